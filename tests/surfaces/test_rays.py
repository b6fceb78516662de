"""First hits against brute force."""

import numpy as np

from tgdsl.surfaces.rays import OrthographicView, first_hits
from tgdsl.surfaces.surface import Surface


def test_rays_agree_with_brute_force_on_a_triangle_soup():
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (300, 1, 3)) + rng.uniform(-0.4, 0.4, (300, 3, 3))
    surface = Surface(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3), np.zeros(300, int), (("soup",),))
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes[2] *= np.linalg.det(axes)
    uv = rng.uniform(-1.5, 1.5, (2000, 2))
    view = OrthographicView.of(surface, axes)
    hits = first_hits(view, uv)
    origin = uv @ axes[:2] - 10 * axes[2]
    matrix = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], np.tile(-axes[2], (300, 1))], -1)
    solution = np.linalg.solve(matrix[None], (origin[:, None] - corners[None, :, 0])[..., None])[..., 0]
    is_hit = (solution[..., :2] >= 0).all(-1) & (solution[..., :2].sum(-1) <= 1)
    depth = np.where(is_hit, solution[..., 2] - 10, np.inf)
    np.testing.assert_allclose(hits.depth, depth.min(axis=1), atol=1e-8)
    face = np.where(hits.face >= 0, view.face_id[hits.face], -1)
    np.testing.assert_array_equal(face, np.where(is_hit.any(1), depth.argmin(axis=1), -1))
