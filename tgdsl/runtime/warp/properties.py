"""Mass and friction of objects in MuJoCo Warp's environments, as fields of the model that each has of its own.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.runtime.simulators.objects.properties import (
    MASS_FIELDS,
    PER_ENV,
    ObjectProperties,
    RigidObject,
    refuse_other_fields,
)
from tgdsl.tensors.env_ids import broadcast_over


class WorldProperties(ObjectProperties):
    """Masses and frictions of objects, changed on the device without waiting."""

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        model: mujoco.MjModel,
        bodies_of: Mapping[str, str],
        num_envs: int,
        device: torch.device,
    ):
        """Begin: all environments are as the scene has them.

        Args:
            parameters: The fields that environments have of their own, (env, …).
            model: The scene.
            bodies_of: Body of each of the document's objects.
            num_envs: Number of environments.
            device: Where physics runs.
        """
        super().__init__(model, bodies_of, num_envs, device)
        self._fields = parameters
        self._indices: dict[tuple[str, str], Tensor] = {}
        self._plain: dict[str, list[tuple[Tensor, Tensor, Tensor]]] = {}

    def renew(self) -> None:
        """Take what objects now are like as what masses are changed from: after others were chosen."""
        for parts in self._plain.values():
            for array, columns, value in parts:
                value.copy_(array[:, columns])

    def fields(self) -> dict[str, Tensor]:
        """Return what environments have of their own: see `ObjectProperties.fields`."""
        return dict(self._fields)

    def set_fields(self, fields: Mapping[str, Tensor]) -> None:
        """Give environments fields of their own: see `ObjectProperties.set_fields`."""
        refuse_other_fields(fields, self._fields)
        for name, value in fields.items():
            self._fields[name].copy_(value)

    def _set_mass(self, target: RigidObject, mask: Bool[Tensor, " env"], mass: Float[Tensor, " env"]) -> None:
        self._check("mass")
        if not target.is_tree:
            what = f'"{target.name}" is part of a kinematic tree, or its joints have armature'
            raise SimulationError(f"{what}: what follows of its mass is not a matter of scale; simulate on the CPU")
        own, inertia, subtree, body, dof = (self._fields[name] for name in MASS_FIELDS)
        bodies, above, dofs = (self._index(target, name, own.device) for name in ("bodies", "above", "dofs"))
        parts = [(own, bodies), (inertia, bodies), (subtree, bodies), (body, bodies), (dof, dofs)]
        if target.name not in self._plain:  # what masses are changed from each time: rounding would add up
            self._plain[target.name] = [(array, columns, array[:, columns].clone()) for array, columns in parts]
        plain = [value for _, _, value in self._plain[target.name]]
        before = own[:, bodies].sum(dim=1)
        factor = mass.to(own.dtype) / plain[0].sum(dim=1)
        scales = (factor, factor, factor, 1.0 / factor, 1.0 / factor)
        for (array, columns), value, scale in zip(parts, plain, scales, strict=True):
            new = value * scale.view(-1, *[1] * (value.ndim - 1))
            array[:, columns] = torch.where(broadcast_over(mask, new), new, array[:, columns])
        subtree[:, above] = subtree[:, above] + (own[:, bodies].sum(dim=1) - before)[:, None]

    def _set_friction(self, target: RigidObject, mask: Bool[Tensor, " env"], friction: Float[Tensor, " env"]) -> None:
        self._check("friction")
        own = self._fields["geom_friction"]
        geoms = self._index(target, "geoms", own.device)
        own[:, geoms, 0] = torch.where(mask[:, None], friction.to(own.dtype)[:, None], own[:, geoms, 0])

    def _mass(self, target: RigidObject) -> Float[Tensor, " env"]:
        own = self._values("body_mass")
        return own[:, self._index(target, "bodies", own.device)].sum(dim=1)

    def _friction(self, target: RigidObject) -> Float[Tensor, " env"]:
        own = self._values("geom_friction")
        return own[:, self._index(target, "geoms", own.device), 0].amax(dim=1)

    def _values(self, field: str) -> Float[Tensor, "env ..."]:
        """Return what each environment has of a field of the model, also where all share it."""
        if field in self._fields:
            return self._fields[field]
        shared = torch.from_numpy(getattr(self._model, field)).to(self._device, torch.float32)
        return shared.expand(self._num_envs, *shared.shape)

    def _check(self, word: str) -> None:
        if not self._fields.keys() >= set(PER_ENV[word]):
            raise SimulationError(f'environments share each {word}; simulate(..., per_env=("{word}",)) gives them their own')

    def _index(self, target: RigidObject, name: str, device: torch.device) -> Tensor:
        key = (target.name, name)
        if key not in self._indices:
            self._indices[key] = torch.from_numpy(getattr(target, name)).to(device)
        return self._indices[key]
