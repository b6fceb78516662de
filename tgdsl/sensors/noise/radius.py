"""Disturbed radii: R̃_j = max(0, R_j + ε_j), ε_j ~ U[−ρ, ρ] at each reading, before objects are felt [m]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, NamedTuple

import numpy as np
from torch import Tensor

from tgdsl.fields.models import Range, RangeOf, SpecModel, Usual
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.fields import ZERO
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.stage import NoMemory, Now, Number, Stage, uniform
from tgdsl.tensors.fusion import materialised


class RadiusKnobs(SpecModel):
    """Knob of the radius."""

    radius_noise: Annotated[Range, RangeOf("length", ge=0.0), Usual("length", high=0.1)] = ZERO
    """ρ, half-width of the uniform disturbance of each probe's radius, drawn at each reading [m]."""


class RadiusValues(NamedTuple):
    """Half-width of the disturbance [m]."""

    radius_noise: Tensor


class RadiusStage(Stage[RadiusValues, NoMemory]):
    """Disturbs radii by `shift`, and leaves the signal that follows from them as it is."""

    name = "radius_noise"
    Knobs = RadiusKnobs
    numbers = {"radius_noise": Number(0, unit=" m")}
    Values = RadiusValues

    def purposes(self, constants: Mapping[str, np.ndarray]) -> tuple[int, ...]:
        return (random.RADIUS,)

    def shift(self, values: RadiusValues, now: Now, like: Tensor) -> Tensor:
        """Return by how much each probe's radius is off (env, taxel) [m]."""
        share = materialised(uniform(now, random.RADIUS, 0, like))
        return values.radius_noise[:, 0] * (2 * share - 1)

    def reference_radius(self, radius: np.ndarray, call: ReferenceCall) -> np.ndarray:
        """Return this step's radii (row,) of probes whose own are given [m]."""
        disturbed = radius[:, None] + call.number("radius_noise") * (2 * call.uniform(random.RADIUS) - 1)
        return np.maximum(0, disturbed[:, 0])


RADIUS = RadiusStage()
