"""Turning an object on the palm: rewards and terminations against the reference, and incentives."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from task_records import Recorder, assert_reference
from task_references import in_palm_rotate
from tiny_tasks import tiny_env

from tgdsl.errors import SpecError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate
from tgdsl.rl.tasks.parts import are_fingers

DOCUMENT = Path(__file__).parents[3] / "examples" / "tasks" / "in_palm_rotate.yaml"
MORE = "episode: 0.5 s\nmax_force: 0.05 N\nfree_distance: 1 mm\ndrop_distance: 20 mm\naction: {scale: 0.3}\n"
MORE += "free_speed: 1 mm/s\nfree_spin: 0.1\n"
COSTS = {"rewards.effort": -0.5, "rewards.object_speed": -0.2}
"""Weights that are 0 by default, so that all terms occur."""
WEIGHTS = {name: (1.5 + 0.1 * i) * value or -0.5 for i, (name, value) in enumerate(InPalmRotate.Rewards())}
"""Weights that differ from the task's, each by its own factor."""


def held_reference(env):
    """Return the reference, given which links are fingers."""
    setup = env.task.setup
    extra = {"fingers": are_fingers(setup.model, setup.links)}
    return lambda spec, record, dt: in_palm_rotate(spec, record | extra, dt)


def random_actions(env, num, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [2 * torch.rand((env.num_envs, env.num_actions), generator=generator) - 1 for _ in range(num)]


@pytest.mark.parametrize("direction", ["counterclockwise", "clockwise"])
def test_rewards_ends_and_scores_equal_the_reference(tmp_path, direction):
    push = "randomise: {xy: [-5 mm, 5 mm], yaw: [-1, 1], push: {x: [-2 N, 2 N], interval: [0.1 s, 0.2 s]}}\n"
    env = tiny_env(
        tmp_path, 4, more=MORE + push + f"direction: {direction}\n", overrides={"rewards": WEIGHTS, "hold.coasting_pay": 0.25}
    )
    recorder = Recorder(env)
    for i, action in enumerate(random_actions(env, 80)):
        env.sim.qvel[:2, 8] = 6.0 if direction == "counterclockwise" else -6.0  # nothing else turns a ball
        recorder.step(action if i < 40 else torch.ones_like(action))
    assert sum(len(episodes) for episodes in recorder.episodes) >= 12
    names = {*InPalmRotate.Rewards.model_fields, "is_over", "score"}
    assert assert_reference(recorder, held_reference(env)) == names


def test_bounds_backward_turns_tilts_and_falls_equal_the_reference(tmp_path):
    settings = {
        "max_spin": 1.5,
        "min_spin": -0.5,
        "backward": 5,
        "spin_tilt": 0.2,
        "drop_measure": "below",
        "drop_distance": "5 mm",
    }
    env = tiny_env(tmp_path, 4, more=MORE, overrides=COSTS | settings | {"episode": "10 s"})
    recorder = Recorder(env)
    for i, action in enumerate(random_actions(env, 60)):
        env.sim.qvel[:, 8] = torch.tensor([4.0, -4.0, 0.3, -0.3]) * (1 if i % 7 else -1)
        env.sim.qvel[3, 6] = 2.0 if i > 20 else 0.0  # tilts
        if i == 50:
            env.sim.qpos[:2, 5] = 0.022  # 8 mm lower
        recorder.step(action)
    names = assert_reference(recorder, held_reference(env))
    assert {"spin", "drop", "is_over", "tilt"} <= names
    rates = np.concatenate([rows["spin"] for _, rows in recorder.records()])
    assert rates.min() == pytest.approx(2 * 5 * -0.5, rel=1e-5) and rates.max() == pytest.approx(2 * 1.5, rel=1e-5)
    env.close()


def test_a_document_chooses_the_observations_of_the_goal(tmp_path):
    env = tiny_env(tmp_path, 2, more="goal: [angle, difference]\nrandomise: {yaw: [-1, 1]}\n")
    goal = env.step(torch.zeros(2, 2)).obs["goal"]
    assert goal.shape == (2, 7)
    np.testing.assert_allclose(goal[:, 0], 0.5 * math.pi, atol=1e-3)
    quarter = [0, 1, 0, -1, 0, 0]  # the turned x and y axes
    np.testing.assert_allclose(goal[:, 1:], [quarter] * 2, atol=1e-3)
    env.close()
    with pytest.raises(SpecError, match="goal names angle twice"):
        tiny_env(tmp_path, 2, more="goal: [angle, angle]\n")


@pytest.mark.slow
def test_the_real_hand_equals_the_reference():
    env = TouchEnv(DOCUMENT, 4, threads=1, overrides={"episode": "0.5 s", "action": {"mode": "relative", "scale": 0.3}})
    recorder = Recorder(env)
    for action in random_actions(env, 50):
        recorder.step(action)
    assert {"spin", "near", "tilt", "action_rate", "work"} <= assert_reference(recorder, held_reference(env))


def reward_of_turning(env, rate, steps=8):
    """Return the mean reward of a ball turned about the vertical at given rates [rad/s]."""
    env.reset()
    total, rate = torch.zeros(env.num_envs), torch.as_tensor(rate, dtype=torch.float64)
    for i in range(1, steps + 1):
        half = 0.5 * rate * env.control_step * i
        env.sim.qpos[:, 6:10] = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], dim=1)
        env.sim.qvel[:, 3:] = 0
        total += env.step(torch.zeros(env.num_envs, env.num_actions)).reward
    return total / steps


