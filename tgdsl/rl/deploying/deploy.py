"""Run a policy on a source, whatever it is: observe, choose, command, at the task's control rate.

Shapes: `actuator` actuators of the scene, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.console.progress import Progress
from tgdsl.console.tables import text_table
from tgdsl.rl.deploying.hand import EVERYONE, Hand
from tgdsl.rl.deploying.prepared import DeployError, Prepared, prepare
from tgdsl.rl.deploying.report import Quantiles, Report, Scores
from tgdsl.rl.deploying.scene import TaskScene, first_step
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.evaluation import SEED
from tgdsl.rl.playing.policy import Policy
from tgdsl.rl.playing.record import Record
from tgdsl.rl.playing.rollout import Moment, rollout
from tgdsl.runtime.connect import connect, kind_of
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.simulators.model_ids import keyframe_id
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.motion import MotionLimits

EMULATED_SPEED, EMULATED_CURRENT, EMULATED_GAIN, EMULATED_WATCHDOG_S = 1e6, 300, 100, 1.0
"""Limits of an emulated hand: its drives are those of the scene, and it is not to wait for them."""


@dataclass(frozen=True, eq=False)
class HandMoment(Moment):
    """One control step of a policy on a source; `step` is what a scene's task says of it.

    Attributes:
        episode: Number of the episode, from 0.
        target: Set-points of the joints that it moves [rad].
        age_s: How old the sample was [s]; None where nothing runs in real time.
        inference_s: From then until the set-points were there [s].
    """

    episode: int
    target: Float[Tensor, "env joint"]
    age_s: float | None
    inference_s: float


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


@dataclass
class _Sums:
    """What is added up of all steps."""

    ages: list[float | None] = field(default_factory=list)
    inferences: list[float] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    are_held: list[bool] = field(default_factory=list)
    seconds: float = 0.0
    late_steps: int = 0


class Deployment:
    """A policy on a source: what it takes, seen before anything is connected.

    Attributes:
        prepared: The policy and its task.
        source: The source, as `tgdsl.connect` takes it.
        has_scene: Whether it has a scene, so that the task can judge.
        moves: Whether set-points go to joints.
    """

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
            groups: Groups of observations that the policy takes, in its order; default: see `prepare`.
            goal: What it is asked for, in the task's units; default: what the scene's task asks for.
            overrides: Values of the document to set first by dotted path.
            seed: What is random in a scene follows from it: episode i is the first one of environment i of `tgdsl evaluate`.
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
        self._is_emulated = is_emulated = self.has_scene and "motion" in kind.options
        self._device, self._simulator = "cpu", "mujoco"
        if kind.name == "warp":
            self._device, self._simulator = source.partition(":")[2] or "cuda", "warp"
        self.prepared = prepare(
            task,
            Path(policy),
            groups=groups,
            goal=goal,
            overrides=overrides,
            device=self._device,
            is_emulated=is_emulated,
            progress=progress,
        )
        prepared = self.prepared
        if not self.has_scene and prepared.loaded.task.goal_units and prepared.goal is None and _needs_goal(prepared):
            units = ", ".join(prepared.loaded.task.goal_units)
            problem = (
                f'the task "{prepared.loaded.spec.task}" draws what it asks for by what is in its scene, and {source} has none'
            )
            raise DeployError(f"{policy}: {problem}; say what to ask for: a goal [{units}]")
        motion = motion(prepared.model) if callable(motion) else motion
        if is_emulated and motion is None:
            motion = emulated_limits(prepared)
        self.moves = kind.name != "log" and (motion is not None or "motion" not in kind.options)
        self._start = None if start is None else prepared.model.key_ctrl[keyframe_id(prepared.model, start)]
        self._seed, self._progress = seed, progress
        self._options = options | {"calibration": calibration, "motion": motion, "lockstep": lockstep}
        self._sums = _Sums()

    def scene(self, episode: int) -> TaskScene:
        """Return the scene of an episode: that of the environment of this number."""
        prepared = self.prepared
        env = TouchEnv(
            prepared.loaded,
            1,
            device=self._device,
            seed=self._seed,
            simulator=self._simulator,
            threads=1,
            first_env=episode,
            sensed=prepared.sensed,
            progress=self._progress,
        )
        return TaskScene(env)

    def steps(self, episodes: int = 1, seconds: float | None = None) -> Iterator[HandMoment]:
        """Act, and yield each control step.

        A scene's episodes end as the task says; others, and a log that is not over, after some time.

        Raises:
            DeployError: If there is nothing to do.
            ObservationError: If the source cannot give what the policy feels; no hand was touched then.
            HandError: If a hand does not answer, or may not move like this.
        """
        if episodes < 1 or not (seconds is None or 0 < seconds < math.inf):
            raise DeployError(f"{episodes} episodes of {seconds} s, expected at least 1, and more than 0 s")
        longest = self.prepared.loaded.spec.episode if seconds is None else seconds
        is_whole = seconds is None and kind_of(self.source).name == "log"
        num_steps = None if is_whole else max(1, round(longest / self.prepared.control_step))
        self._sums, policy = _Sums(), self.prepared.policy()
        if self.has_scene:
            for episode in range(episodes):
                scene = self.scene(episode)
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
        """Return what came of the steps that were made.

        Raises:
            DeployError: If none was made.
        """
        sums, spec = self._sums, self.prepared.loaded.spec
        if not sums.inferences:
            raise DeployError(f"{self.source}: not one control step was made")
        ages = [age for age in sums.ages if age is not None]
        pairs = [age + inference for age, inference in zip(sums.ages, sums.inferences, strict=True) if age is not None]
        return Report(
            task=spec.task,
            policy=str(self.prepared.saved.file),
            source=self.source,
            unit=self.prepared.loaded.task.score_unit,
            episodes=len(sums.scores) if self.has_scene else max(1, len(sums.are_held)),
            steps=len(sums.inferences),
            scores=Scores.of(sums.scores, sums.are_held) if sums.scores else None,
            has_scene=self.has_scene,
            age=Quantiles.of(ages) if ages else None,
            inference=Quantiles.of(sums.inferences),
            latency=Quantiles.of(pairs) if ages else None,
            control_rate=1.0 / self.prepared.control_step,
            rate=len(sums.inferences) / sums.seconds,
            late_steps=sums.late_steps,
            moves=self.moves,
        )

    def _connected(self, scene: TaskScene | None) -> Connection:
        """Connect; a scene is closed with the connection, or if there is none."""
        with ExitStack() as opened:
            if scene is not None:
                opened.callback(scene.close)
            prepared = self.prepared
            result = connect(
                prepared.sensed.touch, self.source, control_step=prepared.control_step, scene=scene, **self._options
            )
            opened.pop_all()
        return result

    def _episode(
        self, episode: int, connection: Connection, policy: Policy, num_steps: int | None, scene: TaskScene | None
    ) -> Iterator[HandMoment]:
        """Make the steps of one episode."""
        sums, late = self._sums, getattr(connection.source, "num_late_steps", 0)
        hand = Hand(self.prepared, connection, scene, is_exact=self.has_scene and not self._is_emulated)
        hand.begin(self._start, self.moves)
        policy.begin(EVERYONE)
        info = first_step().info
        for moment in rollout(policy, hand, num_steps):
            info = moment.step.info
            sums.seconds += hand.seconds
            sums.ages.append(hand.age_s)
            sums.inferences.append(hand.inference_s)
            asked = {"episode": episode, "target": hand.target, "age_s": hand.age_s, "inference_s": hand.inference_s}
            yield HandMoment(**vars(moment), **asked)
            if info.ended or connection.is_over:
                break
        sums.late_steps += getattr(connection.source, "num_late_steps", 0) - late
        sums.are_held.append(bool(~info.ended | (scene is not None and info.is_whole(scene.max_steps))))
        if scene is not None:
            sums.scores.append(float(info.score))


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
        watch: Is told of each control step.
        **options: As for `Deployment`.

    Raises:
        TgdslError: As from `Deployment` and `Deployment.steps`.
    """
    result = Deployment(task, policy, source, **options)
    for moment in result.steps(episodes, seconds):
        if watch is not None:
            watch(moment)
    return result.report()


def emulated_limits(prepared: Prepared) -> MotionLimits:
    """Return limits of an emulated hand. Do not use these figures on a real one: what its gains do is not published.

    Raises:
        MotionError: If the scene is not of an XHand1.
    """
    return MotionLimits.of_robot(
        prepared.model,
        speed=EMULATED_SPEED,
        current_limit=EMULATED_CURRENT,
        kp=EMULATED_GAIN,
        watchdog_s=EMULATED_WATCHDOG_S,
    )


def _needs_goal(prepared: Prepared) -> bool:
    return any(name in prepared.loaded.task.hand_groups for name in prepared.groups)
