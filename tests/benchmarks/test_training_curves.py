"""`benchmarks/training_curves.py`: curves of runs, thinned."""

import csv
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import training_curves

from tgdsl.errors import TgdslError


def test_a_curve_is_thinned_to_means_over_equal_numbers_of_iterations(tmp_path, monkeypatch):
    """Values of episodes are weighted by episodes; counters have the last iteration's value."""
    monkeypatch.setattr(training_curves, "KEPT", tmp_path / "kept")
    num = 2 * training_curves.ROWS
    with (tmp_path / "curve.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["iteration", "samples", "seconds", "episodes", "Episode/score", "Reward/spin", "Loss/rnd", "rollout", "update"]
        )
        for i in range(num):
            score = "nan" if i < 2 else i
            writer.writerow([i + 1, 100 * (i + 1), 0.5 * (i + 1), 0 if i < 2 else 1 + 2 * (i % 2), score, i, 3 * i, i, 2 * i])
    file_kept = training_curves.keep(tmp_path, "task/run")
    assert file_kept == tmp_path / "kept" / "task" / "run.csv"
    with file_kept.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == training_curves.ROWS
    assert rows[0] == {
        "iteration": "2", "samples": "200", "seconds": "1", "Episode/score": "", "Reward/spin": "",
        "Loss/rnd": "1.5", "rollout": "0.5", "update": "1",
    }  # fmt: skip
    assert float(rows[4]["Episode/score"]) == (8 + 3 * 9) / 4 and rows[4]["Reward/spin"] == "8.75"
    assert rows[4]["rollout"] == "8.5"


def test_a_missing_or_invalid_curve_leaves_the_kept_one(tmp_path, monkeypatch):
    monkeypatch.setattr(training_curves, "KEPT", tmp_path)
    (tmp_path / "run.csv").write_text("kept")
    for text, message in ((None, r"curve\.csv"), ("iteration,seconds\n1,2\n", "no column episodes")):
        if text is not None:
            (tmp_path / "curve.csv").write_text(text)
        with pytest.raises((OSError, TgdslError), match=message):
            training_curves.keep(tmp_path, "run")
    assert (tmp_path / "run.csv").read_text() == "kept"
