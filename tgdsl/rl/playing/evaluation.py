"""How good a policy is: episodes without exploration, the same for all policies.

Shapes: `env` environments.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from scipy.stats import t as student_t

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.gait import Gait, GaitMeter
from tgdsl.rl.playing.rollout import Actor, rollout

SEED = 1_000_003
"""What is random in the episodes follows from it, whatever a policy was learned with."""
Z95 = 1.959963984540054
CHECKED_EVERY = 40
"""Control steps after which the host looks whether all episodes have ended."""


@dataclass(frozen=True)
class Evaluation:
    """What episodes were; intervals are of 95 %.

    Attributes:
        task: The task.
        unit: Unit of the score.
        episodes: How many there were.
        envs: In how many environments.
        seed: What was random in them follows from it.
        score: Mean of the score.
        score_interval: Its interval.
        held: Share of the episodes that lasted as long as one may: without a drop, or whatever else ends them before.
        held_interval: Its interval, Wilson's.
        episode_return: Mean of the sum of rewards.
        seconds: Mean of the duration [s].
        faults: How many a fault ended.
        gait: How the object was moved.
    """

    task: str
    unit: str
    episodes: int
    envs: int
    seed: int
    score: float
    score_interval: tuple[float, float]
    held: float
    held_interval: tuple[float, float]
    episode_return: float
    seconds: float
    faults: int
    gait: Gait

    def plain(self) -> dict[str, Any]:
        """Return plain values as JSON has them: None for what is not finite, such as the interval of one episode."""
        return {name: _finite(value) for name, value in asdict(self).items()}

    def __str__(self) -> str:
        low, high = self.score_interval
        least, most = self.held_interval
        between = f" (95 %: {low:.3f} to {high:.3f}) in {self.episodes:,} episodes" if self.episodes > 1 else " in one episode"
        return f"score {self.score:.3f} {self.unit}{between}; {self.held:.1%} (95 %: {least:.1%} to {most:.1%}) of full length"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return tuple(_finite(part) for part in value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def evaluate(env: TouchEnv, actor: Actor, episodes: int = 1000, seed: int = SEED, progress: Progress = silent) -> Evaluation:
    """Let an actor act, and return how good that was: see `evaluate_each`."""
    return evaluate_each(env, actor, 1, episodes, seed, progress)[0]


def evaluate_each(
    env: TouchEnv, actor: Actor, blocks: int, episodes: int = 1000, seed: int = SEED, progress: Progress = silent
) -> list[Evaluation]:
    """Let an actor act, and return how good that was in each block of environments.

    Each environment's first episodes count, as many of each, so that short ones do not count more often than long ones.

    Args:
        env: The environments; they begin again.
        actor: Who acts.
        blocks: How many blocks they are: as many environments each, one block after the other.
        episodes: How many episodes count of each block.
        seed: What all that is random in the environments follows from.
        progress: Is told how many episodes have ended.

    Raises:
        TgdslError: If no episode is asked for.
    """
    if episodes < 1:
        raise TgdslError(f"found {episodes} episodes, expected at least 1")
    size = env.num_envs // blocks
    quota = torch.full((blocks, size), episodes // size, dtype=torch.int64, device=env.device)
    quota[:, : episodes % size] += 1
    quota = quota.flatten()
    done, sums = torch.zeros_like(quota), torch.zeros((6, env.num_envs), dtype=torch.float64, device=env.device)
    env.reset(seed)
    actor.begin(torch.ones_like(quota, dtype=torch.bool))
    meter = GaitMeter(env, blocks)
    progress(f"evaluating: 0 of {blocks * episodes:,} episodes")
    for moment in rollout(actor, env):
        info, is_asked = moment.step.info, done < quota
        meter.add(is_asked & ~info.ended)
        counts = info.ended & is_asked
        score = info.score.double()
        numbers = [score, score.square(), info.is_whole(env.max_steps), info.episode_return, info.episode_steps, info.faults]
        sums += torch.where(counts, torch.stack([value.double() for value in numbers]), 0.0)
        done += counts
        if (moment.index + 1) % CHECKED_EVERY == 0:
            left = int((quota - done).sum())
            progress(f"evaluating: {blocks * episodes - left:,} of {blocks * episodes:,} episodes")
            if not left:
                break
    each = sums.view(6, blocks, size).sum(dim=2).T.tolist()
    count = min(size, episodes)
    return [
        _evaluation(env, block_sums, episodes, count, seed, gait) for block_sums, gait in zip(each, meter.gaits(), strict=True)
    ]


def _evaluation(env: TouchEnv, sums: list[float], episodes: int, envs: int, seed: int, gait: Gait) -> Evaluation:
    """Return what episodes were, by sums over them, and how the object was moved in them."""
    total, squares, held, paid, steps, faults = sums
    mean = total / episodes
    share = held / episodes
    return Evaluation(
        task=env.spec.task,
        unit=env.task.score_unit,
        episodes=episodes,
        envs=envs,
        seed=seed,
        score=mean,
        score_interval=mean_interval(mean, squares, episodes),
        held=share,
        held_interval=share_interval(share, episodes),
        episode_return=paid / episodes,
        seconds=steps / episodes * env.control_step,
        faults=round(faults),
        gait=gait,
    )


def mean_interval(mean: float, squares: float, num: int) -> tuple[float, float]:
    """Return the 95 % interval of a mean, Student's."""
    if num < 2:
        return -math.inf, math.inf
    half = float(student_t.ppf(0.975, num - 1)) * math.sqrt(max(0.0, squares - num * mean**2) / (num - 1) / num)
    return mean - half, mean + half


def share_interval(share: float, num: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share of a number of trials."""
    z = Z95
    middle = (share + z * z / (2 * num)) / (1 + z * z / num)
    half = z / (1 + z * z / num) * math.sqrt(share * (1 - share) / num + z * z / (4 * num * num))
    return max(0.0, middle - half), min(1.0, middle + half)
