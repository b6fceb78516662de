"""A policy learns by touch: a finger stops on a ridge that it can only feel (tasks/find_ridge.py), with rsl_rl's PPO.

    python examples/learn.py                                     # ten minutes with touch; `make learn` does this
    python examples/learn.py --blind --minutes 2                 # without touch
    python examples/learn.py --all --seeds 3 --jobs 9 --threads 1
    python examples/learn.py --plot out/learn                    # table and curve of the runs that are there

All policies see their own command: targets, last action, time left. With `--touch` a policy also sees the taxels of the
fingertip, with `--joints` measured positions and velocities of the joints, whose error betrays contact. `--blind` adds nothing.
The critic, which only learning needs, sees where the ridge is in all three. Then the policy is evaluated without exploration,
in the same episodes for all.

A run writes NAME.json (results and curve) and NAME.pt, the policy: tgdsl play examples/tasks/find_ridge.yaml --policy NAME.pt
--groups command tactile_sensors. From the same seed, numbers of environments, threads and iterations follow the same results.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rsl_rl.modules import EmpiricalNormalization
from rsl_rl.runners import OnPolicyRunner

from tgdsl.rl.adapters.rsl_rl import TouchVecEnv
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task

TASK = Path(__file__).parent / "tasks/find_ridge.yaml"
SEES = {"touch": ("command", "tactile_sensors"), "blind": ("command",), "joints": ("command", "proprio")}
"""Groups of observations of each condition's policy."""
PRIVILEGED = ("proprio", "priv_ridge")
"""What the critic sees in addition."""
STEPS = 40
"""Control steps between updates: half an episode."""
EVALUATION_SEED, EVALUATION_ENVS = 1_000_003, 250
PRINT_INTERVAL = 5.0
"""Time between lines of progress [s]."""


@dataclass(frozen=True)
class Result:
    """One run: `success` and its 95 % `interval` are of the evaluation.

    Each row of `curve` is an iteration in which episodes ended: minutes, episodes so far, and the share of this iteration's
    episodes that succeeded, with exploration.
    """

    condition: str
    seed: int
    envs: int
    threads: int
    iterations: int
    minutes: float
    episodes: int
    chance: float
    success: float
    interval: tuple[float, float]
    evaluated: int
    curve: list[tuple[float, int, float]]


class Counted(TouchVecEnv):
    """Environments that count ended episodes and successes."""

    def __init__(self, touch_env: TouchEnv):
        """Begin to count."""
        super().__init__(touch_env)
        self.ended, self.successes = 0, 0.0

    def step(self, actions: torch.Tensor) -> Any:
        """Make one control step."""
        stepped = super().step(actions)
        if "log" in stepped[3]:
            score = stepped[3]["log"]["Episode/score"]
            self.ended, self.successes = self.ended + len(score), self.successes + float(score.sum())
        return stepped


def settings(condition: str) -> dict[str, Any]:
    """Return the runner's configuration."""
    sees = SEES[condition]
    network = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "elu", "obs_normalization": True}
    return {
        "num_steps_per_env": STEPS,
        "save_interval": sys.maxsize,
        "obs_groups": {"actor": list(sees), "critic": list(dict.fromkeys((*sees, *PRIVILEGED)))},
        "actor": network | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}},
        "critic": dict(network),
        "algorithm": {"class_name": "PPO", "entropy_coef": 0.003, "gamma": 0.99, "lam": 0.95, "schedule": "adaptive"},
    }


def environments(condition: str, num_envs: int, seed: int, threads: int) -> TouchEnv:
    """Return the environments of a condition."""
    overrides = {} if condition == "touch" else {"touch": "none"}
    return TouchEnv(TASK, num_envs, seed=seed, threads=threads, overrides=overrides)


