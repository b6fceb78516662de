"""Triangles of USD geometry: polygon meshes validated and triangulated, and shapes that MuJoCo has no primitive for."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from tgdsl.formats.usd.stage import Prim, Stage

SECTIONS = 64
"""Corners of a circle where a round shape becomes a mesh: its area is 0.16 % too small."""
Vertices = Float[np.ndarray, "vertex 3"]
Faces = Int[np.ndarray, "face 3"]


def read_mesh(stage: Stage, prim: Prim) -> tuple[Vertices, Faces]:
    """Return the control cage of a mesh as triangles, in its own space and unit; its faces look outwards.

    Subdivision and holes are ignored.

    Raises:
        RobotError: If it has no points or faces, or they are broken.
    """
    time = stage.pxr.Usd.TimeCode.EarliestTime()
    mesh = stage.pxr.UsdGeom.Mesh(prim)
    points, counts, indices = (
        attribute.Get(time)
        for attribute in (mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    )
    for name, value in (("points", points), ("faceVertexCounts", counts), ("faceVertexIndices", indices)):
        if not value:
            raise stage.error(prim, f"the mesh has no {name}")
    vertices = np.array(points, dtype=np.float64)
    sizes, corners = np.array(counts, dtype=np.int64), np.array(indices, dtype=np.int64)
    if not np.isfinite(vertices).all():
        raise stage.error(prim, "the mesh has points that are not finite")
    if sizes.min() < 3:
        raise stage.error(prim, f"the mesh has a face with {sizes.min()} corners; expected 3 or more")
    if sizes.sum() != len(corners):
        raise stage.error(prim, f"faceVertexCounts add up to {sizes.sum()}, but there are {len(corners)} faceVertexIndices")
    if corners.min() < 0 or corners.max() >= len(vertices):
        wrong = corners.min() if corners.min() < 0 else corners.max()
        raise stage.error(prim, f"faceVertexIndices holds {wrong}; the mesh has {len(vertices)} points")
    faces = _triangles(vertices, sizes, corners)
    return vertices, faces[:, ::-1] if mesh.GetOrientationAttr().Get() == "leftHanded" else faces


def _triangles(vertices: Vertices, sizes: Int[np.ndarray, " polygon"], corners: Int[np.ndarray, " corner"]) -> Faces:
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    results = [corners[starts[sizes == 3, None] + np.arange(3)]]
    order = [np.flatnonzero(sizes == 3)]
    for polygon in np.flatnonzero(sizes > 3):
        ring = corners[starts[polygon] : starts[polygon] + sizes[polygon]]
        results.append(ring[_ear_clipping(vertices[ring])])
        order.append(np.full(len(ring) - 2, polygon))
    return np.concatenate(results)[np.argsort(np.concatenate(order), kind="stable")]


def _ear_clipping(ring: Vertices) -> Faces:
    """Triangulate a simple polygon by ear clipping."""
    following = np.roll(ring, -1, axis=0)
    normal = np.cross(ring - ring[0], following - ring[0]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    sign = -1.0 if normal[axis] < 0 else 1.0
    flat = np.delete(ring, axis, axis=1) * ([1.0, sign] if axis != 1 else [1.0, -sign])
    left, faces = list(range(len(ring))), []
    while len(left) > 3:
        at = next((i for i in range(len(left)) if _is_ear(flat, left, i)), 0)  # of a degenerate ring any corner will do
        faces.append([left[at - 1], left[at], left[(at + 1) % len(left)]])
        del left[at]
    return np.array([*faces, left], dtype=np.int64)


def _is_ear(flat: Float[np.ndarray, "corner 2"], left: list[int], at: int) -> bool:
    a, b, c = flat[left[at - 1]], flat[left[at]], flat[left[(at + 1) % len(left)]]
    if _cross(b - a, c - b) <= 0:
        return False
    others = flat[[i for i in left if not any(np.array_equal(flat[i], corner) for corner in (a, b, c))]]
    if not len(others):
        return True
    sides = np.stack([_cross(q - p, others - p) for p, q in ((a, b), (b, c), (c, a))])
    return not (sides >= 0).all(axis=0).any()


def _cross(a: Float[np.ndarray, " 2"], b: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    return np.asarray(a[0] * b[..., 1] - a[1] * b[..., 0])


def surface_of_revolution(profile: list[tuple[float, float]], axis: str) -> tuple[Vertices, Faces]:
    """Return the surface of a convex solid of revolution as triangles.

    Args:
        profile: Radius and height of its rings, from the lowest to the highest; a ring of radius zero is a tip.
        axis: Its axis of revolution, X, Y or Z.
    """
    angles = 2 * np.pi * np.arange(SECTIONS) / SECTIONS
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rings = [np.c_[circle * radius, np.full(SECTIONS, height)] for radius, height in profile]
    tips = [[0.0, 0.0, profile[0][1]], [0.0, 0.0, profile[-1][1]]]
    vertices = np.concatenate([*rings, tips])
    here, after = np.arange(SECTIONS), (np.arange(SECTIONS) + 1) % SECTIONS
    low, high = len(vertices) - 2, len(vertices) - 1
    faces = [np.stack([np.full(SECTIONS, low), after, here], axis=1)]
    for ring in range(len(profile) - 1):
        a, b = here + ring * SECTIONS, after + ring * SECTIONS
        faces += [np.stack([a, b, b + SECTIONS], axis=1), np.stack([a, b + SECTIONS, a + SECTIONS], axis=1)]
    top = (len(profile) - 1) * SECTIONS
    faces.append(np.stack([np.full(SECTIONS, high), here + top, after + top], axis=1))
    return merge_vertices(vertices @ rotation_from_z(axis).T, np.concatenate(faces))


def rotation_from_z(axis: str) -> Float[np.ndarray, "3 3"]:
    """Return the rotation that takes z to an axis: a cyclic permutation."""
    return np.eye(3)[:, {"X": [1, 2, 0], "Y": [2, 0, 1], "Z": [0, 1, 2]}[axis]]


def merge_vertices(vertices: Vertices, faces: Faces) -> tuple[Float[np.ndarray, "merged 3"], Int[np.ndarray, "kept 3"]]:
    """Merge coincident vertices; drop degenerate faces and unreferenced vertices."""
    merged, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, index = np.unique(faces, return_inverse=True)
    return merged[used], index.reshape(-1, 3)


def capsule_profile(radius: float, low: float, high: float, low_radius: float | None = None) -> list[tuple[float, float]]:
    """Return the profile of the hull of two balls, for `surface_of_revolution`.

    Args:
        radius: Radius of the upper ball, and of the lower one too unless that is given.
        low: Height of the lower ball's centre.
        high: Height of the upper ball's centre.
        low_radius: Radius of the lower ball.
    """
    low_radius = radius if low_radius is None else low_radius
    gap = high - low
    if gap <= abs(radius - low_radius):  # one holds the other
        low, high, radius, low_radius = (
            (high, high, radius, radius) if radius >= low_radius else (low, low, low_radius, low_radius)
        )
        gap = 0.0
    lean = (
        float(np.arcsin((low_radius - radius) / gap)) if gap else 0.0
    )  # height at which the common tangent touches, as an angle
    below = np.linspace(-np.pi / 2, lean, SECTIONS // 4 + 1)
    above = np.linspace(lean, np.pi / 2, SECTIONS // 4 + 1)
    rings = [(low_radius * np.cos(t), low + low_radius * np.sin(t)) for t in below]
    rings += [(radius * np.cos(t), high + radius * np.sin(t)) for t in above]
    rings[0], rings[-1] = (0.0, float(rings[0][1])), (0.0, float(rings[-1][1]))
    return [(float(r), float(z)) for r, z in rings]
