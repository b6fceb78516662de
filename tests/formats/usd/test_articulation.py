"""Kinematic trees of USD stages: parents, loops, names and random robots."""

import math

import mujoco
import numpy as np
import pytest
from pxr import UsdGeom, UsdPhysics
from scipy.spatial.transform import Rotation
from stages import (
    ODD,
    TOLERANCE,
    add_body,
    add_joint,
    add_shape,
    chain,
    close,
    compiled,
    matrix,
    new_stage,
    parents,
    shift,
    turn,
    warned,
    world_pose,
)


@pytest.mark.parametrize("seed", range(8))
def test_random_robots_keep_their_poses(tmp_path, seed):
    """Random trees in centimetres with Y up: joints swapped or not, bodies scaled, nested or flat."""
    random = np.random.default_rng(seed)
    stage = new_stage(tmp_path, metres=0.01, up="Y")
    upright = np.diag([0.01, 0.01, 0.01, 1.0]) @ turn("X", math.pi / 2)

    def somewhere() -> tuple[list[float], list[float]]:
        return random.uniform(-50, 50, 3).round(3).tolist(), random.normal(size=4).tolist()

    def local(pos: list[float], quat: list[float], scale: list[float]) -> np.ndarray:
        return matrix(np.multiply(pos, scale), quat)

    paths, poses, scales, angles = ["/r/b0"], [matrix(*somewhere())], [[1.0, 1.0, 1.0]], {}
    for i in range(1, 7):
        parent = int(random.integers(i))
        path = f"{paths[parent]}/b{i}" if random.random() < 0.3 and scales[parent] == [1.0] * 3 else f"/r/b{i}"
        scale = random.uniform(0.5, 2, 3).tolist() if random.random() < 0.5 else [1.0] * 3
        kind, axis = ("hinge", "slide")[i % 2], "XYZ"[int(random.integers(3))]
        (pos0, rot0), (pos1, rot1), q = somewhere(), somewhere(), float(random.uniform(-3, 3))
        outer, inner = local(pos0, rot0, scales[parent]), local(pos1, rot1, scale)
        is_swapped = random.random() < 0.5
        sign = -1 if is_swapped else 1
        motion = turn(axis, sign * q) if kind == "hinge" else shift(axis, sign * 100 * q)
        paths, scales = [*paths, path], [*scales, scale]
        poses.append(poses[parent] @ outer @ motion @ np.linalg.inv(inner))
        sides = [(paths[parent], pos0, rot0), (path, pos1, rot1)][::sign]
        (body0, pos0, rot0), (body1, pos1, rot1) = sides
        add_joint(stage, f"/r/j{i}", kind, (body0, body1), pos0, rot0, pos1, rot1, axis=axis)
        angles[f"j{i}"] = q
    for i in random.permutation(len(paths)):
        above = [p for p in paths if paths[i].startswith(f"{p}/")]
        outer = poses[paths.index(max(above, key=len))] if above else np.eye(4)
        relative = np.linalg.inv(outer) @ poses[i]
        quat = Rotation.from_matrix(relative[:3, :3]).as_quat(scalar_first=True).tolist()
        add_body(stage, paths[i], relative[:3, 3].tolist(), quat, scales[i])
    UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath("/r/b0"))
    model = compiled(stage)
    for i, pose in enumerate(poses):
        expected = upright @ pose
        expected[:3, :3] *= 100
        close(world_pose(model, f"b{i}", key="authored"), expected, 1e-5)
    for name, q in angles.items():
        close(model.key("authored").qpos[model.joint(name).qposadr[0]], q, 1e-5)


