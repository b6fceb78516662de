"""A task: start and end of an episode, observations, rewards and score.

A task is one file in `tgdsl/rl/tasks`, in a fixed order: a description of the task and its groups; the spec; then the class
with its terms, `reset`, `advance`, `is_over`, `observe`, `score`. Numbers of the document are read in each step, as a
curriculum may change them, except the `constants` of the class.

A term of the reward is a method marked by `reward_term`, or a shared one of `tgdsl.rl.terms` such as `near = Near.of_task(0.1,
width="near_width")`. The keys under `rewards` of the task's document follow from the terms, in their order; so do keys such as
`near_width`, unless the spec has them.

All methods take and return tensors of all environments, and change memory in place, so that on a GPU a whole step can be
captured as one CUDA graph: no Python branch depends on a tensor's value, and nothing is copied to the host. `is_over`,
`reward`, `observe` and `score` are compiled by torch on a GPU, and change nothing: `reset` and `advance` do.

Shapes: `env` environments, `joint` joints that the policy moves, `link` links that carry the `link_contact` sensor, `probe`
probes of the `surface_distance` sensor, `nq` and `nu` as in MuJoCo's model.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import mujoco
import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, create_model
from torch import Tensor

from tgdsl.console.tables import TaxelTable
from tgdsl.errors import SimulationError
from tgdsl.fields.models import Number, SpecModel
from tgdsl.rl.actuation import Actuators
from tgdsl.rl.draws import Draws
from tgdsl.rl.grasps.grasps import GraspTable
from tgdsl.rl.spec import TaskSpec
from tgdsl.runtime.simulators.model_ids import element_id
from tgdsl.runtime.simulators.state_values import Contacts, StateValues
from tgdsl.runtime.simulators.watch import BodyMotion, Watch, Watched
from tgdsl.tensors.env_ids import may_be_nonempty, put_rows

S = TypeVar("S", bound=TaskSpec)


def checked(what: str, value: object, num_envs: int, ndim: int = 1, dtype: torch.dtype | None = None) -> Tensor:
    """Return a value that a task or a term returns, validated: a tensor (env,) or (env, feature), of the dtype if not None.

    Raises:
        SimulationError: If it is something else.
    """
    if isinstance(value, Tensor) and value.ndim == ndim and len(value) == num_envs and dtype in (None, value.dtype):
        return value
    actual = f"of shape {tuple(value.shape)} and {value.dtype}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
    kind = f" of {dtype}" if dtype else ""
    raise SimulationError(f"{what} is {actual}, expected a tensor ({num_envs},{' …' if ndim > 1 else ''}){kind}")


def free_qpos(model: mujoco.MjModel, name: str) -> slice | None:
    """Return where a free body's position and quaternion stand in `qpos`; None if it does not move freely."""
    body = model.body(element_id(model, "body", name))
    first = int(model.jnt_qposadr[int(body.jntadr[0])])
    return slice(first, first + 7) if int(body.dofnum[0]) == 6 and int(body.jntnum[0]) == 1 else None


@dataclass(frozen=True, eq=False)
class Setup:
    """Scene, joints, object and random numbers of a task."""

    num_envs: int  # number of environments
    device: torch.device  # where physics runs, and a task's tensors are
    dtype: torch.dtype  # dtype of physics: float64 on a CPU, float32 on a GPU
    control_step: float  # duration of a control step Δt [s]
    model: mujoco.MjModel  # the compiled scene
    actuators: Actuators  # the joints that the policy moves
    low: Float[Tensor, " joint"]  # lower ends of these joints' ranges [rad]
    high: Float[Tensor, " joint"]  # upper ends [rad]
    max_torque: Float[Tensor, " joint"]  # largest torques of their drives [N·m]; infinite where there is no limit
    object: str  # body of the task's object
    links: tuple[str, ...]  # bodies of the rows of `Now.link_force`
    qpos: Float[Tensor, " nq"]  # the keyframe
    start: Float[Tensor, "env nq"]
    """Where episodes start: the keyframe, with each object where the first variant stands; a live tensor, in which the event
    `Placement` moves objects before `reset`."""
    half_height: Float[Tensor, " env"]
    """How far each environment's object reaches below its body's origin when it stands upright [m]."""
    variant: Int[Tensor, " env"]  # which of its variants each environment's object is, from 0
    num_variants: int  # how many there are; 1 if the object has none
    friction: Float[Tensor, " env"]  # coefficient of sliding friction of each object: a live tensor, redrawn before `reset`
    mass: Float[Tensor, " env"]  # mass of each object [kg], in the same way
    scene_start: Float[Tensor, "env nq"]  # `start` before anything is random
    scene_friction: Float[Tensor, " env"]  # `friction` before anything is random
    scene_mass: Float[Tensor, " env"]  # `mass` before anything is random
    draws: Draws  # random numbers
    rows: Mapping[str, tuple[str, TaxelTable]]
    """By kind of sensor that the task looks at: the name of its reading in `Now.readings`, and the table of its rows."""
    grasps: GraspTable | None = None  # grasps that episodes begin from; None if the task's document has none

    def free_qpos(self, body: str | None = None) -> slice:
        """Return where a free body's position and quaternion stand in `qpos`; default: the object's.

        Raises:
            SimulationError: If there is no such body, or it does not move freely.
        """
        name = body or self.object
        free = free_qpos(self.model, name)
        if free is None:
            raise SimulationError(f'the object\'s body "{name}" has no free joint, by which it could be put elsewhere')
        return free


