"""Models and layouts mirrored by `robots/mirror.py`, and checks that two of them are mirror images."""

import importlib
import sys
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from scipy.spatial import KDTree

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "robots"))  # as the script has it
mirror, mirror_mjcf, reflection = map(importlib.import_module, ("mirror", "mirror_mjcf", "reflection"))
ROBOTS = ROOT / "robots"
EXACT = 1e-9
"""Only rounding differs; mesh files are float32, which the reflection keeps."""
FLOAT32 = 2e-8
"""MuJoCo keeps mesh vertices as float32 in the mesh's own inertia frame, which is another one on each hand [m]."""


def both(folder, text, axis):
    """Return the compiled model of a text and that of its mirror image."""
    folder.mkdir(exist_ok=True)
    (folder / "arm_right.xml").write_text(text)
    outputs = mirror_mjcf.ModelMirror(folder / "arm_right.xml", reflection.Mirror(axis)).run()
    for path, content in outputs.items():
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    return [mujoco.MjModel.from_xml_path(str(folder / f"arm_{side}.xml")) for side in ("right", "left")]


def posed(models, rng):
    """Return the data of both models at the same random joint values and velocities."""
    right, left = models
    low, high = np.where(right.jnt_limited[:, None] != 0, right.jnt_range, [-1, 1]).T
    found = [mujoco.MjData(model) for model in models]
    found[0].qpos[:] = found[1].qpos[:] = rng.uniform(low, high)
    found[0].qvel[:] = found[1].qvel[:] = rng.normal(size=right.nv)
    for model, data in zip(models, found, strict=True):
        mujoco.mj_forward(model, data)
    assert left.nq == right.nq == right.njnt
    return found


def check_frames(names, here, there, axis, local=None):
    """Check positions M p and rotations M R M of bodies, geoms, sites; the local reflection of cameras is diag(−1, 1, 1)."""
    flip = np.diag([-1.0 if i == axis else 1.0 for i in range(3)])
    local = flip if local is None else local
    for prefix in names:
        pos, mat = f"{prefix}pos", f"{prefix}mat"
        np.testing.assert_allclose(getattr(there, pos), getattr(here, pos) @ flip, atol=EXACT, err_msg=pos)
        wanted = flip @ getattr(here, mat).reshape(-1, 3, 3) @ local
        np.testing.assert_allclose(getattr(there, mat).reshape(-1, 3, 3), wanted, atol=EXACT, err_msg=mat)


def world_inertia(model, data):
    turn = data.ximat.reshape(-1, 3, 3)
    return turn * model.body_inertia[:, None, :] @ turn.transpose(0, 2, 1)


def check_dynamics(models, found, axis):
    """Check centres of mass and inertia tensors in the world, and the mass matrix in joint coordinates."""
    flip = np.diag([-1.0 if i == axis else 1.0 for i in range(3)])
    here, there = found
    np.testing.assert_allclose(models[1].body_mass, models[0].body_mass, atol=0)
    np.testing.assert_allclose(there.xipos, here.xipos @ flip, atol=EXACT)
    inertias = [world_inertia(model, data) for model, data in zip(models, found, strict=True)]
    np.testing.assert_allclose(inertias[1], flip @ inertias[0] @ flip, atol=EXACT)
    full = [np.zeros((model.nv, model.nv)) for model in models]
    for model, data, matrix in zip(models, found, full, strict=True):
        mujoco.mj_fullM(model, matrix, data.qM) if hasattr(data, "qM") else mujoco.mj_fullM(model, data, matrix)
    np.testing.assert_allclose(full[1], full[0], atol=EXACT)


def vertices(model, data, geom):
    mesh = model.geom_dataid[geom]
    first, num = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    return model.mesh_vert[first : first + num] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def check_meshes(models, found, axis):
    """Check that the vertices of mesh geoms in the world are mirror images, and faces counter-clockwise from outside."""
    signs = np.array([-1.0 if i == axis else 1.0 for i in range(3)])
    for geom in np.flatnonzero(models[0].geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        here, there = (vertices(model, data, geom) for model, data in zip(models, found, strict=True))
        assert len(here) == len(there)
        distance, nearest = KDTree(here * signs).query(there)
        assert distance.max() < FLOAT32
        assert len(set(nearest)) == len(here)
        for model in models:
            mesh = model.geom_dataid[geom]
            first, num = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            own = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
            assert trimesh.Trimesh(own, model.mesh_face[first : first + num], process=False).volume > 0


def check_taxels(here, there, axis, has_tangents=True):
    """Check that taxel i is the mirror image of taxel i."""
    signs = np.array([-1.0 if i == axis else 1.0 for i in range(3)])
    assert len(there.pos) == len(here.pos)
    for name in ("pos", "normal", "tangent") if has_tangents else ("pos", "normal"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name) * signs, rtol=0, atol=EXACT, err_msg=name)
    np.testing.assert_allclose(there.area, here.area, rtol=EXACT)
    np.testing.assert_array_equal(there.radius, here.radius)
    np.testing.assert_array_equal(there.cell, here.cell)
