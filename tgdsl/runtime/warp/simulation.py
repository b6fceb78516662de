"""MuJoCo Warp on a GPU: many environments of the artefact's scene, stepped together by CUDA graphs.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.faults import BAD_VALUES, DIVERGED, NO_ROOM, EnvFaults
from tgdsl.runtime.simulators.fields import FORCES, POSES, StateReader
from tgdsl.runtime.simulators.objects import PER_ENV, EnvObjects
from tgdsl.runtime.simulators.simulation import SimOptions, Simulation, refuse_two_instants
from tgdsl.runtime.simulators.state_values import INTEGRATED, Control, NewValues, StateTable
from tgdsl.runtime.warp.contacts import PairContacts, foreign_sensors
from tgdsl.runtime.warp.objects import OBJECT_FIELDS, WorldObjects, WorldProperties
from tgdsl.runtime.warp.stream import GraphedCall, WarpStream, libraries, view
from tgdsl.tensors.env_ids import put_rows
from tgdsl.tensors.on_host import HostCopy
from tgdsl.tensors.torch_internals import copy_each

POOLS = {
    0: "njmax={njmax} is too small in environments {envs}: constraints are left out, {nefc} were wanted last",
    1: "njmax={njmax} is too small in environments {envs}: entries of the constraints' Jacobian are left out",
    2: "nconmax={nconmax} is too small: pairs of near geoms are left out, in all environments together {ncollision} were "
    "wanted last, and nconmax × num_envs is {naconmax}",
    3: "nconmax={nconmax} is too small: contacts are left out, in all environments together {nacon} were wanted last, and "
    "nconmax × num_envs is {naconmax}",
    4: "nconmax={nconmax} is too small in environments {envs}: contacts of convex shapes are left out",
    5: "contacts with a height field are left out in environments {envs}: a finer field meets too many of its cells",
    6: "contacts that a contact sensor of the model's own should report are left out in environments {envs}: it matches more "
    'than {maxmatch}; raise it with <custom><numeric name="contact_sensor_maxmatch" data="…"/></custom> in the scene',
    7: "nvmax is too small in environments {envs}: degrees of freedom are left out",
    11: "contacts of MuJoCo's tactile sensors are left out in environments {envs}",
}
"""What each bit of MuJoCo Warp's `overflow` says of a pool. Bits 9 and 10, a solver at its last iteration, are no faults: it
goes on."""
_MASK = sum(1 << bit for bit in POOLS)
_HORIZON = 1 << 8
"""Bit of a search that ran out of room: of a size that nobody can choose, and a matter of its environment alone."""
_LARGEST = 1e10  # positions and velocities above it have diverged: MuJoCo's own limit, `mjMAXVAL`


class Faults(EnvFaults):
    """Faults of each environment since it was last reset: its own, and full pools, which many share."""

    def __init__(self, arrays: Mapping[str, Tensor], on_fault: str):
        device = arrays["qpos"].device
        super().__init__(len(arrays["qpos"]), device, on_fault)
        self._arrays = arrays
        self._peak = torch.zeros(len(arrays["qpos"]), dtype=torch.float32, device=device)
        self._counts: Int[Tensor, " count"] = torch.zeros(1 + len(self.totals), dtype=torch.int64, device=device)
        self._copy = HostCopy()

    def check_divergence(self) -> None:
        """Look for divergence after a physics step, on the device."""
        for name in ("qpos", "qvel"):
            if self._arrays[name].shape[1]:
                # The maximum of a NaN is NaN.
                torch.maximum(self._peak, self._arrays[name].abs().amax(dim=1), out=self._peak)

    def update(self) -> Bool[Tensor, " env"]:
        """Count new faults; return which environments have any, full pools excluded."""
        self.note(DIVERGED, ~(self._peak < _LARGEST))
        self.note(NO_ROOM, (self._arrays["overflow"] & _HORIZON) != 0)
        self._peak.zero_()
        is_faulty = super().update()
        has_pool_fault = (self._arrays["overflow"] & _MASK) != 0
        to_raise = (has_pool_fault | is_faulty) if self.on_fault == "raise" else has_pool_fault
        self._counts.copy_(torch.cat([to_raise.any()[None].long(), self.totals]))
        return is_faulty

    def polled(self) -> tuple[bool, list[int]]:
        """Return whether to raise, and the number of faults of each kind so far.

        A GPU is not waited for: there both are of an earlier call.
        """
        counts = self._copy.poll(self._counts)
        first, *totals = [0] if counts is None else counts.tolist()
        return bool(first), totals

    def message(self, sizes: Mapping[str, int]) -> str:
        """Return what went wrong and where, in words with the pools' sizes; nothing if nothing did. It waits for a GPU."""
        result, overflow = self.messages(), self._arrays["overflow"].cpu()
        for bit, text in POOLS.items():
            envs = torch.nonzero((overflow >> bit) & 1).flatten().tolist()
            if envs:
                result.append("MuJoCo Warp: " + text.format(envs=listed([str(env) for env in envs]), **sizes))
        return "; ".join(result)


