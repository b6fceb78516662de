"""From the state of a scene to what sensors asked for: relative poses of all pairs, then each quantity once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tgdsl.errors import TgdslError
from tgdsl.plan import tree
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedSensor
from tgdsl.quantities.base import Gathered, Quantity, Scene
from tgdsl.quantities.pairs import Pairs, PairTable, gates, relate
from tgdsl.sensors.base import Kind
from tgdsl.sensors.noise.stage import Now, Stage
from tgdsl.sensors.noise.stages import Radius

Tensors = Mapping[str, Tensor]
Tree = Mapping[str, Any]
"""What `parts` returns, with tensors for arrays."""


def parts(plan: Plan) -> dict[str, Any]:
    """Return what of a plan is read at run time, its arrays being a module's constants."""
    return {
        "pairs": plan.pairs,
        "quantities": plan.quantities,
        "sensors": {sensor.name: sensor.constants for sensor in plan.sensors},
        "noise": {sensor.name: sensor.noise.constants for sensor in plan.sensors if sensor.noise is not None},
        "observations": {term.key: term.constants for term in plan.observations},
    }


def constant_arrays(plan: Plan) -> dict[str, np.ndarray]:
    """Return the arrays of these parts, by the names that the plan gives them."""
    names, result = {id(array): name for name, array in plan.arrays.items()}, {}
    tree.mapped(parts(plan), lambda array: result.setdefault(names[id(array)], array), _stays_on_host)
    return result


def bind(plan: Plan, kinds: Mapping[str, Kind], tensor_of: Callable[[str], Tensor]) -> Tree:
    """Return these parts with a tensor in the place of each array, and constants as the kind of each sensor has them."""
    names = {id(array): name for name, array in plan.arrays.items()}
    bound = tree.mapped(parts(plan), lambda array: tensor_of(names[id(array)]), _is_prepared)
    return {**bound, "sensors": {name: kinds[name].typed(constants) for name, constants in bound["sensors"].items()}}


def _stays_on_host(record: Any) -> bool:
    """Return whether a part of the plan is no constant of a module, but the source of one."""
    return getattr(record, "stays_on_host", False)


def _is_prepared(record: Any) -> bool:
    """Return the same, after making now what is made of it: no compiler traces that."""
    return _stays_on_host(record) and record.prepared is not None


def scene_of(
    plan: Plan, own: Tree, tensors: Tensors, nows: Mapping[str, Now], noise: Mapping[str, Sequence[Stage]], dtype: torch.dtype
) -> Scene:
    """Return what quantities are gathered from.

    Args:
        plan: The plan.
        own: Its parts, bound.
        tensors: The fields of `SceneState` that `inputs` names.
        nows: When sensors are read, by their names.
        noise: Stages of their noise, which may disturb the taxels' radii.
        dtype: Dtype of what is gathered.
    """
    shifts = {}
    for sensor in plan.sensors:
        for stage in noise.get(sensor.name, ()):
            if isinstance(stage, Radius):
                probes = stage.radius_noise.new_empty(sensor.rows[1] - sensor.rows[0])
                shifts[sensor.name] = stage.shift(nows[sensor.name], probes)
    return Scene(tensors, plan.objects, _pairs(own["pairs"], tensors, dtype) if plan.objects else None, shifts, dtype)


def gather(quantities: Sequence[Quantity], own: Tree, scene: Scene) -> dict[str, tuple[Any, ...]]:
    """Return the values of all uses of each quantity, by its name."""
    values_of = {quantity.name: quantity.gather(own["quantities"][quantity.name], scene) for quantity in quantities}
    for name, values in values_of.items():
        if not isinstance(values, (tuple, list)):
            problem = f"expected a tuple with a value for each use, found {type(values).__name__}"
            raise TgdslError(f'`gather` of the quantity "{name}": {problem}')
    return values_of


def gathered_of(sensor: PlannedSensor, quantities: Sequence[Quantity], values: Mapping[str, tuple[Any, ...]]) -> Gathered:
    """Return what a sensor asked for."""
    used = [quantity for quantity in quantities if quantity.name in sensor.uses]
    for name in (quantity.name for quantity in used):
        if sensor.uses[name] >= len(values[name]):
            problem = f'{len(values[name])} values, and sensor "{sensor.name}" has use {sensor.uses[name]} (from 0)'
            raise TgdslError(f'`gather` of the quantity "{name}" returns {problem}; expected one for each use')
    return Gathered({quantity.request: values[quantity.name][sensor.uses[quantity.name]] for quantity in used})


def _pairs(table: PairTable[Tensor], tensors: Tensors, dtype: torch.dtype) -> Pairs:
    """Return the relative poses and motions of all pairs, and which of them may be felt."""
    gate = gates(tensors["contact_found"], table.gate, dtype) if "contact_found" in tensors else None
    motion = tensors.get("body_linvel"), tensors.get("body_angvel")
    return relate(tensors["body_pos"], tensors["body_quat"], table.link, table.object, dtype, *motion, gate)
