"""The stages of the noise: the batched form against the definition, their order, and closed forms of each."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from noise_cases import MM, Noise, line, make_layout, one

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.sensors.noise import Knobs, random, stages
from tgdsl.sensors.noise.lower import crosstalk_kernel
from tgdsl.sensors.noise.reference import ReferenceNoise

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


def errors(noise: Noise, times: Any = even, calls: int = 40) -> np.ndarray:
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


@pytest.mark.parametrize("case", [*ALONE, *NOISES])
def test_each_stage_is_as_defined(case):
    noise = Noise((ALONE | NOISES)[case], TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    assert errors(noise).max() < (NORMAL if case in NOISES else EXACT)


@pytest.mark.parametrize("case", [case for case in [*ALONE, *NOISES] if not case.startswith(("delay", "jitter"))])
def test_each_stage_is_as_defined_where_dt_is_uneven(case):
    noise = Noise((ALONE | NOISES)[case], TWO_LINKS, CHANNELS, num_envs=3)
    assert errors(noise, uneven).max() < (NORMAL if case in NOISES else EXACT)


def test_the_delay_is_a_time_where_dt_is_uneven():
    """A clock that is read 4 ms late, at 0, 10, 12 and 13 ms: 4 ms before the last call it showed 9."""
    noise = Noise({"read_delay": 4e-3}, dt=1e-3)
    found = [noise.read(t, dt).item() for t, dt in ((0.0, 1e-3), (10.0, 10e-3), (12.0, 2e-3), (13.0, 1e-3))]
    np.testing.assert_allclose(found, [0, 6, 8, 9], atol=EXACT)


@pytest.mark.parametrize("case", ["delay between calls", "delay and jitter of ranges"])
def test_delays_are_as_defined_where_dt_is_uneven(case):
    noise = Noise(ALONE[case], TWO_LINKS, CHANNELS, num_envs=3, dt=0.01 * DT)
    assert errors(noise, uneven).max() < EXACT


def test_a_dead_range_of_two_equal_ranges_is_as_defined():
    """Its ends are two numbers that are drawn apart, so stuck readings differ."""
    noise = Noise({"dead_probability": 1.0, "dead_range": [[-2, 1], [-2, 1]]}, 5, num_envs=3)
    assert errors(noise).max() < EXACT


def test_all_stages_together_are_as_defined():
    noise = Noise(ALL_TOGETHER, TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    assert noise.lowered.terms == (
        "gain", "hysteresis", "crosstalk", "delay", "bias", "white_noise", "drift", "dead",
    )  # fmt: skip
    assert errors(noise).max() < NORMAL


def test_all_stages_and_the_quantiser_are_as_defined():
    """Where the definition is nearer than 1e-5 to the middle between two steps of the quantiser, either will do."""
    step = 0.25
    noise = Noise({**ALL_TOGETHER, "quantization": step}, TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    smooth = Noise(ALL_TOGETHER, TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    rng, exact, fine, num_close = np.random.default_rng(1), noise.references(), smooth.references(), 0
    for _ in range(40):
        signal = rng.normal(0, 1, (3, 7, 3))
        found = noise.read(signal, DT).numpy()
        for env in range(3):
            expected, before = (d[env].read(d[env].gain * signal[env], DT) for d in (exact, fine))
            is_close = np.abs(before / step % 1 - 0.5) < 1e-5
            num_close += is_close.sum()
            np.testing.assert_allclose(np.where(is_close, expected, found[env]), expected, atol=EXACT)
    assert num_close < 5


def test_each_row_has_its_own_knobs():
    """Every third row has all stages, the next none, the last some, with its own values."""
    some = {"hysteresis": {"strength": 0.2, "time_constant": 0.5}, "read_delay": [0, 3e-3], "drift": 0.05, "gain": [2, 3]}
    rows = [({**ALL_TOGETHER, "quantization": 0.0}, {}, some)[i % 3] for i in range(7)]
    noise = Noise(rows, TWO_LINKS, CHANNELS, num_envs=3, dt=DT)
    assert errors(noise).max() < NORMAL


def test_a_row_without_knobs_is_untouched_but_for_its_neighbours():
    rows = [{key: value for key, value in ALL_TOGETHER.items() if key != "crosstalk"}, {}] * 3
    signal = torch.randn(4, 6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    noise = Noise(rows, 6, CHANNELS, num_envs=4, dt=DT)
    for _ in range(10):
        signal = signal + 0.1
        assert torch.equal(noise.read(signal, DT)[:, 1::2], signal[:, 1::2])


def test_between_samples_the_walk_stands_still():
    noise = Noise({"drift": 0.1, "white_noise": {"depth": 0.01}}, 4, num_envs=3)
    definitions, rng = noise.references(), np.random.default_rng(0)
    for call in range(30):
        is_sample = rng.random((3, 1)) < (0.4 if call else 1)
        found = noise.read(1.0, DT, torch.from_numpy(is_sample)).numpy()
        for env, definition in enumerate(definitions):
            expected = definition.read(np.ones((4, 1)), DT, bool(is_sample[env, 0]))
            if is_sample[env, 0]:
                np.testing.assert_allclose(found[env], expected, atol=NORMAL)


def test_a_radius_is_as_defined_and_never_negative():
    rows = [{"radius_noise": width} for width in (1 * MM, [1 * MM, 6 * MM], 0.0)]
    noise = Noise(rows, 3, num_envs=4)
    definitions, radius = noise.references(), np.array([4, 3, 2]) * MM
    for call in range(50):
        if call == 20:
            noise.reset([1, 2])
            for env in (1, 2):
                definitions[env].reset()
        now = noise.now(DT)
        shift = stages.radius_shift(stages.knob_values(noise.constants, now)["radius_noise"], now, torch.zeros(4, 3).double())
        found = stages.shifted(torch.tensor(radius), shift).numpy()
        expected = []
        for definition in definitions:
            expected.append(definition.radius(radius))
            definition.read(np.zeros((3, 1)), DT)
        np.testing.assert_allclose(found, expected, atol=EXACT)
        assert (found >= 0).all() and (found[:, 2] == 2 * MM).all()
        noise.read(0.0, DT)
    assert stages.shifted(torch.tensor([-torch.inf]), torch.tensor([1.0])).item() == -torch.inf
    assert stages.shifted(torch.tensor([1 * MM]), torch.tensor([-2 * MM])).item() == 0


# A whole module: what it reads is what the definition makes of its clean reading.

PADS = """
<mujoco><worldbody>
  <body name="a"><freejoint/><geom type="sphere" size=".02"/></body>
  <body name="b"><freejoint/><geom type="sphere" size=".02"/></body>
  <body name="item"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>
