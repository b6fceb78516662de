"""Whether students' curves have flattened, and which of two students is worse: verdicts by numbers alone.

A curve has flattened if over its last third, by control steps, the score changes by less than 5 % of the range between joints
at rest and the teacher. With s(n) = a + b n fitted to that third by least squares, N its last control step and t the quantile
of Student's distribution with two degrees of freedom fewer than points,

    change   b N/3,   95 %: (b ± t σ_b) N/3          flat: both ends within ± 5 % of |s_teacher − s_rest|

so that a curve which is too noisy to tell is not flat, and one that gets worse is not either; nor is one whose scores are not
known at either end of that third, as when its last leg was shorter than an episode. Where joints at rest were not
measured, students that feel nothing stand in for them. Points are taken as independent, which those closer than an episode are
not. A point is the mean score of the control steps since the one before it.

One student is worse than another if its curve has flattened, the other's does not get worse by those 5 % (flat or still getting
better), and the 95 % intervals of their scores, over seeds and episodes, do not overlap. A worse one that still gets better
might catch up, and of one seed nothing is said, as its interval is of episodes alone.

Shapes: `point` points of a curve.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student_t

TAIL = 1.0 / 3.0
"""Part of a curve, by control steps, over which it must not change any more."""
FLAT = 0.05
"""Change over that part below which a curve is flat, relative to the range of scores."""
LEAST_POINTS = 5
"""Points of the last part below which nothing is said."""
LEAST_SPAN = 0.75
"""Share of the last part that the points must span."""
Array = np.ndarray


class Trend(NamedTuple):
    """By how much a score changes over the last third of its curve.

    Attributes:
        change: Fitted change.
        low: Lower bound of its 95 % interval.
        high: Upper bound.
    """

    change: float
    low: float
    high: float

    def is_flat(self, span: float) -> bool:
        """Return whether that is no change, beside the range of scores."""
        return max(abs(self.low), abs(self.high)) < FLAT * span

    def holds(self, span: float, is_less_better: bool) -> bool:
        """Return whether it does not get worse, by more than is no change; it may get better."""
        return (self.high if is_less_better else -self.low) < FLAT * span


def trend(samples: Float[Array, " point"], score: Float[Array, " point"]) -> Trend | None:
    """Return how a curve changes over its last third; None if there are too few points.

    Args:
        samples: Control steps by the end of each point, rising.
        score: The score there; nan where no episode has ended.
    """
    if not len(samples):
        return None
    end = float(samples[-1])
    kept = (samples > (1.0 - TAIL) * end * (1.0 + 1e-9)) & np.isfinite(score)  # a point is of the steps before it
    x, y = samples[kept] / end, score[kept]
    if len(x) < LEAST_POINTS or x[0] > 1.0 - TAIL * LEAST_SPAN or x[-1] < 1.0 - TAIL * (1.0 - LEAST_SPAN):
        return None
    centred = x - x.mean()
    squares = float(centred @ centred)
    slope = float(centred @ y) / squares
    residual = y - y.mean() - slope * centred
    freedom = len(x) - 2
    half = float(student_t.ppf(0.975, freedom)) * float(np.sqrt(residual @ residual / freedom / squares))
    return Trend(TAIL * slope, TAIL * (slope - half), TAIL * (slope + half))


def is_worse(one: tuple[float, float], other: tuple[float, float], is_less_better: bool) -> bool:
    """Return whether all of an interval of scores, (low, high), is worse than all of another."""
    return one[0] > other[1] if is_less_better else one[1] < other[0]
