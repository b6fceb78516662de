"""Objects that differ between environments: variants, sizes, temperatures, materials, masses and frictions.

MuJoCo takes, of the two geoms of a contact, the larger coefficient of friction, unless one of them has a higher `priority`:
then that one's alone. An object that is to slide more easily than its surroundings needs a higher priority in the scene.

Shapes: `env` environments, `object` and `heated` objects of the module's `inputs`, `n` chosen environments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.fields.units import ZEROS
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.state_values import Numbers
from tgdsl.scene.colliders import free_bit
from tgdsl.scene.scene import Choice, SceneModels, with_choices
from tgdsl.schema.objects import NUM_SIZES
from tgdsl.tensors.env_ids import EnvIds, env_mask

Values = int | float | Sequence[Any] | np.ndarray  # numbers, one per environment or one for all
SPARE_BODY = "tgdsl/spare"  # holds one geom per mesh: it belongs to the world, touches nothing and is not seen
COLDEST = ZEROS["K"]  # absolute zero [°C]
MASS_FIELDS = ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")
"""Fields of a model that follow from the mass of a body, its inertia growing with it."""
PER_ENV: Mapping[str, tuple[str, ...]] = {"mass": MASS_FIELDS, "friction": ("geom_friction",)}
"""Properties that may differ between environments, and the fields of MuJoCo's model that each stands for."""


class SharedMeshModels(SceneModels):
    """The models of a scene for simulators that share meshes among environments.

    MuJoCo builds convex hulls only for meshes of colliding geoms. Here a spare last body holds every mesh of every variant:
    all choices share meshes and hulls. Without such meshes the models are unchanged.
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
    """Variants and sizes of the objects of `inputs.objects` in each environment.

    To begin with, environment i has variant i modulo their number, in the size that the document or the scene gives.
    """

    scenes: SceneModels
    variant: Int[np.ndarray, "env object"]  # the field `variant` of a state
    object_size: Float[np.ndarray, "env object 3"]  # its field `object_size` [m]; 0 for objects whose size is not part of it

    def __init__(self, scenes: SceneModels, inputs: Inputs, num_envs: int):
        self.scenes = scenes
        self._num_variants = dict(zip(inputs.objects, inputs.num_variants, strict=True))
        self._choices = [{name: Choice(env % num) for name, num in self._num_variants.items()} for env in range(num_envs)]
        self._tabulate()

    def choose(self, ids: Int[np.ndarray, " n"], variants: Mapping[str, Values], sizes: Mapping[str, Values]) -> None:
        for name in (*variants, *sizes):
            if name not in self._num_variants:
                hint = did_you_mean(name, self._num_variants, "objects that do")
                raise SimulationError(f'no object "{name}" differs between environments; {hint}')
        env_choices = [dict(self._choices[env]) for env in ids]
        for name, value in variants.items():
            numbers = _integers(f"variants of object {name}", value, len(ids), self._num_variants[name])
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

    def variants(self) -> tuple[list[mujoco.MjModel], bool]:
        """Return a model with each variant that an object may have, and whether a compound's sizes may make further ones."""
        each_variant = [(name, v) for name, num in self._num_variants.items() for v in range(num)]
        is_open = any(target.is_sized and len(target.types) > 1 for target in self.scenes.objects.values())
        return [self.scenes.model({name: Choice(v)}) for name, v in each_variant], is_open

    def models(self) -> list[mujoco.MjModel]:
        """Return each environment's model; equal choices share one."""
        return self.scenes.models(self._choices)

    def _tabulate(self) -> None:
        def size(name: str, choice: Choice) -> tuple[float, float, float]:
            return self.scenes.size(name, choice) if self.scenes.objects[name].is_sized else (0.0, 0.0, 0.0)

        self.variant = np.array([[choice.variant for choice in choices.values()] for choices in self._choices], dtype=np.int64)
        self.object_size = np.array([[size(*item) for item in choices.items()] for choices in self._choices])

    def _sizes(self, name: str, value: Values, count: int) -> Float[np.ndarray, "n size"]:
        if not self.scenes.objects[name].is_sized:
            raise SimulationError(f"the size of object {name} is fixed; the document frees it with `size: per_env`")
        result = np.atleast_1d(np.asarray(value, dtype=np.float64))
        if result.shape[:-1] not in ((), (count,)) or not np.isfinite(result).all():
            raise SimulationError(f"sizes of object {name}: found shape {result.shape}, expected ({count}, 1 to 3), finite")
        return np.broadcast_to(result, (count, result.shape[-1]))


