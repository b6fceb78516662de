"""Spinning a screwdriver: rewards, ends and scores against the reference, what pays, what is observed."""

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
"""Other numbers than the document's, and enough going on that every term is seen."""
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


def by_tip(env, upright, length):
    """Return the reference, given where the tip is: so far below the body's origin, which was upright at a place."""
    setup = env.task.setup
    own = {"fingers": are_fingers(setup.model, setup.links)}

    def told(spec, record, dt):
        down = np.array([0, 0, -length])
        tip = record["pos"] + np.stack([rotation(quat) @ down for quat in record["quat"]])
        return screwdriver(spec, {**record, **own, "tip": tip, "upright_pos": upright, "upright_tip": upright + down}, dt)

    return told


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    """Four rods without weight and drives without faults."""
    made = pincer_env(tmp_path_factory.mktemp("rod"), 4, gravity="0 0 0", more="episode: 10 s\n")
    yield made
    made.close()


def test_rewards_ends_and_scores_equal_the_reference(tmp_path):
    env = pincer_env(tmp_path, 6, overrides=ODD)
    recorder = Recorder(env)
    for i, action in enumerate(random_actions(env, 90)):
        action[0] = -1.0  # this one opens to the end of its range, and its rod stays where it is
        env.sim.qpos[0, FREE], env.sim.qvel[0, 3:] = torch.tensor([0, 0, 0.1, 1, 0, 0, 0]), 0.0
        if i % 10 < 4:
            env.sim.qvel[1:3, 8] = torch.tensor([-8.0, 3.0], dtype=torch.float64)  # spun by hand
        recorder.step(action)
    assert sum(len(episodes) for episodes in recorder.episodes) > 18
    found = assert_reference(recorder, by_tip(env, np.array([0, 0, 0.1]), LENGTH))
    assert found == {*Screwdriver.Rewards.model_fields, "is_over", "score"}
    env.close()


def test_bounds_and_stalled_episodes_equal_the_reference(tmp_path):
    own = {
        "max_spin": 0.2,
        "min_spin": -0.2,
        "stall": {"within": "0.25 s", "turn": 0.2},
        "engagement": "5 cm",
        "drop_tilt": 1.5,
    }
    env = pincer_env(tmp_path, 4, overrides=ODD | own | {"episode": "3 s", "randomise.push": "{}"})
    recorder = Recorder(env)
    for i, action in enumerate(random_actions(env, 60)):
        env.sim.qvel[:, 8] = torch.tensor([-8.0, -0.5, 0.0, 3.0], dtype=torch.float64) * (i < 40)
        recorder.step(action)
    seen = assert_reference(recorder, by_tip(env, np.array([0, 0, 0.1]), LENGTH))
    assert {"spin", "is_over"} <= seen
    lengths = [[len(rows) for _, rows in episodes] for episodes in recorder.episodes]
    assert max(lengths[0]) > 20 and max(lengths[2]) == 10, lengths
    env.close()


@pytest.mark.slow
def test_the_hand_too():
    env = TouchEnv(DOCUMENT, 8, threads=1, overrides={"touch": "none", "grasps.num": 16})
    recorder = Recorder(env)
    for action in random_actions(env, 80):
        recorder.step(action)
    found = assert_reference(recorder, by_tip(env, np.array([0.09, 0.08, 0.215]), 0.19))
    assert {*Screwdriver.Rewards.model_fields, "is_over", "score"} - {"joint_limit", "contact_force", "effort"} <= found
    env.close()


def turned(env, rates, steps=8, tilt=0.0):
    """Return the mean reward of rods that a script turns clockwise as seen from above, at a rate each [rad/s]."""
    env.reset(0)
    total, rates = torch.zeros(env.num_envs), torch.as_tensor(rates, dtype=torch.float64)
    begin = env.now.object.quat.clone()
    for i in range(1, steps + 1):
        place(env, -rates * env.control_step * i, tilt, begin)
        total += env.step(torch.zeros(env.num_envs, env.num_actions)).reward
    return total / steps


def place(env, yaw, tilt, begin=None):
    """Turn rods about their own axis, then tilt them about the world's x, the tip where it was; jaws out of the way."""
    yaw = torch.as_tensor(yaw, dtype=torch.float64).expand(env.num_envs)
    w, z = (0.5 * yaw).cos(), (0.5 * yaw).sin()
    if begin is not None:
        w, z = begin[:, 0] * w - begin[:, 3] * z, begin[:, 0] * z + begin[:, 3] * w
    tilt = torch.as_tensor(tilt, dtype=torch.float64).expand(env.num_envs)
    c, s = (0.5 * tilt).cos(), (0.5 * tilt).sin()
    quat = torch.stack([c * w, s * w, -s * z, c * z], dim=1)
    pos = torch.stack([0 * tilt, -LENGTH * tilt.sin(), 0.1 - LENGTH + LENGTH * tilt.cos()], dim=1)
    env.sim.qpos[:, FREE] = torch.cat([pos, quat], dim=1)
    env.sim.qpos[:, :2] = 0.0
    env.sim.qvel[:] = 0.0
    env.actuation.target[:] = 0.0


