"""Joints of USD stages: poses against products of USD's joint frames."""

import math

import mujoco
import numpy as np
import pytest
from pxr import Gf, Sdf, UsdGeom, UsdPhysics
from stages import (
    FRAME0,
    FRAME1,
    GENERIC,
    ODD,
    ONE_TURN,
    OTHER,
    add_body,
    add_joint,
    add_shape,
    arm,
    close,
    compiled,
    generic,
    matrix,
    move,
    new_stage,
    placed,
    shift,
    turn,
    warned,
    world_pose,
)


@pytest.mark.parametrize("is_swapped", [False, True], ids=["straight", "swapped"])
@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_links_move_by_their_joint_frames(tmp_path, kind, axis, is_swapped):
    stage = new_stage(tmp_path)
    arm(stage, kind, axis, is_swapped)
    model = compiled(stage)
    base = matrix((0.1, 0.2, 0.3), OTHER)
    for q in (0.0, 0.7, -2.1):
        motion = turn(axis, q) if kind == "hinge" else shift(axis, q)
        one_in_zero = FRAME0 @ motion @ np.linalg.inv(FRAME1)  # body 1 in body 0, as UsdPhysics defines it
        expected = base @ (np.linalg.inv(one_in_zero) if is_swapped else one_in_zero)
        close(world_pose(model, "link", [q]), expected)
        close(world_pose(model, "base", [q]), base)
    assert model.nkey == 0
    assert [model.joint(i).name for i in range(model.njnt)] == ["j"]


@pytest.mark.parametrize("is_swapped", [False, True], ids=["straight", "swapped"])
def test_ball_joints(tmp_path, is_swapped):
    stage = new_stage(tmp_path)
    arm(stage, "ball", "", is_swapped)
    model = compiled(stage)
    assert model.jnt_type.tolist() == [mujoco.mjtJoint.mjJNT_BALL]
    inner = FRAME0 if is_swapped else FRAME1
    outer = matrix((0.1, 0.2, 0.3), OTHER) @ (FRAME1 if is_swapped else FRAME0)
    for quat in (ODD, OTHER):
        link = world_pose(model, "link", np.array(quat) / np.linalg.norm(quat))
        close((link @ inner)[:3, 3], outer[:3, 3])
        zero = outer @ np.linalg.inv(inner)
        close(link[:3, :3], zero[:3, :3] @ matrix((0, 0, 0), quat)[:3, :3])


@pytest.mark.parametrize("is_swapped", [False, True], ids=["straight", "swapped"])
@pytest.mark.parametrize(("kind", "axis"), [("hinge", "Y"), ("slide", "Z"), ("ball", "")])
def test_authored_poses_become_a_keyframe(tmp_path, kind, axis, is_swapped):
    stage = new_stage(tmp_path)
    arm(stage, kind, axis, is_swapped)
    motion = {"hinge": turn("Y", -0.6), "slide": shift("Z", 0.4), "ball": matrix((0, 0, 0), (0.9, 0.2, 0.1, -0.3))}[kind]
    one_in_zero = FRAME0 @ motion @ np.linalg.inv(FRAME1)
    pose = matrix((0.1, 0.2, 0.3), OTHER) @ (np.linalg.inv(one_in_zero) if is_swapped else one_in_zero)
    move(stage.GetPrimAtPath("/robot/link"), pose)
    add_body(stage, "/robot/loose", (3, 2, 1), ODD)  # a free joint is in the keyframe too
    model = compiled(stage)
    close(world_pose(model, "link", key="authored"), pose)
    close(world_pose(model, "loose", key="authored"), matrix((3, 2, 1), ODD))
    if kind != "ball":
        close(model.key("authored").qpos[0], {"hinge": -0.6, "slide": 0.4}[kind])


