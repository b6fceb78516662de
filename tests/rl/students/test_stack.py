"""A stack of students is as many separate trainings: against plain modules, torch's own cells, Adam and clipping."""

import copy

import pytest
import torch
from torch import nn

from tgdsl.rl.students.learner import action_error, decoder_error
from tgdsl.rl.students.student import (
    Architecture,
    Encoder,
    Grid,
    Lstm,
    Stack,
    acting,
    deployed,
    forgotten,
    network,
    seeded_student,
)

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")  # what policies are written in
SEEDS = (3, 4, 9)
GRID = Grid(2, 7, (2, 3, 2), (0, 1, 2, 3, -1, -1, 4, 5, -1, -1, 6, -1))
ENCODERS = {
    "mlp": Encoder("mlp", (8, 8), 5),
    "lstm": Encoder("lstm", (6,), 5),
    "cnn": Encoder("cnn", (4, 6), 5, 3, GRID),
    "convrnn": Encoder("convrnn", (4,), 5, 3, GRID),
}
FORWARD = 1e-5  # float32: sums in another order
UPDATES = 1e-9  # float64, 10 steps of Adam
MOMENTS = 1e-6  # float32: what networks take is rounded
CLIP = 20.0  # of gradients whose norms are 10 to 50


def architecture(kind, heads=((6,), (4,))):
    return Architecture(((3, Encoder("mlp", (8,), 4)), (14, ENCODERS[kind])), (16, 8), 2, heads)