def test_the_right_way_beats_rest_and_rest_beats_the_wrong_way(env):
    """The right way is clockwise as seen from the handle."""
    rest, slow, right, fast = turned(env, [0.0, 0.5, 2.0, 20.0]).tolist()
    wrong, slowly_wrong, same, far_wrong = turned(env, [-2.0, -0.5, 0.0, -20.0]).tolist()
    assert far_wrong < wrong < slowly_wrong < rest < slow < right < fast and rest == pytest.approx(same, abs=1e-5)
    dt, share = env.control_step, 0.975  # readings are of the start of the last physics step of 5 ms: not all of the last step
    assert right - rest == pytest.approx(10 * 2.0 * dt * share, rel=0.03)
    assert rest - wrong == pytest.approx(10 * 2.0 * dt * share, rel=0.03)
    assert fast - rest == pytest.approx(10 * 6.0 * dt, rel=0.03)  # the most that it pays
    assert rest - far_wrong == pytest.approx(10 * 20.0 * dt * share, rel=0.03)  # and what it costs has no bound


def test_turning_to_and_fro_pays_nothing_however_fast_either_way(env):
    """Slowly forth and at once back, and the other way round."""
    env.reset(0)
    slowly, back = np.linspace(0, 1.0, 21)[1:], np.linspace(1.0, 0, 21)[1:]
    total = torch.zeros(env.num_envs)
    place(env, 0.0, 0.0)
    before = env.step(torch.zeros(4, 2)).info.score
    for angle in [*slowly, 0.0, 0.0, 1.0, 1.0, *back, 0.0]:
        place(env, -angle, 0.0)
        result = env.step(torch.zeros(4, 2))
        total += result.info.terms["spin"]
    # The fast way forth pays less than it is worth.
    assert (total <= 1e-6).all() and (result.info.score - before).tolist() == pytest.approx([0.0] * 4, abs=1e-4)


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        ("spin", lambda tilt: 20.0),
        ("alignment", lambda tilt: -400 * (1 - math.cos(tilt))),
        ("object_distance", lambda tilt: -300 * max(0.0, 2 * 0.19 * math.sin(tilt / 2) - 0.02)),
    ],
)
@pytest.mark.parametrize("degrees", [0.0, 5.0, 10.0, 20.0])
def test_what_terms_are_worth_beside_a_spin_of_two_radians_per_second(env, term, expected, degrees):
    """A screwdriver of 19 cm from the handle's middle to the tip, as the page's table has it."""
    env.reset(0)
    tilt, task = math.radians(degrees), env.task
    pos = task.upright_pos + torch.tensor([0.0, -0.19 * math.sin(tilt), 0.19 * (math.cos(tilt) - 1)], dtype=torch.float64)
    task.rate.fill_(2.0)
    task.tilt.fill_(tilt)
    now = replace(env.now, object=env.now.object._replace(pos=pos.expand(4, 3)))
    terms = task.reward(now, torch.zeros(4, dtype=torch.bool))
    assert terms[term].tolist() == pytest.approx([expected(tilt)] * 4, abs=1e-9)


def test_spinning_pays_up_to_a_tilt_of_fifteen_degrees():
    """By the table: at 2 rad/s spin, alignment and distance sum to zero between 14 and 16 degrees."""

    def sum_at(degrees):
        tilt = math.radians(degrees)
        return 20 - 400 * (1 - math.cos(tilt)) - 300 * max(0.0, 0.38 * math.sin(tilt / 2) - 0.02)

    assert sum_at(14) > 0 > sum_at(16)


def test_only_what_is_turned_upright_counts_for_the_score(env):
    env.reset(0)
    degrees = torch.tensor([0.0, 19.0, 21.0, 40.0], dtype=torch.float64)
    tilt = torch.deg2rad(degrees)
    place(env, 0.0, tilt)
    env.step(torch.zeros(4, 2))
    before = env.task.score().clone()
    for i in range(1, 9):
        place(env, -0.05 * i, tilt)
        result = env.step(torch.zeros(4, 2))
    assert not result.terminated.any()
    # Over 10 s, although 0.2 s have passed.
    assert (result.info.score - before).tolist() == pytest.approx([0.04, 0.04, 0, 0], abs=1e-3)
    torch.testing.assert_close(env.task.tilt, tilt, rtol=0, atol=1e-4)


def test_a_screwdriver_that_has_fallen_or_left_its_screw_ends_the_episode(env):
    env.reset(0)
    place(env, 0.0, torch.tensor([0.79, 0.81, 0.0, 0.0], dtype=torch.float64))
    env.sim.qpos[2:, 5] += torch.tensor([0.0049, 0.0051], dtype=torch.float64)
    result = env.step(torch.zeros(4, 2))
    assert result.terminated.tolist() == [False, True, False, True]
    assert result.info.terms["drop"].tolist() == pytest.approx([0, -2.5, 0, -2.5])
    assert env.steps.tolist() == [1, 0, 1, 0] and env.task.turned.tolist()[1] == 0.0
    # The others go on as they were, and those begin with grasps of their own.
    assert (env.task.tilt[[1, 3]] < 0.2).all() and env.task.tilt[0] == pytest.approx(0.79, abs=1e-3)


