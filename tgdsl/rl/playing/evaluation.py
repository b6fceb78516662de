"""Evaluation of a policy: episodes without exploration, the same for all policies; and requirements.

Shapes: `env` environments.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from operator import ge, gt, le, lt
from typing import Any

import torch
from scipy.stats import t as student_t

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.fields.units import parse
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.gait import METRICS, SHARE, UNITS, Gait, GaitMeter
from tgdsl.rl.playing.rollout import Actor, rollout
from tgdsl.rl.task import Task

SEED = 1_000_003  # seed of the episodes, independent of a policy's training
Z95 = 1.959963984540054
CHECK_INTERVAL = 40  # control steps between the host's checks whether all episodes have ended
DIMENSIONS = {"score": "number", "held": SHARE} | {name: dimension for name, (_, dimension) in METRICS.items()}
"""Quantities that requirements may name: fields of `Evaluation` and `Gait`, and their dimensions."""
COMPARISONS: dict[str, Callable[[float, float], bool]] = {"<=": le, ">=": ge, "<": lt, ">": gt}
_PART = re.compile(r"\s*(?P<name>[^\s<>=]+)\s*(?P<sign><=|>=|<|>)\s*(?P<value>[^<>=]+?)\s*\Z")


@dataclass(frozen=True)
class Evaluation:
    """Means over some episodes of a policy, with 95 % intervals: Wilson's of shares, Student's of others.

    `held` is the share of episodes of full length, without a drop or another end; `seconds` is their duration [s], `faults` the
    number of episodes that a fault ended.
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
        """Return values for JSON: None instead of numbers that are not finite, such as the interval of one episode."""
        return _finite(asdict(self))

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
    env: TouchEnv, actor: Actor, blocks: int, episodes: int, seed: int = SEED, progress: Progress = silent
) -> list[Evaluation]:
    """Let an actor act, and return how good that was in each block of environments.

    Each environment's first episodes count, as many of each, so that short ones do not count more often than long ones. Blocks
    are of as many environments each, one block after the other; `episodes` count of each.
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
        if (moment.index + 1) % CHECK_INTERVAL == 0:
            left = int((quota - done).sum())
            progress(f"evaluating: {blocks * episodes - left:,} of {blocks * episodes:,} episodes")
            if not left:
                break
    block_sums = sums.view(6, blocks, size).sum(dim=2).T.tolist()
    return [
        Evaluation(
            task=env.spec.task,
            unit=env.task.score_unit,
            episodes=episodes,
            envs=min(size, episodes),
            seed=seed,
            score=scores / episodes,
            score_interval=score_interval(type(env.task), scores / episodes, squares, episodes),
            held=whole / episodes,
            held_interval=share_interval(whole / episodes, episodes),
            episode_return=returns / episodes,
            seconds=steps / episodes * env.control_step,
            faults=round(faults),
            gait=gait,
        )
        for (scores, squares, whole, returns, steps, faults), gait in zip(block_sums, meter.gaits(), strict=True)
    ]


@dataclass(frozen=True)
class Requirement:
    """A requirement such as `coasting<0.1`: `name` is a key of `DIMENSIONS`, the bound in SI units."""

    text: str
    name: str
    sign: str
    bound: float

    def failure(self, evaluation: Evaluation) -> str | None:
        """Return why an evaluation does not meet this; None if it does."""
        value = getattr(evaluation if self.name in ("score", "held") else evaluation.gait, self.name)
        if value is None:
            return f"not met: {self.text}: it was not measured: the task has none, or nothing was touched"
        unit = UNITS.get(DIMENSIONS[self.name], "")
        return None if COMPARISONS[self.sign](value, self.bound) else f"not met: {self.text}: found {value:.4g} {unit}".rstrip()


def parse_requirements(text: str) -> list[Requirement]:
    """Return the requirements of a text, separated by commas: `coasting<0.1, penetration<2 mm, held>=95 %`."""
    requirements = []
    for part in map(str.strip, text.split(",")):
        match = _PART.match(part)
        if not match:
            expected = 'expected NAME<VALUE, such as "coasting<0.1, penetration<2 mm", with <, <=, > or >='
            raise TgdslError(f'--require "{part}": {expected}')
        name, value = match["name"], match["value"]
        if name not in DIMENSIONS:
            raise TgdslError(f'--require "{part}": nothing is called "{name}"; {did_you_mean(name, DIMENSIONS, "names")}')
        dimension = DIMENSIONS[name]
        is_percent = dimension == SHARE and value.endswith("%")
        try:
            bound = parse(value.removesuffix("%") if is_percent else value, "number" if dimension == SHARE else dimension)
        except ValueError as error:
            raise TgdslError(f'--require "{part}": {error}') from error
        requirements.append(Requirement(part, name, match["sign"], 0.01 * bound if is_percent else bound))
    return requirements


def score_interval(task: type[Task[Any]], mean: float, squares: float, num: int) -> tuple[float, float]:
    """Return the 95 % interval of a task's mean score, within the range of its scores.

    It is Wilson's if all scores are 0 or 1, else Student's.
    """
    least, largest = task.score_range
    if num > 1 and (least, largest) == (0, 1) and math.isclose(squares, num * mean, abs_tol=1e-9):
        return share_interval(mean, num)
    low, high = mean_interval(mean, squares, num)
    return (max(low, least), min(high, largest)) if num > 1 else (low, high)


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
