"""USD files: poses against products of USD's own joint frames, masses against closed forms, every error by its prim."""

import builtins
import math
import xml.etree.ElementTree as ET
from itertools import product
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

pytest.importorskip("pxr")

from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdUtils
from scipy.spatial.transform import Rotation
from stages import (
    add_body,
    add_joint,
    add_material,
    add_mesh,
    add_shape,
    call,
    compiled,
    inertia,
    matrix,
    move,
    new_stage,
    path_of,
    placed,
    shift,
    turn,
    world_pose,
)

from tgdsl.compiler.robot import load_model
from tgdsl.compiler.usd import usd_to_mjcf, write_mjcf
from tgdsl.errors import RobotError

TOLERANCE = 1e-6
"""USD keeps joint frames and sizes in float32, MuJoCo mesh vertices too; all here is about 1 m or 1 kg."""
ODD = (0.8, 0.3, -0.4, 0.2)
OTHER = (0.5, -0.6, 0.1, 0.7)
ONE_TURN = (1.0, 0.0, 0.0, 0.0)
WEDGE = [(0, 0, 0), (3, 0, 0), (0, 2, 0), (0, 0, 1)]
WEDGE_FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
QUAD = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
FRAMES = ((0.4, -0.3, 0.2), ODD, (-0.1, 0.25, 0.35), OTHER)
"""Where the joint of `arm` is in body 0 and in body 1: position and quaternion."""
FRAME0, FRAME1 = matrix(*FRAMES[:2]), matrix(*FRAMES[2:])


def close(found, expected, tolerance: float = TOLERANCE) -> None:
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


def error_of(stage: Usd.Stage) -> str:
    path = path_of(stage)
    with pytest.raises(RobotError) as caught:
        usd_to_mjcf(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def warned(stage: Usd.Stage) -> tuple[mujoco.MjModel, list[str]]:
    """Return the model, and its warnings without the file's name."""
    with pytest.warns(UserWarning, match=r"\.usda: ") as caught:
        model = compiled(stage)
    return model, [str(w.message).removeprefix(f"{path_of(stage)}: ") for w in caught]


def arm(stage: Usd.Stage, kind: str, axis: str, is_swapped: bool = False, **values) -> None:
    """Add a base that is fixed to the world and a link on it; frame 0 is the base's, or the link's if swapped."""
    add_body(stage, "/robot/base", (0.1, 0.2, 0.3), OTHER)
    add_body(stage, "/robot/link")
    UsdPhysics.ArticulationRootAPI.Apply(
        add_joint(stage, "/robot/root", "fixed", (None, "/robot/base"), (0.1, 0.2, 0.3), OTHER)
    )
    bodies = ("/robot/link", "/robot/base") if is_swapped else ("/robot/base", "/robot/link")
    add_joint(stage, "/robot/j", kind, bodies, *FRAMES, **({"axis": axis} if axis else {}), **values)
    place_at_zero(stage, is_swapped)


def place_at_zero(stage: Usd.Stage, is_swapped: bool) -> None:
    """Move the link to where the joint is at zero, so that nothing is off."""
    base = matrix((0.1, 0.2, 0.3), OTHER)
    pose = base @ (FRAME1 @ np.linalg.inv(FRAME0) if is_swapped else FRAME0 @ np.linalg.inv(FRAME1))
    move(stage.GetPrimAtPath("/robot/link"), pose)


# Joints


@pytest.mark.parametrize("is_swapped", [False, True], ids=["straight", "swapped"])
@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_links_move_as_the_joint_frames_say(tmp_path, kind, axis, is_swapped):
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
def test_authored_poses_that_are_not_zero_are_a_keyframe(tmp_path, kind, axis, is_swapped):
    stage = new_stage(tmp_path)
    arm(stage, kind, axis, is_swapped)
    motion = {"hinge": turn("Y", -0.6), "slide": shift("Z", 0.4), "ball": matrix((0, 0, 0), (0.9, 0.2, 0.1, -0.3))}[kind]
    one_in_zero = FRAME0 @ motion @ np.linalg.inv(FRAME1)
    pose = matrix((0.1, 0.2, 0.3), OTHER) @ (np.linalg.inv(one_in_zero) if is_swapped else one_in_zero)
    move(stage.GetPrimAtPath("/robot/link"), pose)
    add_body(stage, "/robot/loose", (3, 2, 1), ODD)  # a free joint takes its place in the keyframe too
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


def test_a_joint_whose_frames_do_not_meet_is_told(tmp_path):
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


def test_limits_that_leave_no_room_are_a_weld_there(tmp_path):
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


def test_gains_are_per_degree_and_in_the_units_of_the_stage(tmp_path):
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


GENERIC = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")


def generic(stage: Usd.Stage, limits: dict[str, tuple[float, float]]) -> None:
    arm(stage, "generic", "")
    for dof, (low, high) in limits.items():
        limit = UsdPhysics.LimitAPI.Apply(stage.GetPrimAtPath("/robot/j"), dof)
        limit.CreateLowAttr(low)
        limit.CreateHighAttr(high)


def test_generic_joints_that_are_one_of_mujocos(tmp_path):
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


# The tree


@pytest.mark.parametrize("seed", range(8))
def test_robots_at_random(tmp_path, seed):
    """Any tree, sides of joints swapped or not, scaled bodies, nested or flat, in centimetres with Y up, anywhere."""
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
        own = np.linalg.inv(outer) @ poses[i]
        quat = Rotation.from_matrix(own[:3, :3]).as_quat(scalar_first=True).tolist()
        add_body(stage, paths[i], own[:3, 3].tolist(), quat, scales[i])
    UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath("/r/b0"))
    model = compiled(stage)
    for i, pose in enumerate(poses):
        expected = upright @ pose
        expected[:3, :3] *= 100
        close(world_pose(model, f"b{i}", key="authored"), expected, 1e-5)
    for name, q in angles.items():
        close(model.key("authored").qpos[model.joint(name).qposadr[0]], q, 1e-5)


def chain(stage: Usd.Stage, count: int, kind: str = "hinge", **values) -> None:
    """Add bodies a row along x, 1 m apart, each joined to the one before by its own origin."""
    for i in range(count):
        add_body(stage, f"/b{i}", (i, 0, 0))
        if i:
            add_joint(stage, f"/j{i}", kind, (f"/b{i - 1}", f"/b{i}"), (1, 0, 0), **values)


def parents(model: mujoco.MjModel) -> dict[str, str]:
    return {model.body(i).name: model.body(model.body_parentid[i]).name for i in range(1, model.nbody)}


