"""Hollow bodies to be struck, as triangles."""

import numpy as np
import trimesh
from oracles.setups.solids import box
from scipy.spatial.transform import Rotation


def hollow(outer: trimesh.Trimesh, inner: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return one mesh with a cavity."""
    inner = inner.copy()
    inner.invert()
    return trimesh.util.concatenate([outer, inner])


def thin_box(side: float, wall: float) -> trimesh.Trimesh:
    """Return a closed box with a cavity."""
    return hollow(box([side] * 3), box([side - 2 * wall] * 3))


def slabs(side: float, wall: float, lid: bool = True) -> list[trimesh.Trimesh]:
    """Return the walls of a box, which touch and do not overlap."""
    far, inner = (side - wall) / 2, side - 2 * wall
    found = [box((side, side, wall), at=(0, 0, -far)), box((side, side, wall), at=(0, 0, far))]
    found = found if lid else found[:1]
    found += [box((side, wall, inner), at=(0, sign * far, 0)) for sign in (-1, 1)]
    return found + [box((wall, inner, inner), at=(sign * far, 0, 0)) for sign in (-1, 1)]


def turned(mesh: trimesh.Trimesh, vector: tuple[float, float, float], shift: tuple[float, float, float]) -> trimesh.Trimesh:
    """Return a mesh that is turned by a rotation vector, then shifted."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    matrix[:3, 3] = shift
    return mesh.copy().apply_transform(matrix)
