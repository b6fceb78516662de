"""A stack of students equals separate trainings: against plain modules, torch's cells, Adam and clipping."""

import copy

import pytest
import torch
from torch import nn

from tgdsl.rl.students.gates import noise_like
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

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")  # policies are TorchScript files
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
MOMENTS = 1e-6  # inputs of networks are rounded to float32
CLIP = 20.0  # norms of gradients are 10 to 50


def architecture(kind, heads=((6,), (4,))):
    return Architecture(((3, Encoder("mlp", (8,), 4)), (14, ENCODERS[kind])), (16, 8), 2, heads, gates=(1, 7))


def open_unlike(stack):
    """Open the gates of all students differently, a third of them not at all."""
    with torch.no_grad():
        stack.parameters["gates.weight"].copy_(torch.linspace(-0.2, 0.2, 7).roll(1) + 0.01 * torch.arange(stack.size)[:, None])


def inputs(stack, rows, dtype, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn((stack.size, rows, 17), generator=generator, dtype=dtype)
    return x, torch.randn((stack.size, rows, stack.memory), generator=generator, dtype=dtype)


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_stack_returns_the_outputs_of_single_students(kind):
    stack = Stack(architecture(kind), SEEDS, 1e-3, 1.0)
    open_unlike(stack)
    x, memory = inputs(stack, 11, torch.float32)
    stack.observe(3.0 * x + 1.0)
    for noise in (None, noise_like(stack.log_alpha)):
        output = stack(x, memory, noise)
        for i in range(len(SEEDS)):
            expected = stack.student(i)(x[i], memory[i], None if noise is None else noise[i])
            for one, two in zip(output, expected, strict=True):
                torch.testing.assert_close(one[i], two, rtol=FORWARD, atol=FORWARD)


@pytest.mark.parametrize("kind", ["cnn", "lstm"])
def test_updates_equal_separate_trainings(kind):
    """Ten updates of two steps each through memory; clipping applies to only some gradients."""
    stack = Stack(architecture(kind), SEEDS, 1e-2, CLIP, dtype=torch.float64)
    plain = [seeded_student(stack.architecture, seed).double() for seed in SEEDS]
    optimisers = [torch.optim.Adam(student.parameters(), lr=1e-2) for student in plain]
    size = torch.tensor([1.0, 0.01, 5.0], dtype=torch.float64)
    scales, weights = torch.tensor([20.0, 1.0]).double(), torch.tensor([1.0, 0.5]).double()
    std, norms = torch.tensor([0.5, 2.0]).double(), []
    for update in range(10):
        x, memory = inputs(stack, 8, torch.float64, seed=update)
        generator = torch.Generator().manual_seed(1000 + update)
        label, old_action, target = (torch.randn((3, 8, 2), generator=generator).double() for _ in range(3))
        label = label * size[:, None, None]
        stack_memory, total = memory, 0.0
        for _ in range(2):
            action, decoded, stack_memory = stack(x, stack_memory)
            total = total + action_error(action, label, old_action, std, 0.1) + decoder_error(decoded, target, scales, weights)
        stack.descend(total)
        for i, (student, optimiser) in enumerate(zip(plain, optimisers, strict=True)):
            student_memory, loss = memory[i], torch.zeros(())
            for _ in range(2):
                action, decoded, student_memory = student(x[i], student_memory)
                bounded = old_action[i] + (action - old_action[i]).clamp(-0.1, 0.1)
                worst = torch.stack([(action - label[i]) ** 2, (bounded - label[i]) ** 2]).amax(dim=0)
                loss = loss + (worst / std**2).mean()
                loss = loss + nn.functional.mse_loss(decoded[:, 0], 20.0 * target[i, :, 0])
                loss = loss + 0.5 * nn.functional.mse_loss(decoded[:, 1], target[i, :, 1])
            optimiser.zero_grad()
            loss.backward()
            norms.append(float(nn.utils.clip_grad_norm_(student.parameters(), CLIP)))
            optimiser.step()
    assert min(norms) < CLIP < max(norms)
    for i, student in enumerate(plain):
        for name, value in student.named_parameters():
            torch.testing.assert_close(stack.parameters[name][i], value, rtol=UPDATES, atol=UPDATES)


def test_initial_weights_depend_only_on_the_seed():
    """Not on the other students of the stack; torch's global generator is left untouched."""
    rng_state = torch.get_rng_state()
    alone, together = (Stack(architecture("mlp"), seeds, 1e-3, 1.0) for seeds in ((9,), SEEDS))
    assert torch.equal(torch.get_rng_state(), rng_state)
    for name, value in alone.parameters.items():
        assert torch.equal(value[0], together.parameters[name][2])
        assert name.endswith(("norm.weight", "gates.weight")) or not torch.equal(
            together.parameters[name][0], together.parameters[name][1]
        )


def test_means_and_variances_cover_all_rows_of_a_student():
    stack = Stack(architecture("mlp"), SEEDS, 1e-3, 1.0, dtype=torch.float64)
    parts = [inputs(stack, rows, torch.float64, rows)[0] * torch.tensor([1.0, 2.0, 3.0])[:, None, None] for rows in (5, 40, 7)]
    for part in parts:
        stack.observe(part)
    all_rows = torch.cat(parts, dim=1)
    torch.testing.assert_close(stack.buffers["mean"], all_rows.mean(dim=1), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(stack.buffers["var"], all_rows.var(dim=1, correction=0), rtol=1e-12, atol=1e-12)


def test_means_and_variances_follow_late_changes():
    """Offsets reach 300 spreads, and a shift by one spread comes after 100,000 looks: too small for float32 sums."""
    looks_before, looks = 100_000, 2_000
    stack, generator = Stack(architecture("mlp"), SEEDS, 1e-3, 1.0), torch.Generator().manual_seed(0)
    buffers = dict(stack.buffers)  # updated in place, as a captured graph reads them
    x = torch.randn((3, 64, 17), generator=generator) + torch.linspace(0.0, 300.0, 17)
    stack.observe(x)
    stack.seen.count.mul_(looks_before)  # repeating the same rows would change only the count
    for _ in range(looks):
        stack.observe(x + 1.0)
    rows = x.double(), (x + 1.0).double()
    (mean, var), (late_mean, late_var) = ((each.mean(dim=1), each.var(dim=1, correction=0)) for each in rows)
    share = looks / (looks_before + looks)
    var = torch.lerp(var, late_var, share) + share * (1.0 - share) * (late_mean - mean).square()
    mean = torch.lerp(mean, late_mean, share)
    torch.testing.assert_close(buffers["mean"], mean.float(), rtol=MOMENTS, atol=MOMENTS)
    torch.testing.assert_close(buffers["var"], var.float(), rtol=MOMENTS, atol=MOMENTS)


def test_float32_moments_of_older_checkpoints_load():
    one, other = (Stack(architecture("mlp"), SEEDS, 1e-3, 1.0) for _ in range(2))
    one.observe(3.0 * inputs(one, 40, torch.float32)[0] + 1.0)
    state = copy.deepcopy(one.state_dict())
    state["seen"] |= {name: one.buffers[name].clone() for name in ("mean", "var")}
    assert state["seen"]["mean"].dtype == torch.float32
    buffers = dict(other.buffers)
    other.load_state_dict(state)
    for name in ("mean", "var"):
        assert torch.equal(buffers[name], one.buffers[name]) and other.moments[name].dtype == torch.float64
        assert torch.equal(other.moments[name], one.buffers[name].double())


def test_loading_keeps_adams_options_of_the_device(monkeypatch):
    """Saved options are ignored. They are set before `step` is placed: capturable Adam keeps it with the weights."""
    one, other = (Stack(architecture("mlp"), SEEDS, 1e-3, 1.0) for _ in range(2))
    output = one(*inputs(one, 5, torch.float32))
    one.descend(output.action.square().mean(dim=(1, 2)) + output.decoded.square().mean(dim=(1, 2)))
    saved = one.state_dict()
    for group in saved["optimiser"]["param_groups"]:
        group |= {"lr": 1.0, "capturable": True, "fused": True}
    other.load_state_dict(saved)
    assert [(group["lr"], group["capturable"], group["fused"]) for group in other.optimiser.param_groups] == [
        (1e-3, False, None)
    ]
    assert all(state["step"].device.type == "cpu" for state in other.optimiser.state.values())
    on_gpu = Stack(architecture("mlp"), SEEDS, 1e-3, 1.0, device="meta")
    monkeypatch.setattr(on_gpu, "_options", lambda: {"lr": 1e-3, "capturable": True, "fused": None})
    on_gpu.load_state_dict(one.state_dict())
    assert len(on_gpu.optimiser.state) == len(on_gpu.parameters)
    assert all(state["step"].is_meta for state in on_gpu.optimiser.state.values())


def test_an_lstm_equals_torchs():
    lstm = Lstm(14, ENCODERS["lstm"])
    cell = nn.LSTMCell(14, 6)
    for name, layer in (("ih", lstm.of_input), ("hh", lstm.of_memory)):
        cell.load_state_dict(cell.state_dict() | {f"weight_{name}": layer.weight, f"bias_{name}": layer.bias})
    x, h, c = torch.randn(5, 14), torch.randn(5, 6), torch.randn(5, 6)
    expected_h, expected_c = cell(x, (h, c))
    embedding, memory = lstm(x, torch.cat([h, c], dim=1))
    torch.testing.assert_close(memory, torch.cat([expected_h, expected_c], dim=1))
    torch.testing.assert_close(embedding, lstm.projection(expected_h))


@pytest.mark.parametrize("kind", ["cnn", "convrnn"])
def test_only_cells_with_a_taxel_carry_information(kind):
    """The memory of a cell without a taxel stays 0."""
    encoder = network(14, ENCODERS[kind])
    x = torch.randn(1, 14, requires_grad=True)
    embedding, memory = encoder(x, torch.zeros(1, encoder.memory))
    (gradient,) = torch.autograd.grad(embedding.sum(), x, retain_graph=True)
    assert (gradient != 0).all()
    images, mask = encoder.images(x), encoder.mask
    assert images.shape == (1, 2, 2, 3, 2) and float(mask.sum()) == 7
    assert torch.equal(images[0, 1, :, 1, 1], torch.zeros(2)) and torch.equal(images[0, 1, :, 0, 1], x[0, [5, 12]])
    if kind == "convrnn":
        cells = memory.unflatten(1, (2, 2, 4, 3, 2))
        assert (cells * (1 - mask) == 0).all() and (cells != 0).any()


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_deployed_student_acts_the_same_and_forgets_at_episode_ends(kind, tmp_path):
    stack = Stack(architecture(kind), SEEDS, 1e-3, 1.0)
    open_unlike(stack)
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
    assert not policy(x[1]).requires_grad  # its memory holds no graph either
    assert policy(x[1].requires_grad_()).requires_grad


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_saved_stack_resumes_to_the_bit(kind):
    one, other = (Stack(architecture(kind), seeds, 1e-2, 0.1) for seeds in (SEEDS, (1, 2, 5)))

    def teach(stack, updates):
        for update in updates:
            x, memory = inputs(stack, 6, torch.float32, seed=update)
            stack.observe(x)
            output = stack(x, memory, noise_like(stack.log_alpha))
            stack.descend(torch.cat([output.action, output.decoded], dim=2).square().mean(dim=(1, 2)))

    teach(one, range(3))
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for stack in (one, other):
        torch.manual_seed(0)
        teach(stack, range(3, 6))
    for name, value in one.parameters.items():
        assert torch.equal(value, other.parameters[name])
    assert all(torch.equal(one.moments[name], other.moments[name]) for name in ("mean", "var"))
    assert all(torch.equal(one.buffers[name], other.buffers[name]) for name in ("mean", "var"))
    with pytest.raises(RuntimeError, match="its networks are"):
        other.load_state_dict(Stack(architecture("mlp", ()), SEEDS, 1e-2, 0.1).state_dict())


@pytest.mark.parametrize("seeds", [(3,), SEEDS])
@pytest.mark.parametrize("kind", ENCODERS)
def test_gradients_have_the_strides_of_their_weights(kind, seeds):
    """Adam's fused kernel on a GPU requires it, and gradients from `vmap` are often transposed."""
    stack = Stack(architecture(kind), seeds, 1e-2, 0.1)
    x, memory = inputs(stack, 6, torch.float32)
    stack.descend(stack(x, memory).action.square().mean(dim=(1, 2)) + 0.0 * sum(w.sum() for w in stack.parameters.values()))
    assert all(weight.grad.stride() == weight.stride() for weight in stack.parameters.values())


def test_a_resumed_stack_uses_its_new_learning_rate():
    """Adam's step is the rate times the same moments."""
    saved = Stack(architecture("mlp"), SEEDS, 1e-2, None, dtype=torch.float64)
    x, memory = inputs(saved, 6, torch.float64)

    def descend(stack):
        output = stack(x, memory)
        stack.descend(torch.cat([output.action, output.decoded], dim=2).square().mean(dim=(1, 2)))

    for _ in range(3):
        descend(saved)
    steps = []
    for rate in (1e-2, 1e-4):
        resumed = Stack(architecture("mlp"), SEEDS, rate, None, dtype=torch.float64)
        resumed.load_state_dict(copy.deepcopy(saved.state_dict()))
        descend(resumed)
        steps.append([resumed.parameters[name].detach() - value.detach() for name, value in saved.parameters.items()])
    for fast, slow in zip(*steps, strict=True):
        torch.testing.assert_close(slow, 1e-2 * fast, rtol=1e-8, atol=1e-16)
