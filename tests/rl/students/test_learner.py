"""Teaching in blocks: who sees what, what is learned from it, and going on."""

import re

import pytest
import torch
from felt_tasks import felt_task
from written_teachers import teacher

from tgdsl.errors import SpecError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.playing.evaluation import evaluate, evaluate_each
from tgdsl.rl.playing.policy import policy_for, read_policy
from tgdsl.rl.sensed import Felt
from tgdsl.rl.students.keys import Teacher, feels, student_keys
from tgdsl.rl.students.learner import Distiller
from tgdsl.rl.train.folder import CheckpointError, read_checkpoint, write_checkpoint
from tgdsl.rl.train.run import restore, state_of

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
SMALL = {
    "distill.steps": 4,
    "distill.epochs": 2,
    "distill.networks.encoder.hidden": "[8]",
    "distill.networks.encoder.size": 4,
    "distill.networks.hidden": "[8]",
    "distill.networks.touch_encoder.hidden": "[6]",
    "distill.networks.convolution.channels": "[3]",
    "distill.learning_rate": 1e-3,
}
ENVS = 12
FORWARD = 1e-5  # float32: sums in another order


@pytest.fixture
def make(tmp_path):
    """Return a function that makes a distiller of four students: depth and bool at two placements, depth blind of the finger."""
    made, task = [], felt_task(tmp_path)
    files = {}

    def distiller(
        types=("depth", "bool", "none"),
        placements=("ends", "all"),
        seeds=1,
        num_envs=None,
        sees=("priv_proprio", "priv_obj_state"),
        **overrides,
    ):
        if sees not in files:
            files[sees] = teacher(tmp_path / f"{sees[0]}.pt", load_task(task), sees, std=[0.5, 0.25])
        dotted = SMALL | {f"distill.{name.replace('__', '.')}": value for name, value in overrides.items()}
        loaded = load_task(task, dotted)
        keys = student_keys(types, placements, ["clean"], seeds)
        own = Teacher(files[sees], loaded)
        made.append(TouchEnv(loaded, num_envs or 2 * len(keys), seed=1, threads=1, feels=feels(keys, own.felt)))
        return Distiller(made[-1], loaded, own.bound(made[-1]), keys, 0)

    yield distiller
    for env in made:
        env.close()


def weights(distiller):
    return [value.detach().clone() for own in distiller.rollouts for value in own.stack.parameters.values()]


def test_students_of_equal_networks_are_stacked_in_blocks(make):
    """Types of as many numbers share a stack, as do seeds; blocks cover all environments, each once."""
    found = make(seeds=2)
    stacks = [[key.name for key in own.keys] for own in found.rollouts]
    assert stacks == [
        ["depth-ends-clean-s0", "depth-ends-clean-s1", "bool-ends-clean-s0", "bool-ends-clean-s1"],
        ["depth-all-clean-s0", "depth-all-clean-s1", "bool-all-clean-s0", "bool-all-clean-s1"],
        ["none-s0", "none-s1"],
    ]
    envs = [env for own in found.rollouts for env in range(found.env.num_envs)[own.envs]]
    assert envs == list(range(found.env.num_envs)) and found.env.num_envs == 20
    assert found.groups["depth-all-clean-s1"] == ["proprio", "tactile_sensors/depth/all/clean", "goal"]
    assert found.groups["none-s0"] == ["proprio", "goal"]


def test_each_student_acts_by_what_it_feels_and_nothing_else(make):
    """Other types' readings, other blocks' rows: none of them changes an action; its own do."""
    found = make(networks__touch_kind="lstm")
    found.roll()
    obs = {name: torch.randn_like(value) for name, value in found._seen.items()}
    rows = found.env.num_envs // len(found.keys)

    def actions(seen):
        return found.acting()(seen).split(rows)

    before = actions(obs)
    for name in found.groups["bool-all-clean-s0"] + ["tactile_sensors/depth/ends/clean"]:
        other = obs | {name: obs[name] + 1.0}
        for key, one, two in zip(found.keys, before, actions(other), strict=True):
            assert torch.equal(one, two) != (name in found.groups[key.name]), (key.name, name)
    for block in range(len(found.keys)):
        other = {name: value.clone() for name, value in obs.items()}
        for value in other.values():
            value[block * rows : (block + 1) * rows] += 1.0
        changed = [not torch.equal(one, two) for one, two in zip(before, actions(other), strict=True)]
        assert changed == [own == block for own in range(len(found.keys))]