def constraint_rows(model: mujoco.MjModel, num_contacts: int) -> int:
    """Return the most rows of constraints that a number of contacts, all limits and all equalities can take."""
    dim = max([1, *model.geom_condim.tolist(), *model.pair_dim.tolist()])
    is_pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    per_contact = 2 * (dim - 1) if is_pyramidal and dim > 1 else dim
    limits = np.count_nonzero(model.jnt_limited) + 2 * np.count_nonzero(model.tendon_limited)
    friction = np.count_nonzero(model.dof_frictionloss) + np.count_nonzero(model.tendon_frictionloss)
    return int(num_contacts * per_contact + 6 * model.neq + 2 * limits + friction)


T = TypeVar("T")
_VELOCITIES = ("cvel", "cdof_dot")
"""What `forward` finds of velocities, and takes of the evaluation before for the constraints of loops."""
_DERIVED = tuple(dict.fromkeys((*POSES, "sensordata", *_VELOCITIES, "geom_xpos", "geom_xmat", *FORCES.values())))
_WATCHED = ("overflow", "nefc", "nacon", "ncollision")
DEFAULT_NCONMAX = 48  # default capacity for contacts per environment


class WarpSimulation(Simulation):
    """Environments in MuJoCo Warp, in float32; `qpos`, `qvel` and `ctrl` are on the physics' device.

    Contacts of a pair have no fixed order; if there are more than slots, an arbitrary subset stays. The solver's tolerance is
    1e-6, MuJoCo's 1e-8: forces of sliding contacts agree to 3e-3 of the largest, and to 2e-4 after
    `warp_model.opt.tolerance.fill_(1e-8)`; forces of sticking contacts agree to 1e-5 with both.

    Devices are "cuda", "cuda:1", or "cpu", which is slow and meant for tests. Calls do not wait for the GPU unless host values
    are passed in or read. A later call reports a fault on the GPU; `check` reports it at once.

    Attributes:
        model: The compiled scene; if objects differ between environments, the scene of the first, with an extra body at the
            end if some variants are meshes.
        arrays: Live tensors (env, …) of MuJoCo's integrated quantities, and of the quantities of states. In `sensordata` the
            contact sensors of `tgdsl.instrument` are zero: contacts are read elsewhere.
        parameters: Live tensors (env, …) of the model's fields that may differ between environments. Derived fields, such as
            `body_subtreemass`, are not updated.
        warp_model: MuJoCo Warp's model.
        warp_data: MuJoCo Warp's data.
    """

    OPTIONS = ("substeps", "keyframe", "nconmax", "njmax", "model", "options", "watch", "per_env", "on_fault", "graph")
    DEVICE = "cuda"
    properties: WorldProperties
    parameters: dict[str, Tensor]
    warp_model: Any
    warp_data: Any
    _arrays: dict[str, Tensor]
    _faults: Faults
    _world_objects: WorldObjects | None = None

    def step_and_read(self, control: Control = None) -> dict[str, Tensor]:
        """Advance by one control step and return the module's readings: on a GPU all in one CUDA graph.

        It is `step(control)` and then `touch(state())`, without gradients, and for the price of one launch. As with any CUDA
        graph, the next call overwrites the readings; `clone` them to keep them. The first two calls run eagerly, the third
        captures; the graph is captured again when the module holds other tensors than before: when it was moved, compiled,
        freed, or given another dt.

        Raises:
            SimulationError: As from `step`, or if the module is on another device than physics.
        """
        if self._touch.device != self._stream.device:
            raise SimulationError(
                f"the module is on {self._touch.device}, physics on {self._stream.device}; expected one device"
            )
        self._forget_other_tensors()
        self._begin_step(control)
        readings = self._step_and_read()
        self._earlier.stepped(self._faults.restarted)
        self._touch.record_outputs(readings)
        self._finish_step(is_evaluated=True)
        return readings

    def repeated(self, body: Callable[[], T]) -> Callable[[], T]:
        call = GraphedCall(self._stream, body)
        placed: tuple[Bool[Tensor, " env"] | None, dict[str, Tensor]] = (None, {})

        def done() -> T:
            nonlocal placed
            self._refuse_if_closed()
            was_captured = call.is_captured
            result = call()
            if call.is_captured:  # a replay runs no Python: restore the host's notes from the capture
                start = self._start_contacts
                placed = placed if was_captured else (start.is_placed, dict(start.values))
                start.is_placed, start.values = placed[0], dict(placed[1])
                self._finish_step(is_evaluated=True)
            return result

        return done

    def body_poses(self, env: int) -> tuple[Float[np.ndarray, "body 3"], Float[np.ndarray, "body 4"]]:
        self._refresh()
        pos, quat = (self.arrays[name][env].double().cpu().numpy() for name in ("xpos", "xquat"))
        return pos, quat

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment, its objects as they are there; `parameters` are not in it."""
        return self.model if self._world_objects is None else self._world_objects.env_model(env)

    def check(self) -> None:
        """Look for faults of any environment since it was last reset. It waits for a GPU.

        Raises:
            SimulationError: If an environment has diverged or its controls were not finite, or a pool was too small.
        """
        message = self._faults.message(
            {
                "njmax": int(self.warp_data.njmax),
                "nconmax": self._nconmax,
                "naconmax": int(self.warp_data.naconmax),
                "maxmatch": int(self.warp_model.opt.contact_sensor_maxmatch),
                **{name: int(self._arrays[name].max()) for name in ("nefc", "nacon", "ncollision")},
            }
        )
        if message:
            raise SimulationError(message)

    def _forget_other_tensors(self) -> None:
        """Forget a graph that was captured with other tensors of the module than it has now."""
        held = (self.drive, self._touch.calls.compiled, self._touch.incoming.held_dt, *self._touch.buffers())
        if len(held) != len(self._held) or any(now is not then for now, then in zip(held, self._held, strict=True)):
            self._step_and_read.forget()
            self._held = held

    def _physics_and_touch(self) -> dict[str, Tensor]:
        if not self._earlier.are_wanted:
            self._physics(self.substeps)
        else:
            self._earlier.begin(self.substeps)
            for i in range(self.substeps):
                if i:
                    self._earlier.note(self._gathered(float(self.model.opt.timestep)))
                self._physics(1)
            self._earlier.restart(self._faults.restarted)
        if self._faults.on_fault == "reset":
            self._touch.reset(self._restarted)
            self._evaluate_stale()
        return self._touch(self._earlier.added_to(self._gathered(self.control_step)))

    def _open_device(self, device: str, options: SimOptions) -> torch.device:
        self._stream = WarpStream(device, options.get("graph", True))
        return self._stream.device

    def _start(self, num_envs: int, keyframe: int, options: SimOptions, readers: Sequence[StateReader]) -> None:
        inputs, stream, device, model = self._touch.inputs, self._stream, self._device, self.model
        per_env = [field for word in options.get("per_env", ()) for field in PER_ENV.get(word, (word,))]
        if self._objects is not None:
            self._world_objects = WorldObjects(self._objects, inputs)
            model, per_env = self._world_objects.model, per_env + list(OBJECT_FIELDS)
        per_env = list(dict.fromkeys(per_env))
        refuse_two_instants(model, "bodies that sleep are not supported by physics on a GPU; disable the flag `sleep`")
        nconmax, njmax = options.get("nconmax"), options.get("njmax")
        self._nconmax = DEFAULT_NCONMAX if nconmax is None else nconmax
        rows = constraint_rows(model, self._nconmax) if njmax is None else njmax
        wp, self._mjw = libraries()
        start = mujoco.MjData(model)
        if keyframe >= 0:
            mujoco.mj_resetDataKeyframe(model, start, keyframe)
        with stream.scope():
            try:
                self.warp_model = self._mjw.put_model(model, batch_sizes=dict.fromkeys(per_env, num_envs))
                self.warp_data = self._mjw.put_data(model, start, num_envs, self._nconmax, njmax=rows)
            except (NotImplementedError, ValueError) as error:
                raise SimulationError(f"MuJoCo Warp: {error}") from error
            self.warp_model.opt.warn_overflow = 0  # it would be printed; here it is an error
            # MuJoCo Warp takes this flag for one thing alone: boxes then meet as in MuJoCo, whose normal is the first box's
            # face where two are nearly parallel. Otherwise it takes either, and normals differ by the angle between them.
            self.warp_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
            self._leave_out_sensors(wp, model, inputs)
            names = (*INTEGRATED, *_DERIVED, *_WATCHED)
            self._arrays = {name: view(wp, getattr(self.warp_data, name), device) for name in names}
            self.parameters = {name: view(wp, getattr(self.warp_model, name), device) for name in per_env}
            moved = [name for reader in readers for name in reader.moved]
            self._kept = {name: self._arrays[name].clone() for name in (*moved, "time")}
            self._instant, self._sources = self._kept["time"], self._arrays | self._kept
            self._pairs = PairContacts(inputs, model, num_envs, device)
            self._start_arrays = {name: self._arrays[name][:1].clone() for name in (*INTEGRATED, "overflow")}
            self._is_stale = torch.ones(num_envs, dtype=torch.bool, device=device)
            self._is_reset, self._restarted = (torch.zeros_like(self._is_stale) for _ in range(2))
            self._faults = Faults(self._arrays, options.get("on_fault", "raise"))
            self._table = StateTable(self.model, self._arrays)
        self.properties = WorldProperties(self.parameters, self.model, inputs.bodies_of, num_envs, device)
        self._has_stale, self._is_in_graphs, self._has_loops = True, False, model.neq > 0
        if self._world_objects is not None:
            self._world_objects.write_to(self.parameters, self._arrays)
        self._restarting, self._evaluation = GraphedCall(stream, self._restart), GraphedCall(stream, self._evaluate_stale)
        self._posing = GraphedCall(stream, self._evaluate_poses)
        self._step = GraphedCall(stream, lambda: self._physics(self.substeps))
        self._substep = GraphedCall(stream, lambda: self._physics(1))
        self._step_and_read = GraphedCall(stream, self._physics_and_touch)
        self._held: tuple[object, ...] = ()
        self._driven = self.drive

    def _contacts(self) -> dict[str, Tensor]:
        return self._pairs.read()

    def _use_objects(self, objects: EnvObjects) -> None:
        assert self._world_objects is not None
        self._world_objects.write_to(self.parameters, self._arrays)
        self.properties.renew()

    def _advance(self, num_steps: int) -> None:
        if self._has_loops:  # `forward` needs velocities of the evaluation before, see `_VELOCITIES`
            self._refresh()
        if self.drive is not self._driven:
            self._driven = self.drive
            self._step.forget()
            self._substep.forget()
        (self._step if num_steps == self.substeps else self._substep)()
        if self._faults.on_fault == "reset":
            self._touch.reset(self._restarted.to(self._touch.device))
        self._finish_step()

    def _finish_step(self, is_evaluated: bool = False) -> None:
        """Take note, on the host, that all environments were stepped, and whether restarted ones were evaluated."""
        is_capturing = self._stream.is_capturing
        if not is_capturing:
            self._has_stale = False
        if self._faults.on_fault == "reset" and not is_evaluated:
            self._note_stale()
        if is_capturing:
            return
        self._touch.incoming.slot_watch.warn()
        to_raise, totals = self._faults.polled()
        if to_raise:
            self.check()
        if self._faults.on_fault != "raise":
            self._faults.warn_once(totals)

    def _physics(self, num_steps: int) -> None:
        """Advance all environments by some physics steps; with `on_fault="reset"`, restart faulty ones: for a `GraphedCall`."""
        # Poses and contacts stay at the start of the last step. Sensors are evaluated only there, unless some have a history.
        whole = self.warp_model.opt.disableflags
        idle = whole if self.warp_model.nhistory else whole | int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        try:
            for i in reversed(range(num_steps)):
                self.warp_model.opt.disableflags = idle if i else whole
                if self.drive is not None:
                    self.drive()
                if not i:
                    for name, saved in self._kept.items():
                        saved.copy_(self._arrays[name])
                self._mjw.step(self.warp_model, self.warp_data)
                self._faults.check_divergence()
        finally:
            self.warp_model.opt.disableflags = whole
        # MuJoCo Warp's integrators leave contacts and constraint forces as computed by its last `forward`.
        self._pairs.update(self.warp_model, self.warp_data)
        self._is_stale.zero_()
        is_faulty = self._faults.update()
        if self._faults.on_fault == "reset":
            self._restarted.copy_(is_faulty)
            self._is_reset.copy_(is_faulty)
            self._restart()
            self._faults.note_restarted(is_faulty)

    def _begin_episodes(self, mask: Bool[Tensor, " env"], new: NewValues, *, finds_contacts: bool) -> None:
        """Restart some environments, with values."""
        self._is_reset.copy_(mask)
        self._restarting()
        self._put(mask, new)
        if finds_contacts:
            self._evaluate(mask)
        else:
            self._posing()

    def _put(self, mask: Bool[Tensor, " env"], new: NewValues) -> None:
        """Write values into the state of some environments; skip environments with bad values and note the fault."""
        with torch.no_grad():
            is_put = mask
            if new.is_bad is not None:
                is_put = mask & ~new.is_bad
                self._faults.note(BAD_VALUES, mask & new.is_bad)
            for name, values in new.values.items():
                put_rows(self._arrays[name], is_put, values)

    def _evaluate(self, mask: Bool[Tensor, " env"]) -> None:
        self._is_stale |= mask
        self._note_stale()

    def _refresh(self) -> None:
        """Evaluate poses, velocities and contacts of the environments that are elsewhere than at the last evaluation."""
        self._is_in_graphs |= self._stream.is_capturing
        if not self._has_stale:
            return
        if self._is_stale.is_cuda or self._is_stale.any():
            self._evaluation()
        self._has_stale = self._stream.is_capturing

    def _note_stale(self) -> None:
        """Note, on the host, that environments need an evaluation."""
        # A user's graph is replayed without the host. Environments put elsewhere inside it are therefore evaluated in it; and
        # once there is one, all others are evaluated at once, as the graph may read them.
        if self._stream.is_capturing:
            self._is_in_graphs = True
            self._evaluation()
            return
        self._has_stale = True
        if self._is_in_graphs:
            self._refresh()

    def _evaluate_stale(self) -> None:
        """Evaluate all environments at their present state; environments that are not stale keep their earlier instant."""

        def evaluate() -> None:
            for _ in range(2 if self._has_loops else 1):
                self._mjw.forward(self.warp_model, self.warp_data)
            self._pairs.update(self.warp_model, self.warp_data)

        arrays = {name: self._arrays[name] for name in (*_DERIVED, "history")} | self._pairs.arrays
        self._evaluate_rows(self._is_stale, arrays, evaluate)
        self._is_stale.zero_()

    def _evaluate_poses(self) -> None:
        """Evaluate poses and velocities of the environments that were just reset: for a `GraphedCall`."""

        def evaluate() -> None:
            for part in (self._mjw.kinematics, self._mjw.com_pos, self._mjw.com_vel):
                part(self.warp_model, self.warp_data)

        self._evaluate_rows(self._is_reset, {name: self._arrays[name] for name in _DERIVED}, evaluate)
        self._is_stale &= ~self._is_reset

    def _evaluate_rows(self, is_new: Bool[Tensor, " env"], arrays: Mapping[str, Tensor], evaluate: Callable[[], None]) -> None:
        """Evaluate all environments, restore `arrays` where not `is_new`, and save the joints of the new ones."""
        filled = [array for array in arrays.values() if array.numel()]
        earlier = [torch.empty_like(array) for array in filled]
        copy_each(earlier, filled)
        evaluate()
        is_old = ~is_new
        for array, old in zip(filled, earlier, strict=True):
            put_rows(array, is_old, old)
        for name, saved in self._kept.items():
            put_rows(saved, is_new, self._arrays[name])

    def _leave_out_sensors(self, wp: Any, model: mujoco.MjModel, inputs: Inputs) -> None:
        """Keep MuJoCo Warp from evaluating the sensors that `contacts` stands in for; with no others, from looking for any."""
        foreign = foreign_sensors(model, inputs)
        for name in ("sensor_contact_pos_adr", "sensor_contact_acc_adr"):  # of the stages of positions and of forces
            addresses = np.intersect1d(getattr(self.warp_model, name).numpy(), foreign)
            setattr(self.warp_model, name, wp.array(addresses, dtype=int))
        if not len(foreign):
            self.warp_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)

    def _restart(self) -> None:
        for name, start in self._start_arrays.items():
            put_rows(self._arrays[name], self._is_reset, start)
        for name in _VELOCITIES:  # a NaN there would come back in the next evaluation
            put_rows(self._arrays[name], self._is_reset, 0.0)
        self._faults.clear(self._is_reset)
        self._is_stale |= self._is_reset