@pytest.mark.parametrize(("direction", "way"), [("counterclockwise", 1.0), ("clockwise", -1.0)])
def test_turning_right_beats_rest_and_rest_beats_turning_wrong(tmp_path, direction, way):
    env = tiny_env(tmp_path, 5, gravity="0 0 0", more=f"direction: {direction}\n")
    wrong, slowly_wrong, rest, slow, right = reward_of_turning(
        env, [way * rate for rate in (-2.0, -0.5, 0.0, 0.5, 2.0)]
    ).tolist()
    assert wrong < slowly_wrong < rest < slow < right
    # Without goals only the rate pays.
    dt = env.control_step
    assert right - rest == pytest.approx(2.0 * 2.0 * dt, rel=0.2) and rest - wrong == pytest.approx(2.0 * 2.0 * dt, rel=0.2)


def test_turning_back_and_forth_pays_nothing(tmp_path):
    """Reached goals stay reached, and turning back costs what turning forward paid."""
    env = tiny_env(tmp_path, 2, gravity="0 0 0", more="rewards: {near: 0, work: 0}\nepisode: 10 s\n")
    env.reset()
    total, angle, reached = torch.zeros(2), 0.0, 0
    back = np.linspace(1.7, 0, 6)  # faster than the paid rate
    path = [*np.linspace(0, 1.7, 30), *back, *np.linspace(0, 1.7, 30), *back]
    for angle in path:
        half = torch.full((2,), 0.5 * angle, dtype=torch.float64)
        env.sim.qpos[:, 6:10] = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], dim=1)
        env.sim.qvel[:] = 0
        result = env.step(torch.zeros(2, 2))
        total += result.reward
        reached += int(result.info.terms["success"][0] > 0)
    assert reached == 1 and result.info.score.tolist() == [1.0, 1.0]
    assert total[0].item() == pytest.approx(InPalmRotate.Rewards().success * env.control_step, abs=0.02)


@pytest.mark.parametrize(("direction", "way"), [("counterclockwise", 1.0), ("clockwise", -1.0)])
def test_goals_are_quarter_turns(tmp_path, direction, way):
    env = tiny_env(tmp_path, 1, gravity="0 0 0", more=f"episode: 10 s\ndirection: {direction}\n")
    obs = env.reset()
    assert obs["goal"][0].tolist() == pytest.approx([0, way, 0, -way, 0, 0, math.pi / 2], abs=1e-6)
    angles = []
    for i in range(1, 70):
        angle = torch.tensor(way * 0.05 * i, dtype=torch.float64)
        env.sim.qpos[0, 6:10] = torch.stack([(0.5 * angle).cos(), 0 * angle, 0 * angle, (0.5 * angle).sin()])
        env.sim.qvel[:] = 0
        result = env.step(torch.zeros(1, 2))
        if result.info.terms["success"][0] > 0:
            angles.append(0.05 * i)
        goal = way * (len(angles) + 1) * math.pi / 2
        expected = [math.cos(goal), math.sin(goal), 0, -math.sin(goal), math.cos(goal), 0]
        assert result.obs["goal"][0, :6].tolist() == pytest.approx(expected, abs=1e-5)
    assert angles == pytest.approx([k * math.pi / 2 - 0.1 for k in (1, 2)], abs=0.051)
    assert result.info.score.item() == 2.0


def test_a_tilted_object_reaches_no_goal(tmp_path):
    env = tiny_env(tmp_path, 2, gravity="0 0 0", more="episode: 10 s\n")
    env.reset()
    for i in range(1, 40):
        half = torch.tensor([0.5 * 0.05 * i] * 2, dtype=torch.float64)
        turn = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], dim=1)
        tilt = torch.tensor([0.0, 0.25], dtype=torch.float64)  # half of 0.5 rad about x
        w, z = turn[:, 0], turn[:, 3]
        env.sim.qpos[:, 6:10] = torch.stack([w * tilt.cos(), w * tilt.sin(), z * tilt.sin(), z * tilt.cos()], dim=1)
        env.sim.qvel[:] = 0
        result = env.step(torch.zeros(2, 2))
    assert result.info.score.tolist() == [1.0, 0.0]
    assert env.task.tilt.tolist() == pytest.approx([0.0, 0.5], abs=1e-6)
