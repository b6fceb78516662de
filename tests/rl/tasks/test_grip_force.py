"""Holding an object with a commanded force: rewards against the reference, incentives, starts, commands, terminations."""

import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from task_records import Recorder, assert_reference
from task_references import grip_force

import tgdsl
from tgdsl.errors import LowerError, SpecError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.tasks.grip_force import GripForce
from tgdsl.scene.scene import Choice, SceneModels

FOLDER = Path(__file__).parents[3] / "examples" / "tasks"
DOCUMENT = FOLDER / "grip_force.yaml"
NUM = 8
"""As many environments as the object has variants."""
PLAIN = {"touch": "none", "randomise.drive": {}, "randomise.push": {}}
"""Ideal drives and no pushes."""
GRAVITY = 9.81


def grip(num_envs=NUM, **overrides):
    named = {name.replace("__", "."): value for name, value in overrides.items()}
    return TouchEnv(DOCUMENT, num_envs, threads=1, overrides=PLAIN | named)


@pytest.fixture(scope="module")
def env():
    """Eight objects, ideal drives, no pushes."""
    environments = grip()
    yield environments
    environments.close()


def zero_actions(env):
    return torch.zeros(env.num_envs, env.num_actions)


def random_actions(env, num, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [2 * torch.rand((env.num_envs, env.num_actions), generator=generator) - 1 for _ in range(num)]


def force_of(result):
    """Return the sum of normal forces after a step, also at the end of an episode [N]."""
    return result.info.final_obs["priv_force"][:, 0].double()


def command(env):
    return {"command": env.task.command.double().numpy().copy()}


def reference_of(spec, record, dt):
    """Return the reference's terms, where a change of the command marks a new one."""
    return grip_force(spec, {**record, "is_new": np.diff(record["command"], prepend=0.0) != 0}, dt)


ODD = {
    "episode": "0.6 s", "change": ["0.1 s", "0.2 s"], "settling": "0.06 s", "force": ["2 N", "6 N"], "force_width": 0.4,
    "free_distance": "0.1 mm", "drop_distance": "6 mm", "max_force": "9 N", "start_force": "6 N", "action.scale": "0.02 rad",
    "randomise.push": {"z": ["-4 N", "-4 N"], "interval": ["0.2 s", "0.3 s"]},
    "rewards": {name: 1.5 * value for name, value in GripForce.Rewards()},
}  # fmt: skip
"""Numbers unlike the document's, chosen so that every term occurs."""


def assert_started(env, force):
    """Assert that objects are at their keyframes and the drives' lag is scaled by command over keyframe force."""
    for i, (pos, target, commanded) in enumerate(zip(env.sim.qpos, env.actuation.target, env.task.command, strict=True)):
        key = env.sim.model.key(f"hold-{i}")
        np.testing.assert_allclose(pos, key.qpos, atol=1e-12)
        lag = (key.ctrl - key.qpos[: len(key.ctrl)])[env.task.setup.actuators.actuator]
        np.testing.assert_allclose(target - pos[: len(target)], float(commanded) / force * lag, atol=1e-12)


def test_episodes_begin_with_keyframes(env):
    env.reset(0)
    assert_started(env, 5.0)


def test_rewards_ends_and_scores_equal_the_reference():
    env = grip(**ODD)
    assert_started(env, 6.0)
    recorder = Recorder(env, lambda now: command(env))
    for i, action in enumerate(random_actions(env, 60)):
        recorder.step(torch.ones_like(action) if i % 30 > 20 else action)
    assert sum(len(episodes) for episodes in recorder.episodes) > 2 * NUM
    names = assert_reference(recorder, reference_of)
    # Joints stay far from the ends of their ranges.
    assert names == {*GripForce.Rewards.model_fields, "is_over", "score"} - {"joint_limit"}
    env.close()


@pytest.mark.slow
def test_the_unchanged_document_equals_the_reference():
    env = TouchEnv(DOCUMENT, NUM, threads=1)
    recorder = Recorder(env, lambda now: command(env))
    for action in random_actions(env, 80):
        recorder.step(action)
    assert {"force_near", "force_far", "object_angle", "action_rate", "work"} <= assert_reference(recorder, reference_of)
    env.close()


def test_a_joint_at_the_end_of_its_range_costs(env):
    """The joint is 0.05 rad beyond the middle 95 % of its range."""
    env.reset(0)
    now, (low, high) = env.now, (env.task.setup.low, env.task.setup.high)
    pos = now.joint_pos.clone()
    pos[:, 3] = 0.5 * (low[3] + high[3]) + 0.95 * 0.5 * (high[3] - low[3]) + 0.05
    terms = env.task.reward(replace(now, joint_pos=pos), torch.zeros(NUM, dtype=torch.bool))
    torch.testing.assert_close(terms["joint_limit"], torch.full((NUM,), -40 * 0.05).double())


def force_reward(env, share):
    """Return the reward of the force terms when forces are a share of the command [1/s]."""
    now = env.now
    force = torch.zeros_like(now.normal_force)
    force[:, :2] = (0.5 * share * env.task.command)[:, None]
    now = replace(now, normal_force=force)
    env.task.advance(now)
    terms = env.task.reward(now, torch.zeros(env.num_envs, dtype=torch.bool))
    return terms["force_near"] + terms["force_far"]


def test_the_commanded_force_pays_most(env):
    """The reward falls with distance from the command on both sides, and no force earns nothing."""
    env.reset(0)
    none, half, less, right, more, twice, thrice = (force_reward(env, share) for share in (0, 0.5, 0.9, 1.0, 1.1, 2.0, 3.0))
    torch.testing.assert_close(right, torch.full_like(right, 3.0))
    assert (right > less).all() and (less > half).all() and (half > none).all()
    assert (right > more).all() and (more > twice).all() and (none < 1e-9).all() and (twice < 1e-9).all()
    assert (thrice < 1e-9).all() and (thrice >= 0).all()


def press(env, share):
    """Make the drives press with a share of the command, by the lag of the start's targets."""
    task = env.task
    lag = (share * task.command / task.spec.start_force)[:, None] * task.lag
    env.actuation.target.copy_(task.held + lag)


def regulated_steps(env, force, steps):
    """Regulate the sum of normal forces to a target by an integral controller; yield each step [N]."""
    share = force / env.task.command
    for _ in range(steps):
        press(env, share)
        result = env.step(zero_actions(env))
        yield result
        share = share + 0.2 * (force - force_of(result)) / env.task.command


def test_pressing_as_commanded_beats_half_and_twice_the_force(env):
    """In physics, for every object: at 50 g half the force still holds it; the command stays at 3 N."""
    rewards = {}
    for share in (0.5, 1.0, 2.0):
        env.reset(0)
        env.task.command.fill_(3.0)
        env.sim.properties.set(mass={"item": 0.05}, friction={"item": 1.0})
        results = list(regulated_steps(env, torch.full((NUM,), 3.0 * share).double(), 40))
        assert not any(step.info.ended.any() for step in results)
        assert ((force_of(results[-1]) / 3.0 / share - 1).abs() < 0.05).all()
        rewards[share] = sum(step.reward for step in results[20:])
    assert (rewards[1.0] > rewards[0.5]).all() and (rewards[1.0] > rewards[2.0]).all()


def test_force_taxels_carry_the_weight():
    """At rest the taxels of thumb and fingers carry the weight to 1 %, so no contact force is missed."""
    env = grip(touch="force_taxel", resolution="low", force=["7 N", "7 N"], randomise__friction=[1.5, 1.5])
    for _ in range(20):
        env.step(zero_actions(env))
    load = env._sensors.policy_sensor
    readings, taxels = env.now.readings[load].double(), env.touch.taxels[load]
    bodies = list(dict.fromkeys(taxels["link"]))
    total = torch.zeros(NUM, 3, dtype=torch.float64)
    for i in range(NUM):
        data = mujoco.MjData(env.sim.model)
        data.qpos[:] = env.sim.qpos[i].numpy()
        mujoco.mj_kinematics(env.sim.model, data)
        for body in bodies:
            force = readings[i, torch.from_numpy(np.asarray(taxels["link"]) == body)].sum(dim=0).numpy()
            total[i] += torch.from_numpy(data.body(str(body)).xmat.reshape(3, 3) @ force)
    weight = env.now.mass * GRAVITY
    assert env.now.mass.min() >= 0.02 and env.now.mass.max() <= 0.3 and env.now.mass.std() > 0.03
    assert ((-total[:, 2] / weight - 1).abs() < 0.01).all()
    # Sideways, the forces of thumb and fingers cancel.
    assert (total[:, :2].norm(dim=1) < 0.01 * 7).all()
    env.close()


def test_groups_of_observations(env):
    obs = env.reset(0)
    links = len(env.task.setup.links)
    assert env.groups == {
        "proprio": 24, "priv_proprio": 24 + 3 * links, "goal": 1, "priv_force": 1 + links, "priv_obj_state": 15,
        "priv_obj_props": 2 + len(env.touch.rows[env._sensors.distance]["link"]),
    }  # fmt: skip
    torch.testing.assert_close(obs["goal"][:, 0].double(), env.task.command, rtol=1e-6, atol=0)
    torch.testing.assert_close(obs["priv_obj_props"][:, 1].double(), env.task.setup.mass, rtol=1e-6, atol=0)
    assert not obs["priv_force"].any()  # contacts are not evaluated after a reset
    result = env.step(zero_actions(env))
    normal_forces = result.obs["priv_force"]
    torch.testing.assert_close(normal_forces[:, 0], normal_forces[:, 1:].sum(dim=1))
    touching_links = [name for name, forces in zip(env.task.setup.links, normal_forces[:, 1:].T, strict=True) if forces.any()]
    assert touching_links == ["right_hand_thumb_rota_link2", "right_hand_index_rota_link2", "right_hand_mid_link2"]
    # A link's force is its normal force plus friction.
    whole = result.obs["priv_proprio"][:, 24:].view(NUM, links, 3).norm(dim=2)
    assert (normal_forces[:, 1:] <= whole + 1e-5).all() and (normal_forces[:, 1:] > 0.6 * whole).logical_or(whole == 0).all()


def test_commands_suffice_to_hold_the_object(env):
    """Uniform from κ m g / μ, at least 1 N, to 8 N: a Kolmogorov-Smirnov test at 1e-6, including both ends."""
    shares, lows = [], []
    for seed in range(40):
        env.reset(seed)
        commands, mass, friction = env.task.command, env.task.setup.mass, env.task.setup.friction
        low = (1.5 * mass * GRAVITY / friction).clamp(min=1.0)
        assert (commands >= low).all() and (commands <= 8).all() and low.max() < 7.4
        shares.append((commands - low) / (8 - low))
        lows.append(low)
    share = torch.cat(shares).sort().values
    assert (torch.cat(lows) == 1).any()
    gap = (share - torch.arange(len(share)) / len(share)).abs().max()
    assert gap < np.sqrt(-0.5 * np.log(0.5e-6) / len(share)) and share[0] < 0.02 and share[-1] > 0.98


def test_commands_change_at_random_times(env, monkeypatch):
    """Every 5 to 8 control steps per environment; a step is judged by the command observed before it."""
    assert (env.task.first, env.task.last, env.task.settled) == (80, 160, 40)  # 2 s, 4 s, 1 s
    for name, steps in (("first", 5), ("last", 8), ("settled", 2)):
        monkeypatch.setattr(env.task, name, steps)
    obs, age = env.reset(0), torch.zeros(NUM, dtype=torch.int64)
    ages, changes = [], []
    for _ in range(60):
        observed, score = obs["goal"][:, 0], env.task.squares.clone()
        result = env.step(zero_actions(env))
        obs = result.obs
        assert not result.info.ended.any()
        error = force_of(result) / observed.double() - 1
        torch.testing.assert_close(env.task.error, error, rtol=0, atol=1e-5)
        age += 1
        is_settled = age >= 2
        torch.testing.assert_close(env.task.squares - score, torch.where(is_settled, error**2, 0.0), rtol=0, atol=1e-5)
        is_new = obs["goal"][:, 0] != observed
        ages += age[is_new].tolist()
        changes.append(is_new)
        age = torch.where(is_new, 0, age)
    assert set(ages) == {5, 6, 7, 8}
    assert len({tuple(column.tolist()) for column in torch.stack(changes).T}) == NUM


def test_the_score_before_forces_settle_is_that_of_no_force(env):
    env.reset(0)
    scores = [env.step(zero_actions(env)).info.score for _ in range(40)]
    assert all((score == 1).all() for score in scores[:39])  # the fortieth step is one second after the start
    assert (scores[39] < 0.5).all()


def test_a_falling_object_ends_as_a_drop(env):
    env.reset(0)
    env.sim.qpos[2, 14] -= 0.05
    result = env.step(zero_actions(env))
    assert result.terminated.tolist() == [i == 2 for i in range(NUM)] and not result.truncated.any()
    assert result.info.terms["drop"][2].item() == pytest.approx(-100 * env.control_step)
    assert not result.info.terms["crush"].any()


def test_an_object_pressed_too_hard_ends_as_crushed(env):
    env.reset(0)
    press(env, torch.where(torch.arange(NUM) == 4, 25.0 / env.task.command, 1.0))
    for _ in range(12):
        result = env.step(zero_actions(env))
        assert torch.equal(result.terminated, force_of(result) > 15)
        if result.terminated.any():
            break
    assert result.terminated.tolist() == [i == 4 for i in range(NUM)]
    assert result.info.terms["crush"][4].item() == pytest.approx(-100 * env.control_step)
    assert not result.info.terms["drop"].any()


def test_the_end_of_one_episode_does_not_affect_the_others(env):
    """One run removes an object and the other does not: all other environments are equal to the bit."""
    runs = []
    for is_removed in (False, True):
        env.reset(3)
        rows = []
        for i, action in enumerate(random_actions(env, 12)):
            if is_removed and i == 4:
                env.sim.qpos[5, 12] += 0.1
            result = env.step(action)
            assert result.terminated.tolist() == [is_removed and i == 4 and env_id == 5 for env_id in range(NUM)]
            rows.append(torch.cat([*result.obs.values(), result.reward[:, None]], dim=1))
        runs.append(torch.stack(rows))
    other_envs = [i for i in range(NUM) if i != 5]
    assert torch.equal(runs[0][:, other_envs], runs[1][:, other_envs]) and not torch.equal(runs[0][5:, 5], runs[1][5:, 5])


@pytest.mark.parametrize(
    ("changes", "path", "says"),
    [
        ({"force": ["0 N", "8 N"]}, "force", "expected more than 0"),
        ({"force_width": -1}, "force_width", "more than 0"),
        ({"max_force": "3 mm"}, "max_force", "unit of force"),
        ({"rewards": {"grip": 1}}, "rewards.grip", "unknown key"),
    ],
)
def test_errors_are_located(changes, path, says):
    with pytest.raises(SpecError) as caught:
        load_task(DOCUMENT, changes)
    (problem,) = caught.value.problems
    assert problem.path == path and says in f"{problem.what}; {problem.hint}"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"starts": ("hold-0",)}, "1 starts, and the object has 8 variants; expected a keyframe for each"),
        ({"starts": (*(f"hold-{i}" for i in range(7)), "hold-9")}, 'the scene has no keyframe "hold-9"'),
        ({"change": (0.01, 1.0)}, "commands change every 0.01 s, more often than control steps of 0.025 s"),
    ],
)
def test_mismatched_starts_and_times_are_refused(env, changes, says):
    with pytest.raises(LowerError, match=says) as caught:
        GripForce(env.spec.model_copy(update=changes), env.task.setup)
    assert [caught.value.field] == list(changes)


