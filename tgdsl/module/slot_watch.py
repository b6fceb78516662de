"""Notices contacts that found no slot and may carry force, and warns of them without making the host wait for a GPU.

A pair is noted if its slots lack part of its net force, or if it counts more contacts than slots while those shown carry force:
what is not shown may press from the other side, so that the net force tells nothing of it.

Shapes: `env` environments, `pair` pairs of a module's inputs.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import torch
from torch import Tensor

from tgdsl.errors import listed
from tgdsl.plan.inputs import Inputs

TOLERANCE = 1e-3
"""Part of a pair's force that slots may lack unnoticed: far above what single precision makes of a sum."""


EVERY = 16
"""On a GPU one state in so many is looked at: a dozen small kernels take as long to launch as a module's own."""


class SlotWatch:
    """Looks at states for contacts beyond the slots. Each pair is warned of once."""

    def __init__(self, inputs: Inputs):
        """Begin; nothing has been seen."""
        self._inputs = inputs
        wanted = {"contact_found", "contact_force", "contact_netforce"}
        self._num_pairs = len(inputs.pairs) if inputs.slots and wanted <= set(inputs.fields) else 0
        self._warned: set[int] = set()
        self._num_calls = 0
        self._wanted: Tensor | None = None
        self._seen: Tensor | None = None
        self._copied: torch.cuda.Event | None = None

    @property
    def is_done(self) -> bool:
        """Whether there is nothing left to warn of."""
        return len(self._warned) >= self._num_pairs

    def note(self, tensors: Mapping[str, Tensor]) -> None:
        """Look at a state, on its device."""
        whole, force, found = (tensors[f"contact_{name}"] for name in ("netforce", "force", "found"))
        self._num_calls += 1
        if whole.is_cuda and self._num_calls % EVERY != 1 and not torch.cuda.is_current_stream_capturing():
            return
        with torch.inference_mode(False), torch.no_grad():
            if self._wanted is None or self._wanted.device != whole.device:
                self._wanted = torch.zeros(whole.shape[1], dtype=torch.float32, device=whole.device)
                self._seen, self._copied = None, None
        with torch.no_grad():
            lacking = (whole - force.sum(dim=2)).abs().amax(dim=-1)
            size = whole.abs().amax(dim=-1) + force.abs().amax(dim=(2, 3))
            wanted = found.to(torch.float32).clamp(min=self._inputs.slots + 0.5)  # a state may not count its contacts
            is_crowded = (found > self._inputs.slots) & (force.abs().amax(dim=(2, 3)) > 0)
            wanted = torch.where((lacking > TOLERANCE * size) | is_crowded, wanted, 0.0)
            self._wanted.copy_(torch.cat([self._wanted[None], wanted]).amax(dim=0))

    def warn(self) -> None:
        """Warn of what has been noted. A GPU is not waited for: what it notes may be seen a call or more later."""
        wanted = self._shown()
        if wanted is None:
            return
        new = [i for i, number in enumerate(wanted.tolist()) if number and i not in self._warned]
        if not new:
            return
        self._warned.update(new)
        slots, most = self._inputs.slots, max(float(wanted[i]) for i in new)
        which = listed([f"{self._inputs.pairs[i].link} – {self._inputs.pairs[i].object}" for i in new])
        enough = f"slots: {int(most)}" if most > slots + 0.5 else "more slots"
        warnings.warn(
            f"contacts of {which} are more than `slots: {slots}`: what the others carry acts at the centre of those shown; "
            f"`{enough}` would do",
            stacklevel=6,
        )

    def _shown(self) -> Tensor | None:
        """Return what has been noted, on the host; None if it is not there yet."""
        if self._wanted is None or self._wanted.device.type != "cuda":
            return self._wanted
        if torch.cuda.is_current_stream_capturing():
            return None
        if self._copied is not None and not self._copied.query():
            return None
        shown = None if self._copied is None or self._seen is None else self._seen.clone()
        with torch.inference_mode(False):
            if self._seen is None:
                self._seen = torch.zeros(self._wanted.shape, dtype=torch.float32, pin_memory=True)
            self._seen.copy_(self._wanted, non_blocking=True)
        self._copied = torch.cuda.Event()
        self._copied.record(torch.cuda.current_stream(self._wanted.device))
        return shown
