"""Connections to a hand, an emulated device behind a serial port: actuators, ports, and bytes sent."""

import re
import warnings

import mujoco
import numpy as np
import pytest
import torch
from connections import SQUEEZE, TERMS, instant, stepped, steps
from faulty_lines import Faults, FaultyEmulator
from first_order_hands import first_order_hand
from xhand1_hands import PATIENT, WrittenBytes, read_again, wait_until
from xhand1_models import JOINTS, document, hand_xml

import tgdsl
from tgdsl.errors import HandError, ObservationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime import connect as connecting
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.motion import JointControls, MotionLimits, joint_ids
from tgdsl.runtime.xhand1.source import XHand1Source
from tgdsl.runtime.xhand1.wire.client import PortInfo, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import (
    HandDisconnectedError,
    HandTimeoutError,
    MotionError,
)
from tgdsl.runtime.xhand1.wire.protocol import PASSIVE, Frame, encode_command, encode_frame

PASSIVE_READ = encode_frame(Frame(0xFE, 0x80, 2, encode_command(PASSIVE)))
VERSION = bytes.fromhex("55aafe80130000efc3")


@pytest.fixture(scope="module")
def touch(tmp_path_factory) -> TactileModule:
    return tgdsl.compile(document(tmp_path_factory.mktemp("hand"), {"policy": TERMS, "blind": [{"type": "none"}]}))


def test_actuators_may_be_in_any_order():
    order = list(np.random.default_rng(0).permutation(JOINTS))
    model = mujoco.MjModel.from_xml_string(hand_xml("left", actuators=order))
    assert [model.joint(i).name for i in joint_ids(model)] == [f"left_hand_{name}" for name in JOINTS]
    controls = JointControls.of_model(model)
    angles = dict(zip(order, np.linspace(-1, 1, 12), strict=True))
    for control in (np.array([angles[name] for name in order]), np.array([[angles[name] for name in order]])):
        assert controls.targets(control).tolist() == [angles[name] for name in JOINTS]
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
def test_actuators_that_do_not_fit_a_hand_are_refused(xml, message):
    with pytest.raises(MotionError, match=message):
        JointControls.of_model(mujoco.MjModel.from_xml_string(xml))


def test_limits_beyond_the_robots_ranges_are_refused(touch):
    wide = MotionLimits((-1.1,) * 12, (1.0,) * 12, (1.0,) * 12, (300,) * 12, kp=100)
    for source in ("emulator", "xhand1:/dev/no-such-port"):
        with pytest.raises(MotionError, match=r"thumb_bend_joint: limits from -1.1 to 1 rad, expected them within .* -1 to 1"):
            tgdsl.connect(touch, source, motion=wide)


def test_a_read_only_hand_does_not_move_and_warns_once_about_controls(touch, monkeypatch):
    """Checks every byte written while the hand is connected, stepped with controls, reset and closed."""
    written = WrittenBytes()
    plain_open = XHand1.open
    monkeypatch.setattr(XHand1, "open", lambda *args, **options: plain_open(*args, **options, open_port=written.open))
    with (
        FaultyEmulator(first_order_hand()) as emulator,
        tgdsl.connect(touch, f"xhand1:{emulator.device}", timing=PATIENT) as env,
    ):
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


@pytest.mark.slow
def test_observe_raises_after_a_failed_step(touch):
    timing = SerialTiming(reply_timeout_s=2.0, silence_s=1.0)
    with FaultyEmulator() as emulator, tgdsl.connect(touch, f"xhand1:{emulator.device}", timing=timing) as env:
        env.observe()
        emulator.set_faults(Faults(silence=1.0))
        with pytest.raises(HandTimeoutError):
            steps(env, 1000)
        with pytest.raises(ObservationError, match="the last step or reset failed, so there is nothing new to observe"):
            env.observe()
        assert isinstance(env.source, XHand1Source)
        with pytest.raises(HandTimeoutError, match="the last step or reset gave no reading"):
            env.source.sample()
        with pytest.raises(HandTimeoutError):
            env.reset()
        emulator.set_faults(Faults())
        read_again(env.source.hand)
        env.step()
        assert (env.observe()["policy"] == 0).all()


def test_controls_reach_joints_in_the_actuators_order(tmp_path):
    order = JOINTS[::-1]
    touch = tgdsl.compile(document(tmp_path, {"policy": TERMS}, hand_xml(actuators=order)))
    with (
        FaultyEmulator(first_order_hand(time_constant_s=0.001)) as emulator,
        tgdsl.connect(touch, f"xhand1:{emulator.device}", motion=instant(touch), timing=PATIENT) as env,
    ):
        assert wait_until(lambda: stepped(env, SQUEEZE) and abs(emulator.hand.position - SQUEEZE[::-1]).max() < 1e-3)
        env.reset()
        env.step()
        assert emulator.hand.is_passive
        with pytest.raises(MotionError, match=r"pinky_joint2: target 1.5 rad, expected -1 to 1"):
            env.step(np.array([1.5] + [0.1] * 11))
        with pytest.raises(MotionError, match=r"is passive: .* call resume\(\) to go on"):
            env.step(SQUEEZE)
        assert isinstance(env.source, XHand1Source)
        hand = env.source.hand
        env.resume()
        assert wait_until(lambda: stepped(env, SQUEEZE) and hand.stopped is None)


@pytest.mark.parametrize(
    ("ports", "found"),
    [((), "none"), (("/dev/ttyS0",), "none"), (("/dev/ttyUSB0", "/dev/ttyACM1"), "/dev/ttyUSB0, /dev/ttyACM1")],
)
def test_the_only_port_is_chosen(touch, monkeypatch, ports, found):
    infos = tuple(PortInfo(port, "", "") for port in ports)
    monkeypatch.setattr(connecting, "list_ports", lambda: infos)
    with pytest.raises(HandError, match=f"expected one USB serial port, found {found}; name the hand's"):
        tgdsl.connect(touch, "xhand1")
    monkeypatch.setattr(connecting, "list_ports", lambda: (*infos[:1], PortInfo("/dev/ttyUSB7", "", ""))[-1:])
    with pytest.raises(HandDisconnectedError, match="/dev/ttyUSB7 cannot be opened"):
        tgdsl.connect(touch, "xhand1")