def test_a_joint_at_the_end_of_its_range_and_a_hand_elsewhere_cost(env):
    env.reset(0)
    now, task = env.now, env.task
    pos = now.joint_pos.clone()
    pos[:, 0] = task.setup.low[0] + 0.5 * (task.setup.high[0] - task.setup.low[0]) * 1.95 + 0.02
    terms = task.reward(replace(now, joint_pos=pos), torch.zeros(4, dtype=torch.bool))
    assert terms["joint_limit"].tolist() == pytest.approx([-40 * 0.02] * 4)
    away = (pos[:, 0] - now.joint_pos[:, 0]).square()
    torch.testing.assert_close(terms["hand_pose"], -away)


def test_groups_are_the_papers_by_name(env):
    """No goal; the probes are in the object's state, friction and mass alone in its properties."""
    obs = env.reset(5)
    assert env.groups == {"proprio": 6, "priv_proprio": 12, "priv_obj_state": 3 + 6 + 3 + 3 + 4, "priv_obj_props": 2}
    state, qpos = obs["priv_obj_state"].double(), env.sim.qpos
    torch.testing.assert_close(state[:, :3], qpos[:, 3:6], rtol=0, atol=1e-6)
    for i in range(4):
        matrix = rotation(qpos[i, 6:10].numpy())
        np.testing.assert_allclose(state[i, 3:9], np.concatenate([matrix[:, 0], matrix[:, 1]]), rtol=0, atol=1e-6)
    assert not state[:, 9:15].any()
    # The probes touch the rod's faces, or are a little in them.
    assert (state[:, 15:].abs() < 2e-3).all()
    volumes = torch.tensor([8 * 0.01 * 0.01 * 0.04, 8 * 0.014 * 0.014 * 0.04] * 2)
    mass = volumes * torch.tensor([1000.0, 600.0] * 2)
    torch.testing.assert_close(obs["priv_obj_props"], torch.stack([torch.ones(4), mass], dim=1))


def test_it_begins_with_grasps_or_not_at_all(env):
    with pytest.raises(SimulationError, match="this task begins with grasps"):
        type(env.task)(env.spec, replace(env.task.setup, grasps=None))


def test_a_site_that_the_scene_lacks_is_named(tmp_path):
    with pytest.raises(SimulationError, match='the scene has no site "point"'):
        pincer_env(tmp_path, 2, overrides={"tip": "point"})


@pytest.mark.slow
def test_the_hand_holds_the_screwdriver_without_an_action():
    """With all that is random: for five seconds nine in ten stand, and nothing turns by itself."""
    env = TouchEnv(DOCUMENT, 16, threads=1, overrides={"touch": "none"})
    dropped = torch.zeros(16, dtype=torch.bool)
    for _ in range(200):
        result = env.step(torch.zeros(16, 8))
        dropped |= result.terminated
        assert not result.info.faults.any() and result.reward.isfinite().all()
    assert dropped.sum() <= 1 and result.info.score[~dropped].abs().max() < 0.1
    tip = env.now.watched.site_pos[:, 0] - env.task.upright_tip
    assert tip.norm(dim=1).max() < 2.5e-3
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("touch", ["force_torque", "elastomer", "proximity", "force_taxel"])
def test_kinds_of_touch_of_every_quantity_begin_with_the_same_grasps(touch):
    env = TouchEnv(DOCUMENT, 4, threads=1, overrides={"touch": touch, "resolution": "low", "grasps.num": 16})
    obs = env.reset(0)
    assert obs["tactile_sensors"].abs().amax(dim=1).gt(0).all() and env.now.link_force.norm(dim=2).gt(0.1).sum(dim=1).min() >= 3
    result = env.step(torch.zeros(4, 8))
    assert all(value.isfinite().all() for value in result.obs.values())
    env.close()


@pytest.mark.slow
def test_a_gait_spins_every_handle_the_right_way():
    """What the examples bring, with all that is random: more than 2 rad/s on average, and most hold for three seconds."""
    gait = runpy.run_path(str(DOCUMENT.with_name("screwdriver_gait.py")))["gait"]
    env = TouchEnv(DOCUMENT, 16, threads=1, overrides={"touch": "none"})
    obs, dropped, turned = env.reset(1), torch.zeros(16, dtype=torch.bool), torch.zeros(16)
    for _ in range(120):
        result = env.step(gait(env, obs))
        obs, dropped = result.obs, dropped | result.terminated
        turned += torch.where(dropped, 0.0, env.task.rate.float() * env.control_step)
    assert dropped.sum() <= 8
    rate = (turned / 3.0).view(-1, 4)  # one column per handle
    assert rate.mean() > 2.0 and (rate.mean(dim=0) > 0.8).all()
    env.close()
