"""Tables of students, from the kept results, between markers of two pages; the text around the markers stays.

docs/records/ablations.md has a section per run. docs/background/ablations.md has one table: the mean score of each type.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ablations_kept import KEPT, ROOT, Ablation, KeptError, Taught, kept_ablations, read_rows, read_text
from ablations_plots import plot, png_of
from ablations_series import common_overrides, grouped, own_overrides, series_of, series_plot, what_of
from ablations_verdicts import FLAT, Trend, is_worse, trend

from tgdsl.files.write import atomic_write_all, with_folder
from tgdsl.rl.students.keys import NONE
from tgdsl.rl.students.results import Row

PAGE = ROOT / "docs" / "background" / "ablations.md"
RECORD = ROOT / "docs" / "records" / "ablations.md"
BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"
SUMMARY = "<!-- summary: begin -->", "<!-- summary: end -->"
PAPER = {"in_palm_rotate": (6000, 24), "in_hand_repose": (6000, 24), "screwdriver": (2000, 12)}
"""Iterations of a student and control steps of each environment per iteration: Chung et al., *Tactile Genesis*, appendix,
"Training Setup", table of hyperparameters. The steps stand there among the teacher's numbers, as do the environments."""
PAPER_ENVS = 8192
READING = "grip_force_reading.csv"
NOTHING = "Nothing is kept yet."


class Judged(NamedTuple):
    """Students that differ in their seeds alone, and what their curve says.

    Attributes:
        taught: The students.
        trend: How the mean of their scores changes over the last third; None: too few points.
        is_flat: Whether that has flattened; None where that cannot be told.
        holds: Whether they do not get worse, flat or not; the same.
    """

    taught: Taught
    trend: Trend | None
    is_flat: bool | None
    holds: bool | None

    @property
    def can_be_worse(self) -> bool:
        """Whether they can be called worse than others: of one seed the interval knows nothing of seeds."""
        return bool(self.is_flat) and self.taught.row.seeds > 1

    @property
    def can_be_better(self) -> bool:
        """Whether others can be called worse than they; the same."""
        return bool(self.holds) and self.taught.row.seeds > 1


def paper_samples(task: str) -> int | None:
    """Return the control steps that a student of the paper learned from; None of a task that it does not have."""
    if task not in PAPER:
        return None
    iterations, steps = PAPER[task]
    return iterations * steps * PAPER_ENVS


def span_of(ablation: Ablation, resolution: str) -> float | None:
    """Return the range of scores, from joints at rest, or else from students that feel nothing, to the teacher."""
    if ablation.teacher is None:
        return None
    blind = [each.row.score for each in ablation.taught if each.row.type == NONE and each.row.resolution == resolution]
    low = ablation.rest["score"] if ablation.rest else blind[0] if blind else None
    return None if low is None else abs(ablation.teacher["score"] - low)


def judged(ablation: Ablation) -> list[Judged]:
    """Return what each curve says."""
    found = []
    for taught in ablation.taught:
        curves, span = ablation.curves[taught.row.resolution], span_of(ablation, taught.row.resolution)
        score = sum(curves.score[name] for name in taught.names) / len(taught.names)
        made = trend(curves.samples, score)  # pyright: ignore[reportArgumentType]
        if made is None or span is None:
            found.append(Judged(taught, made, None, None))
        else:
            found.append(Judged(taught, made, made.is_flat(span), made.holds(span, ablation.made["is_less_better"])))
    return found


def worse_than(one: Judged, others: Sequence[Judged], is_less_better: bool) -> list[Judged]:
    """Return those of others that some students are worse than: see `ablations_verdicts.py`."""
    if not one.can_be_worse:
        return []
    row, better = one.taught.row, [other for other in others if other.can_be_better]
    ends = [(other, other.taught.row) for other in better if _are_as_long(row, other.taught.row)]
    return [other for other, own in ends if is_worse((row.low, row.high), (own.low, own.high), is_less_better)]


