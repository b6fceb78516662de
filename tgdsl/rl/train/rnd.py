"""rsl_rl's random network distillation, kept on the device.

Shapes: `env` environments, `feature` numbers that are looked at.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.extensions import RandomNetworkDistillation
from tensordict import TensorDict
from torch import Tensor

from tgdsl.rl.train.normalising import Normalisation, RewardNormalisation

UNTIL = 10**8
"""As rsl_rl has it: after so many states, and rewards, their normalisation does not change any more."""


class Distillation(RandomNetworkDistillation):
    """rsl_rl's `RandomNetworkDistillation`, whose rewards wait for no tensor's value."""

    def __init__(self, num_envs: int, eps: float = 1e-2, clip: float = float("inf"), **options: Any):
        super().__init__(**options)
        if self.state_normalization:
            self.state_normalizer = Normalisation([self.num_states], eps, UNTIL, clip).to(self.device)
        if self.reward_normalization:
            self.reward_normalizer = RewardNormalisation(num_envs, until=UNTIL).to(self.device)
        for parameter in self.target.parameters():
            parameter.requires_grad_(False)

    def surprise(self, obs: TensorDict) -> Tensor:
        """Return the error of the prediction, normalised, (env,)."""
        with torch.no_grad():
            state = self.state_normalizer(self.get_rnd_state(obs))
            error = torch.linalg.norm(self.target(state) - self.predictor(state), dim=1)
            return self.reward_normalizer(error)

    def next_weight(self) -> float:
        """Count a control step, and return the weight of its rewards."""
        self.update_counter += 1
        scheduler = self.weight_scheduler
        self.weight = (
            self.initial_weight if scheduler is None else scheduler(self.update_counter, **self.weight_scheduler_params)
        )
        return self.weight

    def get_intrinsic_reward(self, obs: TensorDict) -> Tensor:
        """Return the rewards of a control step, (env,)."""
        return self.surprise(obs) * self.next_weight()
