"""Turning an object to a sequence of orientations: rewards and terminations against the reference, goals, incentives."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from paper_drives import PAPER
from scipy.spatial.transform import Rotation
from task_records import Recorder, reference_rates
from task_references import in_hand_repose
from tiny_tasks import tiny_env

from tgdsl.errors import SpecError
from tgdsl.rl.draws import Draws
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.tasks.in_hand_repose import InHandRepose, InHandReposeSpec

FOLDER = Path(__file__).parents[3] / "examples" / "tasks"
DOCUMENTS = [FOLDER / "in_hand_repose.yaml", FOLDER / "in_hand_repose_sharpa.yaml"]
QUICK = """episode: 0.6 s
goal_step: 0.3
goal_tolerance: 0.2
goal_hold: 2
goal_timeout: 0.3 s
track_width: 0.3
track_half: 0.15
max_spin: 2
near_width: 1 cm
max_force: 0.05 N
drop_distance: 2 cm
action: {scale: 0.3}
randomise: {xy: [-5 mm, 5 mm], yaw: [-3, 3], push: {x: [-2 N, 2 N], interval: [0.1 s, 0.2 s]}}
"""


def repose(folder, num_envs=2, more="episode: 20 s\n", gravity="0 0 0", axis="any", **options):
    folder.mkdir(exist_ok=True)
    return tiny_env(folder, num_envs, task="in_hand_repose", gravity=gravity, more=more + f"goal_axis: {axis}\n", **options)


def random_actions(env, num, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [2 * torch.rand((env.num_envs, env.num_actions), generator=generator) - 1 for _ in range(num)]


def goal_steps(env, episode, goal, seed=0):
    """Return the number of control steps allowed for a goal."""
    low, high = env.spec.goal_timeout
    share = Draws(seed, env.num_envs).shares({"goal timeout": 1}, torch.full((env.num_envs,), (episode << 32) + goal))
    return np.round((low + (high - low) * share["goal timeout"][:, 0].numpy()) / env.control_step).astype(int)


def goal_axes(num_envs, episode, goal, kind="any", seed=0, step=0.3):
    """Return the axes of an episode's goals from the counted numbers; for `xy`, the angles about both axes."""
    count = torch.full((num_envs,), (episode << 32) + goal)
    draws = Draws(seed, num_envs)
    if kind == "vertical":
        side = draws.integers("goal side", count, 1, 0, 1).double().numpy()
        return np.concatenate([0 * side, 0 * side, 2 * side - 1], axis=1)
    if kind == "xy":
        return draws.uniform("goal angles", count, 2, -step, step).double().numpy()
    axis = draws.normal("goal axis", count, 3).double().numpy()
    return axis / np.linalg.norm(axis, axis=1, keepdims=True)


def put(env, rotation):
    """Turn each environment's ball to a rotation, at rest."""
    quat = np.roll(rotation.as_quat(), 1, axis=-1)
    env.sim.qpos[:, 6:10] = torch.from_numpy(np.broadcast_to(quat, (env.num_envs, 4)).copy())
    env.sim.qvel[:, 3:] = 0


def rest(env):
    return env.step(torch.zeros(env.num_envs, env.num_actions))


def compare(env, recorder, first_episode=2, kind="any"):
    """Compare the records with the reference; return the terms of all episodes by name."""
    axes, all_terms, records = {}, [], iter(recorder.records())
    for env_id, episodes in enumerate(recorder.episodes):
        for number, (_, rows) in enumerate(episodes, start=first_episode):
            if not rows:
                continue
            record, actual = next(records)
            if number not in axes:
                axes[number] = [goal_axes(env.num_envs, number, k, kind) for k in range(12)]
            name = "goal_angles" if kind == "xy" else "goal_axis"
            record[name] = np.stack([axis[env_id] for axis in axes[number]])
            record["goal_steps"] = [goal_steps(env, number, k)[env_id] for k in range(12)]
            expected = reference_rates(env.task, in_hand_repose, env.spec, record, env.control_step)
            assert expected.keys() == actual.keys()
            for name, value in expected.items():
                scale = max(1.0, float(np.abs(value).max()))
                np.testing.assert_allclose(actual[name], value, rtol=0, atol=1e-6 * scale, err_msg=name)
            all_terms.append(actual)
    assert next(records, None) is None
    return all_terms


