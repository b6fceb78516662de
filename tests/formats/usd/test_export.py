"""Robots out: the stage is read back with USD alone, and MuJoCo says where everything has to be."""

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation
from scipy.spatial.transform import Rotation

from tgdsl.errors import RobotError
from tgdsl.formats.robot import export_model, load_model

XHAND1 = Path(__file__).parents[3] / "robots" / "xhand1" / "xhand1_right.xml"
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


def world_of(bodies: str, rest: str = "", asset: str = "") -> str:
    return f"<mujoco><asset>{asset}</asset><worldbody>{bodies}</worldbody>{rest}</mujoco>"


@pytest.fixture(scope="module")
def zoo(tmp_path_factory) -> tuple[Usd.Stage, mujoco.MjModel]:
    return exported(tmp_path_factory.mktemp("zoo"), ZOO)


@pytest.fixture(scope="module")
def hand(tmp_path_factory) -> tuple[Usd.Stage, mujoco.MjModel]:
    out = tmp_path_factory.mktemp("hand") / "hand.usdc"
    export_model(XHAND1, out)
    return Usd.Stage.Open(str(out)), mujoco.MjModel.from_xml_path(str(XHAND1))


@pytest.fixture(params=["zoo", "hand"])
def pair(request) -> tuple[Usd.Stage, mujoco.MjModel]:
    return request.getfixturevalue(request.param)


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


def test_units_and_default_prim(zoo):
    stage, model = zoo
    assert UsdGeom.GetStageMetersPerUnit(stage) == UsdPhysics.GetStageKilogramsPerUnit(stage) == 1
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == "/zoo_of_shapes"
    assert stage.GetDefaultPrim().GetAttribute("tgdsl:name").Get() == "zoo of shapes"
    assert stage.GetDefaultPrim().HasAPI(UsdPhysics.ArticulationRootAPI)
    scene = UsdPhysics.Scene(stage.GetPrimAtPath("/physicsScene"))
    gravity = scene.GetGravityMagnitudeAttr().Get() * np.array(scene.GetGravityDirectionAttr().Get())
    np.testing.assert_allclose(gravity, model.opt.gravity, rtol=SINGLE)


def test_bodies_are_siblings_at_their_world_poses(pair):
    stage, model = pair
    bodies, poses = named(stage, UsdPhysics.RigidBodyAPI), mujoco_poses(model, model.qpos0)
    assert bodies.keys() == poses.keys()
    for name, prim in bodies.items():
        assert prim.GetParent() == stage.GetDefaultPrim()
        np.testing.assert_allclose(world_pose(prim), poses[name], atol=1e-14)
        assert [str(op.GetTypeName()) for op in UsdGeom.Xformable(prim).GetOrderedXformOps()] == ["double3", "quatd"]


def test_a_walk_over_the_joints_is_mujocos_kinematics(pair):
    stage, model = pair
    generator = np.random.default_rng(0)
    states = [model.qpos0, *(random_qpos(model, generator) for _ in range(20))]
    for qpos in states:
        poses = mujoco_poses(model, qpos)
        for name, found in walk(stage, model, qpos).items():
            np.testing.assert_allclose(found, poses[name], atol=TOLERANCE, err_msg=name)


@pytest.mark.parametrize("axis", ["1 0 0", "-1 0 0", "0 1 0", "0 0 -1", "-1 1e-7 0", "1e-9 -1 1", "-1 -1 -1"])
def test_joint_frames_meet_whatever_the_axis(tmp_path, axis):
    text = world_of(
        f"<body name='a' pos='1 2 3' euler='10 20 30'><joint name='j' axis='{axis}' pos='.1 .2 .3'/><geom size='.1'/></body>"
    )
    stage, model = exported(tmp_path, text)
    for angle in (0.0, 1.0, -2.5):
        qpos = np.array([angle])
        np.testing.assert_allclose(walk(stage, model, qpos)["a"], mujoco_poses(model, qpos)["a"], atol=2e-6)  # 4 m away


