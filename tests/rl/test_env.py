"""Control steps of TouchEnv: order of operations, episodes, random numbers, messages."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from tiny_tasks import NOISY, RADIUS, RANDOM, actions, same, taxel_world, tiny_env, tiny_envs, write_task
from torch._inductor import config as inductor

from tgdsl.errors import SimulationError, SpecError
from tgdsl.module.module import TactileModule
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.sensors import PolicyTouch
from tgdsl.runtime import connect
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.connect import SOURCES
from tgdsl.runtime.xhand1.source import TIME_CONSTANT_S, VelocityFilter

STEPS = 12


@pytest.fixture
def make(tmp_path):
    yield from tiny_envs(tmp_path)


def test_groups_match_the_paper(make):
    env = make()
    num_features = 6 * 4
    assert env.groups == {
        "proprio": 3 * 2,
        "tactile_sensors": num_features,
        "priv_proprio": 3 * 2 + 2 * 3,
        "goal": 7,
        "priv_obj_state": 3 + 6 + 3 + 3,
        "priv_obj_props": 2 + 4,
    }
    obs = env.reset()
    qpos, qvel = env.sim.qpos, env.sim.qvel
    torch.testing.assert_close(obs["proprio"][:, :2], qpos[:, :2].float())
    torch.testing.assert_close(obs["proprio"][:, 2:4], qvel[:, :2].float())
    assert not obs["proprio"][:, 4:].any()
    ball = obs["priv_obj_state"]
    torch.testing.assert_close(ball[:, :3], qpos[:, 3:6].float())
    assert ball[:, 3:9].tolist() == [[1, 0, 0, 0, 1, 0]] * 4 and not ball[:, 9:].any()
    torch.testing.assert_close(obs["priv_obj_props"][:, :2], torch.tensor([[0.8, 0.1]] * 4))
    for column, (body, x) in enumerate((("left", 0.005), ("left", 0.005), ("right", -0.005), ("right", -0.005))):
        offset = 0.01 if column % 2 else 0.0
        point = taxel_world(env, body, (x, offset, offset), env.sim.qpos[0].numpy())
        expected = float((point - env.sim.qpos[0, 3:6]).norm()) - RADIUS
        assert obs["priv_obj_props"][0, 2 + column].item() == pytest.approx(expected, abs=1e-6)
    action = actions(env, 1)[0]
    result = env.step(action)
    torch.testing.assert_close(result.obs["proprio"][:, 4:], action)
    assert torch.equal(result.obs["priv_proprio"][:, :6], result.obs["proprio"])


@pytest.mark.parametrize("simulator", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
def test_every_group_describes_the_current_instant(make, simulator):
    """The ball moves as a known function of time, and each reset moves it: readings are never one step late."""
    env = make(3, task="tiny_tasks:Coasting", gravity="0 0 0", more="episode: 0.1 s\ndrop_distance: 1\n", simulator=simulator)
    assert env.max_steps == 4 and env.control_step == 0.025
    env.reset()
    env.steps[1] = 2  # the other episodes end two steps later
    age, episode = torch.zeros(3), torch.tensor([2.0, 2.0, 2.0])
    speed = env.task.speed().cpu().float()
    for action in actions(env, 11):
        result = env.step(action)
        age += 1
        final_state = result.info.final_obs["priv_obj_state"].cpu()
        # The state is that at the start of the last physics step.
        time = 0.025 * age - 0.005
        torch.testing.assert_close(final_state[:, 2], RADIUS + 0.2 + 0.1 * episode, rtol=0, atol=1e-6)
        torch.testing.assert_close(final_state[:, 1], speed * time, rtol=0, atol=1e-6)
        torch.testing.assert_close(final_state[:, 10], speed, rtol=0, atol=1e-6)
        truncated = result.truncated.cpu()
        episode, age = episode + truncated, torch.where(truncated, 0.0, age)
        ball = result.obs["priv_obj_state"].cpu()
        time = torch.where(truncated, 0.0, time)
        torch.testing.assert_close(ball[:, 1], speed * time, rtol=0, atol=1e-6)
        torch.testing.assert_close(ball[:, 2], RADIUS + 0.2 + 0.1 * episode, rtol=0, atol=1e-6)
        torch.testing.assert_close(env.now.object.pos.cpu().float(), ball[:, :3])
        for env_id in range(3):
            qpos = env.sim.model.qpos0.copy()
            qpos[:2] = result.obs["proprio"][env_id, :2].double().cpu()
            point = taxel_world(env, "left", (0.005, 0.0, 0.0), qpos)
            expected = (point.float() - ball[env_id, :3]).norm() - RADIUS
            assert result.obs["priv_obj_props"][env_id, 2].item() == pytest.approx(float(expected), abs=2e-6)
        assert not result.terminated.any()
    assert episode.tolist() == [4, 5, 4]


def test_episodes_are_truncated_at_their_length(make):
    env = make(3, more="episode: 0.1 s\n")
    env.reset()
    env.steps[2] = 3
    truncations = []
    for action in actions(env, 8):
        result = env.step(action)
        assert torch.equal(result.info.ended, result.truncated | result.terminated)
        truncations.append(result.truncated.tolist())
        assert torch.equal(result.info.episode_steps == 4, result.truncated)
    assert [row[0] for row in truncations] == [False, False, False, True] * 2
    assert [row[2] for row in truncations] == [True, False, False, False] * 2


def test_a_lost_object_terminates_without_truncation(make):
    env = make(3)
    env.reset()
    env.steps[:] = torch.tensor([0, env.max_steps - 1, env.max_steps - 1])
    env.sim.qpos[:2, 4] += 0.3
    result = env.step(torch.zeros(3, 2))
    assert result.terminated.tolist() == [True, True, False]
    assert result.truncated.tolist() == [False, False, True]
    assert (result.info.terms["drop"] < 0).tolist() == [True, True, False]
    assert env.steps.tolist() == [0, 0, 0]


def test_terms_sum_to_the_reward_and_to_the_return(make):
    env = make(3, more="episode: 0.1 s\n" + RANDOM)
    env.reset()
    total = torch.zeros(3)
    for i, action in enumerate(actions(env, 4)):
        result = env.step(action)
        torch.testing.assert_close(sum(result.info.terms.values()), result.reward)
        total += result.reward
        assert result.info.episode_steps.tolist() == [i + 1] * 3
    torch.testing.assert_close(result.info.episode_return, total)
    torch.testing.assert_close(sum(result.info.episode_terms.values()), total)
    after = env.step(actions(env, 1)[0])
    torch.testing.assert_close(after.info.episode_return, after.reward)


def test_final_obs_holds_the_last_observations(make):
    env = make(3, more="episode: 0.1 s\n")
    other = make(3)
    env.reset(), other.reset()
    for action in actions(env, 4):
        result, longer = env.step(action), other.step(action)
    assert result.truncated.all() and not longer.truncated.any()
    assert same(result.info.final_obs, longer.obs)
    assert not torch.equal(result.obs["proprio"], longer.obs["proprio"])
    assert same(longer.info.final_obs, longer.obs)


@pytest.mark.parametrize("more", [RANDOM, NOISY, NOISY + RANDOM])
def test_resetting_one_environment_leaves_the_others_unchanged(make, more):
    """Noise, history and draws of the other environments stay identical to the bit."""
    one, other = make(more=more), make(more=more)
    assert same(one.reset(3), other.reset(3))
    unreset = [0, 2, 3]
    for i, action in enumerate(actions(one, STEPS)):
        if i in (2, 3, 7):
            other.steps[1] = other.max_steps - 1
        result, other_result = one.step(action), other.step(action)
        assert other_result.truncated.tolist() == [False, i in (2, 3, 7), False, False]
        assert same(result.obs, other_result.obs, unreset) and torch.equal(result.reward[unreset], other_result.reward[unreset])


def test_noise_advances_once_per_control_step(make):
    """An episode's first reading advances it once more, in that environment only."""
    env = make(more=NOISY)
    env.reset(1)
    clock = env.touch.memory.clock
    resets = torch.zeros(4, dtype=torch.int64)
    for i, action in enumerate(actions(env, STEPS)):
        if i % 3 == 0:
            env.steps[i % 4] = env.max_steps - 1
        resets += env.step(action).info.ended
        assert torch.equal(clock.get_buffer("step"), 2 + i + resets)
    assert resets.sum() == 4


