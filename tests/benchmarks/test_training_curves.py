"""`benchmarks/training_curves.py`: what is kept of the curve of a run."""

import csv
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import training_curves
from ablations_kept import KeptError


def test_a_curve_is_thinned_to_means_over_equal_numbers_of_iterations(tmp_path, monkeypatch):
    """Of episodes' values those over episodes, where there were any; what counts on is that of the last iteration."""
    monkeypatch.setattr(training_curves, "KEPT", tmp_path / "kept")
    num = 2 * training_curves.ROWS
    with (tmp_path / "curve.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["iteration", "samples", "seconds", "episodes", "Episode/score", "Reward/spin", "rollout"])
        for i in range(num):
            score = "nan" if i < 2 else i
            writer.writerow([i + 1, 100 * (i + 1), 0.5 * (i + 1), 0 if i < 2 else 1 + 2 * (i % 2), score, i, ""])
    found = training_curves.keep(tmp_path, "task/run")
    assert found == tmp_path / "kept" / "task" / "run.csv"
    with found.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == training_curves.ROWS
    assert rows[0] == {
        "iteration": "2", "samples": "200", "seconds": "1", "Episode/score": "", "Reward/spin": "0.5", "rollout": "",
    }  # fmt: skip
    assert float(rows[4]["Episode/score"]) == (8 + 3 * 9) / 4 and float(rows[4]["Reward/spin"]) == 8.5


def test_no_curve(tmp_path):
    with pytest.raises(KeptError, match=r"curve\.csv: cannot read this file"):
        training_curves.keep(tmp_path, "task/run")
