"""MuJoCo Warp's model and data on a device, torch's views of their arrays, and what is done to them.

Shapes: `env` environments (MuJoCo Warp's worlds).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.bodies import STATE_ARRAYS
from tgdsl.runtime.simulators.faults import BAD_VALUES, DIVERGED, NO_ROOM, EnvFaults
from tgdsl.runtime.simulators.joint_fields import FORCES, JointColumns
from tgdsl.runtime.simulators.simulation import refuse_two_instants
from tgdsl.runtime.simulators.state_values import INTEGRATED, Rows
from tgdsl.runtime.warp.contacts import PairContacts, foreign_sensors
from tgdsl.runtime.warp.stream import GraphedCall, WarpStream, libraries
from tgdsl.tensors.env_ids import put_rows
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
_LARGEST = 1e10
"""Positions and velocities above it have diverged: MuJoCo's own limit, `mjMAXVAL`."""


class Faults(EnvFaults):
    """What has gone wrong in each environment since it was last reset: its own faults, and full pools, which many share.

    Shapes: `env` environments, `count` what the host is told.
    """

    def __init__(self, arrays: Mapping[str, Tensor], on_fault: str):
        device = arrays["qpos"].device
        super().__init__(len(arrays["qpos"]), device, on_fault)
        self._arrays = arrays
        self._peak = torch.zeros(len(arrays["qpos"]), dtype=torch.float32, device=device)
        self._counts: Int[Tensor, " count"] = torch.zeros(1 + len(self.totals), dtype=torch.int64, device=device)
        self._seen = torch.zeros(self._counts.shape, dtype=torch.int64, pin_memory=device.type == "cuda")
        self._copied: torch.cuda.Event | None = None

    def check_divergence(self) -> None:
        """Look for divergence after a physics step, on the device."""
        for name in ("qpos", "qvel"):
            if self._arrays[name].shape[1]:
                # Of what is no number, the maximum is none either.
                torch.maximum(self._peak, self._arrays[name].abs().amax(dim=1), out=self._peak)

    def update(self) -> Bool[Tensor, " env"]:
        """Count faults that are new; return which environments have any of their own."""
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
        if self._counts.device.type == "cpu":
            first, *totals = self._counts.tolist()
            return bool(first), totals
        if self._copied is not None and not self._copied.query():
            return False, []
        first, *totals = self._seen.tolist() if self._copied is not None else [0]
        self._copied = torch.cuda.Event()
        self._seen.copy_(self._counts, non_blocking=True)
        self._copied.record(torch.cuda.current_stream(self._counts.device))
        return bool(first), totals

    def message(self, sizes: Mapping[str, int]) -> str:
        """Return what went wrong and where, in words with the pools' sizes; nothing if nothing did. It waits for a GPU."""
        result, overflow = self.messages(), self._arrays["overflow"].cpu()
        for bit, text in POOLS.items():
            envs = torch.nonzero((overflow >> bit) & 1).flatten().tolist()
            if envs:
                result.append("MuJoCo Warp: " + text.format(envs=listed([str(env) for env in envs]), **sizes))
        return "; ".join(result)


_VELOCITIES = ("cvel", "cdof_dot")
"""What `forward` finds of velocities, and takes of the evaluation before for the constraints of loops."""
_DERIVED = tuple(dict.fromkeys((*STATE_ARRAYS, *_VELOCITIES, "geom_xpos", "geom_xmat", *FORCES.values())))
_WATCHED = ("overflow", "nefc", "nacon", "ncollision")
DEFAULT_NCONMAX = 48
"""Default capacity for contacts per environment."""


