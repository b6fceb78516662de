"""Each stage of noise against its definition."""

import numpy as np
import pytest
import torch
from noise_stages import ALL_TOGETHER, ALONE, CHANNELS, DT, EXACT, NOISES, NORMAL, TWO_LINKS, errors, even, uneven
from oracles.setups.signals import MM, Noise

from tgdsl.sensors.noise.pipeline import draw
from tgdsl.sensors.noise.stages import Radius


@pytest.mark.parametrize("case", [*ALONE, *NOISES])
def test_each_stage_matches_its_definition(case):
    """In uneven time steps; delays, whose longest step sets their memory, in even steps and below in uneven ones."""
    noise = Noise((ALONE | NOISES)[case], TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    times = even if case.startswith(("delay", "jitter")) else uneven
    assert errors(noise, times).max() < (NORMAL if case in NOISES else EXACT)


def test_the_delay_is_a_time_even_if_dt_is_uneven():
    """A clock read 4 ms late, at 0, 10, 12 and 13 ms: 4 ms before the last call it showed 9."""
    noise = Noise({"read_delay": 4e-3}, dt=1e-3)
    readings = [noise.read(t, dt).item() for t, dt in ((0.0, 1e-3), (10.0, 10e-3), (12.0, 2e-3), (13.0, 1e-3))]
    np.testing.assert_allclose(readings, [0, 6, 8, 9], atol=EXACT)


@pytest.mark.parametrize("case", ["delay between calls", "delay and jitter of ranges"])
def test_delays_match_their_definition_if_dt_is_uneven(case):
    noise = Noise(ALONE[case], TWO_LINKS, CHANNELS, num_envs=3, dt=0.01 * DT)
    assert errors(noise, uneven).max() < EXACT


def test_a_dead_range_of_two_equal_ranges_matches_its_definition():
    """Its ends are drawn independently, so stuck readings differ."""
    noise = Noise({"dead_probability": 1.0, "dead_range": [[-2, 1], [-2, 1]]}, 5, num_envs=3)
    assert errors(noise).max() < EXACT


def test_all_stages_together_match_their_definition():
    noise = Noise(ALL_TOGETHER, TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    assert noise.lowered.terms == (
        "gain", "hysteresis", "crosstalk", "delay", "bias", "white_noise", "drift", "dead",
    )  # fmt: skip
    assert errors(noise).max() < NORMAL


def test_all_stages_and_the_quantiser_match_their_definition():
    """Within 1e-5 of the middle between two steps of the quantiser, either step will do."""
    step = 0.25
    noise = Noise({**ALL_TOGETHER, "quantization": step}, TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    smooth = Noise(ALL_TOGETHER, TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    rng, exact, fine, num_close = np.random.default_rng(1), noise.references(), smooth.references(), 0
    for _ in range(24):
        signal = rng.normal(0, 1, (3, 7, 3))
        readings = noise.read(signal, DT).numpy()
        for env in range(3):
            expected, unquantised = (d[env].read(d[env].gain * signal[env], DT) for d in (exact, fine))
            is_close = np.abs(unquantised / step % 1 - 0.5) < 1e-5
            num_close += is_close.sum()
            np.testing.assert_allclose(np.where(is_close, expected, readings[env]), expected, atol=EXACT)
    assert num_close < 5


def test_each_row_has_its_own_knobs():
    """Every third row has all stages, the next none, the last some, with its own values."""
    some = {"hysteresis": {"strength": 0.2, "time_constant": 0.5}, "read_delay": [0, 3e-3], "drift": 0.05, "gain": [2, 3]}
    rows = [({**ALL_TOGETHER, "quantization": 0.0}, {}, some)[i % 3] for i in range(7)]
    noise = Noise(rows, TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    assert errors(noise).max() < NORMAL


def test_a_row_without_knobs_passes_its_signal_unchanged():
    rows = [{key: value for key, value in ALL_TOGETHER.items() if key != "crosstalk"}, {}] * 3
    signal = torch.randn(4, 6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    noise = Noise(rows, 6, CHANNELS, num_envs=4, dt=DT)
    for _ in range(10):
        signal = signal + 0.1
        assert torch.equal(noise.read(signal, DT)[:, 1::2], signal[:, 1::2])


def test_the_walk_pauses_between_samples():
    noise = Noise({"drift": 0.1, "white_noise": {"depth": 0.01}}, 4, num_envs=3)
    definitions, rng = noise.references(), np.random.default_rng(0)
    for call in range(30):
        is_sample = rng.random((3, 1)) < (0.4 if call else 1)
        readings = noise.read(1.0, DT, torch.from_numpy(is_sample)).numpy()
        for env, definition in enumerate(definitions):
            expected = definition.read(np.ones((4, 1)), DT, bool(is_sample[env, 0]))
            if is_sample[env, 0]:
                np.testing.assert_allclose(readings[env], expected, atol=NORMAL)


def test_a_radius_matches_its_definition_and_is_never_negative():
    rows = [{"radius_noise": width} for width in (1 * MM, [1 * MM, 6 * MM], 0.0)]
    noise = Noise(rows, 3, num_envs=4)
    definitions, radius = noise.references(), np.array([4, 3, 2]) * MM
    for call in range(30):
        if call == 20:
            noise.reset([1, 2])
            for env in (1, 2):
                definitions[env].reset()
        now = noise.now(DT)
        (disturbed,) = draw(noise.stages, noise.constants, now)
        assert isinstance(disturbed, Radius)
        shift = disturbed.shift(now, torch.zeros(4, 3).double())
        radii = (torch.tensor(radius) + shift).clamp(min=0).numpy()
        expected = []
        for definition in definitions:
            expected.append(definition.radius(radius))
            definition.read(np.zeros((3, 1)), DT)
        np.testing.assert_allclose(radii, expected, atol=EXACT)
        assert (radii >= 0).all() and (radii[:, 2] == 2 * MM).all()
        noise.read(0.0, DT)