def is_open(one: Judged, other: Judged, worse: Sequence[Judged]) -> bool:
    """Return whether others may turn out better than some students, which are worse than `worse` already."""
    return other not in worse and not (other.can_be_worse and _are_as_long(one.taught.row, other.taught.row))


def tables(folder: Path = KEPT) -> str:
    """Return all that stands between the markers.

    Raises:
        KeptError: If something that is kept cannot be read.
    """
    reading = read_rows(folder / READING) if (folder / READING).is_file() else []
    groups = grouped(kept_ablations(folder))
    parts = [series_section(own) if what_of(own[0].name) else section(own[0], reading) for own in groups]
    if reading:
        parts.append(reading_section(reading, read_text(folder / READING)))
    return "\n\n".join(parts) or NOTHING


def section(ablation: Ablation, reading: Sequence[dict[str, str]] = ()) -> str:
    """Return an ablation's heading, conditions, table, verdicts and plot."""
    found, is_less_better = judged(ablation), ablation.made["is_less_better"]
    force = {row["type"]: f"{float(row['r2']):.3f}" for row in reading} if _task(ablation) == "grip_force" else {}
    header = ["type", "where", "seeds", f"score [{ablation.made['unit']}]", "95 %", "held", "control steps of each"]
    header += ["change in the last third (95 %)", "flat", "worse than", *(["R² of the force, whole hand"] if force else [])]
    lines = [_line(header), _line(["---"] * len(header))]
    places = list(dict.fromkeys(each.taught.where for each in found))

    def rank(each: Judged) -> tuple[bool, int, float]:
        row = each.taught.row
        return row.type == NONE, places.index(each.taught.where), row.score if is_less_better else -row.score

    for each in sorted(found, key=rank):
        lines.append(_line([*_row(ablation, each, found), *([force.get(each.taught.row.type, "–")] if force else [])]))
    lines += _yardsticks(ablation, ["", ""], len(header))
    parts = [f"### {ablation.name}", _conditions([ablation]), "\n".join(lines), _verdicts(found, is_less_better)]
    parts.append(f"![Score over control steps of each student: {ablation.name}](../images/ablation_{ablation.name}.png)")
    return "\n\n".join(parts)


def series_section(runs: Sequence[Ablation]) -> str:
    """Return heading, conditions, table and plot of runs that differ in their overrides."""
    name, is_less_better = series_of(runs[0].name), runs[0].made["is_less_better"]
    header = ["run", "type", "where", "seeds", f"score [{runs[0].made['unit']}]", "95 %", "held", "control steps of each"]
    header += ["minutes", "change in the last third (95 %)", "flat", "worse than"]
    lines = [_line(header), _line(["---"] * len(header))]
    found = [(f"`{what_of(run.name)}`", run, own) for run in runs for own in judged(run)]
    for name_of_run, run, own in found:
        kind = (own.taught.row.type, own.taught.where)
        beside = [
            (what, each) for what, _, each in found if what != name_of_run and (each.taught.row.type, each.taught.where) == kind
        ]
        worse = worse_than(own, [each for _, each in beside], is_less_better)
        names = ", ".join(what for what, each in beside if each in worse)
        untold = ", ".join(what for what, each in beside if is_open(own, each, worse))
        changed = [f"`{key}={value}`" for key, value in own_overrides(run, runs).items()]
        *cells, moved, flat = _cells(run, own)
        line = [", ".join([name_of_run, *changed]), *cells, f"{own.taught.row.minutes:.1f}", moved, flat]
        lines.append(_line([*line, _verdict(own, names, untold)]))
    lines += _yardsticks(runs[0], ["", "", ""], len(header))
    plotted = f"![Score over control steps of each student: {name}](../images/ablation_{name}.png)"
    return "\n\n".join([f"### {name}", _conditions(runs), "\n".join(lines), plotted])


