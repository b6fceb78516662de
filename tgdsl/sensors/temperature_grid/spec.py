"""What a document says of a temperature grid."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Annotated, Literal

from pydantic import Field, StrictInt, model_validator

from tgdsl.fields.materials import Material, MaterialField
from tgdsl.fields.models import Area, PositiveLength, Quantity, SpecModel, Temperature, Usual
from tgdsl.fields.regions import Region
from tgdsl.sensors.base import Alternative, LinkSpec

Face = Literal["-x", "+x", "-y", "+y", "-z", "+z"]
FACES: tuple[Face, ...] = ("-x", "+x", "-y", "+y", "-z", "+z")
"""Faces of a box, by the axis of the link's frame that they are across, and on which side."""
HeatTransfer = Annotated[float, Quantity("heat_transfer", gt=0.0)]
Cells = Annotated[tuple[Annotated[StrictInt, Field(ge=1)], ...], Field(min_length=3, max_length=3)]


class HeatSource(SpecModel):
    """Heat that is made in each link: one of both."""

    power: Annotated[Annotated[float, Quantity("power")] | None, Usual("power", high=100.0)] = None
    """In all of each link, evenly [W]."""
    flux: Annotated[Annotated[float, Quantity("heat_flux")] | None, Usual("heat_flux", high=1e6)] = None
    """Through a face of each link's box, into the cells there [W/m²]."""
    face: Face | None = None
    """The face of `flux`."""

    @model_validator(mode="after")
    def _check(self) -> HeatSource:
        if (self.power is None) == (self.flux is None):
            raise ValueError("expected one of `power` and `flux`")
        if (self.flux is None) != (self.face is None):
            raise ValueError("`face` says where `flux` comes in: expected both or neither")
        return self


class TemperatureGridSpec(LinkSpec):
    """Temperatures of links that are divided into cells."""

    kind: Literal["temperature_grid"]
    """Temperature of each cell of a link [°C], by conduction within it, heat made there, losses, and what it touches."""
    feels: tuple[str, ...] = ()
    """Objects that heat flows to and from where they touch. An object that is a body of one of the links is that link."""
    cells: Cells | None = None
    """How many cells the box of each link is divided into, along x, y and z of the link's frame."""
    spacing: Annotated[PositiveLength | None, Usual("length", low=1e-5, high=0.1)] = None
    """In place of `cells`: their size, at most [m]."""
    region: Region = ()
    """Part of each link's surface whose box is divided, such as a geom by its name; default: all of the link's surface."""
    material: MaterialField
    """What the links are made of: a material by name, or by its numbers."""
    materials: dict[str, MaterialField] = {}
    """Other materials, by links' names or shell wildcards; the first that matches counts."""
    ambient: Temperature = 22.0
    """Temperature of the surroundings [°C]."""
    temperature: Temperature | None = None
    """Temperature at which the links begin an episode [°C]; default: ambient."""
    scheme: Literal["exact", "spectral", "semi_implicit"] = "exact"
    """Conduction within a link in a step: `exact` of the cells' own equations, never beyond the temperatures around; `spectral`
    of the continuous solid's modes, which oversteps a jump by up to 4 % of it; `semi_implicit`, of first order in time (the
    paper)."""
    model: Literal["physical", "paper"] = "physical"
    """`paper`: the formulas as printed, which neither have the units of a heat flow nor are stable."""
    source: HeatSource | None = None
    """Heat that is made in the links; default: none."""
    emissivity: Literal["material"] | Annotated[float, Quantity("number", ge=0.0, le=1.0)] | None = None
    """Radiation of the exposed faces and of the objects: `material`, or the links' emissivity [1]; default: none."""
    convection: HeatTransfer | None = None
    """Convection from the exposed faces and the objects: heat transfer coefficient [W/(m²·K)]; default: none."""
    exposed: Annotated[tuple[Face, ...], Field(min_length=1)] = FACES
    """Faces that radiate and that air cools."""
    contact_area: Literal["manifold"] | Area = "manifold"
    """Area of a patch: `manifold`, the contact points' convex hull, or by Hertz from the force, whichever is larger; or this,
    whenever they touch [m²]. A side whose material has no Young's modulus, as skin, counts as rigid."""
    contact_conductance: HeatTransfer | None = None
    """Conductance of the interface itself, of roughness or a film [W/(m²·K)]; default: it is no resistance."""
    curvature_radius: Annotated[PositiveLength | None, Usual("length", low=1e-4, high=1.0)] = None
    """Radius of the links' surface where they touch, for Hertz [m]; default: half of the shortest side of its box."""
    slots: Annotated[StrictInt, Field(ge=1, le=32)] = 4
    """Contacts per link and object that make a patch [1]."""
    lag: Annotated[Annotated[float, Quantity("time", gt=0.0)] | None, Usual("time", low=1e-4, high=100.0)] = None
    """Time constant of the sensing element, by which readings trail temperatures [s]; default: none."""
    outputs: Literal["cells", "surface", "max", "mean"] = "cells"
    """What is read: every cell, those at the faces of the box, or one number of each link."""

    @model_validator(mode="after")
    def _check(self) -> TemperatureGridSpec:
        if (self.cells is None) == (self.spacing is None):
            raise ValueError("expected one of `cells` and `spacing`")
        for name, where in self._without_effect:
            raise ValueError(f"`{name}` has no effect {where}; remove it")
        if self.model == "paper" and self.source is not None and self.source.flux is None:
            raise ValueError("the source of `model: paper` is a `flux`, found `power`")
        return self

    @property
    def _without_effect(self) -> Iterator[tuple[str, str]]:
        """Fields that others make meaningless, and by which."""
        idle: list[tuple[bool, set[str], str]] = [
            (self.model == "paper", {"scheme", "contact_conductance"}, "with `model: paper`"),
            (not self.feels, {"contact_area", "contact_conductance", "curvature_radius", "slots"}, "without `feels`"),
            (self.contact_area != "manifold", {"curvature_radius"}, "with a given `contact_area`"),
            (self.emissivity is None and self.convection is None, {"exposed"}, "without `emissivity` or `convection`"),
        ]
        for is_idle, names, where in idle:
            yield from ((name, where) for name in sorted(names & self.model_fields_set) if is_idle)

    @property
    def objects(self) -> tuple[str, ...]:
        """Objects that the sensor feels."""
        return self.feels

    @property
    def start(self) -> float:
        """Temperature at which the links begin [°C]."""
        return self.ambient if self.temperature is None else self.temperature

    def material_of(self, link: str) -> Material:
        """Return what a link is made of."""
        return next((own for pattern, own in self.materials.items() if fnmatchcase(link, pattern)), self.material)


def alternatives(spec: TemperatureGridSpec) -> list[Alternative]:
    """Return coarser cells, the other schemes, and cells of half the size."""
    if spec.model == "paper":
        return []

    def resolved(label: str, factor: float) -> Alternative:
        if spec.spacing is not None:
            return Alternative(label, {"spacing": factor * spec.spacing, "scheme": "exact"})
        assert spec.cells is not None
        return Alternative(label, {"cells": [max(1, round(num / factor)) for num in spec.cells], "scheme": "exact"})

    schemes = [Alternative(scheme, {"scheme": scheme}) for scheme in ("semi_implicit", "spectral", "exact")]
    return [resolved("cells of twice the size", 2.0), *schemes, resolved("cells of half the size", 0.5)]