"""


def pads(folder: Path, kind: str, noise: dict[str, Any], **sensor: Any) -> TactileModule:
    """A module with one sensor, `s`, on two bodies of 4 and 3 probes that reach 50 mm."""
    model = folder / "pads.xml"
    model.write_text(PADS)
    points = [{"pos": [x * MM, 0, 20 * MM], "normal": [0, 0, 1], "radius": "50 mm"} for x in range(4)]
    layout = {
        "resolutions": {"r": {"a": {"method": "points", "points": points}, "b": {"method": "points", "points": points[:3]}}}
    }
    document = {
        "tgdsl": 1,
        "robot": {"model": str(model), "layout": layout},
        "objects": {"item": {"body": "item"}},
        "sensors": {"s": {"kind": kind, "links": ["a", "b"], "feels": ["item"], "noise": noise, "readout": "both", **sensor}},
    }
    return tgdsl.compile(document, dtype=torch.float64)


def definitions_of(touch: TactileModule, seed: int, rows: list[dict[str, Any]], num_envs: int, first: int = 0) -> list[Any]:
    sets, layout = [Knobs.model_validate(own) for own in rows], touch.plan.layout_of(touch.plan.sensors[0])
    key, channels = random.sensor_key(seed, "s"), touch.outputs[0].channels
    return [ReferenceNoise(sets, channels, key, first + env, layout) for env in range(num_envs)]


def test_a_module_reads_what_is_defined(tmp_path):
    on_b = {"hysteresis": {"strength": 0.2, "time_constant": 0.5}, "read_delay": [0, 3e-3], "drift": 1e-3, "gain": [2, 3]}
    common = {**ALL_TOGETHER, "white_noise": 1e-3}
    touch = pads(tmp_path, "kinematic_taxel", {**common, "links": {"b": on_b}}, gate="geometric").seed(5, first_env=100)
    definitions = definitions_of(touch, 5, [common] * 4 + [{**common, **on_b}] * 3, 3, first=100)
    scale = 0.0
    for call in range(30):
        for env in {6: [2], 7: [2], 15: [0, 1]}.get(call, []):
            touch.reset([env])
            definitions[env].reset()
        readings = touch(dataclasses.replace(touch.example_state(3, seed=call), dt=DT))
        clean, found = readings["s/clean"].numpy(), readings["s"].numpy()
        expected = [d.read(d.gain * clean[env], DT) for env, d in enumerate(definitions)]
        scale = max(scale, np.abs(clean).max())
        np.testing.assert_allclose(found, expected, rtol=0, atol=NORMAL)
    assert scale > 1


def test_a_module_disturbs_radii_before_it_feels_and_holds_between_samples(tmp_path):
    """Depth is γ (R̃ − φ), where the clean one is R − φ; taxels are far inside. The sensor takes every fourth call."""
    noise = {"radius_noise": [1 * MM, 3 * MM], "gain": [0.5, 1.5], "bias": 0.1, "drift": 1e-3}
    touch = pads(tmp_path, "contact_depth", noise, gate="geometric", rate=1 / (4 * DT))
    definitions = definitions_of(touch, 0, [noise] * 7, 3)
    for call in range(21):
        if call == 10:
            touch.reset([1])
            definitions[1].reset()
        readings = touch(dataclasses.replace(touch.example_state(3, seed=call // 4, spread=1 * MM), dt=DT))
        if call == 10:
            assert not torch.equal(readings["s"][1], readings["s"][0])
        clean = readings["s/clean"].numpy()
        for env, definition in enumerate(definitions):
            since = call - 10 if env == 1 and call >= 10 else call
            is_sample = since % 4 == 0
            depth = clean[env] + (definition.radius(np.full(7, 50 * MM)) - 50 * MM)[:, None]
            expected = definition.read(definition.gain * depth, DT, is_sample)
            np.testing.assert_allclose(readings["s"][env].numpy(), expected, rtol=0, atol=NORMAL)


# Order. Numbers are counted, so a stage alone disturbs as it does among others: two stages are one after the other, and not
# the other way round. Pairs that commute are not here: gain and hysteresis, gain and delay, delay and what is constant.

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
    rng, off, in_order = np.random.default_rng(3), 0.0, 0.0
    for call in range(30):
        if call == 15:
            for noise in (both, *alone, *swapped):
                noise.reset(1)
        signal = rng.normal(0, 1, (3, 6, 1))
        found = both.read(signal, DT)
        in_order = max(in_order, float((found - alone[1].read(alone[0].read(signal, DT), DT)).abs().max()))
        off = max(off, float((found - swapped[1].read(swapped[0].read(signal, DT), DT)).abs().max()))
    assert in_order < EXACT
    assert off > 0.05


def test_a_dead_taxel_reads_the_same_whatever_it_feels():
    noise = Noise({**ALL_TOGETHER, "dead_probability": 1.0, "quantization": 0.3}, 6, CHANNELS, num_envs=3, dt=DT)
    first = noise.read(5.0, DT)
    for call in range(5):
        assert torch.equal(noise.read(float(call), DT), first)


# Reset: filters begin at the true value, and nothing is left of the past.


def test_after_a_reset_the_reading_begins_at_the_true_value():
    filters = {key: ALL_TOGETHER[key] for key in ("hysteresis", "read_delay", "jitter")}
    noise = Noise(filters, 3, CHANNELS, num_envs=3, dt=DT)
    for call in range(12):
        noise.read(float(call % 3), DT)
    noise.reset([0, 2])
    found = noise.read(22.0, DT)
    assert (found[[0, 2]] == 22).all() and (found[1] != 22).all()
    assert (noise.read(22.0, DT)[[0, 2]] == 22).all()


def test_the_quantiser_lets_gradients_through():
    noise = Noise({"quantization": [0.0, 0.5], "bias": 0.1}, 3)
    signal = torch.linspace(-1, 1, 3, dtype=torch.float64)[:, None].requires_grad_()
    noise.read(signal).sum().backward()
    assert torch.equal(signal.grad, torch.ones_like(signal))


# Hysteresis: one Maxwell branch.

STRENGTH, TAU = 0.5, 0.05
BRANCH = {"hysteresis": {"strength": STRENGTH, "time_constant": TAU}}
PRESS = (np.array([0.0, 0.02, 0.1, 0.13, 0.15, 0.16, 0.18, 0.2, 0.3]), np.array([0.0, 2.0, 2.0, 0.5, 0.9, 0.6, 1.0, 0.0, 0.0]))
"""Press, hold, release, wiggle, let go: times [s] and values between which the signal is linear."""


def branch(t: np.ndarray) -> np.ndarray:
    """The exact answer: each bend of the signal adds a ramp's, β Δv τ (1 − e^(−t/τ))."""
    times, values = PRESS
    bends = np.diff(np.diff(values) / np.diff(times), prepend=0, append=0)
    since = np.maximum(t[:, None] - times, 0)
    return np.interp(t, times, values) + STRENGTH * TAU * ((1 - np.exp(-since / TAU)) @ bends)


