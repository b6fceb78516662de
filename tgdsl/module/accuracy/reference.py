"""A plan's sensor by its kind's float64 reference, and the distance of readings from it, at ties from the nearer side.

Shapes: `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from tgdsl.module.state import SHAPES, SceneState
from tgdsl.plan.plan import Plan
from tgdsl.quantities.reference import References, ReferenceScene
from tgdsl.sensors.base import AnySensorSpec, Kind, ReferenceContext
from tgdsl.sensors.known import quantities_of
from tgdsl.sensors.noise.random import KIND, sensor_key
from tgdsl.sensors.noise.reference import words
from tgdsl.sensors.upstream import Upstream

Planes = Mapping[str, np.ndarray]
Memory = dict[int, dict[str, np.ndarray]]  # what a sensor remembers, by environment and name


class ReferenceModule:
    """A plan's first sensor, computed by the kind's float64 reference, environment by environment."""

    def __init__(
        self,
        plan: Plan,
        kind: Kind,
        spec: AnySensorSpec,
        others: Mapping[str, tuple[Kind, AnySensorSpec]] | None = None,
        sensor: str | None = None,
    ):
        """Begin an episode of a sensor (default: the plan's first); `others`: kind and spec of sensors that it reads."""
        self.plan = plan
        self.kind = kind
        self.spec = spec
        self.sensor = next(planned for planned in plan.sensors if sensor in (None, planned.name))
        self.layout = plan.layout_of(self.sensor)
        self.quantities = [quantity for quantity in quantities_of([kind]) if quantity.name in self.sensor.uses]
        self.memory: Memory = {}
        self.num_calls = 0
        other_kinds = others or {}
        self.upstream = {name: ReferenceModule(plan, *other_kinds[name], other_kinds, name) for name in self.sensor.upstream}
        self._after: Memory = {}

    def __call__(self, state: SceneState, shift: np.ndarray) -> tuple[np.ndarray, Memory]:
        """Return readings (env, *sample, row, channel) of a scene whose objects are shifted [m], and the memory after it."""
        readings, memories, _ = self._run(state, shift)
        return readings, memories

    def _run(self, state: SceneState, shift: np.ndarray) -> tuple[np.ndarray, Memory, list[list[Planes]]]:
        """Return the same, and by environment and substep the planes that the kind provides."""
        assert state.body_pos is not None
        upstream = {name: other._run(state, shift)[2] for name, other in self.upstream.items()}
        readings, memories, planes = [], {}, []
        for env in range(state.body_pos.shape[0]):
            rest = {name: np.full(memory.shape, memory.rest) for name, memory in self.sensor.state.items()}
            memory, samples, provided = self.memory.get(env, rest), [], []
            for i, part in enumerate([*state.substeps, state] if self.sensor.substeps else [state]):
                read = {name: values[env][i] for name, values in upstream.items()}
                gathered, context = self.gathered(part, env, shift, read), self.context(state, i, env)
                reading, memory, *rest_of_it = self.kind.reference(self.spec, self.layout, gathered, context, memory)
                samples.append(reading)
                provided.append(rest_of_it[0] if rest_of_it else {})
            memories[env] = memory
            planes.append(provided)
            readings.append(
                np.concatenate([s if s.ndim == 3 else s[None] for s in samples]) if self.sensor.substeps else samples[0]
            )
        self._after = memories
        return np.stack(readings), memories, planes

    def remember(self, memory: Memory) -> None:
        """Go on to the next call."""
        self.memory, self.num_calls = memory, self.num_calls + 1
        for other in self.upstream.values():
            other.remember(other._after)

    def context(self, state: SceneState, substep: int, env: int) -> ReferenceContext:
        """Return when the kind is called, all calls having been as long as this one, with the random numbers of seed 0."""
        dt, count = state.dt or 0.0, max(self.sensor.substeps, 1)
        time = 0.0 if self.num_calls == 0 else (self.num_calls - 1) * dt + (substep + 1) * dt / count
        call = sensor_key(0, self.sensor.sensor), env, self.num_calls * count + substep, KIND
        is_first = self.num_calls == 0 and substep == 0
        return ReferenceContext(dt / count, self.num_calls, substep, time, is_first, functools.partial(words, *call))

    def gathered(
        self, state: SceneState, env: int, shift: np.ndarray, upstream: Mapping[str, Planes] | None = None
    ) -> References:
        """Return what the sensor asked for, in one environment, with the planes of sensors that it reads."""
        inputs = self.plan.inputs
        fields = {name: value[env].double().numpy() for name in SHAPES if (value := getattr(state, name)) is not None}
        rows = slice(*self.sensor.rows)
        scene = ReferenceScene(self.layout, rows, self.plan.objects, inputs.bodies, inputs.pairs, fields, shift)
        parts, uses = self.plan.quantities, self.sensor.uses
        values: dict[type, Any] = {q.request: q.reference(parts[q.name], uses[q.name], scene) for q in self.quantities}
        return References(values | ({Upstream: upstream} if self.sensor.upstream else {}))


TIE_SHIFT = 1e-7
"""Shift of an object [m] that covers float32 rounding: on which side of a tie a reading falls is not defined closer."""


def full_scale_error(found: Tensor, expected: np.ndarray) -> np.ndarray:
    """Return |found − expected| over the largest magnitude of each channel in the batch (env, *sample, row, channel)."""
    scale = np.abs(expected).max(axis=tuple(range(expected.ndim - 1)), keepdims=True)
    error = np.abs(found.detach().double().numpy() - expected)
    return error / np.where(scale > 0, scale, 1.0)


def row_errors(found: Tensor, reference: ReferenceModule, state: SceneState, enough: float = 0.0) -> np.ndarray:
    """Return the error of each row over full scale (env, *sample, row); the reference then remembers this state.

    Where errors are `enough` or less, the other sides of ties are not looked at.
    """
    shifts = [np.zeros(3)] + [sign * TIE_SHIFT * axis for axis in np.eye(3) for sign in (1, -1)]
    worst = np.full(tuple(found.shape[:-1]), np.inf)
    memory = None
    for shift in shifts:
        expected, after = reference(state, shift)
        memory = memory or after
        worst = np.minimum(worst, full_scale_error(found, expected).max(axis=-1))
        if worst.max() <= enough:
            break
    reference.remember(memory or {})
    return worst
