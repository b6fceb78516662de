"""Calls with an argument of the wrong type: each error names the type and the remedy."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from benched_pads import bench_document
from small_tasks import small_task

import tgdsl
from tgdsl.errors import ArtifactError, ObservationError, SimulationError, SpecError, StateError, TgdslError
from tgdsl.rl.env import TouchEnv

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    return tgdsl.compile(bench_document(tmp_path_factory.mktemp("pad")))


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ("hand.xml", "hand.xml: this is a robot or scene file, which a document names: `robot: {model: …}`, expected a YAML"),
        ("hand.safetensors", "this is an artefact, which `tgdsl.load` reads, expected a YAML document"),
        ("policy.pt", "this is a policy or checkpoint, expected a YAML document"),
        ("tgdsl: 1\nrobot: {model: xhand1}\n", "<text>: found YAML text, expected a file's name, or a mapping"),
    ],
)
def test_what_is_no_document(document, message):
    for read in (tgdsl.compile, lambda own: TouchEnv(own, 1)):
        with pytest.raises(SpecError) as caught:
            read(document)
        assert message in str(caught.value)


def test_documents_of_tasks_and_of_sensors_are_told_apart(here):
    task = EXAMPLES / "tasks" / "in_palm_rotate_cube.yaml"
    code, _, error = here(task.parent, "run", task.name)
    assert (code, error.splitlines()[1:]) == (2, ["1 mistake"])
    assert "task: this is a task's document, expected one of sensors; its sensors are in palm.yaml: name that file" in error
    code, _, error = here(task.parent, "play", "palm.yaml")
    assert code == 2 and "this is a document of sensors, which a task's document names: `document: …`" in error


def test_modules_readings_and_files(touch, tmp_path):
    state = touch.example_state(2)
    with pytest.raises(SimulationError, match=r"found a str, expected a module: tgdsl\.compile\('hand\.yaml'\)"):
        tgdsl.simulate("hand.yaml", 2)  # type: ignore[arg-type]
    with pytest.raises(ObservationError, match="found a SceneState, expected readings by name"):
        touch.observe(state)
    with pytest.raises(TgdslError, match="found a Tensor, expected readings by name"):
        touch.images("depth", touch(state)["depth"])
    with pytest.raises(TgdslError, match=r"x\.pt: an artefact is a safetensors file, expected a name such as x\.safetensors"):
        tgdsl.save(touch, tmp_path / "x.pt")
    assert not list(tmp_path.iterdir())
    with pytest.raises(ArtifactError, match=r"this is a folder, expected an artefact such as .*hand\.safetensors"):
        tgdsl.load(tmp_path)


def test_environments_counts_and_memory(touch):
    state = touch.example_state(2)
    with pytest.raises(StateError, match="memory: found NoneType, expected `initial_memory`, or what the step before returned"):
        touch.step(state, None)
    touch.free()  # of the calls of other tests
    for wrong, found in (("all", "'all'"), ([-1], "-1"), ([0.5], "0.5"), ([[0, 1]], "0, 1")):
        with pytest.raises(StateError, match=rf"env_ids: found {found}, expected indices of environments from 0, or a mask"):
            touch.reset(wrong)
    touch.reset([7])  # before the first call any number of environments is possible
    with pytest.raises(SimulationError, match=r"^num_envs is '2', expected a whole number of at least 1$"):
        tgdsl.simulate(touch, "2")  # type: ignore[arg-type]
    with closing(tgdsl.simulate(touch, 2, device=torch.device("cpu"))) as sim:
        for env_ids in ("all", slice(0, 1), object()):
            for call in (sim.reset, sim.set_state, sim.forward, sim.read):
                with pytest.raises(SimulationError, match=r"env_ids: found .*, expected indices from 0 to 1, or a mask of 2"):
                    call(env_ids)
        with pytest.raises(SimulationError, match="control is no array of numbers: "):
            sim.step("open")  # type: ignore[arg-type]


def test_steps_of_environments(tmp_path):
    env = TouchEnv(small_task(tmp_path), 2)
    with pytest.raises(SimulationError, match=r"action is of torch\.int64, expected numbers from -1 to 1"):
        env.step(torch.zeros(2, env.num_actions, dtype=torch.int64))
    for wrong in (None, "up", {"swing": 0.1}, np.array(["up"])):
        with pytest.raises(SimulationError, match=r"action is of .*, expected a tensor \(2, 2\) of numbers from -1 to 1"):
            env.step(wrong)
    with pytest.raises(SimulationError, match="the seed is 'a', expected a whole number"):
        env.reset(seed="a")
    action = np.linspace(-1, 1, 2 * env.num_actions, dtype=np.float32).reshape(2, -1)
    made = env.step(action)
    env.reset(seed=0)
    again = TouchEnv(small_task(tmp_path), 2, seed=0)
    again.reset(seed=0)
    assert made.reward.shape == (2,)
    torch.testing.assert_close(env.step(action).obs, again.step(torch.from_numpy(action)).obs)


def test_a_device_that_is_not_there(tmp_path):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(TgdslError, match=r'there is no device "cuda": .*; expected "cpu"'):
        tgdsl.compile(bench_document(tmp_path), device="cuda")
