"""The states of a control step's earlier physics steps, for modules whose sensors are advanced at each.

Shapes: `env` environments.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.module.state import SceneState
from tgdsl.plan.inputs import Inputs
from tgdsl.tensors.env_ids import broadcast_over


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
        """Note that a captured step has written the states anew, and which environments it has started anew.

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
