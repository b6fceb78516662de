"""One way to step and observe: a simulation, the same scene behind the hand's serial protocol, and what is refused."""

import re
import time
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from xhand1_hands import PATIENT, WrittenBytes, read_again, wait_until
from xhand1_models import JOINTS, document, hand_xml

import tgdsl
from tgdsl.errors import HandError, ObservationError, SimulationError, TgdslError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.connect import Connection
from tgdsl.runtime.xhand1 import connect as connecting
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.controls import JointControls
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import Emulator
from tgdsl.runtime.xhand1.emulator.faulty_line import Faults
from tgdsl.runtime.xhand1.emulator.hand import EmulatedHand
from tgdsl.runtime.xhand1.emulator.source import EmulatedSource
from tgdsl.runtime.xhand1.motion import MotionLimits, joint_ids
from tgdsl.runtime.xhand1.source import XHand1Source
from tgdsl.runtime.xhand1.wire.errors import (
    HandDisconnectedError,
    HandTimeoutError,
    MotionError,
    StaleReadingError,
    WatchdogError,
)
from tgdsl.runtime.xhand1.wire.link import LinkTiming
from tgdsl.runtime.xhand1.wire.payloads import FORCE_MAX, PASSIVE, encode_command
from tgdsl.runtime.xhand1.wire.protocol import Frame, encode_frame
from tgdsl.runtime.xhand1.wire.serial_port import PortInfo

TERMS = [
    {"type": "agg_force", "of": "depth", "scale": 2000},
    {"type": "agg_force", "of": "depth", "scale": 2000, "axes": "xyz"},
]
TURN = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""The sensor's z is the link's x, which presses; its y is against the link's."""
SCALE = np.array([[0.5, 0.4, 0.6], [0.3, 0.2, 0.5], [0.5, 0.5, 0.5], [0.4, 0.4, 0.4], [1.0, 1.0, 1.0]])
NEWTON = Calibration(
    "N", SCALE, np.tile(TURN, (5, 1, 1)), np.tile([0.0, 0.1, 0.2], (5, 1)), np.tile([3.0, -2.5, 7.0], (5, 1)), "", 5.0
)
EXAMPLES = Path(__file__).parents[2] / "examples"
SQUEEZE = np.linspace(0.1, 0.35, 12).astype(np.float32)
PASSIVE_READ = encode_frame(Frame(0xFE, 0x80, 2, encode_command(PASSIVE)))
VERSION = bytes.fromhex("55aafe80130000efc3")


@pytest.fixture(scope="module")
def touch(tmp_path_factory) -> TactileModule:
    return tgdsl.compile(document(tmp_path_factory.mktemp("hand"), {"policy": TERMS, "blind": [{"type": "none"}]}))


def instant(touch: TactileModule) -> MotionLimits:
    """Return limits that let a set-point go to its target at once, and a busy machine be late."""
    model = tgdsl.simulate(touch, 1).model
    return MotionLimits.of_robot(model, speed=1e9, current_limit=300, kp=100, watchdog_s=1.0)


def ramp(num_steps: int) -> list[np.ndarray]:
    return [SQUEEZE * np.float32(min(1, 2 * i / num_steps)) for i in range(num_steps)]


def recorded(env: Connection, controls) -> torch.Tensor:
    found = [env.observe()["policy"]]
    for control in controls:
        env.step(control)
        found.append(env.observe()["policy"])
    return torch.cat(found).double()


def steps(env: Connection, num_steps: int) -> None:
    for _ in range(num_steps):
        env.step()


def stepped(env: Connection, control) -> bool:
    """Step, and return whether the watchdog let it: on a machine that stood still it does not, and the hand goes on from there."""
    try:
        env.step(control)
    except WatchdogError:
        env.resume()
        return False
    return True


def half_counts(axes: str) -> torch.Tensor:
    """Return half a count of each fingertip along the axes of its link, flattened as `agg_force` is."""
    along_link = 0.5 * np.einsum("ij,fj->fi", abs(TURN), SCALE)
    return torch.from_numpy(along_link[:, ["xyz".index(axis) for axis in axes]].T.reshape(-1))


