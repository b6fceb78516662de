"""Round trips through USD: the stage compiles to the model of the robot file."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Usd
from scipy.spatial.transform import Rotation

from tgdsl.formats.robot import export_model, load_model
from tgdsl.formats.usd.reader import usd_to_mjcf

XHAND1 = Path(__file__).parents[3] / "robots" / "xhand1" / "xhand1_right.xml"
TOLERANCE = 1e-6
"""USD keeps joint frames, limits, masses and vertices in float32: relative errors of 6e-8, along chains of a few bodies."""

SHAPES = """
<mujoco model="shapes">
  <compiler angle="radian"/>
  <option gravity="1 -2 -9"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 3 .1" friction=".3"/>
    <body name="base/plate" pos=".1 .2 .3" quat=".9 .1 -.3 .2">
      <inertial pos=".01 -.02 .03" quat=".8 .1 .2 .5" mass="1.5" diaginertia=".03 .02 .04"/>
      <geom name="block" type="box" size=".01 .02 .03" pos=".1 0 .2" quat=".3 .5 -.1 .9" rgba="1 0 0 .5"/>
      <body name="base plate" pos="0 .1 0" quat=".7 0 .7 .1">
        <joint name="rail" type="slide" axis="-1 .2 .3" pos=".01 .02 .03" range="-.1 .3" ref=".05" armature=".2" frictionloss=".3"/>
        <geom name="ball" type="sphere" size=".02" pos="0 .03 0" friction=".3" group="4"/>
        <body name="arm" pos=".2 0 .1" quat=".1 .9 .2 -.3">
          <joint name="elbow" axis="-1 1e-9 0" pos="0 .01 -.02" ref=".7" range="-.5 2"/>
          <geom name="tube" type="capsule" size=".01 .05" pos="0 0 .1"/>
          <geom name="seen" type="cylinder" size=".02 .03" contype="0" conaffinity="0" group="1"/>
          <body name="wrist" pos="0 .05 0" quat=".6 .1 .2 .7">
            <joint name="socket" type="ball" pos="0 .02 .01"/>
            <geom name="egg" type="ellipsoid" size=".01 .02 .03" contype="0" conaffinity="0"/>
            <geom name="core" size=".01"/>
            <body name="nail" pos=".01 0 0" quat="0 1 1 0"><geom name="rod" type="cylinder" size=".01 .04"/></body>
            <body name="thumb" pos="0 0 .1"><joint name="spin" axis="0 1 2"/><geom name="tip" size=".01"/></body>
          </body>
        </body>
      </body>
    </body>
    <body name="cube" pos="1 1 1" quat=".4 .3 .2 .1"><freejoint/><geom name="die" type="box" size=".1 .1 .1"/></body>
    <body name="target" pos="0 0 2" mocap="true"><geom name="mark" size=".01" contype="0" conaffinity="0"/></body>
  </worldbody>
  <contact><exclude body1="cube" body2="arm"/></contact>
  <actuator>
    <position joint="rail" kp="30" kv="2" forcerange="-5 5"/>
    <velocity joint="spin" kv=".7" forcerange="-2 2"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module", params=["shapes", "hand"])
