"""Measure learning: control steps per second, times of rollout and update, and the time until a policy reaches a score.

    python benchmarks/train.py speed --out out/speed.csv                                  # both cones, RND off and on
    tgdsl train examples/tasks/in_palm_rotate.yaml --set "randomise={}" --minutes 5 --seed 1 --out out/rotate_1
    python benchmarks/train.py curve out/rotate_1 out/rotate_2 out/rotate_3

`speed` prints medians of iterations after a warm-up. `curve` prints when each run's score first reached a bound, in radians per
second where the score is quarter turns; times are wall-clock times of the run, with everything that it writes.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import statistics
from pathlib import Path
from typing import Any

import torch

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.train.learner import Learner

TASK = Path(__file__).parents[1] / "examples" / "tasks" / "in_palm_rotate.yaml"
WARM = 3
"""Iterations before timing, which load kernels and capture graphs."""
BINS = (0.5, 1.0, 1.5, 2.0)
"""Bounds of the angular velocity [rad/s]."""


def speed(options: argparse.Namespace) -> None:
    rows = [row for cone in options.cones for row in _speeds(options, cone)]
    names = list(rows[0])
    print(" | ".join(names))
    for row in rows:
        print(" | ".join(str(row[name]) for name in names))
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        with options.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, names, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def _speeds(options: argparse.Namespace, cone: str) -> list[dict[str, Any]]:
    """Return the rows with RND off and on."""
    overrides = {"physics.cone": cone, **dict(pair.split("=", 1) for pair in options.set)}
    document = load_task(options.task, overrides)
    env = TouchEnv(document, options.envs, device=options.device)
    taxels = sum(len(table) for table in env.touch.taxels.values())
    rows = []
    for has_rnd in (False, True):
        is_unchanged = has_rnd == (document.spec.train.rnd != "off")  # keeps the document's numbers
        loaded = document if is_unchanged else load_task(options.task, {**overrides, "train.rnd": "{}" if has_rnd else "off"})
        learner = Learner(env, loaded, seed=0)
        for _ in range(WARM):
            learner.iterate()
        times = [learner.iterate() for _ in range(options.iterations)]
        rollout, update = (statistics.median(getattr(t, part) for t in times) for part in ("rollout", "update"))
        whole = statistics.median(t.rollout + t.update for t in times)
        steps = env.num_envs * loaded.spec.train.steps
        peak = torch.cuda.max_memory_allocated() / 2**30 if env.device.type == "cuda" else math.nan
        rows.append(
            {
                "cone": cone,
                "rnd": "on" if has_rnd else "off",
                "envs": env.num_envs,
                "taxels": taxels,
                "steps_per_second": f"{steps / whole:,.0f}".replace(",", "_"),
                "rollout_ms": f"{1e3 * rollout:.1f}",
                "update_ms": f"{1e3 * update:.1f}",
                "gpu_gib": f"{peak:.1f}",
            }
        )
        print(rows[-1], flush=True)
    env.close()
    return rows


def curve(options: argparse.Namespace) -> None:
    runs = {folder.name: _read(folder) for folder in options.folders}
    print("run | " + " | ".join(f"min to {bound} rad/s" for bound in BINS) + " | best | last | minutes | M samples | evaluated")
    reached = []
    for name, (rows, evaluation) in runs.items():
        first = [next((minutes for minutes, rate, _ in rows if rate >= bound), math.inf) for bound in BINS]
        reached.append(first[-1])
        best, (minutes, last, samples) = max(rate for _, rate, _ in rows), rows[-1]
        times = " | ".join("–" if math.isinf(value) else f"{value:.2f}" for value in first)
        print(f"{name} | {times} | {best:.2f} | {last:.2f} | {minutes:.2f} | {samples / 1e6:.0f} | {evaluation}")
    print(f"median over {len(runs)} runs of the time to {BINS[-1]} rad/s: {statistics.median(reached):.2f} min")


def _read(folder: Path) -> tuple[list[tuple[float, float, float]], str]:
    """Return minutes, smoothed angular velocity [rad/s] and samples of iterations with episodes; and the evaluation as text."""
    last = json.loads((folder / "run.json").read_text())["starts"][-1]["spec"]
    scale = 0.5 * math.pi / last["episode"] if last["task"] == "in_palm_rotate" else 1.0
    rows, smooth = [], None
    with (folder / "curve.csv").open() as file:
        for row in csv.DictReader(file):
            if row["Episode/score"] != "nan":
                score = scale * float(row["Episode/score"])
                smooth = score if smooth is None else 0.8 * smooth + 0.2 * score
                rows.append((float(row["seconds"]) / 60.0, smooth, float(row["samples"])))
    file = folder / "evaluation.json"
    if not file.is_file():
        return rows, "–"
    evaluation = json.loads(file.read_text())
    bounds = " to ".join("–" if bound is None else f"{scale * bound:.2f}" for bound in evaluation["score_interval"])
    return rows, f"{scale * evaluation['score']:.2f} ({bounds}) rad/s, {evaluation['held']:.1%} held"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("speed")
    command.add_argument("task", type=Path, nargs="?", default=TASK)
    command.add_argument("--envs", type=int, default=8192)
    command.add_argument("--device", default="cuda")
    command.add_argument("--iterations", type=int, default=10)
    command.add_argument("--cones", nargs="+", default=["pyramidal", "elliptic"])
    command.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    command.add_argument("--out", type=Path)
    command.set_defaults(run=speed)
    command = commands.add_parser("curve")
    command.add_argument("folders", type=Path, nargs="+")
    command.set_defaults(run=curve)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