class Worlds:
    """Environments of one model, all arrays on the device.

    Attributes:
        model: MuJoCo Warp's model.
        data: MuJoCo Warp's data.
        arrays: Live tensors of `data`, (env, …): what is integrated, what a state is read from, `geom_xpos` and `geom_xmat`.
        parameters: Live tensors of those fields of `model` that environments have of their own, (env, …).
        kept: Those of `qpos`, `qvel` and `ctrl` that the module wants, at the instant of poses and contacts.
        contacts: The contacts that the module wants.
        faults: What has gone wrong.
        restarted: Environments that the last `step` has restarted.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        inputs: Inputs,
        num_envs: int,
        stream: WarpStream,
        *,
        keyframe: int = -1,
        nconmax: int | None = None,
        njmax: int | None = None,
        per_env: Sequence[str] = (),
        on_fault: str = "raise",
    ):
        """Put model and data on the device, all environments at the start; `keyframe` is -1 for the model's own initial state.

        Raises:
            SimulationError: If MuJoCo Warp does not support something of the model, a field cannot differ, or the model lacks a
                body.
        """
        refuse_two_instants(model, "bodies that sleep are not supported by physics on a GPU; disable the flag `sleep`")
        self.nconmax = DEFAULT_NCONMAX if nconmax is None else nconmax
        rows = constraint_rows(model, self.nconmax) if njmax is None else njmax
        wp, self._mjw = libraries()
        start = mujoco.MjData(model)
        if keyframe >= 0:
            mujoco.mj_resetDataKeyframe(model, start, keyframe)
        with stream.scope():
            try:
                self.model: Any = self._mjw.put_model(model, batch_sizes=dict.fromkeys(per_env, num_envs))
                self.data: Any = self._mjw.put_data(model, start, num_envs, self.nconmax, njmax=rows)
            except (NotImplementedError, ValueError) as error:
                raise SimulationError(f"MuJoCo Warp: {error}") from error
            self.model.opt.warn_overflow = 0  # it would be printed; here it is an error
            # MuJoCo Warp takes this flag for one thing alone: boxes then meet as in MuJoCo, whose normal is the first box's
            # face where two are nearly parallel. Otherwise it takes either, and normals differ by the angle between them.
            self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
            self._leave_out_sensors(wp, model, inputs)
            joints = JointColumns.of(inputs, model)
            names = (*INTEGRATED, *_DERIVED, *_WATCHED)
            self.arrays: dict[str, Tensor] = {name: view(wp, getattr(self.data, name), stream.device) for name in names}
            self.parameters: dict[str, Tensor] = {name: view(wp, getattr(self.model, name), stream.device) for name in per_env}
            self.kept = {array: self.arrays[array].clone() for array in (*joints.moved.values(), "time")}
            self.contacts = PairContacts(inputs, model, num_envs, stream.device)
            self._start = {name: self.arrays[name][:1].clone() for name in (*INTEGRATED, "overflow")}
            self._is_stale = torch.ones(num_envs, dtype=torch.bool, device=stream.device)
            self._is_reset = torch.zeros_like(self._is_stale)
            self.restarted = torch.zeros_like(self._is_stale)
            self.faults = Faults(self.arrays, on_fault)
        self._has_stale, self._is_in_graphs, self._stream = True, False, stream
        self._has_loops = model.neq > 0
        self._reset, self._refresh = GraphedCall(stream, self._restart), GraphedCall(stream, self.evaluate_stale)
        self._move = GraphedCall(stream, self._evaluate_poses)

    def step(self, num_steps: int, drive: Callable[[], None] | None = None) -> None:
        """Advance all environments by some physics steps, and restart those that shall not wait: for a `GraphedCall`.

        Poses, velocities and contacts are then those at the start of the last of them. Only there are sensors evaluated, unless
        some of them remember earlier steps. `drive` is called before each step.
        """
        whole = self.model.opt.disableflags
        idle = whole if self.model.nhistory else whole | int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        try:
            for i in reversed(range(num_steps)):
                self.model.opt.disableflags = idle if i else whole
                if drive is not None:
                    drive()
                if not i:
                    for name, kept in self.kept.items():
                        kept.copy_(self.arrays[name])
                self._mjw.step(self.model, self.data)
                self.faults.check_divergence()
        finally:
            self.model.opt.disableflags = whole
        # MuJoCo Warp's integrators leave contacts and constraint forces as its last `forward` found them.
        self.contacts.update(self.model, self.data)
        self._is_stale.zero_()
        is_faulty = self.faults.update()
        if self.faults.on_fault == "reset":
            self.restarted.copy_(is_faulty)
            self._is_reset.copy_(is_faulty)
            self._restart()
            self.faults.note_restarted(is_faulty)

    def prepare(self) -> None:
        """Evaluate environments that were put elsewhere before they are stepped, if the model has loops: see `_VELOCITIES`."""
        if self._has_loops:
            self.refresh()

    def note_step(self, is_evaluated: bool = False) -> None:
        """Take note, on the host, that all environments were stepped, and whether restarted ones were evaluated."""
        if not self._stream.is_capturing:
            self._has_stale = False
        if self.faults.on_fault == "reset" and not is_evaluated:
            self._note_stale()

    def reset(self, mask: Bool[Tensor, " env"], rows: Rows, finds_contacts: bool = True) -> None:
        """Restart some environments, with values.

        Their poses and contacts are evaluated when they are next asked for; without a look for contacts, their poses at once.
        """
        self._is_reset.copy_(mask)
        self._reset()
        self.put(mask, rows)
        if finds_contacts:
            self.make_stale(mask)
        else:
            self._move()

    def put(self, mask: Bool[Tensor, " env"], rows: Rows) -> None:
        """Write values into the state of some environments; those that cannot be used are left out and noted."""
        with torch.no_grad():
            is_put = mask
            if rows.is_bad is not None:
                is_put = mask & ~rows.is_bad
                self.faults.note(BAD_VALUES, mask & rows.is_bad)
            for name, values in rows.values.items():
                array = self.arrays[name]
                if array.numel():
                    put_rows(array, is_put, values)

    def make_stale(self, mask: Bool[Tensor, " env"]) -> None:
        """Have poses, velocities and contacts of some environments evaluated when they are next asked for."""
        self._is_stale |= mask
        self._note_stale()

    def refresh(self) -> None:
        """Evaluate poses, velocities and contacts of the environments that are elsewhere than at the last evaluation."""
        self._is_in_graphs |= self._stream.is_capturing
        if not self._has_stale:
            return
        if self._is_stale.is_cuda or self._is_stale.any():
            self._refresh()
        self._has_stale = self._stream.is_capturing

    def _note_stale(self) -> None:
        """Note, on the host, that environments are to be evaluated.

        A graph of a user's own is replayed without the host. What is captured there is therefore evaluated in it; and once
        there is one, so is everything else at once, as the graph may read it.
        """
        if self._stream.is_capturing:
            self._is_in_graphs = True
            self._refresh()
            return
        self._has_stale = True
        if self._is_in_graphs:
            self.refresh()

    def evaluate_stale(self) -> None:
        """Evaluate all environments where they are now, then give those that are not stale back their earlier instant.

        It is for a `GraphedCall`.
        """
        arrays = {name: self.arrays[name] for name in (*_DERIVED, "history")} | self.contacts.arrays
        arrays = {name: array for name, array in arrays.items() if array.numel()}
        earlier = _copied(arrays)
        for _ in range(2 if self._has_loops else 1):
            self._mjw.forward(self.model, self.data)
        self.contacts.update(self.model, self.data)
        self._give_back(self._is_stale, earlier, arrays)
        self._is_stale.zero_()

    def _evaluate_poses(self) -> None:
        """Evaluate poses and velocities of the environments that were just reset: for a `GraphedCall`.

        Those of all are evaluated, which costs little, and the others are given back their earlier instant.
        """
        arrays = {name: self.arrays[name] for name in _DERIVED if self.arrays[name].numel()}
        earlier = _copied(arrays)
        for evaluate in (self._mjw.kinematics, self._mjw.com_pos, self._mjw.com_vel):
            evaluate(self.model, self.data)
        self._give_back(self._is_reset, earlier, arrays)
        self._is_stale &= ~self._is_reset

    def _give_back(self, is_new: Bool[Tensor, " env"], earlier: Mapping[str, Tensor], arrays: Mapping[str, Tensor]) -> None:
        """Give environments that are not new back what they had, and take the joints of those that are."""
        is_old = ~is_new
        for name, before in earlier.items():
            put_rows(arrays[name], is_old, before)
        for name, kept in self.kept.items():
            put_rows(kept, is_new, self.arrays[name])

    def forget_graphs(self) -> None:
        """Capture again at the next calls."""
        for call in (self._reset, self._refresh, self._move):
            call.forget()

    def message(self) -> str:
        """Return what went wrong and where, in words with the pools' sizes; nothing if nothing did. It waits for a GPU."""
        sizes = {
            "njmax": int(self.data.njmax),
            "nconmax": self.nconmax,
            "naconmax": int(self.data.naconmax),
            "maxmatch": int(self.model.opt.contact_sensor_maxmatch),
            "nefc": int(self.arrays["nefc"].max()),
            "nacon": int(self.arrays["nacon"].max()),
            "ncollision": int(self.arrays["ncollision"].max()),
        }
        return self.faults.message(sizes)

    def _leave_out_sensors(self, wp: Any, model: mujoco.MjModel, inputs: Inputs) -> None:
        """Keep MuJoCo Warp from evaluating the sensors that `contacts` stands in for; with no others, from looking for any."""
        foreign = foreign_sensors(model, inputs)
        for name in ("sensor_contact_pos_adr", "sensor_contact_acc_adr"):  # of the stages of positions and of forces
            kept = np.intersect1d(getattr(self.model, name).numpy(), foreign)
            setattr(self.model, name, wp.array(kept, dtype=int))
        if not len(foreign):
            self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)

    def _restart(self) -> None:
        for name, start in self._start.items():
            array = self.arrays[name]
            if array.numel():
                put_rows(array, self._is_reset, start)
        for name in _VELOCITIES:
            array = self.arrays[name]
            if array.numel():  # what is not a number there would come back in the next evaluation
                put_rows(array, self._is_reset, 0.0)
        self.faults.clear(self._is_reset)
        self._is_stale |= self._is_reset


def constraint_rows(model: mujoco.MjModel, num_contacts: int) -> int:
    """Return how many rows of constraints a number of contacts makes at most, and all limits and equalities besides."""
    dim = max([1, *model.geom_condim.tolist(), *model.pair_dim.tolist()])
    is_pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    per_contact = 2 * (dim - 1) if is_pyramidal and dim > 1 else dim
    limits = np.count_nonzero(model.jnt_limited) + 2 * np.count_nonzero(model.tendon_limited)
    friction = np.count_nonzero(model.dof_frictionloss) + np.count_nonzero(model.tendon_frictionloss)
    return int(num_contacts * per_contact + 6 * model.neq + 2 * limits + friction)


def _copied(arrays: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return copies of float32 arrays, made by one kernel."""
    copies = {name: torch.empty_like(array) for name, array in arrays.items()}
    copy_each(list(copies.values()), list(arrays.values()))
    return copies


def view(wp: Any, array: Any, device: torch.device) -> Tensor:
    """Return torch's view of one of Warp's arrays; one without elements has no memory to view."""
    return wp.to_torch(array) if array.size else torch.empty(array.shape, device=device)
