"""Proprioception: joint positions, velocities and efforts, and the last action; readings that no sensor makes.

Each is a field of `SceneState` and, where an observation asks for it, a reading of the same name, (env, joint, 1) or (env,
actuator, 1), whose rows are those that `touch.inputs.joints` or `touch.inputs.actuators` lists.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from tgdsl.fields.models import SpecModel


@dataclass(frozen=True)
class ProprioceptiveReading:
    """A reading of a robot's joints or actuators.

    Attributes:
        rows: What it has a row for each of.
        channel: Name of the reading's only channel.
        units: Unit of a hinge, and of a slide.
    """

    rows: Literal["joint", "actuator"]
    channel: str
    units: tuple[str, str]


PROPRIOCEPTION = {
    "joint_pos": ProprioceptiveReading("joint", "position", ("rad", "m")),
    "joint_vel": ProprioceptiveReading("joint", "velocity", ("rad/s", "m/s")),
    "joint_effort": ProprioceptiveReading("joint", "effort", ("N·m", "N")),
    "last_action": ProprioceptiveReading("actuator", "control", ("control", "control")),
}
"""By name: that of the observation type, of the field of `SceneState` and of the reading, which no sensor may have."""


class JointObservation(SpecModel):
    """What all types have in common that observe a robot's joints or actuators."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Names or shell wildcards of hinges and slides; default: the robot's actuated joints, in the order of the actuators.

    They stand in the order of this list; what a wildcard matches in the order of the actuators, then of the model.
    """


class JointPosObservation(JointObservation):
    """Position of each joint [rad; slides: m]."""

    type: Literal["joint_pos"]
    """Position of each joint [rad; slides: m]."""


class JointVelObservation(JointObservation):
    """Velocity of each joint [rad/s; slides: m/s]."""

    type: Literal["joint_vel"]
    """Velocity of each joint [rad/s; slides: m/s]."""


class JointEffortObservation(JointObservation):
    """What the actuators exert on each joint [N·m; slides: N]."""

    type: Literal["joint_effort"]
    """What the actuators exert on each joint [N·m; slides: N]."""


class LastActionObservation(JointObservation):
    """Control that was last given to each actuator, in its own unit; with `joints`, to the actuators of these."""

    type: Literal["last_action"]
    """Control that was last given to each actuator, in its own unit; with `joints`, to the actuators of these."""


JointSpec = JointPosObservation | JointVelObservation | JointEffortObservation | LastActionObservation
"""Any of them."""
