"""Connections to the emulator: in real time, in lockstep, and after it ends."""

import re
import time
import warnings

import pytest
import torch
from connections import NEWTON, SCALE, SQUEEZE, TERMS, instant, ramp, stepped, steps
from xhand1_hands import wait_until
from xhand1_models import document

import tgdsl
from tgdsl.errors import HandError, ObservationError, SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.emulator.simulated import EmulatedSource
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.protocol import FORCE_MAX


@pytest.fixture(scope="module")
def touch(tmp_path_factory) -> TactileModule:
    return tgdsl.compile(document(tmp_path_factory.mktemp("hand"), {"policy": TERMS, "blind": [{"type": "none"}]}))


def test_the_emulator_runs_in_real_time(touch):
    """The hand presses, reads forces, and releases at a reset."""
    with tgdsl.connect(touch, "emulator", calibration=NEWTON, motion=instant(touch)) as env:
        unloaded = env.observe()["policy"]
        assert wait_until(lambda: stepped(env, SQUEEZE) and env.observe()["policy"].abs().max() > 10)
        env.reset()
        assert (env.observe()["policy"] == unloaded).all()


@pytest.mark.slow
def test_a_passive_hand_holds_its_position(touch):
    with tgdsl.connect(touch, "emulator", calibration=NEWTON, motion=instant(touch), lockstep=True) as env:
        assert isinstance(env.source, EmulatedSource)
        for control in ramp(10):
            env.step(control)
        env.source.hand.relax()
        env.source._target = None
        hand = env.source.emulator.hand
        assert wait_until(lambda: hand.is_passive)
        for _ in range(30):
            env.step()
        position = env.source.sample().joint_pos
        env.step()
        assert env.source.sample().joint_pos[0].numpy() == pytest.approx(position[0].numpy(), abs=1e-5)
        assert env.source.sample().joint_vel.abs().max() < 1e-2
        assert position.abs().max() > 0.01


def test_forces_beyond_a_byte_are_warned_of_once_and_flagged(touch):
    tiny = Calibration("N", SCALE / 100, NEWTON.rotation, NEWTON.bias, NEWTON.tare)
    with tgdsl.connect(touch, "emulator", calibration=tiny, motion=instant(touch), lockstep=True) as env:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for control in ramp(20):
                env.step(control)
        assert len(caught) == 1
        assert re.match(r"the emulated (\w+, )*\w+ felt more than counts of -128…127", str(caught[0].message))
        assert isinstance(env.source, EmulatedSource)
        sample = env.source.sample()
        assert sample.is_tip_saturated.any()
        assert (sample.reading.state.total_force <= FORCE_MAX).all()


def test_a_step_raises_when_the_simulation_has_ended(touch, monkeypatch):
    with tgdsl.connect(touch, "emulator", calibration=NEWTON) as env:
        assert isinstance(env.source, EmulatedSource)
        env.step()

        def diverge():
            raise SimulationError("environment 0 diverged")

        monkeypatch.setattr(env.source.body, "step", diverge)
        body = env.source.body
        assert wait_until(lambda: body.failure is not None)
        with pytest.raises(SimulationError, match="the emulated hand's simulation ended: environment 0 diverged"):
            env.step()


def test_a_reset_raises_when_the_simulation_has_ended(touch, monkeypatch):
    with tgdsl.connect(touch, "emulator", calibration=NEWTON) as env:
        assert isinstance(env.source, EmulatedSource)
        body = env.source.body

        def diverge():
            raise SimulationError("environment 0 diverged")

        monkeypatch.setattr(body, "step", diverge)
        assert wait_until(lambda: body.failure is not None)
        with pytest.raises(SimulationError, match="the emulated hand's simulation ended: environment 0 diverged"):
            env.reset()


def test_a_given_timing_decides_how_long_a_reply_may_take(touch, monkeypatch):
    with tgdsl.connect(touch, "emulator", calibration=NEWTON, timing=SerialTiming(reply_timeout_s=0.05)) as env:
        assert isinstance(env.source, EmulatedSource)
        monkeypatch.setattr(env.source.emulator.line, "answer", lambda frame, arrived_at: None)
        with pytest.raises(HandError, match=r"no reply to .* within 50 ms"):
            steps(env, 10)


@pytest.mark.slow
@pytest.mark.parametrize("lockstep", [True, False])
def test_step_reset_and_close_raise_when_the_emulator_has_ended(touch, monkeypatch, lockstep):
    """A bug in the fingertips' forces ends the emulator's thread."""
    timing = SerialTiming(reply_timeout_s=1.0, silence_s=0.5)
    env = tgdsl.connect(touch, "emulator", calibration=NEWTON, timing=timing, lockstep=lockstep)
    assert isinstance(env.source, EmulatedSource)
    env.step()

    def broken(time_s):
        raise ValueError("a mistake of ours")

    monkeypatch.setattr(env.source.body, "felt", broken)
    with pytest.raises(HandError, match=r"the emulator's thread ended: ValueError\('a mistake of ours'\)") as caught:
        steps(env, 1000)
    assert isinstance(caught.value.__cause__, ValueError)
    with pytest.raises(HandError, match="the emulator's thread ended"):
        env.reset()
    with pytest.raises(HandError, match="the emulator's thread ended"):
        env.close()


@pytest.mark.slow
def test_in_lockstep_a_policy_may_take_any_time(touch):
    """Pauses beyond the watchdog's time do not change observations."""
    model, runs = tgdsl.simulate(touch, 1).model, []
    for watchdog_s, pause in ((1.0, 0.0), (0.025, 0.06)):
        motion = MotionLimits.of_robot(model, speed=1e9, current_limit=300, kp=100, watchdog_s=watchdog_s)
        with tgdsl.connect(touch, "emulator", calibration=NEWTON, motion=motion, lockstep=True) as env:
            observations = []
            for control in [*ramp(10), None]:
                env.step(control)
                time.sleep(pause)
                observations.append(env.observe()["policy"])
        runs.append(torch.cat(observations))
    assert (runs[0] == runs[1]).all() and runs[0].any()


def test_the_emulator_needs_one_force_per_fingertip(tmp_path):
    blind = tgdsl.compile(document(tmp_path, {"policy": [{"type": "agg_bool", "of": "contact"}]}))
    message = r"policy\[0\] agg_bool of contact: the emulator's thumb, index, middle, ring, pinky would feel nothing"
    with pytest.raises(ObservationError, match=message):
        tgdsl.connect(blind, "emulator", calibration=NEWTON)
    two = [{"type": "agg_force", "of": "depth"}, {"type": "agg_force", "of": "depth", "scale": 1}]
    torn = tgdsl.compile(document(tmp_path, {"policy": two}))
    with pytest.raises(ObservationError, match="differ, but the hand has one force on its thumb; give them the same `scale`"):
        tgdsl.connect(torn, "emulator", calibration=NEWTON)
