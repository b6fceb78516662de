"""Exported joints and drives move like MuJoCo's."""

import mujoco
import numpy as np
import pytest
from pxr import UsdPhysics
from usd_exports import SINGLE, TOLERANCE, ZOO, exported, mujoco_poses, named, random_qpos, walk, world_of


def test_poses_from_exported_joints_match_mujoco(pair):
    stage, model = pair
    generator = np.random.default_rng(0)
    states = [model.qpos0, *(random_qpos(model, generator) for _ in range(20))]
    for qpos in states:
        poses = mujoco_poses(model, qpos)
        for name, pose in walk(stage, model, qpos).items():
            np.testing.assert_allclose(pose, poses[name], atol=TOLERANCE, err_msg=name)


@pytest.mark.parametrize("axis", ["1 0 0", "-1 0 0", "0 1 0", "0 0 -1", "-1 1e-7 0", "1e-9 -1 1", "-1 -1 -1"])
def test_joint_frames_meet_whatever_the_axis(tmp_path, axis):
    text = world_of(
        f"<body name='a' pos='1 2 3' euler='10 20 30'><joint name='j' axis='{axis}' pos='.1 .2 .3'/><geom size='.1'/></body>"
    )
    stage, model = exported(tmp_path, text)
    for angle in (0.0, 1.0, -2.5):
        qpos = np.array([angle])
        np.testing.assert_allclose(walk(stage, model, qpos)["a"], mujoco_poses(model, qpos)["a"], atol=2e-6)  # 4 m away


def test_limits(zoo):
    joints = named(zoo[0], UsdPhysics.Joint)
    limits = {name: [p.GetAttribute(f"physics:{end}Limit").Get() for end in ("lower", "upper")] for name, p in joints.items()}
    np.testing.assert_allclose(limits["rail"], [-0.1, 0.3], rtol=SINGLE)
    np.testing.assert_allclose(limits["elbow"], np.rad2deg([-0.5, 2.0]), rtol=SINGLE)
    assert limits["spin"] == [-np.inf, np.inf]


def test_armature_friction_and_damping_are_exported(zoo):
    joints = named(zoo[0], UsdPhysics.Joint)
    keys = ("physxJoint:armature", "physxJoint:jointFriction", "tgdsl:damping")
    values = {name: [prim.GetAttribute(key).Get() for key in keys] for name, prim in joints.items()}
    assert values["rail"] == [pytest.approx(0.2), pytest.approx(0.3), None]
    assert values["elbow"] == [None, None, 0.03]
    assert values["socket"] == [None, None, 0.1]
    assert values["spin"] == [None, None, None]


def test_free_and_mocap_bodies_have_no_joints(zoo):
    bodies, joints = named(zoo[0], UsdPhysics.RigidBodyAPI), named(zoo[0], UsdPhysics.Joint)
    children = {
        UsdPhysics.Joint(prim).GetBody1Rel().GetTargets()[0].name for prim in zoo[0].Traverse() if prim.IsA(UsdPhysics.Joint)
    }
    assert children == {"base", "stand", "cart", "arm", "wrist", "nail", "thumb"}
    assert joints.keys() == {"rail", "elbow", "socket", "spin"}
    assert bodies["cube"].GetAttribute("tgdsl:freejoint").Get() == "loose"
    assert [name for name, prim in bodies.items() if UsdPhysics.RigidBodyAPI(prim).GetKinematicEnabledAttr().Get()] == [
        "target"
    ]


GEARED = world_of(
    "<body><joint name='j'/><geom name='g' size='.1'/></body><body pos='1 0 0'><joint name='s' type='slide'/><geom size='.1'/></body>",
    "<actuator><position name='a' joint='j' kp='5' kv='.3' gear='-2' forcerange='-3 3' ctrlrange='-1 3'/>"
    "<velocity name='b' joint='s' kv='4' gear='.5' ctrlrange='-8 8'/></actuator>",
)


