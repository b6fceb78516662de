"""Triangle surfaces of links, as NumPy arrays in the frame of the body they belong to.

Shapes: `v` vertices, `f` faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one or several geoms of a body."""

    vertices: Float[np.ndarray, "v 3"]  # positions in the body frame [m]
    faces: Int[np.ndarray, "f 3"]  # vertex indices, counter-clockwise seen from outside
    face_geom: Int[np.ndarray, " f"]  # index into `geoms` of the geom that each face belongs to
    geoms: tuple[tuple[str, ...], ...]  # names of the geoms: their own name and, if any, their mesh's

    @cached_property
    def corners(self) -> Float[np.ndarray, "f 3 3"]:
        """Corner positions of each face [m]."""
        return self.vertices[self.faces]

    @cached_property
    def _cross(self) -> Float[np.ndarray, "f 3"]:
        return face_cross(self.corners)

    @cached_property
    def face_areas(self) -> Float[np.ndarray, " f"]:
        """Area of each face [m²]."""
        return 0.5 * np.linalg.norm(self._cross, axis=1)

    @cached_property
    def face_normals(self) -> Float[np.ndarray, "f 3"]:
        """Outward unit normal of each face; zero for a face without area."""
        length = np.linalg.norm(self._cross, axis=1, keepdims=True)
        return np.divide(self._cross, length, out=np.zeros_like(self._cross), where=length > 0)

    @cached_property
    def hull_area(self) -> float:
        """Area of the surface's convex hull [m²]; infinite if it is flat."""
        from scipy.spatial import ConvexHull, QhullError  # takes 0.3 s, and compiled modules do not need it

        try:
            return float(ConvexHull(self.vertices[np.unique(self.faces)]).area)
        except QhullError:
            return np.inf

    def keep(self, faces: Bool[np.ndarray, " f"]) -> Surface:
        """Return the surface of some of the faces; vertices and geoms stay."""
        return Surface(self.vertices, self.faces[faces], self.face_geom[faces], self.geoms)

    def placed(self, pos: Float[np.ndarray, " 3"], rotation: Float[np.ndarray, "3 3"]) -> Surface:
        """Return the surface rotated about the origin and then shifted [m]."""
        return Surface(self.vertices @ rotation.T + pos, self.faces, self.face_geom, self.geoms)

    @staticmethod
    def joined(parts: Sequence[Surface]) -> Surface:
        """Return one surface that holds all faces of the parts, in order."""
        vertices, faces, face_geom, geoms = [], [], [], []
        num_vertices = 0
        for part in parts:
            faces.append(part.faces + num_vertices)
            face_geom.append(part.face_geom + len(geoms))
            vertices.append(part.vertices)
            geoms.extend(part.geoms)
            num_vertices += len(part.vertices)
        return Surface(np.concatenate(vertices), np.concatenate(faces), np.concatenate(face_geom), tuple(geoms))


def face_cross(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 3"]:
    """Return the normal of each face, twice its area long [m²]."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def face_areas(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, " f"]:
    """Return the area of each face [m²]."""
    return 0.5 * np.linalg.norm(face_cross(corners), axis=1)


def winding_number(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], pos: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Return how often faces wind around points, as the sum of their solid angles over 4π.

    Source: Van Oosterom and Strackee, The Solid Angle of a Plane Triangle, 1983. Not `igl.winding_number`: on more than 100
    faces its answer for one point changes from call to call (a block of 800 triangles: 43 of 300 calls off by up to 0.9).
    """
    i, j, k = faces.T
    result = np.zeros(len(pos))
    for n, point in enumerate(pos):
        apart = vertices - point
        x, y, z = apart.T.copy()
        ax, ay, az, bx, by, bz, cx, cy, cz = x[i], y[i], z[i], x[j], y[j], z[j], x[k], y[k], z[k]
        a, b, c = (np.linalg.norm(apart, axis=1)[corner] for corner in (i, j, k))
        volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        spread = a * b * c + (ax * bx + ay * by + az * bz) * c + (bx * cx + by * cy + bz * cz) * a
        spread += (cx * ax + cy * ay + cz * az) * b
        result[n] = np.arctan2(volume, spread).sum() / (2 * np.pi)
    return result


def merged(surface: Surface) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Int[np.ndarray, " f"]]:
    """Return a surface's distinct vertices [m], the faces with three distinct ones, and these faces' indices."""
    vertices, same = np.unique(np.asarray(surface.vertices, float) + 0.0, axis=0, return_inverse=True)
    faces = same.reshape(-1)[np.asarray(surface.faces, np.int64)]
    face = np.flatnonzero((faces != np.roll(faces, 1, axis=1)).all(axis=1))
    return vertices, faces[face], face


def hole_caps(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Return the vertices with a centre for each boundary loop, and the triangle fans that close the loops.

    An edge is open unless its faces run along it equally often in both senses. Open edges form a boundary, which has no
    boundary itself: every walk along them returns to its start, for any mesh.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs, which = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    net = np.bincount(which.reshape(-1), np.where(edges[:, 0] < edges[:, 1], 1, -1), len(pairs)).astype(int)
    onward: dict[int, list[int]] = {}
    for (low, high), times in zip(pairs[net != 0].tolist(), net[net != 0].tolist(), strict=True):
        start, end = (high, low) if times > 0 else (low, high)
        onward.setdefault(start, []).extend([end] * abs(times))
    middles, caps = [], []
    for first in onward:
        path = [first]
        while onward[first] or len(path) > 1:
            path.append(onward[path[-1]].pop())
            at = path.index(path[-1])
            if at < len(path) - 1:
                loop = path[at:-1]
                path = path[: at + 1]
                middle = len(vertices) + len(middles)
                middles.append(vertices[loop].mean(axis=0))
                caps.extend((start, end, middle) for start, end in zip(loop, loop[1:] + loop[:1], strict=True))
    return np.concatenate([vertices, np.reshape(middles, (-1, 3))]), np.array(caps, np.int64).reshape(-1, 3)
