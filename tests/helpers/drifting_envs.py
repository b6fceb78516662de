"""Environments without physics, for tests of learning: a point that drifts, and is pushed by the actions."""

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict


class Drifting(VecEnv):
    """Observations are position, velocity and a number that hardly changes; the reward is for being near the origin."""

    num_actions, max_episode_length, device, cfg, step_dt = 2, 7, "cpu", {}, 0.025

    def __init__(self, num_envs, first=0, joint=None, dtype=torch.float64):
        """Environment i of `num_envs` begins as number first + i of `joint` ones."""
        generator = torch.Generator().manual_seed(0)
        self.num_envs = num_envs
        own = slice(first, first + num_envs)
        self.pos = torch.randn((joint or num_envs, 2), generator=generator, dtype=dtype)[own].clone()
        self.vel = torch.randn((joint or num_envs, 2), generator=generator, dtype=dtype)[own].clone()
        self.episode_length_buf = torch.arange(first, first + num_envs) % 7

    @property
    def unwrapped(self):
        return self

    def get_observations(self):
        still = 1e-3 * self.pos[:, :1].sin()
        return TensorDict({"here": self.pos.clone(), "there": self.vel.clone(), "still": still}, [self.num_envs])

    def step(self, actions):
        self.vel = 0.9 * self.vel + 0.1 * actions
        self.pos = self.pos + 0.1 * self.vel
        self.episode_length_buf += 1
        lost = self.pos.norm(dim=1) > 3.0
        late = (self.episode_length_buf >= 7) & ~lost
        ended = lost | late
        reward = 1.0 - self.pos.norm(dim=1)
        self.pos = torch.where(ended[:, None], 0.5 * self.pos, self.pos)
        self.episode_length_buf[ended] = 0
        return self.get_observations(), reward, ended.long(), {"time_outs": late}
