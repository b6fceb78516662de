"""What cells that touch something show in a step of the heat that they get, as they conduct it to the cells around.

A contact's step is implicit in the cells that it touches (`conduction`). In a long one heat spreads from them while it comes
in, so that a cell shows a larger heat capacity than its own, C/κ, with

    κ_i = max(r_φ − ½ r_E − r_F/12, r_E − C/(Δt Σ g)),   r_f = w_sᵀ f(x) q/(w_sᵀ q),   q = Σ_t w_t/|w_t|²                [1]
    E = e^(−x),   φ = (1 − e^(−x))/x,   F = x e^(−x)

of a side s of a patch on a row, w the shares of the cells in its conductance, t all sides of that row that touch, x = Σ αμΔt/Δ²
of the modes of the box (`diffusion`), and g what joins the cell with all that it touches [W/K]; of a cell in several patches
their mean by conductance. r_E is what is left below the patch of heat that was there at the step's begin, r_φ of heat that came
in evenly. A cell's own capacity holds what all of its patches bring; so of sides on the same cells q counts once.

The first number makes flows right: cells are taken at the step's begin, and what is left there of former steps' heat counts too
much, as it falls. The sum of a falling kernel e over steps exceeds its integral by the terms of Euler and Maclaurin,
∫₀^∞ e dt/Δt ≈ r_φ + Σ_{m ≥ 1} e(mΔt) − ½ e(Δt) + Δt ė(Δt)/12. For αΔt/Δ² → 0 it is ½, the trapezoidal rule. The second keeps
cells of an even temperature from going beyond what they touch, and the step stable, however long it is.

Source: Abramowitz and Stegun, 23.1.30. For a half-space and a long step the sum is known, its kernel being 1/√(πt): κ is then
−ζ(½) = 1.460 of it, here 1.458.

Shapes: `env` environments, `row` rows of cells, `side` sides of patches on each, `x`, `y`, `z` modes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.sensors.temperature_grid.diffusion import Modes, along


class Response(NamedTuple):
    """Of each side (env, row, side): what is left at the end of heat that was there, r_E, and r_φ − ½ r_E − r_F/12 [1]."""

    at_end: Tensor
    on_average: Tensor


def response(
    conductance: Float[Tensor, "env row side x y z"],
    x: Float[Tensor, "#env row x y z"],
    modes: tuple[Modes, ...],
    is_implicit: bool,
) -> Response:
    """Return what is left of heat at each side.

    Args:
        conductance: Between sides and cells, in any unit.
        x: What modes decay by in a step.
        modes: Those along each axis.
        is_implicit: Whether a step divides modes by 1 + x.
    """
    whole = conductance.sum(dim=(-3, -2, -1), keepdim=True)
    is_any = whole > 0
    shares = conductance / torch.where(is_any, whole, 1.0)
    squared = (shares * shares).sum(dim=(-3, -2, -1), keepdim=True)
    over = torch.where(is_any, 1.0 / torch.where(is_any, squared, 1.0), 0.0)
    meets = (shares * (shares * over).sum(dim=2, keepdim=True)).sum(dim=(-3, -2, -1))
    num_envs, _, sides = shares.shape[:3]
    own = shares.transpose(1, 2).flatten(0, 1)
    for axis, part in enumerate(modes):
        own = along(part.vectors, own, axis)
    own = own.unflatten(0, (num_envs, sides)).transpose(1, 2)
    every = (own * over).sum(dim=2)
    if is_implicit:
        kept = 1.0 / (1.0 + x)
        on_average = 0.5 * kept
    else:
        safe, kept = torch.where(x > 1e-3, x, 1.0), torch.exp(-x)
        average = torch.where(x > 1e-3, -torch.expm1(-safe) / safe, 1.0 - 0.5 * x * (1.0 - x / 3.0))
        on_average = average - kept * (0.5 + x / 12.0)
    own = own / torch.where(meets > 0, meets, 1.0)[..., None, None, None]
    return Response(*((own * (every * part)[:, :, None]).sum(dim=(-3, -2, -1)) for part in (kept, on_average)))


def fraction_left(
    found: Response, flow: Float[Tensor, "env row side x y z"], capacity: Tensor
) -> Float[Tensor, "env row x y z"]:
    """Return κ of each cell; 1 where it touches nothing.

    Args:
        found: Of the sides.
        flow: Δt g [J/K].
        capacity: C of a row's cells (env, row) [J/K].
    """
    whole = flow.sum(dim=2)
    is_met = whole > 0
    safe = torch.where(is_met, whole, 1.0)
    at_end, on_average = ((flow * part[..., None, None, None]).sum(dim=2) / safe for part in found)
    return torch.where(is_met, torch.maximum(on_average, at_end - capacity[..., None, None, None] / safe), 1.0)
