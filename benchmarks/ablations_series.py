"""Runs that differ in their documents' overrides alone, as in the networks of students, side by side.

They are kept as SERIES__WHAT, such as `cube_encoders__lstm` and `cube_encoders__cnn`, and have one table and one plot in
docs/records/ablations.md.
"""

from __future__ import annotations

from collections.abc import Sequence

from ablations_kept import Ablation, KeptError
from ablations_plots import draw, draw_yardsticks, score_label
from matplotlib import colormaps
from matplotlib.figure import Figure

BETWEEN = "__"
ALIKE = ("document", "teacher", "unit", "is_less_better")
"""What of `distill.json` the runs of a series have in common."""


def series_of(name: str) -> str:
    """Return the name of the series that an ablation is of, its own if of none."""
    return name.partition(BETWEEN)[0]


def what_of(name: str) -> str:
    """Return what an ablation is in its series."""
    return name.partition(BETWEEN)[2]


def grouped(ablations: Sequence[Ablation]) -> list[list[Ablation]]:
    """Return ablations by series, each of no series alone.

    Raises:
        KeptError: If runs of a series are of unlike documents or teachers, or one is called as the series is.
    """
    found: dict[str, list[Ablation]] = {}
    for each in ablations:
        found.setdefault(series_of(each.name), []).append(each)
    for own in found.values():
        if len(own) > 1 and not all(what_of(each.name) for each in own):
            raise KeptError(f"{own[0].name}: a series of runs has that name too: {own[1].name}")
        for each in own[1:]:
            unlike = [name for name in ALIKE if each.made[name] != own[0].made[name]]
            if unlike:
                what = f'{unlike[0]} "{each.made[unlike[0]]}", expected "{own[0].made[unlike[0]]}"'
                raise KeptError(f"{each.name}: {what}, as {own[0].name} has it: they are of one series")
    return list(found.values())


def common_overrides(runs: Sequence[Ablation]) -> dict[str, str]:
    """Return the overrides that all runs have alike."""
    first, *others = (each.made["overrides"] for each in runs)
    return {name: value for name, value in first.items() if all(own.get(name) == value for own in others)}


def own_overrides(run: Ablation, runs: Sequence[Ablation]) -> dict[str, str]:
    """Return the overrides that a run does not have in common with the others."""
    alike = common_overrides(runs)
    return {name: value for name, value in run.made["overrides"].items() if name not in alike}


def series_plot(runs: Sequence[Ablation]) -> Figure:
    """Return the plot of a series: scores over control steps of each student, mean and range of the seeds."""
    figure = Figure(figsize=(5.7, 3.4), dpi=100, layout="constrained")
    axes = figure.subplots()
    lines = [(run, each) for run in runs for each in run.taught]
    for i, (run, each) in enumerate(lines):
        label = ", ".join((what_of(run.name), *([each.row.type, *each.where] if len(run.taught) > 1 else ())))
        draw(axes, run, each, colormaps["tab10"](i % 10), label)
    draw_yardsticks(axes, runs[0])
    axes.set_ylabel(score_label(runs[0]))
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    return figure
