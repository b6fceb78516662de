"""Imperfections of a sensor: what lies between the true signal and what is read. In this order:

    radius        R̃_j = max(0, R_j + ε_j),  ε_j ~ U[−ρ, ρ] at each reading, before objects are felt            [m]
    gain          x ← γ_j x,  γ_j ~ U[γ_low, γ_high] at reset; an elastomer's gain is of the depth at each taxel
    hysteresis    ξ ← e^(−r) ξ + (1 − e^(−r))/r (x_t − x_(t−1)),  r = Δt/τ;   x ← x + β ξ
    crosstalk     x_j ← Σ_i W_ji x_i,  W_ji = (1 − χ_i) δ_ji + χ_i G_ji,  G_ji = K_ji / Σ_k K_ki
    delay         x ← x(t − Δ),  Δ = Δ_read + U[0, J] at each reading, the same for all taxels
    offset        y = x + b + n_t + d_t,  n_t ~ N(0, σ²),  d_t = d_(t−1) + w_t,  w_t ~ N(0, σ_rw²)
    quantization  y ← q round(y/q)
    dead          y ← z_j where M_j,  M_j ~ Bernoulli(p),  z_j ~ U[low, high], both at reset

for each channel alone; d = 0 and ξ = 0 at reset, and what was before it counts as equal to the first signal after it. The
hysteresis is a Maxwell branch, exact for signals that are linear between calls, and the delay reads such a signal too, so both
are the same at any step. Crosstalk mixes the taxels of one link: K_ij = exp(−|x_i − x_j|²/2σ²) where their normals are within
90°, else 0; columns of W add up to 1, so the sum over a link is what it was, at edges and corners too. Where σ is a range, G
mixes the kernels of its ends with a share that is drawn uniformly. Gradients pass the quantiser as if it were not there.

Where a kind makes bits of its signal (`contact`, `link_contact`), all this is done to the signal, before the threshold. A
sensor with a rate of its own holds y between its samples: n, d and J are drawn once per sample.

Source: Chung et al., *Tactile Genesis*, appendix, "Sensor Noise Model". Departures: hysteresis is exact for ramps, where the
paper's ξ ← e^(−r) ξ + x_t − x_(t−1) depends on the step; crosstalk works on any layout and keeps the sum, where a blur that is
padded with zeros loses half of a force at a corner.

Shapes: `env` environments, `taxel` rows of the reading; values of knobs broadcast with (env, channel, taxel).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.random import Stream

TERMS = ("radius_noise", "gain", "hysteresis", "crosstalk", "delay", "bias", "white_noise", "drift", "quantization", "dead")
"""The stages that a plan names, in their order."""

PARAMETERS = (
    "radius_noise",
    "gain_low",
    "gain_high",
    "hysteresis_strength",
    "hysteresis_time",
    "crosstalk_strength",
    "crosstalk_mixture",
    "delay",
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


KERNEL = "kernel/"
"""Kernels of the links, (σ, taxel to, taxel from): `kernel/0000` and so on, in the order of the taxels."""

Planes = list[Tensor]
"""The channels of a signal: tensors (env, taxel)."""


class Now(NamedTuple):
    """When a reading is made.

    Attributes:
        dt: Time since the last call [s].
        step: Number of this call.
        age: Calls since each environment's reset, (env, 1); 0 at the first one.
        is_sample: Whether each environment's sensor takes a sample now, (env, 1); None: always.
        streams: The sensor's random numbers, by purpose.
    """

    dt: Tensor | None
    step: Tensor
    age: Tensor
    is_sample: Tensor | None
    streams: Mapping[int, Stream]


def is_drawn(name: str, ndim: int) -> bool:
    """Return whether a constant is a range, (end, channel, row), from which each environment draws at reset."""
    return ndim == 3 and not name.startswith(KERNEL)


def knob_values(constants: Mapping[str, Tensor], now: Now | None) -> dict[str, Tensor]:
    """Return the values of knobs, (env or 1, channel or 1, row or 1), and the kernels as they are."""
    drawn = [name for name, value in constants.items() if is_drawn(name, value.ndim)]
    values = {name: value if name.startswith(KERNEL) else value[None] for name, value in constants.items()}
    if drawn and now is not None:
        stream, like = now.streams[random.PARAMETER], constants[drawn[0]]
        place = [torch.full((1,), PARAMETERS.index(name), dtype=torch.int32, device=like.device) for name in drawn]
        # Stacked, they are stored, see `random.streams`.
        shares = torch.stack([random.uniform(random.words(stream, index), like.dtype) for index in place], dim=1)
        for name, share in zip(drawn, shares.unbind(1), strict=True):
            low, high = constants[name]
            values[name] = low + share[..., None] * (high - low)
    return values


def shifted(radius: Tensor, shift: Tensor) -> Tensor:
    """Return disturbed radii [m]; what reaches nowhere (−∞) does so still."""
    return torch.where(radius > -torch.inf, torch.clamp(radius + shift, min=0), -torch.inf)


def radius_shift(half_width: Tensor, now: Now, like: Tensor) -> Tensor:
    """Return by how much each probe's radius is off (env, taxel) [m]."""
    return half_width[:, 0] * (2 * _uniform(now, random.RADIUS, 0, like) - 1)


