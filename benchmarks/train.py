"""What learning takes: control steps per second, rollout and update apart; and how fast a policy becomes good.

    python benchmarks/train.py speed --out out/speed.csv                                  # both cones, RND off and on
    tgdsl train examples/tasks/in_palm_rotate.yaml --set "randomise={}" --minutes 5 --seed 1 --out out/rotate_1
    python benchmarks/train.py curve out/rotate_1 out/rotate_2 out/rotate_3 --plot out/rotate.png

`speed` times iterations after warm ones, medians; a run's own curve is of its iterations, wall-clock with all that is written.
`curve` prints when each run's score first reached a bound, in radians per second where the score is quarter turns.
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
"""Iterations before those that are timed: kernels are loaded, graphs captured."""
BINS = (0.5, 1.0, 1.5, 2.0)
"""Bounds of the angular velocity [rad/s]."""


def speed(given: argparse.Namespace) -> None:
    rows = [row for cone in given.cones for row in _speeds(given, cone)]
    names = list(rows[0])
    print(" | ".join(names))
    for row in rows:
        print(" | ".join(str(row[name]) for name in names))
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        with given.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, names, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def _speeds(given: argparse.Namespace, cone: str) -> list[dict[str, Any]]:
    """Return a row each with RND off and on."""
    overrides = {"physics.cone": cone, **dict(pair.split("=", 1) for pair in given.set)}
    document = load_task(given.task, overrides)
    env = TouchEnv(document, given.envs, device=given.device)
    taxels = sum(len(table) for table in env.touch.taxels.values())
    rows = []
    for has_rnd in (False, True):
        is_there = has_rnd == (document.spec.train.rnd != "off")  # with the document's own numbers
        loaded = document if is_there else load_task(given.task, {**overrides, "train.rnd": "{}" if has_rnd else "off"})
        learner = Learner(env, loaded, seed=0)
        for _ in range(WARM):
            learner.iterate()
        made = [learner.iterate() for _ in range(given.iterations)]
        rollout, update = (statistics.median(getattr(one, part) for one in made) for part in ("rollout", "update"))
        whole = statistics.median(one.rollout + one.update for one in made)
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


def curve(given: argparse.Namespace) -> None:
    runs = {folder.name: _read(folder) for folder in given.folders}
    print("run | " + " | ".join(f"min to {bound} rad/s" for bound in BINS) + " | best | last | minutes | M samples | evaluated")
    reached = []
    for name, (rows, evaluated) in runs.items():
        found = [next((minutes for minutes, rate, _ in rows if rate >= bound), math.inf) for bound in BINS]
        reached.append(found[-1])
        best, (minutes, last, samples) = max(rate for _, rate, _ in rows), rows[-1]
        times = " | ".join("–" if math.isinf(value) else f"{value:.2f}" for value in found)
        print(f"{name} | {times} | {best:.2f} | {last:.2f} | {minutes:.2f} | {samples / 1e6:.0f} | {evaluated}")
    print(f"median over {len(runs)} runs of the time to {BINS[-1]} rad/s: {statistics.median(reached):.2f} min")
    if given.plot is not None:
        _plot({name: rows for name, (rows, _) in runs.items()}, given.plot)


def _read(folder: Path) -> tuple[list[tuple[float, float, float]], str]:
    """Return minutes, angular velocity [rad/s] and samples of each iteration with episodes, smoothed; and the evaluation."""
    last = json.loads((folder / "run.json").read_text())["starts"][-1]["spec"]
    scale = 0.5 * math.pi / last["episode"] if last["task"] in ("in_palm_rotate",) else 1.0
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
    found = json.loads(file.read_text())
    bounds = " to ".join("–" if bound is None else f"{scale * bound:.2f}" for bound in found["score_interval"])
    return rows, f"{scale * found['score']:.2f} ({bounds}) rad/s, {found['held']:.1%} held"


def _plot(runs: dict[str, list[tuple[float, float, float]]], file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.5), sharey=True, layout="constrained")
    for name, rows in runs.items():
        minutes, rate, samples = zip(*rows, strict=True)
        axes[0].plot(minutes, rate, lw=1, label=name)
        axes[1].plot([value / 1e6 for value in samples], rate, lw=1)
    axes[0].set(xlabel="learning [min]", ylabel="score, with exploration [rad/s]")
    axes[1].set(xlabel="control steps [million]")
    axes[0].legend()
    figure.savefig(file, dpi=150)
    pyplot.close(figure)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(required=True)
    own = kinds.add_parser("speed")
    own.add_argument("task", type=Path, nargs="?", default=TASK)
    own.add_argument("--envs", type=int, default=8192)
    own.add_argument("--device", default="cuda")
    own.add_argument("--iterations", type=int, default=10)
    own.add_argument("--cones", nargs="+", default=["pyramidal", "elliptic"])
    own.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    own.add_argument("--out", type=Path)
    own.set_defaults(run=speed)
    own = kinds.add_parser("curve")
    own.add_argument("folders", type=Path, nargs="+")
    own.add_argument("--plot", type=Path)
    own.set_defaults(run=curve)
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
