"""Leave for the hand to move: limits, the set-points that stay within them, and the model's actuators that give targets.

No clock and no I/O here: time is passed in. A hand that was stopped, for whatever reason, stays passive until `resume`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import listed
from tgdsl.runtime.xhand1.wire.errors import HandError, MotionError, WatchdogError
from tgdsl.runtime.xhand1.wire.protocol import JOINTS, NUM_JOINTS, PASSIVE, JointCommand, Mode

JointArray = Float[np.ndarray, " joint"]
ROUNDING = 1e-6  # how far a target may lie beyond its range to count as its end [rad]: float32 angles are rounded by less
_LONGEST_STEP_S = 0.05  # set-points move no further in one exchange than in this time, however long it took [s]


@dataclass(frozen=True)
class MotionLimits:
    """Leave to move, and how far it goes. One value per joint, in the order of their ids."""

    lower: tuple[float, ...]  # least set-point [rad]
    upper: tuple[float, ...]  # largest set-point [rad]
    speed: tuple[float, ...]  # how fast a set-point may move [rad/s]
    current_limit: tuple[int, ...]  # largest motor current [mA]; what torque it makes is not published
    kp: int  # proportional gain [hand's unit]
    ki: int = 0  # integral gain [hand's unit]
    kd: int = 0  # derivative gain [hand's unit]
    watchdog_s: float = 0.1  # the hand turns passive if no command comes for this long [s]

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing."""
        for name in ("lower", "upper", "speed", "current_limit"):
            values = getattr(self, name)
            if len(values) != NUM_JOINTS or not np.isfinite(values).all():
                raise MotionError(f"{name} is {values}, expected {NUM_JOINTS} finite numbers")
        for i, name in enumerate(JOINTS):
            if not self.lower[i] < self.upper[i]:
                raise MotionError(f"{name}: the range is {self.lower[i]:g} to {self.upper[i]:g} rad, expected lower < upper")
            if not self.speed[i] > 0 or not 0 < self.current_limit[i] <= 0xFFFF:
                limits = f"speed {self.speed[i]:g} rad/s, current {self.current_limit[i]} mA"
                raise MotionError(f"{name}: {limits}; expected more than 0, and at most 65535 mA")
        if not 0 < self.watchdog_s <= 1:
            raise MotionError(f"watchdog_s is {self.watchdog_s:g}, expected more than 0 and at most 1 s")

    @classmethod
    def of_robot(
        cls,
        model: mujoco.MjModel,
        *,
        speed: float,
        current_limit: int,
        kp: int,
        ki: int = 0,
        kd: int = 0,
        watchdog_s: float = 0.1,
    ) -> MotionLimits:
        """Return limits with the joint ranges of a robot file, and one speed [rad/s] and current [mA] for all joints.

        Raises:
            MotionError: If the robot lacks a joint of the vendor's names, right or left, or one has no range.
        """
        lower, upper = (tuple(map(float, ends)) for ends in model.jnt_range[joint_ids(model)].T)
        return cls(lower, upper, (speed,) * NUM_JOINTS, (current_limit,) * NUM_JOINTS, kp, ki, kd, watchdog_s)


def joint_of(name: str) -> int | None:
    """Return which of the hand's joints, by id, goes by a name in a robot file, of either hand; None if none does."""
    return next((i for i, joint in enumerate(JOINTS) if name == joint or name.endswith(f"_hand_{joint}")), None)


def joint_ids(model: mujoco.MjModel) -> Int[np.ndarray, " joint"]:
    """Return which of a model's joints each of the hand's is, in the order of the hand's ids.

    Raises:
        MotionError: If the robot lacks a joint, or one has no range.
    """
    names = [model.joint(i).name for i in range(model.njnt)]
    of_hand = [joint_of(name) for name in names]
    results = [[i for i, own in enumerate(of_hand) if own == joint] for joint in range(NUM_JOINTS)]
    if lacking := [joint for joint, ids in zip(JOINTS, results, strict=True) if len(ids) != 1 or not model.jnt_limited[ids[0]]]:
        problem = f"an XHand1, real or emulated, is a whole hand: expected one joint with a range for each of {listed(lacking)}"
        raise MotionError(f"{problem}; the robot has {listed(names) or 'none'}")
    return np.array(results)[:, 0]


class JointControls(NamedTuple):
    """Controls of a model that are the hand's joint angles."""

    actuator_id: Int[np.ndarray, " joint"]  # actuator of each joint
    qpos_id: Int[np.ndarray, " joint"]  # place of each joint in the model's `qpos`

    @classmethod
    def of_model(cls, model: mujoco.MjModel) -> JointControls:
        """Return the controls of a model.

        Raises:
            MotionError: If a joint has not just one actuator that takes its angle in rad, or there are others.
        """
        joints = joint_ids(model)
        actuators = [_actuator(model, name, int(joint)) for name, joint in zip(JOINTS, joints, strict=True)]
        foreign = [model.actuator(i).name or str(i) for i in range(model.nu) if i not in actuators]
        if foreign:
            raise MotionError(f"the actuators {listed(foreign)} are not of the hand's joints, so a hand cannot do what they do")
        return cls(np.array(actuators), model.jnt_qposadr[joints].astype(np.int64))

    def targets(self, control: np.ndarray) -> Float[np.ndarray, " joint"]:
        """Return joint angles by joint id [rad] from controls by actuator, (actuator,) or (1, actuator)."""
        if control.shape not in ((NUM_JOINTS,), (1, NUM_JOINTS)):
            raise MotionError(f"control has shape {control.shape}, expected (1, {NUM_JOINTS}) or ({NUM_JOINTS},)")
        return control.reshape(-1)[self.actuator_id].astype(np.float64)


