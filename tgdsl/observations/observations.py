"""Observations: what a policy reads, made of readings by light post-processing.

Each type takes one reading (env, row, channel) and gives features (env, feature), flattened channel-major: all taxels (or
links) of the first channel, then of the second. "Per link" means one value for each link that carries the sensor, in the order
of the robot's bodies; `link_bool` and `link_force` have one for each body, for that is what the solver knows.

`taxel_counts` and `taxel_saturated` are what an XHand1's own fingertips say, taxel by taxel: no simulation has them.

Source of the types and their constants: Chung et al., *Tactile Genesis*, appendix, "Tactile Observation Types".

Shapes: `env` environments, `taxel` taxels of the sensor, `link` links that carry it, `row` taxels or bodies.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, StrictInt
from torch import Tensor

from tgdsl.errors import ObservationError, TgdslError
from tgdsl.fields.models import Positive, Quantity, SpecModel
from tgdsl.files.plugins import Registry
from tgdsl.layout.layout import Layout

_FORCE, _TORQUE = (tuple(f"{name}_{axis}" for axis in "xyz") for name in ("force", "torque"))


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


class Observation(SpecModel):
    """Base of all types."""

    @property
    def type_name(self) -> str:
        """The type's word in documents."""
        return self.type  # type: ignore[attr-defined]

    @staticmethod
    def observe(
        reading: Float[Tensor, "env row channel"], channels: tuple[int, ...], constants: Mapping[str, Tensor]
    ) -> Float[Tensor, "env feature"]:
        """Return the features of a reading: of some of its channels, by index, with the arrays of `lower` as tensors."""
        if "rows" in constants:
            reading = reading.index_select(1, constants["rows"])
        if channels == tuple(range(reading.shape[2])):
            return reading.transpose(1, 2).flatten(1)
        return torch.cat([reading[:, :, channel] for channel in channels], dim=1)


class JointObservation(Observation):
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


class NoneObservation(Observation):
    """No touch at all: nothing is added to the group; the policy that others are compared with."""

    type: Literal["none"]
    """Nothing."""


LinkFeature = tuple[str, str, str, float]
"""Name, unit, frame and scale of a feature: see `tgdsl.rl.task.Features`."""


class OfReading(Observation):
    """What all types have in common that observe a reading."""

    of: str
    """The reading that is observed: a sensor's name, `<sensor>/clean`, or a report such as `<sensor>/missed`."""
    needs: ClassVar[tuple[str, ...]] = ()  # channels of the reading that it takes, in order
    rows: ClassVar[str] = "taxel"  # what the reading has rows of
    task_kind: ClassVar[str] = ""  # kind of the sensor that tasks with `touch: <type>` take; "": tasks do not have it

    def lower(self, layout: Layout) -> dict[str, np.ndarray]:
        """Return the constants of `observe`."""
        return {}

    def num_features(self, num_channels: int, num_rows: int, num_links: int) -> int:
        """Return how many features `observe` gives of one call's reading."""
        return num_channels * num_rows


class PerLink(OfReading):
    """What all types have in common that give numbers of links; by default sums over the taxels of each."""

    @property
    def features(self) -> tuple[LinkFeature, ...]:
        """The features of a link, in order."""
        raise NotImplementedError

    def lower(self, layout: Layout) -> dict[str, np.ndarray]:
        return {"operator": (layout.link_id[:, None] == np.arange(len(layout.links))).astype(np.float64)}

    def num_features(self, num_channels: int, num_rows: int, num_links: int) -> int:
        return len(self.features) * num_links

    @staticmethod
    def observe(reading: Tensor, channels: tuple[int, ...], constants: Mapping[str, Tensor]) -> Tensor:
        return reading[:, :, channels[0]] @ constants["operator"]


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
    needs = ("contact",)
    task_kind = "contact"