def learn(condition: str, seed: int, num_envs: int, threads: int, minutes: float, iterations: int | None, out: Path) -> Result:
    """Learn until time is over, or for a number of iterations; evaluate, and write what came out.

    Args:
        condition: One of `SEES`.
        seed: What all that is random follows from.
        num_envs: Number of environments.
        threads: CPU threads of physics and torch.
        minutes: Time to learn [min]; without effect if there is a number of iterations.
        iterations: How often the policy is updated.
        out: Folder to write to.
    """
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    env = Counted(environments(condition, num_envs, seed, threads))
    with contextlib.redirect_stdout(io.StringIO()):  # the networks, printed
        runner = OnPolicyRunner(env, settings(condition), device="cpu")
    for model in (runner.alg.actor, runner.alg.critic):
        assert isinstance(model.obs_normalizer, EmpiricalNormalization)
        model.obs_normalizer.eps = 1e-5  # rsl_rl's 0.01 would hide depths, which are in metres
    start, printed, curve, done = time.monotonic(), 0.0, [], 0
    while not is_done(done, iterations, time.monotonic() - start, 60.0 * minutes):
        num_ended, successes = env.ended, env.successes
        runner.learn(1)
        runner.current_learning_iteration, done = runner.current_learning_iteration + 1, done + 1
        passed = time.monotonic() - start
        if env.ended > num_ended:
            curve.append((passed / 60.0, env.ended, (env.successes - successes) / (env.ended - num_ended)))
        if passed - printed > PRINT_INTERVAL and curve:
            printed = passed
            left = 60.0 * minutes - passed if iterations is None else passed / done * (iterations - done)
            print(line(condition, seed, curve, left, num_envs * STEPS * done / passed), flush=True)
    passed = time.monotonic() - start
    success, num = evaluate(runner, condition, threads)
    chance = chance_of()
    result = Result(
        *(condition, seed, num_envs, threads, done, passed / 60.0, env.ended, chance),
        *(success, interval(success, num), num, curve),
    )
    write(result, runner, out)
    return result


def is_done(done: int, iterations: int | None, passed: float, seconds: float) -> bool:
    """Return whether learning is over: after a number of iterations if there is one, else after a time [s]."""
    return passed >= seconds if iterations is None else done >= iterations


def line(condition: str, seed: int, curve: Sequence[tuple[float, int, float]], left: float, rate: float) -> str:
    """Return a line of progress: `left` [s] of the run, `rate` control steps per second."""
    recent = [share for _, _, share in curve[-5:]]
    success = sum(recent) / len(recent)
    left = max(0.0, left)
    clock = f"{int(left // 60)}:{int(left % 60):02d} left"
    return f"{condition} {seed}: {clock}, {curve[-1][1]:,} episodes, {success:.0%} end on the ridge, {rate:,.0f} steps/s"


def chance_of() -> float:
    """Return the success of the best fixed place."""
    loaded = load_task(TASK)
    return sys.modules[loaded.task.__module__].chance(loaded.spec)


def evaluate(runner: OnPolicyRunner, condition: str, threads: int, num: int = 1000) -> tuple[float, int]:
    """Return the share of episodes that go well without exploration, and how many there were: at least `num`.

    Ridges, frictions and noise are the same for all policies.
    """
    env = Counted(environments(condition, EVALUATION_ENVS, EVALUATION_SEED, threads))
    policy = runner.get_inference_policy()
    with torch.inference_mode():
        while env.ended < num:
            env.step(policy(env.get_observations()))
    env.close()
    return env.successes / env.ended, env.ended