@pytest.mark.slow
def test_every_object_is_held_for_five_seconds_without_actions():
    """For all masses, frictions and commands: the force is within 15 % and 0.4 N, the object sinks at most 1 cm."""
    env = grip(2 * NUM, change=["20 s", "20 s"], episode="5 s")
    commands, forces = env.task.command.clone(), []
    start = env.task.start_pos.clone()
    for i in range(env.max_steps):
        result = env.step(zero_actions(env))
        assert not result.terminated.any()
        forces += [force_of(result)] if i > 40 else []
    force = torch.stack(forces).mean(dim=0)
    assert ((force - commands).abs() < 0.15 * commands + 0.4).all()
    distance = (result.info.final_obs["priv_obj_state"][:, :3].double() - start).norm(dim=1)
    assert distance.max() < 0.01 and distance.median() < 0.002
    env.close()


@pytest.mark.slow
def test_the_whole_range_of_commands_can_be_pressed():
    """A closed loop reaches 1 to 8 N with every object within 5 %, using 40 % of the drives' torque."""
    env = grip(change=["20 s", "20 s"], randomise__mass=["0 g", "0 g"])
    limit = torch.from_numpy(env.task.setup.actuators.limit)
    for target in (1.0, 3.0, 8.0):
        env.reset(0)
        *_, result = regulated_steps(env, torch.full((NUM,), target).double(), 80)
        assert not result.terminated.any()
        assert ((force_of(result) / target - 1).abs() < 0.05).all()
        assert (env.now.torque.abs() / limit).max() < 0.4
    env.close()