class AggBoolObservation(PerLink):
    """Contact bit per link: whether more than a number of its taxels are in contact; of a `contact` sensor."""

    type: Literal["agg_bool"]
    """Contact bit per link."""
    more_than: Annotated[StrictInt, Field(ge=0)] = 2
    """Taxels that must be exceeded."""
    needs = ("contact",)
    task_kind = "contact"

    @property
    def features(self) -> tuple[LinkFeature, ...]:
        return ((f"contact of more than {self.more_than} taxels", "1", "", 1.0),)

    def lower(self, layout: Layout) -> dict[str, np.ndarray]:
        return super().lower(layout) | {"more_than": np.asarray(float(self.more_than))}

    @staticmethod
    def observe(reading: Tensor, channels: tuple[int, ...], constants: Mapping[str, Tensor]) -> Tensor:
        count = PerLink.observe(reading, channels, constants)
        bit = (count > constants["more_than"]).to(reading.dtype)
        return torch.where(count.isnan(), count, bit)


class DepthObservation(OfReading):
    """Depth per taxel [m], of a `contact_depth` sensor."""

    type: Literal["depth"]
    """Depth per taxel [m]."""
    needs = ("depth",)
    task_kind = "contact_depth"


class AggForceObservation(PerLink):
    """Force per link estimated as scale · P · Σ depth · normal, of a `contact_depth` sensor."""

    type: Literal["agg_force"]
    """Depths summed along the probe normals, per link."""
    scale: Positive = 1e4
    """Factor from summed depth to the unit of the hand's aggregate force [unit/m]."""
    axes: Literal["xyz", "zyx"] = "zyx"
    """Order of the link-frame axes; `zyx` is that of the XHand1's aggregate pressure."""
    needs = ("depth",)
    task_kind = "contact_depth"

    @property
    def features(self) -> tuple[LinkFeature, ...]:
        return tuple((f"sum of depth times normal, {axis}", "m", "link", self.scale) for axis in self.axes)

    def lower(self, layout: Layout) -> dict[str, np.ndarray]:
        normals, belongs = layout.normal[:, ["xyz".index(axis) for axis in self.axes]].T, super().lower(layout)["operator"]
        return {"operator": np.concatenate([self.scale * normal[:, None] * belongs for normal in normals], axis=1)}


class CopObservation(PerLink):
    """Force on each link [N] and its centre of pressure [m], link frame, of a `kinematic_taxel` or `force_taxel` sensor.

    The force is F = Σ f_j, the centre c = Σ p_j x_j / Σ p_j, with f_j the force on taxel j, x_j its position, n_j its outward
    normal and p_j = max(0, −f_j · n_j). Where Σ p_j is at most `threshold`, c = 0.
    """

    type: Literal["cop"]
    """Force [N] and centre of pressure [m] per link."""
    threshold: Annotated[float, Quantity("force", ge=0.0)] = 0.0
    """Normal force of a link up to which it has no centre of pressure [N]."""
    needs = _FORCE

    @property
    def features(self) -> tuple[LinkFeature, ...]:
        centre = ((f"centre of pressure, {axis}", "m", "link", 1.0) for axis in "xyz")
        return (*((name, "N", "link", 1.0) for name in self.needs), *centre)

    def lower(self, layout: Layout) -> dict[str, np.ndarray]:
        operator = super().lower(layout)["operator"]
        moment = np.concatenate([layout.pos[:, axis, None] * operator for axis in range(3)], axis=1)
        return {"operator": operator, "moment": moment, "normal": layout.normal.T, "threshold": np.asarray(self.threshold)}

    @staticmethod
    def observe(reading: Tensor, channels: tuple[int, ...], constants: Mapping[str, Tensor]) -> Tensor:
        x, y, z = force = [reading[:, :, channel] for channel in channels]
        normal_x, normal_y, normal_z = constants["normal"].unbind()
        pressing = (-(x * normal_x + y * normal_y + z * normal_z)).clamp(min=0)
        total = pressing @ constants["operator"]
        is_free = (total <= constants["threshold"]).repeat(1, 3)
        centre = pressing @ constants["moment"] / torch.where(is_free, 1.0, total.repeat(1, 3))
        return torch.cat([*(part @ constants["operator"] for part in force), torch.where(is_free, 0.0, centre)], dim=1)


