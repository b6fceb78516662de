"""Finding the hot ball: rewards and terminations against the reference, the latch, incentives, starts and resets."""

import itertools
import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from task_records import Recorder, assert_reference
from task_references import hot_ball

from tgdsl.errors import LowerError, SpecError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.tasks.hot_ball import HotBall
from tgdsl.schema.load import load

FOLDER = Path(__file__).parents[3] / "examples" / "tasks"
DOCUMENT = FOLDER / "hot_ball.yaml"
NUM_BALLS = 8
CALM = {"randomise.drive": {}, "randomise.xy": 0.0}
"""Ideal drives, and balls in the keyframe's places."""


def bin_of_balls(num_envs, **overrides):
    named = {name.replace("__", "."): value for name, value in overrides.items()}
    return TouchEnv(DOCUMENT, num_envs, threads=1, overrides=CALM | named)


@pytest.fixture(scope="module")
def env():
    """Two bins, ideal drives."""
    bins = bin_of_balls(2)
    yield bins
    bins.close()


def zero_actions(env):
    return torch.zeros(env.num_envs, env.num_actions)


def random_actions(env, num, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [2 * torch.rand((env.num_envs, env.num_actions), generator=generator) - 1 for _ in range(num)]


def ball_positions(env):
    """Return the positions of all balls, the hot one first: (env, ball, 3) [m]."""
    return env.sim.qpos[:, env.task.places][:, :, :3]


def put_on(env, ball, press=0.03, ahead=0.0):
    """Put the middle fingertip on a ball of each environment, or ahead of its top [m], and let the base press."""
    for i, index in enumerate(ball):
        data = mujoco.MjData(env.sim.model)
        data.qpos[:] = env.sim.qpos[i].numpy()
        mujoco.mj_kinematics(env.sim.model, data)
        top = ball_positions(env)[i, index].numpy() + [ahead, 0.0, 0.04]
        env.sim.qpos[i, :3] += torch.from_numpy(top - data.site("right_hand_mid_tip").xpos)
    env.sim.qvel.zero_()
    env.actuation.target[:, :3] = env.sim.qpos[:, :3] - torch.tensor([0.0, 0.0, press])


@pytest.fixture(scope="module")
def rolled(env):
    """Return positions after the balls have rolled to the wall, from seed 0."""
    env.reset(0)
    for _ in range(30):
        env.step(zero_actions(env))
    return env.sim.qpos.clone()


def press_on(env, rolled, ball):
    """Start with the balls at the wall and the middle fingertip on a ball of each environment."""
    env.reset(0)
    env.sim.qpos.copy_(rolled[: env.num_envs])
    put_on(env, ball)


def hottest(env):
    """Return the reading of the hottest cell [°C]."""
    return env.now.readings["heat"].amax(dim=(1, 2))


def cells(now):
    return {"heat": now.readings["heat"][:, :, 0].double().numpy().copy()}


ODD = {
    "episode": "0.6 s", "margin": 0.95, "min_force": "0.5 N", "near_width": "5 cm", "lost_height": "12 cm",
    "ambient": "21 degC", "target": "60 degC", "action.slide_scale": "1 mm", "action.scale": 0.01,
    "rewards": {name: 1.5 * value for name, value in HotBall.Rewards()},
}  # fmt: skip
"""Numbers unlike the document's, chosen so that every term occurs."""


def test_rewards_ends_and_scores_equal_the_reference():
    """Balls of the lower row sink below 12 cm and are lost; those of the upper row stay and are pressed."""
    env = bin_of_balls(8, **ODD)
    recorder = Recorder(env, cells)
    for i, action in enumerate(random_actions(env, 40)):
        if i % 12 == 2:
            put_on(env, [0] * 8, press=0.03)
        recorder.step(action)
    assert sum(len(episodes) for episodes in recorder.episodes) > 12
    assert assert_reference(recorder, hot_ball) == {*HotBall.Rewards.model_fields, "is_over", "score"}
    env.close()


@pytest.mark.slow
def test_the_unchanged_document_equals_the_reference():
    env = TouchEnv(DOCUMENT, 8, threads=1)
    recorder = Recorder(env, cells)
    for action in random_actions(env, 60):
        recorder.step(action)
    assert {"approach", "action_rate", "work"} <= assert_reference(recorder, hot_ball)
    env.close()


def test_terms_sum_to_the_reward(env):
    env.reset(0)
    for action in random_actions(env, 3):
        result = env.step(action)
        torch.testing.assert_close(sum(result.info.terms.values()), result.reward)


@pytest.mark.parametrize(
    ("margin", "steps", "least", "most"), [(0.5, 80, 0.4, 1.8), pytest.param(0.12, 280, 3.0, 6.5, marks=pytest.mark.slow)]
)
def test_only_the_hot_ball_latches(env, rolled, monkeypatch, margin, steps, least, most):
    """One environment touches the hot ball, the other a cold one; the score counts from the latch on."""
    monkeypatch.setattr(env.task, "spec", env.spec.model_copy(update={"margin": margin}))
    press_on(env, rolled, [0, 3])
    latched_at, seconds = torch.full((2,), torch.inf), 0.0
    for _ in range(steps):
        result = env.step(zero_actions(env))
        seconds += env.control_step
        latched_at = torch.where(env.task.is_latched & latched_at.isinf(), seconds, latched_at)
    assert least < latched_at[0] < most and latched_at[1].isinf()
    assert hottest(env)[0] >= 45 - 23 * margin
    np.testing.assert_allclose(hottest(env)[1], 22.0, atol=1e-4)
    np.testing.assert_allclose(result.info.score[0], seconds - latched_at[0] + env.control_step, atol=1e-4)
    assert result.info.score[1] == 0.0
    rates = {name: term / env.control_step for name, term in result.info.terms.items()}
    torch.testing.assert_close(rates["latched"], torch.tensor([10.0, 0.0]))
    assert rates["contact"][1] == 0 and result.reward[0] > 10 * result.reward[1]


@pytest.mark.filterwarnings("ignore::tgdsl.errors.CoarseCellsWarning")  # rubber's cell size does not matter here
def test_rubber_fingers_never_latch(tmp_path, rolled):
    """Heat takes L²/α, half an hour, to cross a 1 cm cell of rubber."""
    text = (FOLDER / "bin.yaml").read_text().replace("bin.xml", str(FOLDER / "bin.xml"))
    material = "material: {like: aluminium, conductivity: 150 W/(m*K), density: 270 kg/m3, emissivity: 0.5}"
    assert material in text
    (tmp_path / "rubber.yaml").write_text(text.replace(material, "material: rubber"))
    env = bin_of_balls(1, document=str(tmp_path / "rubber.yaml"))
    press_on(env, rolled, [0])
    for _ in range(40):
        result = env.step(zero_actions(env))
    assert env.task.is_touched.all() and not env.task.is_latched.any()
    assert (hottest(env) > 22.001).all() and (hottest(env) < 23.0).all() and (result.info.score == 0).all()
    env.close()


def rates_at(env, celsius, force, distance=0.02):
    """Return each term's pay at an instant [1/s]: temperature of the hottest cell, hot ball's force on one fingertip, distance."""
    heat = torch.full_like(env.now.readings["heat"], 22.0)
    heat[:, 37] = celsius
    force_on_links = torch.zeros_like(env.now.link_force)
    force_on_links[:, 2, 1] = force
    distances = torch.full_like(env.now.distance, distance)
    now = replace(env.now, readings={**env.now.readings, "heat": heat}, link_force=force_on_links, distance=distances)
    env.task.advance(now)
    return {name: float(term[0]) for name, term in env.task.reward(now, torch.zeros(env.num_envs, dtype=torch.bool)).items()}


def test_only_latched_contact_counts_and_the_latch_stays(env):
    env.reset(0)
    step, score = env.control_step, lambda: float(env.task.score()[0])
    assert rates_at(env, 42.0, 1.0)["latched"] == 0 and score() == 0  # not hot enough
    assert rates_at(env, 42.3, 0.0)["latched"] == 0 and score() == 0  # latched by heat, without contact
    assert rates_at(env, 42.3, 0.01)["latched"] == 0 and score() == 0  # below the force of a contact
    assert rates_at(env, 42.3, 1.0)["latched"] == 10 and score() == pytest.approx(step)
    assert rates_at(env, 22.0, 1.0)["latched"] == 10 and score() == pytest.approx(2 * step)  # cold again: the latch stays
    assert rates_at(env, 45.0, 0.0)["latched"] == 0 and score() == pytest.approx(2 * step)
    env.reset(0)
    assert rates_at(env, 42.0, 1.0)["latched"] == 0 and score() == 0


def test_the_latch_fires_at_the_margin(env):
    """1 − m of the way from 22 to 45 °C is 42.24 °C; float32 readings are exact to 1e-5 °C."""
    for celsius, fires in ((42.239, False), (42.241, True)):
        env.reset(0)
        rates_at(env, celsius, 0.0)
        assert env.task.is_latched.tolist() == [fires] * 2


def test_instants_nearer_the_goal_pay_more(env):
    """Far, near, touching, warmer, hot: in this order. Below ambient, progress is 0."""
    env.reset(0)
    order = [(10.0, 0.0, 0.5), (22.0, 0.0, 0.2), (22.0, 0.0, 0.01), (22.0, 1.0, 0.0), (30.0, 1.0, 0.0), (44.0, 1.0, 0.0)]
    rewards = [sum(rates_at(env, *instant).values()) for instant in order]
    assert all(less < more for less, more in itertools.pairwise(rewards))
    env.reset(0)
    rates = rates_at(env, 33.5, 1.0, 0.05)
    assert rates["progress"] == pytest.approx(2 * 0.5) and rates["approach"] == pytest.approx(math.exp(-0.25))
    assert rates["contact"] == 1 and rates_at(env, 10.0, 0.0)["progress"] == 0


def test_approaching_the_hot_ball_beats_rest_and_rest_beats_leaving(env):
    rewards = {}
    for direction in (1.0, 0.0, -1.0):
        env.reset(3)
        total = torch.zeros(2)
        for _ in range(20):
            action, towards = zero_actions(env), ball_positions(env)[:, 0, :2].float()  # fingertips are above the middle
            action[:, :2] = 0.3 * direction * towards / towards.norm(dim=1, keepdim=True)
            total += env.step(action).reward
        rewards[direction] = total
    assert (rewards[1.0] > rewards[0.0]).all() and (rewards[0.0] > rewards[-1.0]).all()


def test_groups_of_observations(env, rolled):
    press_on(env, rolled, [0, 3])
    for _ in range(40):
        result = env.step(zero_actions(env))
    heat = env.now.readings["heat"][:, :, 0]
    assert result.obs["tactile_sensors"].shape == (2, 10 * 8)
    torch.testing.assert_close(result.obs["tactile_sensors"], heat.float())
    links = env.touch.rows["heat"]["link"]
    link_maxima = [heat[:, torch.from_numpy(links == name)].amax(dim=1) for name in dict.fromkeys(links.tolist())]
    progress = ((torch.stack(link_maxima, dim=1).double() - 22) / 23).clamp(0, 1)
    assert progress[0].amax() > 0.2 and (progress[1] < 1e-5).all()
    torch.testing.assert_close(result.obs["priv_heat"][:, :10], progress.float())
    assert result.obs["priv_heat"][:, 10:].tolist() == [[0, 1], [0, 0]]
    joints = torch.cat([env.sim.qpos[:, :15], env.sim.qvel[:, :15], zero_actions(env)], dim=1)
    torch.testing.assert_close(result.obs["proprio"], joints.float(), rtol=0, atol=1e-2)  # a physics step earlier
    torch.testing.assert_close(result.obs["priv_obj_state"][:, :3], ball_positions(env)[:, 0].float(), rtol=0, atol=1e-4)
    assert env.groups == {"proprio": 45, "tactile_sensors": 80, "priv_proprio": 60, "priv_heat": 12, "priv_obj_state": 15,
                          "priv_obj_props": 2 + 45}  # fmt: skip


def test_the_policys_observations_do_not_reveal_the_hot_ball(env):
    """At the start, proprioception is the same for all places of the hot ball, and all cells are at ambient temperature."""
    first = env.reset(0)
    place = ball_positions(env)[:, 0].clone()
    second = env.reset()
    assert not torch.equal(place, ball_positions(env)[:, 0])
    for name in ("proprio", "tactile_sensors"):
        torch.testing.assert_close(first[name], second[name], rtol=0, atol=0)
    assert (first["tactile_sensors"] == 22).all()


def test_balls_fill_all_places_and_the_hot_one_is_uniform():
    """In 400 episodes the hot ball takes each place 50 times, within 5 binomial standard deviations; no two balls share one."""
    env = bin_of_balls(4, touch="none", randomise__xy=["-1.5 cm", "1.5 cm"])
    key = env.task.setup.qpos[env.task.places][:, :3]
    count, offsets = torch.zeros(NUM_BALLS), []
    for episode in range(100):
        start = env.task.reset(torch.ones(4, dtype=torch.bool), torch.full((4,), episode)).values["qpos"]
        pos = start[:, env.task.places][:, :, :3]
        distance = (pos[:, :, None] - key[None, None]).norm(dim=3)
        nearest = distance.argmin(dim=2)
        assert (nearest.sort(dim=1).values == torch.arange(NUM_BALLS)).all()
        count += torch.bincount(nearest[:, 0], minlength=NUM_BALLS)
        offset = pos - key[nearest]
        assert (offset[:, :, 2] == 0).all()
        offsets.append(offset[:, :, :2])
        assert (torch.cdist(pos, pos) + torch.eye(NUM_BALLS) > 0.08).all()  # balls do not overlap
    assert ((count - 50).abs() < 5 * math.sqrt(400 * 7 / 64)).all()
    offsets = torch.stack(offsets)
    assert 0.0149 < offsets.abs().max() <= 0.015
    assert offsets.mean().abs() < 5 * 0.015 / math.sqrt(3 * offsets.numel())
    env.close()


def test_balls_and_hand_rest(env):
    """For one second without actions the hand stays above, the balls stay in the bin, and neither touches the other."""
    env.reset(1)
    for _ in range(40):
        result = env.step(zero_actions(env))
        assert not result.info.ended.any()
    assert (env.sim.qpos[:, :3].abs() < 0.01).all() and env.sim.qvel.abs().max() < 1.0
    centres, gaps = (
        ball_positions(env),
        (ball_positions(env)[:, :, None] - ball_positions(env)[:, None]).norm(dim=3) + torch.eye(NUM_BALLS),
    )
    assert (centres[:, :, :2].abs() < 0.23).all() and (centres[:, :, 2] > 0.1).all() and (gaps > 0.079).all()
    assert (result.obs["tactile_sensors"] == 22).all() and (result.info.score == 0).all()


def test_a_reset_restores_temperatures_in_its_environment_only(env, rolled):
    """In the finished environment balls and fingers are reset; in the other, temperatures continue."""
    press_on(env, rolled, [0, 0])
    for _ in range(60):
        env.step(zero_actions(env))
    old_heat = env.now.readings["heat/objects"][:, :, 0].clone()
    assert (hottest(env) > 25).all() and (old_heat[:, 0] < 44.98).all() and env.task.is_touched.all()
    old_memory = {name: value.clone() for name, value in env.task.memory.items()}
    env.sim.qpos[1, env.task.places[0][:3]] = torch.tensor([0.8, 0.0, 0.041]).double()  # on the ground outside the bin
    result = env.step(zero_actions(env))
    assert result.terminated.tolist() == [False, True] and not result.truncated.any()
    assert result.info.terms["lost"].tolist() == pytest.approx([0, -100 * env.control_step])
    objects = env.now.readings["heat/objects"][:, :, 0]
    torch.testing.assert_close(objects[1], torch.tensor([45.0] + [22.0] * 7), rtol=0, atol=1e-4)
    assert (result.obs["tactile_sensors"][1] == 22).all() and hottest(env)[0] > 25
    assert 44 < objects[0, 0] < 44.98
    assert not env.task.progress[1].any() and not env.task.is_touched[1]
    assert env.task.progress[0].amax() > old_memory["progress"][0].amax()


def test_an_episode_is_truncated_at_its_length():
    env = bin_of_balls(2, episode="0.1 s", touch="none")
    assert [bool(env.step(zero_actions(env)).truncated.all()) for _ in range(8)] == [False, False, False, True] * 2
    assert "tactile_sensors" not in env.groups and env.task.cells.shape == (10, 8)  # the latch uses all fingers
    env.close()


def test_groups_follow_placement_and_touch():
    env = bin_of_balls(1, placement="tips")
    assert env.groups["tactile_sensors"] == 5 * 8 and env.groups["priv_heat"] == 5 + 2
    env.close()
    env = bin_of_balls(1, touch="agg_force", placement="tips")
    assert env.groups["tactile_sensors"] == 5 * 3 and env.groups["priv_heat"] == 10 + 2
    env.close()


def test_progress_does_not_depend_on_the_outputs_of_cells(tmp_path, rolled):
    """`spacing` gives long links more cells; `outputs: max` leaves one number per link."""
    text = (FOLDER / "bin.yaml").read_text().replace("bin.xml", str(FOLDER / "bin.xml"))
    readings = []
    for i, cell_settings in enumerate(("spacing: 2 cm", "spacing: 2 cm\n    outputs: max")):
        (tmp_path / f"{i}.yaml").write_text(text.replace("cells: [2, 2, 2]", cell_settings))
        env = bin_of_balls(1, document=str(tmp_path / f"{i}.yaml"))
        press_on(env, rolled, [0])
        for _ in range(10):
            result = env.step(zero_actions(env))
        readings.append(result.obs["priv_heat"])
        env.close()
    torch.testing.assert_close(*readings)
    assert readings[0][0, :10].max() > 0.1


def test_the_task_and_its_sensors_agree_about_temperatures():
    spec = load(FOLDER / "bin.yaml").spec
    task = load_task(DOCUMENT).spec
    heat, (hot, *cold) = spec.sensors["heat"], spec.objects.values()
    assert (heat.ambient, hot.temperature) == (task.ambient, task.target) == (22.0, 45.0)
    assert {ball.temperature for ball in cold} == {None} and len(cold) == 7 and task.margin == 0.12


@pytest.mark.parametrize(
    ("changes", "path", "says"),
    [
        ({"randomise": {"friction": [0.5, 1.5]}}, "randomise", "`friction` would be the hot ball's alone"),
        ({"randomise": {"mass": [0, "10 g"]}}, "randomise", "`mass` would be the hot ball's alone"),
        ({"randomise": {"push": {"x": ["-1 N", "1 N"]}}}, "randomise", "`push` would be the hot ball's alone"),
        ({"target": "20 degC"}, "", "more than `ambient`"),
        ({"target": "3 mm"}, "target", "unit of temperature"),
        ({"margin": 1.5}, "margin", "1.5"),
        ({"rewards": {"heat": 1}}, "rewards.heat", "unknown key"),
    ],
)
def test_errors_are_located(changes, path, says):
    with pytest.raises(SpecError) as caught:
        load_task(DOCUMENT, changes)
    (problem,) = caught.value.problems
    assert problem.path == path and says in f"{problem.what}; {problem.hint}"


@pytest.mark.parametrize(
    ("others", "says"),
    [
        (("ball9",), 'no body "ball9"'),
        (("bin",), 'body "bin" has no free joint'),
        (("ball1", "ball1"), "named twice"),
        (("ball0",), "the object is among them"),
    ],
)
def test_invalid_other_balls_are_refused(env, others, says):
    with pytest.raises(LowerError, match=says) as caught:
        HotBall(env.spec.model_copy(update={"others": others}), env.task.setup)
    assert caught.value.field == "others"


@pytest.mark.parametrize("simulator", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
def test_random_actions_in_both_simulators(simulator):
    """One second of the document's task: finite values, no faults, plausible temperatures, the hand in its range."""
    env = TouchEnv(DOCUMENT, 2, threads=1, simulator=simulator)
    for action in random_actions(env, 40):
        result = env.step(action)
        assert not result.info.faults.any() and result.reward.isfinite().all()
        assert all(value.isfinite().all() for value in result.obs.values())
        heat = result.obs["tactile_sensors"]
        assert (heat > 21.999).all() and (heat < 45.001).all()
    assert (env.sim.qpos[:, :2].abs() < 0.21).all() and (ball_positions(env)[:, :, 2] > 0.03).all()
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("touch", ["bool", "force_torque", "elastomer", "proximity", "force_taxel"])
def test_other_kinds_of_touch_feel_every_ball(touch, rolled):
    """Touch changes when a fingertip is on a cold ball, as on the hot one."""
    env = bin_of_balls(2, touch=touch)
    env.reset(0)
    env.sim.qpos.copy_(rolled[:2])
    untouched = env.step(zero_actions(env)).obs["tactile_sensors"]
    put_on(env, [0, 3], ahead=0.02)  # contact is on the pad, which faces down and back
    for _ in range(10):
        touched = env.step(zero_actions(env)).obs["tactile_sensors"]
    assert ((touched - untouched).abs().amax(dim=1) > 0).all() and touched.isfinite().all()
    env.close()