def test_masses_and_inertia_tensors(pair):
    stage, model = pair
    for name, prim in named(stage, UsdPhysics.RigidBodyAPI).items():
        mass, body = UsdPhysics.MassAPI(prim), model.body(name)
        assert mass.GetMassAttr().Get() == pytest.approx(body.mass[0], rel=SINGLE)
        np.testing.assert_allclose(mass.GetCenterOfMassAttr().Get(), body.ipos, rtol=SINGLE)
        if not body.inertia.all():
            assert (
                name == "stand"
                and not mass.GetPrincipalAxesAttr().IsAuthored()
                and not mass.GetDiagonalInertiaAttr().IsAuthored()
            )
            continue
        axes = mass.GetPrincipalAxesAttr().Get()
        turn = Rotation.from_quat([axes.real, *axes.imaginary], scalar_first=True).as_matrix()
        expected_turn = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
        found = turn @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ turn.T
        expected = expected_turn @ np.diag(body.inertia) @ expected_turn.T
        np.testing.assert_allclose(found, expected, atol=2 * SINGLE * body.inertia.max(), err_msg=name)


def extreme_points(prim: Usd.Prim) -> np.ndarray:
    """Return points of a shape's surface in its own frame, from its USD attributes: corners, poles, vertices."""
    value = lambda key: prim.GetAttribute(key).Get()  # noqa: E731
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T.astype(float)
    poles = np.vstack([np.eye(3), -np.eye(3)])
    kind = prim.GetTypeName()
    if kind == "Cube":
        return value("size") / 2 * corners
    if kind == "Sphere":
        return value("radius") * poles
    if kind == "Plane":
        return corners * [value("width") / 2, value("length") / 2, 0]
    assert value("axis") == "Z"
    if kind == "Cylinder":
        return np.vstack([poles[[0, 1, 3, 4]] * value("radius") + [0, 0, side * value("height") / 2] for side in (-1, 1)])
    assert kind == "Capsule"
    return poles * value("radius") + [0, 0, 1] * poles * value("height") / 2