def test_a_student_learns_nothing_of_others(make):
    """Other blocks' readings and labels are changed between rollout and update: its weights are the same."""
    one, other = make(), make()
    for distiller in (one, other):
        torch.manual_seed(0)
        distiller.roll()
    last = other.rollouts[-1]
    last.x.add_(1.0)
    other._labels[:, last.envs] += 1.0
    for distiller in (one, other):
        distiller.learn()
    for own, its in zip(one.rollouts, other.rollouts, strict=True):
        is_same = [torch.equal(a, b) for a, b in zip(own.stack.parameters.values(), its.stack.parameters.values(), strict=True)]
        assert all(is_same) if its is not last else not any(is_same)


def test_a_rollout_holds_what_was_seen_done_and_said(make):
    """Recorded at the environments: inputs, actions, the teacher's actions, and privileged numbers."""
    found, rows = make(), []
    step = found.env.step

    def recorded(action):
        obs, told = found.env.observe(), found.env.task.decoded(found.env.now)
        rows.append((obs, action.clone(), {name: value.clone() for name, value in told.items()}))
        return step(action)

    found.env.step = recorded
    found.roll()
    found.roll()
    for t, (obs, action, told) in enumerate(rows[4:]):
        torch.testing.assert_close(found._labels[t], found._teacher(obs))
        assert torch.equal(found._privileged[t], torch.stack([told["object_size"], told["goal_distance"]], dim=1).float())
        for own in found.rollouts:
            for i, key in enumerate(own.keys):
                block = slice(own.first + i * own.rows, own.first + (i + 1) * own.rows)
                seen = torch.cat([obs[name][block] for name in found.groups[key.name]], dim=1)
                assert torch.equal(own.x[t, i], seen) and torch.equal(own.before[t, i], action[block])
                made = own.stack.student(i)(seen, own.memory[i])
                torch.testing.assert_close(made.action, action[block], rtol=FORWARD, atol=FORWARD)


def test_memory_ends_with_episodes(make):
    """Of 8 steps: a student's memory is that of its own steps since the last reset, for other students too."""
    found = make(networks__touch_kind="convrnn", networks__kind="lstm", networks__encoder__hidden="[5]")
    seen = []
    step = found.env.step

    def recorded(action):
        made = step(action)
        seen.append(([x.clone() for x in found._inputs], made.info.ended.clone()))
        return made

    found.env.step = recorded
    found.iterate()
    held = [torch.zeros_like(own.memory) for own in found.rollouts]
    seen.clear()
    for own in found.rollouts:
        own.memory.zero_()
    for _ in range(3):
        found.roll()
    assert any(bool(ended.any()) for _, ended in seen) and not all(bool(ended.any()) for _, ended in seen)
    for inputs, ended in seen:
        for i, own in enumerate(found.rollouts):
            held[i] = own.stack(inputs[i], held[i]).memory
            held[i][own.split(ended)] = 0.0
    for expected, own in zip(held, found.rollouts, strict=True):
        torch.testing.assert_close(own.memory, expected, rtol=FORWARD, atol=FORWARD)


@pytest.mark.parametrize(("aggregate", "kind"), [(1, "mlp"), (3, "lstm")])
def test_passes_go_through_rollouts_that_are_kept(make, aggregate, kind):
    """The first through the latest one; the others through any of the last, with what was said and remembered in it."""
    epochs = 3 * aggregate
    chosen = {"types": ("depth",), "placements": ("ends",), "aggregate": aggregate, "epochs": epochs}
    found, rollouts, passes = make(**chosen, networks__touch_kind=kind), [], []
    learned = found._learned

    def noted():
        return [value.clone() for value in found._of_rollout()]

    found._learned = lambda: (passes.append(noted()), learned())
    for _ in range(4):
        found.roll()
        rollouts.append(noted())
        passes.clear()
        found.learn()
        which = [[all(map(torch.equal, own, seen)) for own in rollouts].index(True) for seen in passes]
        assert which[0] == len(rollouts) - 1 and len(which) == epochs
        assert set(which) == set(range(max(0, len(rollouts) - aggregate), len(rollouts)))
        assert all(map(torch.equal, noted(), rollouts[-1]))


