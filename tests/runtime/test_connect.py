"""One interface to step and observe: a simulation, the same scene behind the hand's serial protocol, and errors."""

from pathlib import Path

import numpy as np
import pytest
import torch
from connections import NEWTON, SCALE, TERMS, TURN, instant, ramp
from xhand1_models import document

import tgdsl
from tgdsl.errors import HandError, ObservationError, SimulationError, TgdslError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.connect import Connection
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.emulator.simulated import EmulatedSource
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.wire.errors import (
    HandDisconnectedError,
)

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def touch(tmp_path_factory) -> TactileModule:
    return tgdsl.compile(document(tmp_path_factory.mktemp("hand"), {"policy": TERMS, "blind": [{"type": "none"}]}))


def record_policy(env: Connection, controls) -> torch.Tensor:
    observations = [env.observe()["policy"]]
    for control in controls:
        env.step(control)
        observations.append(env.observe()["policy"])
    return torch.cat(observations).double()


def half_counts(axes: str) -> torch.Tensor:
    """Return half a count of each fingertip along its link's axes, flattened like `agg_force`."""
    along_link = 0.5 * np.einsum("ij,fj->fi", abs(TURN), SCALE)
    return torch.from_numpy(along_link[:, ["xyz".index(axis) for axis in axes]].T.reshape(-1))


@pytest.mark.slow
def test_emulator_and_simulation_agree_within_half_a_count(touch):
    """Fingers press, are released by a reset, and press again; only rounding differs."""
    controls = ramp(30)
    runs = []
    for source in ("simulation", "emulator"):
        with tgdsl.connect(touch, source, calibration=NEWTON, motion=instant(touch), lockstep=True) as env:
            assert (env.num_envs, env.control_step) == (1, 0.02)
            first = record_policy(env, controls)
            env.reset()
            runs.append(torch.cat([first, record_policy(env, controls[:20])]))
    simulated, emulated = runs
    pressed = (simulated[:, :15].reshape(-1, 3, 5) != 0).any(dim=1).any(dim=0)
    assert pressed.sum() >= 2
    bound = torch.cat([half_counts("zyx"), half_counts("xyz")])
    assert ((simulated - emulated).abs() <= bound * (1 + 1e-4)).all()
    assert (emulated != simulated).any()
    assert simulated[-1].abs().max() > 20 * bound.max()


@pytest.mark.slow
def test_the_real_hands_scene_agrees_too():
    """The XHand1 closes on the cube: thumb and index finger press on it."""
    touch = tgdsl.compile(EXAMPLES / "xhand1_tips.yaml")
    model = tgdsl.simulate(touch, 1).model
    motion = MotionLimits.of_robot(model, speed=1e9, current_limit=300, kp=100, watchdog_s=1.0)
    rest, squeeze = (np.float32(model.key(name).ctrl) for name in ("rest", "squeeze"))
    controls = [rest + np.float32(min(1, i / 50)) * (squeeze - rest) for i in range(75)]
    scale = np.array([[0.2] * 3] + [[0.05] * 3] * 4)
    rotation = np.stack([np.eye(3)] + [np.array([[0, 0, 1.0], [0, 1, 0], [1, 0, 0]])] * 4)
    calibration = Calibration("N", scale, rotation, np.zeros((5, 3)), np.zeros((5, 3)))
    runs = []
    for source in ("simulation", "emulator"):
        options = {"keyframe": "rest", "calibration": calibration, "motion": motion, "lockstep": True}
        with tgdsl.connect(touch, source, **options) as env:
            runs.append(record_policy(env, controls).reshape(-1, 3, 5))
    simulated, emulated = runs
    assert (simulated[-1].norm(dim=0) > 1).sum() >= 2
    assert ((simulated - emulated).abs() <= 0.5 * torch.from_numpy(scale.T) * (1 + 1e-4)).all()


def test_a_simulation_gives_the_modules_observations(touch):
    with tgdsl.connect(touch, num_envs=3, control_step=0.01) as env:
        sim = tgdsl.simulate(touch, 3, substeps=5)
        assert env.num_envs == 3
        for control in ramp(10):
            env.step(control)
            sim.step(control)
            observations, expected = env.observe(), touch.observe(touch(sim.state()))
            assert observations.keys() == expected.keys() == {"policy", "blind"}
            for group, part in observations.items():
                torch.testing.assert_close(part, expected[group], rtol=0, atol=0)


def test_observe_reads_once_per_step(tmp_path):
    stacked = tgdsl.compile(document(tmp_path, {"policy": TERMS[:1]}, depth={"history": 2}))
    with tgdsl.connect(stacked) as env:
        for control in ramp(8):
            env.step(control)
            observations = [env.observe()["policy"] for _ in range(3)]
            assert all((part == observations[0]).all() for part in observations)
        assert (observations[0][:, :15] != observations[0][:, 15:]).any()


def test_unavailable_observations_are_refused_before_a_hand_is_opened(tmp_path):
    touch = tgdsl.compile(document(tmp_path, {"policy": [{"type": "depth", "of": "depth"}]}))
    for source in ("xhand1:/dev/no-such-port", "emulator"):
        with pytest.raises(ObservationError, match=r"an XHand1 cannot give these observations:\n  policy\[0\] depth of depth"):
            tgdsl.connect(touch, source)


@pytest.mark.parametrize(
    ("source", "options", "error", "message"),
    [
        ("gazebo", {}, TgdslError, 'unknown source "gazebo"; expected "simulation", "emulator", "xhand1", "xhand1:PORT"'),
        ("emulator", {"num_envs": 2}, TgdslError, 'num_envs is 2, but "emulator" is one environment'),
        ("simulation", {"control_step": 0.0031}, SimulationError, "a whole number of the scene's physics steps of 0.002 s"),
        ("emulator", {"control_step": 0.0005}, SimulationError, "a whole number of the scene's physics steps of 0.002 s"),
        ("xhand1:/dev/x", {"lockstep": True}, HandError, "a real hand moves in its own time"),
        ("xhand1:/dev/no-such-port", {}, HandDisconnectedError, "/dev/no-such-port cannot be opened"),
        ("emulator", {"keyframe": "none"}, SimulationError, 'the scene has no keyframe "none"'),
    ],
)
def test_invalid_sources_and_options_are_refused(touch, source, options, error, message):
    with pytest.raises(error, match=message):
        tgdsl.connect(touch, source, **options)


def test_reset_of_a_hand_accepts_only_its_environment(tmp_path):
    touch = tgdsl.compile(document(tmp_path, {"policy": TERMS[:1]}, depth={"history": 3}))
    with tgdsl.connect(touch, "emulator", calibration=NEWTON, motion=instant(touch), lockstep=True) as env:
        for control in ramp(10):
            env.step(control)
        pressed = env.observe()["policy"]
        for env_ids in ([], [False], torch.zeros(1, dtype=torch.bool)):
            env.reset(env_ids)
            assert (env.observe()["policy"] == pressed).all()
        with pytest.raises(HandError, match=r"env_ids: found 3, expected indices from 0 to 0, or a mask of 1"):
            env.reset([3])
        env.reset([True])
        assert (env.observe()["policy"] != pressed).any()


def test_the_calibration_may_be_a_file(touch, tmp_path):
    path = tmp_path / "hand.yaml"
    path.write_text(NEWTON.text())
    with tgdsl.connect(touch, "emulator", calibration=path, lockstep=True) as env:
        assert isinstance(env.source, EmulatedSource)
        assert env.source.calibration.contact_threshold == 5.0
