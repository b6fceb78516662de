"""Robots exported to USD, read back with USD alone: kinematics over its joints, and what MuJoCo has instead."""

from pathlib import Path

import mujoco
import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics
from scipy.spatial.transform import Rotation

from tgdsl.formats.robot import export_model, load_model

XHAND1 = Path(__file__).parents[2] / "robots" / "xhand1" / "xhand1_right.xml"
TOLERANCE = 1e-6
"""USD keeps joint frames and vertices in float32: 1e-8 m for a hand, and a rotation of 1e-7 rad; 1e-6 is the contract."""
SINGLE = 2e-7
"""Relative error of a number that was rounded to float32 and turned once."""
ZOO = """
<mujoco model="zoo of shapes">
  <compiler angle="radian" autolimits="true"/>
  <option gravity="1 -2 -9"/>
  <asset><material name="red" rgba=".9 .1 .2 .5"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="2 3 .1" friction=".3"/>
    <geom name="endless" type="plane" size="0 0 .1" pos="0 0 -1"/>
    <site name="camp" pos="1 2 3" quat=".5 .5 .5 .5"/>
    <body name="base" pos=".1 .2 .3" quat=".9 .1 -.3 .2">
      <inertial pos=".01 -.02 .03" quat=".8 .1 .2 .5" mass="1.5" diaginertia=".03 .02 .04"/>
      <geom name="block" type="box" size=".01 .02 .03" pos=".1 0 .2" quat=".3 .5 -.1 .9" material="red"/>
      <site name="mark" pos=".01 .02 .03" quat="0 1 0 0"/>
      <body name="cart" pos="0 .1 0" quat=".7 0 .7 .1">
        <joint name="rail" type="slide" axis="-1 .2 .3" pos=".01 .02 .03" range="-.1 .3" ref=".05" armature=".2" frictionloss=".3"/>
        <geom name="ball" type="sphere" size=".02" pos="0 .03 0" rgba="0 1 0 1" friction=".3"/>
        <body name="arm" pos=".2 0 .1" quat=".1 .9 .2 -.3">
          <joint name="elbow" axis="-1 1e-9 0" pos="0 .01 -.02" ref=".7" range="-.5 2" damping=".03"/>
          <geom name="tube" type="capsule" size=".01 .05" pos="0 0 .1"/>
          <geom name="seen" type="cylinder" size=".02 .03" contype="0" conaffinity="0"/>
          <body name="wrist" pos="0 .05 0" quat=".6 .1 .2 .7">
            <joint name="socket" type="ball" pos="0 .02 .01" damping=".1"/>
            <geom name="egg" type="ellipsoid" size=".01 .02 .03" contype="0" conaffinity="0"/>
            <body name="nail" pos=".01 0 0" quat="0 1 1 0"><geom name="rod" type="cylinder" size=".01 .04" contype="2" conaffinity="5"/></body>
            <body name="thumb" pos="0 0 .1"><joint name="spin" axis="0 1 2"/><geom size=".01"/></body>
          </body>
        </body>
      </body>
    </body>
    <body name="cube" pos="1 1 1" quat=".4 .3 .2 .1"><joint name="loose" type="free"/><geom name="die" type="box" size=".1 .1 .1"/></body>
    <body name="stand" pos="0 0 5"/>
    <body name="target" pos="0 0 2" mocap="true"><geom size=".01" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator>
    <position name="push" joint="rail" kp="30" kv="2" forcerange="-5 5" ctrlrange="-.1 .3"/>
    <position name="bend" joint="elbow" kp="3" kv=".4"/>
    <velocity name="whirl" joint="spin" kv=".7" forcerange="-2 2"/>
  </actuator>
</mujoco>
"""


def exported(folder: Path, text: str, ending: str = ".usda") -> tuple[Usd.Stage, mujoco.MjModel]:
    """Export MJCF; return the stage, and what MuJoCo makes of it."""
    (folder / "robot.xml").write_text(text)
    export_model(folder / "robot.xml", folder / f"robot{ending}")
    return Usd.Stage.Open(str(folder / f"robot{ending}")), mujoco.MjModel.from_xml_string(text)