def _integers(what: str, value: Values, count: int, num: int) -> Int[np.ndarray, " n"]:
    """Return integers from 0 to `num` − 1, given as one for all or `count` of them."""
    result = np.asarray(value)
    if result.shape not in ((), (count,)) or result.dtype.kind not in "iu" or (result < 0).any() or (result >= num).any():
        raise SimulationError(f"{what}: expected {count} integers from 0 to {num - 1}, found {value}")
    return np.broadcast_to(result, count).astype(np.int64)


class EnvHeat:
    """Temperatures and materials of the objects that hold heat, in live tensors; columns are `inputs.heated`.

    To begin with, all have the document's temperature, and environment i the material i modulo their number. Values
    written into the tensors are part of the next state: a sensor takes them when it begins an episode.
    """

    temperature: Float[Tensor, "env heated"]  # `object_temperature` of a state [°C]; 0 for objects whose is not part of it
    material: Int[Tensor, "env heated"]  # `object_material` of a state; 0 for objects that have just one

    def __init__(self, inputs: Inputs, num_envs: int, device: torch.device, dtype: torch.dtype):
        self.names, self._starts, self._num_materials = inputs.heated, inputs.start_temperatures, inputs.num_materials
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
            numbers = _integers(f"materials of object {name}", value, len(ids), self._num_materials[column])
            result["material", column] = numbers
        return result

    def write(self, ids: Int[np.ndarray, " n"], chosen: Mapping[tuple[str, int], np.ndarray]) -> None:
        rows = torch.from_numpy(np.ascontiguousarray(ids)).to(self.material.device)
        with torch.inference_mode(False), torch.no_grad():
            for (name, column), values in chosen.items():
                target = getattr(self, name)
                target[rows, column] = torch.from_numpy(values).to(target.device, target.dtype)

    def _column(self, name: str) -> int:
        if not self.names:
            raise SimulationError("no temperature or material differs between environments for a sensor of this module")
        if name not in self.names:
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


class RigidObject(NamedTuple):
    """An object: a body, and those below it that are welded to it, by their indices."""

    name: str  # its body
    bodies: Int[np.ndarray, " body"]
    geoms: Int[np.ndarray, " geom"]
    dofs: Int[np.ndarray, " dof"]  # of its body's joints
    above: Int[np.ndarray, " ancestor"]  # the bodies that carry it, the world among them
    # whether it is a kinematic tree by itself whose joints have no armature: then what MuJoCo derives of its mass grows or
    # shrinks with that alone
    is_tree: bool


