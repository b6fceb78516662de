"""A module's observations, computed from a hand's state instead of readings: same groups, names, order, dtype and device.

`agg_force` is the calibrated force on each fingertip [unit of the calibration]; the simulation's `scale` is the factor from
summed depth to that unit. `agg_bool` is whether that force is larger than the calibration's `contact_threshold`, where the
simulation counts taxels. A sensor's `rate` and `history` follow the module; its noise is not added.

`joint_pos` is the hand's reply, `joint_vel` its difference in time (see `velocity`). `last_action` is the policy's last
action, whether or not the hand was allowed to follow; before the first, the measured joint angles.

Shapes: `env` one, `finger`, `joint` and `taxel` as in `protocol`, `feature` numbers of an observation.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import ObservationError
from tgdsl.module.module import TactileModule
from tgdsl.observations.observations import HAND_ONLY, PROPRIOCEPTION
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedObservation, PlannedSensor
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.simulators.state_values import Control
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.motion import ROUNDING, JointControls, MotionLimits, joint_ids, joint_of
from tgdsl.runtime.xhand1.source import HandSample, HandSource, control_array, is_chosen
from tgdsl.runtime.xhand1.wire.errors import MotionError
from tgdsl.runtime.xhand1.wire.protocol import FINGERS, JOINTS
from tgdsl.scene.scene import scene_model
from tgdsl.tensors.env_ids import EnvIds

TIP_BODIES = ("thumb_rota_link2", "index_rota_link2", "mid_link2", "ring_link2", "pinky_link2")
"""The fingertips' bodies, without the `right_hand_` or `left_hand_` that they have in robot files."""
_GIVES = (
    "it can give: none, agg_force and agg_bool of sensors whose links are fingertips, one per finger "
    f"(bodies {', '.join(f'*_hand_{name}' for name in TIP_BODIES)}), "
    "joint_pos and joint_vel of the hand's joints, last_action, taxel_counts, taxel_saturated"
)
_KEPT = ("stack", "last")


@dataclass(frozen=True)
class HandTerm:
    """One observation that a hand can give."""

    planned: PlannedObservation
    fingers: tuple[int, ...] = ()  # fingertips that it is of, in the order of the sensor's links
    axes: tuple[int, ...] = ()  # axes of an aggregate force, in order
    steps: int = 1  # how many control steps are stacked, the oldest first
    period: float = 0.0  # time between samples [s]; 0: one at every control step
    joints: tuple[int, ...] = ()  # joints that it is of, by the hand's ids; of a `last_action`, those whose actuators it is of

    @property
    def label(self) -> str:
        """Where it stands in the document, and its type: `policy[0] agg_force of depth`."""
        return _label(self.planned)


def hand_terms(plan: Plan, contact_threshold: float | None, is_log: bool = False) -> tuple[HandTerm, ...]:
    """Return the observations of a plan as a hand gives them, or a log, which does not hold its commands.

    Raises:
        ObservationError: If a hand cannot give some: all of them, each with its reason, and what it can give.
    """
    result, problems = [], []
    for planned in plan.observations:
        try:
            is_joint = planned.type in PROPRIOCEPTION
            result.append(_joint_term(plan, planned, is_log) if is_joint else _hand_term(plan, planned, contact_threshold))
        except ObservationError as error:
            problems.append(f"  {_label(planned)}: {error}")
    if problems:
        raise ObservationError("\n".join(["an XHand1 cannot give these observations:", *problems, _GIVES]))
    return tuple(result)


def warn_of_noise(plan: Plan) -> None:
    """Warn that the noise of observed sensors is not added to a real hand's values."""
    observed = [plan.sensor_of(term.reading) for term in plan.observations if term.reading not in (None, *PROPRIOCEPTION)]
    noisy = sorted({sensor.sensor for sensor in observed if sensor.noise is not None})
    if noisy:
        warnings.warn(f"the noise of {', '.join(noisy)} is simulated: it is not added to a hand's values", stacklevel=3)


def finger_of(body: str) -> int | None:
    """Return which fingertip a body is, of either hand and whatever stands before its name; None if it is none."""
    return next((i for i, name in enumerate(TIP_BODIES) if body.endswith((f"right_hand_{name}", f"left_hand_{name}"))), None)


def _label(planned: PlannedObservation) -> str:
    of = f" of {planned.reading}" if planned.reading not in (None, *PROPRIOCEPTION) else ""
    return f"{planned.group}[{planned.index}] {planned.type}{of}"