@pytest.mark.parametrize("where", ["joint", "above", "body"])
def test_the_root_of_an_articulation(tmp_path, where):
    stage = new_stage(tmp_path)
    chain(stage, 3, axis="Z")
    if where == "body":  # floating: all hangs on what is marked, whatever the order of bodies in the joints
        UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath("/b1"))
        model = compiled(stage)
        assert parents(model) == {"b1": "world", "b0": "b1", "b2": "b1"}
        assert model.joint(0).type == mujoco.mjtJoint.mjJNT_FREE
        return
    joint = add_joint(stage, "/fixture/weld", "fixed", ("/b2", None), pos1=(2, 0, 0))  # the other way around, too
    marked = joint if where == "joint" else UsdGeom.Xform.Define(stage, "/fixture").GetPrim()
    UsdPhysics.ArticulationRootAPI.Apply(marked)
    model = compiled(stage)
    assert parents(model) == {"b2": "world", "b1": "b2", "b0": "b1"}
    assert model.njnt == 2
    for name, x in (("b0", 0), ("b1", 1), ("b2", 2)):
        close(world_pose(model, name, [0, 0])[:3, 3], [x, 0, 0])


def test_of_two_joints_to_the_world_the_marked_one_is_the_root(tmp_path):
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
    compiled(stage)  # nothing to tell: there is nothing to collide with yet
    add_shape(stage, "/b1/box")
    model, messages = warned(stage)
    assert messages == ["joints do not keep their bodies from colliding with the static prims that they hang on: /j1"]
    assert parents(model) == {"b0": "world", "b2": "world"}
    assert model.jnt_type.tolist() == [mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE]
    assert model.geom("box").bodyid == 0  # a static collider where the body is
    close(model.geom("box").pos, [1, 0, 0])


def test_kinematic_bodies_are_moved_by_hand(tmp_path):
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
    """The constraint's residual vanishes where the frames of the closing joint meet, and not where they do not."""
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
    square = np.full(3, math.pi / 2)  # four sides of 1 m: the last one ends where the first begins
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


def test_an_excluded_joint_that_alone_holds_a_body_is_in_the_tree(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 2, excludeFromArticulation=True)
    add_joint(stage, "/root", "fixed", (None, "/b0"), excludeFromArticulation=True)
    model = compiled(stage)
    assert parents(model) == {"b0": "world", "b1": "b0"}
    assert (model.njnt, model.neq) == (1, 0)


def test_what_a_loop_or_a_kinematic_body_makes_of_joints(tmp_path):
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


def test_of_a_loop_the_joint_is_left_out_with_which_least_is_lost(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 4)
    add_joint(stage, "/first", "slide", ("/b0", "/b3"), (3, 0, 0), lowerLimit=-1.0, upperLimit=1.0)
    UsdPhysics.DriveAPI.Apply(stage.GetPrimAtPath("/j1"), "angular").CreateStiffnessAttr(1.0)
    for i, limit in ((1, 10.0), (3, 10.0)):
        stage.GetPrimAtPath(f"/j{i}").GetAttribute("physics:upperLimit").Set(limit)
    model = compiled(stage)
    assert {model.joint(i).name for i in range(1, model.njnt)} == {"first", "j1", "j3"}
    assert model.neq == 2


def test_branches_keep_the_order_of_the_keyframe(tmp_path):
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


# Geometry


def test_centimetres_and_y_up_are_metres_and_z_up(tmp_path):
    """The same robot in both, the one turned by the up-axis and 100 times as large in its own units."""
    models = []
    upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # Z-up from Y-up
    for metres, up in ((1.0, "Z"), (0.01, "Y")):
        stage = new_stage(tmp_path, f"robot{up}.usda", metres, up)
        unit, is_y = 1 / metres, up == "Y"
        top = Rotation.from_matrix(upright.T if is_y else np.eye(3)).as_quat(scalar_first=True)
        placed(UsdGeom.Xform.Define(stage, "/top").GetPrim(), quat=top)
        scene = UsdPhysics.Scene.Define(stage, "/scene")
        scene.CreateGravityMagnitudeAttr(9.5 * unit)
        add_body(stage, "/top/base", unit * np.array([0.1, 0.2, 0.3]), ODD, mass=0)
        add_body(stage, "/top/link", mass=0)
        link = matrix((0.1, 0.2, 0.3), ODD) @ matrix((0.1, 0, 0.2), OTHER)
        link[:3, 3] *= unit
        move(stage.GetPrimAtPath("/top/link"), link)
        add_shape(stage, "/top/base/box", pos=(0, 0, 0.1 * unit), quat=OTHER, scale=(0.1 * unit, 0.2 * unit, 0.3 * unit))
        add_shape(stage, "/top/link/pill", UsdGeom.Capsule, radius=0.05 * unit, height=0.2 * unit, axis="X")
        add_mesh(stage, "/top/link/wedge", np.array(WEDGE) * 0.1 * unit, WEDGE_FACES, pos=(0.1 * unit, 0, 0))
        UsdPhysics.MassAPI.Apply(stage.GetPrimAtPath("/top/link/wedge")).CreateDensityAttr(500 * metres**3)
        add_joint(
            stage, "/top/j", "slide", ("/top/base", "/top/link"), (0.1 * unit, 0, 0.2 * unit), OTHER,
            lowerLimit=-0.1 * unit, upperLimit=0.2 * unit,
        )  # fmt: skip
        models.append(compiled(stage))
    one, two = models
    for name in ("body_mass", "body_inertia", "body_ipos", "geom_size", "jnt_range", "geom_pos"):
        close(getattr(two, name), getattr(one, name))
    close(two.opt.gravity, one.opt.gravity)
    for body in ("base", "link"):
        close(world_pose(two, body), world_pose(one, body))
    close(one.opt.gravity, [0, 0, -9.5])


