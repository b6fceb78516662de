"""What is felt at each physics step, stacked: the same as environments feel that make one physics step per control step."""

import pytest
import torch
from tiny_tasks import tiny_env

from tgdsl.rl.deploying.prepared import DeployError, prepare

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
MORE = "temporal: {}\ntouch: depth\nrandomise: {{xy: [20 mm, 20 mm]}}\naction: {{mode: absolute}}\nphysics: {{substeps: {}}}\nepisode: {}\n"

CLOSED = torch.tensor([0.0, -1.0])
"""The right plate on the ball, which lies near it."""


@pytest.fixture
def make(tmp_path):
    made = []

    def env(temporal, substeps, episode="1 s"):
        folder = tmp_path / str(len(made))
        folder.mkdir()
        made.append(tiny_env(folder, 3, more=MORE.format(temporal, substeps, episode)))
        return made[-1]

    yield env
    for each in made:
        each.close()


def test_a_stack_has_what_is_felt_at_each_physics_step(make):
    stacked, each = make("stack", 5), make("last", 1)
    start = each.observe()["tactile_sensors"]
    assert torch.equal(stacked.observe()["tactile_sensors"], start.repeat(1, 5))
    generator, seen = torch.Generator().manual_seed(0), 0
    for _ in range(20):
        action = CLOSED + 0.2 * torch.rand((3, 2), generator=generator)
        found = stacked.step(action).obs["tactile_sensors"]
        expected = torch.cat([each.step(action).obs["tactile_sensors"] for _ in range(5)], dim=1)
        assert torch.equal(found, expected)
        seen += len(expected.unique())
    assert seen > 40


def test_an_episode_begins_with_a_stack_of_its_first_reading(make):
    env = make("stack", 5)
    env.steps[1] = env.max_steps - 12
    for _ in range(12):
        made = env.step(CLOSED.expand(3, 2))
    assert made.truncated.tolist() == [False, True, False]
    felt = made.obs["tactile_sensors"].view(3, 5, -1)
    is_still = (felt == felt[:, :1]).all(dim=2).all(dim=1)
    assert is_still.tolist() == [False, True, False]
    assert not torch.equal(made.info.final_obs["tactile_sensors"][1], made.obs["tactile_sensors"][1])


def test_no_hand_feels_between_control_steps(make, tmp_path):
    make("stack", 5)
    policy = tmp_path / "policy.pt"
    torch.jit.save(torch.jit.trace(torch.nn.Linear(26, 2), torch.zeros(1, 26)), policy)
    with pytest.raises(DeployError, match=r"at each of 5 physics steps .* a hand feels once"):
        prepare(tmp_path / "0" / "task.yaml", policy, groups=("proprio", "tactile_sensors"))
