"""From the knobs of a sensor's taxels to constants and memory: a stage that no taxel has is left out.

Shapes: `row` rows of the reading, `channel` its channels, `end` lowest and highest value of what is drawn at reset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import LowerError, did_you_mean
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.fields import ALL, quantity, range_of
from tgdsl.sensors.noise.spec import Knobs
from tgdsl.sensors.noise.stage import Stage
from tgdsl.sensors.noise.stages import draws_of, known_stages


@dataclass(frozen=True, eq=False)
class LoweredNoise:
    """Noise, ready to be planned.

    Attributes:
        terms: Names of the stages there are.
        constants: Their constants: (channel or 1, row or 1), or (end, …) where an environment draws its own; and kernels.
        memory: Names of what is carried from one call to the next, and for how long each call is held [s]; 0: the last alone.
        radius: Largest disturbance of a radius [m].
        streams: What random numbers are drawn for.
        needs_dt: Whether the time since the last call is needed.
    """

    terms: tuple[str, ...]
    constants: Mapping[str, np.ndarray]
    memory: Mapping[str, float]
    radius: float
    streams: tuple[int, ...]
    needs_dt: bool


def lower_noise(
    knobs: Sequence[Knobs], which: Int[np.ndarray, " row"], channels: Sequence[str], layout: Layout
) -> LoweredNoise:
    """Lower a sensor's noise.

    Args:
        knobs: The different sets of knobs that its rows have.
        which: Which of them each row has.
        channels: Names of the signal's channels.
        layout: The sensor's taxels.

    Raises:
        LowerError: If a knob names a quantity that the reading does not have.
    """
    terms: list[str] = []
    constants: dict[str, np.ndarray] = {}
    memory: dict[str, float] = {}
    streams: set[int] = set()
    stages = known_stages()
    needs_dt = False
    for stage in stages:
        tables = [_table(stage, own, channels) for own in knobs]
        values = {name: np.stack([table[name] for table in tables], axis=-1)[..., which] for name in stage.numbers}
        if not (active := stage.active(values)):
            continue
        own = stage.constants(values, layout)
        terms += active
        constants |= own
        memory |= dict.fromkeys(stage.remembers(active), stage.past(values))
        streams |= set(stage.purposes(own))
        needs_dt |= stage.needs_dt
    if any(constants[name].ndim == 3 for name in draws_of(stages).keys() & constants.keys()):
        streams.add(random.PARAMETER)
    radius = float(constants["radius_noise"].max()) if "radius_noise" in terms else 0.0
    return LoweredNoise(tuple(terms), constants, memory, radius, tuple(sorted(streams)), needs_dt)


def _table(stage: Stage, knobs: Knobs, channels: Sequence[str]) -> dict[str, Float[np.ndarray, "end channel"]]:
    """Return the values of a stage's numbers for each channel."""
    known = list(dict.fromkeys(quantity(channel) for channel in channels))
    result = {}
    for name, value in stage.values_of(knobs).items():
        for own in () if isinstance(value, tuple) else value:
            if own != ALL and own not in known:
                problem = f'"{stage.numbers[name].knob or name}" names "{own}", which this sensor does not read'
                raise LowerError(problem, field="noise", hint=did_you_mean(own, known, "quantities"))
        result[name] = np.array([range_of(value, channel) for channel in channels]).T
    return result
