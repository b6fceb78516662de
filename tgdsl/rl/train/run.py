"""A run: iterations up to a number or a time limit, with checkpoints, so that it may be killed.

A checkpoint holds networks, normalisers, optimisers, learning rate, iteration, random generators, and each environment's
numbers of resets and readings and its episode's steps; it holds no physics. A resumed run begins new episodes with new random
numbers and the saved remaining times. It may have other numbers of environments or processes; episodes then begin as in a new
run.
"""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from tgdsl.errors import FileError, TgdslError, listed
from tgdsl.files.write import as_file_error
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.train.folder import FORMAT, CheckpointError, RunFolder, write_checkpoint
from tgdsl.rl.train.learner import Iteration, Learning

LINE_INTERVAL = 10.0  # time between lines where there is no terminal for a progress bar [s]


class ProgressBar:
    """A progress bar of a run; without a terminal, occasional lines."""

    def __init__(self, iterations: int | None, done: int, unit: str):
        self._unit, self._total, self._last_line = unit, iterations, -LINE_INTERVAL
        form = "{desc} {n_fmt}/{total_fmt} |{bar}| {postfix}" if iterations else "{desc} {n_fmt} {postfix}"
        self._bar = tqdm(total=iterations, initial=done, desc="learning", disable=None, leave=False, bar_format=form)
        self._seen: dict[str, float] = {}

    def show(self, row: Mapping[str, float | int], left: float) -> None:
        """Show an iteration."""
        self._seen |= {name: row[name] for name in ("Episode/return", "Episode/score") if name in row}
        parts = [f"{timedelta(seconds=round(left))} left"]
        if self._seen:
            score = f"{self._seen['Episode/score']:.2f} {self._unit}"
            parts = [f"return {self._seen['Episode/return']:.2f}", f"score {score}", *parts]
        parts.insert(-1, f"{row['steps_per_second']:,.0f} steps/s")
        text = ", ".join(parts)
        if not self._bar.disable:
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.update()
        elif row["seconds"] - self._last_line >= LINE_INTERVAL:
            self._last_line = row["seconds"]
            print(f"{row['iteration']:.0f}{f'/{self._total}' if self._total else ''}: {text}", flush=True)

    def close(self) -> None:
        """Clear the bar."""
        self._bar.close()
        sys.stdout.flush()


class DivergedError(TgdslError):
    """A policy whose losses or state are not finite."""


Show = Callable[[Mapping[str, float | int], float], None]
"""Called with an iteration, as `curve.csv` has it, and the time that is left [s]."""


@contextlib.contextmanager
def stop_requests() -> Iterator[list[signal.Signals]]:
    """Yield a list that collects the first SIGINT (Ctrl-C) or SIGTERM; a second one has its default effect."""
    received: list[signal.Signals] = []
    handlers: dict[signal.Signals, Any] = {}

    def note(number: int, frame: FrameType | None) -> None:
        received.append(signal.Signals(number))
        restore_handlers()

    def restore_handlers() -> None:
        for signal_number, handler in handlers.items():
            signal.signal(signal_number, handler)

    if threading.current_thread() is threading.main_thread():  # Python lets no other thread handle signals
        handlers.update({number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)})
    try:
        yield received
    finally:
        restore_handlers()


