"""Draw the scores of policies while they learned by wall-clock time and by samples, from docs/measured/train.

python benchmarks/training_curves.py [--out docs/images/training_curves.png]          # draw
python benchmarks/training_curves.py --keep out/screwdriver --name screwdriver/s1    # first store a run's curve

A run's curve.csv is stored in at most `ROWS` rows: means over equal numbers of iterations; episodes' values are means over
episodes.
"""

from __future__ import annotations

import argparse
import csv
import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_write, with_folder

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "docs" / "measured" / "train"
PANELS: dict[str, dict[str, str]] = {
    "in_palm_rotate, one cube: quarter turns in 10 s": {
        "cube/u3": "u3: four fingers, pyramidal",
        "cube/c1": "c1: elliptic, condim 4, seed 1",
        "cube/c2": "c2: elliptic, condim 4, seed 2",
        "cube/v2": "v2: elliptic, seed 2",
        "cube/v2_again": "v2 again",
        "cube/v3": "v3: elliptic, seed 3",
        "cube/v3_again": "v3 again",
        "cube/u2": "u2: elliptic, seed 1",
        "cube/u1": "u1: pyramidal",
        "cube/u4": "u4: pyramidal, more noise",
        "cube/t2": "t2: no floor of exploration",
    },
    "in_palm_rotate, one cube, by touch alone or the other way: quarter turns in 10 s": {
        "cube/touch": "touch, beside three other runs",
        "cube/clockwise": "clockwise, seed 3",
        "cube/clockwise_2": "clockwise, seed 2, beside three other runs",
    },
    "in_palm_rotate, randomised: quarter turns in 10 s": {
        "rotate/y": "y: 8,192 environments, later a drop costs four times as much",
        "rotate/y_drop4000": "y goes on, a drop costs forty times as much",
        "rotate/y_drop1000": "y goes on, ten times; object_distance five times",
        "rotate/w": "w",
        "rotate/w_again": "w again",
    },
    "screwdriver: rad/s while upright": {"screwdriver/s1": "s1", "screwdriver/held": "held, weak drives: the last stage"},
    "in_hand_repose: goals in a row": {"repose/r1": "r1", "repose/xy": "about x and y: by 20°, 35°, then 45°"},
    "grip_force: RMS of force error over command": {"grip_force/x": "x", "grip_force/x_again": "x again"},
}
"""Titles of the panels, and files and labels of their runs."""
ROWS = 64
"""Largest number of rows of a stored curve."""
COLUMNS = ("iteration", "samples", "seconds", "Episode/return", "Episode/score", "Episode/dropped", "Reward/spin",
           "Policy/mean_std", "Loss/learning_rate", "Loss/rnd", "rollout", "update")  # fmt: skip
"""Stored columns, where a run has them."""
WINDOW = 5
"""Rows of a curve whose mean is drawn as a point."""


def curve(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return minutes, millions of samples and scores of a run."""
    with (KEPT / f"{name}.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["Episode/score"] not in ("", "nan")]
    seconds, samples, score = (np.array([float(row[key]) for row in rows]) for key in ("seconds", "samples", "Episode/score"))
    window = min(WINDOW, len(score))
    smooth = np.convolve(score, np.ones(window) / window, mode="valid")
    return seconds[window - 1 :] / 60, samples[window - 1 :] / 1e6, smooth


def keep(run: Path, name: str) -> Path:
    """Store a thinned copy of a run's curve; return its file.

    Raises:
        OSError: If there is no curve; nothing is written.
        TgdslError: If a column is missing; nothing is written.
    """
    file = run / "curve.csv"
    with file.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    if missing := sorted({"iteration", "samples", "seconds", "episodes"} - rows[0].keys()):
        raise TgdslError(f"{file}: there is no column {missing[0]}: this is not what tgdsl train writes")
    names, size = [column for column in COLUMNS if column in rows[0]], -(-len(rows) // ROWS)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for first in range(0, len(rows), size):
        writer.writerow([_mean(rows[first : first + size], column) for column in names])
    stored = with_folder(KEPT / f"{name}.csv")
    atomic_write(stored, text.getvalue().encode())
    return stored


def _mean(rows: list[dict[str, str]], column: str) -> str:
    """Return a column's mean, for values of episodes over episodes; for counters the last row's value."""
    if column in ("iteration", "samples", "seconds"):
        return f"{float(rows[-1][column]):.5g}" if column != "iteration" else rows[-1][column]
    weights = [float(row["episodes"]) if column.startswith(("Episode/", "Reward/")) else 1.0 for row in rows]
    pairs = [(float(row[column]), weight) for row, weight in zip(rows, weights, strict=True) if row[column] and weight]
    return f"{sum(value * weight for value, weight in pairs) / sum(weight for _, weight in pairs):.5g}" if pairs else ""


def panel(by_time: Axes, by_samples: Axes, title: str, runs: dict[str, str]) -> None:
    """Draw a task's runs."""
    for name, label in runs.items():
        minutes, millions, score = curve(name)
        by_time.plot(minutes, score, linewidth=1.2, label=label)
        by_samples.plot(millions, score, linewidth=1.2)
    by_time.set_title(title, fontsize=9, loc="left")
    by_time.set_xlabel("minutes of learning")
    by_samples.set_xlabel("million control steps")
    by_time.legend(fontsize=7, frameon=False)
    for axes in (by_time, by_samples):
        axes.grid(True, color="#e3e5e8", linewidth=0.6)
        axes.set_ylim(bottom=0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="folder of a run whose curve is stored")
    parser.add_argument("--name", metavar="TASK/NAME", help="name of the stored curve")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "training_curves.png")
    options = parser.parse_args()
    if (options.keep is None) != (options.name is None):
        parser.error("--keep and --name go together")
    if options.keep is not None:
        try:
            print(keep(options.keep, options.name))
        except (OSError, TgdslError) as error:
            parser.error(str(error))
    figure = Figure(figsize=(10, 3 * len(PANELS)), dpi=100)
    for (title, runs), (by_time, by_samples) in zip(PANELS.items(), figure.subplots(len(PANELS), 2), strict=True):
        panel(by_time, by_samples, title, runs)
    figure.tight_layout()
    FigureCanvasAgg(figure).print_png(str(options.out))
    print(options.out)


if __name__ == "__main__":
    main()