def test_a_clip_bounds_from_where_a_pass_begins(make):
    """In a rollout that earlier weights made too: a_0 is what the present ones ask for, and the bounded error has a gradient."""
    chosen = {"types": ("depth", "none"), "placements": ("ends",), "networks__touch_kind": "lstm"}
    found, whole, passes = make(**chosen, aggregate=3, epochs=4, clip=1e-3), [], []
    learned = found._learned

    def noted():
        is_latest = all(map(torch.equal, [own.x for own in found.rollouts], latest))
        for own in found.rollouts:
            memory = own.begun
            for t in range(len(own.x)):
                made = own.stack(own.x[t], memory)
                passes.append((is_latest, torch.equal(own.before[t], made.action)))
                memory = torch.where(own.split(found._ended[t])[..., None], 0.0, made.memory)
        learned()

    found._learned = noted
    for _ in range(3):
        found.roll()
        latest = [own.x.clone() for own in found.rollouts]
        whole.append([own.before.clone() for own in found.rollouts])
        found.learn()
        assert all(map(torch.equal, [own.before for own in found.rollouts], whole[-1]))
    earlier = [is_same for is_latest, is_same in passes if not is_latest]
    assert earlier and all(earlier) and not all(is_same for is_latest, is_same in passes if is_latest)


def test_to_stop_and_go_on_is_to_go_on(make, tmp_path):
    """To the bit, where the environments are put where they were; otherwise a checkpoint begins episodes again.

    A step is made before: a loaded state has no instant, of which decoders tell.
    """
    chosen = {"types": ("depth", "none"), "placements": ("ends",), "networks__touch_kind": "convrnn"}
    chosen |= {"std": 0.1, "max_grad_norm": 0.5, "decoders": "{object_size: {scale: 20}}"}
    one, other = make(**chosen), make(**chosen)
    for _ in range(2):
        one.iterate()
    write_checkpoint(state_of(one, 1.0), tmp_path / "checkpoint.pt")
    envs, generator = one.env.state_dict(), torch.get_rng_state()
    restore(other, read_checkpoint(tmp_path / "checkpoint.pt"), tmp_path / "checkpoint.pt")
    assert (other.iteration, other.samples) == (2, 2 * 4 * 4)
    other.env.load_state_dict(envs)
    for distiller in (one, other):
        distiller.env.step(torch.zeros(distiller.env.num_envs, distiller.env.num_actions))
        distiller.go_on_here()
        torch.set_rng_state(generator)
        distiller.iterate()
    assert all(torch.equal(a, b) for a, b in zip(weights(one), weights(other), strict=True))
    for own, its in zip(one.rollouts, other.rollouts, strict=True):
        assert all(torch.equal(own.stack.buffers[name], its.stack.buffers[name]) for name in ("mean", "var"))
        assert torch.equal(own.x, its.x)


def test_a_checkpoint_of_others_is_refused(make, tmp_path):
    one = make()
    one.iterate()
    file = tmp_path / "checkpoint.pt"
    write_checkpoint(state_of(one, 1.0), file)
    with pytest.raises(CheckpointError, match=r"learned from the groups .*bool-all.*, not"):
        restore(make(types=("depth",)), read_checkpoint(file), file)
    found = r"its networks are encoders\.0\.layers\.0\.weight, .*, trunk\.2\.bias, .*, decoders\.1\.4\.bias$"
    refused = [
        ({"networks__hidden": "[9]"}, r"trunk\.0\.weight is \(2, 8, 40\), not \(2, 9, 40\)$"),
        ({"networks__encoder__hidden": "[7]"}, r"encoders\.0\.layers\.0\.weight is \(2, 8, 6\), not \(2, 7, 6\)$"),
        ({"networks__touch_kind": "lstm"}, found),
        ({"decoders": "{object_size: {hidden: [4]}}"}, found),
    ]
    for chosen, expected in refused:
        with pytest.raises(CheckpointError, match=f"its networks are of other sizes: {expected}"):
            restore(make(**chosen), read_checkpoint(file), file)


