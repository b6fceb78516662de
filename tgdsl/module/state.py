"""The state of a scene: a module's input from simulators and hardware.

Shapes: `env` environments, `body` bodies of a module's `inputs.bodies`, `pair` pairs of its `inputs.pairs`, `slot` contacts per
pair, `object` objects of its `inputs.objects`, `heated` objects of its `inputs.heated`, `joint` joints of its `inputs.joints`,
`actuator` actuators of its `inputs.actuators`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, get_args, get_type_hints

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from tgdsl.errors import StateError, listed
from tgdsl.module.memory import EVERY
from tgdsl.plan.inputs import Inputs
from tgdsl.plan.plan import Plan
from tgdsl.sensors.base import Kind
from tgdsl.tensors.buffers import Constants
from tgdsl.tensors.env_ids import EnvIds, env_mask, is_out_of_sight
from tgdsl.tensors.on_host import HostCopy

CHOICES = ("variant", "object_material")  # integer fields: indices into an object's variants and materials


@dataclass
class SceneState:
    """Input of a module: poses, contacts and joints of all environments at one instant.

    A module reads only the fields that `touch.inputs.fields` lists; all others may be None.

    All vectors are in the world frame. Floats may be float64 with a float32 module: relative poses are computed in the state's
    dtype and then cast, so that precision does not depend on the distance from the origin.

    NaN is not zero: all readings that depend on it, in its environment, are NaN, also behind `contact_found`. On a CPU the
    module warns once about NaN poses; on a GPU, check `readings[name].isnan()`. A contact slot is unused if force, torque and
    normal are all zero. A contact with a zero normal still has a force; readings that need its normal are NaN.

    Attributes:
        body_pos: Position of each body's frame [m].
        body_quat: Orientation of each body, w, x, y, z.
        body_linvel: Velocity of the body frame's origin, not of the centre of mass [m/s].
        body_angvel: Angular velocity of the body [rad/s].
        contact_found: Whether each (link, object) pair is in contact: boolean, or a number that is positive in contact, such
            as the number of contacts. `inputs.parts_of` lists an object's geoms, `inputs.parts_of_link` a link's.
        contact_pos: Contact points [m].
        contact_force: Force on the link at each point [N].
        contact_torque: Torque on the link at each point [N·m].
        contact_normal: Unit normal out of the object at each point.
        contact_netforce: Total force of the pair on the link [N]. Force beyond the slots acts at the centre of the slots.
        variant: Index of each object's variant, from 0; 0 without variants.
        object_size: Size of each object as MuJoCo defines it [m], such as half-lengths; for objects with `size: per_env`.
        object_temperature: Temperature of each object of `inputs.heated` at the start of an episode [°C]; for objects with
            `temperature: {per_env: …}`.
        object_material: Index of the material of each object of `inputs.heated`, from 0; 0 with one material.
        joint_pos: Position of each joint at the instant of the bodies' poses [rad; slides: m].
        joint_vel: Velocity of each joint at that instant [rad/s; slides: m/s].
        joint_effort: Torque of the actuators on each joint at that instant [N·m; slides: N].
        last_action: Control of each actuator at that instant, in its unit; before the first step, the control of the start.
        dt: Time since the last state [s].
        time: Time of the instant in each environment, on MuJoCo's clock [s]. Simulators set it; no module reads it.
        substeps: States after the earlier physics steps since the last call, oldest first; this state is the last one. Only
            read if `inputs.substeps` is more than 1. Right after a reset all of them equal this state.
    """

    body_pos: Float[Tensor, "env body 3"] | None = None
    body_quat: Float[Tensor, "env body 4"] | None = None
    body_linvel: Float[Tensor, "env body 3"] | None = None
    body_angvel: Float[Tensor, "env body 3"] | None = None
    contact_found: Shaped[Tensor, "env pair"] | None = None
    contact_pos: Float[Tensor, "env pair slot 3"] | None = None
    contact_force: Float[Tensor, "env pair slot 3"] | None = None
    contact_torque: Float[Tensor, "env pair slot 3"] | None = None
    contact_normal: Float[Tensor, "env pair slot 3"] | None = None
    contact_netforce: Float[Tensor, "env pair 3"] | None = None
    variant: Int[Tensor, "env object"] | None = None
    object_size: Float[Tensor, "env object 3"] | None = None
    object_temperature: Float[Tensor, "env heated"] | None = None
    object_material: Int[Tensor, "env heated"] | None = None
    joint_pos: Float[Tensor, "env joint"] | None = None
    joint_vel: Float[Tensor, "env joint"] | None = None
    joint_effort: Float[Tensor, "env joint"] | None = None
    last_action: Float[Tensor, "env actuator"] | None = None
    dt: float | None = None
    time: Float[Tensor, " env"] | None = None
    substeps: tuple[SceneState, ...] = ()

    def to(self, *args: Any, **kwargs: Any) -> SceneState:
        """Return the state with `torch.Tensor.to` applied to every tensor; a dtype does not apply to integers."""
        values: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        moved: dict[str, Any] = {n: v.to(*args, **kwargs) if isinstance(v, Tensor) else v for n, v in values.items()}
        for name in CHOICES:
            if moved[name] is not None:
                moved[name] = moved[name].to(values[name].dtype)
        moved["substeps"] = tuple(part.to(*args, **kwargs) for part in self.substeps)
        return SceneState(**moved)

    def checked(self, inputs: Inputs, device: torch.device, with_dt: bool = True) -> dict[str, Tensor]:
        """Return the tensors that a module on a device reads; `with_dt`: whether `dt` is required, if it is read."""
        required = [name for name in inputs.fields if name != "dt" or with_dt]
        if missing := [name for name in required if getattr(self, name) is None]:
            hint = "; set `state.dt` to the seconds since the last call" if "dt" in missing else ""
            raise StateError(f"SceneState lacks {', '.join(missing)}, which this module reads{hint}")
        tensors = {name: _checked(name, getattr(self, name), inputs, device) for name in inputs.fields if name != "dt"}
        num_envs = tensors["body_pos"].shape[0]
        for name, value in tensors.items():
            if value.shape[0] != num_envs:
                raise StateError(f"SceneState.{name} holds {value.shape[0]} environments, body_pos {num_envs}")
        if device.type == "cpu":  # on a GPU this would synchronise; there the kernel asserts
            _check_choices("variant", tensors, inputs.objects, inputs.num_variants)
            _check_choices("object_material", tensors, inputs.heated, inputs.num_materials)
        return tensors


def _axes(hint: Any) -> tuple[str | int, ...]:
    dims = getattr(next(iter(get_args(hint)), None), "dim_str", "").split()[1:]
    return tuple(int(dim) if dim.isdigit() else dim for dim in dims)


# shape of each tensor of a state that modules read, after the leading `env`
SHAPES = {name: axes for name, hint in get_type_hints(SceneState).items() if (axes := _axes(hint))}


def _check_choices(field: str, tensors: Mapping[str, Tensor], names: Sequence[str], counts: Sequence[int]) -> None:
    for i, (name, num) in enumerate(zip(names, counts, strict=True) if field in tensors else ()):
        column = tensors[field][:, i]
        if ((column < 0) | (column >= num)).any():
            invalid = min(int(v) for v in column.tolist() if not 0 <= v < num)
            raise StateError(f"SceneState.{field} of object {name} is {invalid}, expected 0 to {num - 1}")


def shape_of(name: str, inputs: Inputs) -> tuple[int, ...]:
    """Return a field's shape for a module, after the leading `env`."""
    return tuple([inputs.sizes[part] if isinstance(part, str) else part for part in SHAPES[name]])