def twins_of(folder: Path, text: str) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Return an MJCF model, and what it comes back as after an export; no warning comes, as warnings are errors."""
    (folder / "hand.xml").write_text(text)
    export_model(folder / "hand.xml", folder / "hand.usda")
    return load_model(folder / "hand.xml").compiled, load_model(folder / "hand.usda").compiled


def world_of(bodies: str, rest: str = "", asset: str = "") -> str:
    return f"<mujoco><asset>{asset}</asset><worldbody>{bodies}</worldbody>{rest}</mujoco>"


def named(stage: Usd.Stage, schema: type | None = None) -> dict[str, Usd.Prim]:
    """Return prims by the names that MuJoCo gave them."""
    prims = [prim for prim in stage.Traverse() if prim.GetAttribute("tgdsl:name") and prim != stage.GetDefaultPrim()]
    chosen = [prim for prim in prims if schema is None or prim.IsA(schema) or prim.HasAPI(schema)]
    return {prim.GetAttribute("tgdsl:name").Get(): prim for prim in chosen}


def matrix(pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    pose[:3, 3] = pos
    return pose


def world_pose(prim: Usd.Prim) -> np.ndarray:
    return np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T


def mujoco_poses(model: mujoco.MjModel, qpos: np.ndarray) -> dict[str, np.ndarray]:
    state = mujoco.MjData(model)
    state.qpos[:] = qpos
    mujoco.mj_kinematics(model, state)
    return {model.body(i).name: matrix(state.xpos[i], state.xquat[i]) for i in range(1, model.nbody)}


def motion(joint: Usd.Prim, qpos: np.ndarray) -> np.ndarray:
    """Return what a USD joint does between its two frames."""
    if joint.IsA(UsdPhysics.FixedJoint):
        return np.eye(4)
    if joint.IsA(UsdPhysics.SphericalJoint):
        return matrix(np.zeros(3), qpos)
    assert joint.GetAttribute("physics:axis").Get() == "X"
    if joint.IsA(UsdPhysics.PrismaticJoint):
        return matrix(np.array([*qpos, 0, 0]), np.array([1.0, 0, 0, 0]))
    assert joint.IsA(UsdPhysics.RevoluteJoint)
    return matrix(np.zeros(3), np.array([np.cos(qpos[0] / 2), np.sin(qpos[0] / 2), 0, 0]))


def walk(stage: Usd.Stage, model: mujoco.MjModel, qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Return the world poses of bodies by forward kinematics over USD's joints alone; `qpos` is looked up by joint names."""
    joints = {UsdPhysics.Joint(p).GetBody1Rel().GetTargets()[0]: p for p in stage.Traverse() if p.IsA(UsdPhysics.Joint)}

    def pose(path):
        if path not in joints:
            return world_pose(stage.GetPrimAtPath(path))
        joint = UsdPhysics.Joint(joints[path])
        parents = joint.GetBody0Rel().GetTargets()
        found = pose(parents[0]) if parents else np.eye(4)
        sides = [(joint.GetLocalPos0Attr(), joint.GetLocalRot0Attr()), (joint.GetLocalPos1Attr(), joint.GetLocalRot1Attr())]
        first, second = (matrix(np.array(p.Get()), np.array([q.Get().real, *q.Get().imaginary])) for p, q in sides)
        name = joint.GetPrim().GetAttribute("tgdsl:name").Get()
        if name:
            start = int(model.joint(name).qposadr[0])
            qpos_here = qpos[start : start + (4 if joint.GetPrim().IsA(UsdPhysics.SphericalJoint) else 1)]
        return found @ first @ motion(joint.GetPrim(), qpos_here if name else qpos[:0]) @ np.linalg.inv(second)

    bodies = named(stage, UsdPhysics.RigidBodyAPI)
    return {name: pose(prim.GetPath()) for name, prim in bodies.items()}


def random_qpos(model: mujoco.MjModel, generator: np.random.Generator) -> np.ndarray:
    """Return a random state; what floats freely stays, for no joint of USD moves it."""
    qpos = model.qpos0.copy()
    for joint in range(model.njnt):
        start = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            qpos[start : start + 4] = Rotation.random(random_state=int(generator.integers(1000))).as_quat(scalar_first=True)
        elif model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            qpos[start] = generator.uniform(*(model.jnt_range[joint] if model.jnt_limited[joint] else (-3, 3)))
    return qpos
