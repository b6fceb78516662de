"""The table of students: means and intervals over seeds and episodes, and the order of rows."""

import math

import pytest
from scipy.stats import ttest_1samp

from tgdsl.rl.playing.evaluation import Evaluation
from tgdsl.rl.playing.gait import Gait
from tgdsl.rl.students.keys import student_keys
from tgdsl.rl.students.results import Row, interval, rows_of, shown

GAIT = Gait(
    *[None] * 8, max_speed=0.0, max_spin=0.0, joint_speed=None, saturations={}, link_forces={}, joint_speeds={}, rated_speeds={}
)
"""The gait of a task without contacts."""


def evaluation(score: float, half: float, held: float = 1.0, episodes: int = 10) -> Evaluation:
    """Return the evaluation of one seed."""
    bounds = (score - half, score + half)
    return Evaluation("small", "RMS", episodes, 2, 1, score, bounds, held, (0.0, 1.0), 3.0, 2.0, 0, GAIT)


@pytest.mark.parametrize(("is_less_better", "expected"), [(False, ["a", "b"]), (True, ["b", "a"])])
def test_the_best_comes_first(is_less_better, expected):
    """For a score that is an error, the lowest comes first."""
    rows = [Row(name, "tips", "med", "clean", 1, score, 0.0, 1.0, 1.0, 2, 3, 4.0) for name, score in (("a", 0.9), ("b", 0.1))]
    lines = shown(rows, "RMS", is_less_better).splitlines()[2:]
    assert [line.split()[0] for line in lines] == expected


@pytest.mark.parametrize("scores", [(0.1, 0.5, 0.9), (0.2, 0.3)])
def test_the_interval_of_differing_seeds_is_students_t(scores):
    """The episodes alone would give ±0.01 at most."""
    expected = ttest_1samp(scores, 0.0).confidence_interval(0.95)
    assert interval([evaluation(score, 0.01) for score in scores]) == pytest.approx(tuple(expected))
    assert expected.high - expected.low > 0.5


def test_the_interval_of_similar_seeds_is_that_of_all_episodes():
    """Half-intervals of 0.3 and 0.4 give 0.25 for the mean; the two means alone would give ±0.06."""
    low, high = ttest_1samp((0.5, 0.51), 0.0).confidence_interval(0.95)
    assert high - low < 0.2
    assert interval([evaluation(0.5, 0.3), evaluation(0.51, 0.4)]) == pytest.approx((0.255, 0.755))


def test_the_interval_of_one_seed_is_that_of_its_episodes():
    """A single episode has an infinite interval."""
    assert interval([evaluation(0.5, 0.2)]) == pytest.approx((0.3, 0.7))
    assert interval([evaluation(0.5, math.inf)]) == (-math.inf, math.inf)


def test_rows_are_means_over_seeds():
    """Intervals end at the range of scores, 0.08 to 0.7."""
    keys = student_keys(["depth", "none"], ["tips"], ["clean"], 2)
    evaluations = [
        evaluation(0.5, 0.3, 0.25),
        evaluation(0.51, 0.4, 0.5),
        evaluation(0.1, 0.03, 1.0),
        evaluation(0.1, 0.04, 0.4, 20),
    ]
    depth, none = rows_of(keys, evaluations, (0.08, 0.7), "med", 1000, 2.5)
    assert depth[:5] == ("depth", "tips", "med", "clean", 2) and none[:5] == ("none", "", "med", "", 2)
    assert depth[5:9] == pytest.approx((0.505, 0.255, 0.7, 0.375))
    assert none[5:9] == pytest.approx((0.1, 0.08, 0.125, 0.7))
    assert depth[9:] == (20, 1000, 2.5) and none[9:] == (30, 1000, 2.5)


@pytest.mark.parametrize("score", [math.nan, math.inf])
def test_a_score_that_is_not_finite_affects_only_its_row(score):
    """It has no interval, is printed, and raises nothing."""
    keys = student_keys(["bool", "depth"], ["tips"], ["clean"], 2)
    evaluations = [evaluation(score if key.kind[0] == "bool" and key.seed == 0 else 0.5, 0.1) for key in keys]
    rows = {row.type: row for row in rows_of(keys, evaluations, (-math.inf, math.inf), "med", 3, 4.0)}
    assert not math.isfinite(rows["bool"].score) and not math.isfinite(rows["bool"].low)
    assert rows["depth"].score == 0.5 and rows["depth"].low == pytest.approx(0.5 - 0.1 / math.sqrt(2))
    line = next(line for line in shown(list(rows.values()), "RMS").splitlines() if line.startswith("bool"))
    assert "–" in line