@pytest.mark.slow
def test_the_keyframes_equal_the_scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    import grip_starts

    touch = tgdsl.compile(FOLDER / "grip.yaml", sensors=["felt"])
    scenes = SceneModels(touch.plan.scene, {"timestep": 0.005})
    for variant in (0, 6):
        model = grip_starts.scene_of(scenes, variant)
        holding = grip_starts.Holding(model, grip_starts.width_of(scenes, variant))
        qpos, ctrl = holding.hold()
        key = scenes.model({"item": Choice(variant)}).key(f"hold-{variant}")
        assert holding.force() == pytest.approx(5.0, abs=0.1)
        np.testing.assert_allclose(qpos, key.qpos, atol=2e-4)
        np.testing.assert_allclose(ctrl, key.ctrl, atol=2e-4)
    sys.modules.pop("grip_starts")


@pytest.mark.slow
def test_mujoco_warp_agrees():
    """Over half a second with the same draws, forces agree to 5 % and 0.2 N, commands to rounding."""
    forces = []
    for simulator in ("mujoco", "warp"):
        env = TouchEnv(DOCUMENT, NUM, overrides=PLAIN, simulator=simulator)
        obs = env.reset(1)
        for _ in range(20):
            result = env.step(zero_actions(env))
            assert not result.info.ended.any()
        forces.append((obs["goal"].cpu(), force_of(result).cpu()))
        env.close()
    torch.testing.assert_close(forces[0][0], forces[1][0], rtol=1e-5, atol=0)
    torch.testing.assert_close(forces[0][1], forces[1][1], rtol=0.05, atol=0.2)
