"""What the document of every task says: sensors, joints, physics, touch, actions, and what is random."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, StrictInt, model_validator

from tgdsl.errors import did_you_mean
from tgdsl.fields.models import NonNegative, Positive, Quantity, Radius, Range, RangeOf, SpecModel
from tgdsl.observations.observations import TYPES, ForceObservation, OfReading, ReadingObservation
from tgdsl.rl.actuation import ONE, ZERO, ActionSpec, DriveSpec, Factor
from tgdsl.rl.students.spec import DistillSpec
from tgdsl.rl.train.spec import Time, TrainSpec, Whole


def touch_types() -> dict[str, tuple[str, type[OfReading]]]:
    """Return, by word of `touch:`, the kind of sensor that a policy feels with, and the type of observation of its reading."""
    named = {
        name: (model.task_kind, model)
        for name, model in TYPES.by_name().items()
        if issubclass(model, OfReading) and model.task_kind
    }
    return named | {"force_taxel": ("force_taxel", ForceObservation), "temperature": ("temperature_grid", ReadingObservation)}


def _touch_type(name: str) -> str:
    names = ("none", *touch_types())
    if name not in names:
        raise ValueError(f'unknown type "{name}"; {did_you_mean(name, names, "types")}')
    return name


TouchType = Annotated[
    str, AfterValidator(_touch_type), Field(json_schema_extra=lambda schema: schema.update(enum=["none", *touch_types()]))
]
ForceRange = Annotated[Range, RangeOf("force")]
Impedance = Annotated[float, Quantity("number", ge=1e-4), Field(le=0.9999)]  # between the bounds that MuJoCo has
Power = Annotated[float, Quantity("number", ge=1.0)]


class PhysicsSpec(SpecModel):
    """How physics is stepped; what is left out is the scene's."""

    collision: Literal["mesh", "primitive"] | None = None
    """What the robot's links collide with, in place of what the sensors' document says: see `robot.collision` there."""

    timestep: Time = 0.005
    """Duration of a physics step [s]."""
    substeps: Whole = 5
    """Physics steps per control step."""
    cone: Literal["elliptic", "pyramidal"] | None = None
    """Friction cone."""
    solver: Literal["Newton", "CG", "PGS"] | None = None
    """Solver of the constraints."""
    integrator: Literal["Euler", "implicit", "implicitfast"] | None = None
    """Integrator."""
    iterations: Whole | None = None
    """Most iterations of the solver."""
    ls_iterations: Whole | None = None
    """Most iterations of its line search."""
    tolerance: NonNegative | None = None
    """Where the solver stops."""
    ls_tolerance: NonNegative | None = None
    """Where its line search stops."""
    impratio: Positive | None = None
    """Ratio of friction's impedance to that of the normal force."""
    solref: tuple[Time, Positive] | None = None
    """Of all contacts, as MuJoCo's geoms have it: time constant [s], at least two timesteps, and damping ratio. A contact's
    stiffness is also by the masses that meet, and by `solimp`."""
    solimp: tuple[Impedance, Impedance, Radius, Impedance, Power] | None = None
    """Of all contacts, as MuJoCo's geoms have it: impedances at first and at the width, width [m], midpoint, power."""
    max_torque: dict[str, Annotated[float, Quantity("torque", gt=0.0)]] = {}
    """By names or shell wildcards of joints, the largest torque of their drives in place of the robot's [N·m; slides: N]."""
    nconmax: Whole | None = None
    """On a GPU, capacity for contacts per environment."""
    njmax: Whole | None = None
    """On a GPU, capacity for rows of constraints in each environment."""

    @model_validator(mode="after")
    def _check(self) -> PhysicsSpec:
        if self.solref is not None and self.solref[0] < 2.0 * self.timestep:
            least = f"expected at least two timesteps, {2 * self.timestep:g} s: MuJoCo would take that"
            raise ValueError(f"solref has a time constant of {self.solref[0]:g} s, {least}")
        return self

    @property
    def options(self) -> dict[str, Any]:
        """MuJoCo's options that differ from the scene's."""
        options = self.model_dump(exclude={"collision", "substeps", "nconmax", "njmax"}, exclude_none=True)
        return {name: value.lower() if isinstance(value, str) else value for name, value in options.items() if value != {}}

    @property
    def capacities(self) -> dict[str, int]:
        """MuJoCo Warp's capacities that differ from its defaults."""
        return self.model_dump(include={"nconmax", "njmax"}, exclude_none=True)


