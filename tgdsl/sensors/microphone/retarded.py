"""Retarded time: how long ago what is heard now was emitted, by sources and a microphone that move.

    a = |m(t) − s(t − a)|/c                                                                   [s]

with m where the microphone is and s where the source was. Places are known at the instants of steps, Δt apart, and linear in
between. So of X_j = m(t) − s(t − jΔt), L = cΔt and the first j with |X_(j+1)| < (j+1) L,

    (j + b)² L² = |X_j + b D|²,   D = X_(j+1) − X_j,   a = (j + b) Δt,

whose root in 0 ≤ b ≤ 1 is exact for this path. It is the one root where sources are slower than sound. Where one is faster, or
put elsewhere without a reset, its newest sound to arrive is heard.

Shapes: `env` environments, `row` rows of sources, `node` steps before now, from 0.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec


def age_of_sound(away: Vec, length: Tensor) -> Float[Tensor, "env row"]:
    """Return how long ago what is heard now was emitted, in steps; that of the last node if it is longer.

    Args:
        away: X, from the source's places at each node to where the microphone is now: planes (env, node, row) [m].
        length: L, how far sound travels in a step [m].
    """
    distance = planes.safe_sqrt(planes.dot(away, away))
    last = distance.shape[1] - 1
    number = torch.arange(last + 1, device=distance.device)[:, None]
    has_arrived = distance < number * length
    node = torch.where(has_arrived, number, last).amin(dim=1, keepdim=True) - 1
    first, second = (planes.vec(torch.gather(part, 1, node + i)[:, 0] for part in away) for i in (0, 1))
    steps, own = node[:, 0].to(distance.dtype), torch.gather(distance, 1, node)[:, 0]
    moved = planes.sub(second, first)
    # (L² − |D|²) b² + 2 half b + ahead = 0
    square = length * length - planes.dot(moved, moved)
    half = length * length * steps - planes.dot(first, moved)
    ahead = (length * steps - own) * (length * steps + own)
    root = half.abs() + planes.safe_sqrt((half * half - square * ahead).clamp(min=0.0))
    is_none = root <= planes.tiny()
    b = torch.where(half >= 0, -ahead / torch.where(is_none, 1.0, root), root / torch.where(square > 0, square, 1.0))
    return steps + torch.where(is_none, 0.0, b).clamp(0.0, 1.0)
