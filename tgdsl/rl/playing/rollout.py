"""The loop in which a policy acts: in environments, and on a hand or a log, which is an environment of one.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.rl.env import Observations, Step, TouchEnv


class Actor(ABC):
    """Who acts in environments."""

    changes: Sequence[str] = ()  # what of the task was otherwise when that was learned, a line each

    @abstractmethod
    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return actions, from −1 to 1, for observations by group."""

    def begin(self, ended: Bool[Tensor, " env"]) -> None:  # noqa: B027
        """Forget what is remembered of episodes that have ended; most remember nothing."""


class Environments(Protocol):
    """Where a policy acts: a `TouchEnv`, or one hand."""

    def observe(self) -> Observations:
        """Return what is observed now, by group."""
        ...

    def step(self, action: Float[Tensor, "env joint"]) -> Step:
        """Make one control step."""
        ...


@dataclass(frozen=True, eq=False)
class Moment:
    """One control step of a policy."""

    index: int  # its number, from 0
    obs: Mapping[str, Float[Tensor, "env feature"]]  # observations that the action was chosen from, by group
    action: Float[Tensor, "env joint"]  # the action
    step: Step  # what came of it


def rollout(actor: Actor, env: Environments, num_steps: int | None = None) -> Iterator[Moment]:
    """Let an actor act from where the environments are, and yield each control step."""
    for index in count() if num_steps is None else range(num_steps):
        obs = env.observe()
        action = actor(obs)
        step = env.step(action)
        actor.begin(step.info.ended)
        yield Moment(index, obs, action, step)


def steps_of(env: TouchEnv, seconds: float | None) -> int:
    """Return how many control steps a duration has, at least one; default: an episode's."""
    if seconds is None:
        return env.max_steps
    if not 0 < seconds < float("inf"):
        raise SimulationError(f"played for {seconds:g} s: expected more than 0 s")
    return max(1, round(seconds / env.control_step))
