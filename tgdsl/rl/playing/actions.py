"""Who acts: nobody, chance, a script or a learned policy.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

import runpy
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.rl.draws import Draws
from tgdsl.rl.env import TouchEnv

KINDS = ("zero", "random", "script")
"""Actions by one word; else they are a function of a file, `FILE.py:FUNCTION`."""


class ScriptError(TgdslError):
    """A script that cannot be run, or whose actions do not fit."""


class Actor(Protocol):
    """Who acts."""

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return the actions, from −1 to 1, for observations."""
        ...

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        """Forget what is remembered of episodes that have ended."""
        ...


class Zero:
    """Nobody: zeros."""

    def __init__(self, env: TouchEnv):
        """Begin."""
        self._action = torch.zeros((env.num_envs, env.num_actions), device=env.device)

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return zeros."""
        return self._action

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        """Do nothing."""


class Chance:
    """Numbers from −1 to 1, the same for an environment however many there are."""

    def __init__(self, env: TouchEnv, seed: int):
        """Begin."""
        self._draws = Draws(seed, env.num_envs, env.device)
        self._count = torch.zeros(env.num_envs, dtype=torch.int64, device=env.device)
        self._num = env.num_actions

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return other numbers at each call."""
        self._count += 1
        return self._draws.uniform("played actions", self._count, self._num, -1.0, 1.0)

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        """Do nothing."""


class Script:
    """A function of the environment and its observations that returns actions."""

    def __init__(self, env: TouchEnv, function: Callable[[TouchEnv, Mapping[str, Tensor]], Any], name: str):
        """Begin.

        Args:
            env: The environment.
            function: Returns actions (env, joint).
            name: What it is called in errors.
        """
        self._env, self._function, self._name = env, function, name

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return what the function returns.

        Raises:
            ScriptError: If it raises anything, or what it returns does not fit.
        """
        env = self._env
        try:
            action = torch.as_tensor(self._function(env, obs), dtype=torch.float32, device=env.device)
        except TgdslError:
            raise
        except Exception as error:  # whatever a user's code raises
            place = traceback.extract_tb(error.__traceback__)[-1]
            raise ScriptError(f"{place.filename}:{place.lineno}: {self._name}: {type(error).__name__}: {error}") from error
        if tuple(action.shape) != (env.num_envs, env.num_actions):
            wanted = f"({env.num_envs}, {env.num_actions})"
            raise ScriptError(f"{self._name}: actions have shape {tuple(action.shape)}, expected {wanted}")
        return action

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        """Do nothing: a script knows `env.steps`."""


def actor_of(env: TouchEnv, actions: str, seed: int = 0) -> Actor:
    """Return who acts.

    Args:
        env: The environment.
        actions: One of `KINDS`, `script` being the task's own method `script(obs)`; or `FILE.py:FUNCTION`: the function takes
            the environment and its observations, and returns actions (env, joint).
        seed: What chance follows from.

    Raises:
        ScriptError: If there is no such script.
    """
    if actions == "zero":
        return Zero(env)
    if actions == "random":
        return Chance(env, seed)
    if actions == "script":
        return Script(env, _own_script(env), f"the script of {env.spec.task}")
    return Script(env, _function(actions), actions)


def check_actions(actions: str) -> None:
    """See that actions can be had, before an environment is made.

    Raises:
        ScriptError: If there is no such script.
    """
    if actions not in KINDS:
        _function(actions)


def _own_script(env: TouchEnv) -> Callable[[TouchEnv, Mapping[str, Tensor]], Any]:
    script = getattr(env.task, "script", None)
    if script is None:
        raise ScriptError(f'the task "{env.spec.task}" brings no script of its own; name one as FILE.py:FUNCTION')
    return lambda _, obs: script(obs)


def _function(actions: str) -> Callable[[TouchEnv, Mapping[str, Tensor]], Any]:
    """Return the function that `FILE.py:FUNCTION` names.

    Raises:
        ScriptError: If there is none.
    """
    file, _, name = actions.rpartition(":")
    if not file.endswith(".py"):
        raise ScriptError(f'there are no actions "{actions}", expected {", ".join(KINDS)} or FILE.py:FUNCTION')
    if not Path(file).is_file():
        raise ScriptError(f"{file}: there is no such file")
    try:
        found = runpy.run_path(file, run_name=Path(file).stem)
    except Exception as error:  # whatever a user's code raises
        raise ScriptError(f"{_place(file, error)}: {type(error).__name__}: {error}") from error
    functions = [key for key, value in found.items() if callable(value) and not key.startswith("_")]
    if not callable(found.get(name)):
        raise ScriptError(f'{file}: there is no function "{name}"; {did_you_mean(name, functions, "functions")}')
    return found[name]


def _place(file: str, error: Exception) -> str:
    """Return the file, and the line in it that raised."""
    if isinstance(error, SyntaxError):
        return f"{file}:{error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f"{file}:{lines[-1]}" if lines else file
