"""Places: points that are fixed to bodies, in the world, as precisely as the state knows them.

Differences of two such points are to be formed before they are cast to the module's dtype: far from the origin they then lose
nothing that the state has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.fields.indices import indices
from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Planning, Quantity, Scene, Use
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.places.request import Places
from tgdsl.quantities.reference import ReferenceScene

__all__ = ["PLACES", "Places", "places_of"]

Array = TypeVar("Array")
FIELDS = frozenset({"body_pos", "body_quat"})


@dataclass(frozen=True, eq=False)
class PlacesUse(Generic[Array]):
    """One request: the bodies in the state (point,), and the points in their frames (point, 3) [m]."""

    bodies: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.bodies)))
    offset: Array


@dataclass(frozen=True, eq=False)
class PlacesPart(Generic[Array]):
    """What the Plan holds of it."""

    uses: tuple[PlacesUse[Array], ...]


def bodies_of(use: Use) -> tuple[str, ...]:
    """Return the bodies of a use's points."""
    assert isinstance(use.request, Places)
    return use.request.bodies


def plan(planning: Planning, uses: Sequence[Use]) -> PlacesPart[np.ndarray]:
    """Return the part of the Plan."""
    found = []
    for use in uses:
        assert isinstance(use.request, Places)
        body_of = {target.name: target.body for target in planning.objects}
        names = use.request.bodies or tuple(body_of[name] for name in use.request.objects if name in body_of)
        bodies = np.array([planning.bodies.index(body) for body in names], dtype=np.int64)
        offset = use.request.offset if use.request.bodies else np.zeros((len(names), 3))
        found.append(PlacesUse(bodies, np.asarray(offset, dtype=np.float64).reshape(-1, 3)))
    return PlacesPart(tuple(found))


def places_of(scene: Scene, bodies: Tensor, offset: Tensor) -> Vec:
    """Return points of bodies in the world (env, point) [m], in the state's dtype."""
    pos, quat = (scene.tensors[name][:, bodies] for name in ("body_pos", "body_quat"))
    return planes.add(planes.split(pos), planes.rotate(planes.rotation(quat), planes.split(offset.to(pos.dtype))))


def gather(part: PlacesPart[Tensor], scene: Scene) -> tuple[Vec, ...]:
    """Return what each use asks for."""
    return tuple(places_of(scene, use.bodies, use.offset) for use in part.uses)


def reference(part: PlacesPart[np.ndarray], use: int, scene: ReferenceScene) -> Float[np.ndarray, "point 3"]:
    """Return the points in the world [m]."""
    own = part.uses[use]
    bodies = [scene.body(scene.bodies[i]) for i in own.bodies]
    return np.stack([body.pos + body.rotation @ offset for body, offset in zip(bodies, own.offset, strict=True)])


def _fields(part: PlacesPart) -> set[str]:
    return set(FIELDS)


def _explain(part: PlacesPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
    return [f"places of {len(part.uses[use].bodies)} points on bodies"]


PLACES = Quantity(
    name="places",
    request=Places,
    part=PlacesPart,
    plan=plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    bodies=bodies_of,
    explain=_explain,
)
