"""`benchmarks/ablations.py`: collected runs, and the page that is written from them."""

import csv
import json
import math
import shutil
import sys
from pathlib import Path

import pytest
from felt_tasks import felt_task
from made_up_runs import ITERATIONS, LEGS, PART, ROWS, STEPS, made_up_run
from written_teachers import teacher

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import ablations
from ablations_collect import collect
from ablations_kept import KEPT, LIMIT, KeptError, kept_ablations, read_ablation
from ablations_page import (
    BEGIN,
    END,
    NOTHING,
    PAGE,
    RECORD,
    SUMMARY,
    judged,
    paper_samples,
    summary,
    tables,
    worse_than,
    write_page,
    written,
)
from ablations_plots import plot
from ablations_series import series_of

from tgdsl.rl.load import load_task

STEPS_OF_EACH = ITERATIONS * STEPS * ROWS
LEVEL = {"force": lambda x: 10.0, "bool": lambda x: 8.0, "depth": lambda x: 9.9, "proximity": lambda x: 4.0 * x}
"""Three flat curves, the last one close to the first, and one that still rises."""
BLIND = LEVEL | {"none": lambda x: 1.0}


def evaluation(file, score, task="in_palm_rotate"):
    file.write_text(json.dumps({"task": task, "score": score, "score_interval": [score - 0.2, score + 0.2], "held": 1.0}))
    return file


@pytest.fixture
def kept(tmp_path):
    """Return a function that collects a made-up run and returns the folder of all of them."""

    def keep(name="made_up", scores=BLIND, **options):
        run = made_up_run(tmp_path / f"run_{name}", scores, **options)
        scores_of = {"teacher": 12.0, "rest": 0.0} if options.get("task") != "grip_force" else {"teacher": 0.0, "rest": 10.0}
        files = [
            evaluation(tmp_path / f"{who}.json", score, options.get("task", "in_palm_rotate"))
            for who, score in scores_of.items()
        ]
        collect(run, name, *files, into=tmp_path / "kept")
        return tmp_path / "kept"

    return keep


def rows_of(file):
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def test_a_curve_is_thinned_to_means_over_equal_spans(kept):
    """300 iterations become 60 rows of five; rows of a straight line are means over the iterations that count.

    Iterations in which no episode ended do not count, nor do the first 17 of each leg, the length of an episode.
    """
    rows = rows_of(kept() / "made_up" / "med" / "curve.csv")
    assert [row["samples"] for row in rows] == [f"{5 * STEPS * ROWS * i}" for i in range(1, 61)]
    assert rows[0]["seconds"] == "25" and rows[-1]["seconds"] == f"{5 * ITERATIONS}"
    counted = {i for i in range(1, ITERATIONS + 1) if i % 3 and not any(first < i <= first + PART for first in LEGS)}
    iterations = [[i for i in range(5 * k + 1, 5 * k + 6) if i in counted] for k in range(60)]
    expected = [4.0 * sum(span) / len(span) / ITERATIONS + 0.01 if span else math.nan for span in iterations]
    scores = [float(row["Score/proximity-hand-clean-s1"] or "nan") for row in rows]
    assert scores == pytest.approx(expected, rel=1e-3, nan_ok=True) and sum(map(math.isnan, scores)) == 6
    assert float(rows[0]["Loss/none-s0"]) == pytest.approx(sum(1 / i for i in range(1, 6)) / 5, rel=1e-3)
    means = [value for row in rows for name, value in row.items() if "/" in name and "e" not in value]
    assert all(len(value.replace(".", "").lstrip("0")) <= 4 for value in means)


def test_flat_curves_are_worse_than_those_above_that_do_not_fall(kept):
    verdicts = judged(read_ablation(kept() / "made_up"))
    assert {verdict.taught.row.type: verdict.is_flat for verdict in verdicts} == dict.fromkeys(BLIND, True) | {
        "proximity": False
    }
    worse = {
        verdict.taught.row.type: {other.taught.row.type for other in worse_than(verdict, verdicts, False)}
        for verdict in verdicts
    }
    assert worse == {
        "force": set(),
        "bool": {"force", "depth"},
        "depth": set(),
        "proximity": set(),
        "none": {"force", "depth", "bool", "proximity"},  # which still rises
    }


