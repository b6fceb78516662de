"""`tgdsl evaluate`: how good a policy is."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import OUT, Overrides, Task, parsed_overrides
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError


@dataclass(frozen=True)
class Evaluate:
    """Play episodes without exploration, the same for all policies; print the score with its 95 % interval, and the gait."""

    task: Task
    policy: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A learned policy, as for tgdsl play; default: none, the joints are not moved."""
    groups: tuple[str, ...] = ()
    """Groups of observations that the policy takes, as for tgdsl play."""
    episodes: int = 1000
    """How many episodes count."""
    envs: int = 256
    """Environments; of each, as many episodes count."""
    device: str = "cpu"
    """Where physics and touch are computed: cpu, or cuda."""
    seed: int | None = None
    """Seed of the episodes; default: one that is the same for all policies."""
    out: Annotated[Path | None, OUT] = None
    """A JSON file to write."""
    require: Annotated[str | None, tyro.conf.arg(metavar="BOUNDS")] = None
    """What score, held and gait have to be, such as "coasting<0.1, penetration<2 mm, held>=95 %"; if they are not, the exit
    code is 1."""
    set: Overrides = ()

    def run(self) -> None:
        """Play, and print."""
        from tgdsl.files.write import atomic_write, check_writable, with_folder
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.playing.evaluation import SEED, evaluate, parse_requirements
        from tgdsl.rl.playing.policy import policy_for, read_policy
        from tgdsl.rl.playing.rollout import ZeroActor

        if self.episodes < 1 or self.envs < 1:
            raise TgdslError(f"--episodes {self.episodes} --envs {self.envs}: expected at least 1 of each")
        if self.groups and self.policy is None:
            raise TgdslError("--groups belong to a policy; give one with --policy")
        required = [] if self.require is None else parse_requirements(self.require)
        if self.out is not None:
            check_writable(self.out)
        policy = None if self.policy is None else read_policy(self.policy)
        seed = SEED if self.seed is None else self.seed
        envs = min(self.envs, self.episodes)
        with StatusLine() as progress:
            overrides = parsed_overrides(self.set)
            env = TouchEnv(self.task, envs, device=self.device, seed=seed, overrides=overrides, progress=progress)
        try:
            variants = env.task.setup.num_variants
            if envs < variants:
                played = "1 is" if envs == 1 else f"the first {envs} are"
                print(f'of the {variants} variants of "{env.spec.object}" {played} played: there are no more environments')
            actor = ZeroActor(env) if policy is None else policy_for(env, policy, self.groups)
            for line in actor.changes:
                print(f"changed since the policy was learned: {line}")
            with StatusLine() as progress:
                evaluation = evaluate(env, actor, self.episodes, seed, progress)
        finally:
            env.close()
        print(evaluation)
        print(f"\n{evaluation.gait}")
        if self.out is not None:
            atomic_write(with_folder(self.out), (json.dumps(evaluation.plain(), indent=2, allow_nan=False) + "\n").encode())
        failures = [failure for one in required if (failure := one.failure(evaluation)) is not None]
        if failures:
            print("\n".join(failures), file=sys.stderr)
            sys.exit(1)
