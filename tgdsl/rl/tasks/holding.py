"""Whether a hand holds the object that it turns, or lets it coast.

Fingers that flick an object make more progress than fingers that hold it. With f_l the object's force on link l, the object is
held where at least `links` links carry load, |f_l| ≥ `load`, and one of them is a finger's: two fingers, or one and the palm.
Elsewhere it coasts, and its progress pays the share c = `coasting_pay`.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, StrictInt
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.fields.models import Quantity, SpecModel
from tgdsl.rl.task import Now, Setup
from tgdsl.runtime.simulators.model_ids import element_id


class HoldSpec(SpecModel):
    """What progress pays while the object is not held."""

    coasting_pay: Annotated[float, Quantity("number", ge=0.0, le=1.0)] = 1.0
    """c, what progress pays while the object coasts, as a share of what it pays while the object is held."""
    links: Annotated[StrictInt, Field(ge=1)] = 2
    """The object is held where so many links carry load, at least one of them a finger's."""
    load: Annotated[float, Quantity("force", gt=0.0)] = 0.05
    """The object's force from which on a link carries load [N]."""


class Holding:
    """Says where the object is held, and what its progress pays.

    Attributes:
        pays_in_full: Whether progress always pays the same.
    """

    def __init__(self, spec: HoldSpec, setup: Setup):
        self.spec, self.pays_in_full = spec, isinstance(spec.coasting_pay, float) and spec.coasting_pay == 1.0
        self._fingers = torch.from_numpy(are_fingers(setup.model, setup.links)).to(setup.device)

    def is_held(self, now: Now) -> Bool[Tensor, " env"]:
        """Return where the object is held."""
        is_loaded = vector_norm(now.link_force, dim=2) >= self.spec.load
        return (is_loaded.sum(dim=1) >= self.spec.links) & (is_loaded & self._fingers).any(dim=1)

    def pay(self, now: Now) -> Float[Tensor, " env"]:
        """Return what progress pays: 1 where the object is held, else c."""
        held = self.is_held(now).to(now.joint_pos.dtype)
        return held + (1.0 - held) * self.spec.coasting_pay


def are_fingers(model: mujoco.MjModel, links: Sequence[str]) -> Bool[np.ndarray, " link"]:
    """Return which links are fingers: a hinge moves them, or a slide that does not move all links, as that of a whole hand."""
    joints = [_joints_above(model, element_id(model, "body", link)) for link in links]
    of_all = set.intersection(*joints) if joints else set()
    slides = {joint for joint in of_all if int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return np.array([bool(joint_ids - slides) for joint_ids in joints], dtype=bool)


def _joints_above(model: mujoco.MjModel, body: int) -> set[int]:
    """Return the hinges and slides that move a body."""
    result: set[int] = set()
    while body:
        first = int(model.body_jntadr[body])
        result |= set(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    return {joint for joint in result if int(model.jnt_type[joint]) in kinds}
