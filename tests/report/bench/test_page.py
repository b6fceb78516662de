"""Tables, rows and plots of a bench, from points written by hand."""

import re
from dataclasses import replace

import pytest

from tgdsl.module.accuracy.errors import Errors, Interval
from tgdsl.report.bench.page import bench_text, cells_of, plot
from tgdsl.report.bench.results import Measured, Report, Subject, rows_of
from tgdsl.tuning.trials import Cost

ERRORS = Errors(Interval(1e-3, 9e-4, 2e-3), Interval(0.5, 0.4, 0.5), 0.04, True)
POINT = Measured(
    *("own", "float32", True, ERRORS, ERRORS._replace(rms=Interval(3e-3, 2e-3, 4e-3))),
    {4: Interval(2e-3, 1e-3, 3e-3)},
    Cost(None, 3 * 2**20, 1536, 12),
    is_on_front=True,
)


def subject_of(*points: Measured) -> Subject:
    return Subject("depth", "contact_depth", "raycast, float64", "", {"depth": "0.01 m"}, points, ())


def test_cells_have_milliseconds_errors_and_bytes():
    slower = replace(POINT, label="b", is_own=False, is_on_front=False, times={4: Interval(5e-3, 5e-3, 5e-3)})
    header, own, other = cells_of(subject_of(POINT, slower))
    assert header[6:8] == ("ms, 4 envs", "× now")
    assert own == (
        *("own", "float32", "1.0e-03 [9.0e-04, 2.0e-03]", "4.0e-02", "5.0e-01", "3.0e-03", "2 [1, 3]", "1.00"),
        *("–", "3.0 MiB", "1.5 KiB", "12 B"),
    )
    assert other[6:8] == ("5 [5, 5]", "2.50")
    lines = bench_text(Report("pad.yaml", "machine", "states", (subject_of(POINT, slower),))).split("\n")
    assert next(line for line in lines if line.startswith("own")).endswith("12 B    now ●")
    assert next(line for line in lines if line.startswith("b ")).endswith("12 B")


@pytest.mark.parametrize("half", ["chosen", "verified"])
def test_readings_that_are_not_finite_are_named(half):
    broken = replace(POINT, **{half: ERRORS._replace(is_finite=False)})
    assert list(cells_of(subject_of(broken)))[1][4] == "not finite"


def test_a_row_of_the_files_has_every_number():
    (row,) = rows_of(Report("pad.yaml", "machine", "states", (subject_of(POINT),)))
    assert (row["rms"], row["rms_low"], row["rms_high"], row["verified_rms"]) == (1e-3, 9e-4, 2e-3, 3e-3)
    assert (row["seconds_4_envs"], row["seconds_4_envs_high"], row["times_own"]) == (2e-3, 3e-3, 1.0)
    assert (row["constants_bytes"], row["state_bytes"], row["output_bytes"]) == (3 * 2**20, 1536, 12)


def test_labels_of_points_in_one_place_do_not_overlap():
    """The compiler's choice has its label to the right of its point; the next label is to the left, the third lower."""
    drawn = plot(subject_of(*(replace(POINT, label=name, is_own=name == "own") for name in ("first", "second", "own"))), "")
    texts = re.findall(r'<text style="[^"]*text-anchor: (\w+)[^"]*" x="[^"]*" y="([^"]*)"[^>]*>(\w+), float32', drawn)
    places = {name: (anchor, float(height)) for anchor, height, name in texts}
    assert places["own"] == ("start", places["first"][1]) and places["first"][0] == "end"
    assert places["second"][1] > places["own"][1]
