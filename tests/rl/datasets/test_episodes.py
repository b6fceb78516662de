"""Episodes with touch and their frames, against loops over samples and against environments and hands."""

import numpy as np
import pytest
import torch
from hand_logs import random_readings, write_log
from pressing_hands import CALIBRATION, Blind, press_policy, press_task
from small_tasks import small_task

import tgdsl
from tgdsl.errors import TgdslError
from tgdsl.rl.datasets.dataset import Episode, Header, LinkTaxels, features, frames
from tgdsl.rl.datasets.sources import of_deployment, of_environments, of_log, of_run
from tgdsl.rl.deploying.deploy import Deployment
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.rollout import RandomActor, rollout


def force_task(folder):
    """Return the small task with a force sensor."""
    task, sensors = small_task(folder), folder / "sensors.yaml"
    force = "  push: {kind: kinematic_taxel, links: tip, feels: [item], normal_stiffness: 500}\n"
    sensors.write_text(sensors.read_text() + force)
    return task


def random_episode(times, fps, seed=0):
    rng, num = np.random.default_rng(seed), len(times)
    links = {"tip": LinkTaxels("tip", np.zeros((4, 3)), np.ones((4, 3))), "palm": LinkTaxels("palm")}
    step = float(np.median(np.diff(times)))
    header = Header("made up", "press", ("a", "b"), links, "N", step, fps, has_outcome=True)
    touch = {"tip": rng.normal(size=(num, 4, 3)), "palm": rng.normal(size=(num, 1, 3))}
    state, action, reward = rng.normal(size=(num, 2)), rng.normal(size=(num, 2)), rng.normal(size=num)
    return header, Episode(np.asarray(times), state, action, touch, reward=reward, score=2.0, is_success=True)


@pytest.mark.parametrize("times", [np.arange(21) * 0.01, np.cumsum(np.random.default_rng(1).uniform(0.005, 0.015, 60))])
def test_a_frame_holds_the_newest_sample_and_a_window_of_earlier_ones(times):
    header, episode = random_episode(times, 20.0)
    assert header.window == 5
    result, since = frames(header, episode), times - times[0]
    num = len(result["action"])
    assert num == int(since[-1] * 20.0 + 1e-9) + 1
    newest = [max(i for i, t in enumerate(since) if t <= k / 20.0 + 1e-7) for k in range(num)]
    for k, i in enumerate(newest):
        np.testing.assert_array_equal(result["observation.tactile.tip"][k], episode.touch["tip"][i].astype(np.float32))
        np.testing.assert_array_equal(result["observation.state"][k], episode.state[i].astype(np.float32))
        past = [max(i - back, 0) for back in (4, 3, 2, 1, 0)]
        np.testing.assert_array_equal(
            result["observation.tactile_window.tip"][k], episode.touch["tip"][past].astype(np.float32)
        )
        np.testing.assert_allclose(result["observation.tactile_window_time"][k], since[past] - k / 20.0, atol=1e-6)
        flat = np.concatenate([episode.touch["tip"][i].ravel(), episode.touch["palm"][i].ravel()])
        np.testing.assert_array_equal(result["observation.tactile"][k], flat.astype(np.float32))
        end = newest[k + 1] if k + 1 < num else len(times)
        assert result["next.reward"][k] == pytest.approx(episode.reward[i:end].sum(), abs=1e-5)
    assert result["next.success"].tolist() == result["next.done"].tolist() == [False] * (num - 1) + [True]
    columns = features(header)
    assert columns.keys() == result.keys()
    for name, feature in columns.items():
        assert result[name].shape[1:] == (() if feature.shape == (1,) else feature.shape), name
        assert str(result[name].dtype) == feature.dtype


def test_a_scalar_feature_has_one_number_per_frame():
    header = Header("made up", "press", ("a",), {"palm": LinkTaxels("palm")}, "N", 0.01, 100.0, has_policy=True)
    angles = np.random.default_rng(0).normal(size=(5, 1))
    result = frames(header, Episode(np.arange(5) * 0.01, angles, angles, {"palm": np.zeros((5, 1, 3))}, angles))
    for name in ("observation.state", "action", "policy_action"):
        assert features(header)[name].shape == (1,)
        np.testing.assert_array_equal(result[name], angles[:, 0].astype(np.float32))


def test_episodes_of_environments_hold_readings_and_set_points(tmp_path):
    """Readings and joints are from when the action was chosen; set-points are those of the following step."""
    task = force_task(tmp_path)
    overrides = {"touch": "force", "episode": "0.3 s"}
    env = TouchEnv(task, 3, seed=4, threads=1, overrides=overrides)
    header, episodes = of_environments(env, RandomActor(env, 5), 4)
    recorded = list(episodes)
    assert len(recorded) == 4
    env.reset(4)
    other = TouchEnv(task, 3, seed=4, threads=1, overrides=overrides)
    actor = RandomActor(other, 5)
    forces, positions, targets, rewards = [], [], [], []
    name = next(output.name for output in other.touch.outputs if "force_x" in output.channels and output.rows == "taxel")
    for _ in range(len(recorded[0].time)):
        forces.append(other.now.readings[name][0, :, :3].clone())
        positions.append(other.now.joint_pos[0].clone())
        step = next(rollout(actor, other, 1)).step
        targets.append(other.now.target[0].clone())
        rewards.append(step.reward[0].clone())
    assert bool(step.info.ended[0])
    first = recorded[0]
    np.testing.assert_array_equal(np.concatenate(list(first.touch.values()), axis=1), torch.stack(forces))
    np.testing.assert_array_equal(first.state, torch.stack(positions))
    np.testing.assert_array_equal(
        first.action[:-1], torch.stack(targets)[:-1]
    )  # after the last step the next episode has begun
    np.testing.assert_array_equal(first.reward, torch.stack(rewards))
    table = other.touch.taxels[next(output.sensor for output in other.touch.outputs if output.name == name)]
    np.testing.assert_array_equal(np.concatenate([link.pos for link in header.links.values()]), table["pos"])
    np.testing.assert_array_equal(np.concatenate([link.normal for link in header.links.values()]), table["normal"])