def pair(request, tmp_path_factory) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Return a model before and after the round trip."""
    folder = tmp_path_factory.mktemp(request.param)
    file = XHAND1
    if request.param == "shapes":
        file = folder / "shapes.xml"
        file.write_text(SHAPES)
    export_model(file, folder / "out.usda")
    back = mujoco.MjModel.from_xml_string(usd_to_mjcf(folder / "out.usda"))
    return mujoco.MjModel.from_xml_path(str(file)), back


def names(model: mujoco.MjModel, kind: str) -> set[str]:
    count = {"body": model.nbody, "geom": model.ngeom, "joint": model.njnt}[kind]
    return {getattr(model, kind)(i).name for i in range(count)} - {""}


@pytest.mark.parametrize("kind", ["body", "geom", "joint"])
def test_names(pair, kind):
    assert names(pair[0], kind) == names(pair[1], kind)


def test_masses_and_inertia_tensors(pair):
    for name in names(pair[0], "body") - {"world", "target"}:
        tensors = []
        for body in (model.body(name) for model in pair):
            turn = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
            tensors.append(turn @ np.diag(body.inertia) @ turn.T)
        first, second = (model.body(name) for model in pair)
        np.testing.assert_allclose(second.mass, first.mass, rtol=TOLERANCE)
        np.testing.assert_allclose(second.ipos, first.ipos, atol=TOLERANCE)
        np.testing.assert_allclose(tensors[1], tensors[0], atol=TOLERANCE * first.inertia.max())


def test_joints(pair):
    for name in names(pair[0], "joint"):
        first, second = (model.joint(name) for model in pair)
        assert second.type[0] == first.type[0]
        assert second.limited[0] == first.limited[0]
        np.testing.assert_allclose(second.range, first.range, rtol=TOLERANCE, atol=TOLERANCE)
        for key in ("armature", "frictionloss"):
            np.testing.assert_allclose(getattr(second, key), getattr(first, key), rtol=TOLERANCE)


def test_the_same_joint_positions_give_the_same_poses(pair):
    """Poses of bodies, and points of geoms: ends of axes and vertices of meshes."""
    generator = np.random.default_rng(0)
    for _ in range(20):
        states = [mujoco.MjData(model) for model in pair]
        for joint in names(pair[0], "joint"):
            joint_model = pair[0].joint(joint)
            value = generator.uniform(*(joint_model.range if joint_model.limited[0] else (-3, 3)), size=1)
            if joint_model.type[0] == mujoco.mjtJoint.mjJNT_BALL:
                value = generator.normal(size=4)
            for state in states:
                state.joint(joint).qpos[:] = value
        for model, state in zip(pair, states, strict=True):
            mujoco.mj_kinematics(model, state)
        for body in names(pair[0], "body"):
            np.testing.assert_allclose(states[1].body(body).xpos, states[0].body(body).xpos, atol=TOLERANCE, err_msg=body)
            np.testing.assert_allclose(states[1].body(body).xmat, states[0].body(body).xmat, atol=TOLERANCE, err_msg=body)
        for geom in names(pair[0], "geom"):
            positions = [points(model, state, geom) for model, state in zip(pair, states, strict=True)]
            np.testing.assert_allclose(positions[1], positions[0], atol=TOLERANCE, err_msg=geom)


def points(model: mujoco.MjModel, state: mujoco.MjData, name: str) -> np.ndarray:
    """Return the ends of a geom's axes in the world, or its vertices in file order [m]."""
    geom = model.geom(name)
    local = np.vstack([np.diag(geom.size), np.zeros(3)])
    if geom.type[0] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(geom.dataid[0])
        local = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    elif geom.type[0] == mujoco.mjtGeom.mjGEOM_PLANE:
        local[2] = 0  # a plane's third size is the spacing of its drawn grid
    return local @ state.geom(name).xmat.reshape(3, 3).T + state.geom(name).xpos


def test_geoms_keep_their_kind_size_group_friction_and_colour(pair):
    for name in names(pair[0], "geom"):
        first, second = (model.geom(name) for model in pair)
        assert second.type[0] == first.type[0]
        assert second.group[0] == first.group[0]
        assert (second.contype[0], second.conaffinity[0]) == (first.contype[0], first.conaffinity[0])
        np.testing.assert_allclose(second.friction[0], first.friction[0], rtol=TOLERANCE)
        np.testing.assert_allclose(second.rgba, first.rgba, rtol=TOLERANCE)


def test_exclusions_are_kept(pair):
    """The second model excludes at least the pairs of the first."""
    exclusions = []
    for model in pair:
        signatures = model.exclude_signature.tolist()
        exclusions.append({frozenset((model.body(s >> 16).name, model.body(s & 0xFFFF).name)) for s in signatures})
    assert exclusions[0] <= exclusions[1]


