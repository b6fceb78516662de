"""The rows that `gpu.py` measures, their limits, the tables and the plots."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpu_scenes import CASES, KNOBS, MAIN, artefact, bytes_of

from tgdsl.module.artifact import load

CLOSE = 1e-5
"""Limit of the 99.9 % quantile of the errors, relative to full scale."""
FEWER_TIMES = 6.0
"""Required ratio of the rival's time to a row's."""
CLEAN_BYTES, NOISY_BYTES, ANCHOR_BYTES = 40.0, 120.0, 16.0
"""Limits of bytes per taxel and environment without and with noise, and per point that an elastomer tracks."""


@dataclass(frozen=True)
class Row:
    """A case at one number of environments: sizes, errors relative to full scale, median times [ms], bytes.

    Attributes:
        in_contact: Share of taxels with a nonzero reading.
        error: 99.9 % quantile of the errors; rounding may put the rest across a jump, such as a quantization step.
        error_largest: Largest error.
        graph: A call in a replayed CUDA graph.
        plain: A call from Python.
        replayed: A call from Python of a module compiled with `graph=True`.
        copy: A copy of `moved` bytes.
        sets: Sets of buffers in the graph.
        moved: Bytes that a call must move.
        per_taxel: Bytes of readings and state per taxel and environment, without ring and anchors.
        ring_per_taxel: Bytes of the delay's ring per taxel and environment.
        anchors_per_taxel: Bytes of an elastomer's anchors per taxel and environment.
        per_anchor: Bytes per anchor and environment.
        transient: Peak memory of a plain call [bytes]; None where it was not measured.
        seconds: Time of the whole measurement.
    """

    case: str
    kind: str
    noise: str
    num_envs: int
    num_taxels: int
    num_objects: int
    points: int
    in_contact: float
    error: float
    error_largest: float
    graph: float
    plain: float
    replayed: float
    copy: float
    sets: int
    moved: int
    per_taxel: float
    ring_per_taxel: float
    anchors_per_taxel: float
    per_anchor: float
    transient: int | None
    seconds: float

    @property
    def key(self) -> tuple[str, int]:
        """Case and number of environments."""
        return self.case, self.num_envs

    @property
    def rate(self) -> float:
        """Taxels read per second, by graph replay."""
        return 1e3 * self.num_envs * self.num_taxels / self.graph

    def line(self) -> str:
        """Return the row as text."""
        target = TARGETS.get(self.key, Target())
        limits = f"{column(target.limit)}{column(target.rival)}{judged(self, None).partition(':')[0]:>6}"
        peak = "" if self.transient is None else f"{self.transient / self.num_envs / self.num_taxels:9.1f}"
        return (
            f"{self.case:<30}{self.num_envs:>6} ×{self.num_taxels:>6}{self.in_contact:6.0%}{self.error:9.1e}"
            f"{self.error_largest:9.1e}{self.graph:9.4f}{self.plain:9.4f}{self.replayed:9.4f}{self.copy:9.4f}"
            f"{self.graph / self.copy:9.3g}{limits}"
            f"{1e-6 * self.moved:9.1f}{self.per_taxel:8.1f}{self.ring_per_taxel:8.1f}{peak}{self.seconds:7.1f} s"
        )


HEAD = (
    f"{'case':<30}{'envs':>6} ×{'taxels':>6}{'felt':>6}{'99.9 %':>9}{'largest':>9}{'graph':>9}{'plain':>9}"
    f"{'replayed':>9}{'copy':>9}{'ratio':>9}{'limit':>9}{'rival':>9}{'met':>6}{'MB':>9}{'B/taxel':>8}{'ring':>8}{'peak':>9}"
)


# Limits ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    """The limits of a row.

    Attributes:
        limit: Time of a call in a graph [ms].
        plain: Time of a call from Python [ms].
        rival: Time of an update of such a sensor in genesis-world 1.4.5 on an H200 [ms].
        times_clean: Time relative to the row "kinematic" of as many environments.
    """

    limit: float | None = None
    plain: float | None = None
    rival: float | None = None
    times_clean: float | None = None


TARGETS: dict[tuple[str, int], Target] = {
    ("depth", MAIN): Target(0.012, 0.08, 0.16),
    ("kinematic", MAIN): Target(0.03, 0.08, 0.41),
    ("kinematic-full", MAIN): Target(times_clean=3.0),
    ("kinematic-10-objects", MAIN): Target(0.15, rival=0.41),
    ("kinematic-5-sensors", MAIN): Target(0.14, rival=1.92),
    ("kinematic-1000-taxels", MAIN): Target(0.28),
    ("kinematic-1000-taxels", 20_480): Target(),
    ("kinematic-10000-taxels", 1_024): Target(0.12, rival=2.17),
    ("proximity", MAIN): Target(0.07, rival=0.48),
    ("force", MAIN): Target(0.10),
    ("elastomer-500-points", MAIN): Target(0.40, rival=2.58),
    ("elastomer-1000-points", MAIN): Target(0.7),
}
"""Limits, in the order of the table; a row without numbers must only run."""


def unmet(row: Row, clean: Row | None) -> list[str]:
    """Return the limits that a row exceeds, in words.

    Args:
        row: The row.
        clean: The row to which `times_clean` refers; None, where it was not measured, counts as exceeded.
    """
    target = TARGETS.get(row.key, Target())
    most_bytes = CLEAN_BYTES if row.noise == "clean" else NOISY_BYTES
    misses = {
        f"graph {row.graph:.5g} ms > {target.limit} ms": target.limit is not None and row.graph > target.limit,
        f"from Python {row.replayed:.4g} ms > {target.plain} ms": target.plain is not None and row.replayed > target.plain,
        f"{row.per_taxel:.1f} B per taxel > {most_bytes:g} B": row.per_taxel > most_bytes,
        f"{row.per_anchor:.1f} B per tracked point > {ANCHOR_BYTES:g} B": row.per_anchor > ANCHOR_BYTES,
        f"error {row.error:.1e} > {CLOSE:.0e}": row.error > CLOSE,
    }
    if target.rival is not None:
        less = target.rival / row.graph
        misses[f"{less:.1f} times less than the rival's, not {FEWER_TIMES:g}"] = less < FEWER_TIMES
    if target.times_clean is not None:
        ratio = None if clean is None else row.graph / clean.graph
        reason = "clean not measured" if ratio is None else f"{ratio:.2f} × clean > {target.times_clean:g} ×"
        misses[reason] = ratio is None or ratio > target.times_clean
    return [reason for reason, is_missed in misses.items() if is_missed]


def judged(row: Row, clean: Row | None) -> str:
    """Return "yes", or "no" and the reasons; a dash where there is no limit, or no clean row to compare with."""
    target = TARGETS.get(row.key)
    if target is not None and target.times_clean is not None and clean is None:
        return "–"
    missed = unmet(row, clean)
    if missed:
        return f"no: {'; '.join(missed)}"
    return "–" if target is None else "yes"


def load_rows(paths: Iterable[Path]) -> list[Row]:
    """Return the rows of JSON files; a later row replaces an earlier one of the same measurement."""
    rows = (Row(**fields) for path in paths for fields in json.loads(path.read_text())["rows"])
    return list({row.key: row for row in rows}.values())


# Tables ---------------------------------------------------------------------------------------------------------------------


def column(value: float | None) -> str:
    """Return a number as text, nine characters wide."""
    return f"{'–':>9}" if value is None else f"{value:9.4g}"


def limits_table(rows: list[Row]) -> list[str]:
    """Return the rows that have limits, as Markdown."""
    by_key = {row.key: row for row in rows}
    times = "graph, ms | limit, ms | met | plain, ms | replayed, ms"
    lines = [
        f"| case | envs × taxels | error (largest) | {times} | MB moved | ratio to copy | rival, ms | times less |",
        f"|{'---|' * 12}",
    ]
    for key, target in TARGETS.items():
        if key not in by_key:
            lines.append(f"| {key[0]} | {key[1]:,} × | not measured |{' |' * 9}")
            continue
        row, clean = by_key[key], by_key.get(("kinematic", key[1]))
        limit = f"{target.times_clean:g} × clean" if target.times_clean is not None else "–"
        limit = f"{target.limit:g}" if target.limit is not None else limit
        rival = "– | –" if target.rival is None else f"{target.rival:g} | {target.rival / row.graph:.1f}"
        lines.append(
            f"| {row.case} | {row.num_envs:,} × {row.num_taxels:,} | {row.error:.0e} ({row.error_largest:.0e}) "
            f"| {row.graph:.4f} | {limit} | {judged(row, clean)} | {row.plain:.3f} | {row.replayed:.3f} "
            f"| {1e-6 * row.moved:.1f} | {row.graph / row.copy:.2f} | {rival} |"
        )
    return lines


def others_table(rows: list[Row]) -> list[str]:
    """Return the other rows, which have limits of error and bytes alone, as Markdown."""
    heads = "graph, ms | plain, ms | replayed, ms | MB moved | ratio to copy | bytes held | at once | not met"
    lines = [f"| case | envs × taxels | error (largest) | {heads} |", f"|{'---|' * 11}"]
    for row in (row for row in rows if row.key not in TARGETS):
        at_once = "–" if row.transient is None else f"{row.transient / row.num_envs / row.num_taxels:.1f}"
        lines.append(
            f"| {row.case} | {row.num_envs:,} × {row.num_taxels:,} | {row.error:.0e} ({row.error_largest:.0e}) "
            f"| {row.graph:.4f} | {row.plain:.3f} | {row.replayed:.3f} | {1e-6 * row.moved:.1f} | {row.graph / row.copy:.2f} "
            f"| {row.per_taxel:.1f} | {at_once} | {'; '.join(unmet(row, None))} |"
        )
    return lines


def table(options: argparse.Namespace) -> None:
    """Print the results as Markdown."""
    for path in options.results:
        results = json.loads(path.read_text())
        print(f"{results['device']}, torch {results['torch']}, float32, medians of up to {results['repeats']}")
    rows = load_rows(options.results)
    print("", *limits_table(rows), "", *others_table(rows), sep="\n")


def bytes_table(options: argparse.Namespace) -> None:
    """Print the bytes of readings and state of every case, per taxel and environment, as Markdown."""
    print(f"| case | readings | state | in all | delay's ring | per tracked point | moved per call |\n|{'---|' * 7}")
    for case in CASES.values():
        path = artefact(options.folder, case)
        if path.exists():
            size = bytes_of(load(path))
            parts = (size.outputs, size.state, size.outputs + size.state)
            per = " | ".join(f"{value / size.num_taxels:.1f}" for value in parts)
            ring = f"{size.ring_calls} × {size.ring_entry / size.num_taxels:.1f}" if size.ring_calls else "–"
            anchor = f"{size.per_anchor:.0f}" if size.num_anchors else "–"
            print(f"| {case.name} | {per} | {ring} | {anchor} | {size.moved / size.num_taxels:.1f} |")


# Plots ----------------------------------------------------------------------------------------------------------------------

COLOURS = ("#1b7f4d", "#3b6fb6", "#b5542c", "#e0a03a", "#7a4fa3", "#c2315b", "#2b2f36", "#5aa7a7")
RIVALS = {  # on the same GPU and scene: environments, taxels, ms
    "contact_depth": (16_384, 100, 0.16),
    "kinematic_taxel": (16_384, 100, 0.41),
    "proximity": (16_384, 100, 0.48),
    "elastomer": (16_384, 100, 2.58),
}
WIDE_RIVAL = (1_024, 10_000, 2.17)
RIVAL_BYTES = 400.0
"""Approximate bytes that the rival holds per taxel and environment."""
Curves = dict[str, list[Row]]


def _by_envs(rows: list[Row]) -> Curves:
    names = [name for name, case in CASES.items() if len(case.envs) > 2 and case.num_taxels == 100]
    return {name: sorted((row for row in rows if row.case == name), key=lambda row: row.num_envs) for name in names}


def _by_taxels(rows: list[Row]) -> Curves:
    rows = [r for r in rows if r.kind == "kinematic_taxel" and r.num_envs == 1_024 and r.num_objects == 1]
    return {
        f"kinematic, {noise}": sorted((r for r in rows if r.noise == noise), key=lambda row: row.num_taxels)
        for noise in ("clean", "noisy")
    }


def _by_objects(rows: list[Row]) -> Curves:
    rows = [r for r in rows if r.kind == "kinematic_taxel" and r.noise == "clean" and r.num_envs == MAIN]
    return {"kinematic, clean": sorted((r for r in rows if r.num_taxels == 100), key=lambda row: row.num_objects)}


def _by_points(rows: list[Row]) -> Curves:
    rows = sorted((r for r in rows if r.points and r.noise == "clean" and r.num_envs == 1_024), key=lambda row: row.points)
    return {kind: [row for row in rows if row.kind == kind] for kind in ("elastomer", "proximity")}


def throughput(rows: list[Row]) -> Any:
    """Return the figure of taxels read per second, by environments, taxels, objects and points; crosses are the rival's."""
    from matplotlib.figure import Figure

    panels: list[tuple[str, Curves, Callable[[Row], int]]] = [
        ("environments", _by_envs(rows), lambda row: row.num_envs),
        ("taxels, 1,024 environments", _by_taxels(rows), lambda row: row.num_taxels),
        ("felt objects, 16,384 environments", _by_objects(rows), lambda row: row.num_objects),
        ("points of each object, 1,024 environments", _by_points(rows), lambda row: row.points),
    ]
    figure = Figure(figsize=(12, 9), layout="constrained")
    for axes, (label, curves, size_of) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        for (name, curve), colour in zip(curves.items(), COLOURS, strict=False):
            axes.plot([size_of(r) for r in curve], [r.rate for r in curve], "o-", color=colour, markersize=4, label=name)
            rival = RIVALS.get(curve[0].kind) if curve and label == "environments" and curve[0].noise == "clean" else None
            if rival is not None:
                axes.plot(rival[0], 1e3 * rival[0] * rival[1] / rival[2], "x", color=colour, markersize=8)
        if label.startswith("taxels") and any(curves.values()):
            axes.plot(WIDE_RIVAL[1], 1e3 * WIDE_RIVAL[0] * WIDE_RIVAL[1] / WIDE_RIVAL[2], "kx", markersize=8, label="rival")
        scale = "log" if any(curves.values()) else "linear"
        axes.set(xscale=scale, yscale=scale, xlabel=label, ylabel="taxels read per second")
        axes.grid(alpha=0.25, which="both")
        if any(curves.values()):
            sizes = sorted({size_of(row) for curve in curves.values() for row in curve})
            axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
            axes.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
            axes.legend(frameon=False, fontsize=8.5, **({"loc": "lower right", "ncols": 3} if len(curves) > 3 else {}))
        if len(curves) > 3:
            axes.set_ylim(bottom=axes.get_ylim()[0] / 3)  # room for the names
    return figure


