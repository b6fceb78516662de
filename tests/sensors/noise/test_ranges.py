"""Knobs given as ranges: each environment draws its own value at a reset."""

import numpy as np
import pytest
import torch
from noise_documents import document, mistakes
from noisy_modules import circumstances

import tgdsl

RANGES = {
    "radius_noise": ([1e-4, 2e-4], {"radius_noise": (1e-4, 2e-4)}),
    "gain": ([[0.5, 0.6], [1.5, 1.7]], {"gain_low": (0.5, 0.6), "gain_high": (1.5, 1.7)}),
    "hysteresis": (
        {"strength": [0.2, 0.4], "time_constant": [0.02, 0.08]},
        {"hysteresis_strength": (0.2, 0.4), "hysteresis_time": (0.02, 0.08)},
    ),
    "crosstalk": (
        {"strength": [0.1, 0.2], "sigma": [0.003, 0.006]},
        {"crosstalk_strength": (0.1, 0.2), "crosstalk_mixture": (0, 1)},
    ),
    "read_delay": ([0.01, 0.03], {"read_delay": (0.01, 0.03)}),
    "jitter": ([0.0, 0.02], {"jitter": (0, 0.02), "read_delay": None}),
    "bias": ([-1, 2], {"bias": (-1, 2)}),
    "white_noise": ([1, 3], {"white_noise": (1, 3)}),
    "drift": ([1, 3], {"drift": (1, 3)}),
    "quantization": ([1, 3], {"quantization": (1, 3)}),
    "dead_probability": ([0.1, 0.4], {"dead_probability": (0.1, 0.4), "dead_low": None}),
    "dead_range": ([[-4, -3], [5, 7]], {"dead_low": (-4, -3), "dead_high": (5, 7), "dead_probability": None}),
}
"""A range of each knob and the bounds of its draws; None: a plain number that comes with it."""


@pytest.mark.parametrize("knob", RANGES)
def test_each_environment_draws_its_own_at_reset(tmp_path, knob):
    """Draws lie in the range, differ between environments, persist, and change where an environment is reset."""
    value, expected = RANGES[knob]
    noise = {knob: value, **({"dead_probability": 0.5} if knob == "dead_range" else {})}
    touch = tgdsl.compile(document(tmp_path, "kinematic_taxel", noise), dtype=torch.float64)
    num_envs = 200

    def drawn() -> dict[str, torch.Tensor]:
        state = touch.example_state(num_envs)
        memory = touch.memory.tensors(num_envs, state.dt, touch.dtype, touch.device)
        dt = None if state.dt is None else torch.tensor(state.dt, dtype=torch.float64)
        stages = circumstances(touch, memory, dt)[1]["s"]
        touch(state)
        values = {name: value for stage in stages for name, value in vars(stage).items()}
        return {name: values[name][:, 0, 0] for name in expected}

    first, second = drawn(), drawn()
    touch.reset([3, 7])
    third = drawn()
    untouched = [env for env in range(num_envs) if env not in (3, 7)]
    for name, ends in expected.items():
        assert torch.equal(first[name], second[name])
        if ends is None:
            assert len(first[name]) == 1
            continue
        low, high = ends
        assert len(first[name].unique()) == num_envs
        assert low <= first[name].min() < low + 0.1 * (high - low)  # P(no one of 200 there) = 7e-10
        assert high >= first[name].max() > high - 0.1 * (high - low)
        assert torch.equal(third[name][untouched], first[name][untouched])
        assert (third[name][[3, 7]] != first[name][[3, 7]]).all()


def test_a_range_of_the_release_threshold(tmp_path):
    """Active bits switch off below their environment's own threshold, somewhere in the range."""
    noise = {"release_threshold": [1e-3, 3e-3]}
    spec = document(tmp_path, "contact", noise, threshold=3.5e-3, gate="geometric")
    touch = tgdsl.compile(spec, dtype=torch.float64)
    state = touch.example_state(200)
    state.body_pos, state.body_quat = torch.zeros(200, 4, 3, dtype=torch.float64), torch.zeros(200, 4, 4, dtype=torch.float64)
    state.body_quat[..., 0] = 1
    released = torch.zeros(200, dtype=torch.float64)
    item, depths = touch.inputs.bodies.index("item"), np.linspace(3.75e-3, 0.5e-3, 66)
    for depth in depths:  # of the middle taxel: 10 mm up, of radius 4 mm, under a ball of 30 mm
        state.body_pos[:, item, 2] = 0.01 + 0.004 + 0.03 - depth
        is_off = touch(state)["s"][:, 0, 0] == 0
        released = torch.where(is_off & (released == 0), torch.tensor(depth, dtype=torch.float64), released)
    step = depths[0] - depths[1]
    assert 1e-3 - step <= released.min() < 1.2e-3 and 2.8e-3 < released.max() <= 3e-3
    assert len(released.unique()) > 20


def test_a_release_threshold_above_the_threshold_is_a_mistake(tmp_path):
    (message,) = mistakes(tmp_path, "contact", {"release_threshold": [1e-4, 6e-4]}, threshold=5e-4)
    assert message == "sensors.s.noise: release_threshold 0.0006 m is above the sensor's threshold 0.0005 m"


def test_dead_readings_lie_between_the_ends_of_their_environment(tmp_path):
    """z_j ~ U[low, high] with low and high drawn per environment: taxels of one environment differ, also for equal ranges."""
    noise = {"dead_probability": 1, "dead_range": [[-1, 1], [-1, 1]]}
    touch = tgdsl.compile(document(tmp_path, "contact_depth", noise), dtype=torch.float64)
    stuck = touch(touch.example_state(50))["s"][..., 0]
    assert all(len(row.unique()) == 6 for row in stuck)
