"""Faults of MuJoCo Warp's environments: their own, and pools that are too small.

Shapes: `env` environments, `count` numbers that the host reads.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import listed
from tgdsl.runtime.simulators.faults import DIVERGED, NO_ROOM, EnvFaults
from tgdsl.tensors.on_host import HostCopy

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
    """Return how many rows of constraints a number of contacts makes at most, and all limits and equalities besides."""
    dim = max([1, *model.geom_condim.tolist(), *model.pair_dim.tolist()])
    is_pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    per_contact = 2 * (dim - 1) if is_pyramidal and dim > 1 else dim
    limits = np.count_nonzero(model.jnt_limited) + 2 * np.count_nonzero(model.tendon_limited)
    friction = np.count_nonzero(model.dof_frictionloss) + np.count_nonzero(model.tendon_frictionloss)
    return int(num_contacts * per_contact + 6 * model.neq + 2 * limits + friction)
