"""How grasps are sampled: a part of the document of each task whose episodes begin with the object in the hand.

A task has grasps if its spec has a field `grasps: GraspSpec`.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StrictInt

from tgdsl.fields.models import Angle, PositiveLength, Quantity, Range, RangeOf, SpecModel
from tgdsl.rl.actuation import ZERO
from tgdsl.rl.spec import TaskSpec, Time, Whole

NonNegativeAngle = Annotated[float, Quantity("angle", ge=0.0)]
NonNegativeForce = Annotated[float, Quantity("force", ge=0.0)]


class GraspSpec(SpecModel):
    """How grasps are sampled, and which of them are kept: see `tgdsl.rl.grasps.sampling`."""

    closed: str = "closed"
    """The scene's keyframe to whose controls the joints that the policy moves close; they start near the task's keyframe."""
    file: str | None = None
    """A file that `tgdsl grasps --out` wrote, relative to this document; default: the user's cache, sampled if it has none."""
    num: Whole = 512
    """How many are kept, as many of each variant of the object."""
    seed: Annotated[StrictInt, Field(ge=0)] = 0
    """What all that is random follows from."""
    spread: NonNegativeAngle = 0.2
    """How far joints start from the keyframe, and how far from the closed hand's controls they are told to go, at most [rad];
    but no more than a quarter of a joint's range."""
    squeeze: Annotated[Range, RangeOf("angle", gt=0.0)] = (0.05, 0.2)
    """How far a joint's target may lead its position: what it presses with, over the gain of its servo [rad]."""
    yaw: Annotated[Range, RangeOf("angle")] = ZERO
    """By how much the object is turned about the vertical; it needs a free or ball joint [rad]."""
    offset: Annotated[Range, RangeOf("length")] = ZERO
    """What is added to the object's place along each of the world's axes; it needs a free joint [m]."""
    close: Time = 0.8
    """For how long the hand closes, while the object is held where it is [s]."""
    settle: Time = 0.6
    """For how long the hand then has the object to itself, until it is kept [s]."""
    hold: Time = 1.2
    """For how long it is pushed afterwards, to see whether the hand holds it [s]."""
    push: NonNegativeForce = 1.0
    """Force of the pushes, each in a direction of its own and for a quarter of `hold` [N]."""
    max_tilt: Angle = 0.1
    """By how much the object may then be tilted from where it was held [rad]."""
    max_shift: PositiveLength = 0.01
    """How far it may be from there [m]."""
    min_links: Whole = 2
    """On how many links it must press with `min_force`."""
    min_force: Annotated[float, Quantity("force", gt=0.0)] = 0.1
    """Force with which a link counts [N]."""
    opposite: Angle = 2.0
    """Least angle between two such forces, so that links press from opposite sides [rad]."""


def grasp_spec(spec: TaskSpec) -> GraspSpec | None:
    """Return how a task's grasps are sampled; None if its episodes do not begin with grasps."""
    result = getattr(spec, "grasps", None)
    return result if isinstance(result, GraspSpec) else None
