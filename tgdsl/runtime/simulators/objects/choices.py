"""Objects that differ between environments: which variant and size each environment has, and the models to match."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.plan.inputs import Inputs
from tgdsl.scene.contact_bits import free_bit
from tgdsl.scene.scene import Choice, SceneModels, with_choices
from tgdsl.schema.objects import NUM_SIZES

Values = int | float | Sequence[Any] | np.ndarray
"""Numbers, one per environment or one for all."""
SPARE_BODY = "tgdsl/spare"
"""The body that holds one geom per mesh: it belongs to the world, touches nothing and is not seen."""


class SharedMeshModels(SceneModels):
    """The models of a scene for simulators that share meshes among environments.

    MuJoCo makes the hulls of meshes that some geom collides with. Here a spare body, the last one, holds every mesh of every
    variant, so that meshes and hulls are the same whatever is chosen. Without such meshes the models are those of the scene.
    """

    def _compiled(self, choices: Mapping[str, Choice]) -> mujoco.MjModel:
        plain = super()._compiled(choices)
        spec = with_choices(self._base.copy(), list(self.objects.values()), choices)
        meshes = [mesh.name for mesh in spec.meshes if mesh.name.startswith("tgdsl/")]
        if not meshes:
            return plain
        for target in self.objects.values():
            body, id = spec.body(target.body), plain.body(target.body).id
            body.explicitinertial = True
            body.mass, body.inertia = plain.body_mass[id], plain.body_inertia[id]
            body.iquat, body.ipos = plain.body_iquat[id], plain.body_ipos[id]
        bit = free_bit(spec, "meshes among variants", SimulationError)
        spare = spec.worldbody.add_body(name=SPARE_BODY)
        for name in meshes:
            kind = mujoco.mjtGeom.mjGEOM_MESH
            spare.add_geom(type=kind, meshname=name, contype=bit, conaffinity=0, mass=0, rgba=[0, 0, 0, 0])
        return spec.compile()


class EnvObjects:
    """What the objects of `inputs.objects` are like in each environment.

    To begin with, environment i has variant i modulo their number, in the size that the document or the scene gives.

    Shapes: `env` environments, `object` objects of `inputs.objects`.

    Attributes:
        scenes: The models of the scene.
        variant: The field `variant` of a state.
        object_size: The field `object_size` of a state [m]; 0 for objects whose size is not part of it.
    """

    variant: Int[np.ndarray, "env object"]
    object_size: Float[np.ndarray, "env object 3"]

    def __init__(self, scenes: SceneModels, inputs: Inputs, num_envs: int):
        self.scenes = scenes
        self._num_variants = dict(zip(inputs.objects, inputs.num_variants, strict=True))
        self._choices = [{name: Choice(env % num) for name, num in self._num_variants.items()} for env in range(num_envs)]
        self._tabulate()

    def choose(self, ids: Int[np.ndarray, " n"], variants: Mapping[str, Values], sizes: Mapping[str, Values]) -> None:
        """Say what objects are like in some environments: see `Simulation.set_objects`."""
        chosen = [dict(self._choices[env]) for env in ids]
        for name, value in variants.items():
            self._check_known(name)
            numbers = checked_numbers(f"variants of object {name}", value, len(ids), self._num_variants[name])
            for choices, variant in zip(chosen, numbers, strict=True):
                choices[name] = Choice(int(variant))
        for name, value in sizes.items():
            for choices, size in zip(chosen, self._sizes(name, value, len(ids)), strict=True):
                num = NUM_SIZES[self.scenes.type(name, choices[name].variant)]
                if len(size) < num or not (size[:num] > 0).all():
                    raise SimulationError(f"size of object {name} is {size.tolist()}, expected {num} positive lengths")
                x, y, z = [*size[:num].tolist(), 0.0, 0.0][:3]
                choices[name] = replace(choices[name], size=(x, y, z))
        for env, choices in zip(ids, chosen, strict=True):
            self._choices[env] = choices
        self._tabulate()

    def _tabulate(self) -> None:
        self.variant = np.array([[choice.variant for choice in choices.values()] for choices in self._choices], dtype=np.int64)
        self.object_size = np.array([[self._size(*item) for item in choices.items()] for choices in self._choices])

    def variants(self) -> tuple[list[mujoco.MjModel], bool]:
        """Return a model with each variant that an object may have, and whether a compound's sizes may make further ones."""
        chosen = [(name, v) for name, num in self._num_variants.items() for v in range(num)]
        objects = self.scenes.objects.values()
        is_open = any(target.is_sized and len(target.types) > 1 for target in objects)
        return [self.scenes.model({name: Choice(v)}) for name, v in chosen], is_open

    def models(self) -> list[mujoco.MjModel]:
        """Return each environment's model; those that are alike share one."""
        return self.scenes.models(self._choices)

    def _size(self, name: str, choice: Choice) -> tuple[float, float, float]:
        return self.scenes.size(name, choice) if self.scenes.objects[name].is_sized else (0.0, 0.0, 0.0)

    def _check_known(self, name: str) -> None:
        if name not in self._num_variants:
            hint = did_you_mean(name, self._num_variants, "objects that do")
            raise SimulationError(f'no object "{name}" differs between environments; {hint}')

    def _sizes(self, name: str, value: Values, count: int) -> Float[np.ndarray, "n size"]:
        self._check_known(name)
        if not self.scenes.objects[name].is_sized:
            raise SimulationError(f"the size of object {name} is fixed; the document frees it with `size: per_env`")
        result = np.atleast_1d(np.asarray(value, dtype=np.float64))
        if result.shape[:-1] not in ((), (count,)) or not np.isfinite(result).all():
            raise SimulationError(f"sizes of object {name}: found shape {result.shape}, expected ({count}, 1 to 3), finite")
        return np.broadcast_to(result, (count, result.shape[-1]))


def checked_numbers(what: str, value: Values, count: int, num: int) -> Int[np.ndarray, " n"]:
    """Return integers from 0 to `num` − 1, given as one for all or `count` of them."""
    result = np.asarray(value)
    if result.shape not in ((), (count,)) or result.dtype.kind not in "iu" or (result < 0).any() or (result >= num).any():
        raise SimulationError(f"{what}: expected {count} integers from 0 to {num - 1}, found {value}")
    return np.broadcast_to(result, count).astype(np.int64)
