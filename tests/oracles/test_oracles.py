"""All comparisons hold, are as they were the last time, and are reported; each finding has its line."""

import numpy as np
import pytest
from held import assert_holds

from oracles import every, half_space
from oracles.results import Comparison, along, array, cases
from tgdsl.errors import TgdslError
from tgdsl.report.defects import DEFECTS
from tgdsl.sensors import KINDS


@pytest.fixture(scope="module")
def found():
    return every.run()


@pytest.mark.slow
def test_all_comparisons_hold(found):
    comparisons = [own for own, left_out in found.values() for own in own]
    assert len(comparisons) == sum(map(len, every.FIELDS.values()))
    for comparison in comparisons:
        assert_holds(comparison)
    assert len({comparison.name for comparison in comparisons}) == len(comparisons)


@pytest.mark.slow
def test_each_kind_is_compared_with_something(found):
    kinds = {kind for comparisons, _ in found.values() for own in comparisons for kind in own.kinds}
    assert kinds == {"noise", "geometry", *(kind.name for kind in KINDS)}


@pytest.mark.slow
def test_each_finding_for_the_oracles_has_its_line(found):
    numbers = {number for comparisons, _ in found.values() for own in comparisons for number in own.defects}
    assert {defect.number for defect in DEFECTS if defect.answered_in == "oracles"} <= numbers


def test_numbers_are_the_same_each_time():
    one, other = (half_space.point_load(0.7e-3, 0.3) for _ in range(2))
    np.testing.assert_array_equal(one.ours, other.ours)


def test_a_comparison_that_does_not_hold_is_told():
    found = Comparison("a", "b", "c", (), "d", "m", along("x", "m", [1, 2]), array([1, 0]), array([1.1, 0]), rtol=0.05)
    assert not found.holds
    assert found.error == pytest.approx(0.1)
    assert found.used == pytest.approx(2.0)
    entry = every.entry_of(found)
    assert not entry.holds and entry.record["of_allowed"] == pytest.approx(2.0)
    broken = Comparison("a", "b", "c", (), "d", "m", cases(["x"]), array(1), array(np.nan), atol=np.inf)
    assert not broken.holds and broken.error == np.inf


def test_what_cannot_be_computed_is_left_out_by_name():
    def lacking():
        raise TgdslError("pip install something")

    progress = []
    found = every.run({"field": (lacking,)}, lambda *told: progress.append(told))
    assert found == {"field": ([], [("lacking", "pip install something")])}
    assert progress == [("field", 0, 1), ("", 1, 1)]