@pytest.mark.parametrize("where", ["joint", "above", "body"])
def test_the_root_of_an_articulation(tmp_path, where):
    stage = new_stage(tmp_path)
    chain(stage, 3, axis="Z")
    if where == "body":  # floating: the marked body is the root, whatever the order in the joints
        UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath("/b1"))
        model = compiled(stage)
        assert parents(model) == {"b1": "world", "b0": "b1", "b2": "b1"}
        assert model.joint(0).type == mujoco.mjtJoint.mjJNT_FREE
        return
    joint = add_joint(stage, "/fixture/weld", "fixed", ("/b2", None), pos1=(2, 0, 0))  # with swapped sides
    marked = joint if where == "joint" else UsdGeom.Xform.Define(stage, "/fixture").GetPrim()
    UsdPhysics.ArticulationRootAPI.Apply(marked)
    model = compiled(stage)
    assert parents(model) == {"b2": "world", "b1": "b2", "b0": "b1"}
    assert model.njnt == 2
    for name, x in (("b0", 0), ("b1", 1), ("b2", 2)):
        close(world_pose(model, name, [0, 0])[:3, 3], [x, 0, 0])


def test_the_marked_joint_to_the_world_is_the_root(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 3)
    add_joint(stage, "/first", "ball", (None, "/b2"), pos0=(2, 0, 0))
    UsdPhysics.ArticulationRootAPI.Apply(add_joint(stage, "/second", "fixed", (None, "/b0")))
    model = compiled(stage)
    assert parents(model) == {"b0": "world", "b1": "b0", "b2": "b1"}
    assert (model.neq, model.eq_type[0]) == (1, mujoco.mjtEq.mjEQ_CONNECT)


def test_bodies_without_joints_float_and_fixed_ones_do_not(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/loose", (1, 2, 3), ODD)
    add_body(stage, "/held", (4, 5, 6))
    add_joint(stage, "/weld", "fixed", (None, "/held"), (4, 5, 6))
    model = compiled(stage)
    assert [model.joint(i).type for i in range(model.njnt)] == [mujoco.mjtJoint.mjJNT_FREE]
    close(world_pose(model, "loose"), matrix((1, 2, 3), ODD))
    close(world_pose(model, "held"), matrix((4, 5, 6)))
    assert model.body("held").dofnum == 0


def test_disabled_bodies_and_joints(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 3)
    stage.GetPrimAtPath("/b1").GetAttribute("physics:rigidBodyEnabled").Set(False)
    stage.GetPrimAtPath("/j2").GetAttribute("physics:jointEnabled").Set(False)
    compiled(stage)  # no warning: there is nothing to collide with yet
    add_shape(stage, "/b1/box")
    model, messages = warned(stage)
    assert messages == ["joints do not keep their bodies from colliding with the static prims that they are attached to: /j1"]
    assert parents(model) == {"b0": "world", "b2": "world"}
    assert model.jnt_type.tolist() == [mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE]
    assert model.geom("box").bodyid == 0  # a static collider in the body's pose
    close(model.geom("box").pos, [1, 0, 0])


def test_kinematic_bodies_become_mocap_bodies(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 2)
    UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath("/b0")).CreateKinematicEnabledAttr(True)
    add_shape(stage, "/b0/floor", UsdGeom.Plane)
    model = compiled(stage)
    assert model.body("b0").mocapid == 0
    assert parents(model) == {"b0": "world", "b1": "b0"}
    assert model.jnt_type.tolist() == [mujoco.mjtJoint.mjJNT_HINGE]


@pytest.mark.parametrize("kind", ["ball", "fixed", "hinge"])
def test_loops_are_closed_by_constraints(tmp_path, kind):
    """The constraint's residual vanishes only if the frames of the closing joint meet."""
    stage = new_stage(tmp_path)
    UsdPhysics.ArticulationRootAPI.Apply(add_joint(stage, "/root", "fixed", (None, "/b0")))
    chain(stage, 4, axis="Z")
    values = {"axis": "Z"} if kind == "hinge" else {}
    add_joint(stage, "/close", kind, ("/b3", "/b0"), (1, 0, 0), excludeFromArticulation=True, **values)
    model = compiled(stage)
    assert model.njnt == 3
    tag = mujoco.mjtEq.mjEQ_WELD if kind == "fixed" else mujoco.mjtEq.mjEQ_CONNECT
    assert model.eq_type.tolist() == [tag] * (2 if kind == "hinge" else 1)
    data = mujoco.MjData(model)
    square = np.full(3, math.pi / 2)  # four sides of 1 m form a closed square
    for qpos, is_closed in ((square, kind != "fixed"), (np.zeros(3), False)):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        residual = data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
        assert len(residual) == {"ball": 3, "fixed": 6, "hinge": 6}[kind]
        positions = residual[:3] if kind == "fixed" else residual
        if is_closed or (kind == "fixed" and qpos is square):
            assert np.abs(positions).max() < TOLERANCE
        else:
            assert np.abs(positions).max() > 0.1


