"""Terms of rewards, ends and observations that tasks share, and that a document adds to its task: `terms` of `TaskSpec`.

A `RewardTerm` adds a rate to the reward, a `TerminationTerm` ends episodes, an `ObservationTerm` adds a group of observations;
an `EventTerm` changes the simulation at random; a `CurriculumTerm` changes a weight or another number of a term while a policy
is learned.
`TERMS` has the terms that documents may name, including terms of installed packages; a user's term is a subclass, named as
`file.py:Class`.

Symbols: a action; q, q̇ and τ positions, velocities and torques of the joints that the policy moves, m and h middle and half
width of their ranges; f_l the object's force on link l, d_p the distance from probe p to the object; τ_max the largest torques
of the drives; v and ω the object's velocity and angular velocity.

Source of the names: Chung et al., *Tactile Genesis*, appendix, "Reward terms", which prints no formulas: these are ours.
`effort` and `object_speed` are ours altogether. The option `nearest` of `near`, `net_force` and `score_limit` follow the
authors' public code: see docs/records/paper.md.

Shapes: `env` environments, `joint` joints, `link` links, `probe` probes.
"""

from __future__ import annotations

import inspect
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, create_model, model_validator
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.fields.models import Number, Positive, PositiveLength, Quantity, Range, RangeOf, SpecModel
from tgdsl.files.plugins import Registry
from tgdsl.rl import groups, rotations
from tgdsl.rl.actuation import ZERO, Actuation, Factor
from tgdsl.rl.draws import within
from tgdsl.rl.spec import PushSpec, TaskSpec, Whole
from tgdsl.rl.task import Features, Now, Rate, S, Setup, Task, TaskReward
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.schema.select import matching
from tgdsl.tensors.env_ids import put_rows

FREE_SHARE = 0.95  # share of a joint's range that costs nothing
Force = Annotated[float, Quantity("force", gt=0.0)]
Speed = Annotated[float, Quantity("speed", gt=0.0)]


class Term(SpecModel, ABC):
    """A term that a document adds to its task; its fields are the term's parameters.

    `Now` holds what a term may read. All methods return tensors of all environments and change nothing: on a GPU they are part
    of a captured step, so no Python branch may depend on a tensor's value.
    """

    senses: ClassVar[tuple[str, ...]] = ()  # kinds of sensors that it reads: see `Task.senses`
    constants: ClassVar[tuple[str, ...]] = ()  # parameters that no curriculum can change
    watches_links: ClassVar[bool] = False  # whether it reads the poses of `Setup.links`: `now.watched.body(link)`
    term: str | None = None
    """The term: a name, or `package.module:Class` or `file.py:Class`; default: its key in the document."""


class RewardTerm(Term):
    """A term of the reward."""

    unit: ClassVar[str] = "1/s"  # of its weight
    weight: Number
    """Factor on its rate: more than 0 for a gain, less for a penalty."""

    @abstractmethod
    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        """Return its rate without the weight; the reward is the sum of all rates times Δt."""

    @classmethod
    def of_task(cls, weight: float, **parameters: str) -> TaskReward:
        """Return the term as one of a task's reward.

        Args:
            weight: Its default weight.
            parameters: Key of the task's document for each parameter of the term.
        """

        def rate_of(task: Task) -> Rate:
            return partial(cls.for_spec(task.spec, parameters).rate, setup=task.setup)

        summary = (cls.__doc__ or "").partition("\n")[0].rstrip(".")
        return TaskReward(weight, cls.unit, summary, rate_of, None, cls, parameters)

    @classmethod
    def for_spec(cls, spec: TaskSpec, parameters: Mapping[str, str]) -> Self:
        """Return the term with the parameters that a task's document has, its weight aside."""
        return cls.model_construct(weight=1.0, **{name: getattr(spec, key) for name, key in parameters.items()})


class TerminationTerm(Term):
    """A condition that terminates an episode."""

    @abstractmethod
    def is_over(self, now: Now, setup: Setup) -> Bool[Tensor, " env"]:
        """Return which episodes end."""


