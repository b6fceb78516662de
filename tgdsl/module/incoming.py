"""The fields of a state that a call reads: validated before anything is computed, with warnings of what is odd about them.

Shapes: `env` environments.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from tgdsl.errors import StateError, listed
from tgdsl.module.memory import EVERY
from tgdsl.module.state import SceneState
from tgdsl.plan.inputs import Inputs
from tgdsl.plan.plan import Plan
from tgdsl.sensors.base import Kind
from tgdsl.tensors.buffers import Constants
from tgdsl.tensors.env_ids import EnvIds, env_mask, is_out_of_sight
from tgdsl.tensors.on_host import HostCopy

TOLERANCE = 1e-3  # part of a pair's force that slots may lack unnoticed: far above what single precision makes of a sum
SAME_TIME = 1e-9  # relative difference up to which two times are one: rounding, where a call's time is divided by its substeps


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
        """Check a state, on its device; on a GPU one in `EVERY`, as a dozen small kernels take as long as a module's own."""
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
            slots = count.to(torch.float32).clamp(min=self._inputs.slots + 0.5)  # a state may not count its contacts
            is_crowded = (count > self._inputs.slots) & (largest > 0)
            slots = torch.where((lacking > TOLERANCE * (whole.abs().amax(dim=-1) + largest)) | is_crowded, slots, 0.0)
            self._wanted.copy_(torch.cat([self._wanted[None], slots]).amax(dim=0))

    def warn(self) -> None:
        """Warn of what has been noted. A GPU is not waited for: what it notes may be seen a call or more later."""
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
    """Takes states apart for a module, and warns once of what is odd about them."""

    def __init__(self, plan: Plan, kinds: Mapping[str, Kind], constants: Constants):
        self._plan, self._kinds, self._constants = plan, kinds, constants
        self._timesteps = {sensor.name: sensor.timestep for sensor in plan.sensors if sensor.timestep}
        self._dt: tuple[float, Tensor] | None = None
        self._warned: set[str] = set()
        self.slot_watch = SlotWatch(plan.inputs)

    @property
    def held_dt(self) -> object:
        """Stands for the time between calls as a tensor: another object after it was written again."""
        return self._dt

    def tensors(self, state: SceneState, dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
        """Return the fields of a state that are read, by name; those of earlier substeps as `substep/<i>/<field>`.

        Raises:
            StateError: If a field that is read is missing, or is not of the right shape, dtype or device.
        """
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
        # Our simulators, which say the time, notice faults themselves.
        if state.time is None and "poses" not in self._warned and not is_out_of_sight(tensors["body_pos"]):
            self._check_poses(tensors)
        if inputs.substeps > 1:
            tensors |= self._substeps(state, device, len(tensors["body_pos"]))
        return tensors

    @staticmethod
    def chosen(mask: Tensor | None, env_ids: EnvIds | None, num_envs: int, device: torch.device) -> Bool[Tensor, " env"]:
        """Return a mask of the environments that a caller chose, by a mask or by indices.

        Raises:
            StateError: If both are given, the mask is none, or there are no such environments.
        """
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
            warnings.warn(f"{problem}; this is said once, and not of states on a GPU: look for NaN in readings", stacklevel=7)

    def _dt_tensor(self, dt: float, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return dt as a tensor that is written only when it changes."""
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
        """Recompute constants that are made for another time between the calls of a kind, and warn of it the first time."""
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
