"""The order of stages, resets, and what passes gradients.

Draws are counted, so a stage disturbs alone as it does among others: two stages apply in one order, not the other.
Pairs that commute are left out: gain and hysteresis, gain and delay, delay and constants.
"""

from typing import Any

import numpy as np
import pytest
import torch
from noise_stages import ALL_TOGETHER, CHANNELS, DT, EXACT
from oracles.setups.signals import Noise

HALF_STEP = {"read_delay": [0.5 * DT, 2.5 * DT], "jitter": 2 * DT}
STICKY = {"hysteresis": {"strength": 2.0, "time_constant": 0.01}}
ORDER: dict[str, tuple[Any, Any]] = {
    "gain, crosstalk": ({"gain": [0.5, 1.5]}, {"crosstalk": {"strength": 0.5, "sigma": "1 mm"}}),
    "hysteresis, crosstalk": ([STICKY, {}] * 3, {"crosstalk": {"strength": 0.5, "sigma": "1 mm"}}),
    "hysteresis, delay": (STICKY, HALF_STEP),
    "crosstalk, delay": ({"crosstalk": {"strength": 0.5, "sigma": "1 mm"}}, [HALF_STEP, {}] * 3),
    "hysteresis, white noise": (STICKY, {"white_noise": 0.1}),
    "crosstalk, bias": ({"crosstalk": {"strength": 0.5, "sigma": "1 mm"}}, [{"bias": 1.0}, {}] * 3),
    "gain, bias": ({"gain": [0.5, 1.5]}, {"bias": 1.0}),
    "delay, white noise": (HALF_STEP, {"white_noise": 0.1}),
    "delay, drift": (HALF_STEP, {"drift": 0.1}),
    "delay, quantization": (HALF_STEP, {"quantization": 0.5}),
    "bias, quantization": ({"bias": 0.15}, {"quantization": 0.5}),
    "white noise, quantization": ({"white_noise": 0.1}, {"quantization": 0.5}),
    "drift, quantization": ({"drift": 0.1}, {"quantization": 0.5}),
    "quantization, dead": ({"quantization": 0.5}, {"dead_probability": 0.5, "dead_range": [0.1, 0.4]}),
    "bias, dead": ({"bias": 1.0}, {"dead_probability": 0.5}),
    "white noise, dead": ({"white_noise": 0.1}, {"dead_probability": 0.5}),
    "drift, dead": ({"drift": 0.1}, {"dead_probability": 0.5, "dead_range": [-3, 3]}),
    "crosstalk, dead": ({"crosstalk": {"strength": 0.5, "sigma": "1 mm"}}, {"dead_probability": 0.5}),
}


@pytest.mark.parametrize("pair", ORDER)
def test_the_order_of_stages(pair):
    def rows(knobs: Any) -> list[dict[str, Any]]:
        return knobs if isinstance(knobs, list) else [knobs] * 6

    def make(knobs: Any) -> Noise:
        return Noise(knobs, 6, num_envs=3, dt=DT)

    first, second = map(rows, ORDER[pair])
    both = make([a | b for a, b in zip(first, second, strict=True)])
    alone = make(first), make(second)
    swapped = make(second), make(first)
    rng, swapped_error, ordered_error = np.random.default_rng(3), 0.0, 0.0
    for call in range(30):
        if call == 15:
            for noise in (both, *alone, *swapped):
                noise.reset(1)
        signal = rng.normal(0, 1, (3, 6, 1))
        readings = both.read(signal, DT)
        ordered_error = max(ordered_error, float((readings - alone[1].read(alone[0].read(signal, DT), DT)).abs().max()))
        swapped_error = max(swapped_error, float((readings - swapped[1].read(swapped[0].read(signal, DT), DT)).abs().max()))
    assert ordered_error < EXACT
    assert swapped_error > 0.05


def test_a_dead_taxel_ignores_its_signal():
    noise = Noise({**ALL_TOGETHER, "dead_probability": 1.0, "quantization": 0.3}, 6, CHANNELS, num_envs=3, dt=DT)
    first = noise.read(5.0, DT)
    for call in range(5):
        assert torch.equal(noise.read(float(call), DT), first)


def test_the_first_reading_after_a_reset_is_the_true_value():
    filters = {key: ALL_TOGETHER[key] for key in ("hysteresis", "read_delay", "jitter")}
    noise = Noise(filters, 3, CHANNELS, num_envs=3, dt=DT)
    for call in range(12):
        noise.read(float(call % 3), DT)
    noise.reset([0, 2])
    reading = noise.read(22.0, DT)
    assert (reading[[0, 2]] == 22).all() and (reading[1] != 22).all()
    assert (noise.read(22.0, DT)[[0, 2]] == 22).all()


def test_the_quantiser_lets_gradients_through():
    noise = Noise({"quantization": [0.0, 0.5], "bias": 0.1}, 3)
    signal = torch.linspace(-1, 1, 3, dtype=torch.float64)[:, None].requires_grad_()
    noise.read(signal).sum().backward()
    assert torch.equal(signal.grad, torch.ones_like(signal))
