"""Float64 definition of the contact query, in the world frame and one point at a time: the oracle of `query`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from tgdsl.geometry.planes import tie

Array = np.ndarray
TIE = tie()
"""Lengths [m] that differ by no more than this count as equal, and the first among equals wins."""


@dataclass(frozen=True, eq=False)
class ReferenceBody:
    """A body at one instant, in the world frame.

    Attributes:
        pos: Position of its frame [m].
        quat: Orientation, w, x, y, z.
        linvel: Velocity of the frame's origin [m/s].
        angvel: Angular velocity [rad/s].
    """

    pos: Float[Array, 3]
    quat: Float[Array, 4]
    linvel: Float[Array, 3]
    angvel: Float[Array, 3]

    @cached_property
    def rotation(self) -> Float[Array, "3 3"]:
        """Rotates body vectors into the world."""
        return Rotation.from_quat(self.quat, scalar_first=True).as_matrix()

    def velocity_at(self, point: Float[Array, 3]) -> Float[Array, 3]:
        """Velocity [m/s] of the body's material at a world point."""
        return self.linvel + np.cross(self.angvel, point - self.pos)


@dataclass(frozen=True, eq=False)
class ReferenceGeom:
    """A geom in its body's frame: MuJoCo's type name and size [m], position [m], rotation matrix."""

    shape: str
    size: Float[Array, 3]
    pos: Float[Array, 3]
    rotation: Float[Array, "3 3"]


@dataclass(frozen=True, eq=False)
class ReferenceContacts:
    """The solver's contacts, each in the frame of its body: `contacts.Contacts` as a list.

    Attributes:
        body: Which body each is on.
        pos: Contact points [m].
        force: Force on the body [N].
        torque: Torque on the body [N·m].
        normal: Unit normal out of the object.
        net: Whole force on each body [N].
    """

    body: Int[Array, " contact"]
    pos: Float[Array, "contact 3"]
    force: Float[Array, "contact 3"]
    torque: Float[Array, "contact 3"]
    normal: Float[Array, "contact 3"]
    net: Float[Array, "body 3"]


@dataclass(frozen=True, eq=False)
class ReferenceMoments:
    """Moments of objects' surfaces and the objects' motion, in the links' frames: those of `query.Felt` as arrays.

    Attributes:
        mass: S0 [m³].
        first: S1 about the probe [m⁴].
        velocity: Velocity of each object's material at the probe relative to the probe [m/s].
        angular: Angular velocity of each object relative to the link [rad/s].
        turn: The link's own angular velocity [rad/s].
        area: Area of each object's outer surface, planes left out [m²].
    """

    mass: Float[Array, "taxel object"]
    first: Float[Array, "taxel object 3"]
    velocity: Float[Array, "taxel object 3"]
    angular: Float[Array, "taxel object 3"]
    turn: Float[Array, "taxel 3"]
    area: Float[Array, " object"]


@dataclass(frozen=True, eq=False)
class ReferencePoints:
    """Points sampled on one object, in the frame of one link that they may meet: a row of `query.MetPoints` as arrays.

    Attributes:
        taxels: The link's taxels.
        pos: Where they are [m].
        distance: Signed distance to the link's own surface [m]; +∞ where the gate is closed.
        gradient: Its unit gradient.
        area: Surface that each stands for [m²].
    """

    taxels: Int[Array, " own"]
    pos: Float[Array, "point 3"]
    distance: Float[Array, " point"]
    gradient: Float[Array, "point 3"]
    area: float


@dataclass(frozen=True, eq=False)
class Touch:
    """What a sensor's probes feel, in their links' frames: the fields of `query.Felt`, one row per taxel.

    `distance` [m] and its gradient `outward` are those of `Felt.distances`, one column per object; `rotation` and `offset` [m]
    those of `Felt.frames`.
    """

    depth: Float[Array, " taxel"]
    normal: Float[Array, "taxel 3"]
    velocity: Float[Array, "taxel 3"]
    angular: Float[Array, "taxel 3"]
    distance: Float[Array, "taxel object"]
    outward: Float[Array, "taxel object 3"]
    rotation: Float[Array, "taxel object 3 3"]
    offset: Float[Array, "taxel object 3"]
    contacts: ReferenceContacts | None = None
    moments: ReferenceMoments | None = None
    points: tuple[ReferencePoints, ...] = ()


def touch(
    link: ReferenceBody,
    pos: Float[Array, "taxel 3"],
    radius: Float[Array, " taxel"],
    objects: Sequence[tuple[ReferenceBody, Sequence[ReferenceGeom]] | None],
) -> Touch:
    """Query the probes of one link against the objects that it may feel; None stands for one that it may not.

    The paper's equations word for word: q = p_L + R_L x, d = max(0, max_g (R − φ_g(q))), m = ∇φ at the deepest geom,
    v = R_Lᵀ (v_C(q) − v_L(q)). A probe whose radius is −∞ is inactive.
    """
    normal, velocity, angular = np.zeros((3, len(pos), 3))
    distance, outward = np.full((len(pos), len(objects)), np.inf), np.zeros((len(pos), len(objects), 3))
    rotations, offsets = np.zeros((len(pos), len(objects), 3, 3)), np.zeros((len(pos), len(objects), 3))
    felt = Touch(np.zeros(len(pos)), normal, velocity, angular, distance, outward, rotations, offsets)
    into_link = link.rotation.T
    for j, x in enumerate(pos):
        q = link.pos + link.rotation @ x
        for k, target in enumerate(objects):
            if target is None or radius[j] == -np.inf:
                continue
            body, geoms = target
            felt.rotation[j, k] = body.rotation.T @ link.rotation
            felt.offset[j, k] = body.rotation.T @ (link.pos - body.pos)
            for geom in geoms:
                rotation = body.rotation @ geom.rotation
                local = rotation.T @ (q - body.pos - body.rotation @ geom.pos)
                phi, gradient = signed_distance(geom.shape, geom.size, local)
                if phi < felt.distance[j, k] - TIE:
                    felt.outward[j, k] = into_link @ rotation @ gradient
                felt.distance[j, k] = min(phi, felt.distance[j, k])
            depth, before = radius[j] - felt.distance[j, k], felt.depth[j]
            felt.depth[j] = max(depth, before)
            if depth > (before + TIE if before > 0 else 0.0):
                felt.normal[j] = felt.outward[j, k]
                felt.velocity[j] = into_link @ (body.velocity_at(q) - link.velocity_at(q))
                felt.angular[j] = into_link @ (body.angvel - link.angvel)
    return felt