def test_students_learn_what_they_can_see(make):
    """A teacher that looks at joints alone, as all of them can."""
    chosen = {
        "types": ("bool", "none"),
        "placements": ("ends",),
        "epochs": 6,
        "learning_rate": 3e-2,
        "max_grad_norm": "null",
        "clip": 1.0,
        "networks__hidden": "[16]",
        "networks__encoder__size": 8,
    }
    heads = "{goal_distance: {weight: 0.01, hidden: [4]}}"
    found = make(num_envs=16, sees=("proprio",), decoders=heads, **chosen)
    told = [found.iterate().metrics for _ in range(12)]
    for key in found.keys:
        errors = [row[f"Loss/{key.name}"] for row in told]
        assert min(errors[-5:]) < 0.1 * errors[0]


def test_what_an_iteration_tells_is_of_each_block(make):
    """Scores are means over the episodes that ended in a student's own environments."""
    found = make()
    ended, scores, step = torch.zeros(10), torch.zeros(10), found.env.step

    def recorded(action):
        made = step(action)
        ended.add_(made.info.ended)
        made = made._replace(info=made.info._replace(score=torch.arange(10.0)))
        scores.add_(made.info.ended * made.info.score)
        return made

    found.env.step = recorded
    told = found.iterate().metrics
    for i, key in enumerate(found.keys):
        own = slice(2 * i, 2 * i + 2)
        count = float(ended[own].sum())
        assert told.get(f"Score/{key.name}") == (pytest.approx(float(scores[own].sum()) / count) if count else None)


def test_blocks_are_evaluated_as_one_policy_is(make):
    """A block of one policy's environments, of which the first episodes count, is what those environments tell."""
    found = make(types=("none",), placements=("ends",), seeds=2, num_envs=6)
    each = evaluate_each(found.env, found.acting(), 2, 6, seed=5)
    assert [(own.episodes, own.envs) for own in each] == [(6, 3), (6, 3)]
    whole = evaluate(found.env, found.acting(), 12, seed=5)
    assert whole.score == pytest.approx(sum(own.score for own in each) / 2)
    assert whole.episode_return == pytest.approx(sum(own.episode_return for own in each) / 2)
    assert each[0].episode_return != each[1].episode_return


def test_a_teacher_may_feel(make, tmp_path):
    """Its own type joins those that are felt, and students may be of others."""
    task = tmp_path / "task.yaml"
    loaded = load_task(task, SMALL | {"touch": "depth", "placement": "all"})
    file = teacher(tmp_path / "feeling.pt", loaded, ["proprio", "tactile_sensors"])
    own = Teacher(file, loaded)
    own.check_taxels()
    assert own.felt == Felt("depth", "all", "clean")
    keys = student_keys(["bool"], ["ends"], ["clean"], 1)
    env = TouchEnv(loaded, 2, seed=1, threads=1, feels=feels(keys, own.felt))
    try:
        bound, obs = own.bound(env), env.reset(4)
        assert bound.groups == ("proprio", "tactile_sensors/depth/all/clean")
        alone = TouchEnv(loaded, 2, seed=1, threads=1)
        torch.testing.assert_close(bound(obs), policy_for(alone, read_policy(file))(alone.reset(4)))
        alone.close()
    finally:
        env.close()


def test_mistakes_of_the_document_are_named(make):
    with pytest.raises(SpecError, match=r'distill\.decoders\.size: the task has no privileged number "size"'):
        make(decoders="{size: {}}")
    said = 'there is no group of observations "propio"; did you mean "proprio"?'
    with pytest.raises(SpecError, match=r"distill\.groups\[0\]: " + re.escape(said)):
        make(groups="[propio]")
    with pytest.raises(SpecError, match="steps is 5, expected a multiple of gradient_length, 2"):
        make(steps=5)
    with pytest.raises(SpecError, match="kernel is 2, expected an odd number"):
        make(networks__convolution__kernel=2)
