"""Motion of links: poses and velocities of the bodies that carry a sensor, in the world.

Positions are cast to the module's dtype: far from the origin a float32 module knows them as float32 does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.quantities.base import Planning, Quantity, Scene, Use
from tgdsl.quantities.motion.request import BodyMotion, LinkMotion
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.reference import ReferenceBody, ReferenceScene

__all__ = ["MOTION", "BodyMotion", "LinkMotion"]

Array = TypeVar("Array")
FIELDS = ("body_pos", "body_quat", "body_linvel", "body_angvel")


@dataclass(frozen=True, eq=False)
class MotionPart(Generic[Array]):
    """What the Plan holds of it: for each use the indices of its bodies in the state, (body,)."""

    bodies: tuple[Array, ...]


def bodies_of(use: Use) -> tuple[str, ...]:
    """Return the bodies of a use's links, each once, in order."""
    return tuple(dict.fromkeys(link.body for link in use.links))


def plan(planning: Planning, uses: Sequence[Use]) -> MotionPart[np.ndarray]:
    """Return the part of the Plan."""
    return MotionPart(tuple(np.array([planning.bodies.index(body) for body in bodies_of(use)]) for use in uses))


def gather(part: MotionPart[Tensor], scene: Scene) -> tuple[BodyMotion, ...]:
    """Return what each use asks for."""
    found = []
    for bodies in part.bodies:
        pos, quat, linvel, angvel = (scene.tensors[name][:, bodies] for name in FIELDS)
        rotation = planes.rot(part.to(scene.dtype) for part in planes.rotation(quat))
        vectors = [planes.vec(part.to(scene.dtype) for part in planes.split(value)) for value in (pos, linvel, angvel)]
        found.append(BodyMotion(rotation, *vectors))
    return tuple(found)


def reference(part: MotionPart[np.ndarray], use: int, scene: ReferenceScene) -> list[ReferenceBody]:
    """Return the bodies of a sensor's links."""
    return [scene.body(name) for name in scene.layout.bodies]


def _fields(part: MotionPart) -> set[str]:
    return set(FIELDS)


def _explain(part: MotionPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
    return ["poses and velocities of its links"]


MOTION = Quantity(
    name="motion",
    request=LinkMotion,
    part=MotionPart,
    plan=plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    bodies=bodies_of,
    explain=_explain,
)
