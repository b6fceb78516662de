"""Imperfections of a sensor: what lies between the true signal and what is read, in this order.

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

import torch
from torch import Tensor

from tgdsl.sensors.noise import filters, random
from tgdsl.sensors.noise.instant import Now, Planes, of, row_index, uniform

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
    return half_width[:, 0] * (2 * uniform(now, random.RADIUS, 0, like) - 1)


def gain(values: Mapping[str, Tensor], now: Now, like: Tensor) -> Tensor:
    """Return each taxel's gain (env, taxel)."""
    low, high = values["gain_low"][:, 0], values["gain_high"][:, 0]
    return low + uniform(now, random.GAIN, 0, like) * (high - low)


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
        planes, more = filters.hysteresis(planes, values, memory, now)
        new |= more
    if "crosstalk" in terms:
        planes = filters.crosstalk(planes, values)
    if "delay" in terms and now is not None:
        new["ring"] = planes
        planes = filters.delayed(planes, values, memory["ring"], now)
    if "bias" in terms:
        planes = [plane + of(values["bias"], c) for c, plane in enumerate(planes)]
    if ("white_noise" in terms or "drift" in terms) and now is not None:
        planes, more = _random_offset(planes, terms, values, memory, now)
        new |= more
    if "quantization" in terms:
        planes = [_quantized(plane, of(values["quantization"], c)) for c, plane in enumerate(planes)]
    if "dead" in terms and now is not None:
        is_dead = uniform(now, random.DEAD, 0, planes[0]) < values["dead_probability"][:, 0]
        planes = [torch.where(is_dead, _stuck(values, c, plane, now), plane) for c, plane in enumerate(planes)]
    return planes, new


def _random_offset(
    planes: Planes, terms: Sequence[str], values: Mapping[str, Tensor], memory: Mapping[str, Planes], now: Now
) -> tuple[Planes, dict[str, Planes]]:
    """Return the signal with white noise and drift, and the random walk; both are of the same pair of normal numbers."""
    result, walks = [], []
    for c, plane in enumerate(planes):
        word = random.words(now.streams[random.READING], row_index(c, plane))
        noise, step = random.normal_pair(word, plane.dtype)
        if "white_noise" in terms:
            plane = plane + of(values["white_noise"], c) * noise
        if "drift" in terms:
            step = of(values["drift"], c) * step
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
    low = of(values["dead_low"], c)
    if "dead_high" not in values:
        return low
    return low + uniform(now, random.DEAD, c + 1, plane) * (of(values["dead_high"], c) - low)