def test_with_one_seed_nothing_is_called_worse(kept):
    """Its interval does not include differences between seeds."""
    verdicts = judged(read_ablation(kept(seeds=1) / "made_up"))
    assert sum(bool(verdict.is_flat) for verdict in verdicts) == 4 and not any(
        worse_than(verdict, verdicts, False) for verdict in verdicts
    )
    assert "0 of 10 pairs of types" in tables(kept("again", seeds=1))


def test_with_a_teacher_no_better_than_rest_no_curve_is_flat(kept, tmp_path):
    """The tolerance of flatness is then zero."""
    folder = kept()
    evaluation(folder / "made_up" / "rest.json", 12.0)
    assert "Flat: within ±0 over the last third" in tables(folder) and "0 of 5 curves are flat." in tables(folder)


def test_page_and_plots_are_written_into_new_folders(kept, tmp_path):
    page = tmp_path / "docs" / "background" / "page.md"
    page.parent.mkdir(parents=True)
    page.write_text(f"before\n{BEGIN}\n{END}\nafter\n")
    files = write_page(kept(), page)
    assert files == [page, page.parents[1] / "images" / "ablation_made_up.png"] and all(file.is_file() for file in files)
    assert "### made_up" in page.read_text()


def test_evaluations_of_another_teacher_or_task_are_refused(kept, tmp_path):
    folder = kept()
    other = made_up_run(tmp_path / "other", BLIND)
    options = json.loads((other / "distill.json").read_text())
    (other / "distill.json").write_text(json.dumps(options | {"teacher": "policies/y.pt"}))
    with pytest.raises(KeptError, match=r"is of policies/x.pt, and this run was taught by policies/y.pt: give --teacher"):
        collect(other, "made_up", into=folder)
    collect(other, "made_up", evaluation(tmp_path / "y.json", 11.0), into=folder)
    assert read_ablation(folder / "made_up").teacher["score"] == 11.0
    gripped = made_up_run(tmp_path / "gripped", BLIND, task="grip_force")
    with pytest.raises(KeptError, match='an evaluation in "in_palm_rotate", expected one in "grip_force"'):
        collect(gripped, "made_up", into=folder)


def test_names_of_resolutions_may_have_a_dot(tmp_path):
    run = made_up_run(tmp_path / "run", LEVEL, places=[("hand", "1.5mm", "clean")])
    for _ in range(2):
        collect(run, "dots", into=tmp_path / "kept")
    assert read_ablation(tmp_path / "kept" / "dots").taught[0].row.resolution == "1.5mm"


def test_smaller_errors_are_better(kept):
    text = tables(kept(task="grip_force"))
    rows = {line.split("`")[1]: line for line in text.splitlines() if line.startswith("| `")}
    assert list(rows) == ["proximity", "bool", "depth", "force", "none"]
    assert rows["proximity"].endswith("| no | open |") and rows["bool"].endswith("| yes | `none`; open: `proximity` |")
    assert rows["none"].endswith("| yes | open: `proximity` |") and rows["force"].endswith(
        "| `bool`, `none`; open: `proximity` |"
    )
    assert "of the paper's" not in text and "The paper does not have this task." in text


def test_nothing_is_open_if_all_curves_are_flat(kept):
    text = tables(kept(scores={name: BLIND[name] for name in ("force", "bool", "none")}))
    rows = {line.split("`")[1]: line for line in text.splitlines() if line.startswith("| `")}
    assert rows["force"].endswith("| yes | – |") and rows["bool"].endswith("| yes | `force` |")


