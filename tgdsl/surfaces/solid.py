"""Triangle surfaces as solids: signed distance to the outer surface, closed boundary loops, sharp edges.

Distances and winding numbers are libigl's. `igl.signed_distance` takes as long (2.8 s for 860,000 points, signs the same), but
builds its trees anew at each call, ignores holes, and measures to faces inside other components too.

Shapes: `n` points, `v` vertices, `f` and `g` faces, `x`, `y`, `z` nodes along the axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tgdsl.errors import BakeError
from tgdsl.surfaces.holes import hole_caps, merged
from tgdsl.surfaces.surface import Surface

SHARP = np.deg2rad(30.0)
"""Angle between the normals of two faces from which their edge is sharp [rad]."""
MAX_COMPONENTS = 64
"""Largest number of connected components of which those inside others are looked for."""
CHUNK = 1 << 18
"""Points that are asked for at once."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """A regular grid of nodes around a solid: its bounding box, a margin, and one cell more for the stencil."""

    origin: Float[np.ndarray, " 3"]
    cell: float
    shape: tuple[int, ...]

    @staticmethod
    def around(solid: Solid, margin: float, cell: float) -> Lattice:
        """Return the lattice of a solid at a cell size [m]."""
        low, high = solid.corners.min(axis=(0, 1)) - margin, solid.corners.max(axis=(0, 1)) + margin
        # An even number puts nodes on the middle planes, where the distance of plates and boxes has its creases.
        num_cells = 2 * np.ceil((high - low) / (2 * cell)) + 2
        return Lattice((low + high) / 2 - cell * num_cells / 2, cell, tuple(int(num) + 1 for num in num_cells))

    @property
    def num_nodes(self) -> int:
        """Number of nodes."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    @property
    def num_bytes(self) -> int:
        """Size of a float32 at every node [bytes]."""
        return 4 * self.num_nodes

    def pos(self, nodes: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return the positions of nodes, given as flat indices [m]."""
        return self.origin + self.cell * np.stack(np.unravel_index(nodes, self.shape), axis=1)

    def nodes_around(self, pos: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " m"]:
        """Return the nodes that interpolating at some points takes, as sorted flat indices."""
        lower = np.floor((pos - self.origin) / self.cell).astype(int)
        stencil = np.stack(np.meshgrid(*[np.arange(-1, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.unique(np.ravel_multi_index(tuple((lower[:, None] + stencil).reshape(-1, 3).T), self.shape, mode="clip"))


class Solid:
    """The solid that a surface bounds: distances, random points and sharp edges.

    Attributes:
        corners: Corners of the faces that separate inside from outside [m].
        is_watertight: As in `Baked`.
    """

    def __init__(self, surface: Surface, leaf: float):
        vertices, faces = merged(surface)
        vertices, caps = hole_caps(vertices, faces)
        self.is_watertight = not len(caps)
        faces, caps = (part[_has_area(vertices[part])] for part in (faces, caps))
        if not len(faces):
            raise BakeError("a surface to bake needs a face with an area")
        self._closed = vertices, np.ascontiguousarray(np.concatenate([faces, caps]))
        before, behind = self._sides(vertices[caps])
        faces = np.concatenate([faces, caps[self.is_inside(before) != self.is_inside(behind)]])
        self._creases = _creases(vertices, faces)
        self.leaf = max(leaf, 1e-3 * float(np.linalg.norm(np.ptp(vertices, axis=0))))
        self.corners = self._outer(vertices, faces, self.leaf)
        self._soup = self.corners.reshape(-1, 3), np.arange(3 * len(self.corners)).reshape(-1, 3)
        self._tree = _tree(*self._soup)

    def is_inside(self, pos: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return which points are inside."""
        if not len(pos):
            return np.zeros(0, bool)
        winding = np.abs(np.atleast_1d(igl.fast_winding_number(*self._closed, np.ascontiguousarray(pos))))
        doubtful = np.flatnonzero(np.abs(winding - 0.5) < 0.1)
        if len(doubtful):
            winding[doubtful] = np.abs(igl.winding_number(*self._closed, np.ascontiguousarray(pos[doubtful])))
        return winding >= 0.5

    def _sides(self, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points just before and behind the middle of triangles."""
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        step = 1e-5 * np.linalg.norm(np.ptp(self._closed[0], axis=0)) * normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return corners.mean(axis=1) + step, corners.mean(axis=1) - step

    def _outer(self, vertices: np.ndarray, faces: np.ndarray, leaf: float) -> np.ndarray:
        """Return the corners of the outer faces; those that meet another component are bisected down to `leaf` [m]."""
        edges = coo_array((np.ones(2 * len(faces)), (faces[:, :2].ravel(), faces[:, 1:].ravel())), (len(vertices),) * 2)
        component_of_face = connected_components(edges, directed=False)[1][faces[:, 0]]
        components = np.unique(component_of_face)
        if not 1 < len(components) <= MAX_COMPONENTS:
            return vertices[faces]
        outer = []
        for component in components:
            others = np.ascontiguousarray(faces[component_of_face != component])
            tree, whole = _tree(vertices, others), vertices[faces[component_of_face == component]]
            corners, owner, pieces, owners = whole, np.arange(len(whole)), [], []
            is_cut = np.zeros(len(whole), bool)
            while len(corners):
                middle = corners.mean(axis=1)
                radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
                is_apart = np.reshape(tree.squared_distance(vertices, others, middle)[0], -1) > radius**2
                is_done = is_apart | (radius <= leaf / 2)
                before, behind = self._sides(corners[is_done])
                is_inner = self.is_inside(before) & self.is_inside(behind)
                is_cut[owner[is_done][is_inner]] = True
                pieces.append(corners[is_done][~is_inner])
                owners.append(owner[is_done][~is_inner])
                corners, owner = bisected(corners[~is_done]), np.tile(owner[~is_done], 2)
            outer += [whole[~is_cut], np.concatenate(pieces)[is_cut[np.concatenate(owners)]]]
        return np.concatenate(outer)

    def distance(self, pos: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Return signed distance [m] and its gradient; on the surface the gradient is 0."""
        pos = np.ascontiguousarray(pos)
        squared, _, nearest = self._tree.squared_distance(*self._soup, pos)
        length = np.sqrt(np.asarray(squared)).reshape(-1)
        signed = np.where(self.is_inside(pos), -length, length)
        way = pos - np.asarray(nearest).reshape(-1, 3)
        return signed, np.divide(way, signed[:, None], out=np.zeros_like(way), where=length[:, None] > 1e-9)

    def node_distance(self, lattice: Lattice) -> Float[np.ndarray, "x y z"]:
        """Return the signed distance at all nodes [m].

        Between two neighbours that are both farther from the surface than half a cell there is none: such nodes that hang
        together are on one side, and the winding number of one of them tells which.
        """
        length = np.empty(lattice.num_nodes)
        for start in range(0, len(length), CHUNK):
            pos = lattice.pos(np.arange(start, min(start + CHUNK, len(length))))
            length[start : start + CHUNK] = np.sqrt(np.reshape(self._tree.squared_distance(*self._soup, pos)[0], -1))
        is_far = (length > lattice.cell / 2 + self.leaf).reshape(lattice.shape)
        regions = np.zeros(lattice.shape, np.int32)
        label(is_far, output=regions)
        regions = regions.reshape(-1)
        names, first = np.unique(regions, return_index=True)
        is_inside = np.zeros(int(names[-1]) + 1, bool)
        is_inside[names] = self.is_inside(lattice.pos(first))
        is_inside = is_inside[regions]
        near = np.flatnonzero(regions == 0)
        is_inside[near] = self.is_inside(lattice.pos(near))
        return np.where(is_inside, -length, length).astype(np.float32).reshape(lattice.shape)

    def edge_distance(self, pos: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the distance to the nearest sharp edge [m]."""
        vertices, edges = self._creases
        if not len(edges):
            return np.full(len(pos), np.inf)
        squared = _tree(vertices, edges).squared_distance(vertices, edges, np.ascontiguousarray(pos))[0]
        return np.sqrt(np.asarray(squared)).reshape(-1)


def _tree(vertices: np.ndarray, simplices: np.ndarray) -> igl.AABB:
    tree = igl.AABB()
    tree.init(vertices, simplices)
    return tree


def _has_area(corners: Float[np.ndarray, "f 3 3"]) -> np.ndarray:
    """Return which triangles are higher than 1e-9 of their longest side: needles are, slivers of zero area are not."""
    sides = corners - np.roll(corners, 1, axis=1)
    longest = (sides**2).sum(axis=2).max(axis=1, initial=0)
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > 1e-9 * longest


def bisected(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "g 3 3"]:
    """Return the two halves of each triangle by longest-edge bisection."""
    length = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    turn = (length.argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(corners, turn[:, :, None], axis=1).swapaxes(0, 1)
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _creases(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the sharp edges: vertices and pairs of their indices; `igl.sharp_edges` leaves out open and non-manifold ones."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.tile(normal / np.linalg.norm(normal, axis=1, keepdims=True), (3, 1))
    pairs, first, which, count = np.unique(edges, axis=0, return_index=True, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(which.reshape(-1), part, len(pairs)) for part in normal.T], axis=1)
    # Two unit normals at an angle: their sum less one of them is the other.
    cosine = ((total - normal[first]) * normal[first]).sum(axis=1)
    return vertices, np.ascontiguousarray(pairs[(count != 2) | (cosine < np.cos(SHARP))])
