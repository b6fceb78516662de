"""Objects that differ between environments, as fields of MuJoCo Warp's model that each environment has of its own.

Shapes: `env` environments, `object` objects of the module's `inputs.objects`.
"""

from __future__ import annotations

import copy
import dataclasses

import mujoco
import numpy as np
import torch

from tgdsl.errors import SimulationError
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.objects.choices import EnvObjects
from tgdsl.runtime.warp.stream import libraries
from tgdsl.runtime.warp.worlds import Worlds
from tgdsl.scene.scene import Choice, SceneModels, is_absent
from tgdsl.tensors.env_ids import broadcast_over

Array = np.ndarray
Row = dict[str, Array]

OWN_FIELDS = (
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
"""Distance [m] from the scene where geoms that an environment lacks have their bounding boxes, so that nothing meets them."""


class WorldObjects:
    """What the objects of `inputs.objects` are like in each environment, as MuJoCo Warp's model has it.

    Types of geoms are shared by all environments: of the geoms that an object has in any variant, those that an environment
    lacks weigh nothing and are kept out of its collisions.

    Attributes:
        model: The model that all environments share.
    """

    def __init__(self, chosen: EnvObjects, inputs: Inputs):
        self._scenes, self._names, self._chosen = chosen.scenes, inputs.objects, chosen
        self._rows: dict[tuple[Choice, ...], Row] = {}
        self._written: list[tuple[Choice, ...]] = []
        self.model = shared_model(chosen.scenes, inputs)

    def write_to(self, worlds: Worlds) -> None:
        """Write the fields of environments whose objects were chosen again, in place; the others keep their masses.

        Raises:
            SimulationError: If a field that all environments share would differ.
        """
        choices = [self._choices(env) for env in range(len(self._chosen.variant))]
        before, self._written = self._written or [None] * len(choices), choices
        device = worlds.arrays["qpos"].device
        changed = torch.tensor([old != new for old, new in zip(before, choices, strict=True)], device=device)
        distinct = list(dict.fromkeys(choices))
        self._rows = {key: self._rows[key] if key in self._rows else self._row(key) for key in distinct}
        number = {key: i for i, key in enumerate(distinct)}
        index = torch.tensor([number[key] for key in choices], device=device)
        for name in (*OWN_FIELDS, "geom_xpos", "geom_xmat"):
            target = worlds.parameters[name] if name in OWN_FIELDS else worlds.arrays[name]
            rows = torch.from_numpy(np.stack([self._rows[key][name] for key in distinct]))
            new = rows.to(target.device, target.dtype)[index].reshape(target.shape)
            target.copy_(torch.where(broadcast_over(changed, new), new, target))

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment."""
        return self._scenes.model(dict(zip(self._names, self._choices(env), strict=True)))

    def _choices(self, env: int) -> tuple[Choice, ...]:
        """Return what each object is like in one environment."""
        results = []
        for i, name in enumerate(self._names):
            x, y, z = self._chosen.object_size[env, i].tolist()
            size = (x, y, z) if self._scenes.objects[name].is_sized else None
            results.append(Choice(int(self._chosen.variant[env, i]), size))
        return tuple(results)

    def _row(self, choices: tuple[Choice, ...]) -> Row:
        """Return the fields that environments with some choices have of their own."""
        model = self._scenes.models([dict(zip(self._names, choices, strict=True))])[0]
        self._check_shared(model)
        row = {name: np.array(getattr(model, name)) for name in OWN_FIELDS}
        for geom in np.flatnonzero([is_absent(model, geom) for geom in range(model.ngeom)]):
            row["geom_rbound"][geom] = -FAR  # below every plane
            # Each in a place of its own, or two that are lacking would meet there.
            row["geom_aabb"][geom] = [FAR * (1 + geom)] * 3 + [0.0] * 3
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        row["geom_xpos"], row["geom_xmat"] = data.geom_xpos.copy(), data.geom_xmat.copy()  # of the world's geoms, for good
        return row

    def _check_shared(self, model: mujoco.MjModel) -> None:
        for field in dataclasses.fields(libraries()[1].Model):
            here = getattr(self.model, field.name, None)
            if not isinstance(here, Array) or field.name in OWN_FIELDS or field.name in IGNORED_FIELDS:
                continue
            if not np.array_equal(here, getattr(model, field.name)):
                what = f"objects {', '.join(self._names)}: their variants differ in MuJoCo's `{field.name}`"
                raise SimulationError(f"{what}, which MuJoCo Warp shares among all environments; simulate on the CPU")


def shared_model(scenes: SceneModels, inputs: Inputs) -> mujoco.MjModel:
    """Return the scene with every geom that an object has in any variant able to collide.

    MuJoCo Warp draws up the list of pairs that can collide once, from this model; an environment that lacks a geom keeps it out
    by its bounding box.
    """
    model = copy.copy(scenes.model({}))
    lacking = {geom for geom in range(model.ngeom) if is_absent(model, geom)}
    for name, num_variants in zip(inputs.objects, inputs.num_variants, strict=True):
        for variant in range(num_variants):
            own = scenes.model({name: Choice(variant)})
            model.body_contype |= own.body_contype
            model.body_conaffinity |= own.body_conaffinity
            for geom in [geom for geom in lacking if not is_absent(own, geom)]:
                model.geom_contype[geom], model.geom_conaffinity[geom] = own.geom_contype[geom], own.geom_conaffinity[geom]
                lacking.remove(geom)
    return model
