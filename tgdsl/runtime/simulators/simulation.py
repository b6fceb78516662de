"""Simulations of a module's scene: what users call, whichever engine steps the physics.

Shapes: `env` environments, `nq`, `nv` and `nu` as in MuJoCo's model.
"""

from __future__ import annotations

import dataclasses
import gc
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from numbers import Integral
from typing import Any, ClassVar, TypedDict, TypeVar, Unpack

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.runtime.simulators.faults import BAD_CONTROL, EnvFaults, OnFault
from tgdsl.runtime.simulators.fields import StateReader, warn_of_mocap
from tgdsl.runtime.simulators.model_ids import Joints, keyframe_id
from tgdsl.runtime.simulators.objects import EnvHeat, EnvObjects, ObjectProperties, SharedMeshModels, Values
from tgdsl.runtime.simulators.state_values import (
    INTEGRATED,
    Contacts,
    Control,
    NewValues,
    StartContacts,
    StateTable,
    StateValues,
    warn_of_range,
    write_controls,
)
from tgdsl.runtime.simulators.watch import Watch, Watched, WatchReader
from tgdsl.scene.options import Options
from tgdsl.tensors.env_ids import EnvIds, broadcast_over, env_indices, env_mask

T = TypeVar("T")


class SimOptions(TypedDict, total=False):
    """Options of a simulation; an engine knows some, its `OPTIONS`."""

    substeps: int
    """Physics steps per control step; default 1."""
    threads: int
    """CPU threads; default 0: one per CPU."""
    keyframe: str | None
    """Keyframe to start from; default: the model's own initial state."""
    options: Options | None
    """Fields of MuJoCo's `mjOption` that replace the scene's, by name and in its units, such as
    `{"timestep": 0.005, "cone": "pyramidal", "iterations": 10}`, and `solref` and `solimp` of all contacts."""
    watch: Watch | None
    """Names of bodies, sites, joints, actuators and pairs that `watched` returns, at the instant of readings."""
    per_env: Sequence[str]
    """Properties that may differ between environments: "mass" and "friction" for `properties`, on a GPU also fields of MuJoCo's
    model by name. On the CPU masses and frictions may always differ."""
    on_fault: OnFault
    """Treatment of environments that diverge, receive controls that are not finite, or, on a GPU, whose search for contacts of
    convex shapes runs out of room. "raise" (default): `step` raises until they are reset. "reset": they restart, in the
    simulator and in the module; on a GPU without waiting, and each `state` then evaluates all environments once more. "note":
    the caller checks `faults` and resets them. `fault_counts` counts all faults; "reset" and "note" warn once. Pools of MuJoCo
    Warp that are too small always raise."""
    nconmax: int | None
    """On a GPU, capacity for contacts per environment, in a pool that all share; default 48."""
    njmax: int | None
    """On a GPU, capacity for constraint rows per environment; default: enough for `nconmax` contacts and all limits."""
    model: mujoco.MjModel | None
    """A model that replaces the artefact's scene; its objects are the same in all environments. On the CPU it has to
    hold the contact sensors that `tgdsl.instrument` adds."""
    prepare: Callable[[mujoco.MjSpec], None] | None
    """On the CPU, changes the artefact's scene before it is compiled; bodies and contact sensors must stay."""
    graph: bool
    """Whether a GPU's work is captured as CUDA graphs (default); without them it is slower and easier to debug."""


class SubstepStates:
    """Copies of the states after all physics steps of a control step except the last."""

    def __init__(self, wanted: int):
        self.are_wanted, self._wanted = wanted > 1, wanted
        self._earlier: list[SceneState] = []
        self._restarted: Bool[Tensor, " env"] | None = None

    def begin(self, substeps: int) -> None:
        """Forget the last control step; the next one has so many physics steps."""
        if substeps != self._wanted:
            problem = f"this module has sensors that are advanced at {self._wanted} physics steps per call"
            raise SimulationError(
                f"{problem}, and this simulation makes {substeps} per control step; simulate with substeps={self._wanted}"
            )
        self._earlier, self._restarted = [], None

    def note(self, state: SceneState) -> None:
        """Keep a copy of the state after a physics step."""
        copies: dict[str, Any] = {name: value.clone() for name, value in vars(state).items() if isinstance(value, Tensor)}
        self._earlier.append(dataclasses.replace(state, **copies))

    def restart(self, chosen: Bool[Tensor, " env"]) -> None:
        """Note environments that have begun a new episode since: the earlier states are not of it."""
        if self._earlier:
            self._restarted = chosen.clone() if self._restarted is None else self._restarted | chosen

    def stepped(self, restarted: Bool[Tensor, " env"]) -> None:
        """Note that a replayed graph, which runs no Python, has written the states, and which environments it restarted."""
        if self._earlier:
            self._restarted = restarted.clone()

    def added_to(self, state: SceneState) -> SceneState:
        """Return a state with the earlier ones, which equal it in environments that have just begun an episode."""
        if not self.are_wanted:
            return state
        earlier = [self._mixed(state, then) for then in self._earlier] or [state] * (self._wanted - 1)
        return dataclasses.replace(state, substeps=tuple(earlier))

    def _mixed(self, now: SceneState, then: SceneState) -> SceneState:
        if self._restarted is None:
            return then
        values: dict[str, Any] = {name: value for name, value in vars(now).items() if isinstance(value, Tensor)}
        for name, value in values.items():
            is_new = broadcast_over(self._restarted.to(value.device), value)
            values[name] = torch.where(is_new, value, getattr(then, name))
        return dataclasses.replace(then, **values)


