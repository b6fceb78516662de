"""Draw what policies scored while they learned, by wall-clock and by samples, from the kept curves.

python benchmarks/training_curves.py [--out docs/images/training_curves.png]
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "docs" / "measured" / "train"
PANELS: dict[str, dict[str, str]] = {
    "in_palm_rotate, one cube: quarter turns in 10 s": {
        "cube/u3": "u3: four fingers, pyramidal",
        "cube/v2": "v2: elliptic, seed 2",
        "cube/v2_again": "v2 again",
        "cube/v3": "v3: elliptic, seed 3",
        "cube/v3_again": "v3 again",
        "cube/u2": "u2: elliptic, seed 1",
        "cube/u1": "u1: pyramidal",
        "cube/u4": "u4: pyramidal, more noise",
        "cube/t2": "t2: no floor of exploration",
    },
    "in_palm_rotate, randomised: quarter turns in 10 s": {"rotate/w": "w", "rotate/w_again": "w again"},
    "grip_force: RMS of force error over command": {"grip_force/x": "x", "grip_force/x_again": "x again"},
}
"""Titles, and the runs by file and label."""
WINDOW = 5
"""Rows of a curve that a point is the mean of."""


def curve(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return minutes, millions of samples and scores of a run."""
    with (KEPT / f"{name}.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["Episode/score"] not in ("", "nan")]
    seconds, samples, score = (np.array([float(row[key]) for row in rows]) for key in ("seconds", "samples", "Episode/score"))
    smooth = np.convolve(score, np.ones(WINDOW) / WINDOW, mode="valid")
    return seconds[WINDOW - 1 :] / 60, samples[WINDOW - 1 :] / 1e6, smooth


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
    """Draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "training_curves.png")
    options = parser.parse_args()
    figure = Figure(figsize=(10, 9), dpi=100)
    for (title, runs), pair in zip(PANELS.items(), figure.subplots(len(PANELS), 2), strict=True):
        by_time, by_samples = pair
        panel(by_time, by_samples, title, runs)
    figure.tight_layout()
    FigureCanvasAgg(figure).print_png(str(options.out))
    print(options.out)


if __name__ == "__main__":
    main()
