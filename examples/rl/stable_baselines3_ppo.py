"""PPO of Stable-Baselines3 on a task, through the environment of gymnasium: `pip install "tgdsl[rl]" stable-baselines3`.

python examples/rl/stable_baselines3_ppo.py --task examples/tasks/in_palm_rotate.yaml --envs 256 --steps 5000
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from tgdsl.rl.adapters.gymnasium import TouchVectorEnv
from tgdsl.rl.env import TouchEnv

HAND = ("proprio", "tactile_sensors", "goal")
"""Groups that a real hand has."""


class Sb3VecEnv(VecEnv):
    """Stable-Baselines3's own kind of vector environment, made of one of gymnasium."""

    def __init__(self, env: TouchVectorEnv):
        """Translate an environment."""
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> dict[str, np.ndarray]:
        """Begin new episodes; a seed is used once."""
        obs, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Make one control step; `infos` has end, return and last observations of each episode that has ended."""
        obs, reward, terminated, truncated, info = self.env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(terminated | truncated):
            final = info["final_info"]
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": {"r": float(final["episode_return"][i]), "l": int(final["episode_steps"][i]), "t": 0.0},
                "score": float(final["score"][i]),
            }
        return obs, reward, terminated | truncated, infos

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute, which all environments share."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: environments have no separate attributes."""
        raise NotImplementedError("environments have no separate attributes")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Refuse: environments have no separate methods."""
        raise NotImplementedError("environments have no separate methods")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that none is wrapped."""
        return [False for _ in self._get_indices(indices)]


def main(arguments: Sequence[str] | None = None) -> PPO:
    """Train, and return the model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="examples/tasks/in_palm_rotate.yaml")
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=5000, help="control steps of each environment")
    args = parser.parse_args(arguments)

    touch_env = TouchEnv(args.task, args.envs)
    groups = [group for group in HAND if group in touch_env.groups]
    env = Sb3VecEnv(TouchVectorEnv(touch_env, groups=groups))
    rollout = 24 * args.envs
    model = PPO("MultiInputPolicy", env, n_steps=24, batch_size=rollout // 4, n_epochs=5, device="cpu", verbose=1)
    model.learn(args.steps * args.envs)
    env.close()
    return model


if __name__ == "__main__":
    main()
