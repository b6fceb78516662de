"""The table of students."""

import pytest

from tgdsl.rl.students.results import Row, shown


@pytest.mark.parametrize(("is_less_better", "expected"), [(False, ["a", "b"]), (True, ["b", "a"])])
def test_the_best_comes_first(is_less_better, expected):
    """Of a score that is an error, the least."""
    rows = [Row(name, "tips", "med", "clean", 1, score, 0.0, 1.0, 1.0, 2, 3, 4.0) for name, score in (("a", 0.9), ("b", 0.1))]
    lines = shown(rows, "RMS", is_less_better).splitlines()[2:]
    assert [line.split()[0] for line in lines] == expected
