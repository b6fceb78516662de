"""Mass and friction of objects, by name: which bodies, geoms and joints of a model these are of.

MuJoCo takes, of the two geoms of a contact, the larger coefficient of friction, unless one of them has a higher `priority`:
then that one's alone. An object that is to slide more easily than its surroundings needs a higher priority in the scene.

Shapes: `env` environments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.runtime.simulators.state_values import Numbers
from tgdsl.tensors.env_ids import EnvIds, env_mask

MASS_FIELDS = ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")
"""Fields of a model that follow from the mass of a body, its inertia growing with it."""
PER_ENV: Mapping[str, tuple[str, ...]] = {"mass": MASS_FIELDS, "friction": ("geom_friction",)}
"""Properties that may differ between environments, and the fields of MuJoCo's model that each stands for."""


@dataclass(frozen=True, eq=False)
class RigidObject:
    """An object: a body, and those below it that are welded to it."""

    name: str  # its body
    bodies: Int[np.ndarray, " body"]  # indices of its bodies
    geoms: Int[np.ndarray, " geom"]  # indices of their geoms
    dofs: Int[np.ndarray, " dof"]  # degrees of freedom of its body's joints
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
        """Change masses and frictions of objects in some environments (default: all), for good; nothing else moves.

        What MuJoCo derives of a mass follows. Of the two geoms of a contact MuJoCo takes the larger friction, unless one has a
        higher `priority`: an object that is to slide more easily than what it lies on needs that in the scene. On a GPU nothing
        waits, and the simulation has to be made with `per_env=("mass", "friction")`.

        Args:
            env_ids: Indices, or a boolean mask over environments.
            mass: Mass by name [kg]: one number, or (env,). The inertia grows in proportion.
            friction: Coefficient of sliding friction of all geoms, by name: one number, or (env,).

        Raises:
            SimulationError: If there is no such object or environment, a number on the host is out of range, or environments
                cannot have this of their own.
        """
        mask, num_envs, device = env_mask(env_ids, self._num_envs, self._device), self._num_envs, self._device
        masses = {n: property_rows(f"mass of {n}", v, num_envs, device, True) for n, v in (mass or {}).items()}
        frictions = {n: property_rows(f"friction of {n}", v, num_envs, device) for n, v in (friction or {}).items()}
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
            self._objects[name] = rigid_object(self._model, name, self._bodies_of)
        return self._objects[name]


def refuse_other_fields(given: Mapping[str, Tensor], known: Mapping[str, Tensor]) -> None:
    """Raise an error for fields that environments do not have, or of another shape."""
    for name, value in given.items():
        if name not in known or tuple(known[name].shape) != tuple(value.shape):
            raise SimulationError(f'environments cannot have a "{name}" of shape {tuple(value.shape)} of their own')


def rigid_object(model: mujoco.MjModel, name: str, bodies_of: Mapping[str, str]) -> RigidObject:
    """Return an object by its name in the document, or by its body's in the scene."""
    try:
        body = int(model.body(bodies_of.get(name, name)).id)
    except KeyError as error:
        names = [*bodies_of, *(model.body(i).name for i in range(1, model.nbody))]
        raise SimulationError(
            f'there is no object or body "{name}"; {did_you_mean(name, names, "objects and bodies")}'
        ) from error
    bodies = [body]
    for i in range(body + 1, model.nbody):
        if model.body_parentid[i] in bodies and not model.body_jntnum[i]:
            bodies.append(i)
    above, parent = [0], int(model.body_parentid[body])
    while parent:
        above.append(parent)
        parent = int(model.body_parentid[parent])
    if not body or not model.body_mass[bodies].sum() > 0:
        raise SimulationError(f'"{name}" has no mass of its own that could be changed')
    first, count = int(model.body_dofadr[body]), int(model.body_dofnum[body])
    dofs = np.arange(first, first + count)
    below = [i for i in range(body + 1, model.nbody) if model.body_rootid[i] == model.body_rootid[body]]
    is_tree = model.body_rootid[body] == body and set(below) <= set(bodies) and not model.dof_armature[dofs].any()
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    return RigidObject(model.body(body).name, np.array(bodies), geoms, dofs, np.array(above), bool(is_tree))


def property_rows(
    what: str, given: Numbers, num_envs: int, device: torch.device, is_positive: bool = False
) -> Float[Tensor, " env"]:
    """Return a property's value for each environment; those on the host must be finite and at least 0, or more than 0."""
    values = given if isinstance(given, Tensor) else torch.as_tensor(np.asarray(given, dtype=np.float64))
    if tuple(values.shape) not in ((), (1,), (num_envs,)):
        raise SimulationError(f"{what} has shape {tuple(values.shape)}, expected one number or ({num_envs},)")
    if values.device.type == "cpu":
        numbers = values.detach().double().numpy()
        is_fit = ((numbers > 0) if is_positive else (numbers >= 0)) & (numbers < np.inf)
        if not is_fit.all():
            expected = "more than 0" if is_positive else "at least 0"
            raise SimulationError(f"{what} is {numbers[~is_fit][0]:g}, expected {expected}")
    return values.detach().to(device).expand(num_envs)
