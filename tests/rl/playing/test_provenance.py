"""Provenance of policies: changes of the sensors' document and the scene are reported, and nothing else."""

import json

import mujoco
import numpy as np
import pytest
import small_tasks
from written_teachers import teacher

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.playing.policy import SCENE, changes_around, policy_for, provenance, read_policy

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
IN_SCENE = [
    ("gravity", '<option timestep="0.005"', '<option timestep="0.005" gravity="0 0 -9.8"'),
    ("bodies", 'mass=".02"', 'mass=".021"'),
    ("geoms", 'size=".02 .02 .02"', 'size=".02 .02 .02" friction=".9"'),
    (
        "joints",
        'name="bend" type="hinge" axis="0 1 0" range="-1 1" damping=".05"',
        'name="bend" range="-1 1" axis="0 1 0" damping=".06"',
    ),
    ("actuators", 'joint="bend" kp="2"', 'joint="bend" kp="2.1"'),
]


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Return the file of a policy for the small task."""
    folder = tmp_path_factory.mktemp("learned")
    return teacher(folder / "policy.pt", load_task(small_tasks.small_task(folder)), ["proprio"])


def changes(learned, folder):
    env = TouchEnv(small_tasks.small_task(folder), 2, threads=1)
    try:
        return policy_for(env, read_policy(learned)).changes
    finally:
        env.close()


def test_an_unchanged_task_reports_no_changes(learned, tmp_path):
    """Also in another folder, and for a card without provenance."""
    assert changes(learned, tmp_path) == []
    loaded = load_task(small_tasks.small_task(tmp_path))
    assert changes_around({}, loaded, mujoco.MjModel.from_xml_string(small_tasks.SCENE)) == []


def test_changed_sensors_are_reported(learned, tmp_path, monkeypatch):
    text = small_tasks.SENSORS.replace("threshold: 0.1 mm", "rate: 20 Hz, threshold: 0.2 mm").replace("10 cm", "11 cm")
    text += "  more: {kind: contact_depth, links: tip, feels: [item]}\n"  # a sensor that no policy used
    monkeypatch.setattr(small_tasks, "SENSORS", text)
    lines = ["bit.rate: null, now 20.0", "bit.threshold: 0.0001, now 0.0002", "gap.max_range: 0.1, now 0.11"]
    assert sorted(changes(learned, tmp_path)) == [f"sensors.yaml: sensors.{line}" for line in lines]


@pytest.mark.parametrize(("part", "before", "now"), IN_SCENE)
def test_changes_of_the_scene_are_reported(learned, tmp_path, monkeypatch, part, before, now):
    monkeypatch.setattr(small_tasks, "SCENE", small_tasks.SCENE.replace(before, now))
    assert small_tasks.SCENE.count(now) == 1
    assert changes(learned, tmp_path) == [f"the scene's {part}"]


def test_rounding_is_no_difference(tmp_path):
    """All floats may be a few units in the last place larger; one number 1 % and 0.001 larger is reported."""
    loaded = load_task(small_tasks.small_task(tmp_path))
    model = mujoco.MjModel.from_xml_string(small_tasks.SCENE)
    card = json.loads(json.dumps(provenance(loaded, model)))
    arrays = [getattr(model, name) for names in SCENE.values() for name in names if not name.startswith("opt.")]
    for array in arrays:
        if array.dtype == np.float64:
            array += 4 * np.spacing(array) * (array != 0) + 1e-17 * (array == 0)
    assert changes_around(card, loaded, model) == []
    for part, names in SCENE.items():
        for name in names:
            array = model.opt.gravity if name == "opt.gravity" else getattr(model, name)
            if array.dtype == np.float64 and array.size:
                original = array.copy()
                array.flat[0] = array.flat[0] * 1.01 + 1e-3
                assert changes_around(card, loaded, model) == [f"the scene's {part}"], name
                array[...] = original