@pytest.mark.parametrize("kind", ["any", "vertical"])
def test_rewards_ends_and_scores_equal_the_reference(tmp_path, kind):
    """Each weight differs from the task's by its own factor."""
    weights = {name: (1.5 + 0.1 * i) * value for i, (name, value) in enumerate(InHandRepose.Rewards())}
    env = repose(tmp_path, 4, QUICK, "0 0 -9.81", kind, overrides={"rewards": weights})
    recorder = Recorder(env)
    for i, action in enumerate(random_actions(env, 70)):
        env.sim.qvel[1, 6:9] = 3.0 if i % 4 else -3.0  # nothing else turns a ball
        if i % 5 in (0, 1):
            env.sim.qpos[0, 6:10] = env.task.goal[0]
        recorder.step(action if i < 40 else torch.ones_like(action))
    episodes = compare(env, recorder, kind=kind)
    assert len(episodes) >= 12 and max(rows["score"].max() for rows in episodes) >= 2
    assert sum(rows["goal_timeout"].any() for rows in episodes) >= 2 and sum(rows["drop"].any() for rows in episodes) >= 1
    terms = set(InHandRepose.Rewards.model_fields) | {"is_over", "score"}
    assert {name for rows in episodes for name, value in rows.items() if np.abs(value).max() > 1e-9} == terms
    max_progress = 2 * weights["progress"]
    assert max(np.abs(rows["progress"]).max() for rows in episodes) > max_progress  # losses are not clipped
    assert max(rows["progress"].max() for rows in episodes) <= max_progress + 1e-6


def test_xy_goals_and_random_times_equal_the_reference(tmp_path):
    settings = "drop_measure: below\nmin_spin: -1\nbackward: 2\ngoal: [orientation, difference, angle]\n"
    env = repose(
        tmp_path, 4, QUICK.replace("goal_timeout: 0.3 s", "goal_timeout: [0.15 s, 0.4 s]") + settings, "0 0 -9.81", "xy"
    )
    recorder = Recorder(env)
    for i, action in enumerate(random_actions(env, 70)):
        env.sim.qvel[1, 6:9] = 3.0 if i % 4 else -3.0
        if i % 5 in (0, 1):
            env.sim.qpos[0, 6:10] = env.task.goal[0]
        recorder.step(action)
    episodes = compare(env, recorder, kind="xy")
    assert max(rows["score"].max() for rows in episodes) >= 2 and sum(rows["goal_timeout"].any() for rows in episodes) >= 4
    assert len({len(rows["score"]) for rows in episodes if rows["goal_timeout"].any()}) > 3  # times differ
    assert min(rows["progress"].min() for rows in episodes) == pytest.approx(0.2 * 2 * -1)
    angles = np.concatenate([goal_axes(500, 1, k, "xy") for k in range(4)])
    assert np.abs(angles).max() <= 0.3 and np.abs(angles.mean(axis=0)).max() < 0.02
    np.testing.assert_allclose(angles.std(axis=0), 0.3 / math.sqrt(3), rtol=0.05)
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS, ids=["xhand1", "sharpa"])
def test_real_hands_equal_the_reference(document):
    quick = {"episode": "0.6 s", "goal_tolerance": 0.39, "goal_hold": 2, "goal_timeout": "0.4 s"}
    controls = {"action": {"mode": "relative", "scale": 0.3}, "touch": "none"}
    env = TouchEnv(document, 4, threads=1, overrides=quick | controls)
    recorder = Recorder(env)
    for action in random_actions(env, 60):
        recorder.step(action)
    assert len(compare(env, recorder, kind="vertical")) >= 8


def test_terms_at_a_known_angle(tmp_path):
    env = repose(tmp_path)
    env.reset()
    for angle in (0.4, 0.25, 0.12):
        put(env, Rotation.from_rotvec(goal_axes(2, 2, 0) * (0.4 - angle)))
        terms = rest(env).info.terms
        rates = {name: (value / env.control_step).tolist() for name, value in terms.items()}
        assert rates["track_gaussian"] == pytest.approx([2 * math.exp(-0.5 * (angle / 0.2) ** 2)] * 2, rel=1e-5)
        assert rates["track_inverse"] == pytest.approx([2 / (1 + (angle / 0.1) ** 2)] * 2, rel=1e-5)
        assert rates["success"] == rates["drop"] == rates["goal_timeout"] == [0, 0]


