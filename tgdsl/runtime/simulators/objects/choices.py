"""Objects that differ between environments: variants, sizes, temperatures and materials, and the models to match.

Shapes: `env` environments, `heated` objects of the module's `inputs.heated`, `n` chosen environments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.fields.units import ZEROS
from tgdsl.plan.inputs import Inputs
from tgdsl.scene.contact_bits import free_bit
from tgdsl.scene.scene import Choice, SceneModels, with_choices
from tgdsl.schema.objects import NUM_SIZES

Values = int | float | Sequence[Any] | np.ndarray  # numbers, one per environment or one for all
SPARE_BODY = "tgdsl/spare"  # the body that holds one geom per mesh: it belongs to the world, touches nothing and is not seen


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
        env_choices = [dict(self._choices[env]) for env in ids]
        for name, value in variants.items():
            self._check_known(name)
            numbers = checked_numbers(f"variants of object {name}", value, len(ids), self._num_variants[name])
            for choices, variant in zip(env_choices, numbers, strict=True):
                choices[name] = Choice(int(variant))
        for name, value in sizes.items():
            for choices, size in zip(env_choices, self._sizes(name, value, len(ids)), strict=True):
                num = NUM_SIZES[self.scenes.type(name, choices[name].variant)]
                if len(size) < num or not (size[:num] > 0).all():
                    raise SimulationError(f"size of object {name} is {size.tolist()}, expected {num} positive lengths")
                x, y, z = [*size[:num].tolist(), 0.0, 0.0][:3]
                choices[name] = replace(choices[name], size=(x, y, z))
        for env, choices in zip(ids, env_choices, strict=True):
            self._choices[env] = choices
        self._tabulate()

    def _tabulate(self) -> None:
        self.variant = np.array([[choice.variant for choice in choices.values()] for choices in self._choices], dtype=np.int64)
        self.object_size = np.array([[self._size(*item) for item in choices.items()] for choices in self._choices])

    def variants(self) -> tuple[list[mujoco.MjModel], bool]:
        """Return a model with each variant that an object may have, and whether a compound's sizes may make further ones."""
        each_variant = [(name, v) for name, num in self._num_variants.items() for v in range(num)]
        objects = self.scenes.objects.values()
        is_open = any(target.is_sized and len(target.types) > 1 for target in objects)
        return [self.scenes.model({name: Choice(v)}) for name, v in each_variant], is_open

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


COLDEST = ZEROS["K"]  # absolute zero [°C]


class EnvHeat:
    """What the objects that hold heat are like in each environment.

    To begin with, all have the document's temperature, and environment i the material i modulo their number. Values
    written into the tensors are part of the next state: a sensor takes them when it begins an episode.

    Attributes:
        names: The objects, in the order of the tensors' columns: `inputs.heated`.
        temperature: The field `object_temperature` of a state [°C], a live tensor; 0 for objects whose temperature is not part
            of it.
        material: The field `object_material`, a live tensor; 0 for objects that have just one.
    """

    temperature: Float[Tensor, "env heated"]
    material: Int[Tensor, "env heated"]

    def __init__(self, inputs: Inputs, num_envs: int, device: torch.device, dtype: torch.dtype):
        self.names = inputs.heated
        self._starts, self._num_materials = inputs.start_temperatures, inputs.num_materials
        with torch.inference_mode(False):
            starts = [0.0 if start is None else start for start in self._starts]
            self.temperature = torch.tensor(starts, dtype=dtype, device=device).repeat(num_envs, 1)
            numbers = torch.tensor(self._num_materials, dtype=torch.int64, device=device)
            self.material = torch.arange(num_envs, device=device)[:, None] % numbers

    @property
    def saved(self) -> dict[str, Tensor]:
        """The live tensors by the names that a saved simulation has for them; none without objects that hold heat."""
        return {"heat/temperature": self.temperature, "heat/material": self.material} if self.names else {}

    def read(self) -> dict[str, Tensor]:
        """Return copies for a state, by field."""
        if not self.names:
            return {}
        return {"object_temperature": self.temperature.clone(), "object_material": self.material.clone()}

    def choose(
        self, ids: Int[np.ndarray, " n"], temperatures: Mapping[str, Values], materials: Mapping[str, Values]
    ) -> dict[tuple[str, int], np.ndarray]:
        """Return, checked, what `write` writes: see `Simulation.set_objects`."""
        result = {("temperature", self._column(name)): self._degrees(name, v, len(ids)) for name, v in temperatures.items()}
        for name, value in materials.items():
            column = self._column(name)
            numbers = checked_numbers(f"materials of object {name}", value, len(ids), self._num_materials[column])
            result["material", column] = numbers
        return result

    def write(self, ids: Int[np.ndarray, " n"], chosen: Mapping[tuple[str, int], np.ndarray]) -> None:
        """Write what was chosen for some environments, in place."""
        rows = torch.from_numpy(np.ascontiguousarray(ids)).to(self.material.device)
        with torch.inference_mode(False), torch.no_grad():
            for (name, column), values in chosen.items():
                target = getattr(self, name)
                target[rows, column] = torch.from_numpy(values).to(target.device, target.dtype)

    def _column(self, name: str) -> int:
        if name not in self.names:
            if not self.names:
                raise SimulationError("no temperature or material differs between environments for a sensor of this module")
            raise SimulationError(f'no object "{name}" holds heat; {did_you_mean(name, self.names, "objects that do")}')
        return self.names.index(name)

    def _degrees(self, name: str, value: Values, count: int) -> Float[np.ndarray, " n"]:
        if self._starts[self._column(name)] is None:
            hint = "the document frees it with `temperature: {per_env: 45 degC}`"
            raise SimulationError(f"the temperature of object {name} is fixed; {hint}")
        degrees = np.asarray(value, dtype=np.float64)
        if degrees.shape not in ((), (count,)) or not np.isfinite(degrees).all() or (degrees < COLDEST).any():
            expected = f"{count} numbers of at least {COLDEST} °C"
            raise SimulationError(f"temperatures of object {name}: expected {expected}, found {value}")
        return np.broadcast_to(degrees, count).copy()
