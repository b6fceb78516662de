"""Events of a document: what they change, when they happen, and that the others are left alone."""

import numpy as np
import pytest
import torch
from tiny_tasks import tiny_env, write_task

from tgdsl.errors import SimulationError, SpecError
from tgdsl.rl.load import load_task

KNOCK = "terms: {knock: {term: object_velocity, speed: [0.1 m/s, 0.2 m/s], spin: [1, 2], interval: [0.1 s, 0.2 s]}}\nepisode: 60 s\ndrop_distance: 100 m\n"
OWN = """from tgdsl.fields.models import Number

def lift(event, speed: Number, times: float = 1.0):
    event.sim.arrays["qvel"][:, 5] += event.chosen * speed * times
"""


def flying(folder, more, num_envs=4, **options):
    """Return environments whose ball flies without gravity, above all that it could touch."""
    env = tiny_env(folder, num_envs, gravity="0 0 0", more=more, **options)
    env.sim.qpos[:, 5] = 1.0
    return env


def changes(env, steps):
    """Return of each control step by how much the ball's velocities differ from those before it: (step, env, 6)."""
    rows = [env.sim.qvel[:, 3:9].clone()]
    for _ in range(steps):
        env.step(torch.zeros(env.num_envs, 2))
        rows.append(env.sim.qvel[:, 3:9].clone())
    return torch.stack(rows).diff(dim=0).numpy()


def test_a_free_ball_is_given_velocity_within_bounds_at_intervals_within_bounds(tmp_path):
    """The ball is a sphere: without forces linear and angular velocity stay as they are."""
    env = flying(tmp_path, KNOCK)
    found = changes(env, 60)
    for row in found.swapaxes(0, 1):
        at = np.flatnonzero(np.abs(row).max(axis=1) > 1e-9)
        gaps = np.diff(at)
        assert len(at) >= 8 and gaps.min() >= 4 and gaps.max() <= 8 and len(set(gaps)) > 1
        knocks = row[at]
        assert (knocks[:, :3] > 0.1 - 1e-6).all() and (knocks[:, :3] < 0.2 + 1e-6).all()
        assert (knocks[:, 3:] > 1 - 1e-6).all() and (knocks[:, 3:] < 2 + 1e-6).all()
        assert np.unique(knocks[:, 0]).size == len(at)


def test_numbers_do_not_depend_on_the_batch(tmp_path):
    """Each environment has its own, whichever others there are."""
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    all_of_them, last = flying(tmp_path / "a", KNOCK, 4), flying(tmp_path / "b", KNOCK, 2, first_env=2)
    np.testing.assert_array_equal(changes(all_of_them, 20)[:, 2:], changes(last, 20))


def test_a_function_of_ones_own_happens_at_each_reset(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    more = 'terms: {lift: {term: "own.py:lift", mode: reset, speed: 0.5, times: 2}}\nepisode: 0.5 s\n'
    env = tiny_env(tmp_path, 3, gravity="0 0 0", more=more)
    assert env.sim.qvel[:, 5].tolist() == pytest.approx([1.0] * 3)
    for _ in range(3):
        env.step(torch.zeros(3, 2))
    env.steps[1] = env.max_steps  # the next step ends this episode alone
    before = env.sim.qvel[:, 5].clone()
    env.step(torch.zeros(3, 2))
    assert env.sim.qvel[1, 5].item() == pytest.approx(1.0)
    torch.testing.assert_close(env.sim.qvel[[0, 2], 5], before[[0, 2]])


def test_a_saved_environment_goes_on_with_its_events(tmp_path):
    env = flying(tmp_path, KNOCK)
    changes(env, 7)
    again = tiny_env(tmp_path, gravity="0 0 0", more=KNOCK)
    again.load_state_dict(env.state_dict())
    np.testing.assert_array_equal(changes(again, 20), changes(env, 20))


def test_what_is_wrong_with_an_event_is_told(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    with pytest.raises(SpecError, match="unknown key"):
        load_task(write_task(tmp_path, more='terms: {lift: {term: "own.py:lift", speed: 1, height: 2}}\n'))
    with pytest.raises(SpecError, match='missing key "speed"'):
        load_task(write_task(tmp_path, more='terms: {lift: {term: "own.py:lift"}}\n'))
    with pytest.raises(SimulationError, match=r'"knock" comes every 0\.001 s, more often than control steps of 0\.025 s'):
        tiny_env(tmp_path, more=KNOCK.replace("0.1 s, 0.2 s", "1 ms, 0.2 s"))
