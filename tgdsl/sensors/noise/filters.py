"""The stages of noise that remember or mix: hysteresis, crosstalk, delay. Their equations are in `stages`.

Shapes: `env` environments, `channel` numbers of the signal, `row` its rows; values of knobs broadcast with all three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.instant import Now, Signal
from tgdsl.tensors.fusion import materialised
from tgdsl.tensors.link_products import LINK_PRODUCTS

KERNEL = "kernel/"
"""Kernels of the links, (σ, taxel from, taxel to): `kernel/0000` and so on, in the order of the taxels."""


def hysteresis(
    signal: Signal, values: Mapping[str, Tensor], memory: Mapping[str, Tensor], now: Now
) -> tuple[Signal, dict[str, Tensor]]:
    """Return the signal with its overshoot, and what is remembered of both."""
    assert now.dt is not None
    ratio = now.dt / values["hysteresis_time"]
    ramp = torch.where(ratio > 0, -torch.expm1(-ratio) / torch.where(ratio > 0, ratio, 1.0), 1.0)
    decay, ramp = materialised(torch.exp(-ratio)), materialised(ramp)
    lag = torch.where(now.age[..., None] == 0, 0.0, decay * memory["lag"] + ramp * (signal - memory["last"]))
    return signal + values["hysteresis_strength"] * lag, {"lag": lag, "last": signal}


def crosstalk(signal: Signal, values: Mapping[str, Tensor]) -> Signal:
    """Spread each taxel's signal over its link, a product for each: with W, or with G where χ or σ differ between episodes."""
    given = signal * values["crosstalk_strength"] if "crosstalk_strength" in values else signal
    kernels = [values[name] for name in sorted(name for name in values if name.startswith(KERNEL))]
    mixed = _product(given, [kernel[0] for kernel in kernels])
    if len(kernels[0]) > 1:
        mixed = mixed + values["crosstalk_mixture"] * _product(given, [kernel[1] for kernel in kernels])
    return signal - given + mixed if "crosstalk_strength" in values else mixed


def _product(signal: Signal, kernels: Sequence[Tensor]) -> Signal:
    """Return the signal with each link's rows multiplied by its kernel, (from, to)."""
    lines = signal.flatten(0, 1)  # of all environments and channels: one product, not one for each environment
    return LINK_PRODUCTS(lines, [kernel[:, None] for kernel in kernels])[0].view(signal.shape)


def delayed(signal: Signal, values: Mapping[str, Tensor], ring: Tensor, now: Now) -> Signal:
    """Return the signal as it was, linear between calls; before the first call it counts as constant."""
    assert now.ages is not None
    late = values["read_delay"][:, 0]
    if "jitter" in values:
        index = torch.zeros_like(now.streams[random.JITTER].first[:1, 0])
        late = late + values["jitter"][:, 0] * random.uniform(random.words(now.streams[random.JITTER], index), late.dtype)
    length = ring.shape[1]
    ages = now.ages[:, :length]
    newer = torch.minimum((ages[:, None] <= late[..., None]).sum(dim=-1), torch.clamp(now.age, max=length))
    is_oldest = newer >= torch.clamp(now.age, max=length)
    start = torch.where(newer > 0, ages.gather(1, (newer - 1).clamp(min=0)), 0.0)
    rest = (late - start) / (ages.gather(1, newer.clamp(max=length - 1)) - start)
    rest, newer = materialised(torch.where(is_oldest, 0.0, rest)), materialised(newer)
    after, before = (_entry(ring, materialised((now.step - newer - k) % length)) for k in (0, 1))
    after = torch.where(newer[:, None] == 0, signal, after)
    return torch.where(rest[:, None] > 0, after + rest[:, None] * (before - after), after)


def _entry(ring: Tensor, slot: Tensor) -> Signal:
    """Return what a ring (env, call, channel, row) holds at a place, (env, 1) or (env, row)."""
    env = torch.arange(len(ring), device=ring.device)
    if slot.shape[1] == 1:  # whole signals, which lie together
        return ring[env, slot[:, 0]]
    place = slot[:, None, None].expand(-1, 1, *ring.shape[2:])
    return ring.gather(1, place)[:, 0]
