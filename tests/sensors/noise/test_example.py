"""Each line of the noisy-hand example does what its comment says."""

from pathlib import Path

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.observations.observations import ObservationSpec
from tgdsl.runtime.rollout import rollout, scripted_controls
from tgdsl.schema.load import load
from tgdsl.view.picture import picture
from tgdsl.view.table import table

EXAMPLE = Path(__file__).parents[3] / "examples" / "noisy_hand.yaml"
NUM_STEPS, NUM_ENVS = 12, 2

SCENE = """
<mujoco><worldbody>
  <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
  <body name="cube" pos="0 0 .0295"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def touch():
    """The example, with a field of moments that takes a second to bake."""
    return tgdsl.compile(EXAMPLE, overrides={"sensors.near.tolerance": 0.1})


@pytest.fixture(scope="module")
def readings(touch):
    """Readings of the squeeze, every 10 ms: by name (step, env, …)."""
    sim = tgdsl.simulate(touch, NUM_ENVS, substeps=5, keyframe="squeeze")
    controls = scripted_controls(sim.model, ("squeeze",), 0.01 * NUM_STEPS, sim.control_step)
    steps = [{name: value.clone() for name, value in step.readings.items()} for step in rollout(touch, sim, controls)]
    return {name: torch.stack([step[name] for step in steps]) for name in steps[0]}


def test_the_example_has_every_observation_type_of_the_paper():
    types = {part.type for parts in load(EXAMPLE).spec.observations.values() for part in parts}
    all_types = {part.model_fields["type"].annotation.__args__[0] for part in ObservationSpec.__origin__.__args__}
    hand_types = {"taxel_counts", "taxel_saturated", "joint_pos", "joint_vel", "joint_effort", "last_action"}
    assert types == all_types - {"none", "link_bool", "link_force", "reading", "cop"} - hand_types


@pytest.mark.slow
def test_the_clean_reading_equals_a_clean_sensors(touch, readings):
    """`touch/clean` equals the reading of a document with `readout: clean`; measured readings differ wherever there is contact."""
    clean = tgdsl.compile(EXAMPLE, overrides={"sensors": CLEAN, "observations": "{}"})
    sim = tgdsl.simulate(clean, NUM_ENVS, substeps=5, keyframe="squeeze")
    controls = scripted_controls(sim.model, ("squeeze",), 0.01 * NUM_STEPS, sim.control_step)
    for i, step in enumerate(rollout(clean, sim, controls)):
        torch.testing.assert_close(readings["touch/clean"][i], step.readings["touch"], rtol=0, atol=0)
    is_felt = readings["touch/clean"][..., :3].norm(dim=-1) > 0.1
    assert is_felt.any()
    assert (readings["touch"] != readings["touch/clean"])[is_felt].any(dim=-1).all()


CLEAN = "{touch: {kind: kinematic_taxel, links: hand, feels: [cube], noise: noisy, readout: clean}}"


@pytest.mark.slow
def test_readings_are_multiples_of_the_quantisers_step(touch, readings):
    """Steps of the paper's table: 0.1 mm, 0.01 N and 0.1 mm; on the palm `worn` has none."""
    for name, step in {"depth": 1e-4, "touch": 1e-2, "near": 1e-2, "skin": 1e-4}.items():
        share = readings[name].double() / step
        assert (share - share.round()).abs().max() < 1e-3, name
    share = readings["worn"].double() / 1e-2
    is_palm = torch.from_numpy(np.isin(touch.taxels["worn"]["link"], touch.plan.layout.groups["palm"]))
    assert 0 < is_palm.sum() < len(is_palm)
    assert (share - share.round())[..., ~is_palm, :].abs().max() < 1e-3
    assert ((share - share.round()).abs() > 1e-2)[..., is_palm, :].float().mean() > 0.8


@pytest.mark.slow
def test_the_skin_samples_at_every_second_call(readings):
    """50 Hz read every 10 ms: each value appears twice, then changes."""
    skin = readings["skin"]
    torch.testing.assert_close(skin[1::2], skin[0::2], rtol=0, atol=0)
    assert (skin[2::2] != skin[1:-1:2]).flatten(1).any(dim=1).all()


@pytest.mark.slow
def test_the_history_is_the_last_three_readings(readings):
    worn = readings["worn"]
    assert worn.shape == (NUM_STEPS, NUM_ENVS, 3, 199, 6)
    torch.testing.assert_close(worn[2:, :, 0], worn[:-2, :, 2], rtol=0, atol=0)
    torch.testing.assert_close(worn[1:, :, 1], worn[:-1, :, 2], rtol=0, atol=0)


@pytest.fixture
def stacked(tmp_path):
    """A pad whose sensor stacks three calls, its scene, and a reading."""
    (tmp_path / "scene.xml").write_text(SCENE)
    grid = {"method": "grid", "rows": 2, "columns": 3, "direction": [0, 0, -1], "radius": 0.004}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"pad": grid}}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"touch": {"kind": "kinematic_taxel", "links": "pad", "feels": ["cube"], "history": 3}},
    }
    module = tgdsl.compile(document)
    sim = tgdsl.simulate(module, 1)
    sim.step()
    return module, sim, module(sim.state())


def test_a_table_of_stacked_readings_shows_the_last_one(stacked):
    module, _, readings = stacked
    last = readings["touch"][0, -1, :, :3].double().numpy().sum(axis=0)
    assert table(module, readings)[-1].split() == ["pad", f"{np.linalg.norm(last):.3f}"]


def test_a_picture_of_stacked_readings_can_be_drawn(stacked, tmp_path):
    module, sim, readings = stacked
    assert picture(module, sim, readings, tmp_path / "picture.png").exists()


def test_names_of_objects_may_end_like_an_axis(tmp_path):
    """The quantity of the object `cube_x` is `distance_cube_x`, not `distance_cube`."""
    (tmp_path / "scene.xml").write_text(SCENE)
    points = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]}
    sensor = {"kind": "surface_distance", "links": "pad", "feels": ["cube_x"], "max_range": 0.1, "readout": "both"}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"pad": points}}}},
        "objects": {"cube_x": {"body": "cube"}},
        "sensors": {"s": {**sensor, "noise": {"bias": {"distance_cube_x": 0.5}}}},
    }
    module = tgdsl.compile(document, dtype=torch.float64)
    readings = module(module.example_state(2))
    torch.testing.assert_close(readings["s"], readings["s/clean"] + 0.5)
