"""Mass and inertia of a collider as MuJoCo computes them: shells, and the four ways in which it takes meshes."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.formats.usd.shapes import Shape, quaternion

MASS_MODELS = ("legacy", "convex", "exact", "shell")
"""MJCF's ways to take a mesh; `shell` is there for all shapes."""


def mujoco_mass_properties(shape: Shape, model: str) -> tuple[float, Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Return volume [m³] or a shell's area [m²], centre of mass [m] and inertia about it at density one, in the body's frame.

    Args:
        shape: The shape; a mesh must be one that MuJoCo can take so.
        model: One of `MASS_MODELS`.

    Raises:
        ValueError: If MuJoCo cannot take the mesh so.
    """
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    geom = body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}"), density=1.0)
    geom.pos, geom.quat = shape.pose[:3, 3], quaternion(shape.pose)
    if shape.kind == "mesh":
        assert shape.vertices is not None and shape.faces is not None
        inertia = getattr(mujoco.mjtMeshInertia, f"mjMESH_INERTIA_{model.upper()}")
        spec.add_mesh(
            name="mesh", uservert=shape.vertices.ravel().tolist(), userface=shape.faces.ravel().tolist(), inertia=inertia
        )
        geom.meshname = "mesh"
    else:
        geom.size[: len(shape.size)] = shape.size
        geom.typeinertia = mujoco.mjtGeomInertia.mjINERTIA_SHELL
    made = spec.compile()
    axes = Rotation.from_quat(made.body_iquat[1], scalar_first=True).as_matrix()
    return float(made.body_mass[1]), made.body_ipos[1].copy(), axes @ np.diag(made.body_inertia[1]) @ axes.T
