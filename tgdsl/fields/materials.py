"""Materials by name or by numbers: how they conduct, hold and radiate heat, how stiff they are, and how they ring.

Numbers are those at room temperature. Where a source gives a range, the table has its middle. Sources:

- Incropera: Incropera, DeWitt, Bergman, Lavine, *Fundamentals of Heat and Mass Transfer*, 6th ed., tables A.1 (metals), A.3
  (other solids), A.6 (water), A.11 (emissivities);
- Holman: *Heat Transfer*, 10th ed., table A-10 (emissivities);
- Kaye: Kaye & Laby, *Tables of Physical and Chemical Constants*, 2.2.2 (elasticity of isotropic solids);
- Ashby: *Materials Selection in Mechanical Design*, 4th ed., appendix A; Granta: MaterialUniverse, ABS (extrusion);
- Crawford: *Plastics Engineering*, 3rd ed., table 1.8; FLIR: tables of emissivities in the manuals of its cameras;
- Sylgard 184: Dow, its data sheet; Mark: *Polymer Data Handbook*; Johnston et al., J. Micromech. Microeng. 24, 2014;
- USDA: *Wood Handbook*, tables 5-1 and 5-2;
- IT'IS: Foundation for Research on Information Technologies in Society, database of tissue properties, v4;
- Jin: Jin, Xu, Gao, Wu, Wang, Li, *DiffSound*, SIGGRAPH 2024, materials of its published code: Rayleigh's damping by ear, of
  whole objects in air;
- Cremer: Cremer, Heckl, *Structure-Borne Sound*, loss factors η in bending, of the material alone: air and supports take more;
- Adams: Adams, Askenazi, *Building Better Products with Finite Element Analysis*, damping ratio η/2 of rubber.

A loss factor stands as Rayleigh's damping that has it at 1 kHz, where that has its minimum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import pi
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Tag, WithJsonSchema, model_validator
from pydantic_core import CoreSchema, core_schema

from tgdsl.errors import did_you_mean
from tgdsl.fields.models import TEXT_OR_OTHER, Pressure, Quantity, SpecModel, Usual


@dataclass(frozen=True)
class Material:
    """The material of a body: thermal and elastic properties."""

    name: str  # its name; for a material by numbers, the name of the one that it is based on
    conductivity: Annotated[float, Usual("conductivity", low=0.01, high=2500.0)]  # thermal conductivity k [W/(m·K)]
    density: Annotated[float, Usual("mass_density", low=5.0, high=25000.0)]  # ρ [kg/m³]
    specific_heat: Annotated[float, Usual("specific_heat", low=100.0, high=10000.0)]  # specific heat capacity c [J/(kg·K)]
    emissivity: float  # hemispherical emissivity ε of its surface, from 0 to 1
    # Young's modulus E [Pa]; None where it means little, as of a liquid
    youngs_modulus: Annotated[float | None, Usual("pressure", low=1e3, high=1.2e12)]
    poissons_ratio: float | None  # Poisson's ratio ν; None where it means little
    source: str  # where the numbers are from
    # Rayleigh's α [1/s]: a mode of angular frequency ω decays as e^(−dt), d = (α + β ω²)/2. None if unknown.
    mass_damping: float | None = None
    stiffness_damping: float | None = None  # Rayleigh's β [s]; None if unknown

    def damped(self, mass_damping: float, stiffness_damping: float, source: str) -> Material:
        """Return the material with Rayleigh's damping α [1/s] and β [s], and where these are from."""
        return replace(self, mass_damping=mass_damping, stiffness_damping=stiffness_damping, source=f"{self.source}; {source}")


def rayleigh(loss_factor: float, frequency: float = 1000.0) -> tuple[float, float]:
    """Return α [1/s] and β [s] whose loss factor 2d/ω has its minimum at a frequency [Hz], and is given there."""
    omega = 2 * pi * frequency
    return loss_factor * omega / 2, loss_factor / (2 * omega)


_DAMPING = {
    "glass": (1.0, 1e-7, "α, β: Jin"),
    "steel": (5.0, 3e-8, "α, β: Jin"),
    "stainless_steel": (5.0, 3e-8, "α, β: Jin, as steel"),
    "aluminium": (*rayleigh(1e-4), "η 1e-4: Cremer"),
    "anodized_aluminium": (*rayleigh(1e-4), "η 1e-4: Cremer"),
    "copper": (*rayleigh(2e-3), "η 2e-3: Cremer"),
    "brass": (*rayleigh(1e-3), "η 1e-3: Cremer, at most"),
    "abs": (30.0, 1e-6, "α, β: Jin, as plastic"),
    "pla": (30.0, 1e-6, "α, β: Jin, as plastic"),
    "rubber": (*rayleigh(0.1), "η 0.1: Adams"),
    "silicone": (*rayleigh(0.1), "η 0.1: Adams, as rubber"),
    "wood": (60.0, 2e-6, "α, β: Jin"),
}
"""Rayleigh's damping of materials, α [1/s] and β [s], and its source."""