class ObservationTerm(Term):
    """A group of observations, with the name that the term has in the document."""

    @abstractmethod
    def observe(self, now: Now, setup: Setup) -> Float[Tensor, "env feature"]:
        """Return the group."""

    def describe(self, setup: Setup) -> Sequence[Features]:
        """Describe its features, in order; none: they are "not described"."""
        return ()


@dataclass(frozen=True, eq=False)
class Event:
    """An event that happens now."""

    sim: Simulation  # the simulation; its `arrays` and `properties` may be changed, of the chosen environments alone
    setup: Setup  # the setup of the environments
    actuation: Actuation  # the drives
    chosen: Bool[Tensor, " env"]  # the environments in which it happens: decide by this mask, not by `if`
    count: Int[Tensor, " env"]
    """Resets of each environment; for events at intervals, events so far, with the episode in the upper 32 bits."""
    stream: str  # purpose of its random numbers

    def shares(self, num: int) -> Float[Tensor, "env num"]:
        """Return random numbers between 0 and 1, float32, new for each event."""
        return self.setup.draws.shares({self.stream: num}, self.count, self.chosen)[self.stream]

    def uniform(self, num: int, low: float = 0.0, high: float = 1.0) -> Float[Tensor, "env num"]:
        """Return random numbers between two bounds, of physics' dtype, new for each event."""
        return within(self.shares(num).to(self.setup.dtype), low, high)


class EventTerm(Term):
    """A change of the simulation, at each reset or after random intervals."""

    changes_model: ClassVar[bool] = False  # whether it changes the scene's model: at a reset it happens before the others
    per_env: ClassVar[tuple[str, ...]] = ()  # properties of objects that differ between environments: see `tgdsl.simulate`
    mode: Literal["reset", "interval"] = "interval"
    """When it happens."""
    interval: Annotated[Range, RangeOf("time", gt=0.0)] = (2.0, 4.0)
    """Time from the end of one to the start of the next, drawn for each [s]."""

    @abstractmethod
    def apply(self, event: Event) -> None:
        """Change the simulation."""

    def num_steps(self, control_step: float) -> int:
        """Return how many control steps it lasts; by default none."""
        return 0

    def end(self, event: Event) -> None:
        """Change the simulation where it ends, and where an episode begins; by default nothing."""


def event_term(function: Callable[..., None]) -> type[EventTerm]:
    """Return the term of a function of an `Event`: its other parameters, with annotations and defaults, are the term's."""
    parameters = list(inspect.signature(function, eval_str=True).parameters.values())[1:]
    fields: dict[str, Any] = {
        parameter.name: (parameter.annotation, ... if parameter.default is parameter.empty else parameter.default)
        for parameter in parameters
    }

    def apply(self: EventTerm, event: Event) -> None:
        function(event, **{name: getattr(self, name) for name in fields})

    base = type(
        function.__name__, (EventTerm,), {"apply": apply, "__module__": function.__module__, "__doc__": function.__doc__}
    )
    return create_model(function.__name__, __base__=base, **fields)


class CurriculumTerm(Term):
    """A number of the task or of a term that follows the progress of learning."""

    of: str
    """The number: `rewards.effort`, `hold.coasting_pay`, `max_spin`, or `terms.slip.weight`."""

    @abstractmethod
    def value(self, iteration: int, score: float | None) -> float:
        """Return the number.

        Args:
            iteration: Number of iterations so far.
            score: Mean score of the episodes that have ended last, in `Task.score_unit`; None: none has ended yet.
        """

    def extremes(self) -> tuple[float, ...]:
        """Return numbers that the document is checked with; by default the first one."""
        return (self.value(0, None),)