def test_emulator_and_simulation_agree_within_half_a_count(touch):
    """Fingers press, are released by a reset, and press again; then nothing but rounding lies between both."""
    controls = ramp(30)
    runs = []
    for source in ("simulation", "emulator"):
        with tgdsl.connect(touch, source, calibration=NEWTON, motion=instant(touch), lockstep=True) as env:
            assert (env.num_envs, env.control_step) == (1, 0.02)
            first = recorded(env, controls)
            env.reset()
            runs.append(torch.cat([first, recorded(env, controls[:20])]))
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
            runs.append(recorded(env, controls).reshape(-1, 3, 5))
    simulated, emulated = runs
    assert (simulated[-1].norm(dim=0) > 1).sum() >= 2
    assert ((simulated - emulated).abs() <= 0.5 * torch.from_numpy(scale.T) * (1 + 1e-4)).all()


def test_the_simulation_is_what_the_module_observes(touch):
    with tgdsl.connect(touch, num_envs=3, control_step=0.01) as env:
        sim = tgdsl.simulate(touch, 3, substeps=5)
        assert env.num_envs == 3
        for control in ramp(10):
            env.step(control)
            sim.step(control)
            found, expected = env.observe(), touch.observe(touch(sim.state()))
            assert found.keys() == expected.keys() == {"policy", "blind"}
            for group, part in found.items():
                torch.testing.assert_close(part, expected[group], rtol=0, atol=0)


def test_a_reading_is_made_once_per_step(tmp_path):
    stacked = tgdsl.compile(document(tmp_path, {"policy": TERMS[:1]}, depth={"history": 2}))
    with tgdsl.connect(stacked) as env:
        for control in ramp(8):
            env.step(control)
            found = [env.observe()["policy"] for _ in range(3)]
            assert all((part == found[0]).all() for part in found)
        assert (found[0][:, :15] != found[0][:, 15:]).any()


def test_actuators_may_be_in_any_order():
    order = list(np.random.default_rng(0).permutation(JOINTS))
    model = mujoco.MjModel.from_xml_string(hand_xml("left", actuators=order))
    assert [model.joint(i).name for i in joint_ids(model)] == [f"left_hand_{name}" for name in JOINTS]
    controls = JointControls.of_model(model)
    angles = dict(zip(order, np.linspace(-1, 1, 12), strict=True))
    for given in (np.array([angles[name] for name in order]), np.array([[angles[name] for name in order]])):
        assert controls.targets(given).tolist() == [angles[name] for name in JOINTS]
    with pytest.raises(MotionError, match=re.escape("control has shape (11,), expected (1, 12) or (12,)")):
        controls.targets(np.zeros(11))


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (hand_xml(actuator="motor"), 'thumb_bend_joint: actuator "right_thumb_bend_joint" takes no angle in rad'),
        (hand_xml(actuator='position kp="1" gear="2"'), "thumb_bend_joint: actuator .* takes no angle in rad"),
        (hand_xml(actuators=JOINTS[:11]), "pinky_joint2 has 0 actuators, expected one"),
        (hand_xml(actuators=[*JOINTS]).replace("</actuator>", '<motor name="arm" joint="right_hand_mid_joint1"/></actuator>'),
         "mid_joint1 has 2 actuators, expected one"),
        (hand_xml().replace("</worldbody>", '<body><joint name="arm"/><geom size=".1"/></body></worldbody>').replace(
            "</actuator>", '<motor name="arm" joint="arm"/></actuator>'),
         "the actuators arm are not of the hand's joints"),
    ],
)  # fmt: skip
def test_actuators_that_are_not_a_hands(xml, message):
    with pytest.raises(MotionError, match=message):
        JointControls.of_model(mujoco.MjModel.from_xml_string(xml))


def test_limits_beyond_the_robot_files_are_refused(touch):
    wide = MotionLimits((-1.1,) * 12, (1.0,) * 12, (1.0,) * 12, (300,) * 12, kp=100)
    for source in ("emulator", "xhand1:/dev/no-such-port"):
        with pytest.raises(MotionError, match=r"thumb_bend_joint: limits from -1.1 to 1 rad, expected them within .* -1 to 1"):
            tgdsl.connect(touch, source, motion=wide)


def test_reading_alone_moves_nothing_and_says_once_that_controls_go_nowhere(touch, monkeypatch):
    """Every byte that is written to the port of a hand that is connected, stepped with controls, reset and closed."""
    written = WrittenBytes()
    plain_open = XHand1.open
    monkeypatch.setattr(XHand1, "open", lambda *args, **options: plain_open(*args, **options, open_port=written.open))
    with Emulator(EmulatedHand()) as emulator, tgdsl.connect(touch, f"xhand1:{emulator.device}", timing=PATIENT) as env:
        with pytest.warns(UserWarning, match="the hand was connected for reading alone: its controls go nowhere"):
            env.step(SQUEEZE)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for control in (SQUEEZE, torch.from_numpy(SQUEEZE)[None], None):
                env.step(control)
        env.reset()
        env.resume()
        assert env.observe()["policy"].shape == (1, 30)
        assert (emulator.hand.position == 0).all()
    assert set(written.writes) == {PASSIVE_READ, VERSION}


