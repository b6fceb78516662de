"""What cells show of heat that contacts bring within a step, while it is conducted on.

The heat that flows through a side of a patch in a step, H [J], and its flow at the end of the step times Δt, J [J], stand for
its course in time: an impulse at the step's begin, a constant and a linear part,

    H a(t) + J b(t),   a = ((1 − σ) δ(t) + 6σ − 6σ t)/(1 + 2σ),   b = ((σ − 1) δ(t) + 1 − 4σ + 6σ t)/(1 + 2σ),   0 ≤ t ≤ 1

so that ∫ a = 1, a(1) = 0, ∫ b = 0 and b(1) = 1. A steady flow, H = J, is exact for any σ. Of it a mode of the cells that
decays by e^(−x) in the step shows at the step's end, and in its mean, over the heat capacity of a cell

    e_a = (1 − σ, 6σ, −6σ) · (φ₀, φ₁, φ₂)/(1 + 2σ),   e_b = (σ − 1, 1 − 4σ, 6σ) · (φ₀, φ₁, φ₂)/(1 + 2σ)                   [1]
    m_a, m_b: the same of (φ₁, φ₂, φ₃),   φ₀ = e^(−x),   φ_k = (1/(k − 1)! − φ_(k−1))/x

A flow that decays as e^(−zt), that of two bodies of one temperature each, has exactly

    σ = (J₀ − z e^(−z))/(2 (Q − J₀)),   Q = 1 − e^(−z),   J₀ = 2 (Q/z − e^(−z))

from 1, a linear course, for z → 0 to 1/z, an impulse. z of all that touches a row follows from what its cells, and the bodies
of one temperature, show of an impulse and of a constant flow, r_k = Σ_st g_s φ_k,st Δt g_t/(C Σ g):

    z = r₀/(1 + r₁ − r₀) + 16 (1 − r₀/r₁)² r₁/(1 + r₁)

The first term is exact for bodies of one temperature, and has what cells conduct within the step in series with the patch. The
second was fitted to the closed form of a half-space, whose flow first falls as 1/√t: in the first step of a contact it gets its
heat to 1 %, from the second step on to 0.1 %, for any αΔt/Δ².

Source: Hochbruck and Ostermann, Exponential integrators, *Acta Numerica* 2010, for φ_k. With σ = 1 the step is the Radau IIA
method of third order, with σ = 0 the (0, 2) Padé approximation: Hairer and Wanner, *Solving Ordinary Differential Equations
II*, IV.3 and IV.5.

Shapes: `env` environments, `row` rows of cells, `side` sides of patches on each, `x`, `y`, `z` cells or modes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.sensors.temperature_grid.diffusion import Modes, along

Four = tuple[Tensor, Tensor, Tensor, Tensor]


class Response(NamedTuple):
    """What heat of unit H and J shows [1], each times the cells' heat capacity: in the mean, then at the end of the step."""

    mean_of_heat: Tensor
    mean_of_rate: Tensor
    end_of_heat: Tensor
    end_of_rate: Tensor


def decays(x: Tensor, is_implicit: bool) -> Four:
    """Return φ₀ − 1, φ₁ − 1, φ₂ − ½ and φ₃ − ⅙ of modes that decay by e^(−x), or by 1/(1 + x): then φ₀ = φ₁ = φ₂ [1]."""
    if is_implicit:
        less = -x / (1.0 + x)
        return less, less, 0.5 + less, less
    is_far = x > 1.0
    near, far = torch.where(is_far, 1.0, x), torch.where(is_far, x, 1.0)
    fourth = torch.ones_like(x)
    for n in range(18, 4, -1):
        fourth = 1.0 - near * fourth / n
    third = -near * fourth / 24.0
    second = -near * (1.0 / 6.0 + third)
    first = -near * (0.5 + second)
    zeroth = -near * (1.0 + first)
    far_first = -torch.expm1(-far) / far
    far_second = (1.0 - far_first) / far
    parts = torch.expm1(-far), far_first - 1.0, far_second - 0.5, (0.5 - far_second) / far - 1.0 / 6.0
    a, b, c, d = (torch.where(is_far, far, near) for far, near in zip(parts, (zeroth, first, second, third), strict=True))
    return a, b, c, d