def reading_section(rows: Sequence[dict[str, str]], text: str) -> str:
    """Return the table of how well the force can be read from each type."""
    command = next((line.lstrip("# ") for line in text.splitlines() if line.startswith("#")), "")
    header = ["type", "numbers", "R² (95 %)", "RMS error [N]", "RMS error, relative (95 %)"]
    lines = [_line(header), _line(["---"] * len(header))]
    for row in rows:
        r2 = f"{float(row['r2']):.3f} ({_bounds(float(row['r2_low']), float(row['r2_high']))})"
        relative, low, high = (_percent(float(row[name])) for name in ("relative", "relative_low", "relative_high"))
        cells = [f"`{row['type']}`", row["numbers"], r2, f"{float(row['rms']):.3f}"]
        lines.append(_line([*cells, f"{relative} ({low} to {high})"]))
    first = rows[0]
    said = (
        f"`{command}` fits a ridge regression while the teacher acts. From the numbers of one instant it predicts the sum of "
        f"normal forces on the object, which MuJoCo's contact forces give. {first['train_episodes']} episodes fit it, "
        f"{first['test_episodes']} others test it ({int(first['instants']):,} instants). Intervals are over test episodes. "
        "`none` has joint positions, velocities and last action."
    )
    return "\n\n".join(["### How well each type predicts the force", said, "\n".join(lines)])


def summary(folder: Path = KEPT) -> str:
    """Return a table of mean scores: a row per type, and a column per task, placement and noise.

    Runs that compare one type alone, as over resolutions or encoders, have no column.

    Raises:
        KeptError: If kept results cannot be read.
    """
    columns = [
        (run, [each for each in run.taught if each.where == where])
        for run in kept_ablations(folder)
        if not what_of(run.name) and len({each.row.type for each in run.taught}) > 2
        for where in dict.fromkeys(each.where for each in run.taught if each.row.type != NONE)
    ]
    types = dict.fromkeys(each.row.type for _, taught in columns for each in taught)
    heads = []
    for run, taught in columns:
        noise = f", {taught[0].row.noise}" if len({each.row.noise for each in run.taught} - {""}) > 1 else ""
        heads.append(f"`{Path(run.made['document']).stem}`, {taught[0].row.placement}{noise} [{run.made['unit']}]")
    lines = [_line(["type", *heads]), _line(["---", *["---:"] * len(heads)])]
    for name in (*types, NONE):
        rows = [[each.row for each in (*taught, *run.taught) if each.row.type == name] for run, taught in columns]
        lines.append(_line([f"`{name}`", *(f"{row[0].score:.3f}" if row else "–" for row in rows)]))
    for name, kept in (("teacher", "teacher"), ("joints at rest", "rest")):
        scores = [getattr(run, kept) for run, _ in columns]
        lines.append(_line([f"*{name}*", *(f"{score['score']:.3f}" if score else "–" for score in scores)]))
    return "\n".join(lines)


def written(text: str, made: str, file: Path = RECORD, markers: tuple[str, str] = (BEGIN, END)) -> str:
    """Return a page's text with other tables between its markers.

    Raises:
        KeptError: If it has no markers.
    """
    first, last = markers
    before, begin, rest = text.partition(first + "\n")
    _, end, after = rest.partition(last)
    if not begin or not end:
        raise KeptError(f"{file}: expected the lines {first} and {last}")
    return f"{before}{begin}\n{made}\n\n{end}{after}"


def write_summary(folder: Path = KEPT, page: Path = PAGE) -> Path:
    """Write the table of mean scores; return the page.

    Raises:
        KeptError: If kept results cannot be read, or the page has no markers.
        FileError: If the page cannot be written.
    """
    atomic_write_all({page: written(read_text(page), summary(folder), page, SUMMARY).encode()})
    return page


