"""From the knobs of a sensor's taxels to constants and memory: a stage that no taxel has is not there.

Shapes: `row` rows of the reading, `channel` its channels, `end` lowest and highest value of what is drawn at reset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import LowerError, did_you_mean
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.filters import KERNEL
from tgdsl.sensors.noise.spec import ALL, ZERO, Amplitude, Crosstalk, Hysteresis, Knobs
from tgdsl.sensors.noise.stages import is_drawn


@dataclass(frozen=True, eq=False)
class LoweredNoise:
    """Imperfections, ready to be planned.

    Attributes:
        terms: The stages there are, see `stages.TERMS`.
        constants: Values of the knobs that they read: (channel or 1, row or 1), or (end, …) where an environment draws its own;
            and kernels.
        memory: Names of what is remembered of each channel and row.
        past: How far back the delay reaches [s].
        radius: Largest disturbance of a radius [m].
        streams: What random numbers are drawn for.
    """

    terms: tuple[str, ...]
    constants: Mapping[str, np.ndarray]
    memory: tuple[str, ...]
    past: float
    radius: float
    streams: tuple[int, ...]


def lower_noise(
    knobs: Sequence[Knobs], which: Int[np.ndarray, " row"], channels: Sequence[str], layout: Layout, by_taxel: bool
) -> LoweredNoise:
    """Lower a sensor's imperfections.

    Args:
        knobs: The different sets of knobs that its rows have.
        which: Which of them each row has.
        channels: Names of the signal's channels.
        layout: The sensor's taxels.
        by_taxel: Whether rows are taxels; else they are bodies.

    Raises:
        LowerError: If a knob names a quantity that the reading does not have.
    """
    tables = [_parameters(own, channels) for own in knobs]
    values = {name: np.stack([table[name] for table in tables], axis=-1)[..., which] for name in tables[0]}
    terms = tuple(term for term, is_on in _stages(values).items() if is_on)
    constants: dict[str, np.ndarray] = {}
    for term in terms:
        for name in _READS[term]:
            constants[name] = _compact(values[name])
    if "delay" in terms and not values["jitter"].any():
        del constants["jitter"]
    if "dead" in terms and (np.ptp([*values["dead_low"], *values["dead_high"]], axis=0) == 0).all():
        del constants["dead_high"]
    if "crosstalk" in terms and by_taxel:
        constants |= _kernels(values, layout)
        if constants["crosstalk_strength"].ndim == 2 and "crosstalk_mixture" not in constants:
            del constants["crosstalk_strength"]  # it is part of the kernels
    memory = tuple(name for term, names in _REMEMBERS.items() if term in terms for name in names)
    past = float((values["read_delay"][1] + values["jitter"][1]).max())
    return LoweredNoise(terms, constants, memory, past, float(values["radius_noise"].max()), _streams(terms, constants))


def _streams(terms: Sequence[str], constants: Mapping[str, np.ndarray]) -> tuple[int, ...]:
    wanted = {
        random.READING: "white_noise" in terms or "drift" in terms,
        random.RADIUS: "radius_noise" in terms,
        random.JITTER: "jitter" in constants,
        random.GAIN: "gain" in terms,
        random.DEAD: "dead" in terms,
        random.PARAMETER: any(is_drawn(name, value.ndim) for name, value in constants.items()),
    }
    return tuple(purpose for purpose, is_wanted in wanted.items() if is_wanted)


NOTHING = 1e-14
"""Share of a taxel's signal that counts as none: a millionth of float32's last digit. Much smaller ones would be subnormal
numbers, with which processors multiply ten times slower."""

_READS = {
    "radius_noise": ("radius_noise",),
    "gain": ("gain_low", "gain_high"),
    "hysteresis": ("hysteresis_strength", "hysteresis_time"),
    "crosstalk": ("crosstalk_strength",),
    "delay": ("read_delay", "jitter"),
    "bias": ("bias",),
    "white_noise": ("white_noise",),
    "drift": ("drift",),
    "quantization": ("quantization",),
    "dead": ("dead_probability", "dead_low", "dead_high"),
    "release_threshold": ("release_threshold",),
}
_REMEMBERS = {"hysteresis": ("lag", "last"), "delay": ("ring",), "drift": ("walk",)}


def _stages(values: Mapping[str, np.ndarray]) -> dict[str, bool]:
    """Return for each stage, in their order, whether some row has it."""
    on = {name: bool(value.any()) for name, value in values.items()}
    return {
        "radius_noise": on["radius_noise"],
        "gain": bool((values["gain_low"] != 1).any() or (values["gain_high"] != 1).any()),
        "hysteresis": on["hysteresis_strength"],
        "crosstalk": on["crosstalk_strength"],
        "delay": on["read_delay"] or on["jitter"],
        "bias": on["bias"],
        "white_noise": on["white_noise"],
        "drift": on["drift"],
        "quantization": on["quantization"],
        "dead": on["dead_probability"],
        "release_threshold": bool((values["release_threshold"] >= 0).all()),
    }


def _parameters(knobs: Knobs, channels: Sequence[str]) -> dict[str, Float[np.ndarray, "end channel"]]:
    """Return the values of all parameters for each channel; those of a stage that is off are neutral."""
    hysteresis = knobs.hysteresis or Hysteresis.model_construct(strength=ZERO, time_constant=(1.0, 1.0))
    crosstalk = knobs.crosstalk or Crosstalk.model_construct(strength=ZERO, sigma=(1.0, 1.0))
    plain = {
        "radius_noise": knobs.radius_noise,
        "gain_low": knobs.gain[0],
        "gain_high": knobs.gain[1],
        "hysteresis_strength": hysteresis.strength,
        "hysteresis_time": hysteresis.time_constant,
        "crosstalk_strength": crosstalk.strength,
        "crosstalk_sigma": crosstalk.sigma,
        "read_delay": knobs.read_delay,
        "jitter": knobs.jitter,
        "dead_probability": knobs.dead_probability,
        "release_threshold": knobs.release_threshold or (-1.0, -1.0),
    }
    amplitudes = {
        "bias": knobs.bias,
        "white_noise": knobs.white_noise,
        "drift": knobs.drift,
        "quantization": knobs.quantization,
        "dead_low": knobs.dead_range[0],
        "dead_high": knobs.dead_range[1],
    }
    result = {name: np.repeat(np.array(value)[:, None], len(channels), axis=1) for name, value in plain.items()}
    return result | {name: _by_channel(name, value, channels) for name, value in amplitudes.items()}


def quantity(channel: str) -> str:
    """Return what a channel is a component of: `force` of `force_x`, else its own name; a distance is named by its object."""
    is_component = channel[-2:] in ("_x", "_y", "_z") and not channel.startswith("distance_")
    return channel[:-2] if is_component else channel


def _by_channel(name: str, amplitude: Amplitude, channels: Sequence[str]) -> Float[np.ndarray, "end channel"]:
    known = list(dict.fromkeys(quantity(channel) for channel in channels))
    for own in amplitude:
        if own != ALL and own not in known:
            knob = "dead_range" if name.startswith("dead_") else name
            what = f'"{knob}" names "{own}", which this sensor does not read'
            raise LowerError(what, field="noise", hint=did_you_mean(own, known, "quantities"))
    return np.array([amplitude.get(quantity(channel), amplitude.get(ALL, ZERO)) for channel in channels]).T


def _compact(value: Float[np.ndarray, "end channel row"]) -> np.ndarray:
    """Return values without the axes along which nothing changes; those of channels and rows become 1."""
    for axis in (1, 2):
        first = value.take([0], axis)
        value = first if (value == first).all() else value
    return value[0] if (value[0] == value[1]).all() else value


def _kernels(values: Mapping[str, np.ndarray], layout: Layout) -> dict[str, np.ndarray]:
    """Return each link's operator W, (σ, from, to); G alone where χ or σ is a range: the lower end's, then the rest."""
    result: dict[str, np.ndarray] = {}
    strength, (low, high) = values["crosstalk_strength"][:, 0], values["crosstalk_sigma"][:, 0]
    is_wider = bool((low != high).any())
    for i in range(len(layout.links)):
        own = np.flatnonzero(layout.link_id == i)
        kernel, wider = (crosstalk_kernel(layout.take(own), sigma[own]) for sigma in (low, high))
        if is_wider:
            kernels = [kernel, wider - kernel]
        elif (strength[0] != strength[1]).any():
            kernels = [kernel]
        else:
            kernels = [np.diag(1 - strength[0, own]) + strength[0, own] * kernel]
        result[f"{KERNEL}{i:04d}"] = np.stack(kernels).transpose(0, 2, 1)
    if is_wider:
        result["crosstalk_mixture"] = np.array([0.0, 1.0])[:, None, None]
    return result


def crosstalk_kernel(layout: Layout, sigma: Float[np.ndarray, " taxel"]) -> Float[np.ndarray, "taxel taxel"]:
    """Return G (to, from): how what a taxel gives is shared, each column adding up to 1.

    Args:
        layout: Taxels of one link; inactive ones keep what they have.
        sigma: Standard deviation of each giver's neighbourhood [m].
    """
    apart = layout.pos[:, None] - layout.pos[None]
    weight = np.exp(-np.sum(apart**2, axis=-1) / (2 * sigma[None] ** 2))
    weight *= layout.normal @ layout.normal.T > 0
    is_active = layout.radius > 0
    weight *= is_active[:, None] & is_active[None]
    weight[weight < NOTHING] = 0.0
    weight[np.diag_indices(len(weight))] = 1.0
    return weight / weight.sum(axis=0)
