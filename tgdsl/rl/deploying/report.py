"""What came of a policy that acted on a source: how it scored, where a scene can say, and how fast it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tgdsl.rl.playing.evaluation import mean_interval, share_interval


class Quantiles(NamedTuple):
    """Median and 99th percentile [ms]."""

    median: float
    p99: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Quantiles:
        """Return those of times [s]."""
        low, high = np.quantile(np.array(seconds), (0.5, 0.99))
        return cls(1e3 * float(low), 1e3 * float(high))

    def __str__(self) -> str:
        return f"{self.median:.2f} ms (99 %: {self.p99:.2f} ms)"


class Scores(NamedTuple):
    """Scores of the episodes that a scene has judged; intervals are of 95 %.

    Attributes:
        each: Score of each episode, in their order.
        mean: Their mean.
        interval: Its interval.
        held: Share of the episodes that lasted as long as they might: without a drop, or whatever else ends them before.
        held_interval: Its interval, Wilson's.
    """

    each: tuple[float, ...]
    mean: float
    interval: tuple[float, float]
    held: float
    held_interval: tuple[float, float]

    @classmethod
    def of(cls, scores: Sequence[float], are_held: Sequence[bool]) -> Scores:
        """Return what episodes were."""
        num = len(scores)
        mean, share = math.fsum(scores) / num, sum(are_held) / num
        low, high = mean_interval(mean, math.fsum(score**2 for score in scores), num)
        return cls(tuple(scores), mean, (low, high), share, share_interval(share, num))


@dataclass(frozen=True)
class Report:
    """What came of a policy that acted.

    Attributes:
        task: The task.
        policy: The policy's file.
        source: On what it acted, as `tgdsl.connect` takes it.
        unit: Unit of the score.
        episodes: How many there were.
        steps: Control steps of all of them.
        scores: Their scores; None where no scene says what happened, as on a real hand and of a log, or no episode was whole.
        has_scene: Whether a scene says what happened.
        age: How old the sample was that an action was chosen from; None where nothing runs in real time.
        inference: From a sample to set-points: what it took to observe and to choose.
        latency: Age and inference, of each step together; None where there is no age.
        control_rate: Control steps per second that the task asks for [Hz].
        rate: Achieved rate [Hz].
        late_steps: Control steps that began after they should have ended.
        moves: Whether set-points went to joints.
    """

    task: str
    policy: str
    source: str
    unit: str
    episodes: int
    steps: int
    scores: Scores | None
    has_scene: bool
    age: Quantiles | None
    inference: Quantiles
    latency: Quantiles | None
    control_rate: float
    rate: float
    late_steps: int
    moves: bool

    def __str__(self) -> str:
        moved = [] if self.moves else [f"{self.source} was not moved: actions were computed, and went nowhere"]
        return "\n".join([self._scored(), self._timed(), *moved])

    def _scored(self) -> str:
        count = f"{self.episodes:,} episode{'' if self.episodes == 1 else 's'}, {self.steps:,} control steps"
        if self.scores is None:
            why = "no episode has ended" if self.has_scene else f"{self.source} has no scene that knows what happened"
            return f"no score: {why}; {count}"
        scores = self.scores
        between = f" (95 %: {scores.interval[0]:.4f} to {scores.interval[1]:.4f})" if len(scores.each) > 1 else ""
        return f"score {scores.mean:.4f} {self.unit}{between}, {scores.held:.1%} of full length; {count}"

    def _timed(self) -> str:
        rate = f"{self.rate:.1f} of {self.control_rate:.1f} control steps per second"
        if self.latency is None:
            return f"inference {self.inference}; {rate}, not in real time"
        parts = f"latency {self.latency}: sample age {self.age}, inference {self.inference}"
        return f"{parts}; {rate}, {self.late_steps} late"
