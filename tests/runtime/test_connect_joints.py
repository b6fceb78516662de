"""Joint and last-action terms: equal from a simulation, an emulated hand, samples of a real one, and a log."""

import numpy as np
import pytest
import torch
from hand_logs import random_readings, write_log
from xhand1_models import JOINTS, document, hand_xml

import tgdsl
from tgdsl.errors import ObservationError
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.observe import HandObserver
from tgdsl.runtime.xhand1.source import TIME_CONSTANT_S, HandSample, VelocityFilter
from tgdsl.runtime.xhand1.wire.errors import MotionError

PLAIN = Calibration.none()
ORDER = [str(name) for name in np.random.default_rng(1).permutation(JOINTS)]
"""Order of the actuators and observations, which is neither the hand's nor the model's."""
IDS = [JOINTS.index(name) for name in ORDER]
TERMS = [{"type": "joint_pos"}, {"type": "joint_vel", "joints": ["*_mid_joint2", "*thumb*"]}, {"type": "last_action"}]
VEL_IDS = [JOINTS.index("mid_joint2"), *(JOINTS.index(name) for name in ORDER if "thumb" in name)]


def compiled(tmp_path, terms=TERMS, xml=None):
    return tgdsl.compile(document(tmp_path, {"policy": terms}, xml or hand_xml(actuators=ORDER)))


def instant(touch):
    """Return limits that let a set-point reach its target at once, with a watchdog for a busy machine."""
    return MotionLimits.of_robot(tgdsl.simulate(touch, 1).model, speed=1e9, current_limit=300, kp=100, watchdog_s=1.0)


def samples(num=4):
    velocity_filter = VelocityFilter(TIME_CONSTANT_S)
    readings = random_readings(np.arange(num) * 0.02 + 1.0)
    return [HandSample.of(reading, PLAIN, velocity_filter, reading.requested_at) for reading in readings]


def test_observations_have_the_order_of_the_actuators(tmp_path):
    observer = HandObserver(compiled(tmp_path), PLAIN, 0.02)
    first, second, third, _ = samples()
    start = first.joint_pos[:, IDS]
    for sample in (first, second):  # without a control, the last action is the first joint position
        expected = torch.cat([sample.joint_pos[:, IDS], sample.joint_vel[:, VEL_IDS], start], dim=1)
        assert (observer.observe(sample)["policy"] == expected).all()
    control = np.random.default_rng(0).normal(size=12)
    for action in (control, torch.from_numpy(control)[None], None):
        observer.note(action)
        assert (observer.observe(third)["policy"][0, -12:].numpy() == control.astype(np.float32)).all()
    observer.reset()
    assert (observer.observe(third)["policy"][:, -12:] == third.joint_pos[:, IDS]).all()
    with pytest.raises(MotionError, match=r"control has shape \(3,\), expected \(1, 12\) or \(12,\)"):
        observer.note(np.zeros(3))


def test_emulator_and_simulation_agree(tmp_path):
    """Angles agree to the wire's float precision, controls exactly; a reset restarts both."""
    terms = [{"type": "joint_pos"}, {"type": "last_action"}]
    touch = compiled(tmp_path, terms)
    squeeze = np.linspace(0.05, 0.2, 12).astype(np.float32)
    controls = [np.float32(share) * squeeze for share in np.linspace(0.1, 1, 10)]
    runs = []
    for source in ("simulation", "emulator"):
        with tgdsl.connect(touch, source, motion=instant(touch), lockstep=True) as env:
            observations = [env.observe()["policy"]]
            for control in [*controls, None]:
                env.step(control)
                observations.append(env.observe()["policy"])
            env.reset()
            observations.append(env.observe()["policy"])
            runs.append(torch.cat(observations))
    simulated, emulated = runs
    torch.testing.assert_close(emulated[:, :12], simulated[:, :12], rtol=2e-7, atol=1e-9)
    assert simulated[-2, :12].abs().min() > 0.001
    expected = torch.from_numpy(np.stack([np.zeros(12, np.float32), *controls, controls[-1], np.zeros(12, np.float32)]))
    assert (simulated[:, 12:] == expected).all() and (emulated[:, 12:] == expected).all()


def test_a_read_only_hand_observes_the_last_action(tmp_path):
    touch = compiled(tmp_path, [{"type": "last_action"}, {"type": "joint_pos"}])
    control = np.linspace(-0.3, 0.3, 12).astype(np.float32)
    with tgdsl.connect(touch, "emulator", lockstep=True) as env:
        with pytest.warns(UserWarning, match="the emulated hand was connected for reading alone"):
            env.step(control)
        policy = env.observe()["policy"][0].numpy()
        assert (policy[:12] == control).all()
        assert np.abs(policy[12:]).max() < 0.05
        with pytest.raises(MotionError, match="control has shape"):
            env.step(control[:3])
        with pytest.raises(ObservationError, match="the last step or reset failed"):
            env.observe()


def test_a_log_gives_joint_observations(tmp_path):
    touch = compiled(tmp_path, TERMS[:2])
    readings = random_readings(np.arange(6) * 0.02 + 3.0)
    log = write_log(tmp_path / "a.npz", readings)
    with tgdsl.connect(touch, log, lockstep=True) as env:
        observations = [env.observe()["policy"]]
        while not env.is_over:
            env.step()
            observations.append(env.observe()["policy"])
    velocity_filter = VelocityFilter(TIME_CONSTANT_S)
    for row, reading in zip(observations, readings, strict=True):
        position = reading.state.position
        velocity = velocity_filter.update(reading.requested_at, position.astype(np.float64)).astype(np.float32)
        np.testing.assert_array_equal(row[0].numpy(), np.concatenate([position[IDS], velocity[VEL_IDS]]))


def test_unavailable_joint_terms_are_refused_before_a_hand_is_opened(tmp_path):
    arm = '<body><joint name="arm"/><geom size=".1"/></body></worldbody>'
    touch = compiled(tmp_path, [{"type": "joint_effort"}, {"type": "joint_pos", "joints": ["*"]}, *TERMS[2:]])
    message = r"policy\[0\] joint_effort: it reports each drive's current as a raw number, and no torque\nit can give"
    for source in ("xhand1:/dev/no-such-port", "emulator"):
        with pytest.raises(ObservationError, match=message):
            tgdsl.connect(touch, source)
    wider = compiled(
        tmp_path,
        [{"type": "joint_pos", "joints": ["*"]}],
        hand_xml().replace("</worldbody>", arm.replace("<body>", '<body name="arm">')),
    )
    with pytest.raises(ObservationError, match=r'policy\[0\] joint_pos: it has no joint "arm"'):
        tgdsl.connect(wider, "xhand1:/dev/no-such-port")
    motors = compiled(tmp_path, TERMS[2:], hand_xml(actuator="motor"))
    with pytest.raises(ObservationError, match=r"policy\[0\] last_action: thumb_bend_joint: actuator .* takes no angle"):
        tgdsl.connect(motors, "xhand1:/dev/no-such-port")


def test_a_log_cannot_give_the_last_action(tmp_path):
    log = write_log(tmp_path / "a.npz", random_readings(np.arange(3) * 0.02))
    with pytest.raises(ObservationError, match=r"policy\[2\] last_action: a log does not hold the hand's commands"):
        tgdsl.connect(compiled(tmp_path), log)
