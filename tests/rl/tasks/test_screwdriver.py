"""Spinning a screwdriver: rewards, terminations and scores against the reference, incentives, observations."""

import math
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pincer_tasks import LENGTH, pincer_env
from task_records import Recorder, assert_reference
from task_references import screwdriver

from tgdsl.errors import SimulationError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.tasks.parts import are_fingers
from tgdsl.rl.tasks.screwdriver import Screwdriver

DOCUMENT = Path(__file__).parents[3] / "examples" / "tasks" / "screwdriver.yaml"
ODD = {
    "episode": "0.6 s", "max_spin": 1.0, "near_width": "3 mm", "free_distance": "2 mm", "drop_tilt": 0.3, "engagement": "8 mm",
    "action.slide_scale": 0.01, "randomise.push": {"x": ["-3 N", "3 N"], "y": ["-3 N", "3 N"], "interval": ["0.1 s", "0.2 s"]},
    "rewards": {name: 1.5 * value or -0.5 for name, value in Screwdriver.Rewards()}, "max_force": "0.1 N", "hold": {"coasting_pay": 0.25},
}  # fmt: skip
"""Numbers unlike the document's, chosen so that every term occurs."""
FREE = slice(3, 10)
"""The rod's part of `qpos`."""


def random_actions(env, num, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [2 * torch.rand((env.num_envs, env.num_actions), generator=generator) - 1 for _ in range(num)]


def rotation(quat):
    """Return the matrix of a quaternion w, x, y, z."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def reference_with_tip(env, upright, length):
    """Return the reference for a tip at a given length below the body, which was upright at a given place."""
    setup = env.task.setup
    extra = {"fingers": are_fingers(setup.model, setup.links)}

    def reference(spec, record, dt):
        down = np.array([0, 0, -length])
        tip = record["pos"] + np.stack([rotation(quat) @ down for quat in record["quat"]])
        return screwdriver(spec, {**record, **extra, "tip": tip, "upright_pos": upright, "upright_tip": upright + down}, dt)

    return reference


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    """Four rods without weight, with ideal drives."""
    environment = pincer_env(tmp_path_factory.mktemp("rod"), 4, gravity="0 0 0", more="episode: 10 s\n")
    yield environment
    environment.close()


def test_rewards_ends_and_scores_equal_the_reference(tmp_path):
    env = pincer_env(tmp_path, 6, overrides=ODD)
    recorder = Recorder(env)
    for i, action in enumerate(random_actions(env, 90)):
        action[0] = -1.0  # opens to the end of its range; its rod stays in place
        env.sim.qpos[0, FREE], env.sim.qvel[0, 3:] = torch.tensor([0, 0, 0.1, 1, 0, 0, 0]), 0.0
        if i % 10 < 4:
            env.sim.qvel[1:3, 8] = torch.tensor([-8.0, 3.0], dtype=torch.float64)  # nothing else spins them
        recorder.step(action)
    assert sum(len(episodes) for episodes in recorder.episodes) > 18
    names = assert_reference(recorder, reference_with_tip(env, np.array([0, 0, 0.1]), LENGTH))
    assert names == {*Screwdriver.Rewards.model_fields, "is_over", "score"}
    env.close()


def test_bounds_and_stalled_episodes_equal_the_reference(tmp_path):
    settings = {
        "max_spin": 0.2,
        "min_spin": -0.2,
        "stall": {"within": "0.25 s", "turn": 0.2},
        "engagement": "5 cm",
        "drop_tilt": 1.5,
    }
    env = pincer_env(tmp_path, 4, overrides=ODD | settings | {"episode": "3 s", "randomise.push": "{}"})
    recorder = Recorder(env)
    for i, action in enumerate(random_actions(env, 60)):
        env.sim.qvel[:, 8] = torch.tensor([-8.0, -0.5, 0.0, 3.0], dtype=torch.float64) * (i < 40)
        recorder.step(action)
    names = assert_reference(recorder, reference_with_tip(env, np.array([0, 0, 0.1]), LENGTH))
    assert {"spin", "is_over"} <= names
    lengths = [[len(rows) for _, rows in episodes] for episodes in recorder.episodes]
    assert max(lengths[0]) > 20 and max(lengths[2]) == 10, lengths
    env.close()


@pytest.mark.slow
def test_the_real_hand_equals_the_reference():
    env = TouchEnv(DOCUMENT, 8, threads=1, overrides={"touch": "none", "grasps.num": 16})
    recorder = Recorder(env)
    for action in random_actions(env, 80):
        recorder.step(action)
    names = assert_reference(recorder, reference_with_tip(env, np.array([0.09, 0.08, 0.215]), 0.19))
    assert {*Screwdriver.Rewards.model_fields, "is_over", "score"} - {"joint_limit", "contact_force", "effort"} <= names
    env.close()


def reward_of_turning(env, rates, steps=8, tilt=0.0):
    """Return the mean reward of rods turned clockwise, seen from above, at given rates [rad/s]."""
    env.reset(0)
    total, rates = torch.zeros(env.num_envs), torch.as_tensor(rates, dtype=torch.float64)
    start = env.now.object.quat.clone()
    for i in range(1, steps + 1):
        place(env, -rates * env.control_step * i, tilt, start)
        total += env.step(torch.zeros(env.num_envs, env.num_actions)).reward
    return total / steps


def place(env, yaw, tilt, start=None):
    """Turn rods about their axis, then tilt them about the world's x with the tip in place; jaws stay clear."""
    yaw = torch.as_tensor(yaw, dtype=torch.float64).expand(env.num_envs)
    w, z = (0.5 * yaw).cos(), (0.5 * yaw).sin()
    if start is not None:
        w, z = start[:, 0] * w - start[:, 3] * z, start[:, 0] * z + start[:, 3] * w
    tilt = torch.as_tensor(tilt, dtype=torch.float64).expand(env.num_envs)
    c, s = (0.5 * tilt).cos(), (0.5 * tilt).sin()
    quat = torch.stack([c * w, s * w, -s * z, c * z], dim=1)
    pos = torch.stack([0 * tilt, -LENGTH * tilt.sin(), 0.1 - LENGTH + LENGTH * tilt.cos()], dim=1)
    env.sim.qpos[:, FREE] = torch.cat([pos, quat], dim=1)
    env.sim.qpos[:, :2] = 0.0
    env.sim.qvel[:] = 0.0
    env.actuation.target[:] = 0.0


def test_turning_right_beats_rest_and_rest_beats_turning_wrong(env):
    """The right way is clockwise as seen from the handle."""
    rest, slow, right, fast = reward_of_turning(env, [0.0, 0.5, 2.0, 20.0]).tolist()
    wrong, slowly_wrong, rest_again, fast_wrong = reward_of_turning(env, [-2.0, -0.5, 0.0, -20.0]).tolist()
    assert fast_wrong < wrong < slowly_wrong < rest < slow < right < fast and rest == pytest.approx(rest_again, abs=1e-5)
    dt, share = env.control_step, 0.975  # readings are from the start of the last physics step of 5 ms
    assert right - rest == pytest.approx(10 * 2.0 * dt * share, rel=0.03)
    assert rest - wrong == pytest.approx(10 * 2.0 * dt * share, rel=0.03)
    assert fast - rest == pytest.approx(10 * 6.0 * dt, rel=0.03)  # the reward is clipped
    assert rest - fast_wrong == pytest.approx(10 * 20.0 * dt * share, rel=0.03)  # the cost is not


def test_turning_back_and_forth_pays_nothing_at_any_speed(env):
    """Slowly forward and at once back, and the reverse."""
    env.reset(0)
    forward, back = np.linspace(0, 1.0, 21)[1:], np.linspace(1.0, 0, 21)[1:]
    total = torch.zeros(env.num_envs)
    place(env, 0.0, 0.0)
    old_score = env.step(torch.zeros(4, 2)).info.score
    for angle in [*forward, 0.0, 0.0, 1.0, 1.0, *back, 0.0]:
        place(env, -angle, 0.0)
        result = env.step(torch.zeros(4, 2))
        total += result.info.terms["spin"]
    # Fast forward turns are clipped.
    assert (total <= 1e-6).all() and (result.info.score - old_score).tolist() == pytest.approx([0.0] * 4, abs=1e-4)


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        ("spin", lambda tilt: 20.0),
        ("alignment", lambda tilt: -400 * (1 - math.cos(tilt))),
        ("object_distance", lambda tilt: -300 * max(0.0, 2 * 0.19 * math.sin(tilt / 2) - 0.02)),
    ],
)
@pytest.mark.parametrize("degrees", [0.0, 5.0, 10.0, 20.0])
def test_terms_at_two_radians_per_second(env, term, expected, degrees):
    """For 19 cm from the handle's middle to the tip, as in the documentation's table."""
    env.reset(0)
    tilt, task = math.radians(degrees), env.task
    pos = task.upright_pos + torch.tensor([0.0, -0.19 * math.sin(tilt), 0.19 * (math.cos(tilt) - 1)], dtype=torch.float64)
    task.rate.fill_(2.0)
    task.tilt.fill_(tilt)
    now = replace(env.now, object=env.now.object._replace(pos=pos.expand(4, 3)))
    terms = task.reward(now, torch.zeros(4, dtype=torch.bool))
    assert terms[term].tolist() == pytest.approx([expected(tilt)] * 4, abs=1e-9)


