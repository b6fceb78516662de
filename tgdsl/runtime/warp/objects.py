"""Objects that differ between environments, as batched fields of MuJoCo Warp's model.

Shapes: `env` environments, `object` objects of the module's `inputs.objects`.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.objects import (
    MASS_FIELDS,
    PER_ENV,
    EnvObjects,
    ObjectProperties,
    RigidObject,
    refuse_other_fields,
)
from tgdsl.runtime.warp.stream import libraries
from tgdsl.scene.scene import Choice, SceneModels, is_absent
from tgdsl.tensors.env_ids import broadcast_over, put_rows

Array = np.ndarray
Row = dict[str, Array]

OBJECT_FIELDS = (
    *("geom_size", "geom_aabb", "geom_rbound", "geom_pos", "geom_quat", "geom_dataid"),
    *("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_subtreemass", "body_invweight0", "dof_invweight0"),
)
"""Fields of a model that an object's variant and size decide."""
IGNORED_FIELDS = {
    "geom_contype": "all geoms that are there in any environment can collide, see `shared_model`",
    "geom_conaffinity": "the same",
    "body_contype": "the same",
    "body_conaffinity": "the same",
    "geom_rgba": "it is only seen",
    "geom_matid": "it is only seen",
    "cam_pos0": "it is for cameras that follow a body",
    "cam_poscom0": "the same",
    "light_pos0": "the same, for lights",
    "light_poscom0": "the same, for lights",
    "dof_length": "it is for bodies that sleep, which are refused",
}
"""Fields that an object's variant and size decide too, and why no environment needs its own."""
FAR = 1e6
"""Distance [m] from the scene to the bounding boxes of geoms that an environment lacks: out of reach of all collisions."""


class WorldObjects:
    """Variants and sizes of `inputs.objects` in each environment, as fields of MuJoCo Warp's model.

    All environments share the geoms of all variants. Geoms of other variants than an environment's weigh nothing and do not
    collide.
    """

    def __init__(self, chosen: EnvObjects, inputs: Inputs):
        self._scenes, self._names, self._chosen = chosen.scenes, inputs.objects, chosen
        self._rows: dict[tuple[Choice, ...], Row] = {}
        self._written: list[tuple[Choice, ...]] = []
        self.model = shared_model(chosen.scenes, inputs)

    def write_to(self, parameters: Mapping[str, Tensor], arrays: Mapping[str, Tensor]) -> None:
        """Write the fields of environments whose objects were chosen again, in place; the others keep their masses."""
        choices = [self._choices(env) for env in range(len(self._chosen.variant))]
        old_choices, self._written = self._written or [None] * len(choices), choices
        device = arrays["qpos"].device
        changed = torch.tensor([old != new for old, new in zip(old_choices, choices, strict=True)], device=device)
        distinct = list(dict.fromkeys(choices))
        self._rows = {key: self._rows[key] if key in self._rows else self._row(key) for key in distinct}
        number = {key: i for i, key in enumerate(distinct)}
        index = torch.tensor([number[key] for key in choices], device=device)
        for name in (*OBJECT_FIELDS, "geom_xpos", "geom_xmat"):
            target = parameters[name] if name in OBJECT_FIELDS else arrays[name]
            rows = torch.from_numpy(np.stack([self._rows[key][name] for key in distinct]))
            new = rows.to(target.device, target.dtype)[index].reshape(target.shape)
            put_rows(target, changed, new)

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment."""
        return self._scenes.model(dict(zip(self._names, self._choices(env), strict=True)))

    def _choices(self, env: int) -> tuple[Choice, ...]:
        """Return each object's choice in one environment."""
        results = []
        for i, name in enumerate(self._names):
            x, y, z = self._chosen.object_size[env, i].tolist()
            size = (x, y, z) if self._scenes.objects[name].is_sized else None
            results.append(Choice(int(self._chosen.variant[env, i]), size))
        return tuple(results)

    def _row(self, choices: tuple[Choice, ...]) -> Row:
        """Return the batched fields of environments with these choices."""
        model = self._scenes.models([dict(zip(self._names, choices, strict=True))])[0]
        self._check_shared(model)
        row = {name: np.array(getattr(model, name)) for name in OBJECT_FIELDS}
        for geom in np.flatnonzero([is_absent(model, geom) for geom in range(model.ngeom)]):
            row["geom_rbound"][geom] = -FAR  # below every plane
            # Each at a different place: absent geoms must not meet each other.
            row["geom_aabb"][geom] = [FAR * (1 + geom)] * 3 + [0.0] * 3
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        row["geom_xpos"], row["geom_xmat"] = data.geom_xpos.copy(), data.geom_xmat.copy()  # of the world's geoms, for good
        return row

    def _check_shared(self, model: mujoco.MjModel) -> None:
        for field in dataclasses.fields(libraries()[1].Model):
            here = getattr(self.model, field.name, None)
            if not isinstance(here, Array) or field.name in OBJECT_FIELDS or field.name in IGNORED_FIELDS:
                continue
            if not np.array_equal(here, getattr(model, field.name)):
                problem = f"objects {', '.join(self._names)}: their variants differ in MuJoCo's `{field.name}`"
                raise SimulationError(f"{problem}, which MuJoCo Warp shares among all environments; simulate on the CPU")


