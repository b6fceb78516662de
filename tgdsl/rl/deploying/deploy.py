"""Run a policy on a source: observe, choose, command, at the task's control rate; and report the results.

Shapes: `actuator` actuators of the scene, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.console.progress import Progress
from tgdsl.console.tables import text_table
from tgdsl.rl.deploying.hand import EVERYONE, DeployError, Hand, TaskScene, empty_step, prepare
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.evaluation import SEED, score_interval, share_interval
from tgdsl.rl.playing.policy import Policy
from tgdsl.rl.playing.record import Record
from tgdsl.rl.playing.rollout import Moment, rollout
from tgdsl.runtime.connect import MUJOCO, connect, kind_of
from tgdsl.runtime.connection import Connection, SimulatorKind
from tgdsl.runtime.simulators.model_ids import keyframe_id
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.motion import MotionLimits

EMULATED_LIMITS = {"speed": 1e6, "current_limit": 300, "kp": 100, "watchdog_s": 1.0}
"""Limits of an emulated hand, which need not wait for the scene's drives. Do not use these figures on a real hand: the effect
of its gains is not published."""


@dataclass(frozen=True, eq=False)
class HandMoment(Moment):
    """One control step of a policy on a source; `step` is the result by the scene's task."""

    episode: int  # number of the episode, from 0
    target: Float[Tensor, "env joint"]  # set-points of the joints that it moves [rad]
    age_s: float | None  # age of the sample [s]; None where nothing runs in real time
    inference_s: float  # time from the sample to the set-points [s]


class DeployRecord(Record):
    """A record of a policy on a source.

    The file holds, of each control step, its `episode` and `index` in it (step,), observations `obs:<group>` (step, feature)
    that the action was chosen from, the `action` (step, joint) from −1 to 1, the `target` (step, joint) [rad], `age` and
    `inference` (step,) [s], and the `score` so far (step,); unknown ages and scores are NaN. `joints` names the
    joints.
    """

    def add(self, moment: HandMoment) -> None:
        """Add one step."""
        numbers = {"episode": moment.episode, "index": moment.index, "inference": moment.inference_s}
        numbers |= {"age": np.nan if moment.age_s is None else moment.age_s, "score": float(moment.step.info.score)}
        values = {f"obs:{name}": value for name, value in moment.obs.items()}
        values |= {"action": moment.action.double().clamp(-1.0, 1.0), "target": moment.target}
        self.add_rows({name: value.numpy() for name, value in values.items()})
        self.add_rows({name: np.array([number]) for name, number in numbers.items()})

    def lines(self) -> list[str]:
        """Return a table of actions and targets, joint by joint."""
        action, target = self["action"], self["target"]
        rows = [
            (name, f"{action[:, i].mean():.3f}", f"{action[:, i].std():.3f}", f"{low:.3f} to {high:.3f}")
            for i, (name, low, high) in enumerate(zip(self.joints, target.min(axis=0), target.max(axis=0), strict=True))
        ]
        return text_table(("joint", "mean action", "spread", "targets [rad]"), rows).splitlines()


class Quantiles(NamedTuple):
    """Median and 99th percentile [ms]."""

    median: float
    p99: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Quantiles | None:
        """Return the quantiles of times [s]; None without any."""
        return cls(*(1e3 * np.quantile(seconds, (0.5, 0.99))).tolist()) if seconds else None

    def __str__(self) -> str:
        return f"{self.median:.2f} ms (99 %: {self.p99:.2f} ms)"


class Scores(NamedTuple):
    """Scores of a scene's episodes, and their mean; `held` and the intervals as in `Evaluation`."""

    each: tuple[float, ...]
    mean: float
    interval: tuple[float, float]
    held: float
    held_interval: tuple[float, float]


@dataclass(frozen=True)
class Report:
    """Results of a policy on a source."""

    source: str  # the source, as `tgdsl.connect` takes it
    unit: str
    episodes: int
    steps: int  # control steps of all episodes
    scores: Scores | None  # None without a scene, as for a real hand and a log, or without a complete episode
    has_scene: bool  # whether a scene computes scores
    age: Quantiles | None  # age of the sample of each action; None where nothing runs in real time
    inference: Quantiles | None  # time from a sample to set-points: observation and choice
    latency: Quantiles | None  # sum of age and inference of each step; None without an age
    control_rate: float  # the task's control rate [Hz]
    rate: float  # achieved rate [Hz]
    late_steps: int  # control steps that began after they should have ended
    moves: bool  # whether joints received the set-points

    def __str__(self) -> str:
        count = f"{self.episodes:,} episode{'' if self.episodes == 1 else 's'}, {self.steps:,} control steps"
        rate = f"{self.rate:.1f} of {self.control_rate:.1f} control steps per second"
        if self.scores is None:
            why = "no episode has ended" if self.has_scene else f"{self.source} has no scene that knows what happened"
            lines = [f"no score: {why}; {count}"]
        else:
            scores, (low, high) = self.scores, self.scores.interval
            between = f" (95 %: {low:.4f} to {high:.4f})" if len(scores.each) > 1 else ""
            lines = [f"score {scores.mean:.4f} {self.unit}{between}, {scores.held:.1%} of full length; {count}"]
        if self.latency is None:
            lines.append(f"inference {self.inference}; {rate}, not in real time")
        else:
            parts = f"latency {self.latency}: sample age {self.age}, inference {self.inference}"
            lines.append(f"{parts}; {rate}, {self.late_steps} late")
        if not self.moves:
            lines.append(f"{self.source} was not moved: actions were computed, and went nowhere")
        return "\n".join(lines)


