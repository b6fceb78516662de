"""Which observations a hand can give, and from which of its fingertips and joints: looked at before the hand is touched."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from tgdsl.errors import ObservationError
from tgdsl.observations.observations import HAND_ONLY
from tgdsl.observations.proprioception import PROPRIOCEPTION
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedObservation, PlannedSensor
from tgdsl.runtime.xhand1.motion import JointControls
from tgdsl.runtime.xhand1.wire.errors import MotionError
from tgdsl.runtime.xhand1.wire.payloads import FINGERS, JOINTS
from tgdsl.scene.scene import scene_model

TIP_BODIES = ("thumb_rota_link2", "index_rota_link2", "mid_link2", "ring_link2", "pinky_link2")
"""The fingertips' bodies, without the `right_hand_` or `left_hand_` that they have in robot files."""
_GIVES = (
    "it can give: none, agg_force and agg_bool of sensors whose links are fingertips, one per finger "
    f"(bodies {', '.join(f'*_hand_{name}' for name in TIP_BODIES)}), "
    "joint_pos and joint_vel of its own joints, last_action, taxel_counts, taxel_saturated"
)
_KEPT = ("stack", "last")


@dataclass(frozen=True)
class HandTerm:
    """One observation that a hand can give.

    Attributes:
        planned: The observation.
        fingers: Fingertips that it is of, in the order of the sensor's links.
        axes: Axes of an aggregate force, in order.
        steps: How many control steps are stacked, the oldest first.
        period: Time between samples [s]; 0: one at every control step.
        joints: Joints that it is of, by the hand's ids; of a `last_action`, those whose actuators it is of.
    """

    planned: PlannedObservation
    fingers: tuple[int, ...] = ()
    axes: tuple[int, ...] = ()
    steps: int = 1
    period: float = 0.0
    joints: tuple[int, ...] = ()

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
    """Warn that the noise of sensors that are observed is not added to what a real hand says."""
    observed = [plan.sensor_of(term.reading) for term in plan.observations if term.reading not in (None, *PROPRIOCEPTION)]
    noisy = sorted({sensor.sensor for sensor in observed if sensor.noise is not None})
    if noisy:
        problem = f"the noise of {', '.join(noisy)} is that of a simulated sensor"
        warnings.warn(f"{problem}: it is not added to what a hand says", stacklevel=3)


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
    fingers = _fingers(plan, sensor)
    if planned.type == "agg_bool" and contact_threshold is None:
        raise ObservationError("its calibration has no `contact_threshold`, the force above which a fingertip is in contact")
    if sensor.history is not None and sensor.history.reduce not in _KEPT:
        raise ObservationError(f"`history` with `reduce: {sensor.history.reduce}` is not done; expected {' or '.join(_KEPT)}")
    steps = sensor.history.length if sensor.history is not None and sensor.history.reduce == "stack" else 1
    return HandTerm(planned, fingers, tuple("xyz".index(axis) for axis in planned.axes), steps, sensor.period)


def _joint_term(plan: Plan, planned: PlannedObservation, is_log: bool) -> HandTerm:
    """Return an observation of the hand's joints or last commands."""
    if planned.type == "joint_effort":
        raise ObservationError("it reports each drive's current as a raw number, and no torque")
    if planned.type == "last_action" and is_log:
        raise ObservationError("a log does not hold what the hand was told")
    rows = plan.inputs.actuators if planned.type == "last_action" else plan.inputs.joints
    if planned.constants:
        rows = tuple(rows[i] for i in plan.arrays[f"observations/{planned.group}/{planned.index}/rows"])
    if planned.type != "last_action":
        return HandTerm(planned, joints=tuple(_joint_of(name) for name in rows))
    model = scene_model(plan.scene)
    try:
        actuator_id = JointControls.of_model(model).actuator_id.tolist()
    except MotionError as error:
        raise ObservationError(str(error)) from error
    return HandTerm(planned, joints=tuple(actuator_id.index(model.actuator(name).id) for name in rows))


def _joint_of(name: str) -> int:
    """Return which of the hand's joints one of the robot file is."""
    results = [i for i, joint in enumerate(JOINTS) if name == joint or name.endswith(f"_hand_{joint}")]
    if not results:
        raise ObservationError(f'it has no joint "{name}"')
    return results[0]


def _fingers(plan: Plan, sensor: PlannedSensor) -> tuple[int, ...]:
    links = plan.layout_of(sensor).links
    fingers = [finger_of(link.body) for link in links]
    others = [link.name for link, finger in zip(links, fingers, strict=True) if finger is None]
    if others:
        raise ObservationError(f'"{sensor.sensor}" is on {", ".join(others)}, where it has no sensor')
    known = [finger for finger in fingers if finger is not None]
    twice = sorted({FINGERS[finger] for finger in known if known.count(finger) > 1})
    if twice:
        raise ObservationError(f'"{sensor.sensor}" has several links on one fingertip: {", ".join(twice)}')
    sides = {link.body.split("_hand_")[0].endswith("right") for link in links}
    if len(sides) > 1:
        raise ObservationError(f'"{sensor.sensor}" is on two hands')
    return tuple(known)
