"""The keys that all task documents share: sensors, joints, physics, touch, actions and randomisation."""

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
    """Return, by word of `touch:`, the kind of the policy's sensor, and the type of observation of its reading."""
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
    """Options of the physics; null keeps the scene's value."""

    collision: Literal["mesh", "primitive"] | None = None
    """Collision geoms of the robot's links; default: `robot.collision` of the sensors' document."""

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
    """Largest number of solver iterations."""
    ls_iterations: Whole | None = None
    """Largest number of line-search iterations."""
    tolerance: NonNegative | None = None
    """Termination tolerance of the solver."""
    ls_tolerance: NonNegative | None = None
    """Termination tolerance of its line search."""
    impratio: Positive | None = None
    """Ratio of frictional to normal impedance."""
    solref: tuple[Time, Positive] | None = None
    """MuJoCo's `solref` of all contacts: time constant [s], at least two timesteps, and damping ratio. A contact's stiffness
    also depends on the colliding masses and on `solimp`."""
    solimp: tuple[Impedance, Impedance, Radius, Impedance, Power] | None = None
    """MuJoCo's `solimp` of all contacts: impedances at zero and at the width, width [m], midpoint, power."""
    max_torque: dict[str, Annotated[float, Quantity("torque", gt=0.0)]] = {}
    """Largest torque of the drives, by names or shell wildcards of joints; default: the robot's [N·m; slides: N]."""
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
    """Strength and timing of an object's pushes."""

    x: ForceRange = ZERO
    """Force along the world's x [N]."""
    y: ForceRange = ZERO
    """Force along the world's y [N]."""
    z: ForceRange = ZERO
    """Force along the world's z [N]."""
    interval: Annotated[Range, RangeOf("time", gt=0.0)] = (2.0, 4.0)
    """Time from the end of one push to the start of the next, drawn for each [s]."""
    duration: Time = 0.025
    """Duration of a push, rounded up to control steps [s]."""


class RandomSpec(SpecModel):
    """Values drawn at each reset; keys left out are not random."""

    friction: Factor = ONE
    """Factor on the object's coefficient of sliding friction."""
    mass: Annotated[Range, RangeOf("mass", ge=0.0)] = ZERO
    """Mass added to the object [kg]."""
    drive: DriveSpec = DriveSpec()
    """The drives of the joints."""
    push: PushSpec = PushSpec()
    """Forces that push the object."""


class PlacedRandomSpec(RandomSpec):
    """Random values of a task with a free object: its placement too."""

    xy: Annotated[Range, RangeOf("length")] = ZERO
    """Offset of the object's start along the world's x and y, each [m]."""
    yaw: Annotated[Range, RangeOf("angle")] = ZERO
    """Rotation of the object about the vertical [rad]."""


class ProprioSpec(SpecModel):
    """Noise and scale of the group `proprio`."""

    pos_noise: Annotated[float, Quantity("angle", ge=0.0)] = 0.0
    """Standard deviation of normal noise on positions, drawn at each control step [rad; slides: m]."""
    vel_noise: NonNegative = 0.0
    """The same on velocities, before scaling [rad/s; slides: m/s]."""
    vel_scale: Positive = 1.0
    """Factor on velocities."""


class TaskSpec(SpecModel):
    """Keys of all tasks."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    task: str
    """A task of tgdsl by name, such as `in_palm_rotate`; one of your own as `package.module:Class`, or as `file.py:Class`
    with the file relative to this document."""
    document: str
    """The sensors' document, relative to this one: robot, scene, objects and sensors. Only the sensors needed are compiled."""
    sensors: dict[str, dict[str, Any]] = {}
    """Changes of the sensors' document, by sensor: `{near: {radius: 4 mm}}`."""
    object: str
    """The task's object in the sensors' document."""
    variants: Annotated[tuple[Annotated[StrictInt, Field(ge=0)], ...], Field(min_length=1)] | None = None
    """Indices of the object's variants in the sensors' document, from 0; default: all."""
    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    """Joints that the policy moves: names or shell wildcards, in the order of the actuators; the others are held."""
    keyframe: str | None = None
    """The scene's keyframe that episodes start from; default: the model's initial state."""
    physics: PhysicsSpec = PhysicsSpec()
    """Options of the physics."""
    episode: Annotated[float, Quantity("time", gt=0.0), Field(le=1e6)] = 10.0
    """Duration of an episode [s]."""
    touch: TouchType = "force_torque"
    """The policy's type of touch."""
    placement: str = "hand"
    """Links with touch: a link group of the layout."""
    resolution: str | None = None
    """A taxel resolution of the layout; default: the sensors' document's."""
    joint_vel: Literal["exact", "measured"] = "exact"
    """Velocities of `proprio`: `exact`, from the simulation; or `measured`, as a hand computes them: differences of positions
    at each control step through a low-pass filter of 20 ms. `priv_proprio` always has exact ones."""
    proprio: ProprioSpec = ProprioSpec()
    """Noise and scale of `proprio`; `priv_proprio` has neither."""
    temporal: Literal["last", "stack"] = "last"
    """Readings of a control step in `tactile_sensors`: after its `last` physics step, or a `stack` of all of them in order."""
    noise: str = "clean"
    """A noise profile of the sensors' document, or the built-in `clean` or `noisy`."""
    action: ActionSpec = ActionSpec()
    """Meaning of a policy's action."""
    randomise: RandomSpec = RandomSpec()
    """Values drawn at each reset."""
    terms: dict[str, dict[str, Any]] = {}
    """Additional rewards, terminations, observations, events and curricula: see `tgdsl.rl.terms`."""
    train: TrainSpec = TrainSpec()
    """Training of a policy: `tgdsl train`."""
    distill: DistillSpec = DistillSpec()
    """Training of students from a trained policy: `tgdsl distill`."""