def gain(values: Mapping[str, Tensor], now: Now, like: Tensor) -> Tensor:
    """Return each taxel's gain (env, taxel)."""
    low, high = values["gain_low"][:, 0], values["gain_high"][:, 0]
    return low + _uniform(now, random.GAIN, 0, like) * (high - low)


def disturb(
    planes: Planes, terms: Sequence[str], values: Mapping[str, Tensor], memory: Mapping[str, Planes], now: Now | None
) -> tuple[Planes, dict[str, Planes]]:
    """Return what is read of a signal, and the new memory.

    Args:
        planes: The signal, channel by channel; its gain, if there is one, is applied already.
        terms: The stages there are.
        values: The knobs' values.
        memory: By name and channel, (env, taxel); of `ring`, (env, call, taxel), the new one holds this call alone.
        now: When; None if no stage wants to know.
    """
    new: dict[str, Planes] = {}
    if "hysteresis" in terms and now is not None:
        planes, more = _hysteresis(planes, values, memory, now)
        new |= more
    if "crosstalk" in terms:
        planes = _crosstalk(planes, values)
    if "delay" in terms and now is not None:
        new["ring"] = planes
        planes = _delayed(planes, values, memory["ring"], now)
    if "bias" in terms:
        planes = [plane + _of(values["bias"], c) for c, plane in enumerate(planes)]
    if ("white_noise" in terms or "drift" in terms) and now is not None:
        planes, more = _random_offset(planes, terms, values, memory, now)
        new |= more
    if "quantization" in terms:
        planes = [_quantized(plane, _of(values["quantization"], c)) for c, plane in enumerate(planes)]
    if "dead" in terms and now is not None:
        is_dead = _uniform(now, random.DEAD, 0, planes[0]) < values["dead_probability"][:, 0]
        planes = [torch.where(is_dead, _stuck(values, c, plane, now), plane) for c, plane in enumerate(planes)]
    return planes, new


def _hysteresis(
    planes: Planes, values: Mapping[str, Tensor], memory: Mapping[str, Planes], now: Now
) -> tuple[Planes, dict[str, Planes]]:
    assert now.dt is not None
    ratio = now.dt / values["hysteresis_time"]
    ramp = torch.where(ratio > 0, -torch.expm1(-ratio) / torch.where(ratio > 0, ratio, 1.0), 1.0)
    strength, decay, ramp = torch.broadcast_tensors(values["hysteresis_strength"], torch.exp(-ratio), ramp)
    # Stacked, they are stored; a compiler that fuses would else take the exponentials anew for every number.
    strength, decay, ramp = torch.stack([strength, decay, ramp]).unbind()
    is_first = now.age == 0
    lag, result = [], []
    for c, plane in enumerate(planes):
        change = _of(decay, c) * memory["lag"][c] + _of(ramp, c) * (plane - memory["last"][c])
        lag.append(torch.where(is_first, 0.0, change))
        result.append(plane + _of(strength, c) * lag[-1])
    return result, {"lag": lag, "last": planes}


