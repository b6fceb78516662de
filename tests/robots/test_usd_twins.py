"""Robots in USD feel like their MJCF twins: the same layouts, and the same readings during a squeeze.

The models differ by the order of floating-point operations: 1e-16, which contacts amplify to 1e-12 within a second.
"""

import runpy
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.compiler.resolve import resolve
from tgdsl.formats.robot import export_model, load_model
from tgdsl.schema.load import load
from tgdsl.sensors import KINDS

ROOT = Path(__file__).resolve().parents[2]
HANDS = {"xhand1": "right_hand_link", "sharpa": "right_hand_C_MC"}
SHARPA_SCENE = f"""
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <asset><model name="sharpa" file="{ROOT / "robots" / "sharpa" / "sharpa_right.xml"}"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <frame pos="0 0 0.06" quat="0 0.70710678 0 0.70710678">
      <attach model="sharpa" body="right_hand_C_MC" prefix=""/>
    </frame>
    <body name="cube" pos="0.07 -0.005 0.115">
      <freejoint name="cube"/>
      <geom type="box" size="0.02 0.02 0.02" mass="0.1" friction="0.9 0.005 0.0001"/>
    </body>
  </worldbody>
</mujoco>
"""
FULL_SCALE = 1e-6
"""Largest difference of a reading relative to the run's maximum. Float32 joint frames alone would give 1.5e-6."""
STEPS, HOLD, RAMP = 150, 10, 120
"""Control steps of 2 ms: in all, before the squeeze, and during it."""

# The exporter warns of keyframes, lights and other things that USD does not hold.
pytestmark = pytest.mark.filterwarnings("ignore:.*USD holds no")


def document(model: Path, hand: str, resolution: str, obj: str) -> dict:
    return {
        "tgdsl": 1,
        "robot": {"model": str(model), "layout": str(ROOT / "robots" / hand / "layout.yaml")},
        "objects": {"thing": {"body": obj}},
        "resolution": resolution,
        "sensors": {
            "touch": {"kind": "kinematic_taxel", "links": "hand", "feels": ["thing"], "normal_stiffness": 500},
            "depth": {"kind": "contact_depth", "links": "hand", "feels": ["thing"]},
        },
    }


def scene(hand: str, folder: Path) -> tuple[Path, np.ndarray, np.ndarray, np.ndarray]:
    """Return a scene with a hand and a free cube, its initial positions, and controls that hold and squeeze."""
    if hand == "xhand1":
        file = ROOT / "examples" / "palm_cube.xml"
        model = load_model(file).compiled
        rest, squeeze = model.key("rest"), model.key("squeeze")
        return file, rest.qpos, rest.ctrl, squeeze.ctrl
    file = folder / "sharpa_cube.xml"
    file.write_text(SHARPA_SCENE)
    model = load_model(file).compiled
    targets = {"MCP_FE": 1.3, "PIP": 1.2, "DIP": 0.6, "CMC_FE": 1.5, "IP": 0.5}
    squeeze = np.array([targets.get(model.actuator(i).name.split("_", 2)[2], 0.0) for i in range(model.nu)])
    return file, model.qpos0, np.zeros(model.nu), squeeze


def run(file: Path, hand: str, qpos: np.ndarray, hold: np.ndarray, squeeze: np.ndarray) -> dict[str, np.ndarray]:
    """Return positions, depths, forces and torques after each step; one hand closes, the other half as far."""
    touch = tgdsl.compile(document(file, hand, "med", "cube"), dtype=torch.float64)
    sim = tgdsl.simulate(touch, 2)
    sim.batch.qpos[...] = qpos
    steps: dict[str, list[np.ndarray]] = {"qpos": [], "depth": [], "force": [], "torque": []}
    for step in range(STEPS):
        part = np.clip((step - HOLD) / RAMP, 0.0, 1.0)
        sim.step(np.stack([hold + part * (squeeze - hold), hold + part / 2 * (squeeze - hold)]))
        readings = touch(sim.state())
        steps["qpos"].append(sim.batch.qpos.copy())
        steps["depth"].append(readings["depth"][..., 0].numpy().copy())
        steps["force"].append(readings["touch"][..., :3].numpy().copy())
        steps["torque"].append(readings["touch"][..., 3:].numpy().copy())
    return {name: np.stack(values) for name, values in steps.items()}


def test_twins_are_reproducible():
    files = [file.with_suffix(".usda") for file in sorted((ROOT / "robots").glob("*/*.xml"))]
    contents = [file.read_bytes() for file in files]
    runpy.run_path(str(ROOT / "robots" / "make_usd.py"), run_name="__main__")
    assert [file.read_bytes() for file in files] == contents
    assert max(map(len, contents)) < 3_000_000