def test_the_same_seed_gives_the_same_bytes(make):
    more = NOISY + RANDOM + "episode: 0.2 s\n"
    envs = [make(5, more=more, seed=4), make(5, more=more, seed=4, threads=2), make(5, more=more, seed=5)]
    for env in envs[:2]:
        torch.set_num_threads(2 if env is envs[1] else 1)
        env.found = [env._obs, *(env.step(action).obs for action in actions(env, STEPS))]
        assert torch.get_num_threads() == (2 if env is envs[1] else 1)
    torch.set_num_threads(1)
    assert all(same(a, b) for a, b in zip(envs[0].found, envs[1].found, strict=True))
    assert not same(envs[2]._obs, envs[0].found[0])
    repeated = [envs[2].reset(4), *(envs[2].step(action).obs for action in actions(envs[2], STEPS))]
    assert all(same(a, b) for a, b in zip(envs[0].found, repeated, strict=True))


@pytest.mark.slow
def test_compiled_equals_eager(make, monkeypatch):
    """With delayed drives, noise, pushes and resets: everything that is compiled besides the module."""
    monkeypatch.setattr(TactileModule, "compile", lambda module, **_: module)
    more = NOISY + RANDOM + "episode: 0.2 s\n"
    eager, compiled = make(more=more, seed=1), make(more=more, seed=1, compiled=True)
    for i, action in enumerate(actions(eager, STEPS)):
        for env in (eager, compiled):
            env.steps[i % 4] += 1
        with inductor.patch("cpp.simdlen", 1):  # code for vectors takes twice the time to write
            actual, expected = compiled.step(action), eager.step(action)
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(compiled.actuation.memory(), eager.actuation.memory(), rtol=1e-6, atol=1e-9)