@pytest.mark.parametrize("kind", ["any", "vertical"])
def test_turning_right_beats_rest_and_rest_beats_turning_wrong(tmp_path, kind):
    env = repose(tmp_path, 5, axis=kind)
    env.reset()
    axes, total = goal_axes(5, 2, 0, kind), torch.zeros(5)
    for step in range(1, 9):
        put(env, Rotation.from_rotvec(axes * np.array([[-1.2], [-0.3], [0.0], [0.3], [1.2]]) * env.control_step * step))
        total += rest(env).reward
    wrong, slowly_wrong, still, slow, right = total.tolist()
    assert wrong < slowly_wrong < still < slow < right


@pytest.mark.parametrize("there", [0.05, 0.1, 0.3], ids=["slowly", "at max_spin", "faster than max_spin"])
def test_turning_away_and_back_makes_no_progress(tmp_path, there):
    """In either order of fast and slow: gains are clipped, losses never."""
    env = repose(tmp_path, 2)
    env.reset()
    axes, progress = goal_axes(2, 2, 0), torch.zeros(2)
    for first, second in ((there, 0.05), (0.05, there)):
        path = [*np.arange(0, 0.6, first)[1:], 0.6, *np.arange(0.6, 0, -second)[1:], 0.0]
        for angle in path:
            put(env, Rotation.from_rotvec(-angle * axes))
            progress += rest(env).info.terms["progress"]
    assert (progress < 1e-6).all()
    if there <= 0.1:
        assert progress.tolist() == pytest.approx([0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("kind", ["any", "vertical"])
def test_each_goal_must_be_held_and_the_next_starts_from_it(tmp_path, kind):
    env = repose(tmp_path, 3, "episode: 20 s\ngoal_hold: 3\n", axis=kind)
    obs, goal = env.reset(), Rotation.identity(3)
    for k in range(4):
        goal = Rotation.from_rotvec(0.4 * goal_axes(3, 2, k, kind)) * goal
        columns = goal.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(3, 6)
        np.testing.assert_allclose(obs["goal"][:, :6], columns, rtol=0, atol=1e-6)
        near_goal = Rotation.from_rotvec([0.05, 0, 0]) * goal  # within the tolerance, without effect on the next goal
        put(env, near_goal)
        for steps_held in range(1, 4):
            result = rest(env)
            obs = result.obs
            assert result.info.terms["success"].tolist() == pytest.approx([500 * env.control_step * (steps_held == 3)] * 3)
            assert result.info.score.tolist() == [k + (steps_held == 3)] * 3
            if steps_held < 3:
                assert obs["goal"][:, 6].tolist() == pytest.approx([0.05] * 3, abs=1e-6)
        assert ((obs["goal"][:, 6] >= 0.35 - 1e-6) & (obs["goal"][:, 6] <= 0.45 + 1e-6)).all()
        # A change of the goal is no progress.
        assert rest(env).info.terms["progress"].tolist() == pytest.approx([0.0] * 3, abs=1e-6)


def test_a_goal_left_too_early_is_not_reached(tmp_path):
    env = repose(tmp_path, 2, "episode: 20 s\ngoal_hold: 3\n")
    env.reset()
    goal = Rotation.from_rotvec(0.4 * goal_axes(2, 2, 0))
    for is_at_goal in (True, True, False, True, True, False):
        put(env, goal if is_at_goal else Rotation.identity(2))
        assert not rest(env).info.terms["success"].any()
    assert env.task.score().tolist() == [0, 0]


def test_a_goal_that_takes_too_long_terminates_the_episode(tmp_path):
    env = repose(tmp_path, 2, "episode: 20 s\ngoal_hold: 1\ngoal_timeout: 0.1 s\n")
    env.reset()
    for _ in range(2):
        rest(env)
    goal = Rotation.from_rotvec(0.4 * goal_axes(2, 2, 0)).as_rotvec()
    goal[1] = 0  # the second object stays in place
    put(env, Rotation.from_rotvec(goal))
    assert rest(env).info.score.tolist() == [1, 0]
    result = rest(env)
    assert result.terminated.tolist() == [False, True] and not result.truncated.any()
    assert result.info.terms["goal_timeout"].tolist() == pytest.approx([0, -200 * env.control_step])
    assert result.info.terms["drop"].tolist() == [0, 0]
    assert [rest(env).terminated.tolist() for _ in range(4)] == [[False, False], [False, False], [True, False], [False, True]]


def test_a_goal_reached_at_the_last_step_is_in_time(tmp_path):
    env = repose(tmp_path, 1, "episode: 20 s\ngoal_hold: 2\ngoal_timeout: 0.1 s\n")
    env.reset()
    for _ in range(2):
        rest(env)
    put(env, Rotation.from_rotvec(0.4 * goal_axes(1, 2, 0)))
    rest(env)
    result = rest(env)
    assert result.info.score.tolist() == [1] and not result.terminated.any()


def test_a_dropped_object_terminates_the_episode(tmp_path):
    env = repose(tmp_path, 2, "episode: 20 s\n")
    env.reset()
    env.sim.qpos[:, 5] += torch.tensor([0.079, 0.081])
    env.sim.qvel[:, 3:] = 0
    result = rest(env)
    assert result.terminated.tolist() == [False, True]
    assert result.info.terms["drop"].tolist() == pytest.approx([0, -100 * env.control_step])


def test_truncating_one_episode_does_not_affect_the_others(tmp_path):
    env = repose(tmp_path, 3, "episode: 1 s\ngoal_hold: 1\n")
    env.reset()
    put(env, Rotation.from_rotvec(0.4 * goal_axes(3, 2, 0)))
    rest(env)
    env.steps[1] = env.max_steps - 1
    old_memory = {name: value.clone() for name, value in env.task.memory.items()}
    result = rest(env)
    assert result.truncated.tolist() == [False, True, False] and not result.terminated.any()
    memory = env.task.memory
    assert memory["episode"].tolist() == [2, 3, 2] and memory["reached"].tolist() == [1, 0, 1]
    assert memory["waited"].tolist() == [1, 0, 1] and memory["held"].tolist() == [0, 0, 0]
    assert torch.equal(memory["goal"][[0, 2]], old_memory["goal"][[0, 2]])
    goal = Rotation.from_rotvec(0.4 * goal_axes(3, 3, 0)[1]).as_matrix()[:, :2].T.reshape(6)
    np.testing.assert_allclose(result.obs["goal"][1, :6], goal, rtol=0, atol=1e-6)
    np.testing.assert_allclose(result.obs["goal"][1, 6], 0.4, rtol=0, atol=1e-6)
    assert result.info.final_obs["goal"][1, :6].tolist() != result.obs["goal"][1, :6].tolist()


@pytest.mark.parametrize("kind", ["any", "vertical"])
def test_axes_are_uniform_and_do_not_depend_on_the_batch(tmp_path, kind):
    env = repose(tmp_path / "all", 300, axis=kind)
    parts = [repose(tmp_path / str(i), 150, axis=kind, first_env=150 * i) for i in (0, 1)]
    axes = []
    for _ in range(4):
        whole = env.reset()["goal"]
        assert torch.equal(whole, torch.cat([part.reset()["goal"] for part in parts]))
        quat = np.roll(env.task.goal.numpy(), -1, axis=1)
        axes.append(Rotation.from_quat(quat).as_rotvec() / 0.4)
    axis = np.concatenate(axes)
    np.testing.assert_allclose(np.linalg.norm(axis, axis=1), 1.0, atol=1e-9)
    if kind == "vertical":
        assert not axis[:, :2].any()
        assert abs(axis[:, 2].mean()) < 5 / math.sqrt(len(axis))
        return
    assert (np.abs(axis.mean(axis=0)) < 5 * math.sqrt(1 / 3 / len(axis))).all()
    # On the sphere each component is uniform from −1 to 1: variance 1/3, and 4/45 for its square.
    assert (np.abs((axis**2).mean(axis=0) - 1 / 3) < 5 * math.sqrt(4 / 45 / len(axis))).all()


@pytest.fixture(scope="module")
def busy(tmp_path_factory):
    """Return environments where all terms are nonzero; those of events are set by hand."""
    env = repose(tmp_path_factory.mktemp("busy"), 3, QUICK, "0 0 -9.81")
    for i in range(10):
        env.sim.qvel[:, 6:9] = 3.0
        result = env.step(torch.tensor([[1.0, -1.0 if i % 3 else -0.8]] * 3))
        assert torch.stack(list(result.info.terms.values())).sum(dim=0).tolist() == pytest.approx(result.reward.tolist())
    for tensor, value in ((env.task.is_reached, True), (env.task.is_late, True), (env.task.start_pos, 9.0)):
        tensor.fill_(value)
    return env


def changed_terms(env, **changes):
    """Return the reward's terms with changed values of the document."""
    task = InHandRepose(env.task.spec.model_copy(update=changes), env.task.setup)
    for name, value in env.task.memory.items():
        task.memory[name].copy_(value)
    return task.reward(env.now, task.is_over(env.now))


def test_every_term_is_nonzero(busy):
    assert all(term.abs().max() > 1e-9 for term in changed_terms(busy).values())


@pytest.mark.parametrize(
    ("name", "value", "term", "grows"),
    [
        ("track_width", 0.6, "track_gaussian", True),
        ("track_half", 0.3, "track_inverse", True),
        ("near_width", 0.05, "near", True),
        ("max_force", 0.02, "contact_force", False),
        ("drop_distance", 99.0, "drop", True),
    ],
)
def test_a_parameter_changes_only_its_term(busy, name, value, term, grows):
    other, plain = changed_terms(busy, **{name: value}), changed_terms(busy)
    differs = {key for key in plain if not torch.equal(plain[key], other[key])}
    assert differs == {term}
    assert (other[term].sum() > plain[term].sum()) == grows


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"goal_step": 0.1}, "goal_step is 0.1 rad, expected more than goal_tolerance, 0.1 rad, and at most a half turn"),
        ({"goal_step": "190 deg"}, "goal_step is 3.31613 rad"),
        ({"goal_hold": 201}, "201 control steps of 0.025 s, takes longer than goal_timeout, 5 s"),
        ({"goal_hold": 0}, "goal_hold"),
        ({"goal_axis": "vertcal"}, "goal_axis"),
        ({"goal_timeout": "-1 s"}, "goal_timeout"),
        ({"randomise.friction": [-1, 1]}, "friction"),
    ],
)
def test_impossible_goals_are_refused(changes, said):
    with pytest.raises(SpecError) as error:
        load_task(DOCUMENTS[0], changes)
    assert said in str(error.value)


