"""The repository's policies: small, fitting their tasks, and as good as their cards claim."""

from pathlib import Path

import pytest
import torch

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.playing.policy import Policy, check_card, check_learned, policy_for, read_policy
from tgdsl.rl.sensors import compile_sensors
from tgdsl.rl.start import moved_joints

REPOSITORY = Path(__file__).parents[3]
POLICIES = sorted((REPOSITORY / "policies").glob("*.pt"))
CAPPED = "physics.iterations: null, now 10"
"""The palm's policies predate their tasks' cap, which is rarely reached: docs/background/hands.md."""
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
SAYS = {
    *("groups", "joints", "iterations", "samples", "minutes", "command", "score", "task", "overrides", "seed", "device"),
    *("taxels", "versions", "spec"),
}
PER_TAXEL = {"none": 0, "bool": 1, "depth": 1, "force_taxel": 3, "force": 3, "proximity": 6, "force_torque": 6}


def taxels_of(document, touch, resolution, placement):
    """Return the touch module, the link of each taxel, and the moved joints of a task."""
    loaded = load_task(document, {"touch": touch, "resolution": resolution, "placement": placement})
    sensors = compile_sensors(loaded, "cpu")
    links = [link for touch in sensors.groups.values() for link in touch.layout.link_id.tolist()]
    return sensors.touch, links, moved_joints(loaded, sensors)


@pytest.mark.parametrize("file", POLICIES, ids=lambda file: file.stem)
def test_the_card_is_complete(file):
    """The network takes the sizes on its card, which names no folder of the training machine."""
    assert file.stat().st_size <= 2.5 * 2**20
    saved = read_policy(file)
    card = saved.card
    assert set(card) >= SAYS and card["score"]["episodes"] >= 1000
    assert str(Path.home()) not in str(card) and "/tmp" not in str(card)
    check_learned(card, file, load_task(REPOSITORY / card["task"], card["overrides"]).spec)
    policy = Policy(saved, card["groups"], 2, len(card["joints"]))
    obs = {name: torch.ones(2, size) for name, size in card["groups"].items()}
    assert policy(obs).isfinite().all() and policy(obs).dtype == torch.float32


@pytest.mark.parametrize("name", ["find_ridge", "grip_force_agg_force", "in_palm_rotate_cube"])
def test_policies_of_the_wheel_fit_their_tasks(name):
    """Joints, taxels and sizes of groups match; `test_a_policy_does_better_than_rest` checks the other policies."""
    saved = read_policy(REPOSITORY / "policies" / f"{name}.pt")
    card = saved.card
    spec = load_task(REPOSITORY / card["task"], card["overrides"]).spec
    touch, links, joints = taxels_of(REPOSITORY / card["task"], spec.touch, spec.resolution, spec.placement)
    check_card(saved, joints, touch)
    touch = 3 * len(set(links)) if spec.touch == "agg_force" else PER_TAXEL[spec.touch] * len(links)
    sizes = {"proprio": 3 * len(joints), "tactile_sensors": touch}
    assert {**card["groups"], **sizes} == {**sizes, **card["groups"]}


@pytest.mark.slow
@pytest.mark.parametrize("file", POLICIES, ids=lambda file: file.stem)
def test_a_policy_does_better_than_rest(file):
    """Usually in each of four environments within a second on MuJoCo.

    Students and reorientation may lose some objects: the sum of eight environments counts, over five seconds.
    The resting environments compute no touch, which does not change their episodes. A few grasps suffice to begin.
    """
    saved = read_policy(file)
    card = saved.card
    is_long = "teacher" in card or card["score"]["task"] == "in_hand_repose"
    num = 8 if is_long else 4
    fewer = {"grasps.num": "16"} if card["score"]["task"] == "screwdriver" else {}
    env = TouchEnv(REPOSITORY / card["task"], num, threads=1, overrides={**card["overrides"], **fewer})
    policy, obs = policy_for(env, saved), env.reset(seed=1)
    assert all(change == CAPPED or change.startswith("grasps.num") for change in policy.changes)
    steps = env.max_steps - 1  # after an episode's last step the score is the next one's
    steps = min(steps, round((5.0 if is_long else 1.0) / env.control_step))
    returns = torch.zeros(num)
    for _ in range(steps):
        step = env.step(policy(obs))
        obs, returns = step.obs, returns + step.reward.float()
    rest = TouchEnv(REPOSITORY / card["task"], num, threads=1, overrides={**card["overrides"], **fewer, "touch": "none"})
    rest.reset(seed=1)
    resting = sum(rest.step(torch.zeros(num, env.num_actions)).reward.float() for _ in range(steps))
    assert returns.sum() > resting.sum() if is_long else (returns > resting).all()
    assert (env.task.score().sum() < rest.task.score().sum()) == env.task.is_less_better
    env.close()
    rest.close()


def test_all_policies_together_are_small():
    assert 0 < sum(file.stat().st_size for file in POLICIES) < 20e6