def test_two_processes_give_the_same_environments_as_one(make):
    """Random numbers are counted across the environments of all processes."""
    more = NOISY + RANDOM
    whole = make(6, more=more, seed=2)
    halves = [make(3, more=more, seed=2, first_env=first) for first in (0, 3)]
    for action in [None, *actions(whole, 5)]:
        parts = [
            half._obs if action is None else half.step(action[rows]).obs
            for half, rows in zip(halves, (slice(3), slice(3, 6)), strict=True)
        ]
        obs = whole._obs if action is None else whole.step(action).obs
        for name, value in obs.items():
            torch.testing.assert_close(torch.cat([part[name] for part in parts]), value, rtol=1e-5, atol=1e-6)


def test_measured_velocities_match_a_hands_driver(make):
    """They follow from positions at control steps and start at rest in each episode; privileged velocities stay exact."""
    env = make(more=RANDOM + "episode: 0.2 s\njoint_vel: measured\n")
    filters, times = [VelocityFilter(TIME_CONSTANT_S) for _ in range(4)], np.zeros(4)
    obs = env.reset(seed=3)
    for action in [None, *actions(env, 2 * STEPS - 3)]:
        if action is not None:
            result = env.step(action)
            obs, times = result.obs, times + env.control_step
            for i in np.flatnonzero(result.info.ended):
                filters[i].reset()
        for i, (velocity_filter, time) in enumerate(zip(filters, times, strict=True)):
            expected = velocity_filter.update(float(time), obs["proprio"][i, :2].double().numpy())
            np.testing.assert_allclose(obs["proprio"][i, 2:4], expected, rtol=1e-5, atol=1e-6)
    exact = env.now.joint_vel.float()
    assert torch.equal(obs["priv_proprio"][:, 2:4], exact) and (exact - obs["proprio"][:, 2:4]).abs().max() > 0.01


