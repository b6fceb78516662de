"""Each stage of noise with its knobs, and how far the batched form is from the definition."""

from typing import Any

import numpy as np
from oracles.setups.signals import MM, Noise, make_layout

EXACT = 1e-12
"""Both are float64."""
NORMAL = 1e-6
"""Normal numbers, of amplitudes below 0.1: sine and cosine of the batched form are short series."""
DT = 2e-3
CHANNELS = ("force_x", "force_y", "torque_x")
RNG = np.random.default_rng(7)
TWO_LINKS = make_layout(
    RNG.uniform(0, 5 * MM, (7, 3)), normal=[[0, 0, 1]] * 4 + [[0, 0.6, 0.8], [0, 0.6, 0.8], [0, 0, -1]], link_id=[0, 0, 0, 1, 1, 1, 1],
    radius=[4 * MM] * 5 + [0.0, 4 * MM],
)  # fmt: skip

ALONE: dict[str, dict[str, Any]] = {
    "gain": {"gain": [0.85, 1.15]},
    "gain of ranges": {"gain": [[0.5, 0.8], [1.0, 1.5]]},
    "hysteresis": {"hysteresis": {"strength": 0.5, "time_constant": 0.01}},
    "hysteresis of ranges": {"hysteresis": {"strength": [0.1, 0.9], "time_constant": [1e-3, 0.1]}},
    "crosstalk": {"crosstalk": {"strength": 0.3, "sigma": "2 mm"}},
    "crosstalk of ranges": {"crosstalk": {"strength": [0.1, 0.9], "sigma": ["1 mm", "4 mm"]}},
    "delay": {"read_delay": "4 ms"},
    "delay between calls": {"read_delay": "5.3 ms"},
    "delay below a call": {"read_delay": "0.5 ms"},
    "jitter": {"jitter": "9 ms"},
    "delay and jitter of ranges": {"read_delay": [1e-3, 7e-3], "jitter": [0, 5e-3]},
    "bias": {"bias": {"force": 0.3, "torque": -2}},
    "bias of ranges": {"bias": {"force": [-1, 1], "torque": [3, 4]}},
    "quantization": {"quantization": {"force": 0.01, "torque": 0.3}},
    "quantization of ranges": {"quantization": [0, 0.2]},
    "dead": {"dead_probability": 0.4, "dead_range": [-2, {"force": 1, "torque": 5}]},
    "dead of ranges": {"dead_probability": [0.1, 0.9], "dead_range": [[-2, -1], [0.5, 1]]},
    "dead at one value": {"dead_probability": 0.4, "dead_range": [{"torque": 3}, {"torque": 3}]},
}
NOISES: dict[str, dict[str, Any]] = {
    "white noise": {"white_noise": 0.1},
    "drift": {"drift": 0.02},
    "both of ranges": {"white_noise": {"force": [0, 0.1]}, "drift": {"torque": [0.01, 0.02], "*": 1e-3}},
}
ALL_TOGETHER: dict[str, Any] = {
    **ALONE["gain of ranges"],
    **ALONE["hysteresis of ranges"],
    **ALONE["crosstalk of ranges"],
    **ALONE["delay and jitter of ranges"],
    **ALONE["bias of ranges"],
    **NOISES["both of ranges"],
    **ALONE["dead of ranges"],
}


def even(_: int) -> float:
    return DT


def uneven(call: int) -> float:
    return DT * (1, 0.5, 3, 0.01, 20)[call % 5]


def errors(noise: Noise, times: Any = even, calls: int = 24) -> np.ndarray:
    """Feed both a random signal, reset some environments in between, and return how far they are apart at each call."""
    rng, definitions, found = np.random.default_rng(1), noise.references(), []
    signal = np.zeros((noise.num_envs, noise.layout.num_taxels, len(noise.channels)))
    for call in range(calls):
        for env in {7: [1], 8: [1], 20: [0, 2]}.get(call, []):
            noise.reset(env)
            definitions[env].reset()
        signal = signal + rng.normal(0, 0.3, signal.shape)
        expected = [d.read(d.gain * signal[env], times(call)) for env, d in enumerate(definitions)]
        found.append(np.abs(noise.read(signal, times(call)).numpy() - expected).max())
    return np.array(found)
