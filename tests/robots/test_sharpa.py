"""The Sharpa Wave: joints, masses, drives, counts, surfaces, and the depth of a cube on a fingertip."""

import hashlib
import runpy
from pathlib import Path

import igl
import mujoco
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.compiler.pipeline import compile_document
from tgdsl.formats.robot import load_model

FOLDER = Path(__file__).resolve().parents[2] / "robots" / "sharpa"
MODEL = FOLDER / "sharpa_right.xml"
COUNTS = {
    "low": {"hand": 98, "tips": 45, "fingers": 89, "palm": 9},
    "med": {"hand": 206, "tips": 70, "fingers": 190, "palm": 16},
    "high": {"hand": 781, "tips": 245, "fingers": 660, "palm": 121},
}
"""Chung et al., Tactile Genesis, appendix: active probes per resolution and placement."""
PER_LINK = {
    "low": {"elastomer": 9, "MP": 4, "PP": 4, "thumb_MC": 4, "pinky_MC": 4, "hand_C_MC": 9},
    "med": {"elastomer": 14, "MP": 12, "PP": 12, "thumb_PP": 9, "thumb_MC": 9, "pinky_MC": 6, "hand_C_MC": 16},
    "high": {"index_elastomer": 47, "middle_elastomer": 46, "ring_elastomer": 46, "pinky_elastomer": 47, "thumb_elastomer": 59}
    | {"MP": 36, "PP": 42, "thumb_PP": 20, "thumb_MC": 30, "pinky_MC": 53, "hand_C_MC": 121},
}
"""The same per kind of link; a finger's entry overrides that of all fingers."""
FINGER = [
    ("MCP_FE", -0.17453, 1.5708, 1.864),
    ("MCP_AA", -0.3491, 0.3491, 1.864),
    ("PIP", 0.0, 1.7453, 0.638),
    ("DIP", 0.0, 1.3963, 0.189369),
]
JOINTS = [
    ("thumb_CMC_FE", -0.1745, 1.9199, 3.3),
    ("thumb_CMC_AA", -0.3491, 0.3491, 3.3),
    ("thumb_MCP_FE", -0.5236, 1.3963, 1.864),
    ("thumb_MCP_AA", -0.3491, 0.3491, 1.864),
    ("thumb_IP", 0.0, 1.7453, 0.638),
    *((f"{finger}_{name}", *rest) for finger in ("index", "middle", "ring") for name, *rest in FINGER),
    ("pinky_CMC", 0.0, 0.2618, 0.5285),
    *((f"pinky_{name}", *rest) for name, *rest in FINGER),
]
MASSES = {"hand_C_MC": 0.72045, "thumb_MC": 0.116, "thumb_PP": 0.04955, "thumb_DP": 0.003886, "thumb_elastomer": 0.0021}
MASSES |= {"pinky_MC": 0.12541, "index_PP": 0.04138, "index_MP": 0.02509, "index_DP": 0.003002, "index_elastomer": 0.0011}
SCENE = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" gravity="0 0 0"/>
  <asset><model name="sharpa" file="{model}"/></asset>
  <worldbody>
    <frame pos="0 0 0.1"><attach model="sharpa" body="right_hand_C_MC" prefix=""/></frame>
    <body name="cube" pos="0.0247 0.0303 0.2930">
      <joint name="push" type="slide" axis="-1 0 0" damping="5"/>
      <geom type="box" size="0.008 0.008 0.008" mass="0.2"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="push" ctrlrange="0 2"/></actuator>
</mujoco>
"""
SPEC = """
tgdsl: 1
robot: {{model: "{model}", layout: "{layout}"}}
{rest}
resolution: low
sensors:
  depth: {{kind: contact_depth, links: hand, feels: [{feels}]}}
"""


@pytest.fixture(scope="module")
def hand():
    return mujoco.MjModel.from_xml_path(str(MODEL))


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    """Return a document of the hand with a cube that is pushed at the index finger's tip."""
    folder = tmp_path_factory.mktemp("sharpa")
    (folder / "scene.xml").write_text(SCENE.format(model=MODEL))
    rest = "scene: {model: scene.xml}\nobjects: {cube: {body: cube}}"
    layout = FOLDER / "layout.yaml"
    (folder / "touch.yaml").write_text(SPEC.format(model=MODEL, layout=layout, rest=rest, feels="cube"))
    return folder / "touch.yaml"


def inertia(hand, data):
    """Return the inertia at each joint [kg·m²]."""
    matrix = np.zeros((hand.nv, hand.nv))
    mujoco.mj_fullM(hand, data, matrix)
    return np.diag(matrix)


