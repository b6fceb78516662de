"""A link's outer surface: its meshes cleaned, without components inside others; points spread over triangles.

Real meshes hold screws and magnets as separate components, and their faces are wound inconsistently.

The only file that imports pymeshlab (GPL-3), and only when a surface is cleaned or sampled: compiled
modules run without it.

Shapes: `f` faces, `edge` three per face, `component` connected components of the mesh, `n` points. Everything is in the body
frame.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tgdsl.surfaces.rays import sphere_directions
from tgdsl.surfaces.region import LENGTH_TOLERANCE
from tgdsl.surfaces.surface import Surface, winding_number

MAX_HOLE = 0.05
"""A component is solid, and can contain points, if the squared length of its border is at most this share of its area: a
sphere with a hole of an eighth of its radius is solid, a bowl is not."""

ROUNDING = 0.05
"""Fast winding numbers (Barill et al., SIGGRAPH 2018) that are this close to an integer are not computed exactly."""


SLABS = sphere_directions(32)
"""Directions across slabs that bound a component: points outside any of them are outside, without a winding number."""


@dataclass(frozen=True, eq=False)
class Shell:
    """A clean surface without enclosed components."""

    surface: Surface  # its triangles; solid components are counter-clockwise seen from outside
    component: Int[np.ndarray, " f"]  # connected component of each face
    is_solid: Bool[np.ndarray, " component"]  # which components enclose a volume

    @cached_property
    def offset(self) -> float:
        """Distance to either side of a face at which points are tested for being inside [m]."""
        return max(1e-6 * float(np.ptp(self.surface.corners.reshape(-1, 3), axis=0).max()), LENGTH_TOLERANCE)

    @cached_property
    def is_closed(self) -> Bool[np.ndarray, " component"]:
        """Which solid components have no border: faces pass every edge as often one way as the other."""
        edges = _edges(self.surface.faces)
        _, edge = np.unique(_keys(edges), return_inverse=True)
        sense = np.bincount(edge, np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0))[edge]
        return self.is_solid & (np.bincount(np.repeat(self.component, 3), sense != 0) == 0)

    def solid(self, component: int) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
        """Return vertices and faces of one component."""
        used, faces = np.unique(self.surface.faces[self.component == component], return_inverse=True)
        return self.surface.vertices[used], faces.reshape(-1, 3).astype(np.int64)

    def winding(self, component: int, pos: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return how often a component winds around points: 1 inside, 0 outside, 1/2 on a flat piece of it."""
        import igl

        winding = np.zeros(len(pos))
        vertices, faces = self.solid(component)
        near = ((pos >= vertices.min(axis=0) - self.offset) & (pos <= vertices.max(axis=0) + self.offset)).all(axis=1)
        extent, height = vertices @ SLABS.T, pos[near] @ SLABS.T
        low, high = extent.min(axis=0) - self.offset, extent.max(axis=0) + self.offset
        near[near] = ((height >= low) & (height <= high)).all(axis=1)
        if near.any():
            winding[near] = np.atleast_1d(igl.fast_winding_number(vertices, faces, np.ascontiguousarray(pos[near])))
        doubtful = np.flatnonzero(np.abs(winding - np.round(winding)) > ROUNDING)
        if len(doubtful):
            winding[doubtful] = winding_number(vertices, faces, pos[doubtful])
        return winding


def outer_shell(surface: Surface) -> Shell:
    """Return the cleaned surface without the components that lie wholly inside another.

    Closed components that are inside out are turned, so that all face outward.

    Raises:
        ImportError: If pymeshlab is not installed.
    """
    clean = _clean(surface)
    component = _components(clean)
    is_solid = _solid(clean, component)
    volume = np.bincount(component, _signed_volumes(clean, component), minlength=len(is_solid))
    is_turned = (is_solid & (volume < 0))[component]
    faces = np.where(is_turned[:, None], clean.faces[:, ::-1], clean.faces)
    shell = Shell(Surface(clean.vertices, faces, clean.face_geom, clean.geoms), component, is_solid)
    is_kept = ~_enclosed(shell)[component]
    old, component = np.unique(component[is_kept], return_inverse=True)
    return Shell(shell.surface.keep(is_kept), component, is_solid[old])