ROBOTS = sorted((ROOT / "robots").glob("*/*.xml"))


@pytest.mark.parametrize("file", ROBOTS, ids=[file.stem for file in ROBOTS])
def test_actuators_joints_and_colliding_pairs_are_the_same(file):
    first, second = (load_model(path).compiled for path in (file, file.with_suffix(".usda")))
    for kind, count in (("body", "nbody"), ("joint", "njnt"), ("actuator", "nu")):
        names = [[getattr(m, kind)(i).name for i in range(getattr(m, count))] for m in (first, second)]
        assert names[0] == names[1]
    for array in ("damping", "armature", "frictionloss"):
        np.testing.assert_allclose(getattr(second, f"dof_{array}"), getattr(first, f"dof_{array}"), rtol=1e-12)
    for array in ("gainprm", "biasprm", "ctrlrange", "forcerange", "gear"):
        np.testing.assert_allclose(getattr(second, f"actuator_{array}"), getattr(first, f"actuator_{array}"), rtol=1e-12)
    assert second.opt.timestep == first.opt.timestep
    assert colliding_pairs(first) == colliding_pairs(second) != set()


def colliding_pairs(model) -> set[tuple[int, int]]:
    """Return the pairs of bodies with colliders that can collide, by MuJoCo's filters of bodies."""
    weld = model.body_weldid
    parent = weld[model.body_parentid[weld]]
    excluded = {(signature >> 16, signature & 0xFFFF) for signature in model.exclude_signature.tolist()}
    is_filtering = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT

    def is_family(a, b):
        return weld[a] and weld[b] and (weld[b] == parent[a] or weld[a] == parent[b])

    bodies = np.unique(model.geom_bodyid[(model.geom_contype | model.geom_conaffinity) != 0]).tolist()
    pairs = {(a, b) for a in bodies for b in bodies if a < b and weld[a] != weld[b]} - excluded
    return {(a, b) for a, b in pairs if not (is_filtering and is_family(a, b))}


@pytest.mark.parametrize(("hand", "resolution"), [("xhand1", "low"), pytest.param("sharpa", "high", marks=pytest.mark.slow)])
def test_layouts_are_the_same(hand, resolution):
    """The palm is the felt object; any would do."""
    files = [ROOT / "robots" / hand / f"{hand}_right{ending}" for ending in (".xml", ".usda")]
    first, second = (resolve(load(document(file, hand, resolution, HANDS[hand]), None, KINDS)).layout for file in files)
    assert set(first.groups) == {"tips", "palm", "fingers", "hand"}
    assert [link.name for link in first.links] == [link.name for link in second.links]
    assert first.groups == second.groups
    np.testing.assert_array_equal(first.link_id, second.link_id)
    np.testing.assert_allclose(second.pos, first.pos, rtol=0, atol=1e-6)
    np.testing.assert_allclose(second.normal, first.normal, rtol=0, atol=1e-5)
    np.testing.assert_allclose(second.tangent, first.tangent, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(second.radius, first.radius)


@pytest.mark.slow
@pytest.mark.parametrize("hand", HANDS)
def test_a_squeeze_reads_the_same(hand, tmp_path):
    file, qpos, hold, squeeze = scene(hand, tmp_path)
    export_model(file, tmp_path / "scene.usda")
    first, second = (run(model, hand, qpos, hold, squeeze) for model in (file, tmp_path / "scene.usda"))
    assert (first["depth"][-1] > 0).any(axis=-1).all()  # both environments feel the cube to the end
    for name, values in first.items():
        off = np.abs(second[name] - values).max() / np.abs(values).max()
        assert off < FULL_SCALE, f"{name} differs by {off:.1e} of {np.abs(values).max():.3g}"


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:.*collides the convex hull", "ignore::tgdsl.errors.UnfeltWarning"
)  # the hand's palm is the felt object
def test_a_loaded_artefact_of_a_usd_robot_reads_the_same(tmp_path):
    model = ROOT / "robots" / "xhand1" / "xhand1_right.usda"
    touch = tgdsl.compile(document(model, "xhand1", "low", HANDS["xhand1"]))
    tgdsl.save(touch, tmp_path / "touch.safetensors")
    readings = []
    for module in (touch, tgdsl.load(tmp_path / "touch.safetensors")):
        sim = tgdsl.simulate(module, 1)
        sim.step(np.full(12, 0.5))
        readings.append(module(sim.state())["depth"].numpy().copy())
    np.testing.assert_array_equal(*readings)
