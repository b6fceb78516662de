"""Compare students that differ in their sense of touch, on docs/background/ablations.md and docs/records/ablations.md.

    python benchmarks/ablations.py keep out/cube_400 cube --teacher out/teacher.json --rest out/rest.json
    python benchmarks/ablations.py page

`keep` copies the results of `tgdsl distill` to docs/measured/ablations/NAME; `page` writes tables and plots from all results
there. Runs that differ in their number of iterations alone have one name. Names SERIES__NETWORKS share a section and a plot.
A series with names SERIES__WAY_NUMBER, such as `taxels__gates_20`, is plotted over the number of taxels, with a curve for each
way to choose them and a line for each other score.

A student has **converged** if twice as many iterations change its score by less than 5 % of that score. A type is **worse**
than another in the same place if both have converged and several seeds, and the 95 % intervals of their scores do not overlap.

docs/measured/ablations/NAME holds

- run.json: document, teacher, overrides, devices, environments, and the evaluations of the teacher and of joints at rest;
- ITERATIONS/table.csv: scores, as `tgdsl distill` wrote them;
- ITERATIONS/RESOLUTION.csv: at most 60 rows of each student's curve, without episodes that began before the run.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_write_all, with_folder
from tgdsl.rl.load import load_task
from tgdsl.rl.sensors import PolicyTouch
from tgdsl.rl.spec import touch_types
from tgdsl.rl.students.keys import NONE, StudentKey
from tgdsl.rl.students.results import Row

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "measured" / "ablations"
PAGES = ROOT / "docs" / "background" / "ablations.md", ROOT / "docs" / "records" / "ablations.md"
BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"
CHANGE = 0.05  # relative change of the score below which a student has converged
POINTS = 60  # rows of a curve
YARDSTICKS = {"teacher": "teacher", "rest": "joints at rest"}
COLOURS = {name: colormaps["tab10"](i % 10) for i, name in enumerate(touch_types())} | {NONE: "black"}
Place = tuple[str, str, str]  # placement, resolution and noise


class AblationError(TgdslError):
    """Results that cannot be kept or compared."""


@dataclass(frozen=True)
class Results:
    """Results under one name: rows of the tables and curves by number of iterations."""

    name: str
    run: dict[str, Any]
    rows: dict[int, list[Row]]
    curves: dict[int, dict[str, dict[str, np.ndarray]]]  # by iterations, resolution and column

    @property
    def series(self) -> str:
        """Return the part of the name before `__`."""
        return self.name.partition("__")[0]

    @property
    def networks(self) -> str:
        """Return the part of the name after `__`, empty without one."""
        return self.name.partition("__")[2]

    @property
    def final(self) -> dict[tuple[str, Place], tuple[int, Row]]:
        """Return the row with the most iterations of each type and place, and these iterations."""
        return {(row.type, place_of(row)): (n, row) for n in sorted(self.rows) for row in self.rows[n]}

    @property
    def places(self) -> list[Place]:
        """Return all places with touch, in the order of the tables."""
        return list(dict.fromkeys(place_of(row) for rows in self.rows.values() for row in rows if row.type != NONE))

    def before(self, row: Row, iterations: int) -> Row | None:
        """Return the row of the same students after half as many iterations."""
        half = self.rows.get(iterations // 2, []) if iterations % 2 == 0 else []
        return next((other for other in half if (other.type, place_of(other)) == (row.type, place_of(row))), None)

    def has_converged(self, row: Row, iterations: int) -> bool | None:
        """Return whether students have converged, with a score of 0 never; None: no run had half as many iterations."""
        before = self.before(row, iterations)
        return None if before is None else abs(row.score - before.score) < CHANGE * abs(row.score)

    def worse_than(self, row: Row, iterations: int) -> list[str]:
        """Return the types in the same place that a type is worse than."""
        comparable = [other for n, other in self.final.values() if other.seeds > 1 and self.has_converged(other, n)]
        if row not in comparable:
            return []
        others = [other for other in comparable if place_of(other) == place_of(row) or is_same_without_touch(other, row)]
        if self.run["is_less_better"]:
            better = [other.type for other in others if other.high < row.low]
        else:
            better = [other.type for other in others if other.low > row.high]
        return list(dict.fromkeys(better))


def place_of(row: Row) -> Place:
    return row.placement, row.resolution, row.noise


def is_same_without_touch(one: Row, other: Row) -> bool:
    """Return whether one of two types has no touch: it is in each place of its resolution."""
    return NONE in (one.type, other.type) and one.resolution == other.resolution


def keep(run: Path, name: str, evaluations: Mapping[str, Path | None], folder: Path = RESULTS) -> Path:
    """Keep a run of `tgdsl distill` under a name; return the folder.

    Raises:
        AblationError: If files are missing, or the run differs in more than its iterations from those of the name; nothing is
            written.
    """
    distill, table = _read_json(run / "distill.json"), _read(run / "table.csv")
    curves: dict[str, bytes] = {}
    lengths, devices, document = set(), [], ""
    for resolution in distill["resolutions"]:
        starts = _read_json(run / resolution / "run.json")["starts"]
        curve = list(csv.DictReader(io.StringIO(_read(run / resolution / "curve.csv"))))
        lengths.add(int(curve[-1]["iteration"]))
        document = starts[-1]["task"]
        devices += [start["device"] for start in starts]
        curves[f"{resolution}.csv"] = _thinned(curve, starts).encode()
    if len(lengths) > 1:
        raise AblationError(f"{run}: resolutions have {sorted(lengths)} iterations, expected one number")
    task = load_task(document if Path(document).is_file() else ROOT / document).task
    record = {"document": _relative(document), "unit": task.score_unit, "is_less_better": task.is_less_better}
    record |= {"teacher": _relative(distill["teacher"]), "envs": distill["envs"], "devices": sorted(set(devices))}
    record |= {"overrides": distill["overrides"], "scores": {}}
    before = _read_json(folder / name / "run.json") if (folder / name / "run.json").is_file() else {}
    for key in ("document", "teacher", "envs", "overrides") if before else ():
        if before[key] != record[key]:
            raise AblationError(
                f"{name}: its results have {key} {before[key]}, this run has {record[key]}; choose another name"
            )
    for who, file in evaluations.items():
        evaluation = _read_json(file) if file else before.get("scores", {}).get(who)
        if evaluation is not None:
            record["scores"][who] = {key: evaluation[key] for key in ("score", "score_interval", "held", "episodes")}
    files = {"table.csv": table.encode(), **curves}
    contents = {folder / name / str(*lengths) / file: content for file, content in files.items()}
    contents[folder / name / "run.json"] = (json.dumps(record, indent=1, ensure_ascii=False) + "\n").encode()
    for file in contents:
        with_folder(file)
    atomic_write_all(contents)
    return folder / name


def _thinned(curve: Sequence[Mapping[str, str]], starts: Sequence[Mapping[str, Any]]) -> str:
    """Return means over equal spans of control steps as CSV; `samples` and `seconds` are those at the end of a span.

    When a run begins or continues, episodes begin midway: scores of the first episode's length are left out.
    """
    iteration, samples, seconds = (
        np.array([float(row[name]) for row in curve]) for name in ("iteration", "samples", "seconds")
    )
    is_partial = np.zeros(len(curve), dtype=bool)
    for start in starts:
        spec, first = start["spec"], start.get("iteration", 0)
        steps = spec["episode"] / (spec["physics"]["timestep"] * spec["physics"]["substeps"]) / spec["distill"]["steps"]
        is_partial |= (iteration > first) & (iteration <= first + math.ceil(steps))
    names = [name for name in curve[0] if name.startswith("Score/")]
    columns = names + [name for name in ("rollout", "update") if name in curve[0]]
    values = {name: np.array([float(row[name] or "nan") for row in curve]) for name in columns}
    for name in names:
        values[name][is_partial] = np.nan
    span = np.ceil(samples / samples[-1] * POINTS - 1e-9)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["samples", "seconds", *columns])
    for index in np.unique(span):
        part = span == index
        finite = [value[part & np.isfinite(value)] for value in values.values()]
        means = [f"{value.mean():.4g}" if len(value) else "" for value in finite]
        writer.writerow([round(samples[part][-1] / len(names)), f"{seconds[part][-1]:.4g}", *means])
    return text.getvalue()


def all_results(folder: Path = RESULTS) -> list[Results]:
    """Return all results, by name."""
    return [_results(file.parent) for file in sorted(folder.glob("*/run.json"))]


def _results(folder: Path) -> Results:
    rows: dict[int, list[Row]] = {}
    curves: dict[int, dict[str, dict[str, np.ndarray]]] = {}
    kinds = get_type_hints(Row)
    for table in sorted(folder.glob("*/table.csv")):
        n = int(table.parent.name)
        rows[n] = [Row(**{key: kinds[key](row[key]) for key in kinds}) for row in csv.DictReader(io.StringIO(_read(table)))]
        curves[n] = {}
        for file in set(table.parent.glob("*.csv")) - {table}:
            lines = list(csv.DictReader(io.StringIO(_read(file))))
            curves[n][file.stem] = {key: np.array([float(line[key] or "nan") for line in lines]) for key in lines[0]}
    return Results(folder.name, _read_json(folder / "run.json"), rows, curves)


def summary(runs: Sequence[Results]) -> str:
    """Return a table of scores: a row per type, a column per place where more than two types were compared."""
    columns = [(run, place) for run in runs for place in run.places if len({row.type for row in run.rows[max(run.rows)]}) > 2]
    types = dict.fromkeys(type_ for run, place in columns for type_, where in run.final if where == place)
    head = [f"`{Path(run.run['document']).stem}`, {_title(run, place)} [{run.run['unit']}]" for run, place in columns]
    lines = [("type", *head), ("---", *["---:"] * len(head))]
    for type_ in (*types, NONE):
        cells = []
        for run, place in columns:
            n, row = run.final.get((type_, ("", place[1], "") if type_ == NONE else place), (0, None))
            cells.append("–" if row is None else f"{row.score:.3f}{'' if run.has_converged(row, n) else '†'}")
        lines.append((f"`{type_}`", *cells))
    for who, title in YARDSTICKS.items():
        lines.append(
            (
                f"*{title}*",
                *(f"{run.run['scores'][who]['score']:.3f}" if who in run.run["scores"] else "–" for run, _ in columns),
            )
        )
    return _markdown(lines) + "\n\n† not known to have converged"


def sections(runs: Sequence[Results]) -> str:
    """Return a section per series: conditions, a table, and the plot."""
    parts = []
    for series, members in _by_series(runs).items():
        first = members[0].run
        conditions = f"Task `{first['document']}`, teacher `{first['teacher']}`, "
        conditions += f"on {', '.join(first['devices'])}, {first['envs']:,} environments."
        head = (
            "where",
            "type",
            f"score [{first['unit']}]",
            "95 %",
            "iterations",
            "after half of them",
            "converged",
            "worse than",
        )
        lines = [(*head, "seeds", "held", "million control steps"), ("---",) * 11]
        for run in members:
            sign = 1.0 if first["is_less_better"] else -1.0
            order = sorted(run.final.values(), key=lambda each: (each[1].type == NONE, place_of(each[1]), sign * each[1].score))
            for n, row in order:
                before = run.before(row, n)
                cells = [
                    _title(run, place_of(row)),
                    f"`{row.type}`",
                    f"{row.score:.3f}",
                    _bounds((row.low, row.high)),
                    f"{n:,}",
                ]
                cells.append("–" if before is None else f"{before.score:.3f}")
                cells.append({None: "–", True: "yes", False: "no"}[run.has_converged(row, n)])
                cells += [", ".join(f"`{name}`" for name in run.worse_than(row, n)) or "–", f"{row.seeds}", f"{row.held:.1%}"]
                lines.append((*cells, f"{row.samples / 1e6:.3g}"))
        for who, title in YARDSTICKS.items():
            if score := first["scores"].get(who):
                lines.append(
                    (
                        "",
                        f"*{title}*",
                        f"{score['score']:.3f}",
                        _bounds(score["score_interval"]),
                        *[""] * 5,
                        f"{score['held']:.1%}",
                        "",
                    )
                )
        converged = [run.has_converged(row, n) for run in members for n, row in run.final.values()]
        count = f"{sum(map(bool, converged))} of {len(converged)} rows have converged."
        image = f"![Scores by control steps: {series}](../images/ablation_{series}.png)"
        parts.append("\n\n".join([f"### {series}", conditions, _overrides(members), _markdown(lines), count, image]))
    return "\n\n".join(parts) or "There are no results yet."


def plot(members: Sequence[Results]) -> Figure:
    """Return scores by control steps, a panel per place: mean, least and largest of the seeds."""
    places = [(run, place) for run in members for place in run.places]
    columns = min(3, math.ceil(math.sqrt(len(places))))
    rows = math.ceil(len(places) / columns)
    figure = Figure(figsize=(1.5 + 4.2 * columns, 3.4 * rows), dpi=100, layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for axes, (run, place) in zip(panels, places, strict=False):
        for (type_, where), (n, row) in run.final.items():
            if where not in (place, ("", place[1], "")):
                continue
            curve = run.curves[n][place[1]]
            scores = np.stack([curve[f"Score/{key.name}"] for key in _keys(row)])
            millions = curve["samples"] / 1e6
            axes.plot(millions, scores.mean(axis=0), color=COLOURS.get(type_, "grey"), linewidth=1.3, label=type_)
            axes.fill_between(
                millions, scores.min(axis=0), scores.max(axis=0), color=COLOURS.get(type_, "grey"), alpha=0.15, linewidth=0
            )
        for (who, title), dashes in zip(YARDSTICKS.items(), ("--", ":"), strict=True):
            if who in run.run["scores"]:
                axes.axhline(run.run["scores"][who]["score"], color="black", linestyle=dashes, linewidth=1.0, label=title)
        axes.set_title(_title(run, place), fontsize=9, loc="left")
        axes.set_xlabel("million control steps of each student", fontsize=9)
        axes.grid(True, color="#e3e5e8", linewidth=0.6)
    for axes in panels[len(places) :]:
        axes.set_axis_off()
    for axes in panels[::columns]:
        axes.set_ylabel(f"score [{members[0].run['unit']}]", fontsize=9)
    handles = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside right upper", frameon=False, fontsize=8)
    return figure


def plot_by_number(members: Sequence[Results]) -> Figure:
    """Return scores by number of taxels, and their 95 % intervals."""
    figure = Figure(figsize=(6.4, 4.2), dpi=100, layout="constrained")
    axes, ways = figure.subplots(), defaultdict(list)
    for run in members:
        way, _, number = run.networks.rpartition("_")
        for _, row in run.final.values():
            if number.isdigit():
                ways[way].append((int(number), row.score, row.score - row.low, row.high - row.score))
            else:
                axes.axhline(row.score, linestyle=":", linewidth=1.0, color=COLOURS.get(row.type, "grey"))
                axes.annotate(row.placement or row.type, (1.0, row.score), xycoords=("axes fraction", "data"), fontsize=8)
    for way, points in ways.items():
        number, score, below, above = np.array(sorted(points)).T
        axes.errorbar(number, score, (below, above), marker="o", capsize=3, label=way)
    axes.set_xscale("log")
    numbers = sorted({int(number) for points in ways.values() for number, *_ in points})
    axes.set_xticks(numbers, [f"{number}" for number in numbers])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("taxels")
    axes.set_ylabel(f"score [{members[0].run['unit']}]")
    axes.legend(frameon=False)
    return figure


def _keys(row: Row) -> list[StudentKey]:
    touch = None if row.type == NONE else PolicyTouch(row.type, row.placement, row.noise)
    return [StudentKey(touch, seed) for seed in range(row.seeds)]


def write_pages(folder: Path = RESULTS, pages: tuple[Path, Path] = PAGES) -> list[Path]:
    """Write tables between the markers of both pages, and the plots; return the files."""
    runs = all_results(folder)
    contents = {page: _between(page, text) for page, text in zip(pages, (summary(runs), sections(runs)), strict=True)}
    for series, members in _by_series(runs).items():
        png = io.BytesIO()
        is_by_number = any(run.networks.rpartition("_")[2].isdigit() for run in members)
        FigureCanvasAgg((plot_by_number if is_by_number else plot)(members)).print_png(png, metadata={"Software": None})
        contents[with_folder(pages[1].parents[1] / "images" / f"ablation_{series}.png")] = png.getvalue()
    atomic_write_all(contents)
    return list(contents)


def _between(page: Path, text: str) -> bytes:
    before, begin, rest = _read(page).partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise AblationError(f"{page}: expected the lines {BEGIN} and {END}")
    return f"{before}{begin}\n\n{text}\n\n{end}{after}".encode()


def _by_series(runs: Sequence[Results]) -> dict[str, list[Results]]:
    return {series: [run for run in runs if run.series == series] for series in dict.fromkeys(run.series for run in runs)}


def _title(run: Results, place: Place) -> str:
    return ", ".join(part for part in (run.networks, *place) if part)


def _overrides(members: Sequence[Results]) -> str:
    lines = []
    for run in members:
        settings = ", ".join(f"`{name}={value}`" for name, value in run.run["overrides"].items())
        lines.append(f"Overrides{f' of {run.networks}' if run.networks else ''}: {settings or 'none'}.")
    return "\n\n".join(lines)


def _bounds(interval: Sequence[float]) -> str:
    return "{:.3f} to {:.3f}".format(*interval) if all(map(math.isfinite, interval)) else "–"


def _markdown(lines: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _relative(file: str) -> str:
    path = Path(file)
    if not path.is_absolute():
        return file
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise AblationError(f"{file}: {error.strerror}; expected a file of tgdsl distill or evaluate") from error


def _read_json(file: Path) -> dict[str, Any]:
    try:
        return json.loads(_read(file))
    except ValueError as error:
        raise AblationError(f"{file}: {error}") from error


def main() -> None:
    """Keep a run, or write the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    keeping = actions.add_parser("keep")
    keeping.add_argument("run", type=Path, help="folder of a run of tgdsl distill")
    keeping.add_argument("name", help="NAME or SERIES__NETWORKS")
    keeping.add_argument("--teacher", type=Path, help="file of tgdsl evaluate --policy TEACHER --out")
    keeping.add_argument("--rest", type=Path, help="file of tgdsl evaluate --out without a policy")
    actions.add_parser("page")
    options = parser.parse_args()
    try:
        if options.action == "keep":
            print(keep(options.run, options.name, {"teacher": options.teacher, "rest": options.rest}))
        else:
            print(*write_pages(), sep="\n")
    except TgdslError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