def _checked(name: str, value: Any, inputs: Inputs, device: torch.device) -> Tensor:
    want = shape_of(name, inputs)
    if not isinstance(value, Tensor):
        raise StateError(f"SceneState.{name} is a {type(value).__name__}, expected a torch tensor")
    if value.ndim != len(want) + 1 or tuple(value.shape[1:]) != want:
        expected = ", ".join(map(str, want))
        names = "".join(f"; {axis}: {listed(axis_names)}" for axis, axis_names in inputs.names.items() if axis in SHAPES[name])
        raise StateError(f"SceneState.{name} has shape {tuple(value.shape)}, expected (env, {expected}){names}")
    if value.device != device:
        raise StateError(f"SceneState.{name} is on {value.device}, the module on {device}")
    dtypes = (torch.int64, torch.int32) if name in CHOICES else (torch.float32, torch.float64)
    if name != "contact_found" and value.dtype not in dtypes:
        raise StateError(f"SceneState.{name} is {value.dtype}, expected {' or '.join(map(str, dtypes))}")
    return value


def example_state(inputs: Inputs, num_envs: int, seed: int, dtype: torch.dtype, spread: float) -> SceneState:
    """Return a random state of all wanted fields, with bodies close enough to touch: see `TactileModule.example_state`.

    Contacts lie around their links, with unit normals and forces inside a friction cone of 0.5; every third slot is unused, and
    the net force is the slots' sum.
    """
    generator = torch.Generator().manual_seed(seed)
    values: dict[str, Any] = {}
    for name in (name for name in inputs.fields if name in SHAPES):
        value = torch.randn((num_envs, *shape_of(name, inputs)), generator=generator, dtype=dtype)
        if name == "body_pos":
            value = spread * value
        elif name == "body_quat":
            value = value / value.norm(dim=-1, keepdim=True)
        elif name == "contact_found":
            value = value > -1.0
        elif name in CHOICES:
            counts = inputs.num_variants if name == "variant" else inputs.num_materials
            value = torch.arange(num_envs)[:, None] % torch.tensor(counts)
        elif name == "object_size":
            value = 0.015 + 0.01 * value.clamp(-1, 1)
        elif name == "object_temperature":
            value = 30.0 + 15.0 * value.clamp(-1, 1)
        values[name] = value
    if "contact_force" in values:
        values |= _contacts(values, inputs, spread)
    if "dt" in inputs.fields:
        values["dt"] = inputs.dt or 0.01
    if inputs.substeps > 1:
        one = replace(inputs, substeps=1, fields=tuple(name for name in inputs.fields if name != "dt"))
        seeds = torch.randint(2**62, (inputs.substeps - 1,), generator=generator).tolist()
        values["substeps"] = tuple(example_state(one, num_envs, substep_seed, dtype, spread) for substep_seed in seeds)
    return SceneState(**values)


