"""`benchmarks/ablations_series.py`: made-up runs that differ in an override, side by side."""

import json
import sys
from pathlib import Path

import pytest
from made_up_runs import made_up_run

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from ablations_collect import collect
from ablations_kept import KeptError
from ablations_page import BEGIN, END, tables, write_page

SCORES = {"cnn": lambda x: 8.0, "lstm": lambda x: 10.0, "mlp": lambda x: 4.0 * x, "rising": lambda x: 9.0 + 3.0 * x}
"""Two flat curves, and two that still rise: one below both, one above both."""


@pytest.fixture
def kept(tmp_path):
    """Collect a run of `force` per curve, as nets__NAME; return the folder."""
    for who, score in (("teacher", 12.0), ("rest", 0.0)):
        content = {"task": "in_palm_rotate", "score": score, "score_interval": [score, score], "held": 1.0}
        (tmp_path / f"{who}.json").write_text(json.dumps(content))
    for name, score in SCORES.items():
        overrides = {"distill.epochs": "12", "distill.networks.touch_kind": name}
        run = made_up_run(tmp_path / name, {"force": score}, overrides=overrides)
        collect(run, f"nets__{name}", tmp_path / "teacher.json", tmp_path / "rest.json", into=tmp_path / "kept")
    return tmp_path / "kept"


def test_runs_of_a_series_have_one_table(kept):
    text = tables(kept)
    assert text.count("###") == 1 and "### nets\n" in text and "Overrides: `distill.epochs=12`. Flat: within ±0.6" in text
    rows = {line.split("`")[1]: line for line in text.splitlines() if line.startswith("| `")}
    assert list(rows) == list(SCORES) and text.count("| *teacher* |") == 1
    assert rows["cnn"].startswith("| `cnn`, `distill.networks.touch_kind=cnn` | `force` | hand, med, clean | 2 | 8.005 |")
    verdicts = {name: [part.strip() for part in row.split("|")[-3:-1]] for name, row in rows.items()}
    assert verdicts == {
        "cnn": ["yes", "`lstm`, `rising`; open: `mlp`"],
        "lstm": ["yes", "`rising`; open: `mlp`"],
        "mlp": ["no", "open"],
        "rising": ["no", "open"],
    }
    assert all(len(line.split("|")) == len(rows["cnn"].split("|")) for line in text.splitlines() if line.startswith("| "))


def test_runs_of_other_lengths_are_not_compared(kept):
    """A curve that is flat after half as many control steps may still rise."""
    folder = kept / "nets__cnn"
    steps = 300 * 24 * 10
    (folder / "table.csv").write_text((folder / "table.csv").read_text().replace(f",{steps},", f",{steps // 2},"))
    rows = {line.split("`")[1]: line for line in tables(kept).splitlines() if line.startswith("| `")}
    assert rows["cnn"].endswith("| yes | open: `lstm`, `mlp`, `rising` |")
    assert rows["lstm"].endswith("| yes | `rising`; open: `cnn`, `mlp` |")


def test_a_name_that_sorts_in_between_does_not_split_a_series(kept, tmp_path):
    for name in ("nets2", "nets__0"):
        collect(made_up_run(tmp_path / name, {"force": lambda x: 7.0}), name, into=kept)
    assert [line for line in tables(kept).splitlines() if line.startswith("#")] == ["### nets2", "### nets"]


def test_a_series_has_one_plot(kept, tmp_path):
    page = tmp_path / "background" / "page.md"
    page.parent.mkdir()
    page.write_text(f"{BEGIN}\n{END}\n")
    assert write_page(kept, page) == [page, tmp_path / "images" / "ablation_nets.png"]


def test_other_documents_and_a_run_of_the_series_name_are_refused(kept, tmp_path):
    other = made_up_run(tmp_path / "other", {"force": lambda x: 1.0}, task="grip_force")
    collect(other, "nets__other", into=kept)
    with pytest.raises(KeptError, match=r'nets__other: document "examples/tasks/grip_force\.yaml", expected'):
        tables(kept)
    collect(other, "nets", into=kept)
    with pytest.raises(KeptError, match="nets: a series of runs has that name too: nets__cnn"):
        tables(kept)