class Simulation(ABC):
    """Environments of one model, read by one module.

    **The instant of a state.** As with `mj_step`, `step` leaves poses, velocities and contacts at the start of the last
    physics step. `state`, `read`, `watched` and `time` refer to that instant, joints included: with `substeps=1` the instant
    before the step. After `reset`, `set_state` and `forward` they refer to the present. `qpos`, `qvel` and `ctrl` are live
    tensors and always hold present values.

    A module with state remembers each environment's episode. One simulation at a time reads it, until it is closed or
    garbage-collected.

    An engine implements the abstract methods; its `_start` sets `_arrays`, `_sources`, `_instant`, `_faults`, `_table`
    and `properties`.

    Attributes:
        model: The compiled scene; where objects differ between environments, the first environment's.
        substeps: Physics steps per control step.
        properties: Masses and frictions of objects, which may differ between environments.
        heat: Temperatures and materials of objects that hold heat, in live tensors.
        drive: Called before each physics step; may write into `qpos`, `qvel`, `ctrl` and the other live tensors: an
            actuator model that MuJoCo lacks. A GPU captures it with the step, so it must not synchronise with the GPU.
    """

    OPTIONS: ClassVar[tuple[str, ...]]  #: the options of `SimOptions` that this engine knows
    DEVICE: ClassVar[str] = "cpu"  #: the default device

    model: mujoco.MjModel
    substeps: int
    properties: ObjectProperties
    heat: EnvHeat
    drive: Callable[[], None] | None = None
    _device: torch.device
    _arrays: Mapping[str, Tensor]  # live, by MuJoCo's names: at least `INTEGRATED`
    _sources: Mapping[str, Tensor]  # arrays of the readers at the state's instant; copies where a step changes them
    _instant: Float[Tensor, " env"]
    _faults: EnvFaults
    _table: StateTable
    _objects: EnvObjects | None = None
    _watch: WatchReader | None = None
    _is_closed = False
    _has_warned_of_range = False

    def __init__(self, touch: TactileModule, num_envs: int, *, device: str | None = None, **options: Unpack[SimOptions]):
        """Start all environments of the scene that a module reads; see `SimOptions`.

        Raises:
            ArtifactError: If an asset of the scene is missing or has changed.
            SimulationError: If the model lacks a body, a contact sensor, the keyframe or a watched element, or holds something
                that the engine does not support; if the device or a library is missing; if there is nothing to step, more
                environments than there is memory for, or if the module's state is another simulation's or of other
                environments.
        """
        if unknown := [name for name in options if name not in self.OPTIONS]:
            hint = did_you_mean(unknown[0], self.OPTIONS, "options")
            raise SimulationError(f'{type(self).__name__} has no option "{unknown[0]}"; {hint}')
        self._touch, self.substeps = touch, options.get("substeps", 1)
        _refuse_unfit(touch, num_envs, options)
        self._device = self._open_device(device or self.DEVICE, options)
        inputs, model, watch = touch.inputs, options.get("model"), options.get("watch")
        if model is None:
            scenes = SharedMeshModels(touch.plan.scene, options.get("options"), options.get("prepare"))
            model = scenes.model({})
            if inputs.objects:
                self._objects = EnvObjects(scenes, inputs, num_envs)
        self.model, self._reader, readers = model, StateReader(inputs, model, self._device), []
        if watch is not None:
            self._watch = WatchReader(watch, inputs, model, self._device)
            readers = [self._watch.reader]
        self._start(num_envs, keyframe_id(model, options.get("keyframe")), options, [self._reader, *readers])
        self.heat = EnvHeat(inputs, num_envs, self._device, self.qpos.dtype)
        self._object_fields: dict[str, Tensor] = {}
        if self._objects is not None:
            variant, size = self._objects.variant, self._objects.object_size
            with torch.inference_mode(False):
                self._object_fields["variant"] = torch.from_numpy(variant.copy()).to(self._device)
                self._object_fields["object_size"] = torch.from_numpy(size.copy()).to(self._device, self.qpos.dtype)
        warn_of_mocap(inputs, model)
        self._earlier, self._start_contacts = SubstepStates(inputs.substeps), StartContacts(inputs)
        if touch.has_state:
            _READERS[touch] = weakref.ref(self)
        self.reset()

    @property
    def num_envs(self) -> int:
        return len(self.qpos)

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        return self.substeps * float(self.model.opt.timestep)

    @property
    def arrays(self) -> Mapping[str, Tensor]:
        """Live tensors (env, …) of MuJoCo's arrays by their names in `mjData`: at least the integrated ones."""
        return self._arrays

    @property
    def qpos(self) -> Float[Tensor, "env nq"]:
        """Positions of the joints now, as MuJoCo's `qpos`: a live tensor.

        Values written into it count from the next step on; use `set_state`, or call `forward`, to have `state` follow.
        """
        return self._arrays["qpos"]

    @property
    def qvel(self) -> Float[Tensor, "env nv"]:
        """Velocities of the joints now, as MuJoCo's `qvel`: a live tensor, as `qpos` is."""
        return self._arrays["qvel"]

    @property
    def ctrl(self) -> Float[Tensor, "env nu"]:
        """Controls of the actuators now, as MuJoCo's `ctrl`: a live tensor, as `qpos` is."""
        return self._arrays["ctrl"]

    @property
    def time(self) -> Float[Tensor, " env"]:
        """The state's instant by MuJoCo's clock [s]: after `step` a physics step before now."""
        self._refresh()
        return self._instant.clone()

    @cached_property
    def joints(self) -> Joints:
        """Where each joint stands: `sim.qpos[:, sim.joints["thumb"].qpos]`, `sim.qvel[:, sim.joints["thumb"].qvel]`."""
        return Joints(self.model)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of `qpos`."""
        return tuple(self.joints)

    @property
    def faults(self) -> Bool[Tensor, " env"]:
        """Environments with a fault that wait for a reset; with `on_fault="reset"`, restarted by the last step."""
        return self._faults.mask

    @property
    def fault_counts(self) -> Int[Tensor, " env"]:
        """Number of faults in each environment since the simulation began."""
        return self._faults.counts.clone()

    def step(self, control: Control = None) -> None:
        """Advance all environments by one control step; see the class for the instant that `state` then is of.

        Args:
            control: Actuator controls, (env, actuator), or (actuator,) for all environments; default: unchanged. Controls on
                a GPU are checked there. MuJoCo clips them to their ranges; host values far beyond them cause a warning.

        Raises:
            SimulationError: If controls do not fit, or a pool of MuJoCo Warp was too small; with `on_fault="raise"` also if
                controls are not finite or an environment diverged. The other environments have then made their step. On a
                GPU a later call may raise it.
        """
        self._begin_step(control)
        if not self._earlier.are_wanted:
            self._advance(self.substeps)
            return
        self._earlier.begin(self.substeps)
        fault = None
        for i in range(self.substeps):
            if i:
                self._earlier.note(self._state(float(self.model.opt.timestep)))
            try:
                self._advance(1)
            except SimulationError as error:  # the other environments make their step all the same
                fault = error
        self._earlier.restart(self._faults.restarted)
        if fault is not None:
            raise fault

    def substates(self, control: Control = None) -> Iterator[SceneState]:
        """Advance all environments as `step` does, and yield the state after each physics step, with its `dt`.

        For sensors that are read at every physics step: `for state in sim.substates(control): readings = touch(state)`. The
        first iteration sets the controls; leaving the loop early skips the remaining physics steps. With `on_fault="reset"`
        environments restart after the physics step of their fault, and continue from there.
        """
        self._begin_step(control)
        if self._earlier.are_wanted:
            self._earlier.begin(self.substeps)
        for i in range(self.substeps):
            self._advance(1)
            state = self._state(float(self.model.opt.timestep))
            if self._earlier.are_wanted:
                if i < self.substeps - 1:
                    self._earlier.note(state)
                self._earlier.restart(self._faults.restarted)
            yield state

    def state(self) -> SceneState:
        """Return the module's inputs at one instant (see the class), on its device; `dt` is the control step.

        For sensors that advance at each physics step, `substeps` holds the states after the earlier physics steps.
        """
        self._refuse_if_closed()
        return self._earlier.added_to(self._start_contacts.applied_to(self._state(self.control_step)))

    def read(self, env_ids: EnvIds | None = None) -> dict[str, Tensor]:
        """Return the module's readings of the present state: `touch(state())`, for some environments (default: all).

        The other environments' noise, delays and histories do not advance, and their rows repeat the last readings. Read all
        environments after a step, and the reset ones after a reset.
        """
        if env_ids is None:
            return self._touch(self.state())
        return self._touch(self.state(), env_mask(env_ids, self.num_envs, self._touch.device))

    def watched(self) -> Watched:
        """Return what the option `watch` names, of the instant that `state` is of, on the physics' device."""
        self._refuse_if_closed()
        if self._watch is None:
            raise SimulationError("nothing is watched: simulate(..., watch=Watch(bodies=(...), joints=(...)))")
        self._refresh()
        values = self._start_contacts.applied_to(self._watch.read(self._sources), is_stored=False)
        return self._watch.watched(values, self.state() if self._watch.has_pairs else None)

    def reset(self, env_ids: EnvIds | None = None, *, contacts: Contacts = "evaluate", **values: Unpack[StateValues]) -> None:
        """Begin a new episode in some environments (default: all), in the simulator and in the module.

        They start from the keyframe at time 0 with `values` applied, as `MjData` after `mj_resetData`, assignments and
        `mj_forward`. The other environments do not change. On a GPU a boolean mask and values on the device are used without
        waiting; for indices on the device, the host waits.

        Evaluating contacts and their forces costs about a physics step, on a GPU one of all environments. With
        `contacts="none"` only poses and velocities are evaluated: until the next step pairs are not in contact and no force
        acts, `joint_effort` included. A start in contact can be stored with its contacts: then `contacts` holds these fields
        of its state.

        Args:
            env_ids: Indices, or a boolean mask over environments.
            contacts: "evaluate"; "none"; or fields of `SceneState` by name (`contact_found`, `contact_netforce`,
                `joint_effort`, …), one row for all environments alike or (env, …), those left out being zero.
            **values: MuJoCo's `qpos`, `qvel`, `ctrl` or another array of the state, as for `set_state`.

        Raises:
            SimulationError: If there are no such environments, a value or `contacts` does not fit, numbers on the host are not
                finite, or MuJoCo reports an environment as failed.
        """
        self._refuse_if_closed()
        new, mask = self._table.rows(values, env_ids), env_mask(env_ids, self.num_envs, self._device)
        if contacts == "evaluate":
            self._start_contacts.forget(mask)
        else:
            self._start_contacts.place(mask, contacts)
        self._begin_episodes(mask, new, finds_contacts=contacts == "evaluate")
        self._touch.reset(mask)
        self._earlier.restart(mask)

    def set_state(self, env_ids: EnvIds | None = None, **values: Unpack[StateValues]) -> None:
        """Put some environments (default: all) into a state; their time and the module's memory go on.

        Derived quantities are evaluated as by `mj_forward`. The other environments do not change.

        Args:
            env_ids: Indices, or a boolean mask over environments.
            **values: MuJoCo's arrays of the state (`StateValues`); the rest stay. Each is one row for all environments, a row
                per index in their order, or (env, …) with a mask, whose other rows are ignored. Quaternions are normalised
                by MuJoCo's rule (`mju_normalize4`).

        Raises:
            SimulationError: If there are no such environments or arrays, a shape does not fit, or numbers on the host are not
                finite or hold a quaternion of length 0; nothing has changed. On a GPU such environments keep their state and
                have a fault.
        """
        self._refuse_if_closed()
        new, mask = self._table.rows(values, env_ids), env_mask(env_ids, self.num_envs, self._device)
        self._start_contacts.forget(mask)
        self._put(mask, new)
        self._evaluate(mask)

    def forward(self, env_ids: EnvIds | None = None) -> None:
        """Evaluate poses, velocities and contacts of some environments (default: all) where they are now, as `mj_forward` does.

        It costs about one physics step; forces follow from the present controls.
        """
        self._refuse_if_closed()
        mask = env_mask(env_ids, self.num_envs, self._device)
        self._start_contacts.forget(mask)
        self._evaluate(mask)

    def set_objects(
        self,
        variants: Mapping[str, Values] | None = None,
        sizes: Mapping[str, Values] | None = None,
        env_ids: EnvIds | None = None,
        *,
        temperatures: Mapping[str, Values] | None = None,
        materials: Mapping[str, Values] | None = None,
    ) -> None:
        """Choose variants and sizes of objects in some environments (default: all), and restart these; resets keep the choice.

        At first, environment i has variant i modulo their number. MuJoCo compiles one model per distinct choice: for a cube in
        the XHand1's palm, 10 ms; on the CPU each model is cached and takes 3 MB.

        Args:
            variants: Which variant of an object these environments have: (env,) integers, or one for all.
            sizes: Size of an object in them as MuJoCo defines it [m]: (env, size), or one for all.
            env_ids: Indices, or a boolean mask over environments.
            temperatures: Temperature of an object when an episode begins [°C]: (env,), or one for all.
            materials: Which of its materials an object is of: (env,) integers, or one for all.

        Raises:
            SimulationError: If there is no such object, variant, material or environment, or a value does not fit; nothing has
                changed.
        """
        if self._objects is None and (variants or sizes or not (temperatures or materials)):
            raise SimulationError("no object of this module differs between environments")
        ids = env_indices(env_ids, self.num_envs)
        heat = self.heat.choose(ids, temperatures or {}, materials or {})
        if self._objects is not None and (variants or sizes):
            self._objects.choose(ids, variants or {}, sizes or {})
            self._use_objects(self._objects)
            self._object_fields["variant"].copy_(torch.from_numpy(self._objects.variant))
            self._object_fields["object_size"].copy_(torch.from_numpy(self._objects.object_size))
        self.heat.write(ids, heat)
        self.reset(ids)

    def repeated(self, body: Callable[[], T]) -> Callable[[], T]:
        """Return a callable for work that repeats on the same tensors, such as a step, its reading and resets.

        On a GPU its third call captures one CUDA graph, and later calls replay it: results are then in the same tensors each
        time. It must not copy a value from the GPU, nor branch on one.
        """
        return body

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the environments' whole state; the module's is in its own `state_dict`."""
        result = self._saved_arrays() | {f"properties/{name}": value for name, value in self.properties.fields().items()}
        start = self._start_contacts
        if start.is_placed is not None:
            result |= {"start/is_placed": start.is_placed} | {f"start/{name}": value for name, value in start.values.items()}
        return {name: value.clone() for name, value in result.items()}

    def load_state_dict(self, saved: Mapping[str, Tensor]) -> None:
        """Go on where a simulation of the same scene, objects and number of environments was saved.

        Raises:
            SimulationError: If it was another one; nothing has changed.
        """
        self._refuse_if_closed()
        live = self._saved_arrays()
        wrong = [name for name, now in live.items() if name not in saved or saved[name].shape != now.shape]
        if wrong:
            raise SimulationError(f"this is the state of another simulation: {listed(wrong)} missing or of another shape")
        properties, start = (
            {name.removeprefix(part): value for name, value in saved.items() if name.startswith(part)}
            for part in ("properties/", "start/")
        )
        self.properties.set_fields(properties)
        with torch.no_grad():
            for name, now in live.items():
                now.copy_(saved[name])
            self._faults.clear(torch.ones_like(self._faults.mask))
        self.forward()
        contacts = {name: value.to(self._device) for name, value in start.items()}
        self._start_contacts.is_placed, self._start_contacts.values = contacts.pop("is_placed", None), contacts

    def close(self) -> None:
        """Release the module, so that another simulation can read it; this one can no longer be used."""
        self._is_closed = True
        if _reader_of(self._touch) is self:
            del _READERS[self._touch]

    @abstractmethod
    def body_poses(self, env: int) -> tuple[Float[np.ndarray, "body 3"], Float[np.ndarray, "body 4"]]:
        """Return where all bodies are in one environment at the state's instant: origins [m], quaternions w, x, y, z."""

    @abstractmethod
    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment, its objects as they are there."""

    @abstractmethod
    def _open_device(self, device: str, options: SimOptions) -> torch.device:
        """Load the engine's libraries and return the device."""

    @abstractmethod
    def _start(self, num_envs: int, keyframe: int, options: SimOptions, readers: Sequence[StateReader]) -> None:
        """Make the environments and the live arrays that readers read; `model`, `_objects` and `_watch` are there."""

    @abstractmethod
    def _contacts(self) -> dict[str, Tensor]:
        """Return the contacts that the module wants by field."""

    @abstractmethod
    def _refresh(self) -> None:
        """Evaluate environments whose evaluation was put off, so that the arrays are of the state's instant."""

    @abstractmethod
    def _advance(self, num_steps: int) -> None:
        """Make physics steps, and see to faults."""

    @abstractmethod
    def _begin_episodes(self, mask: Bool[Tensor, " env"], new: NewValues, *, finds_contacts: bool) -> None:
        """Restart environments with values, without the module. Unless `finds_contacts`, skip collision and forces."""

    @abstractmethod
    def _put(self, mask: Bool[Tensor, " env"], new: NewValues) -> None:
        """Write values into the state of environments."""

    @abstractmethod
    def _evaluate(self, mask: Bool[Tensor, " env"]) -> None:
        """Evaluate environments where they are, at once or by the next `_refresh`."""

    @abstractmethod
    def _use_objects(self, objects: EnvObjects) -> None:
        """Simulate the objects that were chosen."""

    def _state(self, dt: float) -> SceneState:
        self._refresh()
        return self._gathered(dt).to(self._touch.device)

    def _gathered(self, dt: float) -> SceneState:
        """Return the fields that the module wants from the arrays as they are, on the physics' device; `dt` in s."""
        values: dict[str, Any] = self.heat.read() | {"time": self._instant.clone()}
        values |= {name: field.clone() for name, field in self._object_fields.items()}
        values |= self._reader.read(self._sources) | self._contacts() | {"dt": dt}
        return SceneState(**{name: value for name, value in values.items() if name in (*self._touch.inputs.fields, "time")})

    def _begin_step(self, control: Control) -> None:
        self._refuse_if_closed()
        self._start_contacts.forget()
        self._faults.begin_step()
        if control is None:
            return
        self._faults.note(BAD_CONTROL, write_controls(control, self.ctrl, self._faults.on_fault == "raise"))
        self._has_warned_of_range = self._has_warned_of_range or warn_of_range(control, self.model)

    def _saved_arrays(self) -> dict[str, Tensor]:
        arrays = {f"state/{name}": self._arrays[name] for name in INTEGRATED}
        return arrays | self.heat.saved | {"faults/counts": self._faults.counts}

    def _refuse_if_closed(self) -> None:
        if self._is_closed:
            raise SimulationError("this simulation is closed; make another one")


