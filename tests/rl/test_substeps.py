"""Stacked readings of all physics steps equal those of environments with one physics step per control step."""

import pytest
import torch
from small_tasks import small_task

from tgdsl.rl.deploying.hand import DeployError, prepare
from tgdsl.rl.env import TouchEnv

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")


@pytest.fixture
def task(tmp_path):
    """Return the document of a task whose fingertip feels depths."""
    file = small_task(tmp_path)
    sensors = tmp_path / "sensors.yaml"
    text = sensors.read_text().replace("direction: [0, 0, -1]", "direction: [0, 0, 1]")
    sensors.write_text(text + "  deep: {kind: contact_depth, links: tip, feels: [item]}\n")
    return file


@pytest.fixture
def make(task):
    envs = []

    def env(temporal, substeps):
        overrides = {"temporal": temporal, "touch": "depth", "physics.substeps": substeps, "action": {"mode": "absolute"}}
        envs.append(TouchEnv(task, 3, threads=1, overrides=overrides | {"episode": "10 s"}))
        return envs[-1]

    yield env
    for each in envs:
        each.close()


def actions(num):
    generator = torch.Generator().manual_seed(0)
    return [0.4 * torch.rand((3, 2), generator=generator) - 0.2 for _ in range(num)]


def test_a_stack_holds_the_reading_of_each_physics_step(make):
    stacked, single = make("stack", 5), make("last", 1)
    start = single.observe()["tactile_sensors"]
    assert torch.equal(stacked.observe()["tactile_sensors"], start.repeat(1, 5))
    num_varied = 0
    for action in actions(20):
        readings = stacked.step(action).obs["tactile_sensors"]
        expected = torch.cat([single.step(action).obs["tactile_sensors"] for _ in range(5)], dim=1)
        assert torch.equal(readings, expected)
        num_varied += len(expected.unique()) > 10
    assert num_varied > 10


def test_an_episode_begins_with_a_stack_of_its_first_reading(make):
    env = make("stack", 5)
    env.steps[1] = env.max_steps - 4
    for action in actions(4):
        result = env.step(action)
    assert result.truncated.tolist() == [False, True, False]

    def changes_within_stack(obs):
        stack = obs["tactile_sensors"].view(3, 5, -1)
        return (stack != stack[:, :1]).any(dim=2).any(dim=1).tolist()

    assert changes_within_stack(result.info.final_obs) == [True] * 3 and changes_within_stack(result.obs) == [True, False, True]


def test_a_real_hand_cannot_feel_between_control_steps(task, tmp_path):
    policy = tmp_path / "policy.pt"
    torch.jit.save(torch.jit.trace(torch.nn.Linear(26, 2), torch.zeros(1, 26)), policy)
    with pytest.raises(DeployError, match=r"at each of 5 physics steps .* a hand feels once"):
        prepare(task, policy, groups=("proprio", "tactile_sensors"), overrides={"temporal": "stack"})
