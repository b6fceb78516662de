"""Imperfections of a sensor: what lies between the true signal and what is read, in this order.

    radius        R̃_j = max(0, R_j + ε_j),  ε_j ~ U[−ρ, ρ] at each reading, before objects are felt            [m]
    gain          x ← γ_j x,  γ_j ~ U[γ_low, γ_high] at reset; an elastomer's gain is of the depth at each taxel
    hysteresis    ξ ← e^(−r) ξ + (1 − e^(−r))/r (x_t − x_(t−1)),  r = Δt/τ;   x ← x + β ξ
    crosstalk     x_j ← Σ_i W_ji x_i,  W_ji = (1 − χ_i) δ_ji + χ_i G_ji,  G_ji = K_ji / Σ_k K_ki
    delay         x ← x(t − Δ),  Δ = Δ_read + U[0, J] at each reading, the same for all taxels
    offset        y = x + b + n_t + d_t,  n_t ~ N(0, σ²),  d_t = d_(t−1) + w_t,  w_t ~ N(0, σ_rw²)
    quantization  y ← q round(y/q)
    dead          y ← z_j where M_j,  M_j ~ Bernoulli(p),  z_j = low + s_j (high − low),  s_j ~ U[0, 1], both at reset

for each channel alone, but M_j and s_j are of the taxel; d = 0 and ξ = 0 at reset, and what was before it counts as equal to
the first signal after it. The hysteresis is a Maxwell branch, exact for signals that are linear between calls, and the delay
reads such a signal too, so both are the same at any step. Crosstalk mixes the taxels of one link:
K_ij = exp(−|x_i − x_j|²/2σ²) where their normals are within 90°, else 0; columns of W add up to 1, so the sum over a link is
what it was, at edges and corners too. Where σ is a range, G mixes the kernels of its ends with a share that is drawn uniformly.
Gradients pass the quantiser as if it were not there.

Where a kind makes bits of its signal (`contact`, `link_contact`), all this is done to the signal, before the threshold. A
sensor with a rate of its own holds y between its samples: n, d and J are drawn once per sample.

Source: Chung et al., *Tactile Genesis*, appendix, "Sensor Noise Model". Departures: hysteresis is exact for ramps, where the
paper's ξ ← e^(−r) ξ + x_t − x_(t−1) depends on the step; crosstalk works on any layout and keeps the sum, where a blur that is
padded with zeros loses half of a force at a corner.

Shapes: `env` environments, `channel` numbers of the signal, `row` its rows; values of knobs broadcast with all three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tgdsl.sensors.noise import filters, random
from tgdsl.sensors.noise.instant import Now, Signal, uniform
from tgdsl.tensors.fusion import materialised

TERMS = ("radius_noise", "gain", "hysteresis", "crosstalk", "delay", "bias", "white_noise", "drift", "quantization", "dead")
"""The stages that a plan names, in their order."""

TIMELESS = frozenset({"crosstalk", "bias", "quantization", "release_threshold"})
"""Stages that need not know when a reading is made, unless a knob of theirs is a range."""

PARAMETERS = (
    "radius_noise",
    "gain_low",
    "gain_high",
    "hysteresis_strength",
    "hysteresis_time",
    "crosstalk_strength",
    "crosstalk_mixture",
    "read_delay",
    "jitter",
    "bias",
    "white_noise",
    "drift",
    "quantization",
    "dead_probability",
    "dead_low",
    "dead_high",
    "release_threshold",
)
"""Numbers that a range may be given for; the place in this list says which random number is drawn, so it only grows."""


def is_drawn(name: str, ndim: int) -> bool:
    """Return whether a constant is a range, (end, channel, row), from which each environment draws at reset."""
    return ndim == 3 and not name.startswith(filters.KERNEL)


def knob_values(constants: Mapping[str, Tensor], now: Now | None) -> dict[str, Tensor]:
    """Return the values of knobs, (env or 1, channel or 1, row or 1), and the kernels as they are."""
    drawn = [name for name, value in constants.items() if is_drawn(name, value.ndim)]
    values = {name: value if name.startswith(filters.KERNEL) else value[None] for name, value in constants.items()}
    if drawn and now is not None:
        stream, like = now.streams[random.PARAMETER], constants[drawn[0]]
        place = [torch.full((1,), PARAMETERS.index(name), dtype=torch.int32, device=like.device) for name in drawn]
        for name, index in zip(drawn, place, strict=True):
            share = materialised(random.uniform(random.words(stream, index), like.dtype))
            low, high = constants[name]
            values[name] = low + share[..., None] * (high - low)
    return values


def shifted(radius: Tensor, shift: Tensor) -> Tensor:
    """Return disturbed radii [m]; what reaches nowhere (−∞) does so still."""
    return torch.where(radius > -torch.inf, torch.clamp(radius + shift, min=0), -torch.inf)


def radius_shift(half_width: Tensor, now: Now, like: Tensor) -> Tensor:
    """Return by how much each probe's radius is off (env, taxel) [m]."""
    share = materialised(uniform(now, random.RADIUS, 0, like))
    return half_width[:, 0] * (2 * share - 1)


