"""The loop in which a policy acts, in environments and on a hand or a log; actors without learning.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

import runpy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import SimulationError, TgdslError, did_you_mean, raised_at
from tgdsl.rl.draws import Draws
from tgdsl.rl.env import Observations, Step, TouchEnv


class Actor(ABC):
    """A source of actions in environments."""

    changes: Sequence[str] = ()  # changes of the task since the actor was learned, a line each

    @abstractmethod
    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return actions, from −1 to 1, for observations by group."""

    def begin(self, ended: Bool[Tensor, " env"]) -> None:  # noqa: B027
        """Reset the memory of ended episodes; most actors have none."""


class Environments(Protocol):
    """Where a policy acts: a `TouchEnv`, or one hand."""

    def observe(self) -> Observations:
        """Return the present observations, by group."""
        ...

    def step(self, action: Float[Tensor, "env joint"]) -> Step:
        """Make one control step."""
        ...


@dataclass(frozen=True, eq=False)
class Moment:
    """One control step of a policy."""

    index: int  # its number, from 0
    obs: Mapping[str, Float[Tensor, "env feature"]]  # observations before the action, by group
    action: Float[Tensor, "env joint"]  # the action
    step: Step  # its result


def rollout(actor: Actor, env: Environments, num_steps: int | None = None) -> Iterator[Moment]:
    """Let an actor act from the environments' present state, and yield each control step."""
    for index in count() if num_steps is None else range(num_steps):
        obs = env.observe()
        action = actor(obs)
        step = env.step(action)
        actor.begin(step.info.ended)
        yield Moment(index, obs, action, step)


def steps_of(env: TouchEnv, seconds: float | None) -> int:
    """Return the number of control steps of a duration, at least one; default: an episode's."""
    if seconds is None:
        return env.max_steps
    if not 0 < seconds < float("inf"):
        raise SimulationError(f"played for {seconds:g} s: expected more than 0 s")
    return max(1, round(seconds / env.control_step))


KINDS = ("zero", "random", "script")  # actions by one word; others are a function of a file, `FILE.py:FUNCTION`
ScriptFunction = Callable[[TouchEnv, Mapping[str, Tensor]], Any]
"""Takes an environment and its observations by group, and returns actions (env, joint)."""


class ScriptError(TgdslError):
    """A script that cannot be run, or whose actions do not fit."""


class ZeroActor(Actor):
    """Returns zeros."""

    def __init__(self, env: TouchEnv):
        self._action = torch.zeros((env.num_envs, env.num_actions), dtype=torch.float32, device=env.device)

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        return self._action


class RandomActor(Actor):
    """Returns random numbers from −1 to 1, independent of the number of environments."""

    def __init__(self, env: TouchEnv, seed: int):
        self._draws = Draws(seed, env.num_envs, env.device)
        self._count = torch.zeros(env.num_envs, dtype=torch.int64, device=env.device)
        self._num = env.num_actions

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        self._count += 1
        return self._draws.uniform("played actions", self._count, self._num, -1.0, 1.0)


class ScriptActor(Actor):
    """Returns the actions of a function of the environment and its observations; errors name the line in `file`."""

    def __init__(self, env: TouchEnv, function: ScriptFunction, name: str, file: str = ""):
        self._env, self._function, self._name, self._file = env, function, name, file

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        env, shape = self._env, (self._env.num_envs, self._env.num_actions)
        try:
            output = self._function(env, obs)
        except Exception as error:  # whatever a user's code raises
            place = f"{raised_at(self._file, error)}: {self._name}" if self._file else self._name
            raise ScriptError(f"{place}: {type(error).__name__}: {error}") from error
        try:
            action = torch.as_tensor(output, dtype=torch.float32, device=env.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ScriptError(f"{self._name}: actions are {type(output).__name__}, expected {shape} numbers") from error
        if tuple(action.shape) != shape:
            raise ScriptError(f"{self._name}: actions have shape {tuple(action.shape)}, expected {shape}")
        return action


def actor_of(env: TouchEnv, actions: str, seed: int = 0) -> Actor:
    """Return the actor of one of `KINDS`, `script` being the task's own method `script(obs)`, or of `FILE.py:FUNCTION`."""
    if actions == "zero":
        return ZeroActor(env)
    if actions == "random":
        return RandomActor(env, seed)
    if actions != "script":
        return ScriptActor(env, *_script_of(actions))
    script = getattr(env.task, "script", None)
    if script is None:
        raise ScriptError(f'the task "{env.spec.task}" has no script; name one as FILE.py:FUNCTION')
    return ScriptActor(env, lambda _, obs: script(obs), f"the script of {env.spec.task}")


def check_actions(actions: str) -> None:
    """Raise `ScriptError` if a script does not exist; needs no environment."""
    if actions not in KINDS:
        _script_of(actions)


def _script_of(actions: str) -> tuple[ScriptFunction, str, str]:
    """Return the function that `FILE.py:FUNCTION` names, its name and the file."""
    file, _, name = actions.rpartition(":")
    if not file.endswith(".py"):
        raise ScriptError(f'there are no actions "{actions}", expected {", ".join(KINDS)} or FILE.py:FUNCTION')
    if not Path(file).is_file():
        raise ScriptError(f"{file}: there is no such file")
    try:
        result = runpy.run_path(file, run_name=Path(file).stem)
    except Exception as error:  # whatever a user's code raises
        raise ScriptError(f"{raised_at(file, error)}: {type(error).__name__}: {error}") from error
    functions = [key for key, value in result.items() if callable(value) and not key.startswith("_")]
    if not callable(result.get(name)):
        raise ScriptError(f'{file}: there is no function "{name}"; {did_you_mean(name, functions, "functions")}')
    return result[name], name, file