def test_the_simulation_has_the_drawn_properties(make):
    env = make(8, more=RANDOM)
    env.reset(0)
    props = env.reset()["priv_obj_props"]
    torch.testing.assert_close(env.sim.properties.friction("ball").float(), props[:, 0])
    torch.testing.assert_close(env.sim.properties.mass("ball").float(), props[:, 1])
    assert (props[:, 0] >= 0.4).all() and (props[:, 0] <= 1.2).all() and props[:, 0].std() > 0.05
    assert (props[:, 1] >= 0.1).all() and (props[:, 1] <= 0.2).all() and props[:, 1].std() > 0.01
    qpos = env.sim.qpos
    assert (qpos[:, 3:5].abs() <= 0.005).all() and qpos[:, 3:5].std() > 1e-3
    yaw = 2 * torch.atan2(qpos[:, 9], qpos[:, 6])
    assert (yaw.abs() <= 0.3).all() and yaw.std() > 0.05
    assert env.actuation.drawn["gain"].std() > 0.01


def test_held_joints_stay_and_actions_move_targets(make):
    env = make(2)
    env.reset()
    for _ in range(3):
        env.step(torch.tensor([[1.0, -1.0], [0.0, 5.0]]))
    torch.testing.assert_close(env.sim.ctrl[:, 2], torch.tensor([0.2, 0.2], dtype=torch.float64))
    expected = torch.tensor([[0.1 + 0.15, -0.1 - 0.15], [0.1, -0.1 + 0.15]], dtype=torch.float64)
    torch.testing.assert_close(env.actuation.target, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(env.sim.ctrl[:, :2], expected, rtol=0, atol=1e-12)


def test_now_has_the_time_of_its_readings(make):
    """One physics step before the end of the control step; 0 when an episode has just begun."""
    env = make(2)
    physics = float(env.sim.model.opt.timestep)
    assert env.now.time.tolist() == [0.0, 0.0]
    env.step(torch.zeros(2, 2))
    assert env.now.time.tolist() == pytest.approx([env.control_step - physics] * 2)
    env.steps[1] = env.max_steps
    assert env.step(torch.zeros(2, 2)).truncated.tolist() == [False, True]
    assert env.now.time.tolist() == pytest.approx([2 * env.control_step - physics, 0.0])


def test_large_actions_warn_in_the_first_step_only(make):
    env = make(3)
    large_actions = torch.tensor([[0.0, 3.0], [0.5, -50.0], [0.0, 0.0]])
    with pytest.warns(UserWarning, match=r"^action of right is -50 in environment 1, and clipped to \[-1, 1\]") as caught:
        env.step(large_actions)
    assert caught[0].filename == __file__
    env.step(large_actions)  # warnings are errors
    make(3).step(torch.full((3, 2), 3.0))  # a policy that explores may exceed the range


def test_a_step_prints_names_dtypes_and_shapes(make):
    env = make(3)
    result = env.step(torch.zeros(3, 2))
    lines = str(result.info).splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["StepInfo", "ended", "final_obs"]
    assert lines[1].split(maxsplit=1)[1] == "bool (3,)"
    assert (
        f"proprio float32 (3, {env.groups['proprio']}), tactile_sensors float32 (3, {env.groups['tactile_sensors']})"
        in lines[2]
    )
    assert [line.split(maxsplit=1)[1] for line in str(result).splitlines()[-4:]] == [
        "float32 (3,)",
        *["bool (3,)"] * 2,
        "StepInfo",
    ]


@pytest.mark.parametrize("more", ["", RANDOM])
def test_a_nan_action_ends_only_its_episode(make, more):
    env, other = make(more=more), make(more=more)
    env.reset(1), other.reset(1)
    for i, action in enumerate(actions(env, 6)):
        faulty_action = action.clone()
        if i == 3:
            faulty_action[2, 0] = math.nan
            with pytest.warns(UserWarning, match="environments had faults: 1 had controls that are not finite"):
                result = env.step(faulty_action)
        else:
            result = env.step(faulty_action)
        other_result = other.step(action)
        assert result.info.faults.tolist() == [False, False, i == 3, False] == result.terminated.tolist()
        assert same(result.obs, other_result.obs, [0, 1, 3])
        assert all(value.isfinite().all() for value in (*result.obs.values(), *result.info.final_obs.values(), result.reward))
        if i == 3:
            assert result.reward[2] == 0.0 and env.steps[2] == 0
    assert env.sim.fault_counts.tolist() == [0, 0, 1, 0]


@pytest.mark.parametrize("simulator", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
def test_a_diverged_environment_is_reset(make, simulator, monkeypatch):
    """Its score is from the step before: the diverged state has no valid score."""
    env = make(3, simulator=simulator)
    env.reset(1)
    count, advance = env.task.keep("count"), env.task.advance
    monkeypatch.setattr(env.task, "advance", lambda now: (advance(now), count.add_(1.0)))
    monkeypatch.setattr(env.task, "score", lambda: count)
    env.step(torch.zeros(3, 2))
    env.sim.qvel[1, 5] = 1e12
    with pytest.warns(UserWarning, match="environments had faults: 1 diverged"):
        result = env.step(torch.zeros(3, 2))
    assert result.info.score.tolist() == [2.0, 1.0, 2.0]
    assert result.info.faults.tolist() == [False, True, False] == result.terminated.tolist()
    assert result.reward[1] == 0.0 and all(value.isfinite().all() for value in result.obs.values())
    for _ in range(3):
        result = env.step(torch.zeros(3, 2))
        assert not result.info.faults.any() and all(value.isfinite().all() for value in result.obs.values())


@pytest.mark.parametrize(
    ("touch", "kind", "size"),
    [
        *(("none", None, 0), ("bool", "contact", 4), ("agg_bool", "contact", 2), ("depth", "contact_depth", 4)),
        *(("agg_force", "contact_depth", 6), ("force", "kinematic_taxel", 12), ("force_torque", "kinematic_taxel", 24)),
        *(("elastomer", "elastomer", 12), ("proximity", "proximity", 24), ("force_taxel", "force_taxel", 12)),
    ],
)
def test_only_the_chosen_sensors_are_computed(make, touch, kind, size):
    env = make(2, more=f"touch: {touch}\n")
    kinds = {sensor.kind for sensor in env.touch.plan.sensors}
    assert kinds == {"link_contact", "surface_distance", *([kind] if kind else [])}
    assert env.groups.get("tactile_sensors", 0) == size
    env.step(torch.zeros(2, 2))


def test_a_placement_selects_a_group_of_links(make):
    env = make(2, more="touch: depth\nplacement: tips\n")
    assert env.groups["tactile_sensors"] == 2 and set(env.touch.taxels["depth"]["link"]) == {"right"}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("touch: depth\nplacement: tipps\n", r'task\.yaml:\d+:12: placement: no link matches "tipps"; did you mean "tips"\?'),
        ("touch: depth\nnoise: nosy\n", r'task\.yaml:\d+:8: noise: unknown noise profile "nosy"; did you mean "noisy"\?'),
        ("touch: depth\nresolution: hi\n", r'task\.yaml:\d+:13: resolution: unknown resolution "hi"'),
        ("touch: depth\nsensors: {depth: {feels: [cub]}}\n", r"task\.yaml:\d+:\d+: sensors\.depth\.feels"),
    ],
)
def test_errors_in_a_tasks_sensor_settings_are_reported_at_its_key(make, more, said):
    with pytest.raises(SpecError) as error:
        make(2, more=more)
    assert [re.search(said, str(problem)) is not None for problem in error.value.problems] == [True], str(error.value)