def _clean(surface: Surface) -> Surface:
    """Weld vertices, drop faces without area or that repeat another, make windings agree; each geom by itself."""
    import pymeshlab as untyped

    pymeshlab: Any = untyped
    parts = []
    for geom in range(len(surface.geoms)):
        faces = surface.faces[surface.face_geom == geom]
        if not len(faces):
            continue
        meshes = pymeshlab.MeshSet()
        used, faces = np.unique(faces, return_inverse=True)
        vertices = surface.vertices[used]
        meshes.add_mesh(pymeshlab.Mesh(vertices, faces.reshape(-1, 3)))
        # Repeated corners in files such as STL differ by the rounding of float32, which grows with distance from the origin.
        weld = max(1e-6 * float(np.ptp(vertices, axis=0).max()), LENGTH_TOLERANCE)
        meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(weld))
        meshes.meshing_remove_duplicate_faces()
        meshes.meshing_remove_null_faces()
        if _disagrees(meshes.current_mesh().face_matrix()):
            # If more than two faces share an edge there is no coherent winding, and the file's winding stays.
            with suppress(pymeshlab.PyMeshLabException):
                meshes.meshing_re_orient_faces_coherently()
        mesh = meshes.current_mesh()
        faces = mesh.face_matrix().astype(np.int64)
        face_geom = np.full(len(faces), geom, dtype=np.int64)
        parts.append(Surface(np.array(mesh.vertex_matrix()), faces, face_geom, ()))
    joined = Surface.joined(parts)
    return Surface(joined.vertices, joined.faces, joined.face_geom, surface.geoms)


def stratified_points(
    corners: Float[np.ndarray, "piece 3 3"], num: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Return about `num` points that are spread evenly over triangles, and the triangle of each; without random numbers."""
    import igl
    import pymeshlab as untyped

    pymeshlab: Any = untyped
    vertices, faces = corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    meshes.generate_sampling_stratified_triangle(samplenum=num, sampling="Similar Triangle", random=False)
    pos = np.array(meshes.current_mesh().vertex_matrix())
    _, piece, nearest = igl.point_mesh_squared_distance(pos, vertices, faces)[:3]  # the sampler does not name its triangles
    return np.asarray(nearest), np.asarray(piece, np.int64)


def _edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "edge 2"]:
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _keys(edges: Int[np.ndarray, "edge 2"]) -> Int[np.ndarray, " edge"]:
    """Return a number for each edge, the same in both senses; sorting numbers is faster than sorting pairs."""
    return np.minimum(edges[:, 0], edges[:, 1]) * (edges.max(initial=0) + 1) + np.maximum(edges[:, 0], edges[:, 1])


def _disagrees(faces: Int[np.ndarray, "f 3"]) -> bool:
    """Return whether two neighbours run along their common edge in the same sense."""
    edges = _edges(faces.astype(np.int64))
    _, edge, num_faces = np.unique(_keys(edges), return_inverse=True, return_counts=True)
    sense = np.bincount(edge, np.where(edges[:, 0] < edges[:, 1], 1, -1))
    return bool(((num_faces == 2) & (sense != 0)).any())


def _components(surface: Surface) -> Int[np.ndarray, " f"]:
    """Return the connected component of each face, numbered in the order of the faces."""
    start, end = _edges(surface.faces).T
    size = len(surface.vertices)
    _, label = connected_components(coo_array((np.ones(len(start), bool), (start, end)), (size, size)), directed=False)
    label = label[surface.faces[:, 0]]
    _, first, component = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[component]


def _solid(surface: Surface, component: Int[np.ndarray, " f"]) -> Bool[np.ndarray, " component"]:
    """Return whether each component is closed, except for small holes."""
    edges = _edges(surface.faces)
    _, first, num_faces = np.unique(_keys(edges), return_index=True, return_counts=True)
    border = first[num_faces == 1]
    length = np.linalg.norm(np.diff(surface.vertices[edges[border]], axis=1)[:, 0], axis=1)
    num = component.max(initial=-1) + 1
    perimeter = np.bincount(component[border // 3], length, minlength=num)
    return perimeter**2 <= MAX_HOLE * np.bincount(component, surface.face_areas, minlength=num)


def _signed_volumes(surface: Surface, component: Int[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    _, first = np.unique(component, return_index=True)
    corners = surface.corners - surface.corners[first, :1][component]
    return np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0


def _enclosed(shell: Shell) -> Bool[np.ndarray, " component"]:
    """Return which components lie wholly inside some solid component."""
    num = len(shell.is_solid)
    owner = np.full(len(shell.surface.vertices), -1)
    owner[shell.surface.faces] = shell.component[:, None]
    vertices, owner = shell.surface.vertices[owner >= 0], owner[owner >= 0]
    is_enclosed = np.zeros(num, dtype=bool)
    for component in np.flatnonzero(shell.is_solid).tolist():
        other = owner != component
        # Not 1/2: a vertex on the other's surface, even in a notch of it, shall not count.
        is_out = shell.winding(component, vertices[other]) < 0.9
        is_inside = np.bincount(owner[other][is_out], minlength=num) == 0
        is_inside[component] = False
        is_enclosed |= is_inside
    return is_enclosed
