"""Print quantiles of the object's nonzero forces on links under a policy, in MuJoCo, without exploration.

    python benchmarks/link_forces.py examples/tasks/screwdriver.yaml policies/screwdriver.pt --envs 24

The forces [N] are those of one episode of each environment: their number, median, 99th percentile and maximum. The same is
printed for the penetration of the deepest probe of the task's `surface_distance` [mm], since contacts are soft.
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
    """Return the nonzero forces [N] and depths [mm] of all links, steps and environments, until episodes end."""
    env = TouchEnv(options.task, options.envs, seed=options.seed, overrides=parsed_overrides(tuple(options.set)))
    forces, depths, is_running = [], [], torch.ones(options.envs, dtype=torch.bool)
    env.reset()
    for moment in rollout(policy_for(env, read_policy(options.policy)), env, env.max_steps):
        is_running &= ~moment.step.info.ended
        force = torch.linalg.vector_norm(env.now.link_force[is_running], dim=2).flatten()
        forces.append(force[force > 0])
        depth = -1e3 * env.now.distance[is_running].flatten(1)
        depth = depth.amax(dim=1) if depth.shape[1] else depth.flatten()  # some tasks have no such probes
        depths.append(depth[depth > 0])
    env.close()
    return torch.cat(forces).double(), torch.cat(depths).double()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", type=Path)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--envs", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="change the task's document")
    options = parser.parse_args()
    for name, values, unit in zip(("forces", "depths"), link_forces(options), ("N", "mm"), strict=True):
        if not len(values):
            continue
        median, high, largest = (float(torch.quantile(values, share)) for share in (0.5, 0.99, 1.0))
        quantiles = f"median {median:.1f} {unit}, 99 % below {high:.1f}, largest {largest:.1f}"
        print(f"{options.policy.stem}: {len(values):,} {name}, {quantiles}")


if __name__ == "__main__":
    main()
