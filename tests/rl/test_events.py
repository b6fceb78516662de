"""Events of a document: what they change, when they occur, and that other environments stay unchanged."""

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


def flying_envs(folder, more, num_envs=4, **options):
    """Return environments whose ball floats without gravity, out of reach of everything."""
    env = tiny_env(folder, num_envs, gravity="0 0 0", more=more, **options)
    env.sim.qpos[:, 5] = 1.0
    return env


def velocity_changes(env, steps):
    """Return the change of the ball's velocities in each control step: (step, env, 6)."""
    rows = [env.sim.qvel[:, 3:9].clone()]
    for _ in range(steps):
        env.step(torch.zeros(env.num_envs, 2))
        rows.append(env.sim.qvel[:, 3:9].clone())
    return torch.stack(rows).diff(dim=0).numpy()


def test_knocks_have_sizes_and_intervals_within_bounds(tmp_path):
    """Without forces a sphere keeps its linear and angular velocity."""
    env = flying_envs(tmp_path, KNOCK)
    jumps = velocity_changes(env, 60)
    for row in jumps.swapaxes(0, 1):
        steps = np.flatnonzero(np.abs(row).max(axis=1) > 1e-9)
        gaps = np.diff(steps)
        assert len(steps) >= 8 and gaps.min() >= 4 and gaps.max() <= 8 and len(set(gaps)) > 1
        knocks = row[steps]
        assert (knocks[:, :3] > 0.1 - 1e-6).all() and (knocks[:, :3] < 0.2 + 1e-6).all()
        assert (knocks[:, 3:] > 1 - 1e-6).all() and (knocks[:, 3:] < 2 + 1e-6).all()
        assert np.unique(knocks[:, 0]).size == len(steps)


def test_events_do_not_depend_on_the_batch(tmp_path):
    """Each environment draws its own numbers, whichever others there are."""
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    whole, last = flying_envs(tmp_path / "a", KNOCK, 4), flying_envs(tmp_path / "b", KNOCK, 2, first_env=2)
    np.testing.assert_array_equal(velocity_changes(whole, 20)[:, 2:], velocity_changes(last, 20))