def test_an_error_in_an_override_names_the_override(tmp_path):
    task = write_task(tmp_path, more="touch: depth\n")
    for options, message in (
        ({"overrides": {"placement": "tipps"}}, '--set placement=tipps: placement: no link matches "tipps"'),
        ({"touches": [PolicyTouch("depth", "tipps", "clean")]}, 'placement: no link matches "tipps"'),
    ):
        with pytest.raises(SpecError) as error:
            TouchEnv(task, 2, threads=1, **options)
        assert str(error.value).startswith(message)


def test_an_action_of_the_wrong_shape_is_refused(make):
    env = make(2)
    with pytest.raises(SimulationError, match=r"action has shape \(2, 3\), expected \(2, 2\)"):
        env.step(torch.zeros(2, 3))


def test_a_simulator_from_a_package_can_be_used(make, monkeypatch):
    """The registered one is MuJoCo's own under another name with fewer options, so it must step identically."""

    class CustomSimulation(BatchSimulation):
        def __init__(self, touch, num_envs, *, substeps, keyframe, options, watch, on_fault):
            super().__init__(
                touch,
                num_envs,
                substeps=substeps,
                keyframe=keyframe,
                options=options,
                watch=watch,
                on_fault=on_fault,
                threads=1,
            )

    custom = dataclasses.replace(SOURCES[0], name="mine", simulate=CustomSimulation, recognise=None)
    monkeypatch.setattr(connect, "known_sources", lambda: (SOURCES[0], custom))
    env, other = make(3, simulator="mine"), make(3, simulator="mujoco")
    assert isinstance(env.sim, CustomSimulation)
    for _ in range(3):
        one, two = (each.step(torch.full((3, 2), 0.3)) for each in (env, other))
    assert torch.equal(one.reward, two.reward) and torch.equal(one.obs["proprio"], two.obs["proprio"])
    with pytest.raises(SimulationError, match='simulator is "min"; did you mean "mine"'):
        make(3, simulator="min")
    with pytest.raises(SimulationError, match='MuJoCo steps on the CPU, and the device is "cuda"'):
        connect.simulator_for("cuda", "mujoco")


