"""Terms that tasks share, and terms that a document adds to its task: `terms` of `TaskSpec`.

A `RewardTerm` adds a rate to the reward, a `TerminationTerm` ends episodes, an `ObservationTerm` adds a group of observations.
`TERMS` has those that documents may name; a user's own is a subclass, named as `file.py:Class`. Rewards that tasks share:

    action_rate       |a_t − a_{t−1}|²                                                      [1]
    joint_limit       Σ_j max(0, |q_j − m_j| − s h_j)                                       [rad]
    work              Σ_j |τ_j q̇_j|                                                         [W]
    contact_force     Σ_l max(0, |f_l| − f_max) / f_max                                     [1]
    near              mean_p exp(−max(0, d_p) / λ)                                          [1]
    effort            Σ_j (τ_j/τ_max,j)²                                                    [1]
    object_speed      max(0, |v|/v_free − 1) + max(0, |ω|/ω_free − 1)                       [1]

with a the action, q, q̇ and τ positions, velocities and torques of the joints that the policy moves, m and h middle and half
width of their ranges, s the share of these that is free, f_l the object's force on link l, d_p the distance from probe p to the
object, τ_max the largest torques of the drives, v and ω the object's velocity and angular velocity.

Source of the names: Chung et al., *Tactile Genesis*, appendix, "Reward terms", which prints no formulas: these are ours.
`effort` and `object_speed` are ours altogether.

Shapes: `env` environments, `joint` joints, `link` links, `probe` probes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.fields.models import Number, PositiveLength, Quantity, SpecModel
from tgdsl.rl import groups
from tgdsl.rl.task import Now, Setup

FREE_SHARE = 0.95
"""s, share of a joint's range that costs nothing."""


def action_rate(now: Now) -> Float[Tensor, " env"]:
    """Return |a_t − a_{t−1}|²."""
    return (now.action - now.last_action).square().sum(dim=1)


def joint_limit(now: Now, setup: Setup) -> Float[Tensor, " env"]:
    """Return how far joints are beyond the middle `FREE_SHARE` of their ranges, summed [rad]."""
    middle, half = 0.5 * (setup.low + setup.high), 0.5 * (setup.high - setup.low)
    return ((now.joint_pos - middle).abs() - FREE_SHARE * half).clamp(min=0.0).sum(dim=1)


def work(now: Now) -> Float[Tensor, " env"]:
    """Return the power of all drives, that which brakes included [W]."""
    return (now.torque * now.joint_vel).abs().sum(dim=1)


def contact_force(now: Now, most: float) -> Float[Tensor, " env"]:
    """Return by how much the object's force on each link exceeds a limit [N], as a share of it, summed."""
    return ((vector_norm(now.link_force, dim=2) - most).clamp(min=0.0) / most).sum(dim=1)


def near(now: Now, width: float) -> Float[Tensor, " env"]:
    """Return how near the probes are to the object's surface, from 0 to 1, which is touch; `width` λ [m]."""
    return torch.exp(-now.distance.clamp(min=0.0) / width).mean(dim=1)


def effort(now: Now, setup: Setup) -> Float[Tensor, " env"]:
    """Return the squares of the torques as shares of the largest ones, summed; a drive without a limit makes none."""
    return (now.torque / setup.max_torque).square().sum(dim=1)


def object_speed(now: Now, free_speed: float, free_spin: float) -> Float[Tensor, " env"]:
    """Return by how much the object is faster than what costs nothing [m/s, rad/s], as shares of that, summed."""
    own, free = (now.object.linvel, now.object.angvel), (free_speed, free_spin)
    speed, spin = ((vector_norm(value, dim=1) / most - 1.0).clamp(min=0.0) for value, most in zip(own, free, strict=True))
    return speed + spin


Force = Annotated[float, Quantity("force", gt=0.0)]
Speed = Annotated[float, Quantity("speed", gt=0.0)]
Spin = Annotated[float, Quantity("number", gt=0.0)]


