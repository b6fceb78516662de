"""What can go wrong on the device without anyone noticing, and how it is noticed: full pools, divergence, bad controls."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import listed

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
    8: "the search for the deepest point of two convex shapes ran out of room in environments {envs}: contacts may be wrong",
    11: "contacts of MuJoCo's tactile sensors are left out in environments {envs}",
}
"""What each bit of MuJoCo Warp's `overflow` says. Bits 9 and 10, a solver at its last iteration, are no faults: it goes on."""
_DIVERGED = 16
_BAD_CONTROL = 17
_MASK = sum(1 << bit for bit in POOLS)
_LARGEST = 1e10
"""Positions and velocities above it have diverged: MuJoCo's own limit, `mjMAXVAL`."""


class Faults:
    """What has gone wrong in each environment since it was last reset.

    Shapes: `env` environments.

    Attributes:
        is_any: Whether there is any fault; filled by `update`.
    """

    is_any: Bool[Tensor, ""]

    def __init__(self, arrays: Mapping[str, Tensor]):
        """Watch over MuJoCo Warp's arrays `overflow`, `qpos` and `qvel`."""
        self._arrays = arrays
        num_envs, device = len(arrays["qpos"]), arrays["qpos"].device
        self._has_diverged = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._has_bad_control = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.is_any = torch.zeros((), dtype=torch.bool, device=device)
        self._seen = torch.zeros((), dtype=torch.bool, pin_memory=device.type == "cuda")
        self._copied: torch.cuda.Event | None = None

    def note_control(self, is_bad: Bool[Tensor, " env"] | Bool[Tensor, ""]) -> None:
        """Note environments whose controls are not finite."""
        self._has_bad_control |= is_bad

    def update(self) -> None:
        """Look for divergence, on the device."""
        for name in ("qpos", "qvel"):
            if self._arrays[name].shape[1]:
                # Where a number is not one, no comparison holds.
                self._has_diverged |= ~(self._arrays[name].abs().amax(dim=1) < _LARGEST)
        self.is_any.copy_((self.codes() != 0).any())

    def clear(self, mask: Bool[Tensor, " env"]) -> None:
        """Forget the faults of some environments."""
        self._has_diverged &= ~mask
        self._has_bad_control &= ~mask

    def codes(self) -> Int[Tensor, " env"]:
        """Return the faults of each environment as bits."""
        own = (self._has_diverged.int() << _DIVERGED) | (self._has_bad_control.int() << _BAD_CONTROL)
        return (self._arrays["overflow"] & _MASK) | own

    def have_shown(self) -> bool:
        """Return whether there is any fault, without waiting for a GPU: there it may be seen a call or more later."""
        if self.is_any.device.type == "cpu":
            return bool(self.is_any)
        if self._copied is not None and not self._copied.query():
            return False
        has_shown = self._copied is not None and bool(self._seen)
        self._copied = torch.cuda.Event()
        self._seen.copy_(self.is_any, non_blocking=True)
        self._copied.record(torch.cuda.current_stream(self.is_any.device))
        return has_shown

    def account(self, sizes: Mapping[str, int]) -> str:
        """Return what went wrong and where, in words; nothing if nothing did. It waits for a GPU.

        Args:
            sizes: Values for the pools' messages.
        """
        codes = self.codes().cpu()
        found: list[str] = []
        if (envs := _where(codes, _BAD_CONTROL)) is not None:
            found.append(f"control is not finite in environments {envs}; reset them to go on")
        if (envs := _where(codes, _DIVERGED)) is not None:
            found.append(f"environments {envs} diverged; reset them to go on")
        for bit, text in POOLS.items():
            if (envs := _where(codes, bit)) is not None:
                found.append("MuJoCo Warp: " + text.format(envs=envs, **sizes))
        return "; ".join(found)


def _where(codes: Int[Tensor, " env"], bit: int) -> str | None:
    envs = torch.nonzero((codes >> bit) & 1).flatten().tolist()
    return listed([str(env) for env in envs]) if envs else None
