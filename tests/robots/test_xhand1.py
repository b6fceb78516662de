"""The XHand1: counts, surfaces, and depths of a squeezed cube."""

import hashlib
import runpy
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.compiler.pipeline import compile_document
from tgdsl.runtime.rollout import scripted_controls

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "xhand1_palm.yaml"
COUNTS = {
    "med": {"hand": 199, "tips": 100, "fingers": 164, "palm": 35},
    "high": {"hand": 667, "tips": 224, "fingers": 448, "palm": 219},
}
"""Chung et al., Tactile Genesis, appendix: active probes per resolution and placement; test_left_hands.py has the coarsest."""
JOINTS = [
    ("thumb_bend_joint", 0.0, 1.832),
    ("thumb_rota_joint1", -0.698, 1.57),
    ("thumb_rota_joint2", 0.0, 1.57),
    ("index_bend_joint", -0.174, 0.174),
    *((f"{name}_joint{i}", 0.0, 1.919) for name in ("index", "mid", "ring", "pinky") for i in (1, 2)),
]


@pytest.fixture(scope="module")
def hand():
    return mujoco.MjModel.from_xml_path(str(ROOT / "robots" / "xhand1" / "xhand1_right.xml"))


def test_joints_limits_and_masses_match_the_hand(hand):
    names = [hand.joint(i).name for i in range(hand.njnt)]
    assert names == [f"right_hand_{name}" for name, _, _ in JOINTS]
    assert [hand.actuator(i).name for i in range(hand.nu)] == names
    np.testing.assert_allclose(hand.jnt_range, [(low, high) for _, low, high in JOINTS], atol=1e-9)
    strong = [1.1 if name.endswith(("bend_joint", "joint1")) and "index_bend" not in name else 0.4 for name, _, _ in JOINTS]
    np.testing.assert_allclose(hand.actuator_forcerange[:, 1], strong)
    assert hand.body_mass.sum() == pytest.approx(1.1015, abs=1e-3)


def test_surfaces_are_closed_and_reproducible(tmp_path):
    assets = sorted((ROOT / "robots" / "xhand1" / "assets").glob("*.stl"))
    assert len(assets) == 7
    hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in assets}
    for path in assets:
        mesh = trimesh.load(path, force="mesh")
        assert isinstance(mesh, trimesh.Trimesh)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, path.name
    runpy.run_path(str(ROOT / "robots" / "xhand1" / "make_meshes.py"), run_name="__main__")
    assert {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in assets} == hashes


@pytest.mark.parametrize("resolution", ["med", pytest.param("high", marks=pytest.mark.slow)])
def test_counts_match_the_paper(resolution):
    plan = compile_document(EXAMPLE, {"resolution": resolution}).plan
    layout = plan.layout
    per_link = {link.name: int((layout.link_id == i).sum()) for i, link in enumerate(plan.layout.links)}
    assert {group: sum(per_link[name] for name in names) for group, names in plan.layout.groups.items()} == COUNTS[resolution]
    np.testing.assert_allclose(np.linalg.norm(layout.normal, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose((layout.normal * layout.tangent).sum(axis=1), 0, atol=1e-12)


@pytest.fixture(scope="module")
def squeezed():
    """Return the module and its readings of two environments, after resting and after squeezing."""
    touch = tgdsl.compile(EXAMPLE, dtype=torch.float64)
    sim = tgdsl.simulate(touch, num_envs=2, substeps=5, keyframe="rest")
    controls = scripted_controls(sim.model, ("rest", "squeeze"), 1.0, sim.control_step)
    readings = {}
    for i, control in enumerate(controls):
        sim.step(control)
        if i == len(controls) // 3 - 1 or i == len(controls) - 1:
            state = sim.state()
            readings["rest" if "rest" not in readings else "squeeze"] = (touch(state), in_cube(touch, state))
    return touch, readings


def in_cube(touch, state):
    """Return the taxels of environment 0 in the cube's frame [m], from the state's poses."""
    rows = {name: i for i, name in enumerate(touch.inputs.bodies)}
    pos = state.body_pos[0].numpy()
    turn = Rotation.from_quat(state.body_quat[0].numpy(), scalar_first=True)
    table = touch.taxels["depth"]
    body = [rows[name] for name in table["body"]]
    world = pos[body] + turn[body].apply(table["pos"])
    return turn[rows["cube"]].inv().apply(world - pos[rows["cube"]])


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["rest", "squeeze"])
def test_depths_match_the_pose_of_the_cube(squeezed, moment):
    """Depth is radius minus distance to the box, for every taxel of a touching link."""
    touch, readings = squeezed
    reading, positions = readings[moment]
    depth = reading["depth"][0, :, 0].numpy()
    beyond = np.abs(positions) - 0.02
    distance = np.where((beyond > 0).any(axis=1), np.linalg.norm(np.maximum(beyond, 0), axis=1), beyond.max(axis=1))
    expected = np.maximum(touch.taxels["depth"]["radius"] - distance, 0)
    is_felt = depth > 0
    assert is_felt.sum() >= 9
    links = touch.taxels["depth"]["link"]
    touching = np.isin(links, links[is_felt])
    np.testing.assert_allclose(depth[touching], expected[touching], atol=1e-14)
    assert {"right_hand_link"} <= set(links[is_felt])
    if moment == "squeeze":
        assert {"right_hand_thumb_rota_link2", "right_hand_index_rota_link2"} <= set(links[is_felt])


@pytest.mark.slow
def test_squeezing_is_felt_more_than_resting(squeezed):
    _, readings = squeezed
    rest, squeeze = (readings[moment][0]["touch"][0, :, :3].norm(dim=1) for moment in ("rest", "squeeze"))
    assert squeeze.sum() > rest.sum() > 0
    assert (squeeze > 0).sum() > (rest > 0).sum()


@pytest.mark.slow
def test_equal_environments_stay_equal(squeezed):
    for reading, *_ in squeezed[1].values():
        for value in reading.values():
            torch.testing.assert_close(value[0], value[1], rtol=0, atol=0)
