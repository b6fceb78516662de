"""A thermometer: at which temperature an object began, and what it is made of; a kind and a quantity that read heat of objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from tgdsl.quantities import Gathered, Quantity, References, Request
from tgdsl.sensors import Kind
from tgdsl.sensors.base import Channel, Lowered, ProbeSpec, body_axis

Array = TypeVar("Array")


class Heat(NamedTuple):
    """Temperature [°C] and conductivity [W/(m·K)] of an object, (env,)."""

    temperature: Tensor
    conductivity: Tensor


@dataclass(frozen=True, eq=False)
class ObjectHeatOf(Request[Heat]):
    """Asks for the heat of its one object."""


@dataclass(frozen=True, eq=False)
class HeatUse(Generic[Array]):
    """What the Plan holds of a request: the object's place in the fields, its temperature if fixed, and (material,) conductivities."""

    place: int
    temperature: float | None
    conductivity: Array


@dataclass(frozen=True, eq=False)
class HeatPart(Generic[Array]):
    """All of them."""

    uses: tuple[HeatUse[Array], ...]


class _Heat(Quantity):
    name, request, part = "object_heat", ObjectHeatOf, HeatPart

    def plan(self, planning, uses) -> HeatPart[np.ndarray]:
        """Look the objects up."""
        found = []
        for use in uses:
            (name,) = use.request.objects
            heat = planning.sensed[name].heat
            if heat is None:
                planning.report(("objects", name), "expected `material`, what it is made of", "")
                continue
            fixed = None if heat.is_per_env else 22.0 if heat.temperature is None else heat.temperature
            found.append(HeatUse(planning.heated.index(name), fixed, np.array([m.conductivity for m in heat.materials])))
        return HeatPart(tuple(found))

    def gather(self, part: HeatPart[Tensor], scene) -> tuple[Heat, ...]:
        """Return the heat of each use's object."""
        found = []
        for use in part.uses:
            same = torch.ones_like(scene.tensors["body_pos"][:, 0, 0], dtype=scene.dtype)
            fixed = use.temperature
            warm = fixed * same if fixed is not None else scene.tensors["object_temperature"][:, use.place].to(scene.dtype)
            is_one = len(use.conductivity) == 1
            conductivity = use.conductivity[0 if is_one else scene.tensors["object_material"][:, use.place].long()]
            found.append(Heat(warm, conductivity * same))
        return tuple(found)

    def reference(self, part: HeatPart[np.ndarray], use: int, scene) -> tuple[float, float]:
        """Return temperature [°C] and conductivity [W/(m·K)]."""
        own = part.uses[use]
        material = int(scene.fields["object_material"][own.place]) if len(own.conductivity) > 1 else 0
        warm = scene.fields["object_temperature"][own.place] if own.temperature is None else own.temperature
        return float(warm), float(own.conductivity[material])

    def fields(self, part: HeatPart) -> set[str]:
        """Temperatures are read if one is part of the state, materials if there is a choice."""
        temperature = {"object_temperature"} if any(use.temperature is None for use in part.uses) else set()
        return temperature | ({"object_material"} if any(len(use.conductivity) > 1 for use in part.uses) else set())


HEAT = _Heat()


class ThermometerSpec(ProbeSpec):
    """Temperature and conductivity of an object."""

    kind: Literal["thermometer"]
    """The same on each link."""
    needs_taxels = False


def lower(spec: ThermometerSpec, layout, surface_of) -> Lowered:
    """Ask for it."""
    channels = Channel("temperature", "°C"), Channel("conductivity", "W/(m·K)")
    return Lowered(channels, requests=(ObjectHeatOf(spec.objects),), rows=body_axis(layout))


def forward(gathered: Gathered, context, constants, state):
    """Return both for every body."""
    heat = gathered[ObjectHeatOf]
    return {"temperature": heat.temperature[:, None], "conductivity": heat.conductivity[:, None]}, {}


def reference(spec: ThermometerSpec, layout, gathered: References, context, state):
    """Return both for every body, (body, 2)."""
    return np.array([gathered[ObjectHeatOf]] * len(layout.bodies)), {}


THERMOMETER = Kind(ThermometerSpec, lower, forward, reference, quantities=(HEAT,))
