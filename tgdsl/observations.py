"""Observations: what a policy reads, made of readings by light post-processing.

Each type takes one sensor's reading (env, taxel, channel) and gives features (env, feature), flattened channel-major: all
taxels (or links) of the first channel, then of the second. "Per link" means one value for each link that carries the sensor,
in the order of the robot's bodies.

Source of the types and their constants: Chung et al., *Tactile Genesis*, appendix, "Tactile Observation Types".

Shapes: `env` environments, `taxel` taxels of the sensor, `link` links that carry it.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, StrictInt
from torch import Tensor

from tgdsl.fields import Positive, SpecModel
from tgdsl.layout import Layout


class _Of(SpecModel):
    of: str
    """The sensor that is observed."""


class BoolObservation(_Of):
    """Contact bit per taxel, of a `contact` sensor."""

    type: Literal["bool"]
    """Contact bit per taxel."""


class AggBoolObservation(_Of):
    """Contact bit per link: whether more than a number of its taxels are in contact; of a `contact` sensor."""

    type: Literal["agg_bool"]
    """Contact bit per link."""
    more_than: Annotated[StrictInt, Field(ge=0)] = 2
    """Taxels that must be exceeded."""


class DepthObservation(_Of):
    """Depth per taxel [m], of a `contact_depth` sensor."""

    type: Literal["depth"]
    """Depth per taxel [m]."""


class AggForceObservation(_Of):
    """Force per link estimated as scale · P · Σ depth · normal, of a `contact_depth` sensor."""

    type: Literal["agg_force"]
    """Depths summed along the probe normals, per link."""
    scale: Positive = 1e4
    """Factor from summed depth to the unit of the hand's aggregate force [unit/m]."""
    axes: Literal["xyz", "zyx"] = "zyx"
    """Order of the link-frame axes; `zyx` is that of the XHand1's aggregate pressure."""


class ForceObservation(_Of):
    """Force per taxel [N], link frame, of a `kinematic_taxel` sensor."""

    type: Literal["force"]
    """Force per taxel [N]."""


class ForceTorqueObservation(_Of):
    """Force [N] and torque [N·m] per taxel, link frame, of a `kinematic_taxel` sensor."""

    type: Literal["force_torque"]
    """Force [N] and torque [N·m] per taxel."""


ObservationSpec = Annotated[
    BoolObservation | AggBoolObservation | DepthObservation | AggForceObservation | ForceObservation | ForceTorqueObservation,
    Field(discriminator="type"),
]

WANTED_CHANNELS: dict[str, tuple[str, ...]] = {
    "bool": ("contact",),
    "agg_bool": ("contact",),
    "depth": ("depth",),
    "agg_force": ("depth",),
    "force": ("force_x", "force_y", "force_z"),
    "force_torque": ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z"),
}
"""Channels of the sensor's reading that each observation type takes, in order."""


def lower(spec: ObservationSpec, layout: Layout) -> dict[str, np.ndarray]:
    """Return the folded operator of an aggregate: a matrix (taxel, feature), and the threshold of a count."""
    num_links = len(layout.links)
    belongs = (layout.link_id[:, None] == np.arange(num_links)).astype(np.float64)
    if isinstance(spec, AggBoolObservation):
        return {"operator": belongs, "more_than": np.asarray(float(spec.more_than))}
    if isinstance(spec, AggForceObservation):
        axes = ["xyz".index(axis) for axis in spec.axes]
        per_axis = [spec.scale * layout.normal[:, axis, None] * belongs for axis in axes]
        return {"operator": np.concatenate(per_axis, axis=1)}
    return {}


def num_features(type_: str, num_taxels: int, num_links: int) -> int:
    """Return how many features an observation type gives."""
    if type_ == "agg_bool":
        return num_links
    if type_ == "agg_force":
        return 3 * num_links
    return len(WANTED_CHANNELS[type_]) * num_taxels


def observe(
    type_: str,
    reading: Float[Tensor, "env taxel channel"],
    channels: tuple[int, ...],
    constants: dict[str, Tensor],
) -> Float[Tensor, "env feature"]:
    """Return the features of one observation.

    Args:
        type_: The observation type.
        reading: The sensor's reading.
        channels: Indices of the wanted channels in the reading.
        constants: The arrays of `lower`, as tensors.
    """
    if type_ == "agg_bool":
        count = reading[:, :, channels[0]] @ constants["operator"]
        bit = (count > constants["more_than"]).to(reading.dtype)
        return torch.where(count.isnan(), count, bit)
    if type_ == "agg_force":
        return reading[:, :, channels[0]] @ constants["operator"]
    by_channel = reading.transpose(1, 2)
    if channels != tuple(range(reading.shape[2])):
        by_channel = by_channel[:, list(channels)]
    return by_channel.flatten(1)