def inputs(stack, rows, dtype, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn((stack.size, rows, 17), generator=generator, dtype=dtype)
    return x, torch.randn((stack.size, rows, stack.memory), generator=generator, dtype=dtype)


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_stack_returns_what_single_students_do(kind):
    stack = Stack(architecture(kind), SEEDS, 1e-3, 1.0)
    x, memory = inputs(stack, 11, torch.float32)
    stack.observe(3.0 * x + 1.0)
    found = stack(x, memory)
    for i in range(len(SEEDS)):
        expected = stack.student(i)(x[i], memory[i])
        for one, two in zip(found, expected, strict=True):
            torch.testing.assert_close(one[i], two, rtol=FORWARD, atol=FORWARD)


@pytest.mark.parametrize("kind", ["cnn", "lstm"])
def test_updates_are_those_of_separate_trainings(kind):
    """Ten of them, of two steps each through memory, with gradients that are clipped for some and not for others."""
    stack = Stack(architecture(kind), SEEDS, 1e-2, CLIP, dtype=torch.float64)
    plain = [seeded_student(stack.architecture, seed).double() for seed in SEEDS]
    optimisers = [torch.optim.Adam(student.parameters(), lr=1e-2) for student in plain]
    size = torch.tensor([1.0, 0.01, 5.0], dtype=torch.float64)
    scales, weights = torch.tensor([20.0, 1.0]).double(), torch.tensor([1.0, 0.5]).double()
    std, norms = torch.tensor([0.5, 2.0]).double(), []
    for update in range(10):
        x, memory = inputs(stack, 8, torch.float64, seed=update)
        generator = torch.Generator().manual_seed(1000 + update)
        label, before, target = (torch.randn((3, 8, 2), generator=generator).double() for _ in range(3))
        label = label * size[:, None, None]
        held, total = memory, 0.0
        for _ in range(2):
            action, told, held = stack(x, held)
            total = total + action_error(action, label, before, std, 0.1) + decoder_error(told, target, scales, weights)
        stack.descend(total)
        for i, (student, optimiser) in enumerate(zip(plain, optimisers, strict=True)):
            own, loss = memory[i], torch.zeros(())
            for _ in range(2):
                action, told, own = student(x[i], own)
                bounded = before[i] + (action - before[i]).clamp(-0.1, 0.1)
                worst = torch.stack([(action - label[i]) ** 2, (bounded - label[i]) ** 2]).amax(dim=0)
                loss = loss + (worst / std**2).mean()
                loss = loss + nn.functional.mse_loss(told[:, 0], 20.0 * target[i, :, 0])
                loss = loss + 0.5 * nn.functional.mse_loss(told[:, 1], target[i, :, 1])
            optimiser.zero_grad()
            loss.backward()
            norms.append(float(nn.utils.clip_grad_norm_(student.parameters(), CLIP)))
            optimiser.step()
    assert min(norms) < CLIP < max(norms)
    for i, student in enumerate(plain):
        for name, value in student.named_parameters():
            torch.testing.assert_close(stack.parameters[name][i], value, rtol=UPDATES, atol=UPDATES)


def test_a_student_does_not_depend_on_who_is_beside_it():
    """Its first weights follow from its seed; torch's own generator is where it was."""
    before = torch.get_rng_state()
    alone, beside = (Stack(architecture("mlp"), seeds, 1e-3, 1.0) for seeds in ((9,), SEEDS))
    assert torch.equal(torch.get_rng_state(), before)
    for name, value in alone.parameters.items():
        assert torch.equal(value[0], beside.parameters[name][2])
        assert name.endswith("norm.weight") or not torch.equal(beside.parameters[name][0], beside.parameters[name][1])


def test_means_and_variances_are_those_of_all_rows_of_a_student():
    stack = Stack(architecture("mlp"), SEEDS, 1e-3, 1.0, dtype=torch.float64)
    parts = [inputs(stack, rows, torch.float64, rows)[0] * torch.tensor([1.0, 2.0, 3.0])[:, None, None] for rows in (5, 40, 7)]
    for part in parts:
        stack.observe(part)
    seen = torch.cat(parts, dim=1)
    torch.testing.assert_close(stack.buffers["mean"], seen.mean(dim=1), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(stack.buffers["var"], seen.var(dim=1, correction=0), rtol=1e-12, atol=1e-12)


def test_means_and_variances_follow_what_changes_late():
    """Offsets of up to 300 spreads, and all moves by a spread after 100,000 looks: float32 cannot hold what one look changes."""
    before, looks = 100_000, 2_000
    stack, generator = Stack(architecture("mlp"), SEEDS, 1e-3, 1.0), torch.Generator().manual_seed(0)
    found = dict(stack.buffers)  # in place: a graph that was captured reads these
    x = torch.randn((3, 64, 17), generator=generator) + torch.linspace(0.0, 300.0, 17)
    stack.observe(x)
    stack.seen.count.mul_(before)  # the same rows again and again change nothing else
    for _ in range(looks):
        stack.observe(x + 1.0)
    rows = x.double(), (x + 1.0).double()
    (mean, var), (late_mean, late_var) = ((own.mean(dim=1), own.var(dim=1, correction=0)) for own in rows)
    share = looks / (before + looks)
    var = torch.lerp(var, late_var, share) + share * (1.0 - share) * (late_mean - mean).square()
    mean = torch.lerp(mean, late_mean, share)
    torch.testing.assert_close(found["mean"], mean.float(), rtol=MOMENTS, atol=MOMENTS)
    torch.testing.assert_close(found["var"], var.float(), rtol=MOMENTS, atol=MOMENTS)


def test_moments_of_older_checkpoints_are_float32():
    one, other = (Stack(architecture("mlp"), SEEDS, 1e-3, 1.0) for _ in range(2))
    one.observe(3.0 * inputs(one, 40, torch.float32)[0] + 1.0)
    state = copy.deepcopy(one.state_dict())
    state["seen"] |= {name: one.buffers[name].clone() for name in ("mean", "var")}
    assert state["seen"]["mean"].dtype == torch.float32
    found = dict(other.buffers)
    other.load_state_dict(state)
    for name in ("mean", "var"):
        assert torch.equal(found[name], one.buffers[name]) and other.moments[name].dtype == torch.float64
        assert torch.equal(other.moments[name], one.buffers[name].double())


def test_adams_options_are_the_devices_own(monkeypatch):
    """Whatever they were where it was saved, and before `step` is placed: it lies by the weights if Adam is capturable."""
    one, other = (Stack(architecture("mlp"), SEEDS, 1e-3, 1.0) for _ in range(2))
    found = one(*inputs(one, 5, torch.float32))
    one.descend(found.action.square().mean(dim=(1, 2)) + found.decoded.square().mean(dim=(1, 2)))
    saved = one.state_dict()
    for group in saved["optimiser"]["param_groups"]:
        group |= {"lr": 1.0, "capturable": True, "fused": True}
    other.load_state_dict(saved)
    assert [(group["lr"], group["capturable"], group["fused"]) for group in other.optimiser.param_groups] == [
        (1e-3, False, None)
    ]
    assert all(kept["step"].device.type == "cpu" for kept in other.optimiser.state.values())
    on_gpu = Stack(architecture("mlp"), SEEDS, 1e-3, 1.0, device="meta")
    monkeypatch.setattr(on_gpu, "_options", lambda: {"lr": 1e-3, "capturable": True, "fused": None})
    on_gpu.load_state_dict(one.state_dict())
    assert len(on_gpu.optimiser.state) == len(on_gpu.parameters)
    assert all(kept["step"].is_meta for kept in on_gpu.optimiser.state.values())


def test_an_lstm_is_torchs_own():
    own = Lstm(14, ENCODERS["lstm"])
    cell = nn.LSTMCell(14, 6)
    for name, layer in (("ih", own.of_input), ("hh", own.of_memory)):
        cell.load_state_dict(cell.state_dict() | {f"weight_{name}": layer.weight, f"bias_{name}": layer.bias})
    x, h, c = torch.randn(5, 14), torch.randn(5, 6), torch.randn(5, 6)
    made_h, made_c = cell(x, (h, c))
    embedding, memory = own(x, torch.cat([h, c], dim=1))
    torch.testing.assert_close(memory, torch.cat([made_h, made_c], dim=1))
    torch.testing.assert_close(embedding, own.projection(made_h))


@pytest.mark.parametrize("kind", ["cnn", "convrnn"])
def test_cells_without_a_taxel_tell_nothing_and_each_taxel_does(kind):
    """Also after steps: what is remembered of a cell without a taxel stays 0."""
    own = network(14, ENCODERS[kind])
    x = torch.randn(1, 14, requires_grad=True)
    embedding, memory = own(x, torch.zeros(1, own.memory))
    (gradient,) = torch.autograd.grad(embedding.sum(), x, retain_graph=True)
    assert (gradient != 0).all()
    images, mask = own.images(x), own.mask
    assert images.shape == (1, 2, 2, 3, 2) and float(mask.sum()) == 7
    assert torch.equal(images[0, 1, :, 1, 1], torch.zeros(2)) and torch.equal(images[0, 1, :, 0, 1], x[0, [5, 12]])
    if kind == "convrnn":
        held = memory.unflatten(1, (2, 2, 4, 3, 2))
        assert (held * (1 - mask) == 0).all() and (held != 0).any()


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_deployed_student_acts_as_it_did_and_forgets_episode_by_episode(kind, tmp_path):
    stack = Stack(architecture(kind), SEEDS, 1e-3, 1.0)
    torch.jit.save(deployed(acting(stack.student(1))), tmp_path / "policy.pt")
    policy = torch.jit.load(tmp_path / "policy.pt")
    assert not [name for name, _ in policy.named_parameters() if "decoder" in name]
    memory = torch.zeros((3, 4, stack.memory))
    with torch.no_grad():
        for step in range(4):
            x = torch.randn((3, 4, 17))
            action, _, memory = stack(x, memory)
            torch.testing.assert_close(policy(x[1]), action[1], rtol=FORWARD, atol=FORWARD)
            ended = torch.tensor([False, step == 1, False, True])
            memory = forgotten(memory, ended)
            if stack.memory:
                policy.begin(ended)
    assert not policy(x[1]).requires_grad  # nor is there a graph in what it remembers
    assert policy(x[1].requires_grad_()).requires_grad


@pytest.mark.parametrize("kind", ENCODERS)
def test_what_is_saved_goes_on_to_the_bit(kind):
    one, other = (Stack(architecture(kind), seeds, 1e-2, 0.1) for seeds in (SEEDS, (1, 2, 5)))

    def teach(stack, updates):
        for update in updates:
            x, memory = inputs(stack, 6, torch.float32, seed=update)
            stack.observe(x)
            made = stack(x, memory)
            stack.descend(torch.cat([made.action, made.decoded], dim=2).square().mean(dim=(1, 2)))

    teach(one, range(3))
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for stack in (one, other):
        teach(stack, range(3, 6))
    for name, value in one.parameters.items():
        assert torch.equal(value, other.parameters[name])
    assert all(torch.equal(one.moments[name], other.moments[name]) for name in ("mean", "var"))
    assert all(torch.equal(one.buffers[name], other.buffers[name]) for name in ("mean", "var"))
    with pytest.raises(RuntimeError, match="its networks are"):
        other.load_state_dict(Stack(architecture("mlp", ()), SEEDS, 1e-2, 0.1).state_dict())


@pytest.mark.parametrize("seeds", [(3,), SEEDS])
@pytest.mark.parametrize("kind", ENCODERS)
def test_gradients_lie_as_their_weights_do(kind, seeds):
    """Adam's fused kernel on a GPU refuses others; those that `vmap` makes are often transposed."""
    stack = Stack(architecture(kind), seeds, 1e-2, 0.1)
    x, memory = inputs(stack, 6, torch.float32)
    stack.descend(stack(x, memory).action.square().mean(dim=(1, 2)) + 0.0 * sum(w.sum() for w in stack.parameters.values()))
    assert all(weight.grad.stride() == weight.stride() for weight in stack.parameters.values())


def test_what_goes_on_at_another_rate_learns_at_it():
    """Adam's step is the rate times the same moments."""
    before = Stack(architecture("mlp"), SEEDS, 1e-2, None, dtype=torch.float64)
    x, memory = inputs(before, 6, torch.float64)

    def descend(stack):
        made = stack(x, memory)
        stack.descend(torch.cat([made.action, made.decoded], dim=2).square().mean(dim=(1, 2)))

    for _ in range(3):
        descend(before)
    moved = []
    for rate in (1e-2, 1e-4):
        after = Stack(architecture("mlp"), SEEDS, rate, None, dtype=torch.float64)
        after.load_state_dict(copy.deepcopy(before.state_dict()))
        descend(after)
        moved.append([after.parameters[name].detach() - value.detach() for name, value in before.parameters.items()])
    for fast, slow in zip(*moved, strict=True):
        torch.testing.assert_close(slow, 1e-2 * fast, rtol=1e-8, atol=1e-16)
