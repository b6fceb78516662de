"""`tgdsl deploy`: a policy acts on a simulation, an emulated hand, a real one or a log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import FILE, OUT, OptionalFile, Overrides, Task, parsed_overrides
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    from mujoco import MjModel

    from tgdsl.rl.deploying.deploy import Deployment
    from tgdsl.runtime.xhand1.motion import MotionLimits

_MOVING = ("speed", "current_limit", "kp")


@dataclass(frozen=True)
class Deploy:
    """Let a policy act on a source at its task's control rate; print score, latency and rate.

    A simulation and an emulated hand have the task's scene, which says how well it went; a real hand and a log have none.
    """

    task: Task
    policy: Annotated[Path, FILE]
    """A learned policy that feels with fingertips: a student of tgdsl distill, with its card."""
    source: Annotated[str, tyro.conf.arg(metavar="SOURCE")] = "simulation"
    """simulation, warp, emulator, xhand1:PORT, or a log (.npz)."""
    episodes: int = 1
    """Number of episodes; in a scene, the first ones of tgdsl evaluate."""
    seconds: float | None = None
    """Longest duration of each [s]; default: an episode's, or the whole log."""
    goal: tuple[float, ...] = ()
    """What the policy is asked for, in the task's units, such as a force [N]; default: what the scene's task asks for."""
    groups: tuple[str, ...] = ()
    """Groups of observations that the policy takes, as for tgdsl play."""
    start: Annotated[str | None, tyro.conf.arg(metavar="KEYFRAME")] = None
    """Keyframe to which a real hand's joints go before the policy acts; default: it begins where they are."""
    calibration: OptionalFile = None
    """What a hand's counts mean; default: of a log its own, else they stay counts."""
    lockstep: bool = False
    """Whether an emulator's scene waits for each step, and a log is read as fast as possible."""
    speed: float | None = None
    """Leave for a real hand to move, with --current-limit and --kp: how fast its set-points may move [rad/s]."""
    current_limit: int | None = None
    """Largest motor current [mA]."""
    kp: int | None = None
    """Proportional gain [hand's unit]."""
    seed: int | None = None
    """Seed of the scene; default: that of tgdsl evaluate."""
    out: Annotated[Path | None, OUT] = None
    """An .npz file to write: observations, actions, targets, latencies and scores of each control step."""
    set: Overrides = ()

    def run(self) -> None:
        """Act, and print."""
        from tgdsl.files.write import check_writable
        from tgdsl.rl.deploying.deploy import Deployment
        from tgdsl.rl.playing.evaluation import SEED

        if self.out is not None:
            check_writable(self.out)
        with StatusLine() as progress:
            deployment = Deployment(
                self.task,
                self.policy,
                self.source,
                groups=self.groups,
                goal=self.goal,
                overrides=parsed_overrides(self.set),
                seed=SEED if self.seed is None else self.seed,
                start=self.start,
                calibration=self.calibration,
                motion=self._motion(),
                lockstep=self.lockstep,
                progress=progress,
            )
        for line in deployment.prepared.changes:
            print(f"changed since the policy was learned: {line}")
        self._act(deployment)

    def _act(self, deployment: Deployment) -> None:
        """Make all steps and report them; Ctrl-C ends them early."""
        from tqdm import tqdm

        from tgdsl.rl.deploying.deploy import DeployRecord

        record = DeployRecord(deployment.prepared.moved.names)
        failed: TgdslError | None = None
        with tqdm(desc="acting", unit="step", disable=None, leave=False) as bar:
            try:
                for moment in deployment.steps(self.episodes, self.seconds):
                    record.add(moment)
                    bar.update()
            except KeyboardInterrupt:
                bar.write("interrupted")
            except TgdslError as error:  # a hand that no longer answers: report the steps so far
                failed = error
        if failed is None or len(record):
            print(deployment.report())
            print("\n".join(record.lines()))
            if self.out is not None:
                record.write(self.out)
                print(f"record: {self.out}")
        if failed is not None:
            raise failed

    def _motion(self) -> Callable[[MjModel], MotionLimits] | None:
        """Return the limits of motion, if all three are given; joint ranges come from the task's scene.

        Raises:
            TgdslError: If some are missing.
        """
        limits = {name: getattr(self, name) for name in _MOVING}
        missing = [f"--{name.replace('_', '-')}" for name, value in limits.items() if value is None]
        if len(missing) == len(limits):
            return None
        if missing:
            raise TgdslError(f"{', '.join(missing)}: missing; a hand moves only with a speed, a current limit and a gain")
        from tgdsl.runtime.xhand1.motion import MotionLimits

        return partial(MotionLimits.of_robot, **limits)