def test_authored_angles_beyond_half_a_turn_are_within_the_limits(tmp_path):
    stage = new_stage(tmp_path)
    arm(stage, "hinge", "X", lowerLimit=0.0, upperLimit=300.0)
    pose = matrix((0.1, 0.2, 0.3), OTHER) @ FRAME0 @ turn("X", math.radians(200)) @ np.linalg.inv(FRAME1)
    move(stage.GetPrimAtPath("/robot/link"), pose)
    close(compiled(stage).key("authored").qpos, [math.radians(200)])


def test_a_joint_whose_frames_do_not_meet_is_named(tmp_path):
    stage = new_stage(tmp_path)
    arm(stage, "hinge", "X")
    stage.GetPrimAtPath("/robot/link").GetAttribute("xformOp:translate").Set(Gf.Vec3d(5, 5, 5))
    _, messages = warned(stage)
    assert messages == ["in the authored poses the frames of joints do not meet; MuJoCo will join them: /robot/j"]


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("hinge", {"lowerLimit": -90.0, "upperLimit": 45.0}, [-math.pi / 2, math.pi / 4]),
        ("slide", {"lowerLimit": -0.5, "upperLimit": 0.25}, [-0.5, 0.25]),
        ("hinge", {"lowerLimit": -90.0}, [-math.pi / 2, 1e10]),
        ("slide", {"upperLimit": 0.25}, [-1e10, 0.25]),
        ("hinge", {}, None),
        ("hinge", {"lowerLimit": -3.4028234663852886e38, "upperLimit": 3.4028234663852886e38}, None),
    ],
)
def test_limits(tmp_path, kind, values, expected):
    stage = new_stage(tmp_path)
    arm(stage, kind, "Z", **values)
    model = compiled(stage)
    assert bool(model.jnt_limited[0]) is (expected is not None)
    if expected:
        close(model.jnt_range[0], expected)


def test_equal_limits_become_a_weld(tmp_path):
    stage = new_stage(tmp_path)
    arm(stage, "hinge", "X", lowerLimit=30.0, upperLimit=30.0)
    with pytest.warns(UserWarning, match="do not meet"):  # the link is authored at zero
        model = compiled(stage)
    assert model.njnt == 0
    close(
        world_pose(model, "link"),
        matrix((0.1, 0.2, 0.3), OTHER) @ FRAME0 @ turn("X", math.radians(30)) @ np.linalg.inv(FRAME1),
    )


def test_scaled_bodies(tmp_path):
    """Joint positions and shapes are in the scaled space of their prims; the body's frame has no scale."""
    stage = new_stage(tmp_path)
    placed(UsdGeom.Xform.Define(stage, "/robot").GetPrim(), (1, 0, 0), (1, 1, 0, 0), (2, 2, 2))
    add_body(stage, "/robot/base", (0.5, 0, 0), scale=(1, 3, 0.5))
    add_body(stage, "/robot/base/link", (0, 1, 0))
    add_shape(stage, "/robot/base/box", pos=(0.1, 0.1, 0.1))
    add_joint(stage, "/robot/j", "hinge", ("/robot/base", "/robot/base/link"), (0, 1, 2), ONE_TURN, (1, 0, 2), ONE_TURN)
    add_joint(stage, "/robot/root", "fixed", (None, "/robot/base"), (2, 0, 0), (1, 1, 0, 0))
    with pytest.warns(UserWarning, match="do not meet"):
        model = compiled(stage)
    rot = matrix((0, 0, 0), (1, 1, 0, 0))
    base = matrix((2, 0, 0)) @ rot
    close(world_pose(model, "base"), base)
    scale = np.array([2, 6, 1])
    expected = base @ matrix(scale * [0, 1, 2]) @ turn("X", 0.3) @ np.linalg.inv(matrix(scale * [1, 0, 2]))
    close(world_pose(model, "link", [0.3]), expected)
    box = model.geom("box")
    close(box.size, scale)
    close(box.pos, 0.1 * scale)


