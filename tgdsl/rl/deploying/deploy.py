"""Run a policy on a source, whatever it is: observe, choose, command, at the task's control rate; and report what came of it.

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
from tgdsl.rl.playing.evaluation import SEED, mean_interval, share_interval
from tgdsl.rl.playing.policy import Policy
from tgdsl.rl.playing.record import Record
from tgdsl.rl.playing.rollout import Moment, rollout
from tgdsl.runtime.connect import MUJOCO, connect, kind_of
from tgdsl.runtime.connection import Connection, SimulatorKind
from tgdsl.runtime.simulators.model_ids import keyframe_id
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.motion import MotionLimits

EMULATED_LIMITS = {"speed": 1e6, "current_limit": 300, "kp": 100, "watchdog_s": 1.0}
"""Limits of an emulated hand: its drives are those of the scene, and it is not to wait for them. Do not use these figures on a
real one: what its gains do is not published."""


@dataclass(frozen=True, eq=False)
class HandMoment(Moment):
    """One control step of a policy on a source; `step` is what a scene's task says of it."""

    episode: int  # number of the episode, from 0
    target: Float[Tensor, "env joint"]  # set-points of the joints that it moves [rad]
    age_s: float | None  # how old the sample was [s]; None where nothing runs in real time
    inference_s: float  # from then until the set-points were there [s]


class DeployRecord(Record):
    """A record of a policy on a source.

    The file holds, of each control step, its `episode` and `index` in it (step,), observations `obs:<group>` (step, feature)
    that the action was chosen from, the `action` (step, joint) from −1 to 1, the `target` (step, joint) [rad], `age` and
    `inference` (step,) [s], and the `score` so far (step,); an age and a score that are not known are NaN. `joints` names the
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
        """Return those of times [s]; None if there are none."""
        return cls(*(1e3 * np.quantile(seconds, (0.5, 0.99))).tolist()) if seconds else None

    def __str__(self) -> str:
        return f"{self.median:.2f} ms (99 %: {self.p99:.2f} ms)"


class Scores(NamedTuple):
    """Scores of the episodes that a scene has judged, and their mean; `held` and the intervals as `Evaluation` has them."""

    each: tuple[float, ...]
    mean: float
    interval: tuple[float, float]
    held: float
    held_interval: tuple[float, float]


@dataclass(frozen=True)
class Report:
    """What came of a policy that acted."""

    source: str  # on what it acted, as `tgdsl.connect` takes it
    unit: str
    episodes: int
    steps: int  # control steps of all episodes
    scores: Scores | None  # None where no scene says what happened, as on a real hand and of a log, or no episode was whole
    has_scene: bool  # whether a scene says what happened
    age: Quantiles | None  # how old the sample was that an action was chosen from; None where nothing runs in real time
    inference: Quantiles | None  # from a sample to set-points: what it took to observe and to choose
    latency: Quantiles | None  # age and inference, of each step together; None where there is no age
    control_rate: float  # control steps per second that the task asks for [Hz]
    rate: float  # achieved rate [Hz]
    late_steps: int  # control steps that began after they should have ended
    moves: bool  # whether set-points went to joints

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
    """A policy on a source: what it takes, seen before anything is connected."""

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
        """Read everything, and see that it fits.

        Args:
            task: The task's document.
            policy: The policy's file.
            source: `simulation`, `warp`, `emulator`, `xhand1:PORT`, a log, or another kind that is installed.
            groups: Groups of observations that the policy takes, in its order; default: as its card says, or `proprio`,
                `tactile_sensors` and `goal`, of those that there are.
            goal: What it is asked for, in the task's units; default: what the scene's task asks for.
            overrides: Values of the document to set first by dotted path.
            seed: Seed of the scene's random numbers: episode i is the first one of environment i of `tgdsl evaluate`.
            start: Keyframe whose controls a hand without a scene begins with; default: it holds the joints where they are.
            calibration: What a hand's counts mean: see `tgdsl.connect`.
            motion: Leave for a real hand to move, or what makes it of the scene's model; default: none. An emulated one always
                has.
            lockstep: Whether an emulator's scene waits for each step, and a log is read as fast as possible.
            progress: Called with a line of text for each long job.
            **options: Other options of `tgdsl.connect`.

        Raises:
            SpecError: All mistakes of the documents, at their places.
            PolicyError: If the policy cannot be read, or was learned for something else.
            DeployError: If it sees what no hand can know, or nobody says what it is asked for.
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
            problem = f'the task "{prepared.loaded.spec.task}" draws what it asks for by what is in its scene'
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
        self._times: list[tuple[float | None, float, float]] = []  # of each step: age, inference and duration [s]
        self._episodes: list[tuple[float, bool]] = []  # of each: its score, and whether it lasted as long as one may
        self._late = 0

    def steps(self, episodes: int = 1, seconds: float | None = None) -> Iterator[HandMoment]:
        """Act, and yield each control step.

        A scene's episodes end as the task says; others, and a log that is not over, after so many seconds: by default an
        episode's, and all of a log.
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
                env = TouchEnv(prepared.loaded, 1, threads=1, first_env=episode, sensed=prepared.sensed, **self._env_options)
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
        """Return what came of the steps that were made; raise `DeployError` if none was made."""
        if not self._times:
            raise DeployError(f"{self.source}: not one control step was made")
        ages, inferences, seconds = zip(*self._times, strict=True)
        prepared, num, scores = self.prepared, len(self._episodes), None
        if self.has_scene and num:
            each, are_held = zip(*self._episodes, strict=True)
            mean, held = math.fsum(each) / num, sum(are_held) / num
            interval = mean_interval(mean, math.fsum(score**2 for score in each), num)
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
        touch, control_step = self.prepared.sensed.touch, self.prepared.control_step
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
    """Run a policy on a source; return what came of it.

    Args:
        task: The task's document.
        policy: The policy's file.
        source: As `tgdsl.connect` takes it.
        episodes: How many.
        seconds: Longest duration of each [s]; default: an episode's, of a log all of it.
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