@dataclass(frozen=True, eq=False)
class Now:
    """State of all environments at the instant of the readings, in world axes unless stated."""

    watched: Watched  # what the task watches, by name: see `Task.watch`
    object: BodyMotion
    """Motion of the object's body: position [m], quaternion w, x, y, z, velocity [m/s], angular velocity [rad/s]."""
    joint_pos: Float[Tensor, "env joint"]  # positions of the joints that the policy moves [rad]
    joint_vel: Float[Tensor, "env joint"]  # their velocities [rad/s]
    target: Float[Tensor, "env joint"]  # position targets of their drives after the last action [rad]
    torque: Float[Tensor, "env joint"]  # torques of their drives [N·m]
    action: Float[Tensor, "env joint"]  # last action, from −1 to 1; zero at the start of an episode
    past_actions: Float[Tensor, "env past joint"]  # actions of the three control steps before, the latest first
    link_force: Float[Tensor, "env link 3"]
    """The object's force on each link, in the link's frame [N]; no links if the task takes no `link_contact`."""
    normal_force: Float[Tensor, "env loaded"]
    """Sum of the normal forces of the object's contacts with each link [N]; no links unless the task `wants_normal_force`."""
    distance: Float[Tensor, "env probe"]
    """Distance from each probe to the object's surface, negative inside [m]; no probes without `surface_distance`."""
    friction: Float[Tensor, " env"]  # coefficient of sliding friction of the object
    mass: Float[Tensor, " env"]  # mass of the object [kg]
    readings: Mapping[str, Tensor]  # all readings of the module by name
    time: Float[Tensor, " env"]
    """MuJoCo's clock of each environment [s]; after a control step, the start of its last physics step."""
    score: Float[Tensor, " env"]
    """Score of the episode up to now, in `Task.score_unit`; in `Task.advance`, up to the control step before."""


@dataclass(frozen=True, eq=False)
class HandNow:
    """State of a hand without a scene: its joints, the last action and the goal."""

    joint_pos: Float[Tensor, "env joint"]  # positions of the joints that the policy moves [rad]
    joint_vel: Float[Tensor, "env joint"]  # their velocities [rad/s]
    target: Float[Tensor, "env joint"]  # position targets of their drives after the last action [rad]
    action: Float[Tensor, "env joint"]  # last action, from −1 to 1; zero at the start of an episode
    steps: int  # control steps since the start of the episode
    control_step: float  # duration of a control step Δt [s]
    goal: Float[Tensor, "env goal"]  # the goal, as `Task.asked` returns it


@dataclass(frozen=True)
class Features:
    """Adjacent features of one kind."""

    name: str  # name of the quantity; of a vector, its components in order: `force_x, force_y, force_z`
    size: int  # how many there are
    unit: str = "1"  # unit of the quantity, before it is scaled; "1" if it has none
    frame: str = ""  # axes of a vector's components: `world`, or `link`, the frame of the link; empty without a direction
    link: str = ""  # the body; empty if there is none
    scale: float = 1.0  # factor from the quantity to the features
    rows: range = range(0)  # rows of `env.touch.rows[sensor]`, one feature each: taxels or probes; else empty
    sensor: str = ""  # the reading; empty if there is none
    note: str = ""  # where the reading is cut off


class Part(NamedTuple):
    """Part of a group of observations: its numbers, (env, feature), and their description."""

    observe: Callable[[Now], Tensor]
    features: Sequence[Features]


class Start(NamedTuple):
    """How episodes begin."""

    values: StateValues
    """MuJoCo's arrays as for `sim.reset`, (env, …); rows of environments without a reset are ignored. `ctrl`, if present, sets
    the drives' targets; else drives hold the positions of their joints."""
    contacts: Contacts = "none"
    """As for `sim.reset`: "none" for an object without contact, or the contacts stored with a grasp."""


Rate = Callable[[Now], Float[Tensor, " env"]]  # a term of the reward without its weight