SHAPES = [
    (UsdGeom.Cube, {"size": 0.4}, (1, 2, 3), "box", (0.2, 0.4, 0.6), 0.4**3 * 6),
    (UsdGeom.Cube, {"size": 0.4}, (-1, 2, 3), "box", (0.2, 0.4, 0.6), 0.4**3 * 6),
    (UsdGeom.Sphere, {"radius": 0.3}, (2, 2, 2), "sphere", (0.6,), 4 / 3 * np.pi * 0.6**3),
    (UsdGeom.Sphere, {"radius": 0.3}, (1, 2, 3), "ellipsoid", (0.3, 0.6, 0.9), 4 / 3 * np.pi * 0.3**3 * 6),
    (UsdGeom.Capsule, {"radius": 0.2, "height": 0.6}, (2, 2, 2), "capsule", (0.4, 0.6), np.pi * 0.16 * 1.2 + 4 / 3 * np.pi * 0.4**3),
    (UsdGeom.Cylinder, {"radius": 0.2, "height": 0.6}, (3, 3, 2), "cylinder", (0.6, 0.6), np.pi * 0.36 * 1.2),
    (UsdGeom.Cylinder, {"radius": 0.2, "height": 0.6}, (1, 2, 1), "mesh", None, np.pi * 0.04 * 2 * 0.6),
    (UsdGeom.Capsule, {"radius": 0.2, "height": 0.6}, (1, 2, 1), "mesh", None, 2 * (np.pi * 0.04 * 0.6 + 4 / 3 * np.pi * 0.008)),
    (UsdGeom.Cone, {"radius": 0.2, "height": 0.6}, (1, 2, 1), "mesh", None, 2 * np.pi * 0.04 * 0.6 / 3),
    (UsdGeom.Capsule_1, {"radiusTop": 0.2, "radiusBottom": 0.2, "height": 0.0}, (1, 1, 1), "sphere", (0.2,), 4 / 3 * np.pi * 0.008),
    (UsdGeom.Capsule_1, {"radiusTop": 0.2, "radiusBottom": 0.01, "height": 0.1}, (1, 1, 1), "ball", None, 4 / 3 * np.pi * 0.008),
    (UsdGeom.Cylinder_1, {"radiusTop": 0.2, "radiusBottom": 0.2, "height": 0.6}, (1, 1, 1), "cylinder", (0.2, 0.3), np.pi * 0.04 * 0.6),
    (UsdGeom.Cylinder_1, {"radiusTop": 0.1, "radiusBottom": 0.2, "height": 0.6}, (1, 1, 1), "mesh", None, np.pi * 0.2 * (0.01 + 0.02 + 0.04)),
]  # fmt: skip


@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize(("kind", "values", "scale", "shape", "size", "volume"), SHAPES)
def test_shapes(tmp_path, kind, values, scale, shape, size, volume, axis):
    """Type, size, place, volume and inertia of every shape, turned and scaled; MuJoCo computes the inertia of its own."""
    stage = new_stage(tmp_path)
    add_body(stage, "/b", mass=0)
    scale = np.array(scale, dtype=float)
    if "height" in values:
        values = {**values, "axis": axis}
        scale = np.roll(scale, "XYZ".index(axis) + 1)  # the last one is along the axis
    elif axis != "Z":
        return
    add_shape(stage, "/b/shape", kind, (0.1, 0.2, 0.3), ODD, scale.tolist(), **values)
    text = usd_to_mjcf(path_of(stage))
    model = mujoco.MjModel.from_xml_string(text)
    own = inertia(model, "b")
    close(model.body("b").mass, 1000 * volume, 5e-3 if shape in ("mesh", "ball") else TOLERANCE)
    geom = load_model(path_of(stage)).geoms[0]
    assert geom.shape == ("mesh" if shape == "ball" else shape)
    root = ET.fromstring(text)
    root.find("worldbody/body").remove(root.find("worldbody/body/inertial"))
    for mesh in root.iter("mesh"):
        mesh.set("inertia", "exact")
    bare = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    np.testing.assert_allclose(own, inertia(bare, "b"), rtol=1e-5, atol=1e-5 * np.abs(own).max())
    close(model.body("b").ipos, bare.body("b").ipos, 1e-5)
    if size:
        close(geom.size[: len(size)], size)
    if size or shape == "ball":
        return
    surface = load_model(path_of(stage)).surface((geom,))
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.volume, volume, rtol=5e-3)  # and outwards
    local = (mesh.vertices - [0.1, 0.2, 0.3]) @ matrix((0, 0, 0), ODD)[:3, :3] / scale
    height = values["height"] + (2 * values["radius"] if kind is UsdGeom.Capsule else 0)
    along = "XYZ".index(axis)
    close([local[:, along].min(), local[:, along].max()], [-height / 2, height / 2])
    around = np.linalg.norm(np.delete(local, along, axis=1), axis=1)
    close(around.max(), 0.2, 1e-3)
    if kind is UsdGeom.Cone:  # the tip is up the axis
        assert around[local[:, along] > 0].max() < 1e-6


def test_shear(tmp_path):
    """A turned shape under a scaled parent: a sphere stays an ellipsoid, a cube becomes a mesh, a body is refused."""
    stage = new_stage(tmp_path)
    add_body(stage, "/b", mass=0)
    placed(UsdGeom.Xform.Define(stage, "/b/stretched").GetPrim(), scale=(1, 2, 3))
    add_shape(stage, "/b/stretched/ball", UsdGeom.Sphere, quat=ODD, scale=(1, 1, 2))
    add_shape(stage, "/b/stretched/cube", quat=ODD, scale=(1, 1, 2))
    model = compiled(stage)
    close(model.body("b").mass, 1000 * 12 * (4 / 3 * np.pi + 8))
    linear = np.diag([1, 2, 3]) @ matrix((0, 0, 0), ODD)[:3, :3] @ np.diag([1, 1, 2])
    ball = model.geom("ball")
    turned = Rotation.from_quat(ball.quat, scalar_first=True).as_matrix()
    close(turned @ np.diag(ball.size**2) @ turned.T, linear @ linear.T)  # the same quadric
    corners = (
        load_model(path_of(stage)).surface(tuple(g for g in load_model(path_of(stage)).geoms if g.name == "cube")).vertices
    )
    expected = np.array(list(product((-1, 1), repeat=3))) @ linear.T
    assert np.linalg.norm(corners[:, None] - expected, axis=2).min(axis=0).max() < 1e-5
    add_body(stage, "/b/stretched/turned", quat=ODD)
    assert error_of(stage) == "/b/stretched/turned: its transform is sheared or flat, so that it has no rigid frame"


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 0.5, 3), (-1, 2, 1)])
@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_meshes_come_out_at_their_place_and_the_right_way_round(tmp_path, scale, orientation):
    stage = new_stage(tmp_path, metres=0.01)
    add_body(stage, "/b", mass=0)
    faces = [face[::-1] for face in WEDGE_FACES] if orientation == "leftHanded" else WEDGE_FACES
    prim = add_mesh(stage, "/b/wedge", WEDGE, faces, pos=(5, 6, 7), quat=ODD, scale=scale)
    UsdGeom.Mesh(prim).CreateOrientationAttr(orientation)
    model = load_model(path_of(stage))
    surface = model.surface(model.touchable("b"))
    volume = 1e-6 * abs(np.prod(scale))
    np.testing.assert_allclose(trimesh.Trimesh(surface.vertices, surface.faces).volume, volume, rtol=1e-5)
    expected = 0.01 * ((np.array(WEDGE) * scale) @ matrix((0, 0, 0), ODD)[:3, :3].T + [5, 6, 7])
    assert np.linalg.norm(surface.vertices[:, None] - expected, axis=2).min(axis=0).max() < TOLERANCE
    np.testing.assert_allclose(model.compiled.body("b").mass, 1000 * volume, rtol=1e-6)