class ObjectProperties(ABC):
    """Masses and frictions of a simulation's objects, by the name of an object or body, with all that is welded to it."""

    def __init__(self, model: mujoco.MjModel, bodies_of: Mapping[str, str], num_envs: int, device: torch.device):
        self._model, self._bodies_of, self._num_envs, self._device = model, bodies_of, num_envs, device
        self._objects: dict[str, RigidObject] = {}
        self._indices: dict[tuple[str, str], Tensor] = {}

    def set(
        self,
        env_ids: EnvIds | None = None,
        *,
        mass: Mapping[str, Numbers] | None = None,
        friction: Mapping[str, Numbers] | None = None,
    ) -> None:
        """Change masses and frictions of objects in some environments (default: all), permanently; no state changes.

        Fields that MuJoCo derives from masses are updated. On a GPU nothing waits, and the simulation needs
        `per_env=("mass", "friction")`.

        Args:
            env_ids: Indices, or a boolean mask over environments.
            mass: Mass by name [kg]: one number, or (env,). The inertia grows in proportion.
            friction: Coefficient of sliding friction of all geoms, by name: one number, or (env,).

        Raises:
            SimulationError: If there is no such object or environment, a number on the host is out of range, or all
                environments share the property.
        """
        mask = env_mask(env_ids, self._num_envs, self._device)
        masses = {name: self._rows(f"mass of {name}", value, True) for name, value in (mass or {}).items()}
        frictions = {name: self._rows(f"friction of {name}", value, False) for name, value in (friction or {}).items()}
        targets = {name: self._object(name) for name in (*masses, *frictions)}
        for name, rows in masses.items():
            self._set_mass(targets[name], mask, rows)
        for name, rows in frictions.items():
            self._set_friction(targets[name], mask, rows)

    def mass(self, name: str) -> Float[Tensor, " env"]:
        """Return the mass of an object in each environment [kg]."""
        return self._values("body_mass")[:, self._index(self._object(name), "bodies")].sum(dim=1)

    def friction(self, name: str) -> Float[Tensor, " env"]:
        """Return the coefficient of sliding friction of an object in each environment, the largest of its geoms'."""
        return self._values("geom_friction")[:, self._index(self._object(name), "geoms"), 0].amax(dim=1)

    @abstractmethod
    def fields(self) -> dict[str, Tensor]:
        """Return the fields of MuJoCo's model that differ between environments, by name, (env, …)."""

    @abstractmethod
    def set_fields(self, fields: Mapping[str, Tensor]) -> None:
        """Set fields that `fields` has returned."""

    @abstractmethod
    def _set_mass(self, target: RigidObject, mask: Bool[Tensor, " env"], mass: Float[Tensor, " env"]) -> None: ...

    @abstractmethod
    def _set_friction(self, target: RigidObject, mask: Bool[Tensor, " env"], friction: Float[Tensor, " env"]) -> None: ...

    @abstractmethod
    def _values(self, field: str) -> Float[Tensor, "env ..."]:
        """Return a field of MuJoCo's model in each environment, also where all share it."""

    def _index(self, target: RigidObject, name: str) -> Int[Tensor, " element"]:
        """Return an object's `bodies`, `geoms`, `dofs` or `above` on the device."""
        key = (target.name, name)
        if key not in self._indices:
            self._indices[key] = torch.from_numpy(getattr(target, name)).to(self._device)
        return self._indices[key]

    def _object(self, name: str) -> RigidObject:
        if name not in self._objects:
            self._objects[name] = _rigid_object(self._model, name, self._bodies_of)
        return self._objects[name]

    def _rows(self, what: str, given: Numbers, is_positive: bool) -> Float[Tensor, " env"]:
        """Return a value for each environment; those on the host must be finite and at least 0, or more than 0."""
        values = given if isinstance(given, Tensor) else torch.as_tensor(np.asarray(given, dtype=np.float64))
        if tuple(values.shape) not in ((), (1,), (self._num_envs,)):
            raise SimulationError(f"{what} has shape {tuple(values.shape)}, expected one number or ({self._num_envs},)")
        if values.device.type == "cpu":
            numbers = values.detach().double().numpy()
            is_fit = ((numbers > 0) if is_positive else (numbers >= 0)) & (numbers < np.inf)
            if not is_fit.all():
                expected = "more than 0" if is_positive else "at least 0"
                raise SimulationError(f"{what} is {numbers[~is_fit][0]:g}, expected {expected}")
        return values.detach().to(self._device).expand(self._num_envs)


def refuse_other_fields(given: Mapping[str, Tensor], known: Mapping[str, Tensor]) -> None:
    """Raise an error for fields that environments do not have, or of another shape."""
    for name, value in given.items():
        if name not in known or tuple(known[name].shape) != tuple(value.shape):
            raise SimulationError(f'environments have no field "{name}" of shape {tuple(value.shape)}')


def _rigid_object(model: mujoco.MjModel, name: str, bodies_of: Mapping[str, str]) -> RigidObject:
    """Return an object by its name in the document, or by its body's in the scene."""
    try:
        body = int(model.body(bodies_of.get(name, name)).id)
    except KeyError as error:
        names = [*bodies_of, *(model.body(i).name for i in range(1, model.nbody))]
        hint = did_you_mean(name, names, "objects and bodies")
        raise SimulationError(f'there is no object or body "{name}"; {hint}') from error
    bodies = [body]
    for i in range(body + 1, model.nbody):
        if model.body_parentid[i] in bodies and not model.body_jntnum[i]:
            bodies.append(i)
    above, parent = [0], int(model.body_parentid[body])
    while parent:
        above.append(parent)
        parent = int(model.body_parentid[parent])
    if not body or not model.body_mass[bodies].sum() > 0:
        raise SimulationError(f'"{name}" has no mass that could be changed')
    dofs = int(model.body_dofadr[body]) + np.arange(int(model.body_dofnum[body]))
    below = [i for i in range(body + 1, model.nbody) if model.body_rootid[i] == model.body_rootid[body]]
    is_tree = model.body_rootid[body] == body and set(below) <= set(bodies) and not model.dof_armature[dofs].any()
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    return RigidObject(model.body(body).name, np.array(bodies), geoms, dofs, np.array(above), bool(is_tree))