def paper(signal: np.ndarray, dt: float) -> np.ndarray:
    """The paper's update."""
    lag = np.zeros(len(signal))
    for i in range(1, len(signal)):
        lag[i] = np.exp(-dt / TAU) * lag[i - 1] + signal[i] - signal[i - 1]
    return signal + STRENGTH * lag


def test_hysteresis_after_a_step():
    noise = Noise(BRANCH)
    assert noise.read(0.0, DT).item() == 0
    noise.read(1.0, 1e-15)
    found = one(noise, np.ones(200), DT)[:, 0]
    np.testing.assert_allclose(found, 1 + STRENGTH * np.exp(-DT * np.arange(1, 201) / TAU), rtol=0, atol=EXACT)


@pytest.mark.parametrize("dt", [1e-6, 1e-3, 0.05, 10.0])
def test_hysteresis_on_a_ramp(dt):
    t, speed = dt * np.arange(200), 3.0 / dt
    expected = speed * t + STRENGTH * speed * TAU * (1 - np.exp(-t / TAU))
    np.testing.assert_allclose(one(Noise(BRANCH), speed * t, dt)[:, 0], expected, rtol=EXACT)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, EXACT), (torch.float32, 1e-4)])
def test_hysteresis_is_the_same_at_any_step(dtype, tolerance):
    common = np.arange(31) * 0.01
    expected = branch(common)
    assert np.abs(expected - np.interp(common, *PRESS)).max() > 0.3
    for parts in (1, 2, 10):
        signal = np.interp(np.arange(30 * parts + 1) * 0.01 / parts, *PRESS)
        found = one(Noise(BRANCH, dtype=dtype), signal, 0.01 / parts)[::parts, 0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def test_the_papers_hysteresis_is_not():
    curves = [paper(np.interp(np.arange(30 * k + 1) * 0.01 / k, *PRESS), 0.01 / k)[::k] for k in (1, 2, 10)]
    assert np.abs(curves[0] - curves[1]).max() > 0.02
    assert np.abs(curves[0] - curves[2]).max() > 0.04
    assert np.abs(curves[2] - branch(np.arange(31) * 0.01)).max() < 0.01


# Crosstalk: any layout, and the sum is kept.


def grid(rows: int, columns: int, spacing: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return spacing * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def sphere_cap() -> tuple[np.ndarray, np.ndarray]:
    polar, around = np.meshgrid([0.2, 0.5, 0.8, 1.1], 2 * np.pi * np.arange(9) / 9)
    normal = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1).reshape(-1, 3)
    return 8 * MM * normal, normal


CAP = sphere_cap()
LAYOUTS = {
    "grid": make_layout(grid(8, 6, 1.5 * MM)),
    "sphere cap": make_layout(*CAP),
    "irregular": make_layout(np.random.default_rng(5).uniform(0, 6 * MM, (40, 3)) * [1, 1, 0.2]),
    "inactive taxels": make_layout(grid(6, 6, MM), radius=np.where(np.arange(36) % 5 == 0, 0.0, 4 * MM)),
    "two links": make_layout(grid(5, 4, MM), link_id=[0] * 12 + [1] * 8),
    "opposite flanks": make_layout(grid(2, 10, MM), normal=[[0, 0, 1]] * 10 + [[0, 0, -1]] * 10),
}
BLUR = {"crosstalk": {"strength": 0.4, "sigma": "1.5 mm"}}


@pytest.mark.parametrize("knobs", [BLUR, {"crosstalk": {"strength": [0.2, 0.9], "sigma": ["1 mm", "3 mm"]}}])
@pytest.mark.parametrize("name", LAYOUTS)
def test_crosstalk_keeps_the_sum_of_each_unit_source(name, knobs):
    """So it does at centre, edge and corner."""
    layout = LAYOUTS[name]
    source = np.eye(layout.num_taxels)[:, :, None]
    spread = Noise(knobs, layout, num_envs=layout.num_taxels, dtype=torch.float32).read(source)[..., 0].numpy()
    np.testing.assert_allclose(spread.sum(axis=1), 1, rtol=0, atol=1e-6)
    assert (spread >= 0).all()
    is_inactive, alone = layout.radius == 0, np.eye(layout.num_taxels)
    np.testing.assert_allclose(spread[is_inactive], alone[is_inactive], atol=1e-7)
    np.testing.assert_allclose(spread[:, is_inactive], alone[:, is_inactive], atol=1e-7)
    assert (spread.diagonal()[~is_inactive] < 0.99).all()
    apart = layout.link_id[:, None] != layout.link_id
    assert (spread[apart] == 0).all()
    assert (spread[layout.normal @ layout.normal.T <= 0] == 0).all()


def test_the_papers_blur_loses_force_at_edges_and_ours_none():
    """A kernel that is padded with zeros keeps about half at an edge and a quarter at a corner, a blur of χ = 1 throughout."""
    layout = make_layout(grid(15, 15, MM))
    kernel = crosstalk_kernel(layout, np.full(225, 2 * MM))
    middle = 7 * 15 + 7
    padded = np.exp(-np.sum((layout.pos - layout.pos[:, None]) ** 2, axis=-1) / (2 * (2 * MM) ** 2))
    padded /= padded[middle].sum()
    assert padded[7].sum() < 0.62 and padded[0].sum() < 0.37
    np.testing.assert_allclose(kernel.sum(axis=0), 1, atol=1e-14)


@pytest.mark.parametrize("strength", [0.3, 1.0])
def test_a_blur_far_from_edges_has_the_variance_of_its_gaussian(strength):
    """Sums over a grid are integrals to 4π²σ²/h² e^(−2π²σ²/h²), 2e-7 for σ = h; the grid reaches 10 σ."""
    layout, sigma = make_layout(grid(21, 21, MM)), 1.0 * MM
    source = np.zeros((441, 1))
    source[220] = 1
    spread = Noise({"crosstalk": {"strength": strength, "sigma": sigma}}, layout).read(source)[0, :, 0].numpy()
    apart = layout.pos - layout.pos[220]
    np.testing.assert_allclose(spread @ apart[:, :2], 0, atol=1e-15)
    np.testing.assert_allclose(spread @ apart[:, :2] ** 2, strength * sigma**2, rtol=1e-6)


def test_no_crosstalk_is_the_identity():
    """A taxel whose strength is 0 gives nothing, but gets of what its neighbours give."""
    none, signal = {"crosstalk": {"strength": 0.0, "sigma": "1 mm"}}, np.array([[1.0], [2.0], [3.0]])
    assert Noise(none, 3).lowered.terms == ()
    more = Noise([none, BLUR, {}], 3).read(signal)[0, :, 0].numpy() - signal[:, 0]
    assert more[0] > 0 and more[2] > 0
    np.testing.assert_allclose(more[0], more[2], rtol=1e-12)
    np.testing.assert_allclose(more.sum(), 0, atol=1e-15)


def test_crosstalk_keeps_channels_apart():
    signal = np.zeros((6, 3))
    signal[2, 1] = 1
    found = Noise(BLUR, line(6), CHANNELS).read(signal)[0].numpy()
    assert (found[:, [0, 2]] == 0).all() and (found[:, 1] > 0).all()


@pytest.mark.parametrize("name", ["foo_x", "y", "ball_y_z"])
def test_a_distance_is_named_by_its_object_whatever_that_ends_in(tmp_path, name):
    """An amplitude for `distance_foo_x` is no component's of `distance_foo`: module and definition read the same."""
    model = tmp_path / "pads.xml"
    model.write_text(PADS)
    points = [{"pos": [0, 0, 20 * MM], "normal": [0, 0, 1], "radius": "50 mm"}]
    noise = {"bias": {f"distance_{name}": 0.25}, "white_noise": {f"distance_{name}": 1e-3}}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(model), "layout": {"resolutions": {"r": {"a": {"method": "points", "points": points}}}}},
        "objects": {name: {"body": "item"}},
        "sensors": {"s": {"kind": "surface_distance", "links": ["a"], "feels": [name], "noise": noise, "readout": "both"}},
    }
    touch = tgdsl.compile(document, dtype=torch.float64).seed(5)
    (definition,) = definitions_of(touch, 5, [noise], 1)
    readings = touch(dataclasses.replace(touch.example_state(1), dt=DT))
    read, clean = readings["s"][0].numpy(), readings["s/clean"][0].numpy()
    np.testing.assert_allclose(read, definition.read(clean, DT), rtol=0, atol=1e-12)
    assert np.abs(read - clean - 0.25).max() < 0.02