class ActionRate(RewardTerm):
    """Change of the action, |a_t − a_{t−1}|²."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return (now.action - now.past_actions[:, 0]).square().sum(dim=1)


class JointLimit(RewardTerm):
    """How far joints are beyond the middle 95 % of their ranges, Σ_j max(0, |q_j − m_j| − 0.95 h_j)."""

    unit = "1/(rad s)"

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        middle, half = 0.5 * (setup.low + setup.high), 0.5 * (setup.high - setup.low)
        return ((now.joint_pos - middle).abs() - FREE_SHARE * half).clamp(min=0.0).sum(dim=1)


class Work(RewardTerm):
    """Power of the drives, braking included, Σ_j |τ_j q̇_j|."""

    unit = "1/J"

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return (now.torque * now.joint_vel).abs().sum(dim=1)


class Effort(RewardTerm):
    """Squares of the torques as shares of the largest ones, Σ_j (τ_j/τ_max,j)²; a drive without a limit makes none."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return (now.torque / setup.max_torque).square().sum(dim=1)


class ContactForce(RewardTerm):
    """Force on links beyond `max_force`, Σ_l max(0, |f_l| − f_max)/f_max."""

    senses = ("link_contact",)
    max_force: Force = 10.0
    """f_max: less force on a link costs nothing [N]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        return ((vector_norm(now.link_force, dim=2) - self.max_force).clamp(min=0.0) / self.max_force).sum(dim=1)


class Near(RewardTerm):
    """How near the probes of `surface_distance` are to the object, mean_p exp(−max(0, d_p)/λ): from 0 to 1, which is touch."""

    senses = ("surface_distance",)
    width: PositiveLength = 0.02
    """λ, decay length of `near` [m]."""
    nearest: Whole | None = None
    """How many of the nearest probes count; null: all."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        distance = now.distance
        if self.nearest is not None:
            distance = distance.topk(min(self.nearest, distance.shape[1]), dim=1, largest=False).values
        return torch.exp(-distance.clamp(min=0.0) / self.width).mean(dim=1)


class NetForce(RewardTerm):
    """Net force of the links on the object beyond `free`, min(max(0, |Σ_l f_l| − f_free), f_most)."""

    senses = ("link_contact",)
    watches_links = True
    unit = "1/(N s)"
    free: Force = 1.0
    """f_free: a smaller net force costs nothing [N]."""
    most: Force = 20.0
    """f_most: largest force beyond `free` that counts [N]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        quat = torch.stack([now.watched.body(link).quat for link in setup.links], dim=1)
        net = rotations.rotated(quat, now.link_force).sum(dim=1)
        return (vector_norm(net, dim=1) - self.free).clamp(min=0.0).clamp(max=self.most)


class ObjectSpeed(RewardTerm):
    """Speed and spin of the object beyond the free ones, max(0, |v|/v_free − 1) + max(0, |ω|/ω_free − 1)."""

    free_speed: Speed = 0.2
    """v_free: a slower object costs nothing [m/s]."""
    free_spin: Positive = 4.0
    """ω_free: the same for its angular velocity, about any axis [rad/s]."""

    def rate(self, now: Now, setup: Setup) -> Float[Tensor, " env"]:
        speed, spin = vector_norm(now.object.linvel, dim=1), vector_norm(now.object.angvel, dim=1)
        return (speed / self.free_speed - 1.0).clamp(min=0.0) + (spin / self.free_spin - 1.0).clamp(min=0.0)


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


class ScoreLimit(TerminationTerm):
    """The episode's score has reached a number; of tasks whose score grows."""

    most: Number
    """The number, in the score's unit."""

    def is_over(self, now: Now, setup: Setup) -> Bool[Tensor, " env"]:
        return now.score >= self.most