def distance_to(geoms: Sequence[ReferenceGeom], point: Float[Array, 3]) -> tuple[float, Float[Array, 3]]:
    """Return the signed distance [m] of a point in a body's frame to its geoms, and its gradient; the first of equals wins."""
    least, outward = np.inf, np.zeros(3)
    for geom in geoms:
        phi, gradient = signed_distance(geom.shape, geom.size, geom.rotation.T @ (point - geom.pos))
        if phi < least - TIE:
            outward = geom.rotation @ gradient
        least = min(phi, least)
    return least, outward


def signed_distance(shape: str, size: Float[Array, 3], point: Float[Array, 3]) -> tuple[float, Float[Array, 3]]:
    """Return the signed distance [m] of a point to a primitive, and the outward gradient, both in the geom's frame.

    Found by way of the nearest surface point, which the module's own `shapes` never form. Where that is not unique, the
    convention is: +x at a centre or on an axis; x before y before z among equally near faces, a wall before a cap; the
    positive side on a plane of symmetry; all of this within `TIE` of such a place.
    """
    if shape == "plane":
        return float(point[2]), np.array([0.0, 0.0, 1.0])
    if shape in ("sphere", "capsule"):
        half = size[1] if shape == "capsule" else 0.0
        core = np.array([0.0, 0.0, np.clip(point[2], -half, half)])
        length = float(np.linalg.norm(point - core))
        if length <= TIE:
            return length - size[0], np.array([1.0, 0.0, 0.0])
        return length - size[0], (point - core) / length
    nearest, is_inside, outward = {"box": _box, "cylinder": _cylinder, "ellipsoid": _ellipsoid}[shape](size, point)
    length = float(np.linalg.norm(point - nearest))
    if is_inside or length <= TIE:
        return -length if is_inside else length, outward
    return length, (point - nearest) / length


def _box(size: Array, point: Array) -> tuple[Array, bool, Array]:
    room = size - np.abs(point)
    inside = bool(np.all(room >= 0))
    nearest = np.clip(point, -size, size)
    if inside:
        deepest = int(np.argmin(room))
        nearest[deepest] = np.copysign(size[deepest], point[deepest])
    axis = 0 if room[0] <= room[1:].min() + TIE else 1 if room[1] <= room[2] + TIE else 2
    outward = np.zeros(3)
    outward[axis] = -1.0 if point[axis] < -TIE else 1.0
    return nearest, inside, outward


def _cylinder(size: Array, point: Array) -> tuple[Array, bool, Array]:
    radius, half = size[0], size[1]
    radial = float(np.hypot(point[0], point[1]))
    along = point[:2] / radial if radial > TIE else np.array([1.0, 0.0])
    sign = -1.0 if point[2] < -TIE else 1.0
    to_wall, to_cap = radius - radial, half - abs(point[2])
    outward = np.array([*along, 0.0]) if to_wall <= to_cap + TIE else np.array([0.0, 0.0, sign])
    if to_wall < 0 or to_cap < 0:
        nearest = np.array([*(along * min(radial, radius)), np.clip(point[2], -half, half)])
        return nearest, False, outward
    if to_wall <= to_cap:
        return np.array([*(along * radius), point[2]]), True, outward
    return np.array([point[0], point[1], np.copysign(half, point[2])]), True, outward


def _ellipsoid(size: Array, point: Array) -> tuple[Array, bool, Array]:
    """Nearest point by bracketing u = t + e², t the Lagrange multiplier: X_i = e_i² p_i / (u + e_i² − e²), ‖X/e‖ = 1.

    If no u above the pole 0 of the least semi-axis e solves it, the point is on that axis' plane of symmetry and the nearest
    points are a mirrored pair, of which the positive is taken.
    """
    square = size**2
    least = int(np.argmin(size))
    sign = np.where(point < -TIE, -1.0, 1.0)
    y = np.abs(point)
    gap = square - square[least]
    terms = [(part, rest) for part, rest in zip((size * y).tolist(), gap.tolist(), strict=True) if part > 0]

    def excess(u: float) -> float:
        return sum((part / (u + rest)) ** 2 for part, rest in terms) - 1.0

    flat = square > square[least]
    at_pole = np.sum((size[flat] * y[flat] / gap[flat]) ** 2)
    if not np.any(y[square == square[least]] > 0) and at_pole <= 1.0:
        nearest = np.zeros(3)
        nearest[flat] = square[flat] * y[flat] / gap[flat]
        nearest[least] = size[least] * np.sqrt(1.0 - at_pole)
    else:
        low, high = max(1e-300, float(np.max(size * y - gap))), float(np.linalg.norm(size * y))
        u = brentq(excess, 0.5 * low, 2.0 * max(low, high), xtol=1e-300, rtol=np.float64(1e-15))
        nearest = square * y / (u + gap)
    inside = bool(np.sum((point / size) ** 2) < 1.0)
    outward = nearest / square
    return sign * nearest, inside, sign * outward / np.linalg.norm(outward)
