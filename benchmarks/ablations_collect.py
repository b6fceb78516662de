"""Keeping a run of `tgdsl distill`: its tables as they are, its curves thinned; see `ablations_kept.py` for what is kept.

Shapes: `point` points of a curve.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from ablations_kept import KEPT, LIMIT, ROOT, KeptError, Taught, column, read_json, read_rows, read_text, taught_in
from jaxtyping import Bool, Float

from tgdsl.files.write import atomic_write_all, with_folder
from tgdsl.rl.load import load_task

ROWS, DIGITS = 60, 4
"""Most rows of a curve, and digits of its numbers."""
NAME = re.compile(r"[a-z0-9]+(_{1,2}[a-z0-9]+)*")
STUDENTS = ("Score/", "Loss/")
"""What columns of students' curves begin with."""
EVALUATED = (
    "episodes",
    "envs",
    "seed",
    "score",
    "score_interval",
    "held",
    "held_interval",
    "episode_return",
    "seconds",
    "faults",
)
"""What is kept of each student's evaluation; task and unit are those of all."""
Array = np.ndarray


def collect(
    run: Path, name: str, teacher: Path | None = None, rest: Path | None = None, into: Path = KEPT, rows: int = ROWS
) -> int:
    """Keep a run under a name, in place of what was kept under it; return the size [byte].

    Evaluations of teacher and rest that were kept under the name stay, if no others are given.

    Args:
        run: Its folder.
        name: The name.
        teacher: What `tgdsl evaluate --policy TEACHER --out` wrote.
        rest: What `tgdsl evaluate --out` wrote without a policy.
        into: Folder of all that is kept.
        rows: Most rows of each curve.

    Raises:
        KeptError: If something is missing, does not fit together, or is too large; nothing is written.
        FileError: If it cannot be written.
    """
    if rows < 1:
        raise KeptError(f"--rows {rows}: expected at least 1")
    if not NAME.fullmatch(name):
        what = "expected small letters and digits, with _ between them, or SERIES__WHAT"
        raise KeptError(f'"{name}" is no name for an ablation, {what}')
    asked = read_json(run / "distill.json", "a run of tgdsl distill")
    if not asked.get("resolutions"):
        raise KeptError(f"{run / 'distill.json'}: there are no resolutions: this is not what tgdsl distill writes")
    files: dict[str, str] = {"table.csv": read_text(run / "table.csv", "the run has not ended, or had --episodes 0")}
    taught = taught_in(read_rows(run / "table.csv"), asked["resolutions"], run / "table.csv")
    made: dict[str, Any] = {}
    for resolution in asked["resolutions"]:
        folder, own = run / resolution, [each for each in taught if each.row.resolution == resolution]
        if not own:
            raise KeptError(f'{run / "table.csv"}: there is no row of the resolution "{resolution}"')
        curve = read_rows(folder / "curve.csv")
        iteration = column(curve, "iteration", folder / "curve.csv")
        starts = starts_in(folder / "run.json")
        legs = legs_in(starts, int(iteration[-1]))
        made[resolution] = made_from(starts[-1], legs)
        files[f"{resolution}/curve.csv"] = thinned(curve, own, rows, folder / "curve.csv", begun_midway(iteration, legs))
        files[f"{resolution}/evaluation.json"] = evaluations(folder / "evaluation.json", own)
    document = next(iter(made.values()))["document"]
    task = next((load_task(file).task for file in (Path(document), ROOT / document) if file.is_file()), None)
    if task is None:
        raise KeptError(f"{run}: it was made from {document}, which is not here: collect it where that is")
    plain = {"document": _shown(document), "unit": task.score_unit, "is_less_better": task.is_less_better} | asked
    plain.pop("teacher_from_here", None)  # a place on this machine
    files["distill.json"] = _json(_without_paths(plain | {"simulations": made}))
    for given, kept in ((teacher, "teacher.json"), (rest, "rest.json")):
        own = given or into / name / kept
        if given is not None or own.is_file():
            files[kept] = _json(_of_task(own, made))
    _refuse_other_teacher(into / name, asked["teacher"], teacher)
    size = sum(len(text.encode()) for text in files.values())
    if size > LIMIT:
        raise KeptError(f"{name}: {size:,} bytes, expected at most {LIMIT:,}: take fewer --rows than {rows}")
    contents = {into / name / file: text.encode() for file, text in files.items()}
    for file in contents:
        with_folder(file)
    atomic_write_all(contents)
    for file in set((into / name).rglob("*.*")) - contents.keys():  # of resolutions that are no longer there
        if file.is_file():
            file.unlink()
    return size


