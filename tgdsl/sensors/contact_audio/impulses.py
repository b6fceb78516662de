"""From the load of a pair at each physics step to the impulses that strike it.

A collision takes the solver one step or several, as its time step and its contacts' stiffness have it, but a stiff body rings
from all of its impulse. So what a load F exceeds a steady load F̄ by is summed up, and strikes at once when it no longer grows:

    A ← κA + (F − F̄)₊ Δt,   F̄ ← F + κ(F̄ − F),   κ = e^(−Δt/τ)                               [N·s], [N]
    J = A, and A ← 0, F̄ ← F, where (F − F̄)₊ Δt ≤ (1 − κ) A                                   [N·s]

A collision of the duration T ≪ τ strikes with its impulse ∫F dt, whatever the number of steps; a load that takes much longer
than τ to rise by ΔF, at the rate R, with R τ² alone; a steady one not at all. The first load of an episode counts as steady.

With mode shapes each mode i has an A_i of its own, which grows by s_i (F − F̄)₊ Δt with the mode's share s_i of what strikes
where the load acts, and is kept and passed on when A is: so it is weighted by where the load was when it grew.

`model: force` collects nothing: its drive is the rise of the force in each step.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` felt objects, `mode` modes.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.sensors.base import Constants, Context, State

Load = Float[Tensor, "env body object"]
UNKNOWN = 1e30
"""Steady load at the beginning of an episode [N]: no first load exceeds it, and the second finds the first."""


def impulses(
    force: Load, constants: Constants, state: State, share: Float[Tensor, "env body object mode"] | None = None
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the impulses that strike at the start of this step [N·s], and what is remembered.

    Args:
        force: F [N].
        constants: The sensor's.
        state: The memory.
        share: Of each mode, s; the impulses are then those of each mode, (env, body, object, mode).
    """
    above, kept = force - state["steady"], constants["kept"]
    grown = above.clamp(min=0.0) * constants["step"]
    if "is_paper" in constants:
        return grown if share is None else grown[..., None] * share, {"steady": force}
    pending = state["pending"].clone()  # derivatives by constants look at it once the state has gone on
    is_over = grown <= constants["leaked"] * pending
    impulse = torch.where(is_over, pending, 0.0 * grown)  # not-a-number strikes at once
    after = torch.where(is_over, force, torch.addcmul(force, above, kept, value=-1))
    new = {"pending": torch.where(is_over, 0.0, torch.addcmul(grown, pending, kept)), "steady": after}
    if share is None:
        return impulse, new
    own, each = grown[..., None] * share, state["weighted"].clone()
    new["weighted"] = torch.where(is_over[..., None], 0.0, torch.addcmul(own, each, kept))
    return torch.where(is_over[..., None], each, 0.0 * own), new


def rises(
    force: Load,
    context: Context,
    constants: Constants,
    state: State,
    share: Float[Tensor, "env body object mode"] | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return by how much the force on each row rises in this step (env, row, *mode) [N], and what is remembered.

    Args:
        force: F [N].
        context: When.
        constants: The sensor's.
        state: The memory.
        share: Of each mode, s.
    """
    load = of_rows(force if share is None else force[..., None] * share, constants)
    is_first = context.is_first.view(-1, *[1] * (load.ndim - 1))
    return load - torch.where(is_first, load, state["load"]), {"load": load}


def of_rows(pairs: Tensor, constants: Constants) -> Tensor:
    """Return the sum over what touches each body (or object) that rings, (env, row, *mode), of (env, body, object, *mode)."""
    dim = 1 if "is_of_object" in constants else 2
    return pairs.squeeze(dim) if pairs.shape[dim] == 1 else pairs.sum(dim=dim)


def reference_impulses(
    force: Float[np.ndarray, "body object"],
    before: tuple[np.ndarray, np.ndarray, np.ndarray],
    share: Float[np.ndarray, "body object mode"],
    step: float,
    settling: float,
    is_paper: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the impulses of each mode, and F̄, A and A_i after them, of one environment: pair by pair.

    Args:
        force: F [N].
        before: F̄ [N], A [N·s] and A_i of each mode [N·s].
        share: s_i; of one mode, 1, where all have the same.
        step: Δt [s].
        settling: τ [s].
        is_paper: Whether each rise of the force strikes by itself.
    """
    impulse, (steady, pending, weighted) = np.zeros_like(share), (part.copy() for part in before)
    kept = np.exp(-step / settling)
    for place, load in np.ndenumerate(force):
        grown = max(0.0, load - steady[place]) * step
        if is_paper:
            impulse[place], steady[place] = grown * share[place], load
        elif grown <= (1 - kept) * pending[place]:
            impulse[place], weighted[place] = weighted[place], 0.0
            pending[place], steady[place] = 0.0, load
        else:
            weighted[place] = kept * weighted[place] + grown * share[place]
            pending[place], steady[place] = kept * pending[place] + grown, load + kept * (steady[place] - load)
    return impulse, steady, pending, weighted
