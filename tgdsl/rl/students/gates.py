"""Gates on taxels: a student learns which of its taxels it needs.

The gate z of a taxel multiplies all its normalised numbers. It is a hard-concrete variable, with β = 2/3, γ = −0.1, ζ = 1.1,
and in training a u per gradient step, uniform in (0, 1):

    training     z = clamp(σ((log u − log(1 − u) + log α)/β) (ζ − γ) + γ, 0, 1)
    acting       z = clamp(σ(log α) (ζ − γ) + γ, 0, 1)
    P(z > 0)     σ(log α − β log(−γ/ζ)) in training
    penalty      weight · max(0, Σ P(z > 0) − taxels)/num_taxels

Source: Louizos, Welling, Kingma, *Learning Sparse Neural Networks through L0 Regularization* (2018). Ours: the penalty is 0
below a number of taxels, log α begins at 2, and Adam learns log α/20, so that gates close within some hundred iterations.

Shapes: `taxel` taxels with a gate, `env` environments, `feature` numbers of taxels: one number of all, then the next.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

BETA, GAMMA, ZETA = 2 / 3, -0.1, 1.1
INITIAL, SCALE = 2.0, 20.0  # log α at the start; log α per unit of the weight, which Adam moves by its rate in a step
LEAST_U = 1e-6  # least distance of u from 0 and 1


def noise_like(values: Tensor) -> Tensor:
    """Return log u − log(1 − u) of new u."""
    return torch.rand_like(values, requires_grad=False).logit(LEAST_U)


def openings(log_alpha: Float[Tensor, "*taxel"], noise: Float[Tensor, "*taxel"] | None = None) -> Float[Tensor, "*taxel"]:
    """Return z: of training with noise, of acting without."""
    share = (log_alpha if noise is None else (log_alpha + noise) / BETA).sigmoid()
    return (share * (ZETA - GAMMA) + GAMMA).clamp(0.0, 1.0)


def expected_open(log_alpha: Float[Tensor, "*stack taxel"]) -> Float[Tensor, "*stack"]:
    """Return the expected number of open gates in training."""
    return (log_alpha - BETA * math.log(-GAMMA / ZETA)).sigmoid().sum(dim=-1)


def penalty(log_alpha: Float[Tensor, "*stack taxel"], taxels: int) -> Float[Tensor, "*stack"]:
    """Return the penalty of weight 1."""
    return (expected_open(log_alpha) - taxels).relu() / log_alpha.shape[-1]


class Gates(nn.Module):
    """The gates of a student."""

    def __init__(self, num_taxels: int):
        super().__init__()
        self.weight = nn.Parameter(torch.full((num_taxels,), INITIAL / SCALE))

    @property
    def log_alpha(self) -> Float[Tensor, " taxel"]:
        """Openness of the gates: the wider, the larger."""
        return SCALE * self.weight

    def forward(
        self, x: Float[Tensor, "env feature"], noise: Float[Tensor, " taxel"] | None = None
    ) -> Float[Tensor, "env feature"]:
        """Return the numbers of taxels, multiplied by their gates."""
        return (x.unflatten(1, (-1, self.weight.shape[0])) * openings(self.log_alpha, noise)).flatten(1)