@pytest.mark.parametrize("document", DOCUMENTS, ids=["xhand1", "sharpa"])
def test_the_documents_have_the_papers_numbers(document):
    spec = load_task(document).spec
    assert isinstance(spec, InHandReposeSpec)
    random = spec.randomise
    assert random.friction == (0.3, 2.0) and random.mass == (0.0, 0.1) and random.xy == (-0.02, 0.02)
    assert random.yaw == pytest.approx((-math.pi, math.pi))
    assert random.drive == PAPER
    assert random.push.x == random.push.y == random.push.z == (-1, 1) and random.push.interval == (2, 4)
    assert spec.episode == 20 and spec.physics.timestep == 0.005 and spec.physics.substeps == 5
    weights = [500, 2, 2, 0.2, 0.5, -5, -100, -200, -1e-5, -20, -1e-3]
    assert list(InHandRepose.Rewards().model_dump().values()) == weights
    assert spec.rewards == (
        InHandRepose.Rewards(joint_limit=-4) if document is DOCUMENTS[0] else InHandRepose.Rewards()
    )  # explained in docs/records/learned.md


@pytest.mark.slow
@pytest.mark.parametrize(("document", "joints"), [(DOCUMENTS[0], 12), (DOCUMENTS[1], 22)], ids=["xhand1", "sharpa"])
def test_each_hand_holds_all_objects_without_actions(document, joints):
    quiet = {"touch": "none", "goal_timeout": "1000 s", "randomise.push": {"x": 0}}
    env = TouchEnv(document, 16, threads=1, overrides=quiet)
    assert env.num_actions == joints and env.task.setup.num_variants == 16
    for _ in range(round(4 / env.control_step)):
        result = rest(env)
        assert not result.terminated.any(), f"{result.terminated.nonzero().flatten().tolist()} were lost"
