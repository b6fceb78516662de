"""Distillation of several students side by side: inputs, updates, checkpoints."""

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
from tgdsl.rl.sensors import PolicyTouch
from tgdsl.rl.students.gates import openings
from tgdsl.rl.students.keys import Teacher, student_keys, touches
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
    """Return a function that makes a distiller of students: depth and bool at two placements, and one without touch."""
    envs, task = [], felt_task(tmp_path)
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
        policy = Teacher(files[sees], loaded)
        envs.append(TouchEnv(loaded, num_envs or 2 * len(keys), seed=1, threads=1, touches=touches(keys, policy.touch)))
        return Distiller(envs[-1], loaded, policy.bound(envs[-1]), keys, 0)

    yield distiller
    for env in envs:
        env.close()


def weights(distiller):
    return [value.detach().clone() for rollout in distiller.rollouts for value in rollout.stack.parameters.values()]


def test_students_of_equal_networks_are_stacked_in_blocks(make):
    """Types of equal size share a stack, as do seeds; blocks partition the environments."""
    distiller = make(seeds=2)
    stacks = [[key.name for key in rollout.keys] for rollout in distiller.rollouts]
    assert stacks == [
        ["depth-ends-clean-s0", "depth-ends-clean-s1", "bool-ends-clean-s0", "bool-ends-clean-s1"],
        ["depth-all-clean-s0", "depth-all-clean-s1", "bool-all-clean-s0", "bool-all-clean-s1"],
        ["none-s0", "none-s1"],
    ]
    envs = [env for rollout in distiller.rollouts for env in range(distiller.env.num_envs)[rollout.envs]]
    assert envs == list(range(distiller.env.num_envs)) and distiller.env.num_envs == 20
    assert distiller.groups["depth-all-clean-s1"] == ["proprio", "tactile_sensors/depth/all/clean", "goal"]
    assert distiller.groups["none-s0"] == ["proprio", "goal"]


def test_actions_depend_only_on_a_students_own_observations(make):
    """Other types' readings and other blocks' rows change no action; a student's own do."""
    distiller = make(networks__touch_kind="lstm")
    distiller.roll()
    obs = {name: torch.randn_like(value) for name, value in distiller._seen.items()}
    rows = distiller.env.num_envs // len(distiller.keys)

    def actions(observations):
        return distiller.acting()(observations).split(rows)

    old_actions = actions(obs)
    for name in distiller.groups["bool-all-clean-s0"] + ["tactile_sensors/depth/ends/clean"]:
        other = obs | {name: obs[name] + 1.0}
        for key, one, two in zip(distiller.keys, old_actions, actions(other), strict=True):
            assert torch.equal(one, two) != (name in distiller.groups[key.name]), (key.name, name)
    for block in range(len(distiller.keys)):
        other = {name: value.clone() for name, value in obs.items()}
        for value in other.values():
            value[block * rows : (block + 1) * rows] += 1.0
        changed = [not torch.equal(one, two) for one, two in zip(old_actions, actions(other), strict=True)]
        assert changed == [index == block for index in range(len(distiller.keys))]


def test_a_students_update_does_not_depend_on_others(make):
    """Changing other blocks' readings and labels after the rollout leaves its weights the same."""
    one, other = make(), make()
    for distiller in (one, other):
        torch.manual_seed(0)
        distiller.roll()
    last = other.rollouts[-1]
    last.x.add_(1.0)
    other._labels[:, last.envs] += 1.0
    for distiller in (one, other):
        distiller.learn()
    for rollout, twin in zip(one.rollouts, other.rollouts, strict=True):
        is_same = [
            torch.equal(a, b) for a, b in zip(rollout.stack.parameters.values(), twin.stack.parameters.values(), strict=True)
        ]
        assert all(is_same) if twin is not last else not any(is_same)


def test_a_rollout_holds_inputs_actions_and_labels(make):
    """Compared with inputs, actions, labels and privileged numbers recorded at the environments."""
    distiller, rows = make(gates="{taxels: 2}"), []
    step = distiller.env.step

    def recording_step(action):
        obs, numbers = distiller.env.observe(), distiller.env.task.decoded(distiller.env.now)
        rows.append((obs, action.clone(), {name: value.clone() for name, value in numbers.items()}))
        return step(action)

    distiller.env.step = recording_step
    distiller.roll()
    distiller.roll()
    for t, (obs, action, numbers) in enumerate(rows[4:]):
        torch.testing.assert_close(distiller._labels[t], distiller._teacher(obs))
        assert torch.equal(
            distiller._privileged[t], torch.stack([numbers["object_size"], numbers["goal_distance"]], dim=1).float()
        )
        for rollout in distiller.rollouts:
            for i, key in enumerate(rollout.keys):
                block = slice(rollout.first + i * rollout.rows, rollout.first + (i + 1) * rollout.rows)
                inputs = torch.cat([obs[name][block] for name in distiller.groups[key.name]], dim=1)
                assert torch.equal(rollout.x[t, i], inputs) and torch.equal(rollout.before[t, i], action[block])
                result = rollout.stack.student(i)(inputs, rollout.memory[i])
                torch.testing.assert_close(result.action, action[block], rtol=FORWARD, atol=FORWARD)


