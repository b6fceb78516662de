"""Robot files of one body or a few links, and their surfaces."""

from pathlib import Path

import numpy as np
import trimesh

from tgdsl.formats.model import Model
from tgdsl.formats.robot import load_model

MESH_TOLERANCE = 1e-6
"""MuJoCo keeps vertices in float32, relative to the centre of the mesh: 1e-8 m for a hand; 1e-6 m is the contract."""


def model_of(folder: Path, body: str, asset: str = "", rest: str = "", name: str = "robot.xml") -> Model:
    """Load MJCF with one body, `pad`."""
    text = f"<mujoco><asset>{asset}</asset><worldbody><body name='pad'>{body}</body>{rest}</worldbody></mujoco>"
    (folder / name).write_text(text)
    return load_model(folder / name)


def trimesh_of(model: Model, body: str = "pad") -> trimesh.Trimesh:
    surface = model.surface(model.touchable(body))
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


def wedge() -> trimesh.Trimesh:
    """An asymmetric solid, far from its own origin: its centre of mass and its principal axes are nowhere special."""
    points = np.array([[3.0, 1, 2], [7, 1, 2], [3, 4, 2.5], [3.5, 1, 9], [6, 3, 5]])
    return trimesh.convex.convex_hull(points)


def nearest(points: np.ndarray, others: np.ndarray) -> float:
    """Return the largest distance from a point to its nearest other, both ways."""
    gaps = np.linalg.norm(points[:, None] - others[None], axis=2)
    return max(gaps.min(axis=0).max(), gaps.min(axis=1).max())