def _hand_term(plan: Plan, planned: PlannedObservation, contact_threshold: float | None) -> HandTerm:
    if planned.type == "none" or planned.type in HAND_ONLY:
        return HandTerm(planned)
    if planned.type not in ("agg_force", "agg_bool"):
        raise ObservationError("it has no such reading of links and taxels as the robot file has them")
    assert planned.reading is not None
    sensor = plan.sensor_of(planned.reading)
    fingers, history = _fingers(plan, sensor), sensor.history
    if planned.type == "agg_bool" and contact_threshold is None:
        raise ObservationError("its calibration has no `contact_threshold`, the force above which a fingertip is in contact")
    if history is not None and history.reduce not in _KEPT:
        raise ObservationError(f"`history` with `reduce: {history.reduce}` is not done; expected {' or '.join(_KEPT)}")
    steps = history.length if history is not None and history.reduce == "stack" else 1
    return HandTerm(planned, fingers, tuple("xyz".index(axis) for axis in planned.axes), steps, sensor.period)


def _joint_term(plan: Plan, planned: PlannedObservation, is_log: bool) -> HandTerm:
    """Return an observation of the hand's joints or last commands."""
    if planned.type == "joint_effort":
        raise ObservationError("it reports each drive's current as a raw number, and no torque")
    if planned.type == "last_action" and is_log:
        raise ObservationError("a log does not hold the hand's commands")
    rows = plan.inputs.actuators if planned.type == "last_action" else plan.inputs.joints
    if planned.constants:
        rows = tuple(rows[i] for i in plan.arrays[f"observations/{planned.group}/{planned.index}/rows"])
    if planned.type == "last_action":
        model = scene_model(plan.scene)
        try:
            actuator_id = JointControls.of_model(model).actuator_id.tolist()
        except MotionError as error:
            raise ObservationError(str(error)) from error
        return HandTerm(planned, joints=tuple(actuator_id.index(model.actuator(name).id) for name in rows))
    joints = []
    for name in rows:
        if (joint := joint_of(name)) is None:
            raise ObservationError(f'it has no joint "{name}"')
        joints.append(joint)
    return HandTerm(planned, joints=tuple(joints))


def _fingers(plan: Plan, sensor: PlannedSensor) -> tuple[int, ...]:
    links = plan.layout_of(sensor).links
    fingers = [finger_of(link.body) for link in links]
    bare_links = [link.name for link, finger in zip(links, fingers, strict=True) if finger is None]
    if bare_links:
        raise ObservationError(f'"{sensor.sensor}" is on {", ".join(bare_links)}, where it has no sensor')
    finger_ids = [finger for finger in fingers if finger is not None]
    twice = sorted({FINGERS[finger] for finger in finger_ids if finger_ids.count(finger) > 1})
    if twice:
        raise ObservationError(f'"{sensor.sensor}" has several links on one fingertip: {", ".join(twice)}')
    sides = {link.body.split("_hand_")[0].endswith("right") for link in links}
    if len(sides) > 1:
        raise ObservationError(f'"{sensor.sensor}" is on two hands')
    return tuple(finger_ids)


