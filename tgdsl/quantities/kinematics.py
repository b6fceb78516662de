"""Kinematics: motion of links, places of points on bodies, and how joints move and are driven.

Positions of `LinkMotion` are cast to the module's dtype: far from the origin a float32 module knows them as float32 does.
`Places` and `Joints` give places in the dtype of the state: subtract two of them before casting, and nothing is lost.

Shapes: `env` environments, `body` bodies of a sensor's links, `point` points on bodies, `joint` joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Rot, Vec
from tgdsl.quantities.base import Planning, Quantity, Request, Scene, Use
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.reference import ReferenceBody, ReferenceScene

Array = TypeVar("Array")


class BodyMotion(NamedTuple):
    """Poses and velocities of the bodies of a sensor's links, in order; planes (env, body)."""

    rotation: Rot  # rotates body vectors into the world
    pos: Vec  # position of each body's frame [m]
    linvel: Vec  # velocity of the frame's origin, in world axes [m/s]
    angvel: Vec  # angular velocity, in world axes [rad/s]


@dataclass(frozen=True, eq=False)
class LinkMotion(Request[BodyMotion]):
    """Asks where the bodies of a sensor's links are and how they move."""


@dataclass(frozen=True, eq=False)
class MotionPart(Generic[Array]):
    """What the Plan holds of it: for each use the indices of its bodies in the state, (body,)."""

    bodies: tuple[Array, ...]


class _Motion(Quantity):
    name, request, part = "motion", LinkMotion, MotionPart
    reads = ("body_pos", "body_quat", "body_linvel", "body_angvel")
    shown = "poses and velocities of its links"

    def plan(self, planning: Planning, uses: Sequence[Use]) -> MotionPart[np.ndarray]:
        return MotionPart(tuple(np.array([planning.bodies.index(body) for body in self.bodies(use)]) for use in uses))

    def gather(self, part: MotionPart[Tensor], scene: Scene) -> tuple[BodyMotion, ...]:
        values = []
        for bodies in part.bodies:
            names = ("body_quat", "body_pos", "body_linvel", "body_angvel")
            quat, *vectors = (scene.tensors[name][:, bodies] for name in names)
            rotation = planes.rot(part.to(scene.dtype) for part in planes.rotation(quat))
            vectors = [planes.vec(part.to(scene.dtype) for part in planes.split(vector)) for vector in vectors]
            values.append(BodyMotion(rotation, *vectors))
        return tuple(values)

    def reference(self, part: MotionPart[np.ndarray], use: int, scene: ReferenceScene) -> list[ReferenceBody]:
        return [scene.body(name) for name in scene.layout.bodies]

    def bodies(self, use: Use) -> tuple[str, ...]:
        return use.bodies


@dataclass(frozen=True, eq=False)
class Places(Request[Vec]):
    """Asks where points on bodies are: planes (env, point) in the world [m], in the dtype of the state.

    With `objects` it asks where the frames of these objects' bodies are, and of no other points.
    """

    bodies: tuple[str, ...] = ()  # the body of each point
    # where each is in its body's frame [m]
    offset: Float[np.ndarray, "point 3"] = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class PlacesUse(Generic[Array]):
    """One request: the bodies in the state (point,), and the points in their frames (point, 3) [m]."""

    bodies: Array
    offset: Array


@dataclass(frozen=True, eq=False)
class PlacesPart(Generic[Array]):
    """What the Plan holds of it."""

    uses: tuple[PlacesUse[Array], ...]


