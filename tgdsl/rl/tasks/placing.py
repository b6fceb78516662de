"""Tasks whose object lies freely: when it is dropped, and what is observed of its goal.

Shapes: `env` environments.
"""

from __future__ import annotations

from typing import Annotated, Literal

from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.rl.features import GoalPart
from tgdsl.rl.spec import PlacedRandomSpec, TaskSpec


class PlacedTaskSpec(TaskSpec):
    """A task whose object is put down freely, and has an orientation as its goal."""

    randomise: PlacedRandomSpec = PlacedRandomSpec()
    """What is random."""
    goal: Annotated[tuple[GoalPart, ...], Field(min_length=1)] = ("orientation", "angle")
    """What the group `goal` has, in order: six numbers of the goal's `orientation`; the same of the `difference`, the turn from
    the object to the goal in world axes; the `angle` of that turn [rad]."""
    drop_measure: Literal["distance", "below"] = "distance"
    """What `drop_distance` bounds: how far the object is from where it started, or how far below."""

    @model_validator(mode="after")
    def _has_each_part_once(self) -> PlacedTaskSpec:
        if twice := [part for part in self.goal if self.goal.count(part) > 1]:
            raise ValueError(f"goal names {twice[0]} twice")
        return self

    def drop_extent(self, offset: Float[Tensor, "env 3"]) -> Float[Tensor, " env"]:
        """Return what `drop_distance` bounds, of an object's position less that at its start [m]."""
        return vector_norm(offset, dim=1) if self.drop_measure == "distance" else -offset[:, 2]