def test_a_task_without_force_readings_is_refused(tmp_path):
    env = TouchEnv(small_task(tmp_path), 1, threads=1, overrides={"touch": "bool"})
    with pytest.raises(TgdslError, match=r"no reading is a force on taxels, in newtons: there are .*--set touch=force"):
        of_environments(env, RandomActor(env, 0), 1)


def test_a_run_has_the_joints_that_actuators_move_directly(tmp_path):
    """The first actuator pulls a tendon, so its control is no joint's set-point."""
    force_task(tmp_path)
    scene, file, rng = tmp_path / "scene.xml", tmp_path / "run.npz", np.random.default_rng(0)
    pull = '<tendon><fixed name="both"><joint joint="swing" coef="1"/></fixed></tendon><actuator><motor tendon="both"/>'
    scene.write_text(scene.read_text().replace("<actuator>", pull).replace('ctrl="0 0"', 'ctrl="0 0 0"'))
    touch = tgdsl.compile(tmp_path / "sensors.yaml")
    output = next(output for output in touch.outputs if output.name == "push")
    arrays = {"time": 0.01 * np.arange(6), "qpos": rng.normal(size=(6, 1, 9)), "ctrl": rng.normal(size=(6, 3))}
    arrays |= {"push": rng.normal(size=(6, 1, *output.shape)), "push:channels": output.channels, "push:units": output.units}
    arrays |= {f"push:{name}": touch.taxels["push"][name] for name in ("link", "body", "pos", "normal")}
    np.savez(file, document="sensors.yaml", **arrays)
    header, (episode,) = of_run(file, touch)
    assert header.joints == ("swing", "bend")
    np.testing.assert_array_equal(episode.state, arrays["qpos"][:-1, 0, :2])
    np.testing.assert_array_equal(episode.action, arrays["ctrl"][1:, 1:])


def test_a_hands_log_is_split_at_gaps(tmp_path):
    times = np.concatenate([np.arange(30) * 0.01, 0.6 + np.arange(20) * 0.01])
    readings = random_readings(times)
    header, episodes = of_log(write_log(tmp_path / "press.npz", readings), fps=20.0, side="right")
    assert header.unit == "counts" and header.window == 5 and header.joints[0] == "right_hand_thumb_bend_joint"
    first, second = episodes
    assert (len(first.time), len(second.time)) == (30, 20)
    expected = np.stack([reading.state.total_force for reading in readings[30:]])
    np.testing.assert_array_equal(second.touch["right_hand_mid_link2"][:, 0], expected[:, 2])
    positions = np.stack([reading.state.position for reading in readings[:30]])
    np.testing.assert_array_equal(first.state, positions)
    np.testing.assert_array_equal(first.action[:24], positions[5:29])  # positions one frame later
    with pytest.raises(TgdslError, match="--fps 500: expected more than 0, and at most the source's rate, 100"):
        of_log(tmp_path / "press.npz", fps=500.0)


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
def test_an_emulated_hand_gives_the_force_on_each_fingertip(tmp_path):
    task = press_task(tmp_path)
    options = {"lockstep": True, "calibration": CALIBRATION}
    policy = press_policy(tmp_path, task, Blind(6), joint_vel="measured")
    header, episodes = of_deployment(Deployment(task, policy, "emulator", **options), 2, "N")
    with pytest.raises(TgdslError, match="a simulation's forces on taxels come from --source environments"):
        of_deployment(Deployment(task, policy), 1, "N")
    first, second = episodes
    moments = [moment for moment in Deployment(task, policy, "emulator", **options).steps(2) if moment.episode == 1]
    assert len(moments) == len(second.time) and header.unit == "N" and first.is_success
    names, num = list(header.links), len(header.joints)
    for k, moment in enumerate(moments):
        axes = moment.obs["tactile_sensors"][0].split(len(names))  # x of all fingertips, then y, then z
        for i, name in enumerate(names):
            np.testing.assert_array_equal(second.touch[name][k, 0], [float(axis[i]) for axis in axes])
        np.testing.assert_array_equal(second.state[k], moment.obs["proprio"][0, :num])
        np.testing.assert_array_equal(second.action[k], moment.target[0])
    assert max(abs(touch).max() for touch in second.touch.values()) > 0.1
    assert second.score == pytest.approx(float(moments[-1].step.info.score))
