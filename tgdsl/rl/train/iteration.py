"""One iteration of learning: its episodes, add_up on the device and read once, and its durations.

Shapes: `env` environments.
"""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Int
from torch import Tensor

from tgdsl.rl.env import Step, TouchEnv
from tgdsl.rl.playing.rollout import Actor, Moment, rollout
from tgdsl.rl.train.ranks import Ranks, add_up

EPISODE_NAMES = ("Episode/return", "Episode/steps", "Episode/score", "Episode/dropped", "Episode/fault")
"""Numbers of a finished episode, before its terms: return, steps, score, whether it ended for good, and by a fault."""
ORIGIN_KEYS = ("task", "overrides", "seed", "processes", "device", "module", "taxels", "sensors", "scene", "versions", "spec")
"""Entries of a run's origin that a policy's card has."""


class EpisodeTally:
    """Sums over finished episodes; `names` are set at the first control step."""

    def __init__(self):
        self.names: list[str] = []
        self._sums: Tensor | None = None

    def add(self, step: Step) -> None:
        """Add a control step, without waiting for the device."""
        info = step.info
        numbers = [info.episode_return, info.episode_steps, info.score, step.terminated, info.faults]
        values = torch.stack([info.ended.double(), *(each.double() for each in (*numbers, *info.episode_terms.values()))])
        sums = torch.where(info.ended, values, 0.0).sum(dim=1)
        if self._sums is None:
            self.names = [*EPISODE_NAMES, *(f"Reward/{name}" for name in info.episode_terms)]
            self._sums = torch.zeros_like(sums)
        self._sums += sums

    def pop(self) -> Tensor:
        """Return the sums over all processes, the number of episodes first, and restart; the host does not wait."""
        assert self._sums is not None
        sums = self._sums.clone()
        add_up(sums)
        self._sums.zero_()
        return sums

    def means(self, sums: list[float]) -> dict[str, float]:
        """Return means over episodes by name, from the sums of `pop`; none if no episode has ended."""
        count = sums[0]
        return {name: total / count for name, total in zip(self.names, sums[1:], strict=True)} if count else {}


@dataclass(frozen=True)
class Iteration:
    """An iteration, over all processes."""

    episodes: int  # how many episodes ended
    metrics: dict[str, float]
    """Means over these episodes, and the learner's numbers, by the names that TensorBoard groups: `Episode/score`."""
    rollout: float  # duration of the rollout [s]
    update: float  # duration of the update [s]


class Learning(Actor):
    """Environments and who learns in them, iteration by iteration: a rollout in which it acts, and an update.

    On a GPU the host waits once per iteration, but for captures at the first ones.

    Attributes:
        groups: Groups of observations of each network.
        iteration: Number of iterations so far.
        samples: How many control steps these took, over all processes and environments.
        rates: What of the document makes smaller steps.
    """

    rates: ClassVar[str]
    groups: dict[str, list[str]]
    std: list[float] | None = None
    """Standard deviation of its actions."""

    def __init__(self, env: TouchEnv, ranks: Ranks, steps: int, desynchronise: bool = True):
        """Take the environments of this process; `steps` control steps are a rollout."""
        self.env, self.ranks, self.iteration, self.samples = env, ranks, 0, 0
        self._num_steps, self._desynchronise, self._has_begun = steps, desynchronise, False
        self._tally = EpisodeTally()

    @property
    def episode_names(self) -> list[str]:
        """Numbers of the episodes that ended, from iterations in which any did."""
        return self._tally.names

    def iterate(self, share: float = 0.0) -> Iteration:
        """Make a rollout, and learn from it; `share` is how much of the run is over, 0 to 1."""
        self.set_rate(share)
        self.roll()
        start, middle = self._roll_start, self._mark()
        self.learn()
        sums, numbers = self._tally.pop(), self._numbers()
        values = torch.cat([sums, torch.stack(list(numbers.values())).double().to(sums.device)]).tolist()  # here the host waits
        end = self._mark()
        if self.env.device.type == "cuda":
            end.synchronize()
            durations = 1e-3 * start.elapsed_time(middle), 1e-3 * middle.elapsed_time(end)
        else:
            durations = middle - start, end - middle
        pairs = zip(numbers, values[len(sums) :], strict=True)
        metrics = {name: value for name, value in pairs if not (name.startswith("Score/") and math.isnan(value))}
        return Iteration(round(values[0]), self._tally.means(values[: len(sums)]) | metrics, *durations)

    def set_rate(self, share: float) -> None:
        """Set the learning rate for a share of the run that is over; by default it stays."""

    def roll(self) -> None:
        """Make a rollout."""
        if not self._has_begun:
            self.go_on(torch.randint_like(self.env.steps, self.env.max_steps) if self._desynchronise else None)
        self._start_rollout()
        self._roll_start = self._mark()
        for moment in rollout(self, self.env, self._num_steps):
            self._keep(moment)
            self._tally.add(moment.step)

    def learn(self) -> None:
        """Learn from the rollout."""
        self._update()
        self.iteration += 1
        self.samples += self._num_steps * self.env.num_envs * self.ranks.size

    def go_on(self, steps: Int[Tensor, " env"] | None = None) -> None:
        """Begin episodes, at given numbers of control steps; default: 0."""
        self.env.reset()
        if steps is not None:
            self.env.steps.copy_(steps)
        self.go_on_here()

    def go_on_here(self) -> None:
        """Go on from where the environments are, with an empty memory of their episodes."""
        self._has_begun = True
        self.begin(torch.ones(self.env.num_envs, dtype=torch.bool, device=self.env.device))

    def card(
        self, origin: Mapping[str, Any], seconds: float, command: str, groups: Mapping[str, int] | None = None
    ) -> dict[str, Any]:
        """Return the card of a policy, as plain values."""
        return {
            "groups": dict(groups or {name: self.env.groups[name] for name in self.groups["actor"]}),
            "joints": list(self.env.joint_names),
            "iterations": self.iteration,
            "samples": self.samples,
            "minutes": round(seconds / 60.0, 2),
            "command": command,
            "score": None,
            **{name: origin[name] for name in ORIGIN_KEYS},
            "std": self.std,
        }

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return what is learned, and what learning goes on from."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what was saved; it may hold more than `state_dict` returned."""

    def _mark(self) -> Any:
        """Return the time; on a GPU as an event, which nobody waits for."""
        if self.env.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def _start_rollout(self) -> None:
        """Prepare for a rollout."""

    @abstractmethod
    def _keep(self, moment: Moment) -> None:
        """Keep a control step of the rollout."""

    @abstractmethod
    def _update(self) -> None:
        """Learn from the rollout."""

    @abstractmethod
    def _numbers(self) -> dict[str, Tensor]:
        """Return the learner's numbers of the iteration, on the device; a score of no episode is not a number."""
