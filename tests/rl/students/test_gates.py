"""Gates on taxels: their distribution, their penalty, and the taxels that they choose."""

import math

import torch

from tgdsl.rl.students.gates import Gates, expected_open, noise_like, openings, penalty
from tgdsl.rl.students.student import Architecture, Encoder, Stack

BETA, GAMMA, ZETA = 2 / 3, -0.1, 1.1


def test_openings_have_the_distribution_of_the_paper():
    """Shares of closed and of fully open gates in 200,000 draws, against the distribution's closed form."""
    log_alpha, num = torch.linspace(-4.0, 4.0, 9), 200_000
    torch.manual_seed(0)
    z = openings(log_alpha, noise_like(log_alpha.expand(num, -1)))
    assert float(z.min()) == 0.0 and float(z.max()) == 1.0

    def chance_above(value):
        """P(s (ζ − γ) + γ > value), s being a binary concrete variable with parameters α and β."""
        share = (value - GAMMA) / (ZETA - GAMMA)
        return torch.sigmoid(log_alpha - BETA * math.log(share / (1.0 - share)))

    for is_it, chance in ((z > 0.0, chance_above(0.0)), (z >= 0.4, chance_above(0.4)), (z >= 1.0, chance_above(1.0))):
        deviation = (chance * (1.0 - chance) / num).sqrt()
        assert ((is_it.float().mean(dim=0) - chance).abs() < 5.0 * deviation).all()
    torch.testing.assert_close(expected_open(log_alpha), chance_above(0.0).sum())
    assert float(((z > 0.0).sum(dim=1).float().mean() - expected_open(log_alpha)).abs()) < 5.0 * (9 / 4 / num) ** 0.5
    torch.testing.assert_close(openings(log_alpha), (1.2 * torch.sigmoid(log_alpha) - 0.1).clamp(0.0, 1.0))


def test_gradients_equal_finite_differences():
    """In float64; below the number of taxels the penalty and its gradient are 0."""
    torch.manual_seed(0)
    log_alpha, noise = torch.randn((2, 2, 8), dtype=torch.float64)
    log_alpha.requires_grad_()
    assert torch.autograd.gradcheck(lambda each: openings(each, noise), log_alpha)
    excess = expected_open(log_alpha) - 5
    assert (excess > 0).all()
    for taxels, expected in ((5, excess / 8), (8, 0.0 * excess)):
        assert torch.autograd.gradcheck(lambda each, taxels=taxels: penalty(each, taxels), log_alpha)
        torch.testing.assert_close(penalty(log_alpha, taxels), expected)


def test_a_gate_multiplies_all_numbers_of_its_taxel():
    gates = Gates(3)
    with torch.no_grad():
        gates.weight.copy_(torch.tensor([-1.0, 1.0, 0.0]))
    x = torch.arange(12.0).view(2, 6) + 1.0  # two numbers of three taxels, channels first
    torch.testing.assert_close(gates(x), x * torch.tensor([0.0, 1.0, 0.5, 0.0, 1.0, 0.5]))


def test_just_the_gates_of_needed_inputs_stay_open():
    """A regression on 5 of 60 inputs, other ones for each of two students."""
    architecture = Architecture(((60, Encoder("mlp", (32,), 16)),), (32,), 1, gates=(0, 60))
    stack, generator = Stack(architecture, (0, 1), 3e-3, 2.0), torch.Generator().manual_seed(0)
    needed = torch.stack([torch.randperm(60, generator=generator)[:5] for _ in range(2)])
    torch.manual_seed(0)
    for _ in range(260):
        x = torch.randn((2, 64, 60), generator=generator)
        label = torch.stack([x[i][:, needed[i]].sum(dim=1, keepdim=True) for i in range(2)])
        error = (stack(x, x[..., :0], noise_like(stack.log_alpha)).action - label).square().mean(dim=(1, 2))
        stack.descend(error + penalty(stack.log_alpha, 5))
    is_open = openings(stack.log_alpha) > 0.0
    assert [row.nonzero()[:, 0].tolist() for row in is_open] == needed.sort(dim=1).values.tolist()