def write_page(folder: Path = KEPT, page: Path = RECORD) -> list[Path]:
    """Write the tables of all runs, and plots; return the files.

    Raises:
        KeptError: If something that is kept cannot be read, or the page has no markers.
        FileError: If something cannot be written.
    """
    images = page.parents[1] / "images"
    contents = {
        images / f"ablation_{series_of(own[0].name)}.png": png_of(series_plot(own) if what_of(own[0].name) else plot(own[0]))
        for own in grouped(kept_ablations(folder))
    }
    contents[page] = written(read_text(page), tables(folder), page).encode()
    for file in contents:
        with_folder(file)
    atomic_write_all(contents)
    return [page, *(file for file in contents if file != page)]


def _row(ablation: Ablation, own: Judged, found: Sequence[Judged]) -> list[str]:
    beside = _beside(own, found)
    worse = worse_than(own, beside, ablation.made["is_less_better"])
    untold = [other for other in beside if is_open(own, other, worse)]
    return [*_cells(ablation, own), _verdict(own, _named(worse, beside), _named(untold, beside))]


def _verdict(own: Judged, worse: str, untold: str) -> str:
    """Return what some students are worse than, and of which others that is open."""
    if not own.can_be_worse:
        return "open"
    return "; ".join(part for part in (worse, f"open: {untold}" if untold else "") if part) or "–"


def _cells(ablation: Ablation, own: Judged) -> list[str]:
    """Return type, place, seeds, score, its interval, held, control steps, change and whether it is flat."""
    row, change, paper = own.taught.row, own.trend, paper_samples(_task(ablation))
    place = ", ".join(part for part in own.taught.where if part)
    steps = _millions(row.samples) + (f" ({_percent(row.samples / paper, 2)} of the paper's)" if paper else "")
    moved = "–" if change is None else "{} ({} to {})".format(*map(_signed, change))
    flat = {True: "yes", False: "no", None: "–"}[own.is_flat]
    score = [f"{row.score:.3f}", _bounds(row.low, row.high), _percent(row.held)]
    return [f"`{row.type}`", place, f"{row.seeds}", *score, steps, moved, flat]


def _are_as_long(one: Row, other: Row) -> bool:
    """Return whether students of two runs learned for about as many control steps: else a slow one may just be early."""
    return abs(one.samples - other.samples) <= 0.1 * max(one.samples, other.samples)


def _yardsticks(ablation: Ablation, before: list[str], width: int) -> list[str]:
    """Return the rows of teacher and joints at rest, with so many cells between name and score."""
    lines = []
    for name, kept in (("teacher", ablation.teacher), ("joints at rest", ablation.rest)):
        if kept is not None:
            cells = [f"*{name}*", *before, f"{kept['score']:.3f}", _bounds(*kept["score_interval"]), _percent(kept["held"])]
            lines.append(_line([*cells, *[""] * (width - len(cells))]))
    return lines


def _conditions(runs: Sequence[Ablation]) -> str:
    """Return under which conditions students were taught, in one run, or in several alike but for overrides."""
    made, task = runs[0].made, _task(runs[0])
    simulations = [own for run in runs for own in run.made["simulations"].values()]
    devices = ", ".join(dict.fromkeys(device for own in simulations for device in own["devices"]))
    legs, envs = max(len(own["begun"]) for own in simulations), dict.fromkeys(f"{own['envs']:,}" for own in simulations)
    said = f"Task `{made['document']}`, teacher `{made['teacher']}`, on {devices}: {' and '.join(envs)} environments"
    said += f", {max(each.row.minutes for each in runs[0].taught):.1f} min" if len(runs) == 1 else ", one run per row"
    said += f" in {legs} legs" if legs > 1 else ""
    rates = simulations[0]["rates"]
    said += f", at rates of {' and then '.join(rates)}" if len(set(rates)) > 1 else ""
    said += f" for each of {len(made['resolutions'])} resolutions. " if len(made["resolutions"]) > 1 else ". "
    if alike := common_overrides(runs):
        said += "Overrides: " + ", ".join(f"`{name}={value}`" for name, value in alike.items()) + ". "
    spans = [span for run in runs for resolution in run.made["resolutions"] if (span := span_of(run, resolution)) is not None]
    if spans:
        low, high = min(spans), max(spans)
        bound = f"{FLAT * low:.3g}" if low == high else f"{FLAT * low:.3g} to {FLAT * high:.3g}"
        said += f"Flat: within ±{bound} over the last third. "
    else:
        said += "Without the scores of teacher and joints at rest, no curve is called flat. "
    paper = paper_samples(task)
    if paper is None:
        return said + "The paper does not have this task."
    iterations, steps = PAPER[task]
    return said + (
        f"The paper's students: {iterations:,} iterations of {steps} steps in {PAPER_ENVS:,} environments, "
        f"{_millions(paper)} control steps each."
    )