def test_spinning_pays_up_to_a_tilt_of_fifteen_degrees():
    """At 2 rad/s, spin, alignment and distance sum to zero between 14 and 16 degrees."""

    def sum_at(degrees):
        tilt = math.radians(degrees)
        return 20 - 400 * (1 - math.cos(tilt)) - 300 * max(0.0, 0.38 * math.sin(tilt / 2) - 0.02)

    assert sum_at(14) > 0 > sum_at(16)


def test_only_upright_turns_count_for_the_score(env):
    env.reset(0)
    degrees = torch.tensor([0.0, 19.0, 21.0, 40.0], dtype=torch.float64)
    tilt = torch.deg2rad(degrees)
    place(env, 0.0, tilt)
    env.step(torch.zeros(4, 2))
    old_score = env.task.score().clone()
    for i in range(1, 9):
        place(env, -0.05 * i, tilt)
        result = env.step(torch.zeros(4, 2))
    assert not result.terminated.any()
    # Averaged over 10 s, although only 0.2 s have passed.
    assert (result.info.score - old_score).tolist() == pytest.approx([0.04, 0.04, 0, 0], abs=1e-3)
    torch.testing.assert_close(env.task.tilt, tilt, rtol=0, atol=1e-4)


def test_a_fallen_or_disengaged_screwdriver_terminates_the_episode(env):
    env.reset(0)
    place(env, 0.0, torch.tensor([0.79, 0.81, 0.0, 0.0], dtype=torch.float64))
    env.sim.qpos[2:, 5] += torch.tensor([0.0049, 0.0051], dtype=torch.float64)
    result = env.step(torch.zeros(4, 2))
    assert result.terminated.tolist() == [False, True, False, True]
    assert result.info.terms["drop"].tolist() == pytest.approx([0, -2.5, 0, -2.5])
    assert env.steps.tolist() == [1, 0, 1, 0] and env.task.turned.tolist()[1] == 0.0
    # The finished environments start from new grasps; the others continue.
    assert (env.task.tilt[[1, 3]] < 0.2).all() and env.task.tilt[0] == pytest.approx(0.79, abs=1e-3)


