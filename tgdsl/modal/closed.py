"""The triangles that bound a body, repaired so that each point of space is clearly inside or outside.

A point is inside where the triangles wind around it, once or more. So geoms that overlap are one solid, a component inside
another one that is wound like it (a screw) is part of it, and one that is wound the other way round is a cavity: that is what
makes a body thin-walled.

Repaired, geom by geom: vertices that coincide are one; triangles without area and repeated ones are dropped; neighbours that
are wound against each other are turned, by connected part, to what most of its area has; a geom that is inside out is turned;
small holes are closed. A geom with larger holes has no inside, which is an error.

Shapes: `v` vertices, `f` faces.
"""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tgdsl.errors import LowerError
from tgdsl.surfaces.holes import hole_caps
from tgdsl.surfaces.meshlab import MAX_HOLE
from tgdsl.surfaces.surface import Surface

COINCIDENT = 1e-7
"""Distance below which two vertices of a geom are one, over its size."""
FLAT = 1e-9
"""Volume below which a geom encloses none, over the cube of its size."""


def refused(what: str, hint: str = "") -> LowerError:
    """Return the error of a body that has no modal analysis."""
    return LowerError(what, field="modes", hint=hint)


def closed(surface: Surface) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return vertices [m] and faces that wind around the inside of a body, once or more, and not around the outside.

    Raises:
        LowerError: If there are no triangles, a coordinate is no number, or a geom is open or flat.
    """
    parts, count = [], 0
    for geom in range(len(surface.geoms)):
        faces = surface.faces[surface.face_geom == geom]
        if len(faces):
            names = [name for name in surface.geoms[geom] if name]
            geom_name = f'geom "{names[0]}"' if names else f"geom {geom}"
            vertices, faces = _closed_geom(surface.vertices, faces, geom_name)
            parts.append((vertices, faces + count))
            count += len(vertices)
    if not parts:
        raise refused("there are no triangles", "a body that rings needs a geom")
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _closed_geom(vertices: np.ndarray, faces: np.ndarray, shown: str) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = _welded(vertices, faces)
    if not np.isfinite(vertices).all():
        raise refused(f"{shown} has a vertex that is no number", "repair the mesh")
    if not len(faces):
        raise refused(f"{shown} has no triangle with an area", "repair the mesh")
    faces = _coherent(vertices, faces)
    area = 0.5 * float(np.asarray(igl.doublearea(vertices, faces)).sum())
    border = _border(vertices, faces)
    if border**2 > MAX_HOLE * area:
        raise refused(
            f"{shown} is open: {1e3 * border:.3g} mm of edges without a second triangle, or with more than two, around "
            f"{1e4 * area:.3g} cm² of surface",
            "close the mesh; a thin wall needs both of its sides",
        )
    vertices, caps = hole_caps(vertices, faces)
    faces = np.concatenate([faces, caps])
    volume, size = enclosed(vertices, faces), float(np.ptp(vertices, axis=0).max())
    if abs(volume) < FLAT * size**3:
        raise refused(f"{shown} encloses no volume", "a thin wall needs both of its sides")
    return vertices, faces if volume > 0 else faces[:, ::-1]


def enclosed(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Return the volume that triangles wind around, counted as often as they do [m³]."""
    a, b, c = (vertices - vertices.mean(axis=0))[faces].swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum()) / 6.0


def _welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a geom's welded vertices, and its distinct faces with an area."""
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used] + 0.0, faces.reshape(-1, 3)
    if not np.isfinite(vertices).all():
        return vertices, faces
    near = COINCIDENT * float(np.ptp(vertices, axis=0).max())
    first, second = KDTree(vertices).query_pairs(near, output_type="ndarray").T
    graph = coo_array((np.ones(len(first), bool), (first, second)), (len(vertices),) * 2)
    _, same = connected_components(graph, directed=False)
    _, first = np.unique(same, return_index=True)
    vertices, faces = vertices[first], same[faces].astype(np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return vertices, faces[np.sort(np.unique(turned, axis=0, return_index=True)[1])]


def _directed(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges, which = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    return edges, which.reshape(-1), np.where(sides[:, 0] < sides[:, 1], 1, -1)


def _border(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the length of edges along which faces do not run as often one way as the other [m]."""
    edges, which, sense = _directed(faces)
    net = np.abs(np.bincount(which, sense, len(edges)))
    return float((net * np.linalg.norm(np.diff(vertices[edges], axis=1)[:, 0], axis=1)).sum())


def _coherent(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return faces wound alike within each connected part, as most of its area was; as they are if all agree already."""
    edges, which, sense = _directed(faces)
    pairs = np.bincount(which, minlength=len(edges)) == 2
    if not (pairs & (np.bincount(which, sense, len(edges)) != 0)).any():
        return faces
    turned, part = (np.asarray(array).astype(np.int64) for array in igl.bfs_orient(faces))
    signed_area = np.where((turned == faces).all(axis=1), 1.0, -1.0) * np.asarray(igl.doublearea(vertices, faces))
    return np.where((np.bincount(part, signed_area) < 0)[part][:, None], turned[:, ::-1], turned)