_READERS: weakref.WeakKeyDictionary[TactileModule, weakref.ref[Simulation]] = weakref.WeakKeyDictionary()
"""The simulation that reads each module that has state."""


def _reader_of(touch: TactileModule) -> Simulation | None:
    reference = _READERS.get(touch)
    return None if reference is None else reference()


def _refuse_unfit(touch: TactileModule, num_envs: int, options: SimOptions) -> None:
    """Raise an error for what no simulation can do."""
    for name, count in (("num_envs", num_envs), ("substeps", options.get("substeps", 1))):
        if not isinstance(count, Integral) or isinstance(count, bool) or count < 1:
            raise SimulationError(f"{name} is {count!r}, expected a whole number of at least 1")
    has_model = options.get("model") is not None
    if has_model and touch.inputs.objects:
        problem = f"object {touch.inputs.objects[0]} differs between environments, which one model cannot"
        raise SimulationError(f"{problem}; leave `model` out")
    if has_model and options.get("options"):
        raise SimulationError("`options` are for the artefact's scene; a model of your own has them in its `opt`")
    if not touch.has_state:
        return
    if _reader_of(touch) is not None:
        gc.collect()  # a simulation that nobody holds may still hold itself
    if (other := _reader_of(touch)) is not None:
        raise SimulationError(
            f"this module is read by a simulation of {other.num_envs} environments, whose state it holds; `close` that one, or "
            "give this one another module: tgdsl.compile(...) again, or copy.deepcopy(touch)"
        )
    if touch.num_envs not in (None, num_envs):
        problem = f"this module holds the state of {touch.num_envs} environments, and num_envs is {num_envs}"
        raise SimulationError(f"{problem}; touch.free() frees it")


def refuse_two_instants(model: mujoco.MjModel, sleep: str) -> None:
    """Raise an error for a model whose state would not be of one instant; `sleep` is the message if its bodies may sleep."""
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        raise SimulationError("with the integrator RK4 MuJoCo's poses and contacts are of two instants; choose another one")
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        raise SimulationError(sleep)