def mujoco_extremes(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return the same points of MuJoCo's geom in the world at `qpos0`, from its own sizes."""
    state = mujoco.MjData(model)
    mujoco.mj_kinematics(model, state)
    geom, size = model.geom(name), model.geom(name).size
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T.astype(float)
    poles = np.vstack([np.eye(3), -np.eye(3)])
    points = {
        mujoco.mjtGeom.mjGEOM_BOX: corners * size,
        mujoco.mjtGeom.mjGEOM_SPHERE: poles * size[0],
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: poles * size,
        mujoco.mjtGeom.mjGEOM_PLANE: corners * [size[0], size[1], 0],
        mujoco.mjtGeom.mjGEOM_CAPSULE: poles * [size[0], size[0], size[0] + size[1]],
        mujoco.mjtGeom.mjGEOM_CYLINDER: corners[:, [2, 2, 2]] * 0
        + np.vstack([poles[[0, 1, 3, 4]] * size[0] + [0, 0, side * size[1]] for side in (-1, 1)]),
    }[mujoco.mjtGeom(int(geom.type[0]))]
    return points @ state.geom_xmat[geom.id].reshape(3, 3).T + state.geom_xpos[geom.id]


@pytest.mark.parametrize("name", ["floor", "block", "ball", "tube", "seen", "egg", "rod", "die"])
def test_shapes_are_where_mujoco_has_them(zoo, name):
    stage, model = zoo
    prim = named(stage, UsdGeom.Gprim)[name]
    pose = world_pose(prim)
    found = extreme_points(prim) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(found, mujoco_extremes(model, name), atol=1e-14)
    low, high = (np.array(corner) for corner in UsdGeom.Boundable(prim).GetExtentAttr().Get())
    np.testing.assert_allclose(low, extreme_points(prim).min(axis=0), rtol=SINGLE)
    np.testing.assert_allclose(high, extreme_points(prim).max(axis=0), rtol=SINGLE)


def test_a_plane_without_end_has_no_width(zoo):
    plane = UsdGeom.Plane(named(zoo[0])["endless"])
    assert not plane.GetWidthAttr().IsAuthored()
    assert not plane.GetLengthAttr().IsAuthored()


def test_meshes_come_out_at_their_original_place(tmp_path):
    points = np.array([[3.0, 1, 2], [7, 1, 2], [3, 4, 2.5], [3.5, 1, 9], [6, 3, 5]]) * 1e-3
    solid = trimesh.convex.convex_hull(points)  # far from its own origin, so that MuJoCo has to move it
    solid.export(tmp_path / "wedge.stl")
    geom = "<body name='a' pos='.1 0 0' quat='.5 .5 -.5 .5'><geom name='g' type='mesh' mesh='wedge' pos='0 .2 0' quat='0 1 0 1'/></body>"
    stage, _ = exported(
        tmp_path, world_of(geom, asset="<mesh file='wedge.stl'/>").replace("wedge.stl", str(tmp_path / "wedge.stl"))
    )
    mesh = UsdGeom.Mesh(named(stage)["g"])
    placed = matrix(np.array([0.1, 0, 0]), np.array([0.5, 0.5, -0.5, 0.5])) @ matrix(
        np.array([0, 0.2, 0]), np.array([0, 1.0, 0, 1])
    )
    expected = solid.vertices @ placed[:3, :3].T + placed[:3, 3]
    pose = world_pose(mesh.GetPrim())
    found = np.array(mesh.GetPointsAttr().Get()) @ pose[:3, :3].T + pose[:3, 3]
    gaps = np.linalg.norm(found[:, None] - expected[None], axis=2)
    assert max(gaps.min(axis=0).max(), gaps.min(axis=1).max()) < TOLERANCE
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    assert trimesh.Trimesh(found, faces).volume == pytest.approx(solid.volume, rel=1e-4)  # and the faces look outwards
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert UsdPhysics.MeshCollisionAPI(mesh.GetPrim()).GetApproximationAttr().Get() == "convexHull"


def test_colliders_masks_and_friction(zoo):
    stage, model = zoo
    for name, prim in named(stage, UsdGeom.Gprim).items():
        geom = model.geom(name)
        masks = [int(prim.GetAttribute(f"tgdsl:{key}").Get() or 0) for key in ("contype", "conaffinity")]
        if prim.GetAttribute("tgdsl:contype"):
            assert masks == [geom.contype[0], geom.conaffinity[0]] != [1, 1]
        else:
            assert (geom.contype[0], geom.conaffinity[0]) == (1, 1)
        assert prim.HasAPI(UsdPhysics.CollisionAPI) == (name not in ("seen", "egg"))
        if name not in ("seen", "egg"):
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
            surface = UsdPhysics.MaterialAPI(material.GetPrim())
            for friction in (surface.GetStaticFrictionAttr(), surface.GetDynamicFrictionAttr()):
                assert friction.Get() == pytest.approx(geom.friction[0], rel=SINGLE)
            assert not surface.GetDensityAttr().IsAuthored()
    materials = [prim for prim in stage.Traverse() if prim.IsA(UsdShade.Material)]
    assert len(materials) == 2  # 0.3 and MuJoCo's 1


def test_the_world_is_no_rigid_body(zoo):
    world = zoo[0].GetPrimAtPath("/zoo_of_shapes/world")
    assert not world.HasAPI(UsdPhysics.RigidBodyAPI)
    assert [child.GetName() for child in world.GetChildren()] == ["floor", "endless", "camp"]


def test_colours(zoo):
    prims = named(zoo[0], UsdGeom.Gprim)
    colours = {
        name: (g.GetDisplayColorAttr().Get()[0], g.GetDisplayOpacityAttr().Get())
        for name, g in ((n, UsdGeom.Gprim(p)) for n, p in prims.items())
    }
    np.testing.assert_allclose(colours["block"][0], [0.9, 0.1, 0.2], rtol=SINGLE)
    assert list(colours["block"][1]) == [0.5]
    assert colours["ball"] == (Gf.Vec3f(0, 1, 0), None)
    assert colours["egg"] == (Gf.Vec3f(0.5), None)


def test_sites(zoo):
    stage, model = zoo
    state = mujoco.MjData(model)
    mujoco.mj_kinematics(model, state)
    sites = {name: prim for name, prim in named(stage).items() if prim.GetAttribute("tgdsl:site").Get()}
    assert sites.keys() == {"camp", "mark"}
    for name, prim in sites.items():
        pose = world_pose(prim)
        np.testing.assert_allclose(pose[:3, 3], state.site(name).xpos, atol=1e-14)
        np.testing.assert_allclose(pose[:3, :3].ravel(), state.site(name).xmat, atol=1e-14)


def test_limits(zoo):
    joints = named(zoo[0], UsdPhysics.Joint)
    limits = {name: [p.GetAttribute(f"physics:{end}Limit").Get() for end in ("lower", "upper")] for name, p in joints.items()}
    np.testing.assert_allclose(limits["rail"], [-0.1, 0.3], rtol=SINGLE)
    np.testing.assert_allclose(limits["elbow"], np.rad2deg([-0.5, 2.0]), rtol=SINGLE)
    assert limits["spin"] == [-np.inf, np.inf]


def test_what_a_joint_does_of_itself(zoo):
    joints = named(zoo[0], UsdPhysics.Joint)
    keys = ("physxJoint:armature", "physxJoint:jointFriction", "tgdsl:damping")
    found = {name: [prim.GetAttribute(key).Get() for key in keys] for name, prim in joints.items()}
    assert found["rail"] == [pytest.approx(0.2), pytest.approx(0.3), None]
    assert found["elbow"] == [None, None, 0.03]
    assert found["socket"] == [None, None, 0.1]
    assert found["spin"] == [None, None, None]


def test_who_floats_and_who_is_led(zoo):
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
def test_drives_pull_as_mujocos_servos_do(tmp_path, text):
    """Seen from the joint: the target is the control over the gear; USD counts an angular drive in degrees."""
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
            own = (joints[joint.name].GetAttribute("tgdsl:damping").Get() or 0) / unit  # in MuJoCo no part of the servo's pull
            stiffness, damping = drive.GetStiffnessAttr().Get(), drive.GetDampingAttr().Get() - own
            effort = stiffness * (target - pos) - damping * speed if stiffness else damping * (target - speed)
            limit = drive.GetMaxForceAttr().Get()
            found = state.qfrc_actuator[joint.dofadr[0]]
            assert found == pytest.approx(np.clip(effort, -limit, limit), rel=1e-5, abs=1e-6)


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
    found = {name: [joints[name].GetAttribute(f"tgdsl:{key}").Get() for key in ("actuator", "ctrlrange")] for name in joints}
    assert found == {"rail": ["push", (-0.1, 0.3)], "elbow": ["bend", None], "socket": [None, None], "spin": ["whirl", None]}
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


FAMILY = """<mujoco><worldbody>
  <geom name='wall' type='box' size='.1 .1 .1'/>
  <body name='palm'><geom size='.1'/>
    <body name='pad'><geom size='.1'/></body>
    <body name='link1'><joint/><geom size='.1'/>
      <body name='plate'><geom size='.1'/><body name='screw'><geom size='.1'/></body></body>
      <body name='link2'><joint/><geom size='.1'/><body name='nail'><geom size='.1'/></body></body>
    </body>
    <body name='link3'><joint/><geom size='.1'/></body>
  </body>
  <body name='cube'><freejoint/><geom size='.1'/></body>
</worldbody><contact><exclude body1='link3' body2='palm'/><exclude body1='nail' body2='cube'/><exclude body1='world' body2='link1'/></contact></mujoco>"""


@pytest.mark.parametrize("option", ["", "<option><flag filterparent='disable'/></option>"], ids=["default", "parents_collide"])
def test_who_can_meet_whom_is_as_in_mujoco(tmp_path, option):
    stage, _ = exported(tmp_path, FAMILY.replace("<worldbody>", f"{option}<worldbody>"))
    apart = set()
    for prim in stage.Traverse():
        if prim.HasAPI(UsdPhysics.FilteredPairsAPI):
            for target in UsdPhysics.FilteredPairsAPI(prim).GetFilteredPairsRel().GetTargets():
                name = (
                    target.name if target.GetParentPath() == stage.GetDefaultPrim().GetPath() else target.GetParentPath().name
                )
                apart.add(frozenset((prim.GetName(), name)))
        if prim.IsA(UsdPhysics.Joint) and not UsdPhysics.Joint(prim).GetCollisionEnabledAttr().Get():
            rels = UsdPhysics.Joint(prim).GetBody0Rel(), UsdPhysics.Joint(prim).GetBody1Rel()
            apart.add(frozenset(target.name for rel in rels for target in rel.GetTargets()))
    model = load_model(tmp_path / "robot.xml")
    bodies = model.bodies[1:]
    pairs = [(a, b) for a in bodies for b in bodies if a < b]
    assert {frozenset(p) for p in pairs if not model.can_meet(*p)} == {p for p in apart if len(p) == 2 and "world" not in p}
    assert {p for p in apart if "world" in p} == {frozenset(("world", "link1"))}


def test_names_that_are_no_identifiers_and_names_that_meet(tmp_path):
    bodies = "<body name='a/b'><geom name='1st'/></body><body name='a_b'><geom name='a/b'/></body><body name='a b'><geom/><geom/></body>"
    bodies = bodies.replace("<geom", "<geom size='.1'") + "<body name='joints'/><body><geom size='.1'/></body>"
    stage, _ = exported(tmp_path, world_of(bodies))
    root = stage.GetDefaultPrim()
    assert root.GetName() == "MuJoCo_Model"
    found = {
        child.GetName(): child.GetAttribute("tgdsl:name").Get()
        for child in root.GetChildren()
        if child.HasAPI(UsdPhysics.RigidBodyAPI)
    }
    assert found == {"a_b": "a/b", "a_b_1": "a_b", "a_b_2": "a b", "joints_1": "joints", "body_5": None}
    geoms = {
        str(p.GetPath().MakeRelativePath(root.GetPath())): p.GetAttribute("tgdsl:name").Get()
        for p in stage.Traverse()
        if p.IsA(UsdGeom.Gprim)
    }
    assert geoms == {
        "a_b/_st": "1st",
        "a_b_1/a_b": "a/b",
        "a_b_2/sphere": None,
        "a_b_2/sphere_1": None,
        "body_5/sphere": None,
    }


@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usd"])
def test_same_input_same_bytes(tmp_path, ending):
    (tmp_path / "robot.xml").write_text(ZOO)
    contents = []
    for name in ("one", "two", "one"):
        export_model(tmp_path / "robot.xml", tmp_path / f"{name}{ending}")
        contents.append((tmp_path / f"{name}{ending}").read_bytes())
    assert contents[0] == contents[1] == contents[2]
    assert contents[0].startswith(b"#usda 1.0" if ending == ".usda" else b"PXR-USDC")
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(["robot.xml", f"one{ending}", f"two{ending}"])


def test_usd_finds_no_fault(pair):
    """USD's own rules for physics, geometry, materials and stages."""
    stage, _ = pair
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert "usdPhysicsValidators:PhysicsJointChecker" in {validator.GetMetadata().name for validator in validators}
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []


def test_urdf(tmp_path):
    inertial = "<inertial><mass value='1'/><inertia ixx='.1' iyy='.1' izz='.1' ixy='0' ixz='0' iyz='0'/></inertial>"
    link = "<visual><geometry><box size='.1 .2 .3'/></geometry></visual><collision><geometry><sphere radius='.1'/></geometry></collision>"
    (tmp_path / "arm.urdf").write_text(
        f"<robot name='arm'><link name='base'>{inertial}{link}</link><link name='hand'>{inertial}{link}</link>"
        "<joint name='wrist' type='revolute'><parent link='base'/><child link='hand'/><origin xyz='0 0 1' rpy='.1 .2 .3'/>"
        "<axis xyz='0 1 0'/><limit lower='-1' upper='1' effort='3' velocity='1'/></joint></robot>"
    )
    export_model(tmp_path / "arm.urdf", tmp_path / "arm.usda")
    stage, model = Usd.Stage.Open(str(tmp_path / "arm.usda")), load_model(tmp_path / "arm.urdf").compiled
    assert stage.GetDefaultPrim().GetName() == "arm"
    qpos = np.array([0.4])
    np.testing.assert_allclose(walk(stage, model, qpos)["hand"], mujoco_poses(model, qpos)["hand"], atol=TOLERANCE)


HINGES = "<body name='knot'><joint axis='1 0 0'/><joint axis='0 1 0'/><geom size='.1'/></body>"


@pytest.mark.parametrize(
    ("text", "out", "message"),
    [
        (
            world_of(HINGES),
            "r.usda",
            '{file}: body "knot" has 2 joints, and a body in USD has one to its parent; give each joint a body of its own',
        ),
        (
            world_of(
                "<geom name='hill' type='hfield' hfield='h'/>", asset="<hfield name='h' nrow='3' ncol='3' size='1 1 .1 .1'/>"
            ),
            "r.usda",
            '{file}: geom "hill" of body world is of type hfield, which USD does not have',
        ),
        (world_of("<geom size='.1'/>"), "r.obj", "{out}: USD files end in .usda, .usdc, .usd"),
        (world_of("<geom size='.1'/>"), "nowhere/r.usda", "{out}: cannot be written: No such file or directory"),
    ],
    ids=["joints", "hfield", "ending", "folder"],
)
def test_refusals(tmp_path, text, out, message):
    (tmp_path / "robot.xml").write_text(text)
    with pytest.raises(RobotError) as caught:
        export_model(tmp_path / "robot.xml", tmp_path / out)
    assert str(caught.value) == message.format(file=tmp_path / "robot.xml", out=tmp_path / out)
    assert [file.name for file in tmp_path.iterdir()] == ["robot.xml"]


def test_without_usd_core(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(RobotError, match="pip install usd-core"):
        export_model(XHAND1, tmp_path / "hand.usda")


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    exported(tmp_path, world_of("<geom size='.1'/>"))
    before = (tmp_path / "robot.usda").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(RobotError) as caught:
        export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    assert str(caught.value) == f"{tmp_path / 'robot.usda'}: cannot be written: No space left on device"
    assert (tmp_path / "robot.usda").read_bytes() == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["robot.usda", "robot.xml"]


TWO = "<body name='a'><joint name='j' {joint}/><geom size='.1'/></body><body name='b' pos='1 0 0'><joint name='k' type='ball'/><geom size='.1'/></body>"


@pytest.mark.parametrize(
    ("bodies", "rest", "messages"),
    [
        (
            TWO,
            "<actuator><motor name='m' joint='j'/></actuator>",
            ['actuator "m" is a motor, which USD has no drive for: left out'],
        ),
        (
            TWO,
            "<actuator><position joint='k'/></actuator>",
            [
                "unnamed actuator 0 is no position or velocity servo of a hinge or slide joint, which USD has no drive for: left out"
            ],
        ),
        (
            TWO,
            "<actuator><general name='g' joint='j' biastype='affine' gainprm='2' biasprm='1 -2 0'/></actuator>",
            ['actuator "g" is no position or velocity servo of a hinge or slide joint, which USD has no drive for: left out'],
        ),
        (
            TWO,
            "<actuator><position name='p' joint='j' forcerange='-1 2'/><velocity name='v' joint='j'/></actuator>",
            [
                'actuator "p" has the force range -1 2, and USD\'s are symmetric: the larger is used',
                'actuator "v" is not the first of its joint, and USD has one drive for each: left out',
            ],
        ),
        (
            TWO,
            "<equality><connect body1='a' body2='b' anchor='0 0 0'/><weld body1='a' body2='b'/></equality><sensor><clock/></sensor>"
            "<tendon><fixed><joint joint='j' coef='1'/></fixed></tendon><keyframe><key time='1'/></keyframe>",
            [
                f"USD holds no {k}: {n} left out"
                for k, n in (("equality constraints", 2), ("tendons", 1), ("sensors", 1), ("keyframes", 1))
            ],
        ),
        (TWO.replace("{joint}", "stiffness='2'"), "", ["USD holds no springs of joints: 1 left out"]),
        (
            "<body name='a'><joint/><geom size='.1'/><body name='dummy'/></body>",
            "",
            ["USD takes a mass of 0 for one that is not given: dummy"],
        ),
        (
            "<geom name='egg' type='ellipsoid' size='.1 .2 .3'/>",
            "",
            ["USD's physics has no ellipsoids, and leaves out or rounds: egg"],
        ),
        (
            "<body name='shelf'><geom type='plane' size='1 1 1'/></body>",
            "",
            ["USD's physics has no planes on bodies, and leaves out: unnamed geom 0"],
        ),
    ],
    ids=["motor", "ball", "general", "second", "kinds", "springs", "massless", "ellipsoid", "plane"],
)
def test_what_is_left_out_is_said(tmp_path, bodies, rest, messages):
    (tmp_path / "robot.xml").write_text(world_of(bodies.replace("{joint}", ""), rest))
    with pytest.warns(UserWarning, match="robot.xml: ") as caught:
        export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    assert [str(warning.message) for warning in caught] == [f"{tmp_path / 'robot.xml'}: {message}" for message in messages]
    assert (tmp_path / "robot.usda").exists()