def memory(rows: list[Row]) -> Any:
    """Return the figure of bytes per taxel and environment, and of the relative time of noise."""
    from matplotlib.figure import Figure

    main = {row.case: row for row in rows if row.num_envs == MAIN and row.num_taxels == 100}
    names = [name for name, row in main.items() if row.noise in ("clean", "noisy", "full") and row.num_objects == 1]
    figure = Figure(figsize=(12, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    starts = [0.0] * len(names)
    for part, label, colour in (
        ("per_taxel", "readings and state", COLOURS[1]),
        ("anchors_per_taxel", "an elastomer's tracked points", COLOURS[0]),
        ("ring_per_taxel", "the delay's ring", COLOURS[3]),
    ):
        sizes = [getattr(main[name], part) for name in names]
        left.barh(names, sizes, left=starts, color=colour, label=label)
        starts = [start + size for start, size in zip(starts, sizes, strict=True)]
    left.axvline(RIVAL_BYTES, color="#888", linestyle="--", label="rival, about")
    left.set(xlabel="bytes per taxel and environment", xlim=(0, 1.05 * RIVAL_BYTES))
    if "kinematic" in main:
        terms = [name for name in ("kinematic-noisy", "kinematic-full", *(f"kinematic-{k}" for k in KNOBS)) if name in main]
        shares = [main[name].graph / main["kinematic"].graph for name in terms]
        right.barh([name.removeprefix("kinematic-") for name in terms], shares, color=COLOURS[0])
    right.axvline(1, color="#888")
    right.set(xlabel="kinematic_taxel: time over that of clean, 16,384 environments")
    for axes in (left, right):
        axes.invert_yaxis()
        axes.grid(alpha=0.25, axis="x")
    left.legend(frameon=False, fontsize=8.5)
    return figure


def plot(options: argparse.Namespace) -> None:
    """Draw the results."""
    rows = load_rows(options.results)
    options.out.mkdir(parents=True, exist_ok=True)
    for name, draw in {"gpu_throughput": throughput, "gpu_memory": memory}.items():
        draw(rows).savefig(options.out / f"{name}.png", dpi=110)
        print(options.out / f"{name}.png")


def add_commands(commands: Any) -> None:
    """Add `table`, `plot` and `bytes` to a command line."""
    for name, call in {"table": table, "plot": plot}.items():
        command = commands.add_parser(name, help=str(call.__doc__))
        command.add_argument("results", type=Path, nargs="+", help="JSON files of `run`")
        command.set_defaults(call=call)
        if name == "plot":
            command.add_argument("--out", type=Path, default=Path("docs/images"), help="folder for the images")
    command = commands.add_parser("bytes", help=str(bytes_table.__doc__))
    command.add_argument("folder", type=Path)
    command.set_defaults(call=bytes_table)