class Deployment:
    """A policy on a source, validated before anything is connected."""

    def __init__(
        self,
        task: str | PathLike[str] | Mapping[str, Any],
        policy: str | PathLike[str],
        source: str = "simulation",
        *,
        groups: Sequence[str] = (),
        goal: Sequence[float] = (),
        overrides: Mapping[str, Any] | None = None,
        seed: int = SEED,
        start: str | None = None,
        calibration: Calibration | str | Path | None = None,
        motion: MotionLimits | Callable[[mujoco.MjModel], MotionLimits] | None = None,
        lockstep: bool = False,
        progress: Progress | None = None,
        **options: Any,
    ):
        """Read everything, and check that it fits.

        Args:
            task: The task's document.
            policy: The policy's file.
            source: `simulation`, `warp`, `emulator`, `xhand1:PORT`, a log, or another kind that is installed.
            groups: Groups of observations that the policy takes, in its order; default: its card's, or the existing ones of
                `proprio`, `tactile_sensors` and `goal`.
            goal: The policy's goal, in the task's units; default: the goal of the scene's task.
            overrides: Values of the document to set first by dotted path.
            seed: Seed of the scene's random numbers: episode i is the first one of environment i of `tgdsl evaluate`.
            start: Keyframe whose controls a hand without a scene begins with; default: it holds the joints where they are.
            calibration: Calibration of a hand's counts: see `tgdsl.connect`.
            motion: Motion limits with which a real hand may move, or a function that returns them for the scene's model;
                default: it does not move. An emulated hand always moves.
            lockstep: Whether an emulator's scene waits for each step, and a log is read as fast as possible.
            progress: Called with a line of text for each long job.
            **options: Other options of `tgdsl.connect`.

        Raises:
            SpecError: All mistakes of the documents, at their places.
            PolicyError: If the policy cannot be read, or was learned for another task.
            DeployError: If it needs observations that no hand has, or a goal that nobody gives.
            TgdslError: If there is no such source.
        """
        kind = kind_of(source)
        self.source, self.has_scene = source, "scene" in kind.options
        self._is_emulated, self._is_log = self.has_scene and "motion" in kind.options, kind.name == "log"
        simulator, device = MUJOCO, "cpu"
        if isinstance(kind, SimulatorKind) and kind.name != "simulation":
            simulator, device = kind.name, source.partition(":")[2] or kind.devices[0]
        self._env_options = {"seed": seed, "simulator": simulator, "device": device, "progress": progress}
        self.prepared = prepared = prepare(
            task,
            Path(policy),
            groups=groups,
            goal=goal,
            overrides=overrides,
            device=device,
            is_emulated=self._is_emulated,
            progress=progress,
        )
        asks = prepared.loaded.task.goal_units and any(name in prepared.loaded.task.hand_groups for name in prepared.groups)
        if not self.has_scene and asks and prepared.goal is None:
            problem = f'the task "{prepared.loaded.spec.task}" draws its goal from its scene'
            units = ", ".join(prepared.loaded.task.goal_units)
            raise DeployError(f"{policy}: {problem}, and {source} has none; say what to ask for: a goal [{units}]")
        motion = motion(prepared.model) if callable(motion) else motion
        if self._is_emulated and motion is None:
            motion = MotionLimits.of_robot(prepared.model, **EMULATED_LIMITS)
        self.moves = not self._is_log and (motion is not None or "motion" not in kind.options)
        self._start = None if start is None else prepared.model.key_ctrl[keyframe_id(prepared.model, start)]
        self._options = options | {"calibration": calibration, "motion": motion, "lockstep": lockstep}
        self._start_over()

    def _start_over(self) -> None:
        self._times: list[tuple[float | None, float, float]] = []  # age, inference and duration of each step [s]
        self._episodes: list[tuple[float, bool]] = []  # each one's score, and whether it reached the full length
        self._late = 0

    def steps(self, episodes: int = 1, seconds: float | None = None) -> Iterator[HandMoment]:
        """Act, and yield each control step.

        The task ends a scene's episodes. Other episodes end after so many seconds, by default the task's duration of an
        episode; a log also ends with its last sample, and by default only there.
        """
        if episodes < 1 or not (seconds is None or 0 < seconds < math.inf):
            raise DeployError(f"{episodes} episodes of {seconds} s, expected at least 1, and more than 0 s")
        prepared = self.prepared
        longest = prepared.loaded.spec.episode if seconds is None else seconds
        num_steps = None if seconds is None and self._is_log else max(1, round(longest / prepared.control_step))
        self._start_over()
        policy = prepared.policy()
        if self.has_scene:
            for episode in range(episodes):
                env = TouchEnv(prepared.loaded, 1, threads=1, first_env=episode, sensors=prepared.sensors, **self._env_options)
                scene = TaskScene(env)
                with self._connected(scene) as connection:
                    yield from self._episode(episode, connection, policy, num_steps, scene)
            return
        with self._connected(None) as connection:
            for episode in range(episodes):
                if connection.is_over:
                    break
                if episode:
                    connection.reset()
                yield from self._episode(episode, connection, policy, num_steps, None)

    def report(self) -> Report:
        """Return the results of the steps so far; raise `DeployError` if there are none."""
        if not self._times:
            raise DeployError(f"{self.source}: there was no control step")
        ages, inferences, seconds = zip(*self._times, strict=True)
        prepared, num, scores = self.prepared, len(self._episodes), None
        if self.has_scene and num:
            each, are_held = zip(*self._episodes, strict=True)
            mean, held = math.fsum(each) / num, sum(are_held) / num
            interval = score_interval(prepared.loaded.task, mean, math.fsum(score**2 for score in each), num)
            scores = Scores(each, mean, interval, held, share_interval(held, num))
        return Report(
            source=self.source,
            unit=prepared.loaded.task.score_unit,
            episodes=num if self.has_scene else max(1, num),
            steps=len(ages),
            scores=scores,
            has_scene=self.has_scene,
            age=Quantiles.of([age for age in ages if age is not None]),
            inference=Quantiles.of(inferences),
            latency=Quantiles.of([a + b for a, b in zip(ages, inferences, strict=True) if a is not None]),
            control_rate=1.0 / prepared.control_step,
            rate=len(ages) / sum(seconds),
            late_steps=self._late,
            moves=self.moves,
        )

    def _connected(self, scene: TaskScene | None) -> Connection:
        """Connect; a scene is closed with the connection, or if there is none."""
        touch, control_step = self.prepared.sensors.touch, self.prepared.control_step
        with ExitStack() as opened:
            if scene is not None:
                opened.callback(scene.close)
            connection = connect(touch, self.source, control_step=control_step, scene=scene, **self._options)
            opened.pop_all()
        return connection

    def _episode(
        self, episode: int, connection: Connection, policy: Policy, num_steps: int | None, scene: TaskScene | None
    ) -> Iterator[HandMoment]:
        late = getattr(connection.source, "num_late_steps", 0)
        hand = Hand(self.prepared, connection, scene, is_exact=self.has_scene and not self._is_emulated)
        hand.begin(self._start, self.moves)
        policy.begin(EVERYONE)
        info = empty_step().info
        for moment in rollout(policy, hand, num_steps):
            info = moment.step.info
            self._times.append((hand.age_s, hand.inference_s, hand.seconds))
            yield HandMoment(
                **vars(moment), episode=episode, target=hand.target, age_s=hand.age_s, inference_s=hand.inference_s
            )
            if info.ended or connection.is_over:
                break
        self._late += getattr(connection.source, "num_late_steps", 0) - late
        is_held = bool(~info.ended | (scene is not None and info.is_whole(scene.max_steps)))
        self._episodes.append((float(info.score), is_held))


def deploy(
    task: str | PathLike[str] | Mapping[str, Any],
    policy: str | PathLike[str],
    source: str = "simulation",
    *,
    episodes: int = 1,
    seconds: float | None = None,
    watch: Callable[[HandMoment], None] | None = None,
    **options: Any,
) -> Report:
    """Run a policy on a source; return the results.

    Args:
        task: The task's document.
        policy: The policy's file.
        source: As `tgdsl.connect` takes it.
        episodes: Number of episodes.
        seconds: Longest duration of each [s]; default: the task's duration of an episode; for a log, all of it.
        watch: Called with each control step.
        **options: As for `Deployment`.

    Raises:
        TgdslError: As from `Deployment` and `Deployment.steps`.
    """
    result = Deployment(task, policy, source, **options)
    for moment in result.steps(episodes, seconds):
        if watch is not None:
            watch(moment)
    return result.report()
