"""Contact patches in float64, pair by pair: the oracle of `gathering`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from tgdsl.quantities.contacts.part import SLOT_FIELDS
from tgdsl.quantities.contacts.reference import completed
from tgdsl.quantities.patches.part import PatchesPart
from tgdsl.quantities.patches.request import cancelled
from tgdsl.quantities.patches.topology import Topology
from tgdsl.quantities.reference import ReferenceScene

Array = np.ndarray


@dataclass(frozen=True)
class Patch:
    """One patch: normal force [N], area [m²], centre [m] and normal, in the link's frame and in the object's."""

    force: float
    area: float
    pos: Float[Array, " 3"]
    normal: Float[Array, " 3"]
    object_pos: Float[Array, " 3"]
    object_normal: Float[Array, " 3"]


@dataclass(frozen=True, eq=False)
class ReferenceObject:
    """What an object is made of, see `HeatOfObjects`; `start` is None where it has no temperature of its own."""

    start: float | None
    conductivity: float
    volumetric_heat: float
    emissivity: float
    compliance: float
    volume: float
    area: float
    curvature: float
    corner: Float[Array, " 3"]
    size: Float[Array, " 3"]


@dataclass(frozen=True, eq=False)
class ReferencePatches:
    """All patches that there are, by (body, object), and what they are between."""

    patches: dict[tuple[int, int], Patch]
    objects: tuple[ReferenceObject, ...]
    topology: Topology
    boxes: Float[Array, "body 2 3"]


def reference(part: PatchesPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferencePatches:
    """Return the patches of a sensor's bodies with the objects of a use."""
    own, found = part.uses[use], {}
    for b, o in own.topology.met:
        patch = _patch(scene, b, scene.contact_pairs[own.pairs[b, o]].object, int(own.pairs[b, o]), own.is_star)
        if patch is not None:
            found[b, o] = patch
    objects = tuple(_object(own, i, scene) for i in range(own.topology.num_objects))
    return ReferencePatches(found, objects, own.topology, own.boxes)


def _patch(scene: ReferenceScene, b: int, name: str, pair: int, is_star: bool) -> Patch | None:
    link = scene.body(scene.layout.bodies[b])
    target = scene.object_body(next(own for own in scene.objects if own.name == name))
    slots = zip(*(scene.fields[field][pair] for field in SLOT_FIELDS), strict=True)
    used = completed([list(row) for row in slots if np.any(row[1:])], scene.fields["contact_netforce"][pair])
    pressing = [(pos, float(force @ normal), normal) for pos, force, _, normal in used if not force @ normal <= 0]
    if not pressing:
        return None
    weights = np.array([force for _, force, _ in pressing])
    pos = np.average([pos for pos, _, _ in pressing], axis=0, weights=weights)
    normal = np.average([normal for _, _, normal in pressing], axis=0, weights=weights)
    if np.linalg.norm(normal) < cancelled():
        normal = pressing[0][2]
    normal = normal / np.linalg.norm(normal)
    area = _area([point - pos for point, _, _ in pressing], normal, is_star)
    frames = [(body.rotation.T @ (pos - body.pos), body.rotation.T @ normal) for body in (link, target)]
    return Patch(float(weights.sum()), area, *frames[0], *frames[1])


def _area(points: list[np.ndarray], normal: np.ndarray, is_star: bool) -> float:
    """Return the area of points about the origin across the normal [m²]: of their hull, or in the order of their angles."""
    one = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    one /= np.linalg.norm(one)
    flat = np.array([[point @ one, point @ np.cross(normal, one)] for point in points])
    if not is_star:
        try:
            return ConvexHull(flat).volume
        except QhullError:  # fewer than three points, or all on a line
            return 0.0
    flat = flat[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]), kind="stable")]
    after = np.roll(flat, -1, axis=0)
    return max(0.0, 0.5 * float(np.sum(flat[:, 0] * after[:, 1] - flat[:, 1] * after[:, 0])))


def _object(use, i: int, scene: ReferenceScene) -> ReferenceObject:  # type: ignore[no-untyped-def]
    start = float(use.start[i]) if use.has_start[i] else None
    if use.has_own_start[i]:
        start = float(scene.fields["object_temperature"][use.heated[i]])
    material = int(scene.fields["object_material"][use.heated[i]]) if use.num_materials[i] > 1 else 0
    variant = int(scene.fields["variant"][use.variants[i]]) if use.variants[i] >= 0 else 0
    corner, size = use.grids[i]
    k, heat, emissivity, compliance = use.materials[i, material].tolist()
    volume, area, curvature = use.shapes[i, variant].tolist()
    return ReferenceObject(start, k, heat, emissivity, compliance, volume, area, curvature, corner, size)