class Term(SpecModel, ABC):
    """A term that a document adds to its task; its fields are the term's parameters.

    `Now` holds what a term may read. All methods return tensors of all environments and change nothing: on a GPU they are part
    of a captured step, so no Python branch may depend on a tensor's value.
    """

    senses: ClassVar[tuple[str, ...]] = ()
    """Kinds of sensors of the sensors' document that it looks at: see `Task.senses`."""
    term: str | None = None
    """Which term it is: a name, or `package.module:Class` or `file.py:Class`; default: the name that it has in the document."""


class RewardTerm(Term):
    """A term of the reward."""

    weight: Number
    """Factor on its rate: more than 0 for what pays, less for what costs."""

    @abstractmethod
    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        """Return its rate without the weight; the reward is the sum of all rates times Δt."""


class TerminationTerm(Term):
    """A reason to end an episode for good."""

    @abstractmethod
    def is_over(self, now: Now, setup: Setup) -> Bool[Tensor, " env"]:
        """Return which episodes end."""


class ObservationTerm(Term):
    """A group of observations, called as the document calls it."""

    @abstractmethod
    def observe(self, now: Now, setup: Setup) -> Float[Tensor, "env feature"]:
        """Return the group."""


class ActionRate(RewardTerm):
    """|a_t − a_{t−1}|² [1/s]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return action_rate(now)


class JointLimit(RewardTerm):
    """How far joints are beyond the middle 95 % of their ranges, summed [rad]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return joint_limit(now, setup)


class Work(RewardTerm):
    """Power of the drives [W]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return work(now)


class Effort(RewardTerm):
    """Squares of the torques as shares of the largest ones, summed [1/s]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return effort(now, setup)


class ContactForce(RewardTerm):
    """By how much the object's force on each link exceeds `max_force`, as a share of it, summed [1/s]."""

    senses = ("link_contact",)
    max_force: Force = 10.0
    """Less force on a link costs nothing [N]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return contact_force(now, self.max_force)


class Near(RewardTerm):
    """How near the probes of `surface_distance` are to the object, from 0 to 1 [1/s]."""

    senses = ("surface_distance",)
    width: PositiveLength = 0.02
    """Decay length [m]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return near(now, self.width)


class ObjectSpeed(RewardTerm):
    """By how much the object is faster than what is free, as shares of that, summed [1/s]."""

    free_speed: Speed = 0.2
    """A slower object costs nothing [m/s]."""
    free_spin: Spin = 4.0
    """The same for its angular velocity [rad/s]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return object_speed(now, self.free_speed, self.free_spin)


class ForceLimit(TerminationTerm):
    """The object presses on a link with more than `max_force`."""

    senses = ("link_contact",)
    max_force: Force
    """Largest force on one link [N]."""

    def is_over(self, now: Now, setup: Setup) -> Bool[Tensor, " env"]:
        return (vector_norm(now.link_force, dim=2) > self.max_force).any(dim=1)


class SpeedLimit(TerminationTerm):
    """The object is faster than a hand could make it by holding it."""

    max_speed: Speed
    """Largest speed of the object [m/s]."""

    def is_over(self, now: Now, setup: Setup) -> Bool[Tensor, " env"]:
        return vector_norm(now.object.linvel, dim=1) > self.max_speed


class LinkForce(ObservationTerm):
    """The object's force on each link, in the link's frame [N]."""

    senses = ("link_contact",)

    def observe(self, now: Now, setup: Setup) -> Float[Tensor, "env feature"]:
        return now.link_force.flatten(1)


class ObjectState(ObservationTerm):
    """Position [m], six numbers of the orientation, velocity [m/s] and angular velocity [rad/s] of the object."""

    def observe(self, now: Now, setup: Setup) -> Float[Tensor, "env feature"]:
        return groups.object_state(now)


TERMS: Mapping[str, type[Term]] = {
    "action_rate": ActionRate,
    "joint_limit": JointLimit,
    "work": Work,
    "effort": Effort,
    "contact_force": ContactForce,
    "near": Near,
    "object_speed": ObjectSpeed,
    "force_limit": ForceLimit,
    "speed_limit": SpeedLimit,
    "link_force": LinkForce,
    "object_state": ObjectState,
}
"""The terms that documents may name."""
