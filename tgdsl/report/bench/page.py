"""A bench as CSV, JSON, and one HTML file that opens without a network: tables, and plots of speed against error."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from tgdsl.console.tables import text_table
from tgdsl.module.accuracy.errors import Interval
from tgdsl.report.bench.results import Measured, Report, Subject, rows_of
from tgdsl.report.files import page_of, svg_of, table_of, write_report_files
from tgdsl.view.style import FAINT, INK

FLOOR = 1e-9  # errors below this are drawn here: an axis of powers of ten has no zero
OWN, FRONT = "#c0392b", "#1f6f8b"


def write_bench(report: Report, folder: Path) -> list[Path]:
    """Write the files of a bench, all or none, and return them.

    Raises:
        FileError: If one cannot be written.
    """
    rows = list(rows_of(report))
    subjects = [{key: value for key, value in asdict(subject).items() if key != "points"} for subject in report.subjects]
    document = {"document": report.document, "machine": report.machine, "states": report.states}
    return write_report_files(folder, "bench", rows, {**document, "rows": rows, "subjects": subjects}, page(report))


def page(report: Report) -> str:
    """Return the HTML file of a bench."""
    about = [
        f'<p class="note">{escape(report.states)}.<br>{escape(report.machine)}.</p>',
        "<p>● on the front: nothing else is better in time or error and worse in neither; where 95 % intervals overlap, "
        "two count as equal. Red: what the compiler takes now. Errors: relative to the largest change of a quantity; those "
        f"below {FLOOR:g} are drawn there.</p>",
    ]
    links = [(subject.name, subject.name) for subject in report.subjects]
    sections = [_section(subject, i) for i, subject in enumerate(report.subjects)]
    return page_of(f"{report.document}: speed against error", about, links, sections)


def bench_text(report: Report) -> str:
    """Return the printed text of a bench."""
    parts = [f"{report.document}: {report.states}\n{report.machine}"]
    for subject in report.subjects:
        header, *rows = cells_of(subject)
        marks = [("now" if p.is_own else "") + (" ●" if p.is_on_front else "") for p in subject.points]
        table = text_table((*header, ""), [(*row, mark.strip()) for row, mark in zip(rows, marks, strict=True)])
        lines = [f"{subject.name} ({subject.kind}), against {subject.reference}", subject.check, *subject.chosen, table]
        lines += [f"not available: {label}: {why}" for label, why in subject.left_out]
        parts.append("\n".join(filter(None, lines)))
    parts.append("now: what the compiler takes; ●: on the front of time and RMS error, overlapping intervals being equal")
    return "\n\n".join(parts)


def _section(subject: Subject, index: int) -> str:
    scales = ", ".join(f"{name} {scale}" for name, scale in subject.magnitudes.items())
    header, *rows = cells_of(subject)
    lines = [
        f'<section id="{escape(subject.name)}"><h2>{escape(subject.name)} <small>{escape(subject.kind)}</small></h2>',
        f"<p>Errors are against: {escape(subject.reference)}. Magnitudes: {escape(scales)}. {escape(subject.check)}</p>",
        *([f'<p class="chosen">{"<br>".join(map(escape, subject.chosen))}</p>'] if subject.chosen else []),
        plot(subject, f"tgdsl{index}"),
        table_of(header, rows, map(_classes, subject.points)),
    ]
    lines += [f'<p class="note">not available: {escape(label)}: {escape(why)}</p>' for label, why in subject.left_out]
    return "\n".join([*lines, "</section>"])


def _classes(point: Measured) -> str:
    return " ".join(name for name, is_on in (("own", point.is_own), ("front", point.is_on_front)) if is_on)


def cells_of(subject: Subject) -> Iterator[tuple[str, ...]]:
    """Yield the header and a row for each variant, for people to read."""
    current = subject.own
    times = tuple(f"ms, {num} envs" for num in current.times)
    costs = ("operations", "constants", "state", "output")
    yield ("variant", "precision", "RMS error", "99 % within", "largest", "RMS, verified", *times, "× now", *costs)
    for point in subject.points:
        spans = tuple(_span(interval, 1e3, ".3g") for interval in point.times.values())
        cost = (point.cost.constants, point.cost.state, point.cost.output)
        operations = "–" if point.cost.operations is None else f"{point.cost.operations}"
        yield (
            point.label,
            point.precision,
            _span(point.chosen.rms, 1.0, ".1e"),
            f"{point.chosen.p99:.1e}",
            f"{point.chosen.largest.value:.1e}" if point.chosen.is_finite and point.verified.is_finite else "not finite",
            f"{point.verified.rms.value:.1e}",
            *spans,
            f"{point.time.value / current.time.value:.2f}",
            operations,
            *map(_bytes, cost),
        )


def _span(interval: Interval, factor: float, form: str) -> str:
    value, low, high = (f"{factor * part:{form}}" for part in interval)
    return f"{value} [{low}, {high}]"


def _bytes(size: int) -> str:
    return f"{size / 2**20:.1f} MiB" if size >= 2**20 else f"{size / 2**10:.1f} KiB" if size >= 2**10 else f"{size} B"


def plot(subject: Subject, salt: str) -> str:
    """Return a plot of time against RMS error as SVG: see `svg_of`."""
    figure = Figure(figsize=(9.5, 4.2))
    axes = figure.add_subplot()
    axes.set_xscale("log")
    axes.set_yscale("log")
    for point in subject.points:
        _draw(axes, point)
    for formatted in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        formatted(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel(f"time of a call, {max(subject.points[0].times)} environments [ms]")
    axes.set_ylabel("RMS error, of the magnitude")
    axes.grid(True, which="major", color="#e3e5e8", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.margins(0.12)
    figure.tight_layout()
    _label(axes, subject.points)
    return svg_of(figure, salt)


def _draw(axes: Axes, point: Measured) -> None:
    times, errors = ([factor * part for part in interval] for factor, interval in ((1e3, point.time), (1.0, point.chosen.rms)))
    x, (y, low, high) = times, (max(part, FLOOR) for part in errors)
    color = OWN if point.is_own else FRONT if point.is_on_front else FAINT
    is_marked = point.is_own or point.is_on_front
    axes.errorbar(
        x[0],
        y,
        xerr=[[max(x[0] - x[1], 0.0)], [max(x[2] - x[0], 0.0)]],
        yerr=[[max(y - low, 0.0)], [max(high - y, 0.0)]],
        fmt="o" if point.is_on_front else "s",
        color=color,
        markersize=7 if is_marked else 5,
        elinewidth=0.9,
    )


def _label(axes: Axes, points: Sequence[Measured]) -> None:
    """Label each point without overlap: to its right or left, and further up or down."""
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    renderer, taken = FigureCanvasAgg(figure).get_renderer(), []
    sides = [(x, step) for step in (5, -11, 16, -22, 27, -33, 38, -44, 49) for x in (6, -6)]
    for point in sorted(points, key=lambda point: not point.is_own):
        label = f"{point.label}, {point.precision}" + (" (now)" if point.is_own else "")
        at = (1e3 * point.time.value, max(point.chosen.rms.value, FLOOR))
        text = axes.annotate(label, at, textcoords="offset points", xytext=sides[0], fontsize=7.5, color=INK)
        for x, y in sides:
            text.set_position((x, y))
            text.set_horizontalalignment("left" if x > 0 else "right")
            box = text.get_window_extent(renderer)
            if axes.bbox.containsx(box.x0) and axes.bbox.containsx(box.x1) and not any(box.overlaps(label) for label in taken):
                break
        taken.append(text.get_window_extent(renderer))