def test_memory_is_cleared_at_the_end_of_an_episode(make):
    """Episodes last 8 steps: a student remembers its steps since the last reset."""
    distiller = make(networks__touch_kind="convrnn", networks__kind="lstm", networks__encoder__hidden="[5]")
    records = []
    step = distiller.env.step

    def recording_step(action):
        result = step(action)
        records.append(([x.clone() for x in distiller._inputs], result.info.ended.clone()))
        return result

    distiller.env.step = recording_step
    distiller.iterate()
    memories = [torch.zeros_like(rollout.memory) for rollout in distiller.rollouts]
    records.clear()
    for rollout in distiller.rollouts:
        rollout.memory.zero_()
    for _ in range(3):
        distiller.roll()
    assert any(bool(ended.any()) for _, ended in records) and not all(bool(ended.any()) for _, ended in records)
    for inputs, ended in records:
        for i, rollout in enumerate(distiller.rollouts):
            memories[i] = rollout.stack(inputs[i], memories[i]).memory
            memories[i][rollout.split(ended)] = 0.0
    for expected, rollout in zip(memories, distiller.rollouts, strict=True):
        torch.testing.assert_close(rollout.memory, expected, rtol=FORWARD, atol=FORWARD)


@pytest.mark.parametrize(("aggregate", "kind"), [(1, "mlp"), (3, "lstm")])
def test_passes_take_the_latest_rollouts(make, aggregate, kind):
    """The first pass uses the latest rollout; each other pass any recent one, with its labels and memory."""
    epochs = 3 * aggregate
    options = {"types": ("depth",), "placements": ("ends",), "aggregate": aggregate, "epochs": epochs}
    distiller, rollouts, passes = make(**options, networks__touch_kind=kind), [], []
    learned = distiller._learned

    def snapshot():
        return [value.clone() for value in distiller._of_rollout()]

    distiller._learned = lambda: (passes.append(snapshot()), learned())
    for _ in range(4):
        distiller.roll()
        rollouts.append(snapshot())
        passes.clear()
        distiller.learn()
        indices = [[all(map(torch.equal, rollout, used)) for rollout in rollouts].index(True) for used in passes]
        assert indices[0] == len(rollouts) - 1 and len(indices) == epochs
        assert set(indices) == set(range(max(0, len(rollouts) - aggregate), len(rollouts)))
        assert all(map(torch.equal, snapshot(), rollouts[-1]))


def test_a_clip_is_relative_to_the_weights_at_the_start_of_a_pass(make):
    """Also for an older rollout: a_0 is the current weights' action, so the bounded error has a gradient."""
    options = {"types": ("depth", "none"), "placements": ("ends",), "networks__touch_kind": "lstm"}
    distiller, actions, passes = make(**options, aggregate=3, epochs=4, clip=1e-3), [], []
    learned = distiller._learned

    def recording_pass():
        is_latest = all(map(torch.equal, [rollout.x for rollout in distiller.rollouts], latest))
        for rollout in distiller.rollouts:
            memory = rollout.begun
            for t in range(len(rollout.x)):
                result = rollout.stack(rollout.x[t], memory)
                passes.append((is_latest, torch.equal(rollout.before[t], result.action)))
                memory = torch.where(rollout.split(distiller._ended[t])[..., None], 0.0, result.memory)
        learned()

    distiller._learned = recording_pass
    for _ in range(3):
        distiller.roll()
        latest = [rollout.x.clone() for rollout in distiller.rollouts]
        actions.append([rollout.before.clone() for rollout in distiller.rollouts])
        distiller.learn()
        assert all(map(torch.equal, [rollout.before for rollout in distiller.rollouts], actions[-1]))
    earlier = [is_same for is_latest, is_same in passes if not is_latest]
    assert earlier and all(earlier) and not all(is_same for is_latest, is_same in passes if is_latest)