def test_polygons_convex_or_not_are_cut_into_triangles(tmp_path):
    """A prism over an L: its volume and area only come out if no triangle lies outside the polygon."""
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    ell = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    points = [(x, y, z) for z in (0, 1) for x, y in ell]
    sides = [(i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6)]
    add_mesh(stage, "/b/ell", points, [tuple(range(5, -1, -1)), tuple(range(6, 12)), *sides], collides=False, quat=ODD)
    model = load_model(path_of(stage))
    surface = model.surface(model.touchable("b"))
    mesh = trimesh.Trimesh(surface.vertices, surface.faces)
    assert mesh.is_volume
    np.testing.assert_allclose([mesh.volume, mesh.area], [3, 2 * 3 + 8], rtol=1e-6)
    geom = model.compiled.geom("ell")
    assert (geom.contype, geom.conaffinity, geom.group) == (0, 0, 2)
    close(model.compiled.body("b").mass, 1.0)


@pytest.mark.parametrize("first", range(16))
def test_polygons_with_many_reflex_corners(tmp_path, first):
    """A comb with four teeth, its corners counted from anywhere, seen from either side."""
    teeth = [corner for x in (6, 4, 2, 0) for corner in ((x + 1, 3), (x, 3), (x, 1), (x - 1, 1))][:-2]
    comb = [(0, 0), (7, 0), *teeth]
    ring = np.roll(np.array([(x, y, 0.5 * x) for x, y in comb], dtype=float), first, axis=0)
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    add_mesh(stage, "/b/comb", [*ring, (0, 0, 9)], [tuple(range(len(ring)))[:: 1 if first % 2 else -1]], collides=False)
    model = load_model(path_of(stage))
    surface = model.surface(model.touchable("b"))
    following = np.roll(ring, -1, axis=0)
    area = np.cross(ring, following).sum(axis=0) / 2
    assert len(surface.faces) == len(ring) - 2
    np.testing.assert_allclose(trimesh.Trimesh(surface.vertices, surface.faces).area, np.linalg.norm(area), rtol=1e-5)