def test_joint_limits_and_the_hands_pose_cost(env):
    env.reset(0)
    now, task = env.now, env.task
    pos = now.joint_pos.clone()
    pos[:, 0] = task.setup.low[0] + 0.5 * (task.setup.high[0] - task.setup.low[0]) * 1.95 + 0.02
    terms = task.reward(replace(now, joint_pos=pos), torch.zeros(4, dtype=torch.bool))
    assert terms["joint_limit"].tolist() == pytest.approx([-40 * 0.02] * 4)
    deviation = (pos[:, 0] - now.joint_pos[:, 0]).square()
    torch.testing.assert_close(terms["hand_pose"], -deviation)


def test_groups_match_the_paper(env):
    """There is no goal; the probes are in the object's state, and its properties are friction and mass."""
    obs = env.reset(5)
    assert env.groups == {"proprio": 6, "priv_proprio": 12, "priv_obj_state": 3 + 6 + 3 + 3 + 4, "priv_obj_props": 2}
    state, qpos = obs["priv_obj_state"].double(), env.sim.qpos
    torch.testing.assert_close(state[:, :3], qpos[:, 3:6], rtol=0, atol=1e-6)
    for i in range(4):
        matrix = rotation(qpos[i, 6:10].numpy())
        np.testing.assert_allclose(state[i, 3:9], np.concatenate([matrix[:, 0], matrix[:, 1]]), rtol=0, atol=1e-6)
    assert not state[:, 9:15].any()
    # The probes touch the rod's faces or slightly penetrate them.
    assert (state[:, 15:].abs() < 2e-3).all()
    volumes = torch.tensor([8 * 0.01 * 0.01 * 0.04, 8 * 0.014 * 0.014 * 0.04] * 2)
    mass = volumes * torch.tensor([1000.0, 600.0] * 2)
    torch.testing.assert_close(obs["priv_obj_props"], torch.stack([torch.ones(4), mass], dim=1))