def interval(share: float, num: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share of a number of trials."""
    middle = (share + z * z / (2 * num)) / (1 + z * z / num)
    half = z / (1 + z * z / num) * math.sqrt(share * (1 - share) / num + z * z / (4 * num * num))
    return max(0.0, middle - half), min(1.0, middle + half)


def write(result: Result, runner: OnPolicyRunner, out: Path) -> None:
    """Write a run's result and its policy."""
    name = f"{result.condition}_{result.seed}"
    out.mkdir(parents=True, exist_ok=True)
    plain = asdict(result) | {"curve": [(round(m, 4), n, round(share, 4)) for m, n, share in result.curve]}
    (out / f"{name}.json").write_text(json.dumps(plain) + "\n")
    runner.export_policy_to_jit(str(out), f"{name}.pt")


def read(folder: Path) -> list[Result]:
    """Return the runs that a folder holds, by condition and seed."""
    runs = [Result(**json.loads(file.read_text())) for file in sorted(folder.glob("*_*.json"))]
    return sorted(runs, key=lambda run: (list(SEES).index(run.condition), run.seed))


def table(results: Sequence[Result]) -> str:
    """Return a table of runs in Markdown."""
    head = "| sees | seed | minutes | iterations | episodes | success | 95 % |\n|---|---|---|---|---|---|---|\n"
    rows = (
        f"| {r.condition} | {r.seed} | {r.minutes:.1f} | {r.iterations} | {r.episodes:,} | {r.success:.1%} "
        f"| {r.interval[0]:.1%} – {r.interval[1]:.1%} |\n"
        for r in results
    )
    return head + "".join(rows)


def plot(results: Sequence[Result], file: Path) -> None:
    """Draw success with exploration against episodes, and the success of the evaluation as a dot at the end."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 4), layout="constrained")
    colours = dict(zip(SEES, ("tab:blue", "tab:gray", "tab:orange"), strict=True))
    for i, run in enumerate(results):
        rows = [(episodes, share) for _, episodes, share in run.curve]
        is_first = run.condition not in [other.condition for other in results[:i]]
        axes.plot(*zip(*rows, strict=True), color=colours[run.condition], lw=1, label=run.condition if is_first else None)
        axes.plot(run.episodes, run.success, "o", color=colours[run.condition], clip_on=False)
    axes.axhline(results[0].chance, color="black", ls=":", lw=1, label="chance: the best fixed place")
    axes.set(xscale="log", ylim=(0, 1), xlabel="episodes", ylabel="ends on the ridge")
    axes.set_title("lines: with exploration; dots: the policies that were learned, without", fontsize="medium")
    axes.legend(loc="upper left")
    figure.savefig(file, dpi=150)
    pyplot.close(figure)


def learn_all(seeds: int, jobs: int, passed_on: Sequence[str]) -> None:
    """Make all runs, each in its own process, `jobs` at once."""
    waiting = [(condition, seed) for seed in range(1, seeds + 1) for condition in SEES]
    running: list[subprocess.Popen[bytes]] = []
    while waiting or running:
        while waiting and len(running) < jobs:
            condition, seed = waiting.pop(0)
            running.append(subprocess.Popen([sys.executable, __file__, f"--{condition}", "--seed", str(seed), *passed_on]))
        if code := running[0].wait():
            raise SystemExit(f"a run ended with {code}")
        running.pop(0)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for condition in SEES:
        parser.add_argument(f"--{condition}", dest="condition", action="store_const", const=condition, default="touch")
    parser.add_argument("--all", action="store_true", help="all conditions, with each of --seeds")
    parser.add_argument("--plot", type=Path, metavar="FOLDER", help="draw table and curve of the runs in FOLDER, and run none")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=3, help="with --all: how many")
    parser.add_argument("--jobs", type=int, default=1, help="with --all: runs at once")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--iterations", type=int, help="instead of --minutes")
    parser.add_argument("--envs", type=int, default=128)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/learn"))
    args = parser.parse_args()
    folder = args.plot or args.out
    if args.all:
        limit = ["--minutes", str(args.minutes)] if args.iterations is None else ["--iterations", str(args.iterations)]
        passed_on = [*limit, "--envs", str(args.envs), "--threads", str(args.threads), "--out", str(args.out)]
        learn_all(args.seeds, args.jobs, passed_on)
    elif args.plot is None:
        run = learn(args.condition, args.seed, args.envs, args.threads, args.minutes, args.iterations, args.out)
        print(f"{run.condition} {run.seed}: {run.success:.1%} of {run.evaluated} episodes; chance is {run.chance:.1%}")
    if results := read(folder):
        print(table(results), end="")
        plot(results, folder / "curve.png")


if __name__ == "__main__":
    main()
