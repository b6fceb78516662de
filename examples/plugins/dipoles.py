"""Magnets: the field of a magnet in each object, and Hall sensors that read it. A quantity from outside the package.

    B(q) = μ₀/4π (3 (m · q) q/|q|⁵ − m/|q|³)   where |q| > ρ,   μ₀/4π · 2 m/ρ³   inside                   [T]

q the taxel's place in the object's frame [m], m the magnet's moment there [A·m²], ρ its radius [m]: a ball that is magnetised
evenly has exactly this field. Beyond `range` it counts as none. Fields of several magnets add up.

Source: Jackson, *Classical Electrodynamics*, 5.10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Generic, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import PositiveLength, Usual
from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities import Gathered, Planning, Quantity, References, ReferenceScene, Request, Scene, Use
from tgdsl.quantities.base import pairs_for
from tgdsl.quantities.pairs import Pair, at_probes
from tgdsl.quantities.pairs import gathered as of_pairs
from tgdsl.sensors import Kind
from tgdsl.sensors.base import Channel, Lowered, ProbeSpec

Array = TypeVar("Array")
MU = 1e-7
"""μ₀/4π [T·m/A]."""


@dataclass(frozen=True, eq=False)
class MagneticField(Request[Vec]):
    """Asks for B at each taxel in its link's frame [T]; `moment` m [A·m²], `size` ρ [m], `range` [m]."""

    moment: tuple[float, float, float] = (0.0, 0.0, 1.0)
    size: float = 0.005
    range: float = 0.5


@dataclass(frozen=True, eq=False)
class FieldUse(Generic[Array]):
    """A planned request: `pos` (3, taxel) [m]; `pair` (object, taxel), indices; `is_met`, 1 where a taxel senses the object."""

    objects: tuple[int, ...]
    pos: Array
    pair: Array
    is_met: Array
    moment: tuple[float, float, float]
    size: float
    range: float


@dataclass(frozen=True, eq=False)
class FieldPart(Generic[Array]):
    """All uses."""

    uses: tuple[FieldUse[Array], ...]


def _planned(planning: Planning, use: Use, request: MagneticField) -> FieldUse[np.ndarray]:
    bodies, active = planning.bodies_of(use.taxels), planning.layout.radius[use.taxels] > 0
    names = [target.name for target in planning.objects if target.name in request.objects]
    is_met = np.array([[Pair(body, name) in planning.pairs for body in bodies] for name in names]) & active
    ids, pair = tuple(planning.object_id(name) or 0 for name in names), planning.pair_table(names, use.taxels)
    return FieldUse(ids, use.pos, pair, is_met.astype(np.float64), request.moment, request.size, request.range)


def _field(use: FieldUse[Tensor], scene: Scene) -> Vec:
    pairs, pos = pairs_for(scene, is_gated=False), planes.vec(use.pos.unbind())
    zero = pos[0].new_zeros((len(pairs.offset[0]), len(pos[0])))
    total = (zero, zero, zero)
    for i, pair, is_met in zip(use.objects, use.pair, use.is_met, strict=True):
        pairs_of_object = scene.objects[i].pairs
        rotation = planes.rot(at_probes(part, pairs_of_object, pair) for part in pairs.rotation)
        q = planes.add(planes.rotate(rotation, pos), of_pairs(pairs.offset, pairs_of_object, pair))
        away = planes.safe_sqrt(planes.dot(q, q))
        outside, moment = away.clamp(min=use.size), planes.vec(torch.full_like(away, m) for m in use.moment)
        along = torch.where(away > use.size, 3 * planes.dot(moment, q) / outside**5, 0.0)
        across = torch.where(away > use.size, -1.0, 2.0) / outside**3
        field = planes.add(planes.scale(along, q), planes.scale(across, moment))
        weight = torch.where(away > use.range, 0.0, MU * is_met)
        total = planes.add(total, planes.rotate_back(rotation, planes.scale(weight, field)))
    return total


class MagneticFieldQuantity(Quantity):
    """Fields of dipoles, planned by pair, summed in the frame of each link."""

    name, request, part = "magnetic_field", MagneticField, FieldPart

    def plan(self, planning: Planning, uses: Sequence[Use]) -> FieldPart[np.ndarray]:
        """Number the pairs of each use."""
        requested = [(use, use.request) for use in uses if isinstance(use.request, MagneticField)]
        return FieldPart(tuple(_planned(planning, use, request) for use, request in requested))

    def gather(self, part: FieldPart[Tensor], scene: Scene) -> tuple[Vec, ...]:
        """Return B of each use, planes (env, taxel)."""
        return tuple(_field(use, scene) for use in part.uses)

    def reference(self, part: FieldPart[np.ndarray], use: int, scene: ReferenceScene) -> np.ndarray:
        """Return B (taxel, 3) [T], magnet by magnet in the world."""
        planned, layout = part.uses[use], scene.layout
        field = np.zeros_like(layout.pos)
        for t, link_id in enumerate(layout.link_id):
            link = scene.body(layout.links[link_id].body)
            for target in (scene.objects[i] for i in planned.objects):
                magnet = scene.object_body(target)
                q = link.pos + link.rotation @ layout.pos[t] - magnet.pos
                m, away = magnet.rotation @ np.array(planned.moment), np.linalg.norm(q)
                if layout.radius[t] > 0 and target.body != layout.links[link_id].body and away <= planned.range:
                    b = 3 * (m @ q) * q / away**5 - m / away**3 if away > planned.size else 2 * m / planned.size**3
                    field[t] += MU * link.rotation.T @ b
        return field


MAGNETIC_FIELD = MagneticFieldQuantity()


class HallSpec(ProbeSpec):
    """Magnetic field at each taxel [T]."""

    kind: Literal["hall"]
    """Magnetic field at each taxel of a magnet in each object [T]."""
    moment: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Moment of each magnet, in its object's frame [A·m²]."""
    size: Annotated[PositiveLength, Usual("length", high=0.1)] = 0.005
    """Radius of the magnet [m]."""
    range: Annotated[PositiveLength, Usual("length", high=5.0)] = 0.5
    """Distance beyond which a magnet counts as none [m]."""


def lower(spec: HallSpec, layout, surface_of) -> Lowered:
    """Request the field."""
    request = MagneticField(spec.objects, moment=spec.moment, size=spec.size, range=spec.range)
    return Lowered(tuple(Channel(f"field_{axis}", "T") for axis in "xyz"), requests=(request,))


def forward(gathered: Gathered, context, constants, state):
    """Return the planes of the field [T]."""
    return {f"field_{axis}": plane for axis, plane in zip("xyz", gathered[MagneticField], strict=True)}, {}


def reference(spec: HallSpec, layout, gathered: References, context, state):
    """Return the field (taxel, 3) [T]."""
    return gathered[MagneticField], {}


HALL = Kind(HallSpec, lower, forward, reference, quantities=(MAGNETIC_FIELD,))