class HandObserver:
    """Observes one hand for a module."""

    def __init__(self, touch: TactileModule, calibration: Calibration, control_step: float, *, is_log: bool = False):
        self.terms = hand_terms(touch.plan, calibration.contact_threshold, is_log)
        self._like = torch.empty(0, dtype=touch.dtype, device=touch.device)
        self._threshold = calibration.contact_threshold
        self._pasts = [_Past(term, control_step, touch.dtype) for term in self.terms]
        wants_action = any(term.planned.type == "last_action" for term in self.terms)
        self._controls = JointControls.of_model(scene_model(touch.plan.scene)) if wants_action else None
        self._action: Tensor | None = None

    def note(self, control: Control) -> None:
        """Take note of controls that were given, by actuator, (actuator,) or (1, actuator) [rad]; None: the last still hold."""
        if control is not None and self._controls is not None:
            self._action = torch.from_numpy(self._controls.targets(control_array(control))).unsqueeze(0)

    def observe(self, sample: HandSample) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the observation groups. To be called once per control step, as sensors may remember their last samples."""
        groups: dict[str, list[Tensor]] = {}
        if self._action is None:
            self._action = sample.joint_pos
        for term, past in zip(self.terms, self._pasts, strict=True):
            features = self._features(term, sample, self._action).to(self._like)
            groups.setdefault(term.planned.group, []).append(past.push(features))
        return {group: torch.cat(parts, dim=1) for group, parts in groups.items()}

    def reset(self) -> None:
        """Forget the last samples and the last action."""
        self._action = None
        for past in self._pasts:
            past.reset()

    def _features(self, term: HandTerm, sample: HandSample, action: Float[Tensor, "env joint"]) -> Tensor:
        type_, fingers, joints = term.planned.type, list(term.fingers), list(term.joints)
        if type_ in ("joint_pos", "joint_vel"):
            return (sample.joint_pos if type_ == "joint_pos" else sample.joint_vel)[:, joints]
        if type_ == "last_action":
            return action[:, joints]
        if type_ == "agg_force":
            return sample.tip_force[:, fingers][:, :, list(term.axes)].transpose(1, 2).flatten(1)
        if type_ == "agg_bool":
            assert self._threshold is not None
            return sample.tip_force[:, fingers].norm(dim=-1) > self._threshold
        if type_ == "taxel_counts":
            return sample.taxel_counts.permute(0, 3, 1, 2).flatten(1)
        if type_ == "taxel_saturated":
            return sample.is_taxel_saturated.flatten(1)
        return sample.tip_force.new_empty((len(sample.tip_force), 0))


class _Past:
    """The samples of one observation: taken when the sensor's rate says so, held until the next, stacked as its history says.

    The module's own arithmetic, in its dtype, says when a sample is due: see `clock.Clock.now` and `reading.read`.
    """

    def __init__(self, term: HandTerm, control_step: float, dtype: torch.dtype):
        self._steps, self._period = term.steps, term.period
        self._dt = torch.tensor(control_step, dtype=dtype)
        self.reset()

    def push(self, features: Float[Tensor, "env feature"]) -> Float[Tensor, "env steps_feature"]:
        """Take the present features, and return the observed ones."""
        if not self._last:
            self._last = [features] * self._steps
        else:
            is_due = not self._period or bool(self._phase + 1.5 * self._dt >= self._period)
            self._last = [*self._last[1:], features if is_due else self._last[-1]]
            since = self._phase + self._dt
            whole = torch.floor((since + 0.5 * self._dt) / self._period).clamp(min=0) if self._period else 0.0
            self._phase = since - whole * self._period
        return torch.cat(self._last, dim=1)

    def reset(self) -> None:
        self._last: Sequence[Tensor] = []
        self._phase = torch.zeros_like(self._dt)


class HandConnection(Connection):
    """A connection to an XHand1, or to the log of one."""

    def __init__(self, source: HandSource, observer: HandObserver, actuators: JointControls | None, name: str = ""):
        """Connect a hand that its observer observes.

        `actuators` are those whose controls are its joint angles; without them controls go nowhere, and a warning says once
        that `name` was connected for reading alone.
        """
        super().__init__(source)
        self._hand, self._observer, self._actuators, self._name = source, observer, actuators, name

    @property
    def is_over(self) -> bool:
        return self._hand.is_over

    @property
    def age_s(self) -> float | None:
        return self._hand.age_s

    def read(self) -> dict[str, Float[Tensor, "env feature"]]:
        return self._observer.observe(self._hand.sample())

    def send(self, control: Control) -> None:
        """Send the joints to the controls' targets, and record the controls after the step.

        Raises:
            MotionError: If there are not as many controls as joints.
        """
        target = None
        if control is not None and self._actuators is not None:
            target = self._actuators.targets(control_array(control))
        elif control is not None and self._name:
            problem = f"{self._name} was connected for reading alone: its controls go nowhere"
            warnings.warn(f"{problem}; to move it, connect with motion=MotionLimits(...)", stacklevel=3)
            self._name = ""
        self._hand.step(target)
        self._observer.note(control)

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Restart the hand, passive, or the log; without environments, the last observation stays."""
        if env_ids is None or is_chosen(env_ids):
            super().reset(env_ids)

    def restart(self, env_ids: EnvIds | None) -> None:
        self._hand.reset(env_ids)
        self._observer.reset()

    def resume(self) -> None:
        self._hand.resume()


def moved_joints(touch: TactileModule, motion: MotionLimits | None) -> JointControls | None:
    """Return the actuators of a hand's joints, if it may move.

    Raises:
        MotionError: If the scene's actuators are not the hand's, or the limits are beyond the robot file's.
    """
    if motion is None:
        return None
    model = scene_model(touch.plan.scene)
    ranges = model.jnt_range[joint_ids(model)]
    for name, lower, upper, (least, largest) in zip(JOINTS, motion.lower, motion.upper, ranges, strict=True):
        if lower < least - ROUNDING or upper > largest + ROUNDING:
            problem = f"{name}: limits from {lower:g} to {upper:g} rad"
            raise MotionError(f"{problem}, expected them within the robot file's {least:g} to {largest:g}")
    return JointControls.of_model(model)