def test_the_task_requires_grasps(env):
    with pytest.raises(SimulationError, match="this task begins with grasps"):
        type(env.task)(env.spec, replace(env.task.setup, grasps=None))


def test_an_unknown_site_is_named(tmp_path):
    with pytest.raises(SimulationError, match='the scene has no site "point"'):
        pincer_env(tmp_path, 2, overrides={"tip": "point"})


@pytest.mark.slow
def test_the_hand_holds_the_screwdriver_without_actions():
    """With all randomisation: nine in ten stand for three seconds, and none turns by itself."""
    env = TouchEnv(DOCUMENT, 16, threads=1, overrides={"touch": "none", "grasps.num": 16})
    dropped = torch.zeros(16, dtype=torch.bool)
    for _ in range(120):
        result = env.step(torch.zeros(16, 8))
        dropped |= result.terminated
        assert not result.info.faults.any() and result.reward.isfinite().all()
    assert dropped.sum() <= 1 and result.info.score[~dropped].abs().max() < 0.1
    tip = env.now.watched.site_pos[:, 0] - env.task.upright_tip
    assert tip.norm(dim=1).max() < 2.5e-3
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("touch", ["force_torque", "elastomer", "proximity", "force_taxel"])
def test_all_kinds_of_touch_begin_with_a_grasp(touch):
    env = TouchEnv(DOCUMENT, 4, threads=1, overrides={"touch": touch, "resolution": "low", "grasps.num": 16})
    obs = env.reset(0)
    assert obs["tactile_sensors"].abs().amax(dim=1).gt(0).all() and env.now.link_force.norm(dim=2).gt(0.1).sum(dim=1).min() >= 3
    result = env.step(torch.zeros(4, 8))
    assert all(value.isfinite().all() for value in result.obs.values())
    env.close()


@pytest.mark.slow
def test_a_gait_spins_every_handle_the_right_way():
    """The example's gait with all randomisation: over 2 rad/s on average, and most hold for three seconds."""
    gait = runpy.run_path(str(DOCUMENT.with_name("screwdriver_gait.py")))["gait"]
    env = TouchEnv(DOCUMENT, 16, threads=1, overrides={"touch": "none", "grasps.num": 16})
    obs, dropped, angle = env.reset(1), torch.zeros(16, dtype=torch.bool), torch.zeros(16)
    for _ in range(120):
        result = env.step(gait(env, obs))
        obs, dropped = result.obs, dropped | result.terminated
        angle += torch.where(dropped, 0.0, env.task.rate.float() * env.control_step)
    assert dropped.sum() <= 8
    rate = (angle / 3.0).view(-1, 4)  # one column per handle
    assert rate.mean() > 2.0 and (rate.mean(dim=0) > 0.8).all()
    env.close()