class ForceObservation(OfReading):
    """Force per taxel [N], link frame, of a `kinematic_taxel`, `force_taxel` or `proximity` sensor."""

    type: Literal["force"]
    """Force per taxel [N]."""
    needs = _FORCE
    task_kind = "kinematic_taxel"


class ForceTorqueObservation(OfReading):
    """Force [N] and torque [N·m] per taxel, link frame, of a `kinematic_taxel` sensor."""

    type: Literal["force_torque"]
    """Force [N] and torque [N·m] per taxel."""
    needs = _FORCE + _TORQUE
    task_kind = "kinematic_taxel"


class ElastomerObservation(OfReading):
    """Displacement of each marker [m], link frame, of an `elastomer` sensor."""

    type: Literal["elastomer"]
    """Displacement of each marker [m]."""
    needs = ("displacement_x", "displacement_y", "displacement_z")
    task_kind = "elastomer"


class ProximityObservation(OfReading):
    """Force and torque signal per taxel [N, N·m], link frame, of a `proximity` sensor."""

    type: Literal["proximity"]
    """Force and torque signal per taxel."""
    needs = _FORCE + _TORQUE
    task_kind = "proximity"


class LinkBoolObservation(OfReading):
    """Contact bit per body, as the solver has it, of a `link_contact` sensor."""

    type: Literal["link_bool"]
    """Contact bit per body."""
    needs = ("contact",)
    rows = "body"


class LinkForceObservation(OfReading):
    """The solver's force on each body [N], in the body's frame, of a `link_contact` sensor."""

    type: Literal["link_force"]
    """The solver's force on each body [N]."""
    needs = _FORCE
    rows = "body"


class TaxelCountsObservation(Observation):
    """Raw force of each of an XHand1's own taxels [counts]; from hardware alone.

    Flattened channel-major: x of the thumb's 120 taxels in the order of the wire, then of the index, middle, ring and little
    finger's; then y, then z. Neither tare nor calibration is applied. Where these taxels sit is not published.
    """

    type: Literal["taxel_counts"]
    """Raw force of each of the hand's own taxels [counts]; from hardware alone."""


class TaxelSaturatedObservation(Observation):
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


def _wrong(model: object) -> str:
    if not (isinstance(model, type) and issubclass(model, Observation)):
        return f"found {model!r}, expected a subclass of tgdsl.observations.observations.OfReading"
    names = get_args(model.model_fields["type"].annotation) if "type" in model.model_fields else ()
    return "" if len(names) == 1 else f'{model.__name__} has no field `type: Literal["its_name"]`'


TYPES = Registry(
    group="tgdsl.observations",
    what="observation type",
    plural="observation types",
    own=get_args(get_args(ObservationSpec)[0]),
    wrong=_wrong,
    name_of=lambda model: get_args(model.model_fields["type"].annotation)[0],
)
register = TYPES.register


def types_of(names: Collection[str]) -> dict[str, type[Observation]]:
    """Return the types with these names; raise `TgdslError` if there is no such type."""
    types = TYPES.by_name()
    if missing := set(names) - types.keys():
        problem = f'the observation type "{min(missing)}" is not known; install its package'
        raise TgdslError(f"{problem}, or `tgdsl.observations.observations.register` it")
    return {name: types[name] for name in names}


HAND_ONLY = {"taxel_counts": 5 * 120 * 3, "taxel_saturated": 5 * 120}
"""Observation types of the real hand alone, and how many features each has."""


def hand_only_error(group: str, index: int, type_: str) -> ObservationError:
    """Return the error of an observation that only the real hand has."""
    problem = f'observation {group}[{index}] is "{type_}", which only a real XHand1 has'
    return ObservationError(f'{problem}, and no simulation; read one with tgdsl.connect(touch, "xhand1")')