class LinkForce(ObservationTerm):
    """The object's force on each link, in the link's frame [N]."""

    senses = ("link_contact",)
    links: Annotated[tuple[str, ...], Field(min_length=1)] = ("*",)
    """Names or shell wildcards of the links, which stand in the order of the `link_contact` sensor."""

    def observe(self, now: Now, setup: Setup) -> Float[Tensor, "env feature"]:
        return torch.cat([now.link_force[:, i] for i in self.rows(setup)], dim=1)

    def describe(self, setup: Setup) -> Sequence[Features]:
        return groups.link_forces([setup.links[i] for i in self.rows(setup)])

    def rows(self, setup: Setup) -> list[int]:
        """Return which links are observed; raise `SimulationError` if a name or wildcard matches none."""
        for pattern in self.links:
            if not matching(pattern, setup.links):
                raise SimulationError(f'no link matches "{pattern}"; {did_you_mean(pattern, setup.links, "links")}')
        return [i for i, link in enumerate(setup.links) if any(matching(pattern, [link]) for pattern in self.links)]


class ObjectState(ObservationTerm):
    """Position [m], six numbers of the orientation, velocity [m/s] and angular velocity [rad/s] of the object."""

    def observe(self, now: Now, setup: Setup) -> Float[Tensor, "env feature"]:
        return groups.object_motion(now)

    def describe(self, setup: Setup) -> Sequence[Features]:
        return groups.object_state(setup).features


class ObjectVelocity(EventTerm):
    """The object, which moves freely, is given more velocity, as by a knock."""

    speed: Annotated[Range, RangeOf("speed")] = (0.0, 0.0)
    """Velocity along each of the world's axes that is added [m/s]."""
    spin: Annotated[Range, RangeOf("number")] = (0.0, 0.0)
    """Angular velocity about each of the object's axes that is added [rad/s]."""

    def apply(self, event: Event) -> None:
        first = int(event.setup.model.body(event.setup.object).dofadr[0])
        share = event.uniform(6)
        added = torch.cat([within(share[:, :3], *self.speed), within(share[:, 3:], *self.spin)], dim=1)
        event.sim.arrays["qvel"][:, first : first + 6] += torch.where(event.chosen[:, None], added, 0.0)


class ResetEvent(EventTerm):
    """A change of the scene's parameters, by default at each reset."""

    changes_model = True
    mode: Literal["reset", "interval"] = "reset"
    """When it happens."""


class Friction(ResetEvent):
    """The object's coefficient of sliding friction is the scene's times a factor."""

    per_env = ("friction",)
    factor: Factor
    """The factor."""

    def apply(self, event: Event) -> None:
        setup = event.setup
        put_rows(setup.friction, event.chosen, setup.scene_friction * within(event.shares(1), *self.factor)[:, 0])
        event.sim.properties.set(event.chosen, friction={setup.object: setup.friction})


class Mass(ResetEvent):
    """The object's mass is the scene's plus a random mass."""

    per_env = ("mass",)
    added: Annotated[Range, RangeOf("mass", ge=0.0)]
    """Mass added [kg]."""

    def apply(self, event: Event) -> None:
        setup = event.setup
        put_rows(setup.mass, event.chosen, setup.scene_mass + within(event.shares(1), *self.added)[:, 0])
        event.sim.properties.set(event.chosen, mass={setup.object: setup.mass})


class Placement(ResetEvent):
    """The object, which moves freely, starts upright where the keyframe has the first variant, moved and turned at random."""

    mode: Literal["reset"] = "reset"  # pyright: ignore[reportIncompatibleVariableOverride]
    """When it happens."""
    xy: Annotated[Range, RangeOf("length")] = ZERO
    """Offset of the object's start along the world's x and y, each [m]."""
    yaw: Annotated[Range, RangeOf("angle")] = ZERO
    """Rotation of the object about the vertical [rad]."""

    def apply(self, event: Event) -> None:
        setup, item = event.setup, event.setup.free_qpos()
        shares = setup.draws.shares({event.stream: 2, "yaw": 1}, event.count, event.chosen)
        xy, yaw = (within(shares[name], *ends).to(setup.dtype) for name, ends in ((event.stream, self.xy), ("yaw", self.yaw)))
        up = torch.eye(3, dtype=setup.dtype, device=setup.device)[2].expand(setup.num_envs, 3)
        pos, quat = setup.scene_start[:, item].split([3, 4], dim=1)
        pos = torch.cat([pos[:, :2] + xy, pos[:, 2:]], dim=1)
        quat = rotations.product(rotations.about(up, yaw[:, 0]), quat)
        put_rows(setup.start[:, item], event.chosen, torch.cat([pos, quat], dim=1))