def test_gains_are_per_degree_in_units_of_the_stage(tmp_path):
    for metres, kilograms in ((1.0, 1.0), (0.01, 0.001)):
        stage = new_stage(tmp_path, f"robot{metres}.usda", metres)
        UsdPhysics.SetStageKilogramsPerUnit(stage, kilograms)
        for name in ("base", "a", "b", "c"):
            add_body(stage, f"/{name}")
        add_joint(stage, "/turn", "hinge", ("/base", "/a"))
        add_joint(stage, "/push", "slide", ("/base", "/b"))
        add_joint(stage, "/spin", "hinge", ("/base", "/c"))
        for name, instance in (("turn", "angular"), ("push", "linear"), ("spin", "angular")):
            drive = UsdPhysics.DriveAPI.Apply(stage.GetPrimAtPath(f"/{name}"), instance)
            drive.CreateStiffnessAttr(0 if name == "spin" else 3.0)
            drive.CreateDampingAttr(0.5)
            drive.CreateTargetPositionAttr(90.0)
            drive.CreateTargetVelocityAttr(0 if name == "turn" else 180.0)
            if name != "push":
                drive.CreateMaxForceAttr(7.0)
        for attribute, value in (("armature", 0.25), ("jointFriction", 0.125)):
            stage.GetPrimAtPath("/turn").CreateAttribute(f"physxJoint:{attribute}", Sdf.ValueTypeNames.Float).Set(value)
        model = compiled(stage)
        angular, degree = kilograms * metres**2, 180 / math.pi
        position, general, velocity = (model.actuator(name) for name in ("turn", "push", "spin"))
        close(position.gainprm[0], 3 * angular * degree)
        close(position.biasprm[:3], [0, -3 * angular * degree, -0.5 * angular * degree])
        close(position.forcerange, [-7 * angular, 7 * angular])
        close(general.gainprm[0], 3 * kilograms)
        close(general.biasprm[:3], [0.5 * kilograms * 180 * metres, -3 * kilograms, -0.5 * kilograms])
        assert not general.forcelimited[0]
        close(velocity.gainprm[0], 0.5 * angular * degree)
        close(velocity.biasprm[:3], [0, 0, -0.5 * angular * degree])
        close(model.key("authored").ctrl, [math.pi / 2, 90 * metres, math.pi])
        close(model.dof_armature[model.joint("turn").dofadr[0]], 0.25 * angular)
        close(model.dof_frictionloss[model.joint("turn").dofadr[0]], 0.125 * angular)


def test_generic_joints_with_a_mujoco_type_are_read(tmp_path):
    locked = dict.fromkeys(GENERIC, (1.0, -1.0))
    cases = {
        "hinge": (locked | {"rotZ": (-30.0, 60.0)}, mujoco.mjtJoint.mjJNT_HINGE, "Z"),
        "slide": (locked | {"transY": (-0.1, 0.2)}, mujoco.mjtJoint.mjJNT_SLIDE, "Y"),
        "ball": (dict.fromkeys(GENERIC[:3], (1.0, -1.0)), mujoco.mjtJoint.mjJNT_BALL, ""),
        "fixed": (locked, None, ""),
        "zero": (dict.fromkeys(GENERIC, (0.0, 0.0)), None, ""),
        "free": ({}, mujoco.mjtJoint.mjJNT_FREE, ""),
    }
    for name, (limits, kind, axis) in cases.items():
        stage = new_stage(tmp_path, f"{name}.usda")
        generic(stage, limits)
        model = compiled(stage)
        assert model.jnt_type.tolist() == ([] if kind is None else [kind]), name
        if name == "hinge":
            close(model.jnt_range[0], np.radians([-30, 60]))
            close(
                world_pose(model, "link", [0.4]),
                matrix((0.1, 0.2, 0.3), OTHER) @ FRAME0 @ turn(axis, 0.4) @ np.linalg.inv(FRAME1),
            )
        if name == "slide":
            close(
                world_pose(model, "link", [0.1]),
                matrix((0.1, 0.2, 0.3), OTHER) @ FRAME0 @ shift(axis, 0.1) @ np.linalg.inv(FRAME1),
            )
