"""Observations: what a policy reads, made of readings by light post-processing.

Each type takes one reading (env, row, channel) and gives features (env, feature), flattened channel-major: all taxels (or
links) of the first channel, then of the second. "Per link" means one value for each link that carries the sensor, in the order
of the robot's bodies; `link_bool` and `link_force` have one for each body, for that is what the solver knows.

`taxel_counts` and `taxel_saturated` are what an XHand1's own fingertips say, taxel by taxel: no simulation has them.

Source of the types and their constants: Chung et al., *Tactile Genesis*, appendix, "Tactile Observation Types".

Shapes: `env` environments, `taxel` taxels of the sensor, `link` links that carry it, `row` taxels or bodies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, StrictInt
from torch import Tensor

from tgdsl.errors import ObservationError
from tgdsl.fields.models import Positive, Quantity, SpecModel
from tgdsl.layout.layout import Layout


@dataclass(frozen=True)
class ProprioceptiveReading:
    """A reading of a robot's joints or actuators."""

    rows: Literal["joint", "actuator"]  # what it has a row for each of
    channel: str  # name of the reading's only channel
    units: tuple[str, str]  # unit of a hinge, and of a slide


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


JointSpec = JointPosObservation | JointVelObservation | JointEffortObservation | LastActionObservation  # any of them


class NoneObservation(SpecModel):
    """No touch at all: nothing is added to the group; the policy that others are compared with."""

    type: Literal["none"]
    """Nothing."""


class OfReading(SpecModel):
    """What all types have in common that observe a reading."""

    of: str
    """The reading that is observed: a sensor's name, `<sensor>/clean`, or a report such as `<sensor>/missed`."""


class ReadingObservation(OfReading):
    """Any reading as it is: all its channels, or some of them."""

    type: Literal["reading"]
    """Any reading as it is."""
    channels: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Names or shell wildcards of channels, such as `[distance_cube]` or `["nearest_*"]`; default: all of them.

    They stand in the order of this list; what a wildcard matches in the order of the reading.
    """


class BoolObservation(OfReading):
    """Contact bit per taxel, of a `contact` sensor."""

    type: Literal["bool"]
    """Contact bit per taxel."""


class AggBoolObservation(OfReading):
    """Contact bit per link: whether more than a number of its taxels are in contact; of a `contact` sensor."""

    type: Literal["agg_bool"]
    """Contact bit per link."""
    more_than: Annotated[StrictInt, Field(ge=0)] = 2
    """Taxels that must be exceeded."""


class DepthObservation(OfReading):
    """Depth per taxel [m], of a `contact_depth` sensor."""

    type: Literal["depth"]
    """Depth per taxel [m]."""


class AggForceObservation(OfReading):
    """Force per link estimated as scale · P · Σ depth · normal, of a `contact_depth` sensor."""

    type: Literal["agg_force"]
    """Depths summed along the probe normals, per link."""
    scale: Positive = 1e4
    """Factor from summed depth to the unit of the hand's aggregate force [unit/m]."""
    axes: Literal["xyz", "zyx"] = "zyx"
    """Order of the link-frame axes; `zyx` is that of the XHand1's aggregate pressure."""


class CopObservation(OfReading):
    """Force on each link [N] and its centre of pressure [m], link frame, of a `kinematic_taxel` or `force_taxel` sensor.

    The force is F = Σ f_j, the centre c = Σ p_j x_j / Σ p_j, with f_j the force on taxel j, x_j its position, n_j its outward
    normal and p_j = max(0, −f_j · n_j). Where Σ p_j is at most `threshold`, c = 0.
    """

    type: Literal["cop"]
    """Force [N] and centre of pressure [m] per link."""
    threshold: Annotated[float, Quantity("force", ge=0.0)] = 0.0
    """Normal force of a link up to which it has no centre of pressure [N]."""


class ForceObservation(OfReading):
    """Force per taxel [N], link frame, of a `kinematic_taxel`, `force_taxel` or `proximity` sensor."""

    type: Literal["force"]
    """Force per taxel [N]."""


class ForceTorqueObservation(OfReading):
    """Force [N] and torque [N·m] per taxel, link frame, of a `kinematic_taxel` sensor."""

    type: Literal["force_torque"]
    """Force [N] and torque [N·m] per taxel."""


class ElastomerObservation(OfReading):
    """Displacement of each marker [m], link frame, of an `elastomer` sensor."""

    type: Literal["elastomer"]
    """Displacement of each marker [m]."""


class ProximityObservation(OfReading):
    """Force and torque signal per taxel [N, N·m], link frame, of a `proximity` sensor."""

    type: Literal["proximity"]
    """Force and torque signal per taxel."""


class LinkBoolObservation(OfReading):
    """Contact bit per body, as the solver has it, of a `link_contact` sensor."""

    type: Literal["link_bool"]
    """Contact bit per body."""


class LinkForceObservation(OfReading):
    """The solver's force on each body [N], in the body's frame, of a `link_contact` sensor."""

    type: Literal["link_force"]
    """The solver's force on each body [N]."""


class TaxelCountsObservation(SpecModel):
    """Raw force of each of an XHand1's own taxels [counts]; from hardware alone.

    Flattened channel-major: x of the thumb's 120 taxels in the order of the wire, then of the index, middle, ring and little
    finger's; then y, then z. Neither tare nor calibration is applied. Where these taxels sit is not published.
    """

    type: Literal["taxel_counts"]
    """Raw force of each of the hand's own taxels [counts]; from hardware alone."""


