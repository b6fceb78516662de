"""Triangle surfaces as solids: signed distance to the outer surface, sharp edges.

Distances and winding numbers are libigl's. `igl.signed_distance` takes as long (2.8 s for 860,000 points, signs the same), but
builds its trees again at each call.

Shapes: `n` points, `v` vertices, `f` faces, `x`, `y`, `z` nodes along the axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label

from tgdsl.surfaces.outer import is_inside, outer
from tgdsl.surfaces.surface import Surface, face_cross

SHARP = np.deg2rad(30.0)  # angle between the normals of two faces from which their edge is sharp [rad]
CHUNK = 1 << 18  # points per query


@dataclass(frozen=True, eq=False)
class Lattice:
    """A regular grid of nodes around a solid: its bounding box, a margin, and one more cell for the stencil."""

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
    def num_bytes(self) -> int:
        """Size of a float32 at every node [bytes]."""
        return 4 * math.prod(self.shape)

    def pos(self, nodes: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return the positions of nodes, given as flat indices [m]."""
        return self.origin + self.cell * np.stack(np.unravel_index(nodes, self.shape), axis=1)

    def nodes_around(self, pos: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " m"]:
        """Return the nodes needed to interpolate at some points, as sorted flat indices."""
        lower = np.floor((pos - self.origin) / self.cell).astype(int)
        stencil = np.stack(np.meshgrid(*[np.arange(-1, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.unique(np.ravel_multi_index(tuple((lower[:, None] + stencil).reshape(-1, 3).T), self.shape, mode="clip"))


class Solid:
    """The solid that a surface bounds: distances, random points and sharp edges.

    Attributes:
        corners: Corners of the faces that separate inside from outside, and of sheets [m].
        flaws: As in `Outer`.
    """

    def __init__(self, surface: Surface):
        boundary = outer(surface)
        self.corners, self.flaws = boundary.vertices[boundary.faces], boundary.flaws
        self._creases = _creases(boundary.vertices, boundary.uncut)
        self._faces = boundary.vertices, boundary.faces
        self._tree = _tree(*self._faces)

    def is_inside(self, pos: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return whether each point is inside."""
        return is_inside(*self._faces, pos)

    def distance(self, pos: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Return signed distance [m] and its gradient; on the surface the gradient is 0."""
        pos = np.ascontiguousarray(pos)
        squared, _, nearest = self._tree.squared_distance(*self._faces, pos)
        length = np.sqrt(np.asarray(squared)).reshape(-1)
        signed = np.where(self.is_inside(pos), -length, length)
        way = pos - np.asarray(nearest).reshape(-1, 3)
        return signed, np.divide(way, signed[:, None], out=np.zeros_like(way), where=length[:, None] > 1e-9)

    def node_distance(self, lattice: Lattice) -> Float[np.ndarray, "x y z"]:
        """Return the signed distance at all nodes [m].

        There is no surface between two neighbours that are both farther than half a cell from it: connected nodes of this kind
        are on one side, which the winding number of one of them decides.
        """
        length = np.empty(math.prod(lattice.shape))
        for start in range(0, len(length), CHUNK):
            pos = lattice.pos(np.arange(start, min(start + CHUNK, len(length))))
            length[start : start + CHUNK] = np.sqrt(np.reshape(self._tree.squared_distance(*self._faces, pos)[0], -1))
        is_far = (length > 0.51 * lattice.cell).reshape(lattice.shape)
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


def _creases(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the sharp edges: vertices and pairs of their indices; `igl.sharp_edges` leaves out open and non-manifold ones."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    normal = face_cross(vertices[faces])
    normal = np.tile(normal / np.linalg.norm(normal, axis=1, keepdims=True), (3, 1))
    pairs, first, which, count = np.unique(edges, axis=0, return_index=True, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(which.reshape(-1), part, len(pairs)) for part in normal.T], axis=1)
    # Two unit normals at an angle: their sum less one of them is the other.
    cosine = ((total - normal[first]) * normal[first]).sum(axis=1)
    return vertices, np.ascontiguousarray(pairs[(count != 2) | (cosine < np.cos(SHARP))])
