"""Events of a document: what happens to environments at each reset, or after intervals that are drawn.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.rl.draws import whole
from tgdsl.rl.task import Setup
from tgdsl.rl.terms import Event, EventTerm, Term
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.tensors.env_ids import may_be_nonempty, put_rows


class Events:
    """The events of all environments.

    Attributes:
        memory: Control steps until the next one and how often it has happened, above that the episode, by name: live tensors.
    """

    def __init__(self, terms: Mapping[str, Term], sim: Simulation, setup: Setup):
        """Begin; `reset` draws when the first ones come.

        Raises:
            SimulationError: If an event would come more often than control steps.
        """
        self._terms = {name: term for name, term in terms.items() if isinstance(term, EventTerm)}
        self._sim, self._setup, self.memory = sim, setup, dict[str, Tensor]()
        for name, term in self._terms.items():
            if term.interval[0] < setup.control_step:
                problem = f'the event "{name}" comes every {term.interval[0]:g} s, more often than control steps'
                raise SimulationError(f"{problem} of {setup.control_step:g} s; expected an interval of at least one")
            for kind in ("left", "count"):
                self.memory[f"{name}/{kind}"] = torch.zeros(setup.num_envs, dtype=torch.int64, device=setup.device)

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> None:
        """Have events at a reset happen, and draw when the others come first.

        Args:
            chosen: The environments.
            episode: How often each was reset.
        """
        for name, term in self._terms.items():
            put_rows(self.memory[f"{name}/count"], chosen, episode << 32)
            if term.mode == "reset":
                self._happen(name, term, chosen)
            else:
                self._wait(name, term, chosen)

    def advance(self) -> None:
        """Have events happen that are due: once per control step, before its physics."""
        for name, term in self._terms.items():
            left, count = self.memory[f"{name}/left"], self.memory[f"{name}/count"]
            if term.mode == "reset":
                continue
            left -= 1
            is_due = left <= 0
            if may_be_nonempty(is_due):
                count += is_due
                self._happen(name, term, is_due)
                self._wait(name, term, is_due)

    def _happen(self, name: str, term: EventTerm, chosen: Bool[Tensor, " env"]) -> None:
        term.apply(Event(self._sim, self._setup, chosen, self.memory[f"{name}/count"], name))

    def _wait(self, name: str, term: EventTerm, chosen: Bool[Tensor, " env"]) -> None:
        """Draw how many control steps there are before the next one."""
        first, last = (round(end / self._setup.control_step) for end in term.interval)
        purpose = f"event {name} interval"
        share = self._setup.draws.shares({purpose: 1}, self.memory[f"{name}/count"], chosen)[purpose]
        put_rows(self.memory[f"{name}/left"], chosen, whole(share, first, last)[:, 0])