def begun_midway(iteration: Float[Array, " point"], legs: Mapping[int, Mapping[str, Any]]) -> Bool[Array, " point"]:
    """Return in which iterations the episodes that ended may have been parts alone: the first of each leg.

    When a run begins or goes on, its first episodes count as having lasted a while, so that not all end at once; what they
    score is that of a part, which would look as if students had forgotten something.
    """
    found = np.zeros(len(iteration), dtype=bool)
    for first, start in legs.items():
        spec, physics = start["spec"], start["spec"]["physics"]
        steps = round(spec["episode"] / (physics["timestep"] * physics["substeps"]))
        found |= (iteration > first) & (iteration <= first + math.ceil(steps / spec["distill"]["steps"]))
    return found


def thinned(
    curve: Sequence[Mapping[str, str]], taught: Sequence[Taught], rows: int, file: Path, left_out: Bool[Array, " point"]
) -> str:
    """Return a curve of few rows as CSV: means over spans of as many control steps each, at the end of which `samples` stands.

    A score's mean is that of the iterations in which it is known, however many episodes ended in each: the curve tells the
    number of all students' episodes together alone, by which a student would count more where others drop the object.

    Args:
        curve: A row per iteration.
        taught: The students.
        rows: Most rows.
        file: Where it was read from, for errors.
        left_out: Rows whose scores do not count.

    Raises:
        KeptError: If a student's column is missing, or the curve goes on beyond what was evaluated.
    """
    names = [name for each in taught for name in each.names]
    columns = [start + name for start in STUDENTS for name in names]
    missing = [name for name in columns if not curve or name not in curve[0]]
    if missing:
        raise KeptError(f"{file}: there is no column {missing[0]}")
    samples = column(curve, "samples", file) / len(names)
    if round(samples[-1]) != taught[0].row.samples:
        steps = f"{round(samples[-1]):,} control steps of each student, the table {taught[0].row.samples:,}"
        raise KeptError(f"{file}: the curve has {steps}: the last leg was not evaluated")
    span = np.ceil(samples / samples[-1] * rows - 1e-9).astype(int)
    seconds, values = column(curve, "seconds", file), {name: column(curve, name, file) for name in columns}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["samples", "seconds", *values])
    for own in np.unique(span):
        chosen = span == own
        known = {name: chosen & np.isfinite(value) for name, value in values.items()}
        known |= {name: kept & ~left_out for name, kept in known.items() if name.startswith("Score/")}
        means = [f"{value[known[name]].mean():.{DIGITS}g}" if known[name].any() else "" for name, value in values.items()]
        writer.writerow([round(samples[chosen][-1]), f"{seconds[chosen][-1]:.{DIGITS}g}", *means])
    return text.getvalue()