class _Places(Quantity):
    name, request, part = "places", Places, PlacesPart
    reads = ("body_pos", "body_quat")

    def plan_use(self, planning: Planning, use: Use) -> PlacesUse[np.ndarray]:
        request, body_of = use.request, {target.name: target.body for target in planning.objects}
        names = request.bodies or tuple(body_of[name] for name in request.objects if name in body_of)
        bodies = np.array([planning.bodies.index(body) for body in names], dtype=np.int64)
        offset = request.offset if request.bodies else np.zeros((len(names), 3))
        return PlacesUse(bodies, np.asarray(offset, dtype=np.float64).reshape(-1, 3))

    def gather_use(self, part: PlacesUse[Tensor], scene: Scene) -> Vec:
        return _places(scene, part.bodies, part.offset)

    def reference(self, part: PlacesPart[np.ndarray], use: int, scene: ReferenceScene) -> Float[np.ndarray, "point 3"]:
        return _reference_places(scene, part.uses[use].bodies, part.uses[use].offset)

    def bodies(self, use: Use) -> tuple[str, ...]:
        return use.request.bodies

    def explain(self, part: PlacesPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
        return [f"places of {len(part.uses[use].bodies)} points on bodies"]


class JointDrive(NamedTuple):
    """How a sensor's joints move and are driven, in the order of its layout's links; planes (env, joint).

    The reference's are arrays (joint,), its places (joint, 3).
    """

    velocity: Any  # velocity ω [rad/s; slides: m/s]
    effort: Any  # actuator efforts τ [N·m; slides: N]
    place: Any  # where the joint's anchor is in the world [m], in the dtype of the state


@dataclass(frozen=True, eq=False)
class Joints(Request[JointDrive]):
    """Asks how the joints of a sensor that is on joints move and are driven, and where they are.

    Its layout has a link for each joint, of the joint's name, on the body that the joint moves.
    """


@dataclass(frozen=True, eq=False)
class JointsUse(Generic[Array]):
    """One request: joints and their bodies in the state (joint,), and the joints' anchors in these bodies' frames [m]."""

    joints: Array
    bodies: Array
    anchor: Array


@dataclass(frozen=True, eq=False)
class JointsPart(Generic[Array]):
    """What the Plan holds of it."""

    uses: tuple[JointsUse[Array], ...]


class _Joints(Quantity):
    name, request, part = "joints", Joints, JointsPart
    reads = ("body_pos", "body_quat", "joint_vel", "joint_effort")
    shown = "velocity, effort and place of its joints"

    def plan_use(self, planning: Planning, use: Use) -> JointsUse[np.ndarray]:
        joints = np.array([planning.joints.index(link.name) for link in use.links], dtype=np.int64)
        bodies = np.array([planning.bodies.index(link.body) for link in use.links], dtype=np.int64)
        return JointsUse(joints, bodies, np.array([planning.anchors[link.name] for link in use.links]))

    def gather_use(self, part: JointsUse[Tensor], scene: Scene) -> JointDrive:
        velocity, effort = (scene.tensors[name][:, part.joints].to(scene.dtype) for name in ("joint_vel", "joint_effort"))
        return JointDrive(velocity, effort, _places(scene, part.bodies, part.anchor))

    def reference(self, part: JointsPart[np.ndarray], use: int, scene: ReferenceScene) -> JointDrive:
        use_part = part.uses[use]
        velocity, effort = (scene.fields[name][use_part.joints] for name in ("joint_vel", "joint_effort"))
        return JointDrive(velocity, effort, _reference_places(scene, use_part.bodies, use_part.anchor))

    def bodies(self, use: Use) -> tuple[str, ...]:
        return use.bodies


def _places(scene: Scene, bodies: Tensor, offset: Tensor) -> Vec:
    pos, quat = (scene.tensors[name][:, bodies] for name in ("body_pos", "body_quat"))
    return planes.add(planes.split(pos), planes.rotate(planes.rotation(quat), planes.split(offset.to(pos.dtype))))


def _reference_places(scene: ReferenceScene, bodies: np.ndarray, offset: np.ndarray) -> Float[np.ndarray, "point 3"]:
    owners = [scene.body(scene.bodies[i]) for i in bodies]
    return np.stack([body.pos + body.rotation @ point for body, point in zip(owners, offset, strict=True)])


MOTION, PLACES, JOINTS = _Motion(), _Places(), _Joints()
