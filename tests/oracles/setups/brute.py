"""Distances to triangles in float64, one triangle at a time: the oracle of every mesh query."""

import numpy as np


def solid_angles(corners, points):
    """Return the signed solid angle of each triangle from each point (Van Oosterom and Strackee)."""
    a, b, c = (corners[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(part, axis=-1) for part in (a, b, c))
    volume = (a * np.cross(b, c)).sum(-1)
    rest = la * lb * lc + (a * b).sum(-1) * lc + (a * c).sum(-1) * lb + (b * c).sum(-1) * la
    return 2 * np.arctan2(volume, rest)


def to_segment(a, b, points):
    """Return distances of points (n, 1, 3) to segments (f, 3)."""
    along = ((points - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1)
    return np.linalg.norm(points - a - np.clip(along, 0, 1)[..., None] * (b - a), axis=-1)


def brute_force(corners, points):
    """Return the distance to the nearest triangle, and the winding number."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    p = points[:, None]
    best = np.minimum(np.minimum(to_segment(a, b, p), to_segment(b, c, p)), to_segment(c, a, p))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    is_over = np.ones(best.shape, bool)
    for start, end in ((a, b), (b, c), (c, a)):
        is_over &= ((p - start) * np.cross(normal, end - start)).sum(-1) >= 0
    best = np.where(is_over, np.abs(((p - a) * normal).sum(-1)), best)
    return best.min(axis=1), solid_angles(corners, points).sum(axis=1) / (4 * np.pi)