def _crosstalk(planes: Planes, values: Mapping[str, Tensor]) -> Planes:
    """Spread each taxel's share among the taxels of its link, one product per link."""
    signal = torch.stack(planes, dim=1)
    given = signal * values["crosstalk_strength"]
    parts, start = [], 0
    for name in sorted(name for name in values if name.startswith(KERNEL)):
        kernel = values[name]
        own = given[..., start : start + kernel.shape[-1]]
        mixed = own @ kernel[0].T
        if len(kernel) > 1:
            mixed = mixed + values["crosstalk_mixture"] * (own @ kernel[1].T)
        parts.append(mixed)
        start += kernel.shape[-1]
    return list((signal - given + torch.cat(parts, dim=-1)).unbind(1))


def _delayed(planes: Planes, values: Mapping[str, Tensor], ring: Planes, now: Now) -> Planes:
    """Return the signal as it was, linear between calls; before the first call it counts as constant."""
    assert now.dt is not None
    late = values["delay"]
    if "jitter" in values:
        late = (
            late
            + values["jitter"] * random.uniform(random.words(now.streams[random.JITTER], _index(0, 1)), late.dtype)[:, None]
        )
    length = ring[0].shape[1]
    calls = torch.minimum((late / now.dt)[:, 0], torch.clamp(now.age, max=length).to(late.dtype))
    whole = calls.floor().clamp(max=length - 1)
    rest, newer = calls - whole, whole.to(torch.int64)
    slots = ((now.step - newer) % length, (now.step - newer - 1) % length)
    env = torch.arange(len(now.age), device=now.age.device)[:, None]
    taxel = torch.arange(planes[0].shape[1], device=now.age.device)
    result = []
    for plane, past in zip(planes, ring, strict=True):
        after = torch.where(newer == 0, plane, past[env, slots[0], taxel])
        before = torch.where(rest > 0, past[env, slots[1], taxel], 0.0)
        result.append(torch.where(rest > 0, after + rest * (before - after), after))
    return result


def _random_offset(
    planes: Planes, terms: Sequence[str], values: Mapping[str, Tensor], memory: Mapping[str, Planes], now: Now
) -> tuple[Planes, dict[str, Planes]]:
    """Return the signal with white noise and drift, and the random walk; both are of the same pair of normal numbers."""
    result, walks = [], []
    for c, plane in enumerate(planes):
        word = random.words(now.streams[random.READING], _index(c, plane))
        noise, step = random.normal_pair(word, plane.dtype)
        if "white_noise" in terms:
            plane = plane + _of(values["white_noise"], c) * noise
        if "drift" in terms:
            step = _of(values["drift"], c) * step
            step = step if now.is_sample is None else torch.where(now.is_sample, step, 0.0)
            walks.append(torch.where(now.age == 0, 0.0, memory["walk"][c]) + step)
            plane = plane + walks[-1]
        result.append(plane)
    return result, {"walk": walks} if walks else {}


def _quantized(plane: Tensor, step: Tensor) -> Tensor:
    level = step * torch.round(plane / torch.where(step > 0, step, 1.0))
    level = torch.where(step > 0, level, plane)
    return level.detach() + (plane - plane.detach()) if plane.requires_grad else level


def _stuck(values: Mapping[str, Tensor], c: int, plane: Tensor, now: Now) -> Tensor:
    low = _of(values["dead_low"], c)
    if "dead_high" not in values:
        return low
    return low + _uniform(now, random.DEAD, c + 1, plane) * (_of(values["dead_high"], c) - low)


def _of(values: Tensor, c: int) -> Tensor:
    """Return a knob's values for one channel."""
    return values[:, c if values.shape[1] > 1 else 0]


def _index(row: int, like: Tensor | int) -> Tensor:
    """Return the numbers of a row's random words: as many as there are taxels."""
    count = like if isinstance(like, int) else like.shape[-1]
    device = None if isinstance(like, int) else like.device
    return torch.arange(count, dtype=torch.int32, device=device) + row * count


def _uniform(now: Now, purpose: int, row: int, like: Tensor) -> Tensor:
    return random.uniform(random.words(now.streams[purpose], _index(row, like)), like.dtype)