class TaxelSaturatedObservation(SpecModel):
    """Whether a component of each of an XHand1's own taxels is at the end of its range; from hardware alone.

    120 bits of the thumb in the order of the wire, then of the index, middle, ring and little finger.
    """

    type: Literal["taxel_saturated"]
    """Whether each of the hand's own taxels is at the end of its range; from hardware alone."""


ReadingSpec = (
    ReadingObservation
    | BoolObservation
    | AggBoolObservation
    | DepthObservation
    | AggForceObservation
    | CopObservation
    | ForceObservation
    | ForceTorqueObservation
    | ElastomerObservation
    | ProximityObservation
    | LinkBoolObservation
    | LinkForceObservation
)
"""Observations of a sensor's reading."""
ObservationSpec = Annotated[
    NoneObservation | ReadingSpec | JointSpec | TaxelCountsObservation | TaxelSaturatedObservation, Field(discriminator="type")
]

_FORCE, _TORQUE, _MARKER = (tuple(f"{name}_{axis}" for axis in "xyz") for name in ("force", "torque", "displacement"))
WANTED: dict[str, tuple[tuple[str, ...], str]] = {
    "bool": (("contact",), "taxel"),
    "agg_bool": (("contact",), "taxel"),
    "depth": (("depth",), "taxel"),
    "agg_force": (("depth",), "taxel"),
    "cop": (_FORCE, "taxel"),
    "force": (_FORCE, "taxel"),
    "force_torque": (_FORCE + _TORQUE, "taxel"),
    "elastomer": (_MARKER, "taxel"),
    "proximity": (_FORCE + _TORQUE, "taxel"),
    "link_bool": (("contact",), "body"),
    "link_force": (_FORCE, "body"),
}
"""Channels of a reading that an observation type takes, in order, and what the reading has rows of; `reading` takes any."""

HAND_ONLY = {"taxel_counts": 5 * 120 * 3, "taxel_saturated": 5 * 120}
"""Observation types of the real hand alone, and how many features each has."""


def lower(spec: ObservationSpec, layout: Layout) -> dict[str, np.ndarray]:
    """Return the folded operator of an aggregate: matrices (taxel, feature), thresholds, normals (axis, taxel)."""
    num_links = len(layout.links)
    belongs = (layout.link_id[:, None] == np.arange(num_links)).astype(np.float64)
    if isinstance(spec, AggBoolObservation):
        return {"operator": belongs, "more_than": np.asarray(float(spec.more_than))}
    if isinstance(spec, AggForceObservation):
        axes = ["xyz".index(axis) for axis in spec.axes]
        per_axis = [spec.scale * layout.normal[:, axis, None] * belongs for axis in axes]
        return {"operator": np.concatenate(per_axis, axis=1)}
    if isinstance(spec, CopObservation):
        moment = np.concatenate([layout.pos[:, axis, None] * belongs for axis in range(3)], axis=1)
        return {"operator": belongs, "moment": moment, "normal": layout.normal.T, "threshold": np.asarray(spec.threshold)}
    return {}


def hand_only_error(group: str, index: int, type_: str) -> ObservationError:
    """Return the error of an observation that only the real hand has."""
    problem = f'observation {group}[{index}] is "{type_}", which only a real XHand1 has'
    return ObservationError(f'{problem}, and no simulation; read one with tgdsl.connect(touch, "xhand1")')


def num_features(type_: str, num_channels: int, num_rows: int, num_links: int) -> int:
    """Return how many features an observation type gives of one call's reading."""
    if type_ == "agg_bool":
        return num_links
    if type_ == "agg_force":
        return 3 * num_links
    if type_ == "cop":
        return 6 * num_links
    return num_channels * num_rows


def observe(
    type_: str,
    reading: Float[Tensor, "env row channel"],
    channels: tuple[int, ...],
    constants: dict[str, Tensor],
) -> Float[Tensor, "env feature"]:
    """Return the features of one observation.

    Args:
        type_: The observation type.
        reading: The reading.
        channels: Indices of the wanted channels in the reading.
        constants: The arrays of `lower`, as tensors; `rows`, where only some rows are wanted, and which.
    """
    if type_ == "agg_bool":
        count = reading[:, :, channels[0]] @ constants["operator"]
        bit = (count > constants["more_than"]).to(reading.dtype)
        return torch.where(count.isnan(), count, bit)
    if type_ == "agg_force":
        return reading[:, :, channels[0]] @ constants["operator"]
    if type_ == "cop":
        x, y, z = force = [reading[:, :, channel] for channel in channels]
        normal_x, normal_y, normal_z = constants["normal"].unbind()
        pressing = (-(x * normal_x + y * normal_y + z * normal_z)).clamp(min=0)
        total = pressing @ constants["operator"]
        is_free = (total <= constants["threshold"]).repeat(1, 3)
        centre = pressing @ constants["moment"] / torch.where(is_free, 1.0, total.repeat(1, 3))
        return torch.cat([*(part @ constants["operator"] for part in force), torch.where(is_free, 0.0, centre)], dim=1)
    if "rows" in constants:
        reading = reading.index_select(1, constants["rows"])
    if channels == tuple(range(reading.shape[2])):
        return reading.transpose(1, 2).flatten(1)
    return torch.cat([reading[:, :, channel] for channel in channels], dim=1)