def test_joints_and_limits_match_the_hand(hand):
    names = [hand.joint(i).name for i in range(hand.njnt)]
    assert names == [f"right_{name}" for name, *_ in JOINTS]
    assert [hand.actuator(i).name for i in range(hand.nu)] == names
    limits = [(low, high) for _, low, high, _ in JOINTS]
    np.testing.assert_allclose(hand.jnt_range, limits, atol=1e-9)
    np.testing.assert_allclose(hand.actuator_ctrlrange, limits, atol=1e-9)
    np.testing.assert_allclose(hand.actuator_forcerange[:, 1], [effort for *_, effort in JOINTS])


def test_masses_match_the_hand(hand):
    for name, mass in MASSES.items():
        assert hand.body(f"right_{name}").mass[0] == pytest.approx(mass, rel=1e-6), name
    assert hand.body_mass.sum() == pytest.approx(1.29969, abs=1e-5)


def test_the_straight_fingers_stand_side_by_side(hand):
    """A finger's tip is 47 + 31.5 + 26.009 mm from its root, along the palm's z."""
    data = mujoco.MjData(hand)
    mujoco.mj_forward(hand, data)
    tips = {name: data.site(f"right_{name}_fingertip").xpos for name in ("index", "middle", "ring", "pinky")}
    roots = {"index": (0.001, 0.0303, 0.0957), "middle": (0, 0.01, 0.0987), "ring": (0.0015, -0.0103, 0.0927)}
    roots["pinky"] = (0.003, -0.0311, 0.0867)
    for name, root in roots.items():
        np.testing.assert_allclose(tips[name], np.add(root, (0, 0, 0.104509)), atol=1e-9)
    np.testing.assert_allclose(data.site("right_index_fingertip").xmat.reshape(3, 3)[:, 2], (0, 0, 1), atol=1e-7)
    assert data.ncon == 0


def test_drives_are_critically_damped_within_a_factor_of_two(hand):
    data = mujoco.MjData(hand)
    for pose in (np.zeros(hand.nq), hand.jnt_range.mean(axis=1), 0.9 * hand.jnt_range[:, 1]):
        data.qpos = pose
        mujoco.mj_forward(hand, data)
        ratio = -hand.actuator_biasprm[:, 2] / (2 * np.sqrt(hand.actuator_gainprm[:, 0] * inertia(hand, data)))
        assert ((ratio > 0.5) & (ratio < 2)).all()


@pytest.mark.parametrize("timestep", [0.002, 0.005])
def test_drives_reach_their_targets_and_stay(timestep):
    hand = mujoco.MjModel.from_xml_path(str(MODEL))
    hand.opt.timestep = timestep
    data = mujoco.MjData(hand)
    target = np.where(hand.jnt_range[:, 0] < -0.3, 0.0, 0.4 * hand.jnt_range[:, 1])
    data.ctrl = target
    for _ in range(round(1.5 / timestep)):
        mujoco.mj_step(hand, data)
    assert np.abs(data.qpos - target).max() < np.deg2rad(1)
    assert np.abs(data.qvel).max() < 1e-3


@pytest.mark.parametrize("timestep", [0.002, 0.005])
def test_drives_stay_stable_for_random_targets(timestep):
    hand = mujoco.MjModel.from_xml_path(str(MODEL))
    hand.opt.timestep = timestep
    data = mujoco.MjData(hand)
    rng = np.random.default_rng(0)
    for _ in range(20):
        data.ctrl = rng.uniform(*hand.jnt_range.T)
        for _ in range(round(0.1 / timestep)):
            mujoco.mj_step(hand, data)
            assert np.abs(data.qvel).max() < 40
    assert not any(warning.number for warning in data.warning)