def _verdicts(found: Sequence[Judged], is_less_better: bool) -> str:
    """Return how many pairs are told apart, and what of placements, resolutions and noises."""
    flat = sum(bool(own.is_flat) for own in found)
    pairs = [(one, other) for i, one in enumerate(found) for other in _beside(one, found[i + 1 :])]
    apart = sum(bool(worse_than(a, [b], is_less_better) or worse_than(b, [a], is_less_better)) for a, b in pairs)
    said = [
        f"{flat} of {len(found)} curves are flat. The rule separates {apart} of {len(pairs)} pairs of types in the same place."
    ]
    for i, axis in enumerate(("placement", "resolution", "noise")):
        for one in found:
            others = [other for other in found if _differ_in(one, other) == [i]]
            for other in worse_than(one, others, is_less_better):
                rest = ", ".join(part for k, part in enumerate(one.taught.where) if part and k != i)
                names = (one.taught.where[i], other.taught.where[i])
                said.append(f"- `{one.taught.row.type}`, {rest}: {axis} {names[0]} is worse than {names[1]}.")
    head, *items = said
    return "\n\n".join([head, *(["\n".join(items)] if items else [])])


def _beside(one: Judged, found: Sequence[Judged]) -> list[Judged]:
    """Return other types in the same place; what feels nothing is in each place of its resolution."""

    def is_beside(other: Judged) -> bool:
        if NONE in (one.taught.row.type, other.taught.row.type):
            return one.taught.row.resolution == other.taught.row.resolution
        return one.taught.where == other.taught.where

    return [other for other in found if other.taught.row.type != one.taught.row.type and is_beside(other)]


def _differ_in(one: Judged, other: Judged) -> list[int]:
    """Return where two of one type differ: in placement, resolution or noise; nothing if types do, or they feel nothing."""
    if one.taught.row.type != other.taught.row.type or one.taught.row.type == NONE:
        return []
    return [i for i, (a, b) in enumerate(zip(one.taught.where, other.taught.where, strict=True)) if a != b]


def _named(worse: Sequence[Judged], beside: Sequence[Judged]) -> str:
    """Return types by name, with their places where not all of the type's are among them."""
    types: dict[str, list[Judged]] = {}
    for each in worse:
        types.setdefault(each.taught.row.type, []).append(each)
    names = []
    for name, own in types.items():
        is_everywhere = len(own) == sum(each.taught.row.type == name for each in beside)
        places = "; ".join(", ".join(part for part in each.taught.where if part) for each in own)
        names.append(f"`{name}`" if is_everywhere else f"`{name}` ({places})")
    return ", ".join(names)


def _task(ablation: Ablation) -> str:
    return next(iter(ablation.made["simulations"].values()))["task"]


def _bounds(low: float | None, high: float | None) -> str:
    is_known = low is not None and high is not None and math.isfinite(low) and math.isfinite(high)
    return f"{low:.3f} to {high:.3f}" if is_known else "–"


def _percent(share: float, digits: int = 1) -> str:
    return f"{100 * share:.{digits}f} %"


def _signed(value: float) -> str:
    return f"{round(value, 3) + 0.0:+.3f}"


def _millions(count: int) -> str:
    return f"{count / 1e6:,.0f} M" if count >= 1e8 else f"{count / 1e6:.3g} M"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