@pytest.mark.parametrize("text", [ZOO, GEARED], ids=["direct", "geared"])
def test_drives_exert_the_forces_of_mujocos_servos(tmp_path, text):
    """At the joint, the target is the control over the gear; USD's angular drives are in degrees."""
    stage, model = exported(tmp_path, text)
    state, generator = mujoco.MjData(model), np.random.default_rng(1)
    joints = named(stage, UsdPhysics.Joint)
    for _ in range(10):
        state.qpos[:], state.qvel[:] = random_qpos(model, generator), generator.normal(size=model.nv)
        state.ctrl[:] = generator.normal(size=model.nu)
        model.actuator_ctrllimited[:] = 0
        mujoco.mj_forward(model, state)
        for actuator in range(model.nu):
            joint, gear = model.joint(model.actuator_trnid[actuator, 0]), model.actuator_gear[actuator, 0]
            is_hinge = joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE
            unit = np.rad2deg(1.0) if is_hinge else 1.0
            drive = UsdPhysics.DriveAPI(joints[joint.name], "angular" if is_hinge else "linear")
            assert drive.GetTypeAttr().Get() == "force"
            target = state.ctrl[actuator] / gear * unit
            pos, speed = state.qpos[joint.qposadr[0]] * unit, state.qvel[joint.dofadr[0]] * unit
            joint_damping = (
                joints[joint.name].GetAttribute("tgdsl:damping").Get() or 0
            ) / unit  # no part of the servo's force in MuJoCo
            stiffness, damping = drive.GetStiffnessAttr().Get(), drive.GetDampingAttr().Get() - joint_damping
            effort = stiffness * (target - pos) - damping * speed if stiffness else damping * (target - speed)
            limit = drive.GetMaxForceAttr().Get()
            force = state.qfrc_actuator[joint.dofadr[0]]
            assert force == pytest.approx(np.clip(effort, -limit, limit), rel=1e-5, abs=1e-6)


def test_a_damped_joint_without_a_servo_has_a_drive_that_only_damps(tmp_path):
    bodies = (
        "<body><joint name='j' damping='3'/><geom size='.1'/></body><body pos='1 0 0'><joint name='s'/><geom size='.1'/></body>"
    )
    stage, _ = exported(tmp_path, world_of(bodies))
    drive = UsdPhysics.DriveAPI(named(stage)["j"], "angular")
    assert drive.GetDampingAttr().Get() == pytest.approx(np.deg2rad(3), rel=SINGLE)
    assert (drive.GetStiffnessAttr().Get(), drive.GetMaxForceAttr().Get(), drive.GetTypeAttr().Get()) == (0, np.inf, "force")
    assert not UsdPhysics.DriveAPI(named(stage)["s"], "angular").GetDampingAttr()


def test_ranges_and_names_of_actuators(tmp_path, zoo):
    joints = named(zoo[0], UsdPhysics.Joint)
    values = {name: [joints[name].GetAttribute(f"tgdsl:{key}").Get() for key in ("actuator", "ctrlrange")] for name in joints}
    assert values == {"rail": ["push", (-0.1, 0.3)], "elbow": ["bend", None], "socket": [None, None], "spin": ["whirl", None]}
    stage, _ = exported(tmp_path, GEARED)
    joints = named(stage, UsdPhysics.Joint)
    assert joints["j"].GetAttribute("tgdsl:ctrlrange").Get() == (-1.5, 0.5)
    assert joints["s"].GetAttribute("tgdsl:ctrlrange").Get() == (-16, 16)
    assert UsdPhysics.DriveAPI(joints["j"], "angular").GetMaxForceAttr().Get() == 6
    assert UsdPhysics.DriveAPI(joints["s"], "linear").GetMaxForceAttr().Get() == np.inf


def test_a_joints_own_force_range_counts_too(tmp_path):
    text = GEARED.replace("<joint name='j'/>", "<joint name='j' actuatorfrcrange='-4 4'/>")
    stage, _ = exported(tmp_path, text)
    assert UsdPhysics.DriveAPI(named(stage)["j"], "angular").GetMaxForceAttr().Get() == 4
