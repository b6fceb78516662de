"""How hard policies press: the object's force on each link, where there is one, in MuJoCo, without exploration.

    python benchmarks/link_forces.py examples/tasks/screwdriver.yaml policies/screwdriver.pt --envs 24

Prints how many forces there were, their median, 99th percentile and largest [N], over one episode of each environment; and
the same how deep in the object the deepest probe of the task's `surface_distance` was [mm], where one was: contacts are soft.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from tgdsl.commands.arguments import parsed_overrides
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.policy import policy_for, read_policy
from tgdsl.rl.playing.rollout import rollout


def link_forces(options: argparse.Namespace) -> tuple[torch.Tensor, torch.Tensor]:
    """Return forces [N] and depths [mm], of all links, instants and environments in one row, until episodes end."""
    env = TouchEnv(options.task, options.envs, seed=options.seed, overrides=parsed_overrides(tuple(options.set)))
    found, depths, going_on = [], [], torch.ones(options.envs, dtype=torch.bool)
    env.reset()
    for moment in rollout(policy_for(env, read_policy(options.policy)), env, env.max_steps):
        going_on &= ~moment.step.info.ended
        force = torch.linalg.vector_norm(env.now.link_force[going_on], dim=2).flatten()
        found.append(force[force > 0])
        depth = -1e3 * env.now.distance[going_on].flatten(1)
        depth = depth.amax(dim=1) if depth.shape[1] else depth.flatten()  # of a task without such probes
        depths.append(depth[depth > 0])
    env.close()
    return torch.cat(found).double(), torch.cat(depths).double()


def main() -> None:
    """Print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", type=Path)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--envs", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="of the task's document")
    options = parser.parse_args()
    for name, values, unit in zip(("forces", "depths"), link_forces(options), ("N", "mm"), strict=True):
        if not len(values):
            continue
        middle, high, largest = (float(torch.quantile(values, share)) for share in (0.5, 0.99, 1.0))
        told = f"median {middle:.1f} {unit}, 99 % below {high:.1f}, largest {largest:.1f}"
        print(f"{options.policy.stem}: {len(values):,} {name}, {told}")


if __name__ == "__main__":
    main()