def test_joints_are_observed_with_noise_and_scaled(tmp_path):
    """Noise is on positions and velocities, not on actions or privileged groups; it differs per step and repeats with the seed."""
    more = "proprio: {pos_noise: 0.01 rad, vel_noise: 0.3, vel_scale: 0.2}\n"
    env = tiny_env(tmp_path, 500, more=more)
    first, noise = env.observe()["proprio"], []
    for action in actions(env, 4):
        obs = env.step(action).obs
        pos, vel, last = obs["proprio"].double().split(2, dim=1)
        noise.append(torch.cat([pos - env.now.joint_pos, vel / 0.2 - env.now.joint_vel], dim=1))
        assert torch.equal(last.float(), action)
        exact = torch.cat([env.now.joint_pos, env.now.joint_vel, env.now.action], dim=1).float()
        assert torch.equal(obs["priv_proprio"][:, :6], exact)
    stacked = torch.stack(noise)
    scale = torch.tensor([0.01, 0.01, 0.3, 0.3])
    assert (stacked.mean(dim=(0, 1)).abs() < 0.1 * scale).all()
    np.testing.assert_allclose(stacked.std(dim=(0, 1)) / scale, 1.0, atol=0.05)
    correlations = torch.corrcoef(torch.cat([stacked[:-1].reshape(-1, 4).T, stacked[1:].reshape(-1, 4).T]))
    assert (correlations - torch.eye(8)).abs().max() < 0.12
    assert torch.equal(env.reset(0)["proprio"], first)
    env.close()


def test_a_document_sets_the_largest_torques(tmp_path):
    env = tiny_env(tmp_path, 1, more="physics: {max_torque: {le*: 0.7 N*m}}\n")
    assert env.task.setup.max_torque.tolist() == pytest.approx([0.7, 0.3])
    env.close()
    with pytest.raises(SpecError, match=r"physics.max_torque.lift: no actuated joint matches .*left"):
        tiny_env(tmp_path, 1, more="physics: {max_torque: {lift: 0.7 N*m}}\n")