def test_approximations(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    ell = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    points = [(x, y, z) for z in (0, 1) for x, y in ell]
    faces = [(5, 4, 3, 2, 1, 0), (6, 7, 8, 9, 10, 11), *((i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6))]
    kinds = ("none", "convexHull", "boundingCube", "boundingSphere", "convexDecomposition", "meshSimplification", "sdf")
    for i, kind in enumerate(kinds):
        add_mesh(stage, f"/b/{kind}", points, faces, kind, pos=(0, 0, 10 * i), scale=(1, 1, 2))
    add_mesh(stage, "/b/wedge", WEDGE, WEDGE_FACES, "none")  # convex: nothing is lost
    model, messages = warned(stage)
    hulls = ("none", "convexDecomposition", "meshSimplification", "sdf")
    assert messages == [f'meshes with approximation "{kind}" collide as their convex hulls: /b/{kind}' for kind in hulls]
    box, ball = model.geom("boundingCube"), model.geom("boundingSphere")
    assert (box.type, ball.type) == (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE)
    close(box.size, [1, 1, 1])
    close(box.pos, [1, 1, 21])
    close(ball.pos, [1, 1, 31])
    close(ball.size[0], math.sqrt(3))
    assert (box.group, model.geom("boundingCube_visual").group) == (3, 2)
    assert model.geom("boundingCube_visual").contype == 0
    assert model.nmesh == 2  # equal meshes are kept once


def test_instances_give_all_their_geoms(tmp_path):
    part = new_stage(tmp_path, "part.usda")
    part.SetDefaultPrim(UsdGeom.Xform.Define(part, "/part").GetPrim())
    add_shape(part, "/part/box", pos=(0, 0, 1))
    add_mesh(part, "/part/look", WEDGE, WEDGE_FACES, collides=False)
    path_of(part)
    stage = new_stage(tmp_path)
    for name in ("left", "right"):
        add_body(stage, f"/{name}", mass=0)
        held = UsdGeom.Xform.Define(stage, f"/{name}/shapes").GetPrim()
        held.GetReferences().AddReference("./part.usda")
        held.SetInstanceable(True)
        assert held.IsInstance()
    model = load_model(path_of(stage))
    assert [(geom.body, geom.name) for geom in model.geoms] == [
        ("left", "left_shapes_box"),
        ("left", "left_shapes_look"),
        ("right", "right_shapes_box"),
        ("right", "right_shapes_look"),
    ]
    assert model.compiled.nmesh == 1
    for body in ("left", "right"):
        close(model.compiled.body(body).mass, 8000.0)
        close(model.compiled.body(body).ipos, [0, 0, 1])


def test_a_whole_robot_as_an_instance(tmp_path):
    """Joints inside an instance name bodies inside the prototype: they are the instance's."""
    part = new_stage(tmp_path, "part.usda")
    part.SetDefaultPrim(UsdGeom.Xform.Define(part, "/part").GetPrim())
    for i in range(2):
        add_body(part, f"/part/b{i}", (i, 0, 0))
    add_joint(part, "/part/j", "hinge", ("/part/b0", "/part/b1"), (1, 0, 0))
    path_of(part)
    stage = new_stage(tmp_path)
    for name in ("left", "right"):
        held = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
        held.GetReferences().AddReference("./part.usda")
        held.SetInstanceable(True)
    model = compiled(stage)
    assert parents(model) == {"left_b0": "world", "left_b1": "left_b0", "right_b0": "world", "right_b1": "right_b0"}


def test_names(tmp_path):
    stage = new_stage(tmp_path)
    for finger in ("thumb", "index"):
        UsdGeom.Xform.Define(stage, f"/hand/{finger}")
        add_body(stage, f"/hand/{finger}/tip")
        add_shape(stage, f"/hand/{finger}/tip/pad")
    add_body(stage, "/hand/world")
    named = add_body(stage, "/hand/palm")
    call(named, "right/palm")
    call(add_shape(stage, "/hand/palm/skin"), "pad")
    double = add_body(stage, "/hand/back")
    call(double, "right/palm")
    add_body(stage, "/hand/index/tip/nested", (1, 0, 0))  # a body in a body moves on its own
    add_shape(stage, "/hand/index/tip/nested/nail")
    model, messages = warned(stage)
    assert messages == ["names in tgdsl:name were dropped that are taken: /hand/back"]
    names = {model.body(i).name for i in range(model.nbody)}
    assert names == {"world", "thumb_tip", "index_tip", "hand_world", "right/palm", "back", "nested"}
    geoms = {model.geom(i).name: model.body(model.geom_bodyid[i]).name for i in range(model.ngeom)}
    assert geoms == {
        "thumb_tip_pad": "thumb_tip",
        "index_tip_pad": "index_tip",
        "pad": "right/palm",
        "nail": "nested",
    }
    assert parents(model)["nested"] == "world"


def test_what_is_seen_and_what_collides(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    for name, purpose, collides in product("v", ("default", "render", "guide", "proxy"), (True, False)):
        prim = add_shape(stage, f"/b/{name}_{purpose}_{collides}", collides=collides)
        UsdGeom.Imageable(prim).CreatePurposeAttr(purpose)
    UsdGeom.Imageable(add_shape(stage, "/b/unseen")).MakeInvisible()
    off = add_shape(stage, "/b/off")
    off.GetAttribute("physics:collisionEnabled").Set(False)
    UsdGeom.Gprim(off).CreateDisplayColorAttr([(0.1, 0.2, 0.3)])
    add_shape(stage, "/floor", UsdGeom.Plane, axis="Y", pos=(0, 0, -1))
    model = compiled(stage)
    groups = {model.geom(i).name: (int(model.geom_group[i]), bool(model.geom_contype[i])) for i in range(model.ngeom)}
    assert groups == {
        "v_default_True": (0, True),
        "v_default_False": (2, False),
        "v_render_True": (0, True),
        "v_render_False": (2, False),
        "v_guide_True": (3, True),
        "v_proxy_True": (3, True),
        "unseen": (3, True),
        "off": (2, False),
        "floor": (0, True),
    }
    close(model.geom("off").rgba, [0.1, 0.2, 0.3, 1])
    normal = Rotation.from_quat(model.geom("floor").quat, scalar_first=True).as_matrix()[:, 2]
    close(normal, [0, 1, 0])
    close(model.body("b").mass, 1.0)


# Mass, materials, contacts, gravity


@pytest.mark.parametrize(
    ("body", "collider", "material", "expected"),
    [
        ({}, {}, 0, 16000),
        ({"Mass": 5}, {}, 0, 5),
        ({"Density": 2}, {}, 0, 32),
        ({}, {"Mass": 7}, 0, 8007),
        ({}, {"Density": 3}, 0, 8024),
        ({}, {}, 4, 64),
        ({"Density": 2}, {"Density": 3}, 4, 40),
        ({"Mass": 5}, {"Mass": 7}, 0, 5),
        ({"Mass": 5, "CenterOfMass": (0, 1, 0)}, {}, 0, 5),
        ({"Mass": 5, "DiagonalInertia": (1, 2, 2.5)}, {}, 0, 5),
        ({"Density": 2, "DiagonalInertia": (1, 2, 2.5), "CenterOfMass": (0, 1, 0)}, {}, 0, 32),
        ({}, {"Mass": 7, "CenterOfMass": (0, 1, 0)}, 0, 8007),
        ({}, {"Mass": 7, "DiagonalInertia": (1, 2, 2.5)}, 0, 8007),
    ],
)
def test_mass_is_what_usd_core_makes_of_it(tmp_path, body, collider, material, expected):
    stage = new_stage(tmp_path)
    prim = add_body(stage, "/b", (1, 2, 3), ODD, mass=0)
    boxes = {"/b/one": (1.0, 0.0, 0.0), "/b/two": (-2.0, 0.0, 0.5)}
    for path, pos in boxes.items():
        add_shape(stage, path, pos=pos)
    for target, values in ((prim, body), (stage.GetPrimAtPath("/b/one"), collider)):
        api = UsdPhysics.MassAPI.Apply(target)
        for name, value in values.items():
            getattr(api, f"Create{name}Attr")(value)
        if "DiagonalInertia" in values:
            api.CreatePrincipalAxesAttr(Gf.Quatf(*map(float, ONE_TURN)))
    if material:
        add_material(stage, "/m", prim, density=float(material))

    def box(at: Usd.Prim):
        found = UsdPhysics.RigidBodyAPI.MassInformation()
        found.volume, found.inertia = 8.0, Gf.Matrix3f(16 / 3)
        found.localPos, found.localRot = Gf.Vec3f(*boxes[str(at.GetPath())]), Gf.Quatf(1)
        return found

    mass, moments, centre, axes = UsdPhysics.RigidBodyAPI(prim).ComputeMassProperties(box)
    turned = Rotation.from_quat([axes.GetReal(), *axes.GetImaginary()], scalar_first=True).as_matrix()
    model = compiled(stage)
    close(model.body("b").mass, expected)
    close(mass, expected)
    close(model.body("b").ipos, centre)
    np.testing.assert_allclose(inertia(model, "b"), turned @ np.diag(moments) @ turned.T, atol=1e-5 * max(moments))


def test_authored_inertia(tmp_path):
    stage = new_stage(tmp_path)
    api = UsdPhysics.MassAPI(add_body(stage, "/b", scale=(2, 3, 4)))
    api.CreateCenterOfMassAttr((0.1, 0.2, 0.3))
    api.CreatePrincipalAxesAttr(Gf.Quatf(*ODD).GetNormalized())
    model = compiled(stage)
    axes = matrix((0, 0, 0), ODD)[:3, :3]
    close(model.body("b").ipos, [0.2, 0.6, 1.2])  # in the scaled space of the prim
    close(inertia(model, "b"), axes @ np.diag([0.02, 0.03, 0.04]) @ axes.T)


def test_inertias_that_are_none_and_masses_without_inertia(tmp_path):
    stage = new_stage(tmp_path)
    UsdPhysics.MassAPI(add_body(stage, "/long")).CreateDiagonalInertiaAttr((0.01, 0.01, 0.1))
    UsdPhysics.MassAPI(add_body(stage, "/disc")).CreateDiagonalInertiaAttr(
        (0.7, 0.1, 0.8)
    )  # in float32 the first two add up to less
    for name in ("seen", "bare"):
        UsdPhysics.MassAPI(add_body(stage, f"/{name}", mass=2.0)).CreateDiagonalInertiaAttr((0, 0, 0))
    add_shape(stage, "/seen/box", collides=False)
    model, messages = warned(stage)
    assert messages == [
        "inertias that no body can have were mended: /long",
        "bodies have a mass but neither inertia nor colliders; their visuals were taken as solid: /seen",
        "bodies have a mass but neither inertia nor geometry; a ball of 0.1 m radius was taken: /bare",
    ]
    close(model.body("long").inertia, 0.04)
    close(model.body("disc").inertia, [0.1, 0.7, 0.8])
    close(model.body("seen").inertia, 2 * 4 / 6)
    close(model.body("bare").inertia, 0.4 * 2 * 0.01)


def test_friction_of_materials(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    values = {
        "both": {"dynamicFriction": 0.3, "staticFriction": 0.6},
        "static": {"staticFriction": 0.7},
        "zero": {"dynamicFriction": 0.0},
        "neither": {"density": 100.0},
    }
    for name, material in values.items():
        add_material(stage, f"/m_{name}", add_shape(stage, f"/b/{name}"), **material)
    add_material(stage, "/all", add_shape(stage, "/b/any"), "", dynamicFriction=0.2)
    add_shape(stage, "/b/none")
    model = compiled(stage)
    frictions = {name: float(model.geom(name).friction[0]) for name in (*values, "any", "none")}
    expected = {"both": 0.3, "static": 0.7, "zero": 0.0, "neither": 1.0, "any": 0.2, "none": 1.0}
    close([frictions[name] for name in expected], list(expected.values()))


def meetings(model: mujoco.MjModel) -> set[tuple[str, ...]]:
    """Return the pairs of bodies that MuJoCo finds in contact."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return {tuple(sorted(model.body(model.geom_bodyid[g]).name for g in contact.geom)) for contact in data.contact}


def crowd(stage: Usd.Stage, *names: str) -> None:
    """Add boxes at one place: all collide with all."""
    for i, name in enumerate(names):
        add_body(stage, f"/{name}", (0.01 * i, 0, 0))
        add_shape(stage, f"/{name}/{name}_box")


def test_jointed_bodies_collide_if_the_joint_says_so(tmp_path):
    for collides in (False, True):
        stage = new_stage(tmp_path, f"{collides}.usda")
        crowd(stage, "a", "b", "c")
        add_joint(stage, "/ab", "hinge", ("/a", "/b"), (0.01, 0, 0), collisionEnabled=collides)
        add_joint(stage, "/bc", "hinge", ("/b", "/c"), (0.01, 0, 0))
        assert meetings(compiled(stage)) == {("a", "c")} | ({("a", "b")} if collides else set())


def test_filtered_pairs(tmp_path):
    stage = new_stage(tmp_path)
    crowd(stage, "a", "b", "c", "d")
    add_shape(stage, "/d/second")
    for prim, target in (("/a", "/b"), ("/a/a_box", "/c/c_box"), ("/b", "/d/second")):
        api = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(prim))
        api.CreateFilteredPairsRel().SetTargets([target])
    model, messages = warned(stage)
    assert meetings(model) == {("a", "d"), ("b", "c"), ("b", "d"), ("c", "d")}
    assert messages == ["collision filters were dropped that hold for some colliders of a body only: /b"]


@pytest.mark.parametrize("is_inverted", [False, True])
def test_collision_groups(tmp_path, is_inverted):
    stage = new_stage(tmp_path)
    crowd(stage, "a", "b", "c", "d")
    for name, members, filtered in (("one", "ab", "two"), ("two", "c", "")):
        group = UsdPhysics.CollisionGroup.Define(stage, f"/{name}")
        Usd.CollectionAPI(group.GetPrim(), "colliders").CreateIncludesRel().SetTargets([f"/{m}" for m in members])
        if filtered:
            group.CreateFilteredGroupsRel().SetTargets([f"/{filtered}"])
            group.CreateInvertFilteredGroupsAttr(is_inverted)
    free = {("a", "d"), ("b", "d"), ("c", "d")}
    expected = {("a", "c"), ("b", "c")} if is_inverted else {("a", "b")}
    assert meetings(compiled(stage)) == free | expected


@pytest.mark.parametrize("up", "YZ")
@pytest.mark.parametrize(
    ("direction", "magnitude", "expected"),
    [
        ((0, 0, 0), -math.inf, (0, 0, -9.81)),
        ((0, 0, 0), 300.0, (0, 0, -3.0)),
        ((2, 0, 0), 300.0, (3.0, 0, 0)),
        ((0, 0, 0), 0.0, (0, 0, 0)),
    ],
)
def test_gravity(tmp_path, direction, magnitude, expected, up):
    stage = new_stage(tmp_path, metres=0.01, up=up)
    add_body(stage, "/b")
    scene = UsdPhysics.Scene.Define(stage, "/scene")
    scene.CreateGravityDirectionAttr(direction)
    scene.CreateGravityMagnitudeAttr(magnitude)
    close(compiled(stage).opt.gravity, expected)


def test_what_is_dropped_is_told_once(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 3, breakForce=10.0)
    drive = UsdPhysics.DriveAPI.Apply(stage.GetPrimAtPath("/j1"), "angular")
    drive.CreateTypeAttr("acceleration")
    drive.CreateStiffnessAttr(1.0)
    UsdPhysics.DriveAPI.Apply(stage.GetPrimAtPath("/j2"), "transX").CreateDampingAttr(1.0)
    stage.GetPrimAtPath("/j2").AddAppliedSchema("PhysxMimicJointAPI:rotX")
    add_body(stage, "/c", (0, 1, 0))
    add_joint(stage, "/cone", "ball", ("/b0", "/c"), (0, 1, 0), coneAngle0Limit=30.0)
    UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath("/c")).CreateVelocityAttr((1, 0, 0))
    UsdPhysics.CollisionAPI.Apply(UsdGeom.Xform.Define(stage, "/c/group").GetPrim())
    UsdGeom.Points.Define(stage, "/c/points")
    UsdGeom.PointInstancer.Define(stage, "/c/swarm")
    add_shape(stage, "/c/swarm/one")
    add_mesh(stage, "/c/triangle", QUAD[:3], [(0, 1, 2)], collides=False)
    add_material(stage, "/m", add_shape(stage, "/c/box"), restitution=0.5)
    add_joint(stage, "/itself", "hinge", ("/c", "/c/box"))
    for name in ("one", "two"):
        UsdPhysics.Scene.Define(stage, f"/{name}")
    _, messages = warned(stage)
    assert sorted(messages) == sorted(
        [
            "joints do not break: their breakForce and breakTorque were dropped: /j1, /j2",
            "drives were dropped whose gains are per mass (type acceleration), which MuJoCo does not have: /j1",
            "drives were dropped that are not along the one degree of freedom of a revolute or prismatic joint: /j2",
            "cone limits of spherical joints were dropped: MuJoCo limits a ball joint's whole angle: /cone",
            "couplings between joints (mimic) were dropped: /j2",
            "initial velocities were dropped: /c",
            "colliders were dropped that are no geometry that MuJoCo has: /c/group",
            "visuals were dropped that are no geometry that MuJoCo has: /c/points, /c/swarm",
            "visual meshes with less than four points were dropped: /c/triangle",
            "restitution of materials was dropped: MuJoCo has none: /m",
            "joints were dropped that join a body to itself, or the world to the world: /itself",
            "physics scenes after the first one were dropped: /two",
        ]
    )


# Errors


def test_unresolved_references(tmp_path, capfd):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    path_of(stage)
    for text, parts in {
        'def Xform "a" (references = @gone.usda@) {}': ("/a: ", "gone.usda"),
        'def Xform "a" (payload = @gone.usda@) {}': ("/a: ", "gone.usda"),
        'def Xform "a" (references = </gone>) {}': ("/a: ", "/gone"),
        'def Xform "a" {\n  def Xform "c" (references = @robot.usda@</gone>) {}\n}': ("/a/c: ", "/gone"),
    }.items():
        file = tmp_path / "broken.usda"
        file.write_text(f"#usda 1.0\n{text}\n")
        with pytest.raises(RobotError) as caught:
            usd_to_mjcf(file)
        assert str(caught.value).startswith(f"{file}: {parts[0]}")
        assert parts[1] in str(caught.value)
        (tmp_path / "broken.usda").unlink()
    file = tmp_path / "layers.usda"
    file.write_text("#usda 1.0\n(\n  subLayers = [@gone.usda@]\n)\n")
    with pytest.raises(RobotError, match=r"layers\.usda: /: .*gone\.usda"):
        usd_to_mjcf(file)
    assert capfd.readouterr() == ("", "")  # USD prints nothing of its own


def test_files_that_are_not_usd(tmp_path):
    (tmp_path / "text.usda").write_text("hello")
    (tmp_path / "broken.usda").write_text('#usda 1.0\ndef Xform "a" {\n')
    (tmp_path / "noise.usdc").write_bytes(bytes(range(200)))
    for name in ("text.usda", "broken.usda", "noise.usdc"):
        with pytest.raises(RobotError, match=rf"{name}: not a USD file: \S"):
            usd_to_mjcf(tmp_path / name)
    with pytest.raises(RobotError, match=r"gone\.usda: there is no such file"):
        usd_to_mjcf(tmp_path / "gone.usda")


def test_a_stage_without_a_robot(tmp_path):
    stage = new_stage(tmp_path)
    add_shape(stage, "/floor")
    assert error_of(stage) == "/: no prim has an enabled PhysicsRigidBodyAPI: there is no robot in it"


@pytest.mark.parametrize("limits", [{}, dict.fromkeys(GENERIC[:4], (1.0, -1.0)), dict.fromkeys(GENERIC[1:3], (1.0, -1.0))])
def test_generic_joints_that_are_none_of_mujocos(tmp_path, limits):
    stage = new_stage(tmp_path)
    generic(stage, limits or {"distance": (0.1, 0.2)})
    free = [dof for dof in GENERIC if dof not in limits]
    assert error_of(stage) == (
        f"/robot/j: a generic joint that leaves {', '.join(free)} free is no single MuJoCo joint (hinge, slide, ball, fixed, free)"
    )


def test_joints_that_mujoco_does_not_have(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 2)
    add_joint(stage, "/far", "distance", ("/b0", "/b1"))
    assert error_of(stage) == "/far: PhysicsDistanceJoint is not supported: MuJoCo has no such joint"
    stage.RemovePrim("/far")
    stage.DefinePrim("/gear", "PhysxPhysicsGearJoint")
    known = "known joints: revolute, prismatic, spherical, fixed, generic"
    assert error_of(stage) == f"/gear: PhysxPhysicsGearJoint is not supported; {known}"
    stage.RemovePrim("/gear")
    add_joint(stage, "/loop", "slide", ("/b0", "/b1"), (1, 0, 0), excludeFromArticulation=True)
    assert error_of(stage) == "/loop: a prismatic joint closes a loop, for which MuJoCo has no constraint"


def test_joints_that_join_what_is_not_there(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 2)
    joint = UsdPhysics.Joint(stage.GetPrimAtPath("/j1"))
    joint.GetBody0Rel().SetTargets(["/gone"])
    assert error_of(stage) == "/j1: physics:body0 names /gone, which does not exist"
    joint.GetBody0Rel().SetTargets(["/b0", "/b1"])
    assert error_of(stage) == "/j1: physics:body0 has 2 targets; expected one at most"
    joint.GetBody0Rel().SetTargets(["/b0"])
    stage.GetPrimAtPath("/b0").SetActive(False)
    assert error_of(stage) == "/j1: physics:body0 names /b0, which does not exist"
    stage.GetPrimAtPath("/b0").SetActive(True)
    joint.GetLocalRot0Attr().Set(Gf.Quatf(0))
    assert error_of(stage) == "/j1: physics:localRot0 is no rotation: (0, 0, 0, 0)"
    joint.GetLocalPos1Attr().Set((math.inf, 0, 0))
    joint.GetLocalRot0Attr().Set(Gf.Quatf(1))
    assert error_of(stage) == "/j1: physics:localPos1 is not finite"
    joint.GetLocalPos1Attr().Set((0, 0, 0))
    joint.GetLocalRot0Attr().Set(Gf.Quatf(1))
    joint.GetPrim().GetAttribute("physics:lowerLimit").Set(10.0)
    joint.GetPrim().GetAttribute("physics:upperLimit").Set(-10.0)
    assert error_of(stage).startswith("/j1: its lower limit 0.17")
    joint.GetPrim().GetAttribute("physics:upperLimit").Set(math.nan)
    assert error_of(stage) == "/j1: physics:upperLimit is not a number"
    joint.GetPrim().GetAttribute("physics:upperLimit").Set(20.0)
    pairs = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath("/b0")).CreateFilteredPairsRel()
    pairs.SetTargets(["/gone"])
    assert error_of(stage) == "/b0: physics:filteredPairs names /gone, which does not exist"
    pairs.ClearTargets(True)
    UsdPhysics.Scene.Define(stage, "/scene").CreateGravityDirectionAttr((math.inf, 0, 0))
    assert error_of(stage) == "/scene: gravity is not finite"


@pytest.mark.parametrize(
    ("points", "faces", "message"),
    [
        ([], [], "the mesh has no points"),
        (WEDGE, [], "the mesh has no faceVertexCounts"),
        (WEDGE, [(0, 1, 4)], "faceVertexIndices holds 4; the mesh has 4 points"),
        (WEDGE, [(0, 1, -1)], "faceVertexIndices holds -1; the mesh has 4 points"),
        (WEDGE, [(0, 1)], "the mesh has a face with 2 corners; expected 3 or more"),
        ([*WEDGE[:3], (0, 0, math.inf)], WEDGE_FACES, "the mesh has points that are not finite"),
        (QUAD, [(0, 1, 2, 3)], "the mesh is flat: it has no hull to collide; use a plane or a thin box"),
    ],
)
def test_broken_meshes(tmp_path, points, faces, message):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    prim = add_mesh(stage, "/b/m", points, faces)
    assert error_of(stage) == f"/b/m: {message}"
    if points == WEDGE and faces:
        UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Set([3, 3])
        assert error_of(stage).startswith("/b/m: ")


def test_flat_meshes_can_be_seen(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    add_mesh(stage, "/b/sheet", QUAD, [(0, 1, 2, 3)], collides=False)
    assert compiled(stage).geom("sheet").group == 2


def test_transforms_that_are_none(tmp_path):
    stage = new_stage(tmp_path)
    prim = add_body(stage, "/b")
    prim.GetAttribute("xformOp:translate").Set(Gf.Vec3d(math.nan, 0, 0))
    assert error_of(stage) == "/b: its transform is not finite"
    prim.GetAttribute("xformOp:translate").Set(Gf.Vec3d(0, 0, 0))
    prim.GetAttribute("xformOp:scale").Set(Gf.Vec3d(1, 0, 1))
    assert error_of(stage) == "/b: its transform is sheared or flat, so that it has no rigid frame"
    prim.GetAttribute("xformOp:scale").Set(Gf.Vec3d(1, 1, 1))
    add_shape(stage, "/b/box", scale=(1, 1, 0))
    assert error_of(stage) == "/b/box: its transform is flat: a scale is zero"


def test_bodies_that_cannot_be(tmp_path):
    stage = new_stage(tmp_path)
    prim = add_body(stage, "/b", mass=0)
    assert error_of(stage) == "/b: the body can move, but has neither mass nor colliders"
    UsdPhysics.MassAPI.Apply(prim).CreateMassAttr(-1.0)
    assert error_of(stage) == "/b: physics:mass is -1.0; expected 0 or more"
    UsdPhysics.MassAPI.Apply(prim).CreateMassAttr(1.0)
    UsdPhysics.MassAPI.Apply(prim).CreateDiagonalInertiaAttr((1, 1, 1))
    add_shape(stage, "/b/floor", UsdGeom.Plane)
    assert error_of(stage) == "/b/floor: a plane can only belong to the world or to a kinematic body"
    stage.RemovePrim("/b/floor")
    add_shape(stage, "/b/ball", UsdGeom.Sphere, radius=0.0)
    assert error_of(stage) == "/b/ball: radius is 0.0; expected more than 0"


def test_without_usd_core(tmp_path, monkeypatch):
    real = builtins.__import__

    def importing(name, *rest, **keywords):
        if name == "pxr":
            raise ImportError(name)
        return real(name, *rest, **keywords)

    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    path = path_of(stage)
    monkeypatch.setattr(builtins, "__import__", importing)
    with pytest.raises(RobotError, match="pip install usd-core"):
        usd_to_mjcf(path)


# Files


@pytest.mark.parametrize("suffix", ["usd", "usda", "usdc", "usdz"])
def test_every_kind_of_file(tmp_path, suffix):
    stage = new_stage(tmp_path, "robot.usda" if suffix == "usdz" else f"robot.{suffix}")
    add_body(stage, "/b")
    path = path_of(stage)
    if suffix == "usdz":
        path = tmp_path / "robot.usdz"
        assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "robot.usda"), str(path))
    assert load_model(path).bodies == ("world", "b")


def test_written_files_are_the_text(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b", mass=0)
    add_mesh(stage, "/b/wedge", np.array(WEDGE) / 3, WEDGE_FACES, pos=(0.1, 0.2, 0.3), quat=ODD)
    named = add_mesh(stage, "/b/odd", np.array(WEDGE) / 7, WEDGE_FACES)
    call(named, "../Wedge")
    text = usd_to_mjcf(path_of(stage))
    out = tmp_path / "out" / "hand.xml"
    out.parent.mkdir()
    for _ in range(2):  # what is there is replaced
        write_mjcf(text, out)
        assert sorted(p.relative_to(out.parent).as_posix() for p in out.parent.rglob("*")) == [
            "hand.xml",
            "hand_assets",
            "hand_assets/.._Wedge.obj",
            "hand_assets/wedge.obj",
        ]
    inline, written = mujoco.MjModel.from_xml_string(text), mujoco.MjModel.from_xml_path(str(out))
    for name in ("mesh_vert", "mesh_face", "geom_pos", "geom_quat", "body_mass", "body_inertia", "body_ipos"):
        np.testing.assert_array_equal(getattr(inline, name), getattr(written, name), err_msg=name)


def test_nothing_half_written_is_left(tmp_path, monkeypatch):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    add_mesh(stage, "/b/wedge", WEDGE, WEDGE_FACES)
    text = usd_to_mjcf(path_of(stage))

    def full(*_, **__):
        raise OSError("no space left on device")

    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="no space"):
        write_mjcf(text, tmp_path / "hand.xml")
    assert sorted(tmp_path.iterdir()) == before


def test_numbers_keep_all_their_digits(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b", (1 / 3, math.pi, 1e-7))
    assert 'pos="0.3333333333333333 3.141592653589793 1e-07"' in usd_to_mjcf(path_of(stage))