class Drive(ResetEvent):
    """New drive parameters are drawn within `randomise.drive`."""

    def apply(self, event: Event) -> None:
        event.actuation.draw(event.chosen, event.count)


class Push(EventTerm, PushSpec):
    """A force in world axes, uniform in a box, acts at the centre of mass of the object's body for a while.

    Source of forces and intervals: Chung et al., *Tactile Genesis*, appendix, "Domain Randomization". It does not give the
    duration of a force: a control step is our choice.
    """

    constants = ("duration",)

    def apply(self, event: Event) -> None:
        counted = replace(event, count=event.count - 1)  # from 0
        share = counted.uniform(3)
        force = torch.stack([within(share[:, i], *getattr(self, axis)) for i, axis in enumerate("xyz")], dim=1)
        put_rows(self._applied(event), event.chosen, force)

    def num_steps(self, control_step: float) -> int:
        return math.ceil(self.duration / control_step - 1e-9)

    def end(self, event: Event) -> None:
        put_rows(self._applied(event), event.chosen, 0.0)

    def _applied(self, event: Event) -> Float[Tensor, "env 3"]:
        return event.sim.arrays["xfrc_applied"][:, int(event.setup.model.body(event.setup.object).id), :3]


class Linear(CurriculumTerm):
    """`start` up to `first`, `end` from `last` on, and linear between: of iterations, or of the score."""

    by: Literal["iteration", "score"] = "iteration"
    """Its variable; before an episode has ended the score counts as `first`."""
    first: Number
    """Where the change begins, in iterations or in the score's unit."""
    last: Number
    """Where the change ends; less than `first` for a score to minimise."""
    start: Number
    """The number before the change."""
    end: Number
    """The number after it."""

    @model_validator(mode="after")
    def _check(self) -> Linear:
        if self.first == self.last:
            raise ValueError(f"first and last are both {self.first:g}, expected a change that takes some time")
        if self.by == "iteration" and self.last < self.first:
            raise ValueError(f"last, iteration {self.last:g}, is before first, {self.first:g}")
        return self

    def extremes(self) -> tuple[float, ...]:
        return self.start, self.end

    def value(self, iteration: int, score: float | None) -> float:
        x = iteration if self.by == "iteration" else self.first if score is None else score
        share = min(1.0, max(0.0, (x - self.first) / (self.last - self.first)))
        return self.start + share * (self.end - self.start)


class HandTask(Task[S]):
    """Base of tgdsl's tasks, with their common reward terms; a task repeats one for another weight or place in the sum."""

    action_rate = ActionRate.of_task(-5e-4)
    work = Work.of_task(-5e-3)


def term_name(term: type[Term]) -> str:
    """Return the name of a term in documents: `object_speed` of `ObjectSpeed`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", term.__name__).lower()


_TERMS = (
    *(ActionRate, JointLimit, Work, Effort, ContactForce, Near, NetForce, ObjectSpeed, ForceLimit, SpeedLimit, ScoreLimit),
    *(LinkForce, ObjectState, ObjectVelocity, Friction, Mass, Placement, Drive, Push, Linear),
)


def _wrong(term: object) -> str:
    if not (isinstance(term, type) and issubclass(term, Term)):
        return f"found {term!r}, expected a subclass of {Term.__module__}.Term"
    lacks = sorted(getattr(term, "__abstractmethods__", ()))
    return f"{term.__name__} lacks {listed(lacks)}" if lacks else ""


TERMS = Registry("tgdsl.terms", "term", "terms", _TERMS, _wrong, term_name)
"""The terms that documents may name; packages bring others by the entry points `tgdsl.terms`."""
