"""Holes of triangle surfaces, and triangles that close them.

Shapes: `v` vertices, `f` and `g` faces.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from tgdsl.surfaces.surface import Surface


def merged(surface: Surface) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Int[np.ndarray, " f"]]:
    """Return a surface's distinct vertices [m], the faces that have three of them, and which of its faces these are."""
    vertices, same = np.unique(np.asarray(surface.vertices, float) + 0.0, axis=0, return_inverse=True)
    faces = same.reshape(-1)[np.asarray(surface.faces, np.int64)]
    face = np.flatnonzero((faces != np.roll(faces, 1, axis=1)).all(axis=1))
    return vertices, faces[face], face


def hole_caps(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Return the vertices with a centre for each boundary loop, and the triangle fans that close the loops.

    An edge is open where its faces do not run along it as often one way as the other. What is open is a boundary and has
    none itself, so every walk along open edges comes back, whatever the mesh.
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