def test_after_a_failed_step_nothing_old_is_observed(touch):
    timing = LinkTiming(reply_timeout_s=2.0, silence_s=1.0)
    with Emulator() as emulator, tgdsl.connect(touch, f"xhand1:{emulator.device}", timing=timing) as env:
        env.observe()
        emulator.set_faults(Faults(silence=1.0))
        with pytest.raises(HandTimeoutError):
            steps(env, 1000)
        with pytest.raises(ObservationError, match="the last step or reset failed, so there is nothing new to observe"):
            env.observe()
        assert isinstance(env.source, XHand1Source)
        with pytest.raises(StaleReadingError, match="the last step or reset gave no reading"):
            env.source.sample()
        with pytest.raises(HandTimeoutError):
            env.reset()
        emulator.set_faults(Faults())
        read_again(env.source.hand)
        env.step()
        assert (env.observe()["policy"] == 0).all()


def test_a_hand_goes_where_the_actuators_say(tmp_path):
    order = JOINTS[::-1]
    touch = tgdsl.compile(document(tmp_path, {"policy": TERMS}, hand_xml(actuators=order)))
    with (
        Emulator(EmulatedHand(time_constant_s=0.001)) as emulator,
        tgdsl.connect(touch, f"xhand1:{emulator.device}", motion=instant(touch), timing=PATIENT) as env,
    ):
        assert wait_until(lambda: stepped(env, SQUEEZE) and abs(emulator.hand.position - SQUEEZE[::-1]).max() < 1e-3)
        env.reset()
        env.step()
        assert emulator.hand.is_passive
        with pytest.raises(MotionError, match=r"pinky_joint2: target 1.5 rad, expected -1 to 1"):
            env.step(np.array([1.5] + [0.1] * 11))
        with pytest.raises(MotionError, match=r"made passive: .* call resume\(\) to go on"):
            env.step(SQUEEZE)
        assert isinstance(env.source, XHand1Source)
        hand = env.source.hand
        env.resume()
        assert wait_until(lambda: stepped(env, SQUEEZE) and hand.stopped is None)


def test_the_emulator_runs_in_real_time(touch):
    """It presses, says so, and lets go when it is reset."""
    with tgdsl.connect(touch, "emulator", calibration=NEWTON, motion=instant(touch)) as env:
        unloaded = env.observe()["policy"]
        assert wait_until(lambda: stepped(env, SQUEEZE) and env.observe()["policy"].abs().max() > 10)
        env.reset()
        assert (env.observe()["policy"] == unloaded).all()


def test_a_passive_body_holds_where_it_is(touch):
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
        held = env.source.sample().joint_pos
        env.step()
        assert env.source.sample().joint_pos[0].numpy() == pytest.approx(held[0].numpy(), abs=1e-5)
        assert env.source.sample().joint_vel.abs().max() < 1e-2
        assert held.abs().max() > 0.01


def test_what_bytes_cannot_hold_is_said_once_and_flagged(touch):
    tiny = Calibration("N", SCALE / 100, NEWTON.rotation, NEWTON.bias, NEWTON.tare)
    with tgdsl.connect(touch, "emulator", calibration=tiny, motion=instant(touch), lockstep=True) as env:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            for control in ramp(20):
                env.step(control)
        assert len(said) == 1
        assert re.match(r"the emulated (\w+, )*\w+ felt more than counts of -128…127", str(said[0].message))
        assert isinstance(env.source, EmulatedSource)
        sample = env.source.sample()
        assert sample.is_tip_saturated.any()
        assert (sample.reading.state.total_force <= FORCE_MAX).all()


def test_a_simulation_that_ends_is_an_error_and_no_old_reading(touch, monkeypatch):
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


def test_a_reset_does_not_hide_that_the_simulation_ended(touch, monkeypatch):
    with tgdsl.connect(touch, "emulator", calibration=NEWTON) as env:
        assert isinstance(env.source, EmulatedSource)
        body = env.source.body

        def diverge():
            raise SimulationError("environment 0 diverged")

        monkeypatch.setattr(body, "step", diverge)
        assert wait_until(lambda: body.failure is not None)
        with pytest.raises(SimulationError, match="the emulated hand's simulation ended: environment 0 diverged"):
            env.reset()


