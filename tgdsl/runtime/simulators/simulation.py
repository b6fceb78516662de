"""What simulators of a module's scene have in common, whatever steps the physics.

Shapes: `env` environments, `nq`, `nv` and `nu` as in MuJoCo's model.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any, TypeVar, Unpack

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.controls import warn_of_range, write_controls
from tgdsl.runtime.simulators.claims import release
from tgdsl.runtime.simulators.faults import BAD_CONTROL, EnvFaults
from tgdsl.runtime.simulators.joints import Joints
from tgdsl.runtime.simulators.objects.choices import ObjectChoices, Values
from tgdsl.runtime.simulators.objects.heat import EnvHeat
from tgdsl.runtime.simulators.objects.properties import ObjectProperties
from tgdsl.runtime.simulators.start_contacts import Contacts, StartContacts
from tgdsl.runtime.simulators.state_values import INTEGRATED, Rows, StateTable, StateValues
from tgdsl.runtime.simulators.watch import Watched, WatchReader
from tgdsl.tensors.env_ids import EnvIds, broadcast_over, env_indices, env_mask


def saved_state(
    arrays: Mapping[str, Tensor],
    heat: Mapping[str, Tensor],
    properties: ObjectProperties,
    start: StartContacts,
    faults: EnvFaults,
) -> dict[str, Tensor]:
    """Return copies of a simulation's state by name."""
    is_placed, values = start.placed
    result = {f"state/{name}": arrays[name] for name in INTEGRATED} | dict(heat)
    result |= {f"properties/{name}": value for name, value in properties.fields().items()}
    if is_placed is not None:
        result |= {"start/is_placed": is_placed} | {f"start/{name}": value for name, value in values.items()}
    return {name: value.clone() for name, value in (result | {"faults/counts": faults.counts}).items()}


def load_state(
    saved: Mapping[str, Tensor],
    arrays: Mapping[str, Tensor],
    heat: Mapping[str, Tensor],
    properties: ObjectProperties,
    start: StartContacts,
    faults: EnvFaults,
    forward: Callable[[], None],
) -> None:
    """Put a simulation into a saved state, and evaluate poses and contacts there.

    Raises:
        SimulationError: If it is that of another simulation; nothing has changed.
    """
    wanted = {f"state/{name}": arrays[name] for name in INTEGRATED} | {**heat, "faults/counts": faults.counts}
    wrong = [name for name, now in wanted.items() if name not in saved or saved[name].shape != now.shape]
    if wrong:
        raise SimulationError(f"this is the state of another simulation: {listed(wrong)} missing or of another shape")
    own = {part: _below(saved, part) for part in ("properties", "start")}
    properties.set_fields(own["properties"])
    with torch.no_grad():
        for name, now in wanted.items():
            now.copy_(saved[name])
        faults.clear(torch.ones_like(faults.mask))
    forward()
    is_placed = own["start"].pop("is_placed", None)
    device = faults.counts.device
    start.placed = None if is_placed is None else (is_placed.to(device), {n: v.to(device) for n, v in own["start"].items()})