@dataclass(frozen=True)
class TaskReward:
    """A term of a task's reward."""

    weight: float  # its weight unless the document gives another
    unit: str  # unit of the weight
    summary: str  # its description, in a line
    rate_of: Callable[[Any], Rate]  # makes the term of a task
    name: str | None = None  # its name; default: the attribute's
    term: type[Any] | None = None  # the shared `RewardTerm`; None: the term is the task's alone
    parameters: Mapping[str, str] = field(default_factory=dict)
    """Key of the task's document for each parameter of the shared term."""

    def __get__(self, task: Task | None, owner: type[Task]) -> Any:
        return self if task is None else self.rate_of(task)


def reward_term(weight: float, unit: str, name: str | None = None) -> Callable[[Callable[[Any, Now], Tensor]], TaskReward]:
    """Mark a method of a task, which takes `Now` and returns a tensor (env,), as a term of its reward.

    Args:
        weight: Its default weight: more than 0 for a gain, less for a penalty.
        unit: Unit of the weight, such as "1/s": weight times term is a rate, the reward is the sum of all rates times Δt.
        name: Its name; default: the method's.
    """

    def mark(method: Callable[[Any, Now], Tensor]) -> TaskReward:
        summary = (method.__doc__ or "").partition("\n")[0].rstrip(".")
        return TaskReward(weight, unit, summary, lambda task: partial(method, task), name)

    return mark