def test_a_distillation_resumes_to_the_bit(make, tmp_path):
    """Exact once the environments' state is restored; a checkpoint alone restarts episodes.

    One step comes first: decoders read the instant of a step, which a loaded state lacks.
    """
    options = {"types": ("depth", "none"), "placements": ("ends",), "networks__touch_kind": "convrnn"}
    options |= {"std": 0.1, "max_grad_norm": 0.5, "decoders": "{object_size: {scale: 20}}", "gates": "{taxels: 2}"}
    one, other = make(**options), make(**options)
    for _ in range(2):
        one.iterate()
    write_checkpoint(state_of(one, 1.0), tmp_path / "checkpoint.pt")
    env_state, generator = one.env.state_dict(), torch.get_rng_state()
    restore(other, read_checkpoint(tmp_path / "checkpoint.pt"), tmp_path / "checkpoint.pt")
    assert (other.iteration, other.samples) == (2, 2 * 4 * 4)
    other.env.load_state_dict(env_state)
    for distiller in (one, other):
        distiller.env.step(torch.zeros(distiller.env.num_envs, distiller.env.num_actions))
        distiller.go_on_here()
        torch.set_rng_state(generator)
        distiller.iterate()
    assert all(torch.equal(a, b) for a, b in zip(weights(one), weights(other), strict=True))
    for rollout, twin in zip(one.rollouts, other.rollouts, strict=True):
        assert all(torch.equal(rollout.stack.buffers[name], twin.stack.buffers[name]) for name in ("mean", "var"))
        assert torch.equal(rollout.x, twin.x)


def test_the_teacher_acts_in_a_warm_start(make, tmp_path):
    """In the run's first iterations, also of a resumed run; it has no noise, and its scores are not the students'."""
    options = {"types": ("depth", "none"), "placements": ("ends",), "num_envs": 24, "warm_start": 2, "std": 0.1}
    distiller, resumed, file = make(**options), make(**options), tmp_path / "checkpoint.pt"
    records = []
    for each in (distiller, resumed):
        step = each.env.step

        def recording_step(action, each=each, step=step):
            records.append((action.clone(), each._label.clone(), each._action.clone()))
            return step(action)

        each.env.step = recording_step
    iterations = [distiller.iterate()]
    write_checkpoint(state_of(distiller, 1.0), file)
    restore(resumed, read_checkpoint(file), file)
    iterations += [resumed.iterate() for _ in range(2)]
    assert all(iteration.episodes for iteration in iterations)
    for number, (action, label, students_action) in enumerate(records):
        assert torch.equal(action, label if number < 2 * 4 else students_action) and not torch.equal(label, students_action)
    scores = [[name for name in iteration.metrics if name.startswith("Score/")] for iteration in iterations]
    assert not scores[0] and not scores[1] and scores[2]


@pytest.mark.parametrize("last", [None, 1e-5])
def test_one_cycle_of_the_learning_rate_equals_torchs(make, last):
    """Torch counts steps from 0 to `total_steps` − 1; its rise then ends at 30 % of them."""
    distiller, total, rate = make(types=("none",), schedule="one_cycle", final_learning_rate=last or "null"), 51, 1e-3
    optimiser = torch.optim.Adam([torch.zeros(1)], lr=rate)
    factors = {"pct_start": (0.3 * (total - 1) + 1) / total, "final_div_factor": rate / 25 / last if last else 1e4}
    expected = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total, **factors)
    for step in range(total):
        distiller.set_rate(step / (total - 1))
        rates = [group["lr"] for each in (distiller.rollouts[0].stack.optimiser, optimiser) for group in each.param_groups]
        assert rates[0] == pytest.approx(rates[1], rel=1e-12)
        optimiser.step()
        if step < total - 1:
            expected.step()


def test_a_checkpoint_of_other_students_is_refused(make, tmp_path):
    one = make()
    one.iterate()
    file = tmp_path / "checkpoint.pt"
    write_checkpoint(state_of(one, 1.0), file)
    with pytest.raises(CheckpointError, match=r"learned from the groups .*bool-all.*, not"):
        restore(make(types=("depth",)), read_checkpoint(file), file)
    layers = r"its networks are encoders\.0\.layers\.0\.weight, .*, trunk\.2\.bias, .*, decoders\.1\.4\.bias$"
    refused = [
        ({"networks__hidden": "[9]"}, r"trunk\.0\.weight is \(2, 8, 40\), not \(2, 9, 40\)$"),
        ({"networks__encoder__hidden": "[7]"}, r"encoders\.0\.layers\.0\.weight is \(2, 8, 6\), not \(2, 7, 6\)$"),
        ({"networks__touch_kind": "lstm"}, layers),
        ({"decoders": "{object_size: {hidden: [4]}}"}, layers),
    ]
    for options, expected in refused:
        with pytest.raises(CheckpointError, match=f"its networks are of other sizes: {expected}"):
            restore(make(**options), read_checkpoint(file), file)