def _contacts(values: Mapping[str, Tensor], inputs: Inputs, spread: float) -> dict[str, Tensor]:
    """Turn random numbers into contacts that a solver could have found."""
    is_used = (torch.arange(inputs.slots) % 3 != 2)[:, None]
    links = values["body_pos"][:, [inputs.bodies.index(pair.link) for pair in inputs.pairs], None]
    normal = values["contact_normal"] / values["contact_normal"].norm(dim=-1, keepdim=True)
    along = (values["contact_force"] * normal).sum(dim=-1, keepdim=True)
    tangential = values["contact_force"] - along * normal
    result = {
        "contact_pos": links + spread * values["contact_pos"],
        "contact_force": along.abs() * (normal + 0.5 * tangential / (tangential.norm(dim=-1, keepdim=True) + 1.0)),
        "contact_torque": 1e-3 * along * normal,
        "contact_normal": normal,
    }
    result = {name: torch.where(is_used, value, 0.0) for name, value in result.items()}
    return {**result, "contact_netforce": result["contact_force"].sum(dim=2)}


TOLERANCE = 1e-3  # part of a pair's force that slots may lack unnoticed: far above the rounding of a single-precision sum
SAME_TIME = 1e-9  # relative difference up to which two times are equal: rounding of a call's time divided by its substeps