def test_without_teacher_and_rest_no_curve_is_flat(kept, tmp_path):
    folder = kept()
    (folder / "made_up" / "rest.json").unlink()
    assert judged(read_ablation(folder / "made_up"))[0].is_flat  # the student without touch replaces rest
    (folder / "made_up" / "teacher.json").unlink()
    assert {verdict.is_flat for verdict in judged(read_ablation(folder / "made_up"))} == {None}
    assert "no curve is called flat" in tables(folder) and "0 of 5 curves are flat." in tables(folder)


def test_types_are_compared_within_each_placement_resolution_and_noise(kept):
    """Students without touch appear once per resolution, compared with every type at it."""
    places = [
        (where, density, noise) for density in ("low", "med") for where in ("tips", "hand") for noise in ("clean", "noisy")
    ]
    folder = kept(scores={"force": lambda x: 5.0, "none": lambda x: 1.0}, places=places)
    ablation = read_ablation(folder / "made_up")
    assert [taught.row.resolution for taught in ablation.taught if taught.row.type == "none"] == ["low", "med"]
    text = tables(folder)
    assert "separates 8 of 8 pairs of types in the same place" in text and "is worse than hand" not in text
    table = rows_of(folder / "made_up" / "table.csv")
    for row in table:
        if row["placement"] == "tips" and row["noise"] == "clean":
            row |= {"score": "3", "low": "2.9", "high": "3.1"}
    with (folder / "made_up" / "table.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    blind = next(line for line in tables(folder).splitlines() if line.startswith("| `none` | low"))
    assert blind.endswith("| yes | `force` |")
    bullets = [line for line in tables(folder).splitlines() if line.startswith("- ")]
    assert bullets == [
        "- `force`, low, clean: placement tips is worse than hand.",
        "- `force`, med, clean: placement tips is worse than hand.",
        "- `force`, tips, low: noise clean is worse than noisy.",
        "- `force`, tips, med: noise clean is worse than noisy.",
    ]
    figure = plot(read_ablation(folder / "made_up"))
    assert [axes.get_title(loc="left") for axes in figure.axes][:2] == ["tips, low, clean", "tips, low, noisy"]
    assert max(len(axes.lines) for axes in figure.axes) == 4  # teacher and rest too


@pytest.mark.slow
def test_the_page_gives_samples_of_the_paper_and_is_repeatable(kept, tmp_path):
    assert paper_samples("in_palm_rotate") == 1_179_648_000 and paper_samples("screwdriver") == 196_608_000
    folder, page = kept(), tmp_path / "docs" / "background" / "ablations.md"
    kept("another", LEVEL)
    page.parent.mkdir(parents=True)
    (page.parents[1] / "images").mkdir()
    page.write_text(f"# Title\n\nProse before.\n\n{BEGIN}\n\nwhat was there\n\n{END}\n\nProse after.\n")
    files = write_page(folder, page)
    first = [file.read_bytes() for file in files]
    text = first[0].decode()
    assert text.startswith(f"# Title\n\nProse before.\n\n{BEGIN}\n\n### another") and text.endswith(f"{END}\n\nProse after.\n")
    assert [file.name for file in files] == ["ablations.md", "ablation_another.png", "ablation_made_up.png"]
    assert f"0.072 M ({100 * STEPS_OF_EACH / 1_179_648_000:.2f} % of the paper's)" in text and "in 2 legs" in text
    assert "what was there" not in text and "| *teacher* |" in text and "Flat: within ±0.6 over the last third." in text
    assert [file.read_bytes() for file in write_page(folder, page)] == first


def test_the_committed_pages_match_the_kept_results():
    text, page = (file.read_text(encoding="utf-8") for file in (RECORD, PAGE))
    assert text == written(text, tables()), "run: python benchmarks/ablations.py page"
    assert page == written(page, summary(), PAGE, SUMMARY), "run: python benchmarks/ablations.py page"
    collected = kept_ablations()
    pictures = {PAGE.parents[1] / "images" / f"ablation_{series_of(ablation.name)}.png" for ablation in collected}
    assert sorted((PAGE.parents[1] / "images").glob("ablation_*.png")) == sorted(pictures)
    sizes = [sum(file.stat().st_size for file in (KEPT / ablation.name).rglob("*.*")) for ablation in collected]
    assert all(size <= LIMIT for size in sizes)


def test_the_summary_has_a_row_per_type_and_a_column_per_place(kept):
    lines = [line.strip("|").split(" | ") for line in summary(kept(places=[("tips", "med", "clean")])).splitlines()]
    assert [line[0].strip() for line in lines[2:]] == [f"`{name}`" for name in BLIND] + ["*teacher*", "*joints at rest*"]
    assert lines[0][1].strip() == "`in_palm_rotate`, tips [quarter turns]"
    scores = {line[0].strip(" `*"): float(line[1]) for line in lines[2:]}
    assert scores["teacher"] == 12.0 and scores["none"] < scores["bool"] < scores["force"]


def test_the_page_says_that_nothing_is_kept(tmp_path):
    assert tables(tmp_path) == NOTHING


def test_no_local_paths_are_kept(kept):
    overrides = {"grasps.file": "/somewhere/else/grasps.npz", "x": f"{PAGE}"}
    text = (kept(overrides=overrides) / "made_up" / "distill.json").read_text()
    assert json.loads(text)["overrides"] == {"grasps.file": "grasps.npz", "x": "docs/background/ablations.md"}
    assert str(PAGE.parents[1]) not in text


def test_sixty_students_fit_the_size_limit(tmp_path):
    """Ten types at two placements, three seeds: 60 students."""
    scores = {
        name: (lambda x, i=i: 1.0 / 3.0 + i * x) for i, name in enumerate([*LEVEL, "force_torque", "elastomer", "agg_bool"])
    }
    places = [(where, "med", noise) for where in ("tips", "hand") for noise in ("clean", "noisy")]
    run = made_up_run(tmp_path / "run", scores, 2, places)
    assert collect(run, "large", into=tmp_path / "kept") < 100_000


@pytest.mark.slow
def test_invalid_runs_and_arguments_are_refused(tmp_path, capsys, monkeypatch):
    def refused(change=lambda run: None, name="name", **options):
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
        run = made_up_run(tmp_path / "run", options.pop("scores", LEVEL), **options.pop("made", {}))
        change(run)
        with pytest.raises(KeptError) as error:
            collect(run, name, into=tmp_path / "kept", **options)
        assert not (tmp_path / "kept").exists()
        return str(error.value)

    for name in ("a/b", "", "nets__", "__cnn", "a___b"):
        assert f'"{name}" is no name for an ablation' in refused(name=name)
    assert "--rows 0: expected at least 1" in refused(rows=0)
    assert "distill.json: cannot read this file" in refused(lambda run: (run / "distill.json").unlink())
    assert "table.csv: cannot read this file" in refused(lambda run: (run / "table.csv").unlink())
    assert "found the columns a, b, expected type, placement" in refused(
        lambda run: (run / "table.csv").write_text("a,b\n1,2\n")
    )
    options_of_run = {"resolutions": ["med", "low"]}
    assert 'no row of the resolution "low"' in refused(
        lambda run: (run / "distill.json").write_text(json.dumps(options_of_run))
    )
    assert "distill.json: there are no resolutions" in refused(lambda run: (run / "distill.json").write_text("{}"))
    stale = refused(made={"is_stale": True})
    assert (
        f"curve has {STEPS_OF_EACH + STEPS * ROWS:,} control steps of each student, the table {STEPS_OF_EACH:,}: the last leg"
        in stale
    )
    curve = ("med", "curve.csv")
    header = lambda run: run.joinpath(*curve).write_text("iteration,samples\n1,1\n")  # noqa: E731
    assert "curve.csv: there is no column Score/force-hand-clean-s0" in refused(header)
    starts = lambda run: (run / "med" / "run.json").write_text('{"starts": [{}, {}]}')  # noqa: E731
    assert "run.json: it does not say at which iteration leg 2 began: it is of an older tgdsl" in refused(starts)
    assert "there is no evaluation of force-hand-clean-s0" in refused(
        lambda run: (run / "med" / "evaluation.json").write_text("{}")
    )
    for changed, score in ({"score": -5.0}, "-5 in 200"), ({"episodes": 2}, "10.005 in 4"):

        def other(run, changed=changed):
            file = run / "med" / "evaluation.json"
            file.write_text(json.dumps({name: result | changed for name, result in json.loads(file.read_text()).items()}))

        message = f"force-hand-clean-s0, force-hand-clean-s1 score {score} episodes, 10.005 in 200 episodes by table.csv"
        assert f"evaluation.json: {message}: of another evaluation" in refused(other)
    assert "this is no JSON" in refused(lambda run: (run / "med" / "run.json").write_text("{"))
    other = evaluation(tmp_path / "other.json", 1.0, "screwdriver")
    assert 'an evaluation in "screwdriver", expected one in "in_palm_rotate"' in refused(teacher=other)
    assert "examples/tasks/nothing.yaml, which is not here" in refused(made={"task": "nothing"})
    assert "expected at most 300,000: take fewer --rows than 300" in refused(made={"seeds": 20}, rows=300)
    with pytest.raises(KeptError, match=r"distill.json: there is no document: this is not what `collect` writes"):
        tables(tmp_path)
    page = tmp_path / "page.md"
    page.write_text("# Nothing\n")
    monkeypatch.setattr(sys, "argv", ["ablations.py", "page", "--kept", str(tmp_path / "kept"), "--page", str(page)])
    with pytest.raises(SystemExit) as failure:
        ablations.main()
    assert failure.value.code == 2 and f"{page}: expected the lines {BEGIN} and {END}" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
def test_a_run_of_tgdsl_distill_and_its_next_leg(tmp_path, here, no_onnx):
    """A small task on the CPU with two resolutions: collect what the command writes."""
    task = felt_task(tmp_path)
    sensors = (tmp_path / "sensors.yaml").read_text()
    dense = "      high:\n        tip: {method: grid, rows: 3, columns: 3, direction: [0, 0, 1], radius: 8 mm}\nobjects:"
    (tmp_path / "sensors.yaml").write_text(sensors.replace("objects:", dense, 1))
    teacher(tmp_path / "teacher.pt", load_task(task), ["priv_proprio", "priv_obj_state"])
    small = [
        word
        for setting in ("steps=4", "networks.encoder.hidden=[8]", "networks.hidden=[8]")
        for word in ("--set", f"distill.{setting}")
    ]
    taught = ("--teacher", str(tmp_path / "teacher.pt"), "--types", "depth,none", "--placements", "ends", "--seeds", "2")
    options = (
        "--device",
        "cpu",
        "--envs",
        "8",
        "--iterations",
        "2",
        "--episodes",
        "2",
        "--resolutions",
        "low,high",
        "-o",
        "run",
    )
    code, _, error = here(tmp_path, "distill", "task.yaml", *taught, *options, *small)
    assert code == 0, error
    collect(tmp_path / "run", "small", into=tmp_path / "kept")
    first = read_ablation(tmp_path / "kept" / "small")
    assert [(setting.row.type, setting.row.resolution) for setting in first.taught] == [
        ("depth", "low"),
        ("none", "low"),
        ("depth", "high"),
        ("none", "high"),
    ]
    assert first.made["teacher"] == "teacher.pt" and str(tmp_path) not in (tmp_path / "kept/small/distill.json").read_text()
    code, _, error = here(
        tmp_path, "distill", "task.yaml", "--resume", "run", "--device", "cpu", "--iterations", "3", "--episodes", "2"
    )
    assert code == 0, error
    collect(tmp_path / "run", "small", into=tmp_path / "kept")
    second = read_ablation(tmp_path / "kept" / "small")
    assert second.curves["high"].samples.tolist() == [8.0, 16.0, 24.0]
    assert second.made["simulations"]["low"]["begun"] == [0, 2] and second.taught[0].row.samples == 24
    assert "### small" in tables(tmp_path / "kept")