def test_an_excluded_joint_that_is_a_bodys_only_one_joins_the_tree(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 2, excludeFromArticulation=True)
    add_joint(stage, "/root", "fixed", (None, "/b0"), excludeFromArticulation=True)
    model = compiled(stage)
    assert parents(model) == {"b0": "world", "b1": "b0"}
    assert (model.njnt, model.neq) == (1, 0)


def test_properties_lost_by_loops_and_kinematic_bodies_are_named(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 3)
    UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath("/b0")).CreateKinematicEnabledAttr(True)
    add_joint(stage, "/held", "fixed", (None, "/b0"))
    excluded = {"excludeFromArticulation": True}
    add_joint(stage, "/loop", "hinge", ("/b0", "/b2"), (2, 0, 0), lowerLimit=-1.0, upperLimit=1.0, **excluded)
    model, messages = warned(stage)
    assert messages == [
        "joints between bodies that no force can move were dropped: /held",
        "limits, drives, armature and friction of joints that close a loop were dropped: /loop",
    ]
    assert (model.njnt, model.neq) == (2, 2)


def test_a_loop_is_cut_at_the_joint_with_least_to_lose(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 4)
    add_joint(stage, "/first", "slide", ("/b0", "/b3"), (3, 0, 0), lowerLimit=-1.0, upperLimit=1.0)
    UsdPhysics.DriveAPI.Apply(stage.GetPrimAtPath("/j1"), "angular").CreateStiffnessAttr(1.0)
    for i, limit in ((1, 10.0), (3, 10.0)):
        stage.GetPrimAtPath(f"/j{i}").GetAttribute("physics:upperLimit").Set(limit)
    model = compiled(stage)
    assert {model.joint(i).name for i in range(1, model.njnt)} == {"first", "j1", "j3"}
    assert model.neq == 2


def test_angles_of_branches_reach_the_keyframe(tmp_path):
    stage = new_stage(tmp_path)
    add_joint(stage, "/root", "fixed", (None, "/palm"))
    add_body(stage, "/palm")
    angles = {}
    for finger, y in (("a", 0.0), ("b", 1.0), ("c", 2.0)):
        parent, pose = "/palm", np.eye(4)
        for i in range(2):
            angle = 0.1 + y + 0.3 * i
            pose = pose @ matrix((0, y if i == 0 else 0, 1)) @ turn("X", angle)
            quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True).tolist()
            add_body(stage, f"/{finger}{i}", pose[:3, 3].tolist(), quat)
            add_joint(stage, f"/j_{finger}{i}", "hinge", (parent, f"/{finger}{i}"), (0, y if i == 0 else 0, 1))
            parent, angles[f"j_{finger}{i}"] = f"/{finger}{i}", angle
    model = compiled(stage)
    key = model.key("authored").qpos
    for name, angle in angles.items():
        close(key[model.joint(name).qposadr[0]], angle)


def test_names_shared_by_whole_paths_are_numbered_from_2(tmp_path):
    stage = new_stage(tmp_path)
    for path in ("/a/b_c", "/x/b_c", "/a_b/c", "/y/c"):
        add_body(stage, path)
    model = compiled(stage)
    assert {model.body(i).name for i in range(1, model.nbody)} == {"a_b_c", "x_b_c", "a_b_c_2", "y_c"}