def test_a_user_defined_function_runs_at_each_reset(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    more = 'terms: {lift: {term: "own.py:lift", mode: reset, speed: 0.5, times: 2}}\nepisode: 0.5 s\n'
    env = tiny_env(tmp_path, 3, gravity="0 0 0", more=more)
    assert env.sim.qvel[:, 5].tolist() == pytest.approx([1.0] * 3)
    for _ in range(3):
        env.step(torch.zeros(3, 2))
    env.steps[1] = env.max_steps  # the next step ends this episode alone
    velocity = env.sim.qvel[:, 5].clone()
    env.step(torch.zeros(3, 2))
    assert env.sim.qvel[1, 5].item() == pytest.approx(1.0)
    torch.testing.assert_close(env.sim.qvel[[0, 2], 5], velocity[[0, 2]])


def test_random_properties_can_be_redrawn_at_intervals(tmp_path):
    """Friction, mass and drives stay in range, differ between draws, and reach the simulation."""
    more = """randomise: {drive: {gain: [0.5, 1.5]}}
episode: 60 s
terms:
  slippery: {term: friction, factor: [0.2, 0.4], mode: interval, interval: [0.1 s, 0.2 s]}
  heavy: {term: mass, added: [100 g, 200 g]}
  wear: {term: drive, mode: interval, interval: [0.1 s, 0.2 s]}
"""
    env = flying_envs(tmp_path, more)
    setup, properties = env.task.setup, env.sim.properties
    rows = []
    for _ in range(60):
        env.step(torch.zeros(4, 2))
        torch.testing.assert_close(properties.friction(setup.object), setup.friction)
        torch.testing.assert_close(properties.mass(setup.object), setup.mass)
        rows.append(
            torch.stack(
                [setup.friction / setup.scene_friction, setup.mass - setup.scene_mass, env.actuation.drawn["gain"][:, 0]]
            )
        )
    factor, added, gain = (value.numpy() for value in torch.stack(rows, dim=1))
    for values, low, high in ((factor[8:], 0.2, 0.4), (added, 0.1, 0.2), (gain, 0.5, 1.5)):
        assert low <= values.min() and values.max() <= high
    assert (added == added[0]).all() and len(set(added[0])) == 4
    for values in (factor, gain):
        assert all(8 <= np.count_nonzero(np.diff(column)) <= 15 for column in values.T)


@pytest.mark.parametrize(
    ("short", "term"),
    [
        ("friction: [0.5, 1.5]", "friction, factor: [0.5, 1.5]"),
        ("mass: [0, 100 g]", "mass, added: [0, 100 g]"),
        (
            "push: {x: [1 N, 2 N], interval: [0.1 s, 0.2 s], duration: 50 ms}",
            "push, x: [1 N, 2 N], interval: [0.1 s, 0.2 s], duration: 50 ms",
        ),
    ],
)
def test_the_short_form_and_the_term_draw_different_numbers(tmp_path, short, term):
    """Over many environments both have the same mean and range; in each environment the numbers differ."""
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    one = flying_envs(tmp_path / "a", f"randomise: {{{short}}}\nepisode: 60 s\n", 64)
    two = flying_envs(tmp_path / "b", f"terms: {{other: {{term: {term}}}}}\nepisode: 60 s\n", 64)
    samples = []
    for env in (one, two):
        for _ in range(9):
            env.step(torch.zeros(64, 2))
        setup = env.task.setup
        samples.append(torch.stack([setup.friction, setup.mass, env.sim.qvel[:, 3]]).numpy())
    varied = [i for i in range(3) if np.ptp(samples[0][i]) > 1e-9]
    assert len(varied) == 1 and not np.array_equal(*(rows[varied[0]] for rows in samples))
    low, high = (getattr(samples[0][varied[0]], end)() for end in ("min", "max"))
    assert abs(samples[1][varied[0]].mean() - samples[0][varied[0]].mean()) < 0.25 * (high - low)
    constant = [i for i in range(3) if i not in varied]
    np.testing.assert_array_equal(samples[0][constant], samples[1][constant])


def test_a_saved_environment_resumes_with_its_events(tmp_path):
    env = flying_envs(tmp_path, KNOCK)
    velocity_changes(env, 7)
    resumed = tiny_env(tmp_path, gravity="0 0 0", more=KNOCK)
    resumed.load_state_dict(env.state_dict())
    np.testing.assert_array_equal(velocity_changes(resumed, 20), velocity_changes(env, 20))


def test_a_saved_environment_resumes_within_a_push(tmp_path):
    more = (
        "randomise: {push: {x: [1 N, 2 N], interval: [0.1 s, 0.1 s], duration: 0.1 s}}\nepisode: 60 s\ndrop_distance: 100 m\n"
    )
    env, resumed = flying_envs(tmp_path, more), tiny_env(tmp_path, gravity="0 0 0", more=more)
    assert not velocity_changes(env, 3).any() and velocity_changes(env, 2)[-1, :, 0].all()
    resumed.load_state_dict(env.state_dict())
    np.testing.assert_array_equal(velocity_changes(resumed, 20), velocity_changes(env, 20))


def test_errors_in_an_event_are_reported(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    with pytest.raises(SpecError, match="unknown key"):
        load_task(write_task(tmp_path, more='terms: {lift: {term: "own.py:lift", speed: 1, height: 2}}\n'))
    with pytest.raises(SpecError, match='missing key "speed"'):
        load_task(write_task(tmp_path, more='terms: {lift: {term: "own.py:lift"}}\n'))
    with pytest.raises(SimulationError, match=r'"knock" comes every 0\.001 s, more often than control steps of 0\.025 s'):
        tiny_env(tmp_path, more=KNOCK.replace("0.1 s, 0.2 s", "1 ms, 0.2 s"))


def test_a_document_can_randomise_the_objects_placement(tmp_path):
    """Within bounds along x and y, turned about the vertical, otherwise as in the keyframe."""
    env = tiny_env(tmp_path, 32, more="terms: {place: {term: placement, xy: [1 mm, 2 mm], yaw: [0.2, 0.3]}}\n")
    pos, quat = env.sim.qpos[:, 3:6].numpy(), env.sim.qpos[:, 6:10].numpy()
    assert (pos[:, :2] > 1e-3 - 1e-9).all() and (pos[:, :2] < 2e-3 + 1e-9).all() and np.unique(pos[:, 0]).size == 32
    np.testing.assert_allclose(pos[:, 2], 0.03)
    turn = 2.0 * np.arctan2(quat[:, 3], quat[:, 0])
    assert (quat[:, 1:3] == 0.0).all() and (turn > 0.2).all() and (turn < 0.3).all()
