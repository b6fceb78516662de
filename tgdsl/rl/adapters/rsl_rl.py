"""A `TouchEnv` as a `VecEnv` of rsl_rl 5.4 or later.

Groups of observations are a TensorDict; the runner's `obs_groups` selects the actor's and the critic's.
`extras["time_outs"]` marks episodes truncated at the time limit. `extras["log"]` exists when episodes have ended, and has their
return, steps, score, whether a fault ended them, and the sum of each term of the reward.

rsl_rl's normaliser divides by the standard deviation plus `eps`, 0.01, which hides groups in metres: set `obs_normalizer.eps`
of actor and critic to 1e-5 after constructing the runner, as `examples/learn.py` does.

Shapes: `env` environments, `joint` joints that the policy moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import TgdslError
from tgdsl.rl.env import StepInfo, TouchEnv

try:
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError as error:
    raise TgdslError(f'an environment of rsl_rl needs rsl-rl-lib and tensordict: pip install "tgdsl[rl]" ({error})') from error


class TouchVecEnv(VecEnv):
    """A `TouchEnv` with rsl_rl's interface, and nothing added; `cfg` is the task's document."""

    def __init__(self, touch_env: TouchEnv):
        self.touch_env, self.device = touch_env, touch_env.device
        self.num_envs, self.num_actions = touch_env.num_envs, touch_env.num_actions
        self.max_episode_length = touch_env.max_steps
        self.cfg = touch_env.spec.model_dump(mode="json")
        self._obs = self._tensordict(touch_env.reset())

    @property
    def unwrapped(self) -> TouchVecEnv:
        """These environments: rsl_rl's random network distillation reads their `step_dt`."""
        return self

    @property
    def step_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.touch_env.control_step

    @property
    def episode_length_buf(self) -> Int[Tensor, " env"]:
        """Control steps of each environment's present episode; may be written, whole or in part."""
        return self.touch_env.steps

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Int[Tensor, " env"]) -> None:
        self.touch_env.steps.copy_(steps)

    def get_observations(self) -> TensorDict:
        """Return the last observations: groups of (env, feature)."""
        return self._obs

    def reset(self, seed: int | None = None) -> tuple[TensorDict, dict[str, Any]]:
        """Begin a new episode in all environments; return the observations and an empty dictionary.

        `seed` is the seed of all random numbers; default: continue with the current numbers.
        """
        self._obs = self._tensordict(self.touch_env.reset(seed))
        return self._obs, {}

    def step(
        self, actions: Float[Tensor, "env joint"]
    ) -> tuple[TensorDict, Float[Tensor, " env"], Int[Tensor, " env"], dict[str, Any]]:
        """Make one control step with actions, clipped to [−1, 1].

        Returns:
            Observations by group, of episodes that have ended the first of the next one; rewards; 1 where an episode has ended,
            else 0; and extras, see the top of this page.
        """
        obs, reward, _, truncated, info = self.touch_env.step(actions)
        self._obs = self._tensordict(obs)
        extras: dict[str, Any] = {"time_outs": truncated}
        if len(ids := info.ended.nonzero()[:, 0]):
            extras["log"] = _log(info, ids)
        return self._obs, reward, info.ended.long(), extras

    def close(self) -> None:
        """Close the environments."""
        self.touch_env.close()

    def _tensordict(self, obs: Mapping[str, Tensor]) -> TensorDict:
        return TensorDict(dict(obs), batch_size=[self.num_envs], device=self.device)


def _log(info: StepInfo, ids: Int[Tensor, " ended"]) -> dict[str, Tensor]:
    """Return the numbers of episodes that have ended: rsl_rl takes the mean over an iteration's."""
    entries = {
        "Episode/return": info.episode_return,
        "Episode/steps": info.episode_steps.float(),
        "Episode/score": info.score,
        "Episode/fault": info.faults.float(),
        **{f"Reward/{name}": total for name, total in info.episode_terms.items()},
    }
    return {name: value[ids].to(torch.float32) for name, value in entries.items()}
