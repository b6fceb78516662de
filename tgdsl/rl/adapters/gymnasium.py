"""A `TouchEnv` as a `gymnasium.vector.VectorEnv`.

Observations are a dictionary of groups, actions from −1 to 1 for each joint. An environment whose episode ends begins the next
one in the same step (`AutoresetMode.SAME_STEP`): `info["final_obs"]` has the last observations of the old one,
`info["final_info"]` its last step's entries. `info` has the entries of `StepInfo`, each with its mask under `_` and its name.

Gymnasium's observation wrappers (`FlattenObservation`, `NormalizeObservation`, …) refuse every environment of this mode: use
the argument `groups` to leave out groups. `NumpyToTorch` cannot convert `final_obs` as an array: use `output="torch"` instead.
All other wrappers take this environment with `output="numpy"`; they compute with arrays, so with `output="torch"` only
`TransformReward` works.

Shapes: `env` environments, `joint` joints that the policy moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import index
from typing import Any, Literal, SupportsIndex

import numpy as np
import torch
from torch import Tensor

from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.rl.env import StepInfo, TouchEnv

try:
    from gymnasium.spaces import Box, Dict
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise TgdslError(f'an environment of gymnasium needs gymnasium: pip install "tgdsl[rl]" ({error})') from error

Output = Literal["numpy", "torch"]
STEP_KEYS = ("terms", "score", "episode_return", "episode_steps", "episode_terms", "faults")
"""Entries of `info` for each step: see `StepInfo`."""


class TouchVectorEnv(VectorEnv[dict[str, Any], Any, Any]):
    """A `TouchEnv` with gymnasium's interface, and nothing added.

    With `output="numpy"`, `info` is as in gymnasium's `SyncVectorEnv`: entries whose mask is false everywhere are missing;
    `final_obs` is an array of dictionaries. With `output="torch"` nothing is copied to the host: all masks are present, rows
    outside of a mask are undefined, and `final_obs` is a dictionary of tensors.

    Attributes:
        touch_env: The `TouchEnv`.
        device: Where tensors are.
    """

    def __init__(self, touch_env: TouchEnv, output: Output | str = "numpy", groups: Sequence[str] | None = None):
        """Translate an environment.

        Args:
            touch_env: The environment; `close` closes it.
            output: Whether observations, rewards and ends are NumPy arrays or tensors on the environment's device; actions may
                always be either.
            groups: Groups of observations to return, in this order; default: all.

        Raises:
            TgdslError: If there is no such output or group.
        """
        if output not in ("numpy", "torch"):
            raise TgdslError(f'output is "{output}", expected "numpy" or "torch"')
        self._groups = tuple(touch_env.groups if groups is None else groups)
        for group in self._groups:
            if group not in touch_env.groups:
                hint = did_you_mean(group, touch_env.groups, "groups")
                raise TgdslError(f'there is no group of observations "{group}"; {hint}')
        self.touch_env, self.device, self.num_envs = touch_env, touch_env.device, touch_env.num_envs
        self._is_numpy = output == "numpy"
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        boxes = [(group, Box(-np.inf, np.inf, (touch_env.groups[group],), np.float32)) for group in self._groups]
        self.single_observation_space = Dict(boxes)
        self.single_action_space = Box(-1.0, 1.0, (touch_env.num_actions,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: SupportsIndex | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin a new episode in all environments; return observations by group, (env, feature) each, and an empty dictionary.

        Args:
            seed: Seed of all random numbers; default: continue with the current numbers.
            options: None or empty: there are none.

        Raises:
            TgdslError: If there is a seed per environment, or an option.
        """
        if isinstance(seed, Sequence):
            raise TgdslError(f"seed is {seed!r}: expected one whole number for all environments, which seeds each of them")
        if options:
            raise TgdslError(f"reset has no options, found {', '.join(map(repr, options))}: all environments begin again")
        new_seed = None if seed is None else index(seed)
        super().reset(seed=new_seed)
        return self._obs(self.touch_env.reset(new_seed)), {}

    def step(self, actions: Any) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """Make one control step with actions (env, joint) from −1 to 1, an array or a tensor.

        Returns:
            Observations by group, rewards, terminations, truncations, and further entries: see the class.
        """
        action = torch.as_tensor(actions, dtype=torch.float32, device=self.device)
        obs, reward, terminated, truncated, info = self.touch_env.step(action)
        entries = self._numpy_info(info) if self._is_numpy else self._torch_info(info)
        return self._obs(obs), self._output(reward), self._output(terminated), self._output(truncated), entries

    def close_extras(self, **_: Any) -> None:
        """Close the environments."""
        self.touch_env.close()

    def _output(self, value: Tensor | Mapping[str, Tensor]) -> Any:
        if isinstance(value, Mapping):
            return {name: self._output(part) for name, part in value.items()}
        return value.cpu().numpy() if self._is_numpy else value

    def _obs(self, obs: Mapping[str, Tensor]) -> dict[str, Any]:
        return self._output({group: obs[group] for group in self._groups})

    def _torch_info(self, info: StepInfo) -> dict[str, Any]:
        entries = {name: getattr(info, name) for name in STEP_KEYS}
        final_obs = {group: info.final_obs[group] for group in self._groups}
        final = {"final_obs": final_obs, "final_info": _masked(entries, info.ended)}
        return _masked(entries, ~info.ended) | final | {f"_{name}": info.ended for name in final}

    def _numpy_info(self, info: StepInfo) -> dict[str, Any]:
        ended = info.ended.cpu().numpy()
        entries = {name: self._output(getattr(info, name)) for name in STEP_KEYS}
        present = {} if ended.all() else _masked(entries, ~ended)
        if not ended.any():
            return present
        last = {group: info.final_obs[group].cpu().numpy() for group in self._groups}
        final_obs = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):
            final_obs[row] = {group: values[row] for group, values in last.items()}
        final = {"final_obs": final_obs, "final_info": _masked(entries, ended)}
        return present | final | {f"_{name}": ended.copy() for name in final}


def _masked(values: Mapping[str, Any], mask: Any) -> dict[str, Any]:
    """Return values and their mask as `VectorEnv._add_info` does: arrays are zero where it is false, tensors as they are."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            result[name] = _masked(value, mask)
        else:
            result[name] = np.where(mask, value, value.dtype.type(0)) if isinstance(value, np.ndarray) else value
        result[f"_{name}"] = mask
    return result