class Run:
    """A run in its folder; `seconds` of learning exclude the time to make environments and to evaluate.

    `resume` is the command that continues from its checkpoint.
    """

    def __init__(self, learner: Learning, folder: RunFolder, every: float, resume: str, seconds: float = 0.0):
        """Write the first checkpoint, so that an unwritable folder or full disk raises now."""
        self.learner, self._folder, self._every, self._resume, self.seconds = learner, folder, every, resume, seconds
        self._rate, self._samples, self._saved = 0.0, learner.samples, learner.iteration
        self.stopped_by: signal.Signals | None = None  # the signal that has ended `learn`
        self._writes = learner.ranks.is_first
        if self._writes:
            folder.keep_rows(learner.iteration)
        self.save()
        self.board = _board(folder.path, learner.iteration) if self._writes else None

    def save(self) -> None:
        """Write a checkpoint, by the first process."""
        learner = self.learner
        state = state_of(learner, self.seconds)
        if wrong := not_finite(state, learner.groups, learner.env.groups):
            raise DivergedError(
                f"iteration {learner.iteration}: {wrong} is not finite: something that the environments return was not, or it "
                f"grew beyond all bounds; {self._folder.checkpoint} is from before"
            )
        if self._writes:
            write_checkpoint(state, self._folder.checkpoint)
        self._saved = learner.iteration

    def learn_with_bar(self, iterations: int | None, minutes: float | None, default: int) -> None:
        """Learn up to `iterations`, else the document's `default`, or for so many minutes, with a progress bar: see `learn`."""
        total, limit = iterations or default, math.inf if minutes is None else 60.0 * minutes
        shown_total = total if minutes is None or iterations else None  # else time ends the run
        unit = self.learner.env.task.score_unit
        bar = ProgressBar(shown_total, self.learner.iteration, unit) if self._writes else None
        try:
            self.learn(total, limit, bar.show if bar else None)
        finally:
            if bar is not None:
                bar.close()

    def learn(self, iterations: int, seconds: float, show: Show | None = None) -> None:
        """Learn. Ctrl-C and SIGTERM end it after the iteration under way, with a checkpoint.

        Iterations get the finished share of the run: of iterations or of time, whichever is larger, including earlier starts.
        So a killed run that resumes for the rest of its time continues as if uninterrupted.
        """
        with self.named_in_file_errors(), stop_requests() as received:
            try:
                self._iterate(iterations, seconds, show, received)
            finally:
                if self.board is not None:
                    with as_file_error(self._folder.board):
                        self.board.close()
        self.stopped_by = received[0] if received else None

    @contextlib.contextmanager
    def named_in_file_errors(self) -> Iterator[None]:
        """Add the last checkpoint and the command that resumes from it to errors of files that cannot be written."""
        try:
            yield
        except FileError as error:
            hint = f"{self._folder.checkpoint} is whole, of iteration {self._saved}; to go on: {self._resume}"
            raise FileError(error.file, f"{error.reason}; {hint}") from error

    def end_if_stopped(self) -> None:
        """Exit if a signal has stopped the run, with the command that resumes it."""
        if self.stopped_by is not None:
            stopped = f"stopped by {self.stopped_by.name} after iteration {self.learner.iteration}"
            print(f"{stopped}; to go on: {self._resume}", file=sys.stderr)
            raise SystemExit(128 + self.stopped_by)

    def _iterate(self, iterations: int, seconds: float, show: Show | None, received: Sequence[signal.Signals]) -> None:
        learner, seconds_before = self.learner, self.seconds
        begun = saved = time.monotonic()
        is_over = learner.iteration >= iterations or seconds <= 0.0
        while not is_over:
            start = time.monotonic()
            time_share = (seconds_before + start - begun) / (seconds_before + seconds)
            iteration = learner.iterate(max(learner.iteration / iterations, time_share))
            now = time.monotonic()
            self.seconds = seconds_before + now - begun
            self._refuse_diverged(iteration)
            self._tell(iteration, now - start, iterations, seconds - (now - begun), show)
            is_over = learner.iteration >= iterations or now - begun >= seconds or bool(received)
            is_due = is_over or now - saved + (now - start) > self._every
            is_over, is_due = learner.ranks.agreed((is_over, is_due), learner.env.device)
            if is_due:
                self.save()
                saved = now  # of the iteration's end: the previous checkpoint counts until this one is written

    def _tell(self, iteration: Iteration, duration: float, iterations: int, time_left: float, show: Show | None) -> None:
        """Write an iteration into curve and TensorBoard, and show it."""
        if not self._writes:
            return
        learner = self.learner
        samples, self._samples = learner.samples - self._samples, learner.samples
        self._rate = duration if not self._rate else 0.9 * self._rate + 0.1 * duration
        perf = {
            "Perf/total_fps": samples / duration,
            "Perf/collection_time": iteration.rollout,
            "Perf/learning_time": iteration.update,
        }
        row: dict[str, float | int] = {
            "iteration": learner.iteration,
            "samples": learner.samples,
            "seconds": self.seconds,
            "steps_per_second": samples / self._rate,
            "rollout": iteration.rollout,
            "update": iteration.update,
            "episodes": iteration.episodes,
        }
        self._folder.add_row({**row, **dict.fromkeys(learner.episode_names, math.nan), **iteration.metrics})
        if self.board is not None:
            with as_file_error(self._folder.board):
                for name, value in (iteration.metrics | perf).items():
                    self.board.add_scalar(name, value, learner.iteration)
        if show is not None:
            show(row | iteration.metrics, max(0.0, min(time_left, (iterations - learner.iteration) * self._rate)))

    def _refuse_diverged(self, iteration: Iteration) -> None:
        losses = {name: value for name, value in iteration.metrics.items() if name.startswith("Loss/")}
        problem = ", ".join(f"{name} is {value}" for name, value in losses.items() if not math.isfinite(value))
        if problem:
            raise DivergedError(
                f"iteration {self.learner.iteration}: {problem}; {self._folder.checkpoint} is from before: try a smaller "
                f"{self.learner.rates}"
            )


