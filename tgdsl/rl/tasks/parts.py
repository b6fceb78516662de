"""Parts of several tasks: reward of progress, whether an object is held, when it is dropped.

Fingers that flick an object make more progress than fingers that hold it. With f_l the object's force on link l, the object is
held where at least `links` links carry load, |f_l| ≥ `load`, and one of them is a finger's: two fingers, or one and the palm.
Otherwise it coasts, and its progress pays the share c = `coasting_pay`. With ω the rate of progress and
b = clip(ω, ω_min, ω_max), the reward is b where b ≥ 0, and κ b elsewhere.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, StrictInt, model_validator
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.fields.models import Positive, Quantity, SpecModel
from tgdsl.rl.groups import GoalPart
from tgdsl.rl.spec import PlacedRandomSpec, TaskSpec
from tgdsl.rl.task import Now, Setup
from tgdsl.runtime.simulators.model_ids import element_id


class HoldSpec(SpecModel):
    """Reward of progress while the object is not held."""

    coasting_pay: Annotated[float, Quantity("number", ge=0.0, le=1.0)] = 1.0
    """c, reward of progress while the object coasts, as a share of the reward while it is held."""
    links: Annotated[StrictInt, Field(ge=1)] = 2
    """The object is held where so many links carry load, at least one of them a finger's."""
    load: Annotated[float, Quantity("force", gt=0.0)] = 0.05
    """Least force of the object on a link that carries load [N]."""


class Holding:
    """Where the object is held, and the reward's factor on progress; always 1 if it `pays_in_full`."""

    def __init__(self, spec: HoldSpec, setup: Setup):
        self.spec, self.pays_in_full = spec, isinstance(spec.coasting_pay, float) and spec.coasting_pay == 1.0
        self._fingers = torch.from_numpy(are_fingers(setup.model, setup.links)).to(setup.device)

    def is_held(self, now: Now) -> Bool[Tensor, " env"]:
        """Return where the object is held."""
        is_loaded = vector_norm(now.link_force, dim=2) >= self.spec.load
        return (is_loaded.sum(dim=1) >= self.spec.links) & (is_loaded & self._fingers).any(dim=1)

    def pay(self, now: Now) -> Float[Tensor, " env"]:
        """Return the reward's factor on progress: 1 where the object is held, else c."""
        held = self.is_held(now).to(now.joint_pos.dtype)
        return held + (1.0 - held) * self.spec.coasting_pay


def are_fingers(model: mujoco.MjModel, links: Sequence[str]) -> Bool[np.ndarray, " link"]:
    """Return which links are fingers: a hinge moves them, or a slide that does not move all links, as a whole hand's does."""
    joints = [_joints_above(model, element_id(model, "body", link)) for link in links]
    of_all = set.intersection(*joints) if joints else set()
    slides = {joint for joint in of_all if int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return np.array([bool(joint_ids - slides) for joint_ids in joints], dtype=bool)


def _joints_above(model: mujoco.MjModel, body: int) -> set[int]:
    result: set[int] = set()
    while body:
        first = int(model.body_jntadr[body])
        result |= set(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    return {joint for joint in result if int(model.jnt_type[joint]) in kinds}


class ProgressSpec(SpecModel):
    """Bounds of the rate that pays: part of a task's document."""

    max_spin: Positive = 4.0
    """ω_max: upper bound of the rate [rad/s]."""
    min_spin: Annotated[float, Quantity("number", le=0.0)] | None = None
    """ω_min, at most 0: lower bound of the rate [rad/s]; null: none."""
    backward: Positive = 1.0
    """κ, factor on negative rates."""

    def pay(self, rate: Float[Tensor, " env"]) -> Float[Tensor, " env"]:
        """Return the part of a rate that pays [rad/s]."""
        bounded = rate.clamp(max=self.max_spin)
        if self.min_spin is not None:
            bounded = bounded.clamp(min=self.min_spin)
        return torch.where(bounded < 0, self.backward * bounded, bounded)


class PlacedTaskSpec(TaskSpec):
    """A task with a free object and a goal orientation."""

    randomise: PlacedRandomSpec = PlacedRandomSpec()
    """Random values."""
    goal: Annotated[tuple[GoalPart, ...], Field(min_length=1)] = ("orientation", "angle")
    """Parts of the group `goal`, in order: six numbers of the goal's `orientation`; six numbers of the `difference`, the
    rotation from the object to the goal in world axes; the `angle` of that rotation [rad]."""
    drop_measure: Literal["distance", "below"] = "distance"
    """Quantity that `drop_distance` bounds: the object's distance from its start, or how far it is below."""

    @model_validator(mode="after")
    def _has_each_part_once(self) -> PlacedTaskSpec:
        if twice := [part for part in self.goal if self.goal.count(part) > 1]:
            raise ValueError(f"goal names {twice[0]} twice")
        return self

    def drop_extent(self, offset: Float[Tensor, "env 3"]) -> Float[Tensor, " env"]:
        """Return the quantity that `drop_distance` bounds, from an object's offset from its start [m]."""
        return vector_norm(offset, dim=1) if self.drop_measure == "distance" else -offset[:, 2]