@pytest.mark.parametrize("lockstep", [True, False])
def test_an_emulator_that_ends_is_told_to_who_waits_for_it(touch, monkeypatch, lockstep):
    """A mistake in what the fingertips feel ends its thread: the step that waits for a reading says so, and so does close."""
    timing = LinkTiming(reply_timeout_s=1.0, silence_s=0.5)
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


def test_in_lockstep_a_policy_may_think_for_as_long_as_it_likes(touch):
    """The watchdog's time passes on the wall, where nothing runs: what is observed does not know of it."""
    model, runs = tgdsl.simulate(touch, 1).model, []
    for watchdog_s, pause in ((1.0, 0.0), (0.025, 0.06)):
        motion = MotionLimits.of_robot(model, speed=1e9, current_limit=300, kp=100, watchdog_s=watchdog_s)
        with tgdsl.connect(touch, "emulator", calibration=NEWTON, motion=motion, lockstep=True) as env:
            found = []
            for control in [*ramp(10), None]:
                env.step(control)
                time.sleep(pause)
                found.append(env.observe()["policy"])
        runs.append(torch.cat(found))
    assert (runs[0] == runs[1]).all() and runs[0].any()


def test_the_emulator_feels_what_is_observed_and_nothing_else(tmp_path):
    blind = tgdsl.compile(document(tmp_path, {"policy": [{"type": "agg_bool", "of": "contact"}]}))
    message = r"policy\[0\] agg_bool of contact: the emulator's thumb, index, middle, ring, pinky would feel nothing"
    with pytest.raises(ObservationError, match=message):
        tgdsl.connect(blind, "emulator", calibration=NEWTON)
    two = [{"type": "agg_force", "of": "depth"}, {"type": "agg_force", "of": "depth", "scale": 1}]
    torn = tgdsl.compile(document(tmp_path, {"policy": two}))
    with pytest.raises(ObservationError, match="differ, but the hand has one force on its thumb; give them the same `scale`"):
        tgdsl.connect(torn, "emulator", calibration=NEWTON)


def test_what_a_hand_cannot_give_is_said_before_it_is_touched(tmp_path):
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
def test_what_cannot_be_connected(touch, source, options, error, message):
    with pytest.raises(error, match=message):
        tgdsl.connect(touch, source, **options)


@pytest.mark.parametrize(
    ("ports", "found"),
    [((), "none"), (("/dev/ttyS0",), "none"), (("/dev/ttyUSB0", "/dev/ttyACM1"), "/dev/ttyUSB0, /dev/ttyACM1")],
)
def test_the_only_port_is_taken(touch, monkeypatch, ports, found):
    infos = tuple(PortInfo(port, "", "") for port in ports)
    monkeypatch.setattr(connecting, "list_ports", lambda: infos)
    with pytest.raises(HandError, match=f"expected one USB serial port, found {found}; name the hand's"):
        tgdsl.connect(touch, "xhand1")
    monkeypatch.setattr(connecting, "list_ports", lambda: (*infos[:1], PortInfo("/dev/ttyUSB7", "", ""))[-1:])
    with pytest.raises(HandDisconnectedError, match="/dev/ttyUSB7 cannot be opened"):
        tgdsl.connect(touch, "xhand1")


def test_only_the_environment_that_there_is_can_be_reset(tmp_path):
    touch = tgdsl.compile(document(tmp_path, {"policy": TERMS[:1]}, depth={"history": 3}))
    with tgdsl.connect(touch, "emulator", calibration=NEWTON, motion=instant(touch), lockstep=True) as env:
        for control in ramp(10):
            env.step(control)
        pressed = env.observe()["policy"]
        for nobody in ([], [False], torch.zeros(1, dtype=torch.bool)):
            env.reset(nobody)
            assert (env.observe()["policy"] == pressed).all()
        with pytest.raises(HandError, match=r"env_ids: found \[3\], expected index 0, or a mask of 1"):
            env.reset([3])
        env.reset([True])
        assert (env.observe()["policy"] != pressed).any()


def test_the_calibration_may_be_a_file(touch, tmp_path):
    path = tmp_path / "hand.yaml"
    path.write_text(NEWTON.text())
    with tgdsl.connect(touch, "emulator", calibration=path, lockstep=True) as env:
        assert isinstance(env.source, EmulatedSource)
        assert env.source.calibration.contact_threshold == 5.0
