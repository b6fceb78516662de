"""Write a layout with evenly spread taxels of a task's touch, to compare with taxels that gates choose.

    python benchmarks/uniform_taxels.py examples/tasks/in_palm_rotate.yaml --taxels 40 -o examples/tasks/layout_40.yaml

Taxels are chosen one by one, each the farthest from those before it in the hand's initial pose; the first is the one nearest to
the mean of all. Teach students with the layout as docs/how-to/distil.md describes for `tgdsl layout from-gates`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from tgdsl.files.write import atomic_write_all
from tgdsl.placement.freeze import frozen_files
from tgdsl.rl.load import load_task
from tgdsl.rl.sensors import GROUP, compile_sensors
from tgdsl.rl.students.results import reduced_layout
from tgdsl.scene.scene import scene_model
from tgdsl.view.cameras import pose_of
from tgdsl.view.markers import taxels_of


def farthest(points: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, " count"]:
    """Return the rows of farthest-point sampling, in the order in which they are chosen."""
    rows = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())]
    distance = np.full(len(points), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, np.linalg.norm(points - points[rows[-1]], axis=1))
        rows.append(int(distance.argmax()))
    return np.array(rows)


def main() -> None:
    """Write the layout."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", type=Path)
    parser.add_argument("--placement", default="hand", help="group of links whose taxels are chosen from")
    parser.add_argument("--resolution", default="med")
    parser.add_argument("--taxels", type=int, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    loaded = load_task(options.task, {"touch": "depth", "placement": options.placement, "resolution": options.resolution})
    sensors = compile_sensors(loaded, "cpu")
    model = scene_model(sensors.touch.plan.scene)
    points = taxels_of(model, pose_of(model, None), sensors.groups[GROUP].layout).pos
    if not 0 < options.taxels <= len(points):
        parser.error(f"--taxels {options.taxels}: expected 1 to {len(points)}")
    rows = farthest(points, options.taxels)
    spec, layouts = reduced_layout(loaded, sensors, rows)
    files = frozen_files(spec, layouts, options.out, f"{options.taxels} evenly spread taxels of {options.task.name}")
    atomic_write_all(files)
    print(*files, sep="\n")


if __name__ == "__main__":
    main()
