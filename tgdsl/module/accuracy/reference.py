"""A plan's first sensor by its kind's float64 reference.

Shapes: `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

import functools

import numpy as np

from tgdsl.module.state import SHAPES, SceneState
from tgdsl.plan.plan import Plan
from tgdsl.quantities.reference import References, ReferenceScene
from tgdsl.sensors.base import Kind, ReferenceContext, SensorSpec
from tgdsl.sensors.known import quantities_of
from tgdsl.sensors.noise.random import KIND, sensor_key
from tgdsl.sensors.noise.reference import words

Memory = dict[int, dict[str, np.ndarray]]
"""What a sensor remembers, by environment and name."""


class ReferenceModule:
    """A plan's first sensor, computed by the kind's float64 reference, environment by environment."""

    def __init__(self, plan: Plan, kind: Kind, spec: SensorSpec):
        self.plan = plan
        self.kind = kind
        self.spec = spec
        self.sensor = plan.sensors[0]
        self.layout = plan.layout_of(self.sensor)
        self.quantities = [quantity for quantity in quantities_of([kind]) if quantity.name in self.sensor.uses]
        self.memory: Memory = {}
        self.num_calls = 0

    def __call__(self, state: SceneState, shift: np.ndarray) -> tuple[np.ndarray, Memory]:
        """Return readings (env, *sample, row, channel) of a scene whose objects are shifted [m], and the memory after it."""
        assert state.body_pos is not None
        readings, memories = [], {}
        for env in range(state.body_pos.shape[0]):
            rest = {name: np.full(memory.shape, memory.rest) for name, memory in self.sensor.state.items()}
            memory, samples = self.memory.get(env, rest), []
            for i, part in enumerate([*state.substeps, state] if self.sensor.substeps else [state]):
                gathered, context = self.gathered(part, env, shift), self.context(state, i, env)
                reading, memory = self.kind.reference(self.spec, self.layout, gathered, context, memory)
                samples.append(reading)
            memories[env] = memory
            readings.append(
                np.concatenate([s if s.ndim == 3 else s[None] for s in samples]) if self.sensor.substeps else samples[0]
            )
        return np.stack(readings), memories

    def remember(self, memory: Memory) -> None:
        """Go on to the next call."""
        self.memory, self.num_calls = memory, self.num_calls + 1

    def context(self, state: SceneState, substep: int, env: int) -> ReferenceContext:
        """Return when the kind is called, all calls having been as long as this one, with the random numbers of seed 0."""
        dt, count = state.dt or 0.0, max(self.sensor.substeps, 1)
        time = 0.0 if self.num_calls == 0 else (self.num_calls - 1) * dt + (substep + 1) * dt / count
        call = sensor_key(0, self.sensor.sensor), env, self.num_calls * count + substep, KIND
        is_first = self.num_calls == 0 and substep == 0
        return ReferenceContext(dt / count, self.num_calls, substep, time, is_first, functools.partial(words, *call))

    def gathered(self, state: SceneState, env: int, shift: np.ndarray) -> References:
        """Return what the sensor asked for, in one environment."""
        inputs = self.plan.inputs
        fields = {name: value[env].double().numpy() for name in SHAPES if (value := getattr(state, name)) is not None}
        rows = slice(*self.sensor.rows)
        scene = ReferenceScene(self.layout, rows, self.plan.objects, inputs.bodies, inputs.pairs, fields, shift)
        parts, uses = self.plan.quantities, self.sensor.uses
        return References({q.request: q.reference(parts[q.name], uses[q.name], scene) for q in self.quantities})