def _below(saved: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    return {name.removeprefix(f"{part}/"): value for name, value in saved.items() if name.startswith(f"{part}/")}


class SubstepStates:
    """Copies of the states after each physics step of the last control step but for the last one."""

    def __init__(self, inputs: Inputs):
        """Begin: no step was made yet."""
        self._wanted = inputs.substeps
        self._earlier: list[SceneState] = []
        self._restarted: Bool[Tensor, " env"] | None = None

    @property
    def are_wanted(self) -> bool:
        """Whether the module has sensors that are advanced at each physics step."""
        return self._wanted > 1

    def begin(self, substeps: int) -> None:
        """Forget the last control step; the next one has so many physics steps.

        Raises:
            SimulationError: If the module wants another number.
        """
        if substeps != self._wanted:
            steps = f"{self._wanted} physics step{'' if self._wanted == 1 else 's'}"
            what = f"this module has sensors that are advanced at {steps} per call"
            raise SimulationError(
                f"{what}, and this simulation makes {substeps} per control step; simulate with substeps={self._wanted}"
            )
        self._earlier, self._restarted = [], None

    def note(self, state: SceneState) -> None:
        """Keep a copy of the state after a physics step."""
        values = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
        copies: dict[str, Any] = {name: v.clone() if isinstance(v, Tensor) else v for name, v in values.items()}
        self._earlier.append(SceneState(**copies))

    def restart(self, chosen: Bool[Tensor, " env"]) -> None:
        """Note environments that have begun a new episode since: what was before is none of theirs."""
        if self._earlier:
            self._restarted = chosen.clone() if self._restarted is None else self._restarted | chosen

    def stepped(self, restarted: Bool[Tensor, " env"]) -> None:
        """Note that a captured step has written the states again, and which environments it has restarted.

        A replayed graph runs no Python: neither `begin` nor `restart`.
        """
        if self._earlier:
            self._restarted = restarted.clone()

    def added_to(self, state: SceneState) -> SceneState:
        """Return a state with the earlier ones; in environments that have just begun an episode they are as it is."""
        if not self.are_wanted:
            return state
        if not self._earlier:
            return dataclasses.replace(state, substeps=(state,) * (self._wanted - 1))
        restarted = self._restarted
        earlier = self._earlier if restarted is None else [_mixed(restarted, state, then) for then in self._earlier]
        return dataclasses.replace(state, substeps=tuple(earlier))


def _mixed(chosen: Bool[Tensor, " env"], now: SceneState, then: SceneState) -> SceneState:
    """Return the state of now in some environments, and that of then in the others."""
    mixed: dict[str, Any] = {}
    for field in dataclasses.fields(SceneState):
        new, old = getattr(now, field.name), getattr(then, field.name)
        if isinstance(new, Tensor):
            old = torch.where(broadcast_over(chosen.to(new.device), new), new, old)
        mixed[field.name] = old
    return SceneState(**mixed)


T = TypeVar("T")


class Simulation(ABC):
    """Environments of one model, read by one module.

    A module with state remembers each environment's episode: one simulation at a time reads it, from when it is made until it
    is closed or garbage-collected.

    Attributes:
        model: The compiled scene; where objects differ between environments, that of the first.
        substeps: Physics steps per control step.
        properties: Masses and frictions of objects, which environments may have of their own.
        heat: Temperatures and materials of objects that hold heat, in live tensors.
        drive: Is called before each physics step, and may write into `qpos`, `qvel`, `ctrl` and the other live tensors: what an
            actuator does that MuJoCo's does not. It is captured with the step on a GPU, so it must not wait for it there.
    """

    model: mujoco.MjModel
    substeps: int
    properties: ObjectProperties
    heat: EnvHeat
    drive: Callable[[], None] | None = None
    _touch: TactileModule
    _arrays: Mapping[str, Tensor]
    _faults: EnvFaults
    _table: StateTable
    _objects: ObjectChoices | None = None
    _watch: WatchReader | None = None
    _is_closed = False
    _has_warned_of_range = False

    @property
    @abstractmethod
    def num_envs(self) -> int:
        """Number of environments."""

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        return self.substeps * float(self.model.opt.timestep)

    @property
    def qpos(self) -> Float[Tensor, "env nq"]:
        """Positions of the joints, as MuJoCo's `qpos`: a live tensor.

        What is written into it counts from the next step on, and what `state` hands out stays that of the last step: use
        `set_state`, or call `forward`. After `step` it is where the environments are now.
        """
        return self._arrays["qpos"]

    @property
    def qvel(self) -> Float[Tensor, "env nv"]:
        """Velocities of the joints, as MuJoCo's `qvel`: a live tensor, as `qpos` is."""
        return self._arrays["qvel"]

    @property
    def ctrl(self) -> Float[Tensor, "env nu"]:
        """Controls of the actuators, as MuJoCo's `ctrl`: a live tensor, as `qpos` is."""
        return self._arrays["ctrl"]

    @property
    @abstractmethod
    def time(self) -> Float[Tensor, " env"]:
        """When the instant is that `state` and `read` are of, by MuJoCo's clock [s].

        After `step` it is a physics step before now: see `state`. Readings of two times within a control step differ by it.
        """

    @property
    @abstractmethod
    def arrays(self) -> Mapping[str, Tensor]:
        """Live tensors (env, …) of the arrays that MuJoCo integrates, by their names in `mjData`."""

    @abstractmethod
    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment, its objects as they are there."""

    @cached_property
    def joints(self) -> Joints:
        """Where each joint stands: `sim.qpos[:, sim.joints["thumb"].qpos]`, `sim.qvel[:, sim.joints["thumb"].qvel]`.

        A joint without a name goes by its body's, if the body has no other.
        """
        return Joints(self.model)

    @cached_property
    def _earlier(self) -> SubstepStates:
        """The states of the last control step's earlier physics steps."""
        return SubstepStates(self._touch.inputs)

    @cached_property
    def _start_contacts(self) -> StartContacts:
        """The contacts of environments that were placed since the last step without looking for contacts."""
        return StartContacts(self._touch.inputs)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of `qpos`."""
        return tuple(self.joints)

    @property
    def faults(self) -> Bool[Tensor, " env"]:
        """Environments that have diverged, or whose controls or given state were not finite.

        With `on_fault="reset"` those that the last step has restarted; else those that wait for a reset.
        """
        return self._faults.mask

    @property
    def fault_counts(self) -> Int[Tensor, " env"]:
        """How many times each environment has had a fault since the simulation was made."""
        return self._faults.counts.clone()

    def step(self, control: Tensor | np.ndarray | None = None) -> None:
        """Advance all environments by one control step.

        As with `mj_step`, poses, velocities and contacts are then those at the start of the last physics step, and `state`
        hands out these: with `substeps=1` what was before the step. `forward` evaluates them where the environments are now.

        Args:
            control: Actuator controls, (env, actuator) or (actuator,) for all alike; default: as they were. Those on a GPU
                are checked there. MuJoCo clips them to their ranges; one on the host that is far beyond is warned of.

        Raises:
            SimulationError: If controls do not fit, or a pool of MuJoCo Warp was too small; and with `on_fault="raise"` if
                controls are not finite or an environment has diverged. The other environments have then made their step. On a
                GPU as soon as it is known.
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

    def substates(self, control: Tensor | np.ndarray | None = None) -> Iterator[SceneState]:
        """Advance all environments by one control step, and hand out the state after each of its physics steps.

        For sensors that are read at every physics step: `for state in sim.substates(control): readings = touch(state)`. The
        simulator is where `step` would have left it once all are taken; who stops earlier has made fewer physics steps. With
        `on_fault="reset"` environments restart after the physics step of their fault, and make the others from there.

        Args:
            control: Actuator controls, as for `step`; they are set when the first state is asked for.

        Yields:
            What `state` returns after each physics step; its `dt` is that of one physics step.

        Raises:
            SimulationError: As `step` does, at the physics step where it happens.
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
        """Return what the module wants on its device, all of one instant; `dt` is that of a control step.

        If it has sensors that are advanced at each physics step, the states after the earlier ones are in `substeps`.

        After `step` the instant is the start of the last physics step, where MuJoCo has evaluated poses, velocities and
        contacts: with `substeps=1` that before the step. After `reset`, `set_state` and `forward` it is where the environments
        are.
        """
        self._refuse_if_closed()
        return self._earlier.added_to(self._start_contacts.applied_to(self._state(self.control_step)))

    def read(self, env_ids: EnvIds | None = None) -> dict[str, Tensor]:
        """Return the module's readings of the present state: `touch(state())`, for some environments (default: all).

        The others' noise, delays and histories stay where they are, and their rows are as they were handed out before: read
        all after a step, and after a reset those that were reset.

        Args:
            env_ids: Indices, or a boolean mask over environments.
        """
        if env_ids is None:
            return self._touch(self.state())
        return self._touch(self.state(), env_mask(env_ids, self.num_envs, self._touch.device))

    def watched(self) -> Watched:
        """Return what `watch` named when the simulation was made, of the instant that `state` is of, on the physics' device.

        Raises:
            SimulationError: If nothing is watched.
        """
        self._refuse_if_closed()
        if self._watch is None:
            raise SimulationError("nothing is watched: simulate(..., watch=Watch(bodies=(...), joints=(...)))")
        values = self._start_contacts.applied_to(self._read_watch(), is_stored=False)
        return self._watch.watched(values, self.state() if self._watch.has_pairs else None)

    def reset(self, env_ids: EnvIds | None = None, *, contacts: Contacts = "evaluate", **values: Unpack[StateValues]) -> None:
        """Begin a new episode in some environments (default: all), in the simulator and in the module.

        They start from the keyframe at time 0, then with the values given, as `MjData` after `mj_resetData`, assignments and
        `mj_forward`. Nothing of the others changes. On a GPU a boolean mask and values that are there are used without
        waiting; of indices there, the host waits to see them.

        To look for contacts and their forces costs about a physics step, on a GPU one of all environments. With
        `contacts="none"` poses and velocities alone follow from where the environments are: until the next step pairs are not
        in contact and no force acts, `joint_effort` included. A start that was in contact can be stored with what it felt: then
        `contacts` holds these fields of its state.

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
        rows, mask = self._table.rows(values, env_ids), env_mask(env_ids, self.num_envs, self._faults.counts.device)
        if contacts == "evaluate":
            self._start_contacts.forget(mask)
        else:
            self._start_contacts.place(mask, contacts)
        self._begin_episodes(env_ids, rows, finds_contacts=contacts == "evaluate")
        self._earlier.restart(mask)

    def set_state(self, env_ids: EnvIds | None = None, **values: Unpack[StateValues]) -> None:
        """Put some environments (default: all) into a state; their time and the module's memory go on.

        What follows from it is evaluated, as `mj_forward` does: `state` hands out this instant. Nothing of the other
        environments changes.

        Args:
            env_ids: Indices, or a boolean mask over environments.
            **values: `qpos`, `qvel`, `ctrl`, or another of MuJoCo's arrays that an environment's future follows from (`act`,
                `mocap_pos`, `mocap_quat`, `time`, `qacc_warmstart`, …); what is not given stays. Each has one row for all
                environments alike, or with indices a row for each in their order, or else (env, …), of which the chosen rows
                are taken. Tensors or arrays of any float dtype, on any device. Quaternions are brought to unit length by
                MuJoCo's rule (`mju_normalize4`).

        Raises:
            SimulationError: If there are no such environments or arrays, a shape does not fit, or numbers on the host are not
                finite or hold a quaternion of length 0; nothing has changed. On a GPU such environments keep what they had
                and have a fault.
        """
        self._refuse_if_closed()
        rows = self._table.rows(values, env_ids)
        self._start_contacts.forget(env_mask(env_ids, self.num_envs, self._faults.counts.device))
        self._put(env_ids, rows)

    @abstractmethod
    def forward(self, env_ids: EnvIds | None = None) -> None:
        """Evaluate poses, velocities and contacts of some environments (default: all) where they are now, as `mj_forward` does.

        `state` then hands out this instant, for the price of about one physics step; forces follow from the present controls.

        Args:
            env_ids: Indices, or a boolean mask over environments.

        Raises:
            SimulationError: If there are no such environments.
        """

    def set_objects(
        self,
        variants: Mapping[str, Values] | None = None,
        sizes: Mapping[str, Values] | None = None,
        env_ids: EnvIds | None = None,
        *,
        temperatures: Mapping[str, Values] | None = None,
        materials: Mapping[str, Values] | None = None,
    ) -> None:
        """Say what objects are like in some environments (default: all), and restart these; resets leave it as it is.

        At first, environment i has variant i modulo their number. MuJoCo compiles one model per distinct choice: for a cube in
        the XHand1's palm, 10 ms; on the CPU each is kept and takes 3 MB.

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
        chosen = self.heat.choose(ids, temperatures or {}, materials or {})
        if self._objects is not None and (variants or sizes):
            self._objects.choose(ids, variants or {}, sizes or {})
            self._use_objects()
        self.heat.write(ids, chosen)
        self.reset(ids)

    def repeated(self, body: Callable[[], T]) -> Callable[[], T]:
        """Return work that is done again and again on the same tensors, such as a step, its reading and resets.

        On a GPU its third call captures it as one CUDA graph, which is replayed from then on: what it returns is then in the
        same tensors each time. It must not ask the GPU for a value, nor branch on one.
        """
        return body

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of all that the future of the environments follows from, but for the module's own `state_dict`."""
        return saved_state(self._arrays, self.heat.saved, self.properties, self._start_contacts, self._faults)

    def load_state_dict(self, saved: Mapping[str, Tensor]) -> None:
        """Go on where a simulation of the same scene, objects and number of environments was saved.

        Raises:
            SimulationError: If it was another one; nothing has changed.
        """
        self._refuse_if_closed()
        load_state(saved, self._arrays, self.heat.saved, self.properties, self._start_contacts, self._faults, self.forward)

    def close(self) -> None:
        """Release the module, so that another simulation can read it; this one can no longer be used."""
        self._is_closed = True
        release(self._touch, self)

    @abstractmethod
    def _state(self, dt: float) -> SceneState: ...

    @abstractmethod
    def _read_watch(self) -> SceneState:
        """Return the fields that the watch wants."""

    @abstractmethod
    def _use_objects(self) -> None:
        """Simulate the objects that were chosen."""

    @abstractmethod
    def _advance(self, num_steps: int) -> None:
        """Make physics steps, and see to faults."""

    @abstractmethod
    def _begin_episodes(self, env_ids: EnvIds | None, rows: Rows, *, finds_contacts: bool = True) -> None:
        """Begin episodes; without a look for contacts, evaluate poses and velocities alone."""

    @abstractmethod
    def _put(self, env_ids: EnvIds | None, rows: Rows) -> None: ...

    def _begin_step(self, control: Tensor | np.ndarray | None) -> None:
        """Take controls over.

        Raises:
            SimulationError: If they do not fit, or are the host's and not finite.
        """
        self._refuse_if_closed()
        self._start_contacts.forget()
        self._faults.begin_step()
        if control is None:
            return
        self._faults.note(BAD_CONTROL, write_controls(control, self.ctrl, self._faults.on_fault == "raise"))
        self._has_warned_of_range = self._has_warned_of_range or warn_of_range(control, self.model)

    def _scene_state(self, values: Mapping[str, Tensor], dt: float) -> SceneState:
        """Return a state of the fields that the module wants; `dt` in s."""
        fields: dict[str, Any] = {**values, "dt": dt}
        return SceneState(**{name: value for name, value in fields.items() if name in (*self._touch.inputs.fields, "time")})

    def _refuse_if_closed(self) -> None:
        if self._is_closed:
            raise SimulationError("this simulation is closed; make another one")
