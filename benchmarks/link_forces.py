"""How hard policies press: the object's force on each link, where there is one, in MuJoCo, without exploration.

    python benchmarks/link_forces.py examples/tasks/screwdriver.yaml policies/screwdriver.pt --envs 24

Prints how many forces there were, their median, 99th percentile and largest [N], over one episode of each environment.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from tgdsl.commands.arguments import parsed_overrides
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.policy import policy_for


def link_forces(options: argparse.Namespace) -> torch.Tensor:
    """Return the forces [N], of all links, instants and environments in one row: those of episodes that have not ended."""
    env = TouchEnv(options.task, options.envs, seed=options.seed, overrides=parsed_overrides(tuple(options.set)))
    policy, obs, found = policy_for(env, options.policy), env.reset(), []
    going_on = torch.ones(options.envs, dtype=torch.bool)
    for _ in range(env.max_steps):
        made = env.step(policy(obs))
        obs = made.obs
        going_on &= ~made.info.ended
        force = torch.linalg.vector_norm(env.now.link_force[going_on], dim=2).flatten()
        found.append(force[force > 0])
        policy.begin(made.info.ended)
    env.close()
    return torch.cat(found).double()


def main() -> None:
    """Print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", type=Path)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--envs", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="of the task's document")
    options = parser.parse_args()
    force = link_forces(options)
    middle, high = (float(torch.quantile(force, share)) for share in (0.5, 0.99))
    shown = f"median {middle:.1f} N, 99 % below {high:.0f} N, largest {float(force.max()):.0f} N"
    print(f"{options.policy.stem}: {len(force):,} forces, {shown}")


if __name__ == "__main__":
    main()
