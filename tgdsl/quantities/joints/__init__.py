"""Joints: velocity and effort of hinges and slides, and where their anchors are in the world.

A sensor that is on joints has a layout whose links are called as its joints are, each on the body that the joint moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.fields.indices import indices
from tgdsl.quantities.base import Planning, Quantity, Scene, Use
from tgdsl.quantities.joints.request import JointDrive, Joints
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.places import places_of
from tgdsl.quantities.reference import ReferenceScene

__all__ = ["JOINTS", "JointDrive", "Joints", "ReferenceDrive"]

Array = TypeVar("Array")
FIELDS = ("body_pos", "body_quat", "joint_vel", "joint_effort")


class ReferenceDrive(NamedTuple):
    """What `JointDrive` has, of one environment: (joint,) each; `place` (joint, 3)."""

    velocity: Float[np.ndarray, " joint"]
    effort: Float[np.ndarray, " joint"]
    place: Float[np.ndarray, "joint 3"]


@dataclass(frozen=True, eq=False)
class JointsUse(Generic[Array]):
    """One request: joints and their bodies in the state (joint,), and the joints' anchors in these bodies' frames [m]."""

    joints: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.joints)))
    bodies: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.bodies)))
    anchor: Array


@dataclass(frozen=True, eq=False)
class JointsPart(Generic[Array]):
    """What the Plan holds of it."""

    uses: tuple[JointsUse[Array], ...]


def bodies_of(use: Use) -> tuple[str, ...]:
    """Return the bodies that a use's joints move."""
    return tuple(dict.fromkeys(link.body for link in use.links))


def plan(planning: Planning, uses: Sequence[Use]) -> JointsPart[np.ndarray]:
    """Return the part of the Plan."""
    found = []
    for use in uses:
        joints = np.array([planning.joints.index(link.name) for link in use.links], dtype=np.int64)
        bodies = np.array([planning.bodies.index(link.body) for link in use.links], dtype=np.int64)
        found.append(JointsUse(joints, bodies, np.array([planning.anchors[link.name] for link in use.links])))
    return JointsPart(tuple(found))


def gather(part: JointsPart[Tensor], scene: Scene) -> tuple[JointDrive, ...]:
    """Return what each use asks for."""
    found = []
    for use in part.uses:
        velocity, effort = (scene.tensors[name][:, use.joints].to(scene.dtype) for name in ("joint_vel", "joint_effort"))
        found.append(JointDrive(velocity, effort, places_of(scene, use.bodies, use.anchor)))
    return tuple(found)


def reference(part: JointsPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferenceDrive:
    """Return velocity, effort and place of each joint."""
    own = part.uses[use]
    bodies = [scene.body(scene.bodies[i]) for i in own.bodies]
    place = np.stack([body.pos + body.rotation @ anchor for body, anchor in zip(bodies, own.anchor, strict=True)])
    return ReferenceDrive(scene.fields["joint_vel"][own.joints], scene.fields["joint_effort"][own.joints], place)


def _fields(part: JointsPart) -> set[str]:
    return set(FIELDS)


def _explain(part: JointsPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
    return ["velocity, effort and place of its joints"]


JOINTS = Quantity(
    name="joints",
    request=Joints,
    part=JointsPart,
    plan=plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    bodies=bodies_of,
    explain=_explain,
)
