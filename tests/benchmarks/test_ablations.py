"""`benchmarks/ablations.py`: which students have converged, which types are worse, and the pages written from kept results."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from felt_tasks import felt_task
from written_teachers import teacher

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import ablations

from tgdsl.errors import TgdslError
from tgdsl.rl.load import load_task
from tgdsl.rl.students.results import Row

SCORES = {"force": (9.8, 10.0), "depth": (8.0, 8.2), "bool": (5.0, 6.0), "none": (1.0, 1.02)}  # after N and 2 N iterations


def row(type_, score, half=0.3):
    placement, noise = ("", "") if type_ == "none" else ("hand", "clean")
    return Row(type_, placement, "med", noise, 2, score, score - half, score + half, 0.9, 100, 8000, 5.0)


def results_of(scores, is_less_better=False, **halves):
    rows = {n: [row(name, pair[i], halves.get(name, 0.3)) for name, pair in scores.items()] for i, n in enumerate((200, 400))}
    return ablations.Results("made_up", {"is_less_better": is_less_better}, rows, {})


def worse(results):
    return {row.type: results.worse_than(row, n) for n, row in results.final.values()}


def test_students_have_converged_if_twice_the_iterations_change_little():
    """5 % of 10.0 is 0.5."""
    for before, expected in ((9.51, True), (9.49, False), (10.49, True), (10.51, False)):
        results = results_of({"force": (before, 10.0)})
        assert results.has_converged(results.rows[400][0], 400) is expected
        assert results.has_converged(results.rows[200][0], 200) is None
    assert results_of({"none": (0.0, 0.0)}).has_converged(row("none", 0.0), 400) is False, "it may not have begun to learn"
    alone = ablations.Results("made_up", {"is_less_better": False}, {300: [row("force", 1.0)], 400: [row("force", 1.0)]}, {})
    assert alone.has_converged(alone.rows[400][0], 400) is None


def test_converged_types_with_separate_intervals_are_worse():
    """`bool` still rises: nothing is said of it."""
    assert worse(results_of(SCORES)) == {"force": [], "depth": ["force"], "bool": [], "none": ["force", "depth"]}
    assert worse(results_of(SCORES, depth=1.6)) == {"force": [], "depth": [], "bool": [], "none": ["force", "depth"]}
    assert worse(results_of(SCORES, is_less_better=True))["force"] == ["depth", "none"]


def test_other_places_are_not_compared():
    tips = Row("depth", "tips", "med", "clean", 2, 1.0, 0.9, 1.1, 0.9, 100, 8000, 5.0)
    rows = {n: [row("force", 10.0), tips] for n in (200, 400)}
    assert worse(ablations.Results("made_up", {"is_less_better": False}, rows, {})) == {"force": [], "depth": []}


def test_one_seed_and_other_resolutions_are_not_compared():
    """An interval of one seed knows nothing of seeds; students without touch are in each place of their resolution."""
    for changes in ({"seeds": 1}, {"resolution": "high"}):
        rows = {n: [row("force", 10.0), row("none", 1.0)._replace(**changes)] for n in (200, 400)}
        results = ablations.Results("made_up", {"is_less_better": False}, rows, {})
        assert worse(results) == {"force": [], "none": []}


def test_a_thinned_curve_has_means_without_episodes_that_began_before():
    """Episodes of 40 control steps, iterations of 10: the first four after each start are left out."""
    spec = {"episode": 4.0, "physics": {"timestep": 0.01, "substeps": 10}, "distill": {"steps": 10}}
    curve = [
        {"iteration": f"{i}", "samples": f"{20 * i}", "seconds": f"{i}", "Score/a": f"{i}", "Score/b": "", "Loss/a": "7"}
        for i in range(1, 241)
    ]
    starts = [{"spec": spec, "iteration": 0}, {"spec": spec, "iteration": 120}]
    rows = list(csv.DictReader(ablations._thinned(curve, starts).splitlines()))
    assert len(rows) == 60 and list(rows[0]) == ["samples", "seconds", "Score/a", "Score/b"]
    assert [line["samples"] for line in rows[:2]] == ["40", "80"] and rows[-1]["seconds"] == "240"
    assert [line["Score/a"] for line in (rows[0], rows[1], rows[29], rows[30], rows[31])] == ["", "6.5", "118.5", "", "126.5"]
    assert {line["Score/b"] for line in rows} == {""}


def test_scores_are_plotted_by_number_of_taxels():
    scores = {"gates_20": 8.0, "gates_5": 4.0, "even_20": 6.0, "places": 9.0}
    members = [
        ablations.Results(f"taxels__{name}", {"unit": "m"}, {300: [row("force", value)]}, {}) for name, value in scores.items()
    ]
    axes = ablations.plot_by_number(members).axes[0]
    points = {bars.get_label(): bars.lines[0].get_xydata().tolist() for bars in axes.containers}
    assert points == {"gates": [[5.0, 4.0], [20.0, 8.0]], "even": [[20.0, 6.0]]}
    assert [line.get_ydata()[0] for line in axes.lines if line.get_linestyle() == ":"] == [9.0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
def test_runs_of_tgdsl_distill_are_kept_and_compared(tmp_path, here, no_onnx):
    """Two lengths and two resolutions of a small task on the CPU."""
    task = felt_task(tmp_path)
    sensors = (tmp_path / "sensors.yaml").read_text()
    dense = "      high:\n        tip: {method: grid, rows: 3, columns: 3, direction: [0, 0, 1], radius: 8 mm}\nobjects:"
    (tmp_path / "sensors.yaml").write_text(sensors.replace("objects:", dense, 1))
    teacher(tmp_path / "teacher.pt", load_task(task), ["priv_proprio", "priv_obj_state"])
    small = "--set distill.steps=4 --set distill.networks.encoder.hidden=[8] --set distill.networks.hidden=[8]"
    options = (
        f"--teacher {tmp_path / 'teacher.pt'} --types depth,none --placements ends --seeds 2 --resolutions low,high {small}"
    )
    folder = tmp_path / "kept"
    for iterations in (2, 4):
        words = f"{options} --device cpu --envs 8 --iterations {iterations} --episodes 2 -o run{iterations}".split()
        code, _, error = here(tmp_path, "distill", "task.yaml", *words)
        assert code == 0, error
        ablations.keep(tmp_path / f"run{iterations}", "small", {"teacher": None, "rest": None}, folder)
    (results,) = ablations.all_results(folder)
    assert sorted(results.rows) == [2, 4] and results.curves[4]["high"]["samples"].tolist() == [8.0, 16.0, 24.0, 32.0]
    assert [(own.type, own.resolution) for own in results.rows[4]] == [
        ("depth", "low"), ("none", "low"), ("depth", "high"), ("none", "high")
    ]  # fmt: skip
    assert all(results.has_converged(own, 4) is not None for own in results.rows[4])
    assert results.run["teacher"] == "teacher.pt" and str(tmp_path) not in (folder / "small" / "run.json").read_text()

    pages = tmp_path / "docs" / "background" / "page.md", tmp_path / "docs" / "records" / "page.md"
    for page in pages:
        page.parent.mkdir(parents=True)
        page.write_text(f"before\n{ablations.BEGIN}\n{ablations.END}\nafter")
    files = ablations.write_pages(folder, pages)
    assert [file.read_bytes() for file in files] == [file.read_bytes() for file in ablations.write_pages(folder, pages)]
    assert "### small" in pages[1].read_text() and (tmp_path / "docs/images/ablation_small.png").is_file()

    record = json.loads((folder / "small" / "run.json").read_text())
    (folder / "small" / "run.json").write_text(json.dumps(record | {"teacher": "other.pt"}))
    with pytest.raises(TgdslError, match=r"teacher other\.pt, this run has teacher\.pt"):
        ablations.keep(tmp_path / "run4", "small", {"teacher": None, "rest": None}, folder)
    (folder / "small" / "run.json").write_text(json.dumps(record | {"overrides": {"distill.epochs": "1"}}))
    with pytest.raises(TgdslError, match=r"overrides .*epochs.*, this run has"):
        ablations.keep(tmp_path / "run4", "small", {"teacher": None, "rest": None}, folder)


def test_missing_results_are_named_and_nothing_is_written(tmp_path):
    with pytest.raises(TgdslError, match=r"distill\.json: No such file"):
        ablations.keep(tmp_path / "run", "small", {}, tmp_path / "kept")
    assert not (tmp_path / "kept").exists()
    (page := tmp_path / "page.md").write_text("no markers")
    with pytest.raises(TgdslError, match="expected the lines"):
        ablations.write_pages(tmp_path / "kept", (page, page))


def test_the_committed_pages_match_the_kept_results():
    runs = ablations.all_results()
    for page, text in zip(ablations.PAGES, (ablations.summary(runs), ablations.sections(runs)), strict=True):
        assert page.read_bytes() == ablations._between(page, text), "run: python benchmarks/ablations.py page"
    images = sorted(file.stem for file in (ablations.ROOT / "docs" / "images").glob("ablation_*.png"))
    assert images == sorted({f"ablation_{run.series}" for run in runs})
    assert all(np.isfinite(own.score) for run in runs for rows in run.rows.values() for own in rows)
