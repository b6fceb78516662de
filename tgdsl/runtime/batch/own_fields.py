"""Fields of the model that environments of MuJoCo's batch have of their own: what their objects are like, mass and friction.

Shapes: `env` environments, `n` environments that are chosen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.runtime.simulators.objects.properties import ObjectProperties, RigidObject

Array = np.ndarray
_OPTION = "opt."


class OwnFields(ObjectProperties):
    """The expanded fields of a batch. Models of variants differ from the batch's in these alone."""

    def __init__(self, batch: mujoco.batch.Batch, model: mujoco.MjModel, bodies_of: Mapping[str, str]):
        """Begin: all environments have the batch's model."""
        super().__init__(model, bodies_of, batch.nsim, torch.device("cpu"))
        self._batch = batch
        self._fields: dict[str, Array] = {}
        self._is_derived = False

    def use_models(self, ids: Int[Array, " n"], models: Sequence[mujoco.MjModel]) -> None:
        """Give environments what models have that differs from the batch's.

        Args:
            ids: The environments.
            models: The model of each.

        Raises:
            SimulationError: If a model differs in what environments cannot have of their own.
        """
        for model in {id(model): model for model in models}.values():
            for name in _differing(self._model, model):
                if name not in self._fields:
                    self._fields[name] = self._batch.expand(name)
        for env, model in zip(ids, models, strict=True):
            for name, values in self._fields.items():
                value = _value(model, name)
                values[env] = value[: len(values[env])] if values[env].ndim else value
        if self._is_derived:
            self._batch.set_const(ids)

    def _set_mass(self, target: RigidObject, mask: Bool[Tensor, " env"], mass: Float[Tensor, " env"]) -> None:
        ids = np.flatnonzero(mask.numpy())
        own, inertia, place = self._field("body_mass"), self._field("body_inertia"), np.ix_(ids, target.bodies)
        factor = mass.numpy()[ids] / own[place].sum(axis=1)
        own[place] *= factor[:, None]
        inertia[place] *= factor[:, None, None]
        self._batch.set_const(ids)
        self._is_derived = True

    def _set_friction(self, target: RigidObject, mask: Bool[Tensor, " env"], friction: Float[Tensor, " env"]) -> None:
        ids = np.flatnonzero(mask.numpy())
        self._field("geom_friction")[ids[:, None], target.geoms, 0] = friction.numpy()[ids, None]

    def _mass(self, target: RigidObject) -> Float[Tensor, " env"]:
        return torch.from_numpy(self._values("body_mass")[:, target.bodies].sum(axis=1))

    def _friction(self, target: RigidObject) -> Float[Tensor, " env"]:
        return torch.from_numpy(self._values("geom_friction")[:, target.geoms, 0].max(axis=1))

    def _values(self, name: str) -> Array:
        base = getattr(self._model, name)
        return self._fields[name] if name in self._fields else np.broadcast_to(base, (self._batch.nsim, *base.shape))

    def _field(self, name: str) -> Array:
        if name not in self._fields:
            self._fields[name] = self._batch.expand(name)
        return self._fields[name]


def _value(model: mujoco.MjModel, name: str) -> Any:
    return getattr(model.opt, name.removeprefix(_OPTION)) if name.startswith(_OPTION) else getattr(model, name)


def _differing(one: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    """Return the fields in which two models of one layout differ.

    Raises:
        SimulationError: If one of them cannot be an environment's own.
    """
    names = [name for name in dir(one) if isinstance(getattr(one, name), Array)]
    found = [name for name in names if not np.array_equal(getattr(one, name), getattr(other, name))]
    if shared := [name for name in found if name not in mujoco.batch.MODEL_FIELDS]:
        what = f"variants of objects differ in MuJoCo's {listed(shared)}"
        raise SimulationError(f"{what}, which all environments share")
    return found