def evaluations(file: Path, taught: Sequence[Taught]) -> str:
    """Return the evaluation of each student, a line each.

    Raises:
        KeptError: If one's is missing, or they are not those that the table was made from.
    """
    found = read_json(file, "evaluations")
    names = [name for each in taught for name in each.names]
    missing = [name for name in names if name not in found]
    if missing:
        raise KeptError(f"{file}: there is no evaluation of {missing[0]}")
    for each in taught:
        own = [found[name] for name in each.names]
        told = f"{fmean(one['score'] for one in own):.6g} in {sum(one['episodes'] for one in own)} episodes"
        if told != (expected := f"{each.row.score:.6g} in {each.row.episodes} episodes"):
            raise KeptError(f"{file}: {', '.join(each.names)} score {told}, {expected} by table.csv: of another evaluation")
    lines = [f"{json.dumps(name)}: {json.dumps(_rounded({key: found[name][key] for key in EVALUATED}))}" for name in names]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def starts_in(file: Path) -> list[dict[str, Any]]:
    """Return what a run was made from at each start.

    Raises:
        KeptError: If that cannot be read, or does not say after how many iterations these were.
    """
    starts = read_json(file, "what the run was made from").get("starts") or []
    if not starts:
        raise KeptError(f"{file}: it has no starts")
    begun = [start.get("iteration") for start in starts[1:]]
    if None in begun:
        raise KeptError(
            f"{file}: it does not say at which iteration leg {begun.index(None) + 2} began: it is of an older tgdsl"
        )
    return [starts[0] | {"iteration": 0}, *starts[1:]]


def legs_in(starts: Sequence[dict[str, Any]], iterations: int) -> dict[int, dict[str, Any]]:
    """Return the starts of which iterations are left, by the iteration after which each was.

    One that was killed while it evaluated, or whose iterations were made again, is no leg.

    Args:
        starts: All starts, in their order.
        iterations: Iterations of the run.
    """
    legs: dict[int, dict[str, Any]] = {}
    for start in starts:
        legs = {first: leg for first, leg in legs.items() if first < start["iteration"]} | {start["iteration"]: start}
    return {first: leg for first, leg in legs.items() if first < iterations}


def made_from(last: Mapping[str, Any], legs: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Return what the simulation of a resolution was made from: of all legs the devices and rates, else of the last start."""
    return {
        "document": last["task"],
        "task": last["spec"]["task"],
        "begun": list(legs),
        "devices": list(dict.fromkeys(start["device"] for start in legs.values())),
        "rates": [_rate(leg["spec"]["distill"]) for leg in legs.values()],
        "envs": last["envs"],
        "episode": last["spec"]["episode"],
        "physics": last["spec"]["physics"],
        "distill": last["spec"]["distill"],
        "versions": last["versions"],
    }


def _rate(distill: Mapping[str, Any]) -> str:
    """Return a leg's learning rate, and what it fell to."""
    last = distill.get("final_learning_rate")  # older runs know of none
    return f"{distill['learning_rate']:g}" + ("" if last is None else f" falling to {last:g}")


def _of_task(file: Path, made: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return an evaluation in the task of a run."""
    found = read_json(file, "what tgdsl evaluate --out wrote")
    task = next(iter(made.values()))["task"]
    if found.get("task") != task:
        raise KeptError(f'{file}: an evaluation in "{found.get("task")}", expected one in "{task}"')
    return _rounded(found)


def _refuse_other_teacher(kept: Path, asked: str, given: Path | None) -> None:
    """Refuse the evaluation of another teacher, which was kept under the name.

    Raises:
        KeptError: If the teacher was another one, and no evaluation is given.
    """
    if given is None and (kept / "teacher.json").is_file() and (kept / "distill.json").is_file():
        before = read_json(kept / "distill.json", "an ablation")["teacher"]
        if before != _shown(asked):
            raise KeptError(f"{kept / 'teacher.json'} is of {before}, and this run was taught by {asked}: give --teacher")


def _rounded(value: Any) -> Any:
    """Return plain values, floats with 6 digits."""
    if isinstance(value, dict):
        return {name: _rounded(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _without_paths(value: Any) -> Any:
    """Return plain values, absolute paths in them as those of the repository, or as their last part."""
    if isinstance(value, dict):
        return {name: _without_paths(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_without_paths(part) for part in value]
    return _shown(value) if isinstance(value, str) else value


def _shown(text: str) -> str:
    file = Path(text)
    if not file.is_absolute():
        return text
    return file.relative_to(ROOT).as_posix() if file.is_relative_to(ROOT) else file.name


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=1, ensure_ascii=False) + "\n"