class Task(ABC, Generic[S]):
    """A task of all environments."""

    Spec: ClassVar[type[TaskSpec]]  #: model of its document
    #: kinds of sensors that the task reads, in addition to the policy's touch: `link_contact` gives `now.link_force`,
    #: `surface_distance` gives `now.distance`
    senses: ClassVar[tuple[str, ...]] = ()
    #: whether it also reads the normal force of the `link_contact` sensor
    wants_normal_force: ClassVar[bool] = False
    score_unit: ClassVar[str]  #: unit of its score
    is_less_better: ClassVar[bool] = False  #: whether its score is an error
    #: least and largest possible score: confidence intervals end there
    score_range: ClassVar[tuple[float, float]] = (-math.inf, math.inf)
    #: names of the groups of `observe`, checked when a document is loaded; None: known only in environments
    own_groups: ClassVar[tuple[str, ...] | None] = None
    #: groups that `observe_hand` computes without a scene: a policy on a hand sees no others of the task
    hand_groups: ClassVar[tuple[str, ...]] = ()
    #: keys of its document that no curriculum can change, as `__init__` reads them
    constants: ClassVar[tuple[str, ...]] = ()
    #: units of the numbers of a goal that a user may give, such as ("N",); empty: users cannot give one
    goal_units: ClassVar[tuple[str, ...]] = ()
    terms: ClassVar[Mapping[str, TaskReward]] = {}  #: terms of its reward by name
    Rewards: ClassVar[type[SpecModel]] = SpecModel  #: model of their weights
    spec: S  #: its document
    setup: Setup  #: its setup
    memory: dict[str, Tensor]  #: its own state, (env, …) each, kept by `state_dict`
    parts: dict[str, list[Part]]  #: its groups of observations, which `__init__` may set

    def __init_subclass__(cls, **options: Any) -> None:
        """Collect the terms of the reward; add `rewards`, their weights, and their parameters to the document's model."""
        super().__init_subclass__(**options)
        if "own_groups" not in vars(cls) and vars(cls).keys() & {"__init__", "observe"}:
            cls.own_groups = None
        terms_of_class = {value.name or name: value for name, value in vars(cls).items() if isinstance(value, TaskReward)}
        is_first = not any(hasattr(base, "Spec") for base in cls.__bases__)  # of a base without a document terms stand last
        cls.terms = {**(terms_of_class if is_first else {}), **cls.terms, **terms_of_class}
        if cls.terms and hasattr(cls, "Spec") and (terms_of_class or "Spec" in vars(cls)):
            weight: Any = Number
            fields: dict[str, Any] = {
                name: (weight | None, Field(term.weight, description=f"{term.summary} [{term.unit}]."))
                for name, term in cls.terms.items()
            }
            doc = "Weights of the reward's terms; null leaves one out."
            cls.Rewards = create_model("Rewards", __base__=SpecModel, __module__=cls.__module__, __doc__=doc, **fields)
            base = cls.Spec
            shared = [(term.term.model_fields, term.parameters) for term in cls.terms.values() if term.term is not None]
            parameters = {key: numbers[name] for numbers, names in shared for name, key in names.items()}
            keys: dict[str, Any] = {
                key: (number.annotation, copy(number)) for key, number in parameters.items() if key not in base.model_fields
            }
            keys["rewards"] = (cls.Rewards, Field(cls.Rewards(), description="Weights of the reward's terms."))
            cls.Spec = create_model(base.__name__, __base__=base, __module__=cls.__module__, __doc__=base.__doc__, **keys)

    def __init__(self, spec: S, setup: Setup):
        self.spec, self.setup, self.memory, self.parts = spec, setup, {}, {}
        weights = getattr(spec, "rewards", None)
        self._rates = {name: term.rate_of(self) for name, term in self.terms.items() if getattr(weights, name) is not None}

    @classmethod
    def watch(cls, spec: S) -> Watch:
        """Return additional bodies, sites, joints and pairs to read; the object and the policy's joints are always read."""
        return Watch()

    def keep(self, name: str, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        """Add zeros (env, *shape) to the task's memory, in physics' dtype unless another is given; return them."""
        setup = self.setup
        self.memory[name] = torch.zeros((setup.num_envs, *shape), dtype=dtype or setup.dtype, device=setup.device)
        return self.memory[name]

    def begin(self, chosen: Bool[Tensor, " env"], **values: Tensor | float) -> None:
        """Set the memory of some environments, by name."""
        for name, value in values.items():
            tensor = self.memory[name]
            put_rows(tensor, chosen, value.to(tensor.dtype) if isinstance(value, Tensor) else value)

    @abstractmethod
    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> Start:
        """Reset the memory of some environments; return where their episodes begin.

        Args:
            chosen: The environments.
            episode: Number of resets of each environment: the counter of its random numbers.
        """

    @abstractmethod
    def advance(self, now: Now) -> None:
        """Update the memory: once per control step, after its physics."""

    def advance_healthy(self, now: Now, faults: Bool[Tensor, " env"]) -> None:
        """Update the memory, leaving environments with a fault unchanged."""
        saved_memory = {name: value.clone() for name, value in self.memory.items()} if may_be_nonempty(faults) else {}
        self.advance(now)
        for name, value in saved_memory.items():
            put_rows(self.memory[name], faults, value)

    @abstractmethod
    def is_over(self, now: Now) -> Bool[Tensor, " env"]:
        """Return which episodes terminate; the time limit is not part of it."""

    def reward(self, now: Now, is_over: Bool[Tensor, " env"]) -> dict[str, Float[Tensor, " env"]]:
        """Return the terms of the reward by name, weights included, as rates: the reward is their sum times Δt [1/s].

        Args:
            now: The instant after the control step.
            is_over: Which episodes have terminated.
        """
        weights: Any = getattr(self.spec, "rewards", None)
        return {name: getattr(weights, name) * rate(now) for name, rate in self._rates.items()}

    def observe(self, now: Now) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the groups of observations other than `proprio`, `tactile_sensors` and `priv_proprio`; default: `parts`.

        Raises:
            SimulationError: If the task has neither `observe` nor `parts`.
        """
        if not self.parts:
            problem = f"{type(self).__name__}: it has no `observe`, and sets no `self.parts`"
            raise SimulationError(f"{problem}; a task without groups returns {{}} from `observe`")
        return {group: torch.cat([part.observe(now) for part in parts], dim=1) for group, parts in self.parts.items()}

    def describe(self) -> Mapping[str, Sequence[Features]]:
        """Describe the features of `observe`, by group and in order; a missing group is "not described"."""
        return {group: [each for part in parts for each in part.features] for group, parts in self.parts.items()}

    def decoded(self, now: Now) -> dict[str, Float[Tensor, " env"]]:
        """Return the privileged numbers that `distill.decoders` may name for students to predict; by default none."""
        return {}

    def step_progress(self) -> Float[Tensor, " env"] | None:
        """Return the object's progress in this control step, such as an angle, negative for the wrong way; None without one.

        `tgdsl evaluate` reports the share of progress while no finger touches the object.
        """
        return None

    @classmethod
    def asked_for(cls, spec: S, goal: tuple[float, ...]) -> S:
        """Return the document with this goal, one number per entry of `goal_units`.

        Raises:
            LowerError: If the document does not allow this goal.
        """
        return spec

    def asked(self) -> Float[Tensor, "env goal"]:
        """Return the present goal, in `goal_units`; by default none."""
        return torch.zeros((self.setup.num_envs, 0), dtype=self.setup.dtype, device=self.setup.device)

    @classmethod
    def observe_hand(cls, spec: S, now: HandNow) -> dict[str, Float[Tensor, "env feature"]]:
        """Return `hand_groups` as `observe` does, from the state of a hand without a scene."""
        return {}

    @abstractmethod
    def score(self) -> Float[Tensor, " env"]:
        """Return how well each environment's episode has gone so far, in `score_unit`."""