def test_students_learn_what_they_can_see(make):
    """The teacher uses only the joints, which all students observe."""
    options = {
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
    distiller = make(num_envs=16, sees=("proprio",), decoders=heads, **options)
    metrics = [distiller.iterate().metrics for _ in range(12)]
    for key in distiller.keys:
        errors = [row[f"Loss/{key.name}"] for row in metrics]
        assert min(errors[-5:]) < 0.1 * errors[0]


def test_metrics_of_an_iteration_are_per_block(make):
    """Scores are means over the episodes that ended in the student's own environments; gates are counted that are open."""
    distiller = make(gates="{taxels: 2}")
    with torch.no_grad():
        distiller.rollouts[1].stack.parameters["gates.weight"][0, :3] = -1.0
    ended, scores, step = torch.zeros(10), torch.zeros(10), distiller.env.step

    def recording_step(action):
        result = step(action)
        ended.add_(result.info.ended)
        result = result._replace(info=result.info._replace(score=torch.arange(10.0)))
        scores.add_(result.info.ended * result.info.score)
        return result

    distiller.env.step = recording_step
    metrics = distiller.iterate().metrics
    for i, key in enumerate(distiller.keys):
        block = slice(2 * i, 2 * i + 2)
        count = float(ended[block].sum())
        assert metrics.get(f"Score/{key.name}") == (pytest.approx(float(scores[block].sum()) / count) if count else None)
        gates = distiller.student(i).gates
        assert metrics.get(f"Gates/{key.name}") == (int((openings(gates.log_alpha) > 0.0).sum()) if gates else None)
    assert (metrics["Gates/depth-all-clean-s0"], metrics["Gates/bool-all-clean-s0"]) == (7.0, 10.0)


def test_evaluating_blocks_equals_evaluating_one_policy(make):
    """A block's scores and returns equal those of one policy in the same environments."""
    distiller = make(types=("none",), placements=("ends",), seeds=2, num_envs=6)
    blocks = evaluate_each(distiller.env, distiller.acting(), 2, 6, seed=5)
    assert [(evaluation.episodes, evaluation.envs) for evaluation in blocks] == [(6, 3), (6, 3)]
    whole = evaluate(distiller.env, distiller.acting(), 12, seed=5)
    assert whole.score == pytest.approx(sum(evaluation.score for evaluation in blocks) / 2)
    assert whole.episode_return == pytest.approx(sum(evaluation.episode_return for evaluation in blocks) / 2)
    assert blocks[0].episode_return != blocks[1].episode_return


def test_a_teacher_may_use_touch(make, tmp_path):
    """The environments compute the teacher's type of touch besides the students'."""
    task = tmp_path / "task.yaml"
    loaded = load_task(task, SMALL | {"touch": "depth", "placement": "all"})
    file = teacher(tmp_path / "feeling.pt", loaded, ["proprio", "tactile_sensors"])
    policy = Teacher(file, loaded)
    policy.check_taxels()
    assert policy.touch == PolicyTouch("depth", "all", "clean")
    keys = student_keys(["bool"], ["ends"], ["clean"], 1)
    env = TouchEnv(loaded, 2, seed=1, threads=1, touches=touches(keys, policy.touch))
    try:
        bound, obs = policy.bound(env), env.reset(4)
        assert bound.groups == ("proprio", "tactile_sensors/depth/all/clean")
        alone = TouchEnv(loaded, 2, seed=1, threads=1)
        torch.testing.assert_close(bound(obs), policy_for(alone, read_policy(file))(alone.reset(4)))
        alone.close()
    finally:
        env.close()


def test_errors_in_the_document_are_located(make):
    with pytest.raises(SpecError, match=r'distill\.decoders\.size: the task has no privileged number "size"'):
        make(decoders="{size: {}}")
    message = 'there is no group of observations "propio"; did you mean "proprio"?'
    with pytest.raises(SpecError, match=r"distill\.groups\[0\]: " + re.escape(message)):
        make(groups="[propio]")
    for types, problem in (
        (("none",), "no student has touch"),
        (("depth", "agg_force"), "agg_force see no numbers of each taxel"),
    ):
        with pytest.raises(SpecError, match=rf"distill\.gates: .*{problem}"):
            make(types=types, gates="{taxels: 2}")
    with pytest.raises(SpecError, match=r"distill\.gates.*: depth at \w+ has (\d+) taxels, so no gate would close; give fewer"):
        make(types=("depth",), gates="{taxels: 5000}")
    with pytest.raises(SpecError, match="steps is 5, expected a multiple of gradient_length, 2"):
        make(steps=5)
    with pytest.raises(SpecError, match="kernel is 2, expected an odd number"):
        make(networks__convolution__kernel=2)
