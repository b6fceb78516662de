"""Touch as a sensor of Newton: `SensorTactile(model, "hand.yaml")`, and `update(state, contacts, observables=…)` after a step.

Shapes: `world` the model's worlds, the module's environments; `item` bodies, shapes or joints of a world, then of none.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Int
from newton.solvers import SolverBase
from torch import Tensor

from tgdsl.adapters import Document, module_of
from tgdsl.errors import SimulationError, listed
from tgdsl.geometry.rotations import rotated
from tgdsl.module.state import SceneState
from tgdsl.runtime.by_name import Geoms, bodies_by_name, contacts_by_pair, index_of, pair_rows

Worlds = Bool[Tensor, " world"] | Sequence[int] | None  # None: all
_ROWS = ("shape0", "shape1", "point0", "point1", "offset0", "offset1", "normal")
_FORCES = {"contact_force", "contact_torque", "contact_netforce"}


class SensorTactile:
    """The readings of all worlds of a model.

    Contacts are of the step that led to the state, and move on with its bodies; their torque is not read.
    """

    def __init__(self, model: Any, document: Document, *, prefix: str = "", names: Mapping[str, str] | None = None):
        """Look up the document's names among the labels of Newton's model.

        Args:
            model: The model.
            document: The document, or an artefact (`.safetensors`).
            prefix: Stands before all names among the labels, such as "robot/"; needed only where several labels end alike.
            names: Labels by the names in the document, where they differ otherwise.

        Raises:
            SimulationError: If a name is missing or ambiguous, or worlds differ.
        """
        self.readings: dict[str, Tensor] = {}  # by name, as `touch.outputs` lists them; empty before the first `update`
        self.touch = module_of(document, "SensorTactile").to(wp.device_to_torch(model.device))
        self._inputs = self.touch.inputs.renamed(names, prefix=prefix)
        # The kinds for `solver.observables`; empty if no sensor reads contacts.
        self.solver_observable_kinds = frozenset({SolverBase.ObservableKind.CONTACT_F} if self._inputs.pairs else ())
        of_kinds = [_by_world(model, kind) for kind in ("body", "shape", "joint")]
        (bodies, self._labels), (shapes, shape_labels), (joints, joint_labels) = of_kinds
        self._bodies, self._com = self._tensor(bodies), wp.to_torch(model.body_com)[self._tensor(bodies)]
        # The worlds that were reset since the last update of all: they have no contacts.
        self.is_new = torch.zeros(len(bodies), dtype=torch.bool, device=self.touch.device)
        self._shape_body = wp.to_torch(model.shape_body).long()  # −1: the world's
        self._shape_world = wp.to_torch(model.shape_world).long().clamp(min=0 if len(bodies) == 1 else -1)
        self._shape_place = torch.zeros_like(self._shape_body)
        self._shape_place[self._tensor(shapes)] = torch.arange(shapes.shape[1], device=self.touch.device)
        labels = [*model.body_label, "world"]
        child, parent = (getattr(model, f"joint_{end}").numpy()[joints[0]] for end in ("child", "parent"))
        parents = tuple((labels[below], labels[above]) for below, above in zip(child, parent, strict=True))
        self._geoms = Geoms(tuple(labels[i] for i in model.shape_body.numpy()[shapes[0]]), tuple(shape_labels), parents)
        joint_ids = joints[:, [index_of(name, joint_labels, "joint", "joints") for name in self._inputs.joints]]
        first = {name: getattr(model, f"joint_{name}_start").numpy() for name in ("q", "qd")}
        if (first["q"][joint_ids + 1] - first["q"][joint_ids] != 1).any():
            raise SimulationError(f"of the joints {listed(self._inputs.joints)}, some are no hinges or slides")
        ends = {"joint_pos": "q", "joint_vel": "qd"}.items()
        self._joints = {name: (end, self._tensor(first[end][joint_ids])) for name, end in ends if name in self._inputs.fields}
        pair_rows(self._inputs, self._geoms)
        self._kinematics(model)

    def reset(self, worlds: Worlds = None) -> None:
        """Begin a new episode in some worlds."""
        self.is_new |= self._mask(worlds)
        self.touch.reset(self._mask(worlds))

    def update(
        self, state: Any, contacts: Any = None, *, observables: Any = None, worlds: Worlds = None, **fields: Any
    ) -> dict[str, Tensor]:
        """Advance the sensors by one control step, and return the readings.

        Args:
            state: Newton's state.
            contacts: Its contacts of the last step; needed only if `solver_observable_kinds` is not empty.
            observables: The solver's, with `contact_f`; default: `contacts.force`. Needed only if forces are read.
            worlds: What to advance, as after a reset; the others keep their readings.
            fields: Fields of `SceneState` that Newton's state does not hold, such as `dt`, `last_action` or `variant`.
        """
        if worlds is None:
            self.is_new.zero_()
        fields |= self._kinematics(state) | (self._contacts(state, contacts, observables) if self._inputs.pairs else {})
        with torch.no_grad():
            self.readings = self.touch(SceneState(**fields), mask=None if worlds is None else self._mask(worlds))
        return self.readings

    def _kinematics(self, state: Any) -> dict[str, Tensor]:
        pose, twist = (wp.to_torch(values)[self._bodies] for values in (state.body_q, state.body_qd))
        parts = (pose[..., :3], pose[..., 3:], twist[..., :3], twist[..., 3:])
        fields = bodies_by_name(self._inputs, self._labels, *parts, quat_order="xyzw", linvel_at=self._com)
        return fields | {name: wp.to_torch(getattr(state, f"joint_{end}"))[ids] for name, (end, ids) in self._joints.items()}

    def _contacts(self, state: Any, contacts: Any, observables: Any) -> dict[str, Tensor]:
        acting = getattr(contacts, "force", None) if observables is None else observables.contact_f
        if contacts is None or (acting is None and _FORCES & {*self._inputs.fields}):
            how = "solver.observables(kinds=sensor.solver_observable_kinds, contacts=contacts)"
            raise SimulationError(f"the sensors read contacts: hand contacts and observables = {how} to step and update")
        rows = {name: wp.to_torch(getattr(contacts, f"rigid_contact_{name}")) for name in _ROWS}
        if self.touch.device.type == "cpu":
            rows = {name: values[: int(contacts.rigid_contact_count.numpy()[0])] for name, values in rows.items()}
        is_filled = torch.arange(len(rows["normal"]), device=self.touch.device) < wp.to_torch(contacts.rigid_contact_count)
        shapes = torch.where(is_filled[:, None], torch.stack([rows["shape0"], rows["shape1"]], dim=1).long(), 0)
        poses = torch.cat([wp.to_torch(state.body_q), torch.eye(7, device=self.touch.device)[6:]])  # the world's at the end
        pose = poses[self._shape_body[shapes]]
        local = torch.stack([rows["point0"] + rows["offset0"], rows["point1"] + rows["offset1"]], dim=1)
        points = pose[..., :3] + rotated(pose[..., [6, 3, 4, 5]], local)
        force = torch.zeros_like(rows["normal"]) if acting is None else wp.to_torch(acting)[: len(shapes), :3]
        is_met = (force != 0).any(dim=1) | (((points[:, 1] - points[:, 0]) * rows["normal"]).sum(dim=1) < 0)
        place, world = self._shape_place[shapes], self._shape_world[shapes].amax(dim=1)
        is_contact = is_filled & is_met & (world >= 0) & ~self.is_new[world]
        columns = {"pos": points.mean(dim=1), "normal": rows["normal"], "force": force, "env": world.clamp(min=0)}
        settings = {"num_envs": len(self._bodies), "is_contact": is_contact, "force_on": 1}
        return contacts_by_pair(self._inputs, self._geoms, place, **columns, **settings)

    def _mask(self, worlds: Worlds) -> Bool[Tensor, " world"]:
        mask = torch.full_like(self.is_new, worlds is None)
        mask[[] if worlds is None else worlds] = True
        return mask

    def _tensor(self, ids: np.ndarray) -> Tensor:
        return torch.from_numpy(ids.astype(np.int64)).to(self.touch.device)


def _by_world(model: Any, kind: str) -> tuple[Int[np.ndarray, "world item"], list[str]]:
    """Return the indices of each world's bodies, shapes or joints, followed by shared ones, and the first world's labels."""
    world, labels = getattr(model, f"{kind}_world").numpy(), getattr(model, f"{kind}_label")
    shared, ids_of_world = np.flatnonzero(world < 0), [np.flatnonzero(world == i) for i in range(max(model.world_count, 1))]
    ends = [[labels[i].rpartition("/")[2] for i in ids] for ids in ids_of_world]
    if different := [i for i, names in enumerate(ends) if names != ends[0]]:
        difference = listed(sorted({*ends[0]} ^ {*ends[different[0]]})) or "their order"
        raise SimulationError(f"worlds 0 and {different[0]} differ in their {kind} labels: {difference}")
    ids = np.stack([np.concatenate([items, shared]) for items in ids_of_world])
    return ids, [labels[i] for i in ids[0]]