class SlotWatch:
    """Warns, once for each pair, of contacts beyond the slots."""

    def __init__(self, inputs: Inputs):
        self._inputs = inputs
        fields = {"contact_found", "contact_force", "contact_netforce"}
        self._num_pairs = len(inputs.pairs) if inputs.slots and fields <= set(inputs.fields) else 0
        self._warned: set[int] = set()
        self._num_calls = 0
        self._wanted: Tensor | None = None  # slots that each pair would need; 0: it has enough
        self._copy = HostCopy()

    @property
    def is_done(self) -> bool:
        """Whether there is nothing left to warn of."""
        return len(self._warned) >= self._num_pairs

    def note(self, tensors: Mapping[str, Tensor]) -> None:
        """Check a state on its device; on a GPU one in `EVERY`: the check's small kernels take as long as a module's."""
        whole, force, count = (tensors[f"contact_{name}"] for name in ("netforce", "force", "found"))
        self._num_calls += 1
        if whole.is_cuda and self._num_calls % EVERY != 1 and not torch.cuda.is_current_stream_capturing():
            return
        with torch.inference_mode(False), torch.no_grad():
            if self._wanted is None or self._wanted.device != whole.device:
                self._wanted = torch.zeros(whole.shape[1], dtype=torch.float32, device=whole.device)
                self._copy = HostCopy()
        with torch.no_grad():
            lacking = (whole - force.sum(dim=2)).abs().amax(dim=-1)
            largest = force.abs().amax(dim=(2, 3))
            slots = count.to(torch.float32).clamp(min=self._inputs.slots + 0.5)  # a state's count may be a boolean
            is_crowded = (count > self._inputs.slots) & (largest > 0)
            slots = torch.where((lacking > TOLERANCE * (whole.abs().amax(dim=-1) + largest)) | is_crowded, slots, 0.0)
            self._wanted.copy_(torch.cat([self._wanted[None], slots]).amax(dim=0))

    def warn(self) -> None:
        """Warn of crowded pairs. It does not synchronise with a GPU: the warning may come a call or more later."""
        num_contacts = None if self._wanted is None else self._copy.poll(self._wanted)
        numbers = [] if num_contacts is None else num_contacts.tolist()
        new = [i for i, number in enumerate(numbers) if number and i not in self._warned]
        if not new:
            return
        self._warned.update(new)
        slots, most = self._inputs.slots, max(numbers[i] for i in new)
        which = listed([f"{self._inputs.pairs[i].link} – {self._inputs.pairs[i].object}" for i in new])
        enough = f"slots: {int(most)}" if most > slots + 0.5 else "more slots"
        problem = f"contacts of {which} are more than `slots: {slots}`: what the others carry acts at the centre of those shown"
        warnings.warn(f"{problem}; `{enough}` would do", stacklevel=6)


