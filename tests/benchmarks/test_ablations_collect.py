"""`benchmarks/ablations.py collect`: thinned curves, and the legs of a run."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from made_up_runs import ITERATIONS, LEGS, PART, ROWS, STEPS, made_up_run

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from ablations_collect import collect, thinned
from ablations_kept import Taught, read_ablation
from ablations_page import tables
from ablations_verdicts import trend

from tgdsl.rl.students.results import Row

STEPS_OF_EACH = ITERATIONS * STEPS * ROWS
SCORES = {"force": lambda x: 10.0, "bool": lambda x: 8.0, "depth": lambda x: 9.9, "proximity": lambda x: 4.0 * x}
SCORES |= {"none": lambda x: 1.0}


def test_scores_are_not_weighted_by_episodes_of_other_students(tmp_path):
    """At first, one student ends 99 of 100 episodes, the other one; then the other ends nine."""
    names = ["often-x-c-s0", "seldom-x-c-s0"]
    header = ["iteration", "samples", "seconds", "episodes", *(start + name for start in ("Score/", "Loss/") for name in names)]
    rows = (("1", "20", "1", "100", "5", "0", "1", "1"), ("2", "40", "2", "10", "5", "1", "1", "1"))
    curve = [dict(zip(header, row, strict=True)) for row in rows]
    taught = [Taught(Row("x", "x", "m", "c", 1, 1.0, 0.0, 1.0, 1.0, 10, 20, 1.0), (name,)) for name in names]
    text = thinned(curve, taught, 1, tmp_path / "curve.csv", np.zeros(2, dtype=bool))
    assert text.splitlines()[1] == "20,2,5,0.5,1,1"


@pytest.mark.parametrize("rows", [60, 15])
def test_a_thinned_curve_changes_as_much_as_the_whole_one(tmp_path, rows):
    """A straight line rises by a third over the last third, however many points remain."""
    run = made_up_run(tmp_path / "run", SCORES, seeds=1)
    collect(run, "thin", into=tmp_path / "kept", rows=rows)
    curves = read_ablation(tmp_path / "kept" / "thin").curves["med"]
    assert curves.samples[-1] == STEPS_OF_EACH
    assert trend(curves.samples, curves.score["proximity-hand-clean-s0"]).change == pytest.approx(4.0 / 3.0, rel=5e-3)


def set_starts(run, *changes):
    """Replace the starts of a run by copies of the first with changed values and document."""
    file = run / "med" / "run.json"
    first = json.loads(file.read_text())["starts"][0]
    starts = [first | values | {"spec": first["spec"] | spec} for values, spec in changes]
    file.write_text(json.dumps({"starts": starts}))


def test_starts_without_remaining_iterations_are_no_legs(tmp_path):
    """One was killed after 250 iterations with its last checkpoint at 240, another during its evaluation."""
    run = made_up_run(tmp_path / "run", SCORES)
    starts = ((0, "a", (1e-3, 1e-4)), (240, "b", (5.0, None)), (240, "c", (1e-5, None)), (300, "d", (5.0, None)))
    documents = [{"learning_rate": first, "final_learning_rate": last, "steps": STEPS} for *_, (first, last) in starts]
    set_starts(
        run,
        *(
            ({"iteration": first, "device": device}, {"distill": document_part})
            for (first, device, _), document_part in zip(starts, documents, strict=True)
        ),
    )
    collect(run, "legs", into=tmp_path / "kept")
    provenance = read_ablation(tmp_path / "kept" / "legs").made["simulations"]["med"]
    assert provenance["begun"] == list(LEGS) and provenance["devices"] == ["a", "c"]
    line = "on a, c: 100 environments, 25.0 min in 2 legs, at rates of 0.001 falling to 0.0001 and then 1e-05. "
    assert line in tables(tmp_path / "kept")


def test_partial_episodes_depend_on_their_leg(tmp_path):
    """Episodes of the second leg are a quarter as long: five of its iterations are left out, and 17 of the first's."""
    run = made_up_run(tmp_path / "run", SCORES)
    set_starts(run, ({"iteration": 0}, {}), ({"iteration": 240}, {"episode": 2.5}))
    curve = run / "med" / "curve.csv"
    with curve.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows[245 : 240 + PART]:
        row |= {name: "7" for name in row if name.startswith("Score/")}
    with curve.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    collect(run, "legs", into=tmp_path / "kept")
    score = read_ablation(tmp_path / "kept" / "legs").curves["med"].score["bool-hand-clean-s0"]
    assert np.flatnonzero(np.isnan(score)).tolist() == [0, 1, 2, 48]
    assert score[3] == 8.0 and score[49:51].tolist() == [7.0, 7.0]
