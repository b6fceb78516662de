"""Faults of single environments, which then wait for a reset, or are restarted.

Shapes: `env` environments, `kind` kinds of faults.
"""

from __future__ import annotations

import warnings
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean, listed

OnFault = Literal["raise", "reset", "note"]
"""What becomes of environments with a fault: "raise" has a step raise until they are reset, "reset" restarts them, "note"
leaves that to whoever looks at `mask`."""
DIVERGED, BAD_CONTROL, BAD_VALUES, NO_ROOM = range(4)
_MESSAGES = (
    "environments {envs} diverged{diverged}",
    "control is not finite in environments {envs}",
    "values given for the state of environments {envs} are not finite, or hold a quaternion of length 0, and were left out",
    "the search for the deepest point of two convex shapes ran out of room in environments {envs}: contacts may be wrong",
)
_COUNTS = (
    "{num} diverged",
    "{num} had controls that are not finite",
    "{num} were given a state that is not finite",
    "in {num} the search for the deepest point of two convex shapes ran out of room",
)


class EnvFaults:
    """The faults of each environment, on the device, from when they are noted until the environment is restarted."""

    counts: Int[Tensor, " env"]  # how many times each environment has had a fault
    totals: Int[Tensor, " kind"]  # number of faults of each kind so far
    restarted: Bool[Tensor, " env"]  # environments that the last step has restarted
    _held: Bool[Tensor, "kind env"]

    def __init__(self, num_envs: int, device: torch.device, on_fault: str):
        if on_fault not in get_args(OnFault):
            hint = did_you_mean(on_fault, get_args(OnFault), "choices")
            raise SimulationError(f'on_fault is "{on_fault}"; {hint}')
        self.on_fault = on_fault
        self._held = torch.zeros((len(_COUNTS), num_envs), dtype=torch.bool, device=device)
        self._is_counted = torch.zeros_like(self._held)
        self.restarted = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.counts = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.totals = torch.zeros(len(_COUNTS), dtype=torch.int64, device=device)
        self._has_warned = False

    @property
    def mask(self) -> Bool[Tensor, " env"]:
        """Environments that wait for a reset, or that the last step restarted."""
        return self._held.any(dim=0) | self.restarted

    def note(self, kind: int, where: Bool[Tensor, " env"] | Bool[Tensor, ""]) -> None:
        self._held[kind] |= where

    def begin_step(self) -> None:
        """Forget which environments the last step has restarted."""
        if self.on_fault == "reset":
            self.restarted.zero_()

    def update(self) -> Bool[Tensor, " env"]:
        """Count faults that are new; return which environments have any."""
        is_new = self._held & ~self._is_counted
        self.counts += is_new.any(dim=0)
        self.totals += is_new.sum(dim=1)
        self._is_counted |= is_new
        return self._held.any(dim=0)

    def clear(self, where: Bool[Tensor, " env"]) -> None:
        """Forget the faults of environments that are restarted."""
        self._held &= ~where
        self._is_counted &= ~where
        self.restarted &= ~where

    def note_restarted(self, where: Bool[Tensor, " env"]) -> None:
        self.restarted |= where

    def messages(self, diverged: str = "") -> list[str]:
        """Return which environments have which fault, in words; it waits for a GPU. `diverged` is added to divergence."""
        results = []
        for text, where in zip(_MESSAGES, self._held.cpu(), strict=True):
            if where.any():
                envs = listed([str(env) for env in torch.nonzero(where).flatten().tolist()])
                results.append(text.format(envs=envs, diverged=diverged) + "; reset them to go on")
        return results

    def warn_once(self, totals: list[int] | None = None) -> None:
        """Warn of the first faults; without `totals`, a GPU is waited for."""
        counts = self.totals.tolist() if totals is None else totals
        if self._has_warned or not any(counts):
            return
        self._has_warned = True
        kinds = ", ".join(text.format(num=num) for text, num in zip(_COUNTS, counts, strict=True) if num)
        problem = "had faults" if self.on_fault == "note" else "had faults and were restarted"
        warnings.warn(f"environments {problem}: {kinds}; shown once, `fault_counts` counts all faults", stacklevel=4)