def _board(folder: Path, done: int) -> Any:
    """Return a writer for TensorBoard; None if that is not installed."""
    with contextlib.suppress(ImportError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # from TensorBoard's dependencies
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(folder), flush_secs=10, purge_step=done + 1 if done else None)


def state_of(learner: Learning, seconds: float) -> dict[str, Any]:
    """Return a checkpoint's state after so many seconds of learning; all processes call it."""
    env = learner.env
    state = {
        "resets": env.resets.cpu().clone(),
        "steps": env.steps.cpu().clone(),
        "touch": {name: count.cpu().clone() for name, count in _clock(env).items()},
        "cpu": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state(env.device) if env.device.type == "cuda" else None,
    }
    return {
        "format": FORMAT,
        "iteration": learner.iteration,
        "samples": learner.samples,
        "seconds": seconds,
        "groups": learner.groups,
        **learner.state_dict(),
        "processes": learner.ranks.gathered(state),
    }


def restore(learner: Learning, state: Mapping[str, Any], file: Path) -> None:
    """Restore a learner of the same groups and networks from a checkpoint; errors name `file`."""
    env, rank = learner.env, learner.ranks.rank
    names = state["groups"].keys() | learner.groups.keys()
    if state["groups"].keys() ^ learner.groups.keys() == {"rnd_state"}:  # RND was turned on or off
        names -= {"rnd_state"}
    if other := sorted(name for name in names if state["groups"].get(name) != learner.groups.get(name)):
        saved_groups, now = ({name: groups.get(name) for name in other} for groups in (state["groups"], learner.groups))
        hint = "a network cannot go on with other groups: begin a new run without --resume"
        raise CheckpointError(f"{file}: learned from the groups {saved_groups}, not {now}; {hint}")
    try:
        learner.load_state_dict(state)
    except (RuntimeError, ValueError, KeyError) as error:
        raise CheckpointError(f"{file}: its networks are of other sizes: {str(error).splitlines()[-1].strip()}") from error
    learner.iteration, learner.samples = state["iteration"], state["samples"]
    ours = state["processes"][rank] if rank < len(state["processes"]) else None
    if ours is not None and ours["resets"].shape == env.resets.shape:
        _count_on(env, [ours])
        learner.go_on(ours["steps"].to(env.device))
    else:
        _count_on(env, state["processes"])
    if ours is None:
        return
    torch.set_rng_state(ours["cpu"])
    if ours["cuda"] is not None and env.device.type == "cuda":
        torch.cuda.set_rng_state(ours["cuda"], env.device)


def not_finite(state: Any, networks: Mapping[str, Sequence[str]], sizes: Mapping[str, int], path: str = "") -> str:
    """Return the name of the first tensor of a state that is not all finite numbers, or nothing.

    Moments of observations are named with their groups: `networks` has the groups of each network, `sizes` the size of each.
    """
    if isinstance(state, Mapping | list | tuple):
        parts = state.items() if isinstance(state, Mapping) else enumerate(state)
        return next(filter(None, (not_finite(part, networks, sizes, f"{path}.{name}".lstrip(".")) for name, part in parts)), "")
    if not isinstance(state, Tensor) or not state.is_floating_point() or bool(state.isfinite().all()):
        return ""
    if "normalizer" not in path and ".seen." not in path:
        return path
    wrong = (~state.isfinite()).reshape(-1, state.shape[-1] if state.ndim else 1).any(dim=0).tolist()
    named = [name for name in networks if f"{name}_state_dict" in path] or list(networks)  # one of rsl_rl's, or students
    columns = [[group for group in networks[name] for _ in range(sizes.get(group, 0))] for name in named]
    result = (group for each in columns if len(each) == len(wrong) for group, is_it in zip(each, wrong, strict=True) if is_it)
    return f"{path}, which observes {listed([*dict.fromkeys(result)])},"


def _count_on(env: TouchEnv, processes: Sequence[Mapping[str, Any]]) -> None:
    """Continue the environments' counters, so that no random number repeats: each from its own, or all from the largest."""
    for name, count in ({"resets": env.resets} | _clock(env)).items():
        saved = [each["resets"] if name == "resets" else each.get("touch", {}).get(name) for each in processes]
        saved = [value for value in saved if value is not None]  # an earlier checkpoint has none of touch
        if len(saved) == 1 and saved[0].shape == count.shape:
            count.copy_(saved[0])
        elif saved:
            count.fill_(max(int(value.max()) for value in saved))


def _clock(env: TouchEnv) -> dict[str, Tensor]:
    clock: Any = env.touch.memory.clock
    return {"step": clock.step, "episode": clock.episode} if clock.num_envs else {}
