"""Teachers that are written, not learned: a function as a policy file with a card."""

import torch

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.policy import card_texts, write_policy
from tgdsl.rl.train.folder import run_origin
from tgdsl.rl.train.learner import ORIGIN_KEYS


class FindRidge(torch.nn.Module):
    """The script of examples/tasks/find_ridge.py: takes the command and clean depths at `low`."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        target, depth = x[:, :2], x[:, 7:].view(-1, 3, 3)
        rows = 1e3 * depth.sum(dim=2)
        low, high = rows[:, 0], rows[:, 2]
        balance = low - high
        passed = torch.where(balance < -0.6, 0.5, -0.5)
        bend = torch.where((low > 3.0) & (high > 3.0), passed, (-0.1 * balance).clamp(-0.5, 0.5))
        bend = torch.where(depth.amax(dim=2).amax(dim=1) > 0.0, bend, torch.zeros_like(bend))
        press = ((0.225 - target[:, 1]) / 0.01).clamp(-1.0, 1.0)
        return torch.stack([bend, press, torch.zeros_like(bend)], dim=1)


class Linear(torch.nn.Module):
    """A fixed linear function of the observations."""

    def __init__(self, size: int, actions: int):
        super().__init__()
        generator = torch.Generator().manual_seed(size)
        self.register_buffer("weight", torch.randn((size, actions), generator=generator) / size**0.5)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x @ self.weight).clamp(-1.0, 1.0)


def teacher(file, loaded, groups, module=None, std=None, **card):
    """Write a teacher that sees some groups; return its file."""
    env = TouchEnv(loaded, 2, threads=1)
    try:
        sizes = {name: env.groups[name] for name in groups}
        network = module or Linear(sum(sizes.values()), env.num_actions)
        origin = run_origin(loaded, env, 0, {}, 1)
        own = {"groups": sizes, "joints": list(env.joint_names), "std": std, **{name: origin[name] for name in ORIGIN_KEYS}}
        traced = torch.jit.trace(network, torch.zeros((2, sum(sizes.values()))))
        write_policy(traced, card_texts(env.touch, own | card), file)
    finally:
        env.close()
    return file