@pytest.mark.parametrize("down", [(0, 0, -1), (0, 0, 1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
def test_drives_hold_against_gravity(down):
    hand = mujoco.MjModel.from_xml_path(str(MODEL))
    hand.opt.gravity = 9.81 * np.array(down)
    data = mujoco.MjData(hand)
    for _ in range(500):
        mujoco.mj_step(hand, data)
    assert np.abs(data.qpos).max() < np.deg2rad(1.5)


def test_surfaces_are_closed_and_reproducible():
    assets = sorted((FOLDER / "assets").glob("*.stl"))
    assert len(assets) == 13
    hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in assets}
    for path in assets:
        mesh = trimesh.load(path, force="mesh")
        assert isinstance(mesh, trimesh.Trimesh)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, path.name
        assert len(mesh.faces) <= 1200, path.name
    runpy.run_path(str(FOLDER / "make_meshes.py"), run_name="__main__")
    assert {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in assets} == hashes


@pytest.mark.parametrize("resolution", ["med", *(pytest.param(name, marks=pytest.mark.slow) for name in ("low", "high"))])
def test_counts_match_the_paper(document, resolution):
    plan = compile_document(document, {"resolution": resolution}).plan
    layout = plan.layout
    per_link = {link.name: int((layout.link_id == i).sum()) for i, link in enumerate(plan.layout.links)}
    assert {group: sum(per_link[name] for name in names) for group, names in plan.layout.groups.items()} == COUNTS[resolution]
    expected = PER_LINK[resolution]
    for name, count in per_link.items():
        whole = name.removeprefix("right_")
        assert count == expected.get(whole, expected.get(whole.partition("_")[2])), name
    assert len(per_link) == 17
    np.testing.assert_allclose(layout.radius, 3e-3 if resolution == "high" else 4e-3)
    np.testing.assert_allclose(np.linalg.norm(layout.normal, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose((layout.normal * layout.tangent).sum(axis=1), 0, atol=1e-12)


@pytest.fixture(scope="module")
def high(document):
    """Return the plan at the finest resolution."""
    return compile_document(document, {"resolution": "high"}).plan


@pytest.mark.slow
def test_taxels_lie_on_the_surfaces_and_near_the_hulls(high):
    """Hulls may miss a little of a pad; only the palm's hollow lies inside one."""
    layout, robot = high.layout, load_model(MODEL)
    for i, link in enumerate(layout.links):
        pos = layout.pos[layout.link_id == i]
        geoms = robot.touchable(link.body)
        surface = robot.surface(geoms)
        squared, *_ = igl.point_mesh_squared_distance(pos, surface.vertices, surface.faces)
        assert np.sqrt(squared).max() < 1e-8, link.name
        hulls = [robot.hull(geom) for geom in geoms]
        signed = np.min(
            [
                igl.signed_distance(pos, hull.vertices @ geom.rotation.T + geom.pos, hull.faces)[0]
                for hull, geom in zip(hulls, geoms, strict=True)
            ],
            axis=0,
        )
        assert signed.max() < 0.6e-3, link.name
        assert signed.min() > (-2.8e-3 if link.name == "right_hand_C_MC" else -0.4e-3), link.name


@pytest.mark.slow
def test_pads_face_away_from_the_bone(high):
    """In the straight hand, taxels of fingers and palm face out of the palm, the thumb's along its pad."""
    layout, hand = high.layout, mujoco.MjModel.from_xml_path(str(MODEL))
    data = mujoco.MjData(hand)
    mujoco.mj_forward(hand, data)
    thumb = data.body("right_thumb_DP").xmat.reshape(3, 3)[:, 1]
    for i, link in enumerate(layout.links):
        on_link = layout.link_id == i
        normal = layout.normal[on_link] @ data.body(link.body).xmat.reshape(3, 3).T
        outward = thumb if "thumb" in link.name else np.array([1.0, 0.0, 0.0])
        assert (normal @ outward).min() > 0.1, link.name
        assert (normal @ outward).mean() > 0.75, link.name
        if link.name.endswith("elastomer"):
            bone = data.body(link.name.replace("elastomer", "DP"))
            axis, out = bone.xmat.reshape(3, 3)[:, 0], bone.xmat.reshape(3, 3)[:, 1]
            pos = data.body(link.body).xpos + layout.pos[on_link] @ data.body(link.body).xmat.reshape(3, 3).T
            assert ((pos - bone.xpos) @ axis).min() > 0.008, link.name
            assert ((pos - bone.xpos) @ out).mean() > 0.001, link.name


@pytest.mark.slow
def test_depths_of_a_pressed_cube_match_its_pose(document):
    """Depth is radius minus distance to the box, for every taxel of a touching link."""
    touch = tgdsl.compile(document, dtype=torch.float64)
    sim = tgdsl.simulate(touch, num_envs=1, substeps=5)
    push = np.zeros((1, sim.model.nu))
    push[0, sim.model.actuator("push").id] = 1.0
    rest_depth = touch(sim.state())["depth"]
    for _ in range(60):
        sim.step(push)
    state = sim.state()
    depth = touch(state)["depth"][0, :, 0].numpy()
    rows = {name: i for i, name in enumerate(touch.inputs.bodies)}
    pos, turn = state.body_pos[0].numpy(), Rotation.from_quat(state.body_quat[0].numpy(), scalar_first=True)
    table = touch.taxels["depth"]
    body = [rows[name] for name in table["body"]]
    positions = turn[rows["cube"]].inv().apply(pos[body] + turn[body].apply(table["pos"]) - pos[rows["cube"]])
    beyond = np.abs(positions) - 0.008
    distance = np.where((beyond > 0).any(axis=1), np.linalg.norm(np.maximum(beyond, 0), axis=1), beyond.max(axis=1))
    np.testing.assert_allclose(depth, np.maximum(table["radius"] - distance, 0), atol=1e-14)
    assert set(table["link"][depth > 0]) == {"right_index_elastomer"}
    assert (depth > 0).sum() >= 3
    assert depth.max() == pytest.approx(4e-3, abs=0.5e-3)
    assert rest_depth.max() < depth.max()