def whole(parts: Four) -> Four:
    """Return φ₀ to φ₃ of what `decays` returns."""
    a, b, c, d = (part + at_rest for part, at_rest in zip(parts, (1.0, 1.0, 0.5, 1.0 / 6.0), strict=True))
    return a, b, c, d


def response(phi: Four, sigma: Tensor) -> Response:
    """Return the equation of this module.

    Args:
        phi: φ₀ to φ₃.
        sigma: σ, to multiply them.
    """
    over = 1.0 / (1.0 + 2.0 * sigma)
    impulse, linear = (1.0 - sigma) * over, 6.0 * sigma * over
    constant = (1.0 - 4.0 * sigma) * over

    def of_heat(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return impulse * a + linear * (b - c)

    def of_rate(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return constant * b + linear * c - impulse * a

    return Response(of_heat(*phi[1:]), of_rate(*phi[1:]), of_heat(*phi[:3]), of_rate(*phi[:3]))


def of_cells(phi: Four, modes: tuple[Modes, ...]) -> Four:
    """Return what each cell shows of its own heat, Σ_m v_im² φ_k (env or 1, row, x, y, z)."""
    result = list(phi)
    for axis, part in enumerate(modes):
        squared = (part.vectors * part.vectors).transpose(-2, -1)
        result = [along(squared, values, axis) for values in result]
    a, b, c, d = result
    return a, b, c, d


def of_sides(
    shares: Float[Tensor, "env row side x y z"], own: Four, phi: Four, modes: tuple[Modes, ...]
) -> tuple[list[Tensor], list[Tensor]]:
    """Return what sides show of heat of one another (env, row, side, side): of φ₀ to φ₃, all, and without that of cells alone.

    Args:
        shares: Those of cells in a side's conductance.
        own: See `of_cells`.
        phi: φ₀ to φ₃ of the modes.
        modes: Modes along each axis.
    """
    num_envs, _, sides = shares.shape[:3]
    waves = shares.transpose(1, 2).flatten(0, 1)
    for axis, part in enumerate(modes):
        waves = along(part.vectors, waves, axis)
    waves = waves.unflatten(0, (num_envs, sides)).transpose(1, 2)
    every = [_between(waves, values) for values in phi]
    return every, [all_of - _between(shares, values) for all_of, values in zip(every, own, strict=True)]


def _between(parts: Tensor, factor: Tensor) -> Tensor:
    return ((parts * factor[:, :, None])[:, :, :, None] * parts[:, :, None]).sum(dim=(-3, -2, -1))


def impulsiveness(start: Tensor, constant: Tensor) -> Tensor:
    """Return σ from r₀ and r₁; 1 where nothing touches."""
    is_any = constant > 0
    safe = torch.where(is_any, constant, 1.0)
    spread = torch.where(is_any, 1.0 - start / safe, 0.0)
    z = start / (1.0 + constant - start) + 16.0 * spread * spread * constant / (1.0 + constant)
    is_fast = z > 0.5
    far, near = torch.where(is_fast, z, 1.0), torch.where(is_fast, 0.5, z)
    left = torch.exp(-far)
    last = 2.0 * ((1.0 - left) / far - left)
    fast = (last - far * left) / (2.0 * (1.0 - left - last))
    square = near * near  # the next term is below 1e-15
    series = 1 / 5600 - square * (1 / 504000 - square * (37 / 1552320000 - square * 59 / 201801600000))
    return torch.where(is_fast, fast, 1.0 - 0.25 * near + square * (1 / 40 - square * series))
