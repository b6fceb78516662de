"""Fields of the model that differ between environments of MuJoCo's batch: of objects' variants, mass and friction.

Shapes: `env` environments.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.runtime.simulators.objects.properties import ObjectProperties, RigidObject, refuse_other_fields

if TYPE_CHECKING:
    import mujoco.batch

Array = np.ndarray
_DERIVED_FROM = ("body_mass", "body_inertia", "geom_friction")
"""Fields that are changed in models of single environments; MuJoCo derives the others."""


class BatchProperties(ObjectProperties):
    """Masses and frictions of a batch: expanded fields of its model, or a model for each environment.

    Expanded fields share all else. Variants that differ in what cannot be expanded, such as trees of bounding volumes,
    take a model for each environment; changed ones are copies.
    """

    def __init__(
        self,
        batch: mujoco.batch.Batch,
        model: mujoco.MjModel,
        bodies_of: Mapping[str, str],
        variants: Sequence[mujoco.MjModel],
        is_open: bool,
    ):
        super().__init__(model, bodies_of, batch.nsim, torch.device("cpu"))
        self._batch = batch
        self._fields: dict[str, Array] = {}
        self._chosen = [model] * batch.nsim
        differ = {name for other in variants for name in _differing(model, other)}
        is_apart = is_open or bool(differ - set(mujoco.batch.MODEL_FIELDS))  # in what cannot be expanded
        self._models = list(self._chosen) if is_apart else None
        self._is_derived = False

    def use_models(self, models: Sequence[mujoco.MjModel]) -> None:
        """Give environments other models; those that keep theirs keep their masses and frictions too."""
        changed = [env for env, model in enumerate(models) if model is not self._chosen[env]]
        self._chosen = list(models)
        if self._models is not None:
            for env in changed:
                self._models[env] = models[env]
            self._batch.set_models(self._models)
            return
        for model in {id(models[env]): models[env] for env in changed}.values():
            for name in _differing(self._model, model):
                self._field(name)
        for env in changed:
            for name, values in self._fields.items():
                value = getattr(models[env], name)
                values[env] = value[: len(values[env])] if values[env].ndim else value
        if self._is_derived and changed:
            self._batch.set_const(np.array(changed))

    def fields(self) -> dict[str, Tensor]:
        """Return the fields that differ: see `ObjectProperties.fields`."""
        names = list(self._fields) if self._models is None else list(_DERIVED_FROM)
        return {name: self._values(name) for name in names}

    def set_fields(self, fields: Mapping[str, Tensor]) -> None:
        """Set the fields that differ: see `ObjectProperties.set_fields`."""
        names = [name for name in fields if name in mujoco.batch.MODEL_FIELDS]
        refuse_other_fields(fields, {name: self._values(name) for name in names})
        changed = set()
        for name, value in fields.items():
            now = self._arrays_of(name)
            for env in np.flatnonzero((now != value.numpy()).reshape(len(now), -1).any(axis=1)).tolist():
                self._row(name, env)[...] = value[env].numpy()
                changed.add(env)
        if "body_mass" in fields:
            self._derive(np.array(sorted(changed), dtype=np.int64))
        elif self._models is not None:
            self._batch.set_models(self._models)

    def _set_mass(self, target: RigidObject, mask: Bool[Tensor, " env"], mass: Float[Tensor, " env"]) -> None:
        ids = np.flatnonzero(mask.numpy())
        for env, wanted in zip(ids.tolist(), mass.numpy()[ids], strict=True):
            model, bodies = self._chosen[env], target.bodies  # not of what it has now: rounding would add up
            factor = wanted / model.body_mass[bodies].sum()
            self._row("body_mass", env)[bodies] = factor * model.body_mass[bodies]
            self._row("body_inertia", env)[bodies] = factor * model.body_inertia[bodies]
        self._derive(ids)

    def _derive(self, ids: Int[Array, " n"]) -> None:
        """Have what follows from masses follow in some environments."""
        self._is_derived = True
        if self._models is None:
            if len(ids):
                self._batch.set_const(ids)
            return
        for env in ids:
            mujoco.mj_setConst(self._models[env], mujoco.MjData(self._models[env]))
        self._batch.set_models(self._models)

    def _set_friction(self, target: RigidObject, mask: Bool[Tensor, " env"], friction: Float[Tensor, " env"]) -> None:
        ids = np.flatnonzero(mask.numpy())
        for env, wanted in zip(ids.tolist(), friction.numpy()[ids], strict=True):
            self._row("geom_friction", env)[target.geoms, 0] = wanted
        if self._models is not None:
            self._batch.set_models(self._models)

    def _values(self, field: str) -> Float[Tensor, "env ..."]:
        return torch.from_numpy(np.array(self._arrays_of(field)))

    def _arrays_of(self, name: str) -> Array:
        """Return a field of all environments, to be read."""
        if self._models is not None:
            return np.stack([getattr(model, name) for model in self._models])
        base = getattr(self._model, name)
        return self._fields[name] if name in self._fields else np.broadcast_to(base, (self._batch.nsim, *base.shape))

    def _row(self, name: str, env: int) -> Array:
        """Return a field of one environment, to be changed."""
        if self._models is None:
            return self._field(name)[env]
        if self._models[env] is self._chosen[env]:
            self._models[env] = copy.copy(self._models[env])
        return getattr(self._models[env], name)

    def _field(self, name: str) -> Array:
        if name not in self._fields:
            self._fields[name] = self._batch.expand(name)
        return self._fields[name]


def _differing(one: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    names = [name for name in dir(one) if isinstance(getattr(one, name), Array)]
    return [name for name in names if not np.array_equal(getattr(one, name), getattr(other, name))]