def gain(values: Mapping[str, Tensor], now: Now, like: Tensor) -> Tensor:
    """Return each taxel's gain (env, taxel)."""
    low, high = values["gain_low"][:, 0], values["gain_high"][:, 0]
    share = materialised(uniform(now, random.GAIN, 0, like))
    return low + share * (high - low)


def disturb(
    signal: Signal, terms: Sequence[str], values: Mapping[str, Tensor], memory: Mapping[str, Tensor], now: Now | None
) -> tuple[Signal, dict[str, Tensor]]:
    """Return what is read of a signal, and the new memory.

    Args:
        signal: The signal; its gain, if there is one, is applied already.
        terms: The stages there are.
        values: The knobs' values.
        memory: By name (env, channel, row); of `ring`, (env, call, channel, row), the new one holds this call alone.
        now: When; None if no stage wants to know.
    """
    assert now is not None or set(terms) <= TIMELESS, terms
    new: dict[str, Tensor] = {}
    if "hysteresis" in terms and now is not None:
        signal, more = filters.hysteresis(signal, values, memory, now)
        new |= more
    if "crosstalk" in terms:
        signal = filters.crosstalk(signal, values)
    if "delay" in terms and now is not None:
        new["ring"] = signal
        signal = filters.delayed(signal, values, memory["ring"], now)
    if "bias" in terms:
        signal = signal + values["bias"]
    if ("white_noise" in terms or "drift" in terms) and now is not None:
        signal, more = _with_random_offset(signal, terms, values, memory, now)
        new |= more
    if "quantization" in terms:
        signal = _quantized(signal, values["quantization"])
    if "dead" in terms and now is not None:
        signal = _with_dead(signal, values, now)
    return signal, new


def _with_random_offset(
    signal: Signal, terms: Sequence[str], values: Mapping[str, Tensor], memory: Mapping[str, Tensor], now: Now
) -> tuple[Signal, dict[str, Tensor]]:
    """Return the signal with white noise and drift, and the random walk; both are of the same pair of normal numbers."""
    channels, rows = signal.shape[1:]
    index = torch.arange(channels * rows, dtype=torch.int32, device=signal.device).view(channels, rows)
    first, second = now.streams[random.READING]
    noise, step = random.normal_pair(random.words(random.Stream(first[..., None], second[..., None]), index), signal.dtype)
    if "white_noise" in terms:
        signal = signal + values["white_noise"] * noise
    if "drift" not in terms:
        return signal, {}
    step = values["drift"] * step
    step = step if now.is_sample is None else torch.where(now.is_sample[..., None], step, 0.0)
    walk = torch.where(now.age[..., None] == 0, 0.0, memory["walk"]) + step
    return signal + walk, {"walk": walk}


def _quantized(signal: Signal, step: Tensor) -> Signal:
    per_step = materialised(torch.where(step > 0, 1 / torch.where(step > 0, step, 1.0), 0.0))
    level = torch.where(step > 0, step * torch.round(signal * per_step), signal)
    return level.detach() + (signal - signal.detach()) if signal.requires_grad else level


def _with_dead(signal: Signal, values: Mapping[str, Tensor], now: Now) -> Signal:
    """Return the signal with dead taxels stuck, in all channels at the same share of their ranges."""
    one = signal[:, 0]
    share = uniform(now, random.DEAD, 1, one) if "dead_high" in values else torch.zeros_like(one)
    is_dead = uniform(now, random.DEAD, 0, one) < values["dead_probability"][:, 0]
    share = materialised(torch.where(is_dead, share, -1.0))
    share, stuck = share[:, None], values["dead_low"]
    if "dead_high" in values:
        stuck = stuck + share * (values["dead_high"] - stuck)
    return torch.where(share < 0, signal, stuck)
