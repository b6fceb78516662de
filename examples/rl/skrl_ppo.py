"""PPO of skrl on a task, through the environment of gymnasium: `pip install "tgdsl[rl]" skrl`.

python examples/rl/skrl_ppo.py --task examples/tasks/in_palm_rotate.yaml --envs 256 --steps 5000
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg
from torch import Tensor

from tgdsl.rl.adapters.gymnasium import TouchVectorEnv
from tgdsl.rl.env import TouchEnv

HAND = ("proprio", "tactile_sensors", "goal")
"""Groups that a real hand has: skrl puts them side by side."""


def network(num_inputs: int, num_outputs: int) -> torch.nn.Module:
    """Return a small network whose first outputs are near zero."""
    last = torch.nn.Linear(128, num_outputs)
    torch.nn.init.normal_(last.weight, std=0.01)
    return torch.nn.Sequential(torch.nn.Linear(num_inputs, 128), torch.nn.ELU(), last)


class Policy(GaussianMixin, Model):
    """Mean actions by a network; their standard deviations are parameters."""

    def __init__(self, **spaces: Any):
        """Make the network."""
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.network = network(self.num_observations, self.num_actions)
        self.log_std = torch.nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        """Return mean actions and the logarithm of their standard deviations."""
        return self.network(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """Value by a network."""

    def __init__(self, **spaces: Any):
        """Make the network."""
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.network = network(self.num_observations, 1)

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        """Return the value."""
        return self.network(inputs["observations"]), {}


def main(arguments: Sequence[str] | None = None) -> PPO:
    """Train, and return the agent."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="examples/tasks/in_palm_rotate.yaml")
    parser.add_argument("--envs", type=int, default=256, help="at least 2: skrl resets a single one itself")
    parser.add_argument("--steps", type=int, default=5000, help="control steps of each environment")
    parser.add_argument("--out", default="out/skrl", help="folder of TensorBoard's files and checkpoints")
    args = parser.parse_args(arguments)

    touch_env = TouchEnv(args.task, args.envs)
    groups = [group for group in HAND if group in touch_env.groups]
    env = wrap_env(TouchVectorEnv(touch_env, groups=groups), wrapper="gymnasium")
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    config = PPO_CFG(rollouts=24, learning_epochs=5, mini_batches=4, learning_rate=3e-4, time_limit_bootstrap=True)
    config.observation_preprocessor = RunningStandardScaler
    config.observation_preprocessor_kwargs = {"size": env.observation_space, "device": env.device}
    config.experiment.directory = args.out
    memory = RandomMemory(memory_size=config.rollouts, num_envs=env.num_envs, device=env.device)
    agent = PPO(models={"policy": Policy(**spaces), "value": Value(**spaces)}, memory=memory, cfg=config, **spaces)
    trainer_config = SequentialTrainerCfg(
        timesteps=args.steps, headless=True, disable_progressbar=None, close_environment_at_exit=False
    )
    SequentialTrainer(cfg=trainer_config, env=env, agents=agent).train()
    env.close()
    return agent


if __name__ == "__main__":
    main()
