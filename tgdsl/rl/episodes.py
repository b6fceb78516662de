"""The episodes of all environments: how they begin, how long they have lasted, and what they have brought.

Shapes: `env` environments, `feature` numbers of a group.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.console.tables import listing, shapes
from tgdsl.rl.actuation import Actuation
from tgdsl.rl.events import Events
from tgdsl.rl.task import Task
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.tensors.fused import FusedCall

Observations = dict[str, Float[Tensor, "env feature"]]


class StepInfo(NamedTuple):
    """What else a step tells. Rows of what is of an episode are of that which has just ended, where one has.

    Attributes:
        ended: Episodes that have ended, terminated or truncated.
        final_obs: Observations before the reset; other than those that the step returns where an episode has ended.
        terms: Terms of the reward of this step by name, weights and Δt included.
        score: Score of the episode, in `task.score_unit`.
        episode_return: Sum of its rewards.
        episode_steps: Its control steps.
        episode_terms: Sums of its terms by name.
        faults: Environments that have diverged, or whose actions were not finite: their episodes end, with a reward of 0.
    """

    ended: Bool[Tensor, " env"]
    final_obs: Observations
    terms: dict[str, Float[Tensor, " env"]]
    score: Float[Tensor, " env"]
    episode_return: Float[Tensor, " env"]
    episode_steps: Int[Tensor, " env"]
    episode_terms: dict[str, Float[Tensor, " env"]]
    faults: Bool[Tensor, " env"]

    def __repr__(self) -> str:
        return "StepInfo\n" + listing((name, shapes(value)) for name, value in self._asdict().items())

    def is_whole(self, max_steps: int) -> Bool[Tensor, " env"]:
        """Return which episodes have lasted as long as one may, in control steps, and were not ended by a fault."""
        return (self.episode_steps >= max_steps) & ~self.faults


class Step(NamedTuple):
    """What a step returns.

    Attributes:
        obs: Observations by group; of episodes that have ended, the first of the next one.
        reward: Sum of the terms.
        terminated: Episodes that have ended for good.
        truncated: Episodes that have merely lasted long enough.
        info: What else there is to tell.
    """

    obs: Observations
    reward: Float[Tensor, " env"]
    terminated: Bool[Tensor, " env"]
    truncated: Bool[Tensor, " env"]
    info: StepInfo

    def __repr__(self) -> str:
        return "Step\n" + listing((name, shapes(value)) for name, value in self._asdict().items())


class Episodes:
    """Begins episodes, and adds up what they bring.

    Attributes:
        number: How often each environment was reset: the count of its random numbers.
        steps: Control steps of each present episode.
        total: Rewards, summed over each present episode.
        sums: Terms of the reward, summed over each present episode, in the order of `terms`.
        terms: Names of these terms; none before `sum_up`.
    """

    number: Int[Tensor, " env"]
    steps: Int[Tensor, " env"]
    total: Float[Tensor, " env"]
    sums: Float[Tensor, "term env"]
    terms: tuple[str, ...]

    def __init__(self, sim: Simulation, task: Task, actuation: Actuation, events: Events, is_compiled: bool = False):
        self._sim, self._task, self._actuation, self._events = sim, task, actuation, events
        self.number = torch.zeros(sim.num_envs, dtype=torch.int64, device=sim.qpos.device)
        self.steps = torch.zeros_like(self.number)
        self.total = torch.zeros_like(self.number, dtype=torch.float32)
        self.terms, self.sums = (), self.total[None][:0]
        self._restarted = FusedCall(self._restart, is_compiled)

    def sum_up(self, terms: Sequence[str]) -> None:
        """Add up these terms of the reward."""
        self.terms, self.sums = tuple(terms), self.total.new_zeros((len(terms), len(self.total)))

    def begin(self, chosen: Bool[Tensor, " env"]) -> None:
        """Begin a new episode in some environments, in the simulation and the module too."""
        self.number += chosen
        self._events.reset(chosen, self.number, is_placed=False)
        start = self._task.reset(chosen, self.number)
        self._sim.reset(chosen, contacts=start.contacts, **start.values)
        self._restarted(chosen, "ctrl" in start.values)
        self._events.reset(chosen, self.number, is_placed=True)

    def add(self, earned: Float[Tensor, "term env"], reward: Float[Tensor, " env"]) -> None:
        """Add a control step and what it brought."""
        self.sums += earned
        self.total += reward
        self.steps += 1

    def memory(self) -> dict[str, Tensor]:
        """Return the memory by name: live tensors."""
        setup, sums = self._task.setup, zip(self.terms, self.sums, strict=True)
        memory = {"number": self.number, "steps": self.steps, "total": self.total}
        return memory | {"friction": setup.friction, "mass": setup.mass} | {f"sums/{name}": total for name, total in sums}

    def _restart(self, chosen: Bool[Tensor, " env"], at_controls: bool) -> None:
        self._actuation.reset(chosen, self.number, at_controls)
        for counted in (self.steps, self.total, self.sums):
            counted.masked_fill_(chosen, 0)