WELDED = """
<mujoco><worldbody><body name="base"><geom size=".01"/><body name="plate"><geom size=".01"/>
  <body name="link"><joint axis="0 1 0"/><geom size=".01"/><body name="cover"><geom size=".01"/></body>
    <body name="tip"><joint axis="0 1 0"/><geom size=".01"/><body name="pad"><geom size=".01"/></body></body></body>
</body></body></worldbody>{contact}</mujoco>
"""


@pytest.mark.parametrize("pairs", [(), (("pad", "plate"),)])
def test_no_exclusions_are_added(tmp_path, pairs):
    """USD needs exclusions for pairs that MuJoCo never collides; they are removed on the way back."""
    contact = "".join(f'<exclude body1="{one}" body2="{two}"/>' for one, two in pairs)
    (tmp_path / "robot.xml").write_text(WELDED.format(contact=f"<contact>{contact}</contact>"))
    export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    first, second = (load_model(tmp_path / f"robot.{ending}") for ending in ("xml", "usda"))
    assert second.compiled.nexclude == len(pairs)
    assert second.compiled.opt.disableflags == first.compiled.opt.disableflags
    for one in first.bodies[1:]:
        for two in first.bodies[1:]:
            assert first.can_collide(one, two) == second.can_collide(one, two)


@pytest.mark.parametrize("of_joint", ["", "-10 10", "-10 4", "-300 300"])
@pytest.mark.parametrize("of_actuator", ["", "-200 200", "-5 5"])
def test_force_limits_of_joint_and_actuator_stay_separate(tmp_path, of_joint, of_actuator):
    limits = [f'{key}="{text}"' if text else "" for key, text in (("actuatorfrcrange", of_joint), ("forcerange", of_actuator))]
    body = f'<body><joint name="j" axis="0 1 0" {limits[0]}/><geom size=".01"/></body>'
    actuator = f'<actuator><position joint="j" kp="5" gear="2" {limits[1]}/></actuator>'
    (tmp_path / "robot.xml").write_text(f"<mujoco><worldbody>{body}</worldbody>{actuator}</mujoco>")
    export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    first, second = (load_model(tmp_path / f"robot.{ending}").compiled for ending in ("xml", "usda"))
    for field in ("jnt_actfrclimited", "jnt_actfrcrange", "actuator_forcelimited", "actuator_forcerange"):
        np.testing.assert_allclose(getattr(second, field), getattr(first, field), rtol=1e-12, err_msg=field)


def test_the_time_step_is_written_even_if_it_is_mujocos_default(tmp_path):
    """Another program's schema on the scene may have another default."""
    (tmp_path / "robot.xml").write_text(WELDED.format(contact=""))
    export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    stage = Usd.Stage.Open(str(tmp_path / "robot.usda"))
    stage.GetPrimAtPath("/physicsScene").AddAppliedSchema("NewtonSceneAPI")
    stage.GetRootLayer().Save()
    assert load_model(tmp_path / "robot.usda").compiled.opt.timestep == 0.002


def test_servos(pair):
    """The joint's damping returns as part of the drive's; their sum is unchanged."""
    first, second = ({model.joint(model.actuator_trnid[i, 0]).name: i for i in range(model.nu)} for model in pair)
    assert first.keys() == second.keys()
    for name, actuator in first.items():
        index, second_model = second[name], pair[1]
        np.testing.assert_allclose(
            second_model.actuator_biasprm[index, 1], pair[0].actuator_biasprm[actuator, 1], rtol=TOLERANCE
        )
        np.testing.assert_allclose(
            second_model.actuator_forcerange[index], pair[0].actuator_forcerange[actuator], rtol=TOLERANCE
        )
        dampings = [m.joint(name).damping[0] - m.actuator_biasprm[i, 2] for m, i in zip(pair, (actuator, index), strict=True)]
        np.testing.assert_allclose(dampings[1], dampings[0], rtol=TOLERANCE)


def test_gravity(pair):
    np.testing.assert_allclose(pair[1].opt.gravity, pair[0].opt.gravity, rtol=TOLERANCE)
