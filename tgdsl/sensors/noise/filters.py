"""The stages of noise that remember or mix: hysteresis, crosstalk, delay. Their equations are in `stages`.

Shapes: `env` environments, `taxel` rows of the reading; values of knobs broadcast with (env, channel, taxel).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.instant import Now, Planes, of

KERNEL = "kernel/"
"""Kernels of the links, (σ, taxel to, taxel from): `kernel/0000` and so on, in the order of the taxels."""


def hysteresis(
    planes: Planes, values: Mapping[str, Tensor], memory: Mapping[str, Planes], now: Now
) -> tuple[Planes, dict[str, Planes]]:
    """Return the signal with its overshoot, and what is remembered of both."""
    assert now.dt is not None
    ratio = now.dt / values["hysteresis_time"]
    ramp = torch.where(ratio > 0, -torch.expm1(-ratio) / torch.where(ratio > 0, ratio, 1.0), 1.0)
    strength, decay, ramp = torch.broadcast_tensors(values["hysteresis_strength"], torch.exp(-ratio), ramp)
    # Stacked, they are stored; a compiler that fuses would else take the exponentials anew for every number.
    strength, decay, ramp = torch.stack([strength, decay, ramp]).unbind()
    is_first = now.age == 0
    lag, result = [], []
    for c, plane in enumerate(planes):
        change = of(decay, c) * memory["lag"][c] + of(ramp, c) * (plane - memory["last"][c])
        lag.append(torch.where(is_first, 0.0, change))
        result.append(plane + of(strength, c) * lag[-1])
    return result, {"lag": lag, "last": planes}


def crosstalk(planes: Planes, values: Mapping[str, Tensor]) -> Planes:
    """Spread each taxel's signal over its link, a product for each: with W, or with G where χ or σ differ between episodes."""
    signal = torch.stack(planes, dim=1)
    given = signal * values["crosstalk_strength"] if "crosstalk_strength" in values else signal
    parts, start = [], 0
    for name in sorted(name for name in values if name.startswith(KERNEL)):
        kernel = values[name]
        own = given[..., start : start + kernel.shape[-1]]
        mixed = own @ kernel[0].T
        if len(kernel) > 1:
            mixed = mixed + values["crosstalk_mixture"] * (own @ kernel[1].T)
        parts.append(mixed)
        start += kernel.shape[-1]
    spread = torch.cat(parts, dim=-1)
    return list((signal - given + spread if "crosstalk_strength" in values else spread).unbind(1))


def delayed(planes: Planes, values: Mapping[str, Tensor], ring: Planes, now: Now) -> Planes:
    """Return the signal as it was, linear between calls; before the first call it counts as constant."""
    assert now.ages is not None
    late = values["delay"][:, 0]
    if "jitter" in values:
        index = torch.zeros_like(now.streams[random.JITTER].first[:1, 0])
        late = late + values["jitter"][:, 0] * random.uniform(random.words(now.streams[random.JITTER], index), late.dtype)
    length = ring[0].shape[1]
    ages = now.ages[:length]
    newer = torch.minimum((ages <= late[..., None]).sum(dim=-1), torch.clamp(now.age, max=length))
    is_oldest = newer >= torch.clamp(now.age, max=length)
    start = torch.where(newer > 0, ages[(newer - 1).clamp(min=0)], 0.0)
    rest = (late - start) / (ages[newer.clamp(max=length - 1)] - start)
    # Stacked, they are stored once per environment, see `random.streams`.
    rest, is_now = torch.stack([torch.where(is_oldest, 0.0, rest), (newer == 0).to(rest.dtype)]).unbind()
    slots = torch.stack([(now.step - newer) % length, (now.step - newer - 1) % length]).unbind()
    result = []
    for plane, past in zip(planes, ring, strict=True):
        after, before = (_entry(past, slot) for slot in slots)
        after = torch.where(is_now > 0, plane, after)
        result.append(torch.where(rest > 0, after + rest * (before - after), after))
    return result


def _entry(ring: Tensor, slot: Tensor) -> Tensor:
    """Return what a ring (env, call, taxel) holds at a place, (env, 1) or (env, taxel)."""
    env = torch.arange(len(slot), device=slot.device)
    if slot.shape[1] == 1:  # whole rows, which lie together
        return ring[env, slot[:, 0]]
    return ring[env[:, None], slot, torch.arange(ring.shape[2], device=slot.device)]