class Incoming:
    """Reads a module's tensors from states, and warns once of each oddity."""

    def __init__(self, plan: Plan, kinds: Mapping[str, Kind], constants: Constants):
        self._plan, self._kinds, self._constants = plan, kinds, constants
        self._timesteps = {sensor.name: sensor.timestep for sensor in plan.sensors if sensor.timestep}
        self._dt: tuple[float, Tensor] | None = None
        self._warned: set[str] = set()
        self.slot_watch = SlotWatch(plan.inputs)

    @property
    def held_dt(self) -> object:
        """The time between calls and its tensor: another object after each change."""
        return self._dt

    def tensors(self, state: SceneState, dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
        """Return the fields that are read, by name; fields of earlier substeps as `substep/<i>/<field>`."""
        inputs = self._plan.inputs
        if not isinstance(state, SceneState):
            problem = f"a module reads a tgdsl.SceneState, found {type(state).__name__}"
            raise StateError(f"{problem}; expected sim.state(), or one that holds {', '.join(inputs.fields)}")
        tensors = state.checked(inputs, device)
        if state.dt is not None and "dt" in inputs.fields:
            tensors["dt"] = self._dt_tensor(state.dt, dtype, device)
        if not self.slot_watch.is_done and not torch.compiler.is_compiling():
            self.slot_watch.note(tensors)
            self.slot_watch.warn()
        # Our simulators, which set the time, detect faults themselves.
        if state.time is None and "poses" not in self._warned and not is_out_of_sight(tensors["body_pos"]):
            self._check_poses(tensors)
        if inputs.substeps > 1:
            tensors |= self._substeps(state, device, len(tensors["body_pos"]))
        return tensors

    @staticmethod
    def mask_of(mask: Tensor | None, env_ids: EnvIds | None, num_envs: int, device: torch.device) -> Bool[Tensor, " env"]:
        """Return the mask of the environments that a caller selects by a mask or by indices."""
        if mask is not None and env_ids is not None:
            raise StateError("found both `mask` and `env_ids`, expected one of them")
        if mask is not None and not (isinstance(mask, Tensor) and mask.dtype == torch.bool and mask.shape == (num_envs,)):
            given_type = f"{mask.dtype} {tuple(mask.shape)}" if isinstance(mask, Tensor) else type(mask).__name__
            raise StateError(f"mask: found {given_type}, expected a boolean tensor ({num_envs},); indices go to `env_ids`")
        return env_mask(mask if mask is not None else env_ids, num_envs, device, StateError, waits=False)

    def _substeps(self, state: SceneState, device: torch.device, num_envs: int) -> dict[str, Tensor]:
        """Return the fields of earlier substeps."""
        inputs, result = self._plan.inputs, {}
        if not (isinstance(state.substeps, (tuple, list)) and all(isinstance(part, SceneState) for part in state.substeps)):
            raise StateError("SceneState.substeps: expected a tuple of tgdsl.SceneState")
        if len(state.substeps) != inputs.substeps - 1:
            problem = f"SceneState.substeps holds {len(state.substeps)} states, expected {inputs.substeps - 1}"
            raise StateError(
                f"{problem}: this module reads each of {inputs.substeps} physics steps of a call, the last one itself"
            )
        for i, part in enumerate(state.substeps):
            for name, value in part.checked(inputs, device, with_dt=False).items():
                if len(value) != num_envs:
                    raise StateError(f"SceneState.substeps[{i}].{name} holds {len(value)} environments, body_pos {num_envs}")
                result[f"substep/{i}/{name}"] = value
        return result

    def _check_poses(self, tensors: Mapping[str, Tensor]) -> None:
        """Warn of environments with a pose that is not finite, the first time."""
        poses = [tensors[name].detach().sum(dim=(1, 2)) for name in ("body_pos", "body_quat") if name in tensors]
        is_bad = ~sum(poses).isfinite()  # type: ignore[union-attr]
        if is_bad.any():
            self._warned.add("poses")
            envs = listed([str(env) for env in is_bad.nonzero().flatten().tolist()])
            problem = f"poses of bodies are not finite in environments {envs}: what depends on them is read as not-a-number"
            warnings.warn(f"{problem}; warned once, and never of states on a GPU: look for NaN in readings", stacklevel=7)

    def _dt_tensor(self, dt: float, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return dt as a tensor that is written only when it changes."""
        if shape := getattr(dt, "shape", ()):
            raise StateError(f"SceneState.dt has shape {tuple(shape)}, expected one number for all environments [s]")
        if not 0 < dt < math.inf:
            raise StateError(f"SceneState.dt is {dt}, expected a finite time above 0 s")
        if self._dt is None or self._dt[0] != dt:
            self._check_rates(dt)
            self._retime(dt)
        if self._dt is None or self._dt[0] != dt or self._dt[1].device != device or self._dt[1].dtype != dtype:
            with torch.inference_mode(False):
                self._dt = dt, torch.tensor(dt, dtype=dtype, device=device)
        return self._dt[1]

    def _retime(self, dt: float) -> None:
        """Recompute a kind's constants for another time between its calls, and warn the first time."""
        for sensor in (sensor for sensor in self._plan.sensors if sensor.name in self._timesteps):
            step_dt, retimed = dt / max(sensor.substeps, 1), self._kinds[sensor.name].retimed
            if math.isclose(step_dt, self._timesteps[sensor.name], rel_tol=SAME_TIME):
                continue
            if math.isclose(step_dt, sensor.timestep, rel_tol=SAME_TIME):
                step_dt = sensor.timestep
            elif sensor.sensor not in self._warned:
                self._warned.add(sensor.sensor)
                problem = f'"{sensor.sensor}" is compiled for {sensor.substeps or 1} steps of {sensor.timestep:g} s per call'
                warnings.warn(f"{problem}, and the state's dt is {dt:g} s: it counts steps of {step_dt:g} s", stacklevel=6)
            self._timesteps[sensor.name] = step_dt
            for name, value in ({} if retimed is None else retimed(sensor.constants, step_dt)).items():
                self._constants.overwrite(f"sensors/{sensor.name}/{name}", value)

    def _check_rates(self, dt: float) -> None:
        """Warn of sensors that would take samples more often than they are called, the first time."""
        for sensor in self._plan.sensors:
            if 0 < sensor.period < (1 - 1e-6) * dt and sensor.sensor not in self._warned:
                self._warned.add(sensor.sensor)
                problem = f'"{sensor.sensor}" has a rate of {1 / sensor.period:g} Hz but is called every {dt:g} s'
                warnings.warn(f"{problem}: it takes a sample at every call", stacklevel=5)