def shared_model(scenes: SceneModels, inputs: Inputs) -> mujoco.MjModel:
    """Return the scene with every geom that an object has in any variant able to collide.

    MuJoCo Warp draws up the list of pairs that can collide once, from this model; an environment that lacks a geom keeps it out
    by its bounding box.
    """
    model = copy.copy(scenes.model({}))
    lacking = {geom for geom in range(model.ngeom) if is_absent(model, geom)}
    for name, num_variants in zip(inputs.objects, inputs.num_variants, strict=True):
        for variant in range(num_variants):
            other = scenes.model({name: Choice(variant)})
            model.body_contype |= other.body_contype
            model.body_conaffinity |= other.body_conaffinity
            for geom in [geom for geom in lacking if not is_absent(other, geom)]:
                model.geom_contype[geom], model.geom_conaffinity[geom] = other.geom_contype[geom], other.geom_conaffinity[geom]
                lacking.remove(geom)
    return model


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
        super().__init__(model, bodies_of, num_envs, device)
        self._fields = parameters
        self._plain: dict[str, list[tuple[Tensor, Tensor, Tensor]]] = {}

    def renew(self) -> None:
        """Take what objects now are like as what masses are changed from: after others were chosen."""
        for parts in self._plain.values():
            for array, columns, value in parts:
                value.copy_(array[:, columns])

    def fields(self) -> dict[str, Tensor]:
        return dict(self._fields)

    def set_fields(self, fields: Mapping[str, Tensor]) -> None:
        refuse_other_fields(fields, self._fields)
        for name, value in fields.items():
            self._fields[name].copy_(value)

    def _set_mass(self, target: RigidObject, mask: Bool[Tensor, " env"], mass: Float[Tensor, " env"]) -> None:
        self._check("mass")
        if not target.is_tree:
            problem = f'"{target.name}" is part of a kinematic tree, or its joints have armature'
            raise SimulationError(f"{problem}: what follows of its mass is not a matter of scale; simulate on the CPU")
        mass_field, inertia, subtree, body, dof = (self._fields[name] for name in MASS_FIELDS)
        bodies, above, dofs = (self._index(target, name) for name in ("bodies", "above", "dofs"))
        parts = [(mass_field, bodies), (inertia, bodies), (subtree, bodies), (body, bodies), (dof, dofs)]
        if target.name not in self._plain:  # what masses are changed from each time: rounding would add up
            self._plain[target.name] = [(array, columns, array[:, columns].clone()) for array, columns in parts]
        plain = [value for _, _, value in self._plain[target.name]]
        old_mass = mass_field[:, bodies].sum(dim=1)
        factor = mass.to(mass_field.dtype) / plain[0].sum(dim=1)
        scales = (factor, factor, factor, 1.0 / factor, 1.0 / factor)
        for (array, columns), value, scale in zip(parts, plain, scales, strict=True):
            new = value * scale.view(-1, *[1] * (value.ndim - 1))
            array[:, columns] = torch.where(broadcast_over(mask, new), new, array[:, columns])
        subtree[:, above] = subtree[:, above] + (mass_field[:, bodies].sum(dim=1) - old_mass)[:, None]

    def _set_friction(self, target: RigidObject, mask: Bool[Tensor, " env"], friction: Float[Tensor, " env"]) -> None:
        self._check("friction")
        values = self._fields["geom_friction"]
        geoms = self._index(target, "geoms")
        values[:, geoms, 0] = torch.where(mask[:, None], friction.to(values.dtype)[:, None], values[:, geoms, 0])

    def _values(self, field: str) -> Float[Tensor, "env ..."]:
        """Return what each environment has of a field of the model, also where all share it."""
        if field in self._fields:
            return self._fields[field]
        shared = torch.from_numpy(getattr(self._model, field)).to(self._device, torch.float32)
        return shared.expand(self._num_envs, *shared.shape)

    def _check(self, word: str) -> None:
        if not self._fields.keys() >= set(PER_ENV[word]):
            raise SimulationError(f'environments share each {word}; simulate(..., per_env=("{word}",)) gives them their own')