def _actuator(model: mujoco.MjModel, name: str, joint: int) -> int:
    """Return the one actuator of a joint, whose control is the angle to go to [rad]."""
    is_of_joint = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
    actuators = np.flatnonzero(is_of_joint)
    if len(actuators) != 1:
        raise MotionError(f"{name} has {len(actuators)} actuators, expected one")
    i = int(actuators[0])
    gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
    is_position = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and gain > 0 and bias[0] == 0 and bias[1] == -gain
    if not is_position or model.actuator_gear[i, 0] != 1:
        raise MotionError(f'{name}: actuator "{model.actuator(i).name}" takes no angle in rad; expected a position actuator')
    return i


class Motion:
    """The set-points of a hand. The first starts from where the joints are; each moves at a limited speed.

    Without limits every command is refused, so that there is never a set-point.
    """

    def __init__(self, limits: MotionLimits | None):
        self.limits = limits
        self.stopped: HandError | None = None  # why the hand was stopped and is passive; None if it was not
        self._target: JointArray | None = None
        self._setpoint = np.zeros(NUM_JOINTS)
        self._commanded_at = self._stepped_at = 0.0

    def command(self, target: JointArray, now: float, measured: JointArray | None) -> None:
        """Take joint angles to go to [rad] at a time [s]; `measured` is where the joints are, if that is known.

        Raises:
            MotionError: If a target is outside its range, or it is not known where the joints are. The hand is then passive.
            HandError: If the hand was stopped, of the kind that stopped it.
            WatchdogError: If the last command is too long ago. The hand is then passive.
        """
        if self.limits is None:
            raise MotionError("this hand was opened for reading alone; to move it, open it with motion=MotionLimits(...)")
        self._watch(now)
        if target.shape != (NUM_JOINTS,):
            raise self.stop(MotionError(f"the target has shape {target.shape}, expected ({NUM_JOINTS},)"))
        if self.stopped is not None:
            raise type(self.stopped)(f"the hand is passive: {self.stopped}; call resume() to go on")
        lower, upper = np.array(self.limits.lower), np.array(self.limits.upper)
        outside = ~((target >= lower - ROUNDING) & (target <= upper + ROUNDING))
        if outside.any():
            i = int(np.argmax(outside))
            problem = f"{JOINTS[i]}: target {target[i]:g} rad, expected {lower[i]:g} to {upper[i]:g}"
            raise self.stop(MotionError(problem))
        if self._target is None:
            if measured is None:
                raise self.stop(MotionError("where the joints are is not known, so no set-point can start from there"))
            self._setpoint, self._stepped_at = measured.astype(np.float64), now
        self._target, self._commanded_at = np.clip(target.astype(np.float64), lower, upper), now

    def joints(self, now: float) -> tuple[JointCommand, ...]:
        """Return what to send now: set-points one step on, or `PASSIVE`."""
        self._watch(now)
        limits = self.limits
        if self._target is None or limits is None:
            return PASSIVE
        reach = np.array(limits.speed) * min(max(now - self._stepped_at, 0.0), _LONGEST_STEP_S)
        self._setpoint = np.clip(self._target, self._setpoint - reach, self._setpoint + reach)
        self._stepped_at = now
        return tuple(
            JointCommand(float(position), limits.kp, limits.ki, limits.kd, current, Mode.POSITION)
            for position, current in zip(self._setpoint, limits.current_limit, strict=True)
        )

    def stop(self, reason: HandError) -> HandError:
        """Make the hand passive until `resume`, if it is not already, and return the reason."""
        self._target = None
        self.stopped = self.stopped or reason
        return reason

    def fail(self, reason: HandError) -> None:
        """Make the hand passive if it is moving."""
        if self._target is not None:
            self.stop(reason)

    def relax(self) -> None:
        """Make the hand passive until the next command; one that was stopped stays so until `resume`."""
        self._target = None

    def resume(self) -> None:
        """Allow commands again."""
        self.stopped = self._target = None

    def _watch(self, now: float) -> None:
        waited = now - self._commanded_at
        if self._target is not None and self.limits is not None and waited > self.limits.watchdog_s:
            allowed = 1e3 * self.limits.watchdog_s
            self.stop(WatchdogError(f"no command came for {1e3 * waited:.0f} ms, expected one every {allowed:.0f} ms"))
