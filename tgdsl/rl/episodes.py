"""The episodes of all environments: how they begin, how long they have lasted, and what they have brought.

Shapes: `env` environments, `feature` numbers of a group.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.console.tables import listing, shapes
from tgdsl.rl.actuation import ONE, ZERO, Actuation
from tgdsl.rl.draws import Draws, within
from tgdsl.rl.pushes import Pushes
from tgdsl.rl.spec import RandomSpec
from tgdsl.rl.task import Start, Task
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.tensors.env_ids import put_rows
from tgdsl.tensors.fused import FusedCall

REST = {"friction": ONE, "mass": ZERO}
"""What of an object can be random, and the ranges in which it is not."""

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
        friction: Coefficient of sliding friction of each object.
        mass: Mass of each object [kg].
        total: Rewards, summed over each present episode.
        terms: Names of the reward's terms; none before the first step.
        sums: These terms, summed over each present episode.
    """

    number: Int[Tensor, " env"]
    steps: Int[Tensor, " env"]
    friction: Float[Tensor, " env"]
    mass: Float[Tensor, " env"]
    total: Float[Tensor, " env"]
    terms: tuple[str, ...]
    sums: Float[Tensor, "term env"]

    def __init__(
        self,
        sim: Simulation,
        random: RandomSpec,
        task: Task,
        actuation: Actuation,
        pushes: Pushes,
        draws: Draws,
        is_compiled: bool = False,
    ):
        """Note what the scene's objects are like before anything is random.

        Args:
            sim: The simulation.
            random: What is random.
            task: The task.
            actuation: The drives.
            pushes: What pushes the object.
            draws: Random numbers.
            is_compiled: Whether what is done to tensors is compiled by torch.
        """
        self._sim, self._random, self._task = sim, random, task
        self._actuation, self._pushes, self._draws = actuation, pushes, draws
        self._object = task.setup.object
        device, dtype = sim.qpos.device, sim.qpos.dtype
        self.number = torch.zeros(sim.num_envs, dtype=torch.int64, device=device)
        self.steps = torch.zeros_like(self.number)
        self._friction = sim.properties.friction(self._object).to(device, dtype).clone()
        self._mass = sim.properties.mass(self._object).to(device, dtype).clone()
        self.friction, self.mass = task.setup.friction, task.setup.mass
        self.total = torch.zeros(sim.num_envs, dtype=torch.float32, device=device)
        self.terms, self.sums = (), torch.zeros((0, sim.num_envs), dtype=torch.float32, device=device)
        self._restarted = FusedCall(self._restart, is_compiled)

    def begin(self, chosen: Bool[Tensor, " env"]) -> None:
        """Begin a new episode in some environments, in the simulation and the module too."""
        start = self._draw(chosen)
        self._set_properties(chosen)
        self._sim.reset(chosen, contacts=start.contacts, **start.values)
        self._restarted(chosen, "ctrl" in start.values)

    def restart_counters(self) -> None:
        """Begin to count episodes from 0, so that random numbers are those of environments just made."""
        self.number.zero_()

    def add(self, terms: tuple[str, ...], earned: Float[Tensor, "term env"], reward: Float[Tensor, " env"]) -> None:
        """Add a control step and what it brought."""
        self.expect(terms)
        self.sums += earned
        self.total += reward
        self.steps += 1

    def expect(self, terms: tuple[str, ...]) -> None:
        """Begin to add up terms of the reward, if that was not begun."""
        if not self.terms:
            self.terms, self.sums = terms, self.total.new_zeros((len(terms), len(self.total)))

    def with_matching_sums(self, saved: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return the current and the saved memory, each with the sums that either has: before the first step there are none."""
        current, saved_memory = self.memory(), dict(saved)
        for one, other in ((current, saved), (saved_memory, self.memory())):
            if not any(name.startswith("sums/") for name in one):
                one |= {name: torch.zeros_like(self.total) for name in other if name.startswith("sums/")}
        return current, saved_memory

    def memory(self) -> dict[str, Tensor]:
        """Return the memory by name: live tensors."""
        memory = {name: getattr(self, name) for name in ("number", "steps", "friction", "mass", "total")}
        return memory | {f"sums/{name}": total for name, total in zip(self.terms, self.sums, strict=True)}

    def _draw(self, chosen: Bool[Tensor, " env"]) -> Start:
        """Draw friction, mass and how the task begins."""
        self.number += chosen
        ranges = {name: getattr(self._random, name) for name, rest in REST.items() if getattr(self._random, name) != rest}
        shares = self._draws.shares(dict.fromkeys(ranges, 1), self.number, chosen) if ranges else {}
        for name, share in shares.items():
            drawn = within(share, *ranges[name])[:, 0]
            if name == "friction":
                put_rows(self.friction, chosen, self._friction * drawn)
            else:
                put_rows(self.mass, chosen, self._mass + drawn)
        return self._task.reset(chosen, self.number)

    def _set_properties(self, chosen: Bool[Tensor, " env"]) -> None:
        """Give objects the friction and mass that were drawn, where these are random."""
        properties, name = self._sim.properties, self._object
        if self._random.friction != ONE:
            properties.set(chosen, friction={name: self.friction})
        if self._random.mass != ZERO:
            properties.set(chosen, mass={name: self.mass})

    def _restart(self, chosen: Bool[Tensor, " env"], at_controls: bool) -> None:
        """Draw drives and pushes again, and begin to add up."""
        self._actuation.reset(chosen, self.number, at_controls)
        self._pushes.reset(chosen, self.number)
        for counted in (self.steps, self.total, self.sums):
            counted.masked_fill_(chosen, 0)