class PushSpec(SpecModel):
    """How strongly and how often an object is pushed."""

    x: ForceRange = ZERO
    """Force along the world's x [N]."""
    y: ForceRange = ZERO
    """Force along the world's y [N]."""
    z: ForceRange = ZERO
    """Force along the world's z [N]."""
    interval: Annotated[Range, RangeOf("time", gt=0.0)] = (2.0, 4.0)
    """Time from the end of one push to the begin of the next, drawn for each [s]."""
    duration: Time = 0.025
    """How long a push lasts, rounded up to control steps [s]."""


class RandomSpec(SpecModel):
    """Values that are drawn at each reset; a key that is left out is not random."""

    friction: Factor = ONE
    """Factor on the object's coefficient of sliding friction."""
    mass: Annotated[Range, RangeOf("mass", ge=0.0)] = ZERO
    """What is added to the object's mass [kg]."""
    drive: DriveSpec = DriveSpec()
    """The drives of the joints."""
    push: PushSpec = PushSpec()
    """Forces that push the object."""


class PlacedRandomSpec(RandomSpec):
    """Of a task whose object is put down freely: where."""

    xy: Annotated[Range, RangeOf("length")] = ZERO
    """What is added to the object's place along the world's x and y, each [m]."""
    yaw: Annotated[Range, RangeOf("angle")] = ZERO
    """By how much the object is turned about the vertical [rad]."""


class ProprioSpec(SpecModel):
    """How a policy observes its joints, in the group `proprio`."""

    pos_noise: Annotated[float, Quantity("angle", ge=0.0)] = 0.0
    """Standard deviation of normal noise on positions, drawn at each control step [rad; slides: m]."""
    vel_noise: NonNegative = 0.0
    """The same on velocities, before they are scaled [rad/s; slides: m/s]."""
    vel_scale: Positive = 1.0
    """Factor on velocities."""


class TaskSpec(SpecModel):
    """What all tasks have in common."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    task: str
    """A task of tgdsl by name, such as `in_palm_rotate`; one of your own as `package.module:Class`, or as `file.py:Class`
    with the file relative to this document."""
    document: str
    """The sensors' document, relative to this one: robot, scene, objects and sensors, of which those needed are taken."""
    sensors: dict[str, dict[str, Any]] = {}
    """What is otherwise than in the sensors' document, by sensor: `{near: {radius: 4 mm}}`."""
    object: str
    """The document's object that the task is about."""
    variants: Annotated[tuple[Annotated[StrictInt, Field(ge=0)], ...], Field(min_length=1)] | None = None
    """Which of the object's variants there are, by their places in the sensors' document, from 0; default: all."""
    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    """Joints that the policy moves: names or shell wildcards, in the order of the actuators; the others are held."""
    keyframe: str | None = None
    """The scene's keyframe that episodes start from; default: the model's own initial state."""
    physics: PhysicsSpec = PhysicsSpec()
    """How physics is stepped."""
    episode: Annotated[float, Quantity("time", gt=0.0), Field(le=1e6)] = 10.0
    """Duration of an episode [s]."""
    touch: TouchType = "force_torque"
    """What a policy feels."""
    placement: str = "hand"
    """Links that feel: a link group of the layout."""
    resolution: str | None = None
    """How densely, as the layout has it; default: as the sensors' document says."""
    joint_vel: Literal["exact", "measured"] = "exact"
    """What velocities `proprio` has: those of the simulation, or what a hand makes of the positions that it reports at each
    control step, by differences through a low-pass filter of 20 ms; `priv_proprio` always has the former."""
    proprio: ProprioSpec = ProprioSpec()
    """Noise and scale of `proprio`; `priv_proprio` has neither."""
    temporal: Literal["last", "stack"] = "last"
    """Which readings of a control step `tactile_sensors` has: that of its last physics step, or those of all of them, the
    first one first."""
    noise: str = "clean"
    """A noise profile of the sensors' document, or the built-in `clean` or `noisy`."""
    action: ActionSpec = ActionSpec()
    """How an action is understood."""
    randomise: RandomSpec = RandomSpec()
    """Values that are drawn at each reset."""
    terms: dict[str, dict[str, Any]] = {}
    """Terms of reward, reasons to end and groups of observations that are added to the task's: see `tgdsl.rl.terms`."""
    train: TrainSpec = TrainSpec()
    """How a policy is learned: `tgdsl train`."""
    distill: DistillSpec = DistillSpec()
    """How students are taught by a policy that is there: `tgdsl distill`."""