MATERIALS: Mapping[str, Material] = MappingProxyType(
    {
        material.name: material.damped(*_DAMPING[material.name]) if material.name in _DAMPING else material
        for material in (
            Material("glass", 1.4, 2500.0, 750.0, 0.925, 71.3e9, 0.22, "Incropera: plate, window; Kaye: crown glass"),
            Material(
                "steel", 60.5, 7854.0, 434.0, 0.28, 211.9e9, 0.291, "Incropera: plain carbon; Holman: polished; Kaye: mild"
            ),
            Material("stainless_steel", 14.9, 7900.0, 477.0, 0.17, 215.3e9, 0.283, "Incropera: AISI 304, polished; Kaye"),
            Material("aluminium", 237.0, 2702.0, 903.0, 0.04, 70.3e9, 0.345, "Incropera: pure, polished; Kaye"),
            Material("anodized_aluminium", 237.0, 2702.0, 903.0, 0.82, 70.3e9, 0.345, "Incropera: pure, anodized; Kaye"),
            Material("copper", 401.0, 8933.0, 385.0, 0.03, 129.8e9, 0.343, "Incropera: pure, polished; Kaye"),
            Material("brass", 110.0, 8530.0, 380.0, 0.028, 100.6e9, 0.35, "Incropera: 70 Cu 30 Zn; Holman: polished; Kaye"),
            Material("abs", 0.25, 1040.0, 1300.0, 0.93, 2.45e9, 0.41, "Crawford; ε: FLIR, as plastics; E, ν: Granta"),
            Material("pla", 0.135, 1230.0, 1195.0, 0.93, 3.64e9, 0.39, "Ashby; ε: FLIR, as plastics"),
            Material(
                "rubber", 0.13, 1100.0, 2010.0, 0.86, 2.0e6, 0.499, "Incropera: soft, vulcanized; Holman: soft; Ashby: natural"
            ),
            Material(
                "silicone", 0.27, 1030.0, 1460.0, 0.86, 2.0e6, 0.499, "Sylgard 184; c: Mark; ε as soft rubber; E: Johnston"
            ),
            Material("wood", 0.17, 545.0, 2385.0, 0.87, 2.0e9, 0.3, "Incropera: oak, cross grain; USDA: white oak, radial"),
            Material("skin", 0.37, 1109.0, 3391.0, 0.95, None, None, "IT'IS; ε: Incropera"),
            Material("water", 0.613, 997.0, 4179.0, 0.96, None, None, "Incropera: at 300 K"),
        )
    }
)
"""The materials that a document can name."""


THERMAL = ("conductivity", "density", "specific_heat", "emissivity")  # what must be known of a material for heat


def known_material(name: str) -> Material:
    """Return a material by its name.

    Raises:
        ValueError: If there is no material of that name.
    """
    if name not in MATERIALS:
        raise ValueError(f'unknown material "{name}"; {did_you_mean(name, MATERIALS, "materials")}')
    return MATERIALS[name]


_Name = Annotated[
    str, AfterValidator(lambda name: known_material(name).name), WithJsonSchema({"type": "string", "enum": sorted(MATERIALS)})
]


class OwnMaterial(SpecModel):
    """A material by numbers: a known material with changes, or all numbers that heat flow needs."""

    model_config = ConfigDict(json_schema_extra={"anyOf": [{"required": ["like"]}, {"required": [*THERMAL]}]})

    like: _Name | None = None
    """Name of the material that supplies all properties not given here."""
    conductivity: Annotated[float | None, Quantity("conductivity", gt=0.0)] = None
    """Thermal conductivity [W/(m·K)]."""
    density: Annotated[float | None, Quantity("mass_density", gt=0.0)] = None
    """Density [kg/m³]."""
    specific_heat: Annotated[float | None, Quantity("specific_heat", gt=0.0)] = None
    """Specific heat capacity [J/(kg·K)]."""
    emissivity: Annotated[float | None, Quantity("number", ge=0.0, le=1.0)] = None
    """Hemispherical emissivity of its surface, from 0 to 1."""
    youngs_modulus: Pressure | None = None
    """Young's modulus [Pa]; default: unknown."""
    poissons_ratio: Annotated[float | None, Quantity("number", ge=0.0, le=0.5)] = None
    """Poisson's ratio, from 0 to 0.5; default: unknown."""
    mass_damping: Annotated[float | None, Quantity("number", ge=0.0)] = None
    """Rayleigh's damping α [1/s]: modes decay at (α + β ω²)/2; default: unknown."""
    stiffness_damping: Annotated[float | None, Quantity("time", ge=0.0)] = None
    """Rayleigh's damping β [s]; default: unknown."""

    @model_validator(mode="after")
    def _check(self) -> OwnMaterial:
        missing = [name for name in THERMAL if getattr(self, name) is None]
        if self.like is None and missing:
            raise ValueError(f"found no {', '.join(missing)}; expected these, or `like`, the name of a material")
        return self

    def resolved(self) -> Material:
        """Return the material."""
        properties = {f.name: getattr(self, f.name) for f in fields(Material) if f.name in OwnMaterial.model_fields}
        properties = {name: value for name, value in properties.items() if value is not None}
        if self.like is None:
            elastic = {"youngs_modulus": None, "poissons_ratio": None}
            return Material(**{"name": "own", "source": "the document", **elastic, **properties})
        base = known_material(self.like)
        changed = {"name": f"like {base.name}", "source": f"the document; {base.source}"} if properties else {}
        return replace(base, **changed, **properties)


class _AsWritten:
    """Marks a material that is written as a name, or as an `OwnMaterial`."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        return core_schema.no_info_after_validator_function(_material, handler.generate_schema(_Written))


def _material(written: str | OwnMaterial) -> Material:
    return known_material(written) if isinstance(written, str) else written.resolved()


_Written = Annotated[Annotated[_Name, Tag("text")] | Annotated[OwnMaterial, Tag("other")], TEXT_OR_OTHER]
MaterialField = Annotated[Material, _AsWritten()]
"""What a user may write for a material: `steel`, `{like: steel, emissivity: 0.8}`, or all numbers of heat."""
