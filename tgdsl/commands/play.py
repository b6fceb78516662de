"""`tgdsl play`: a task's environments, played and shown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import OUT_FOLDER, OptionalFile, Overrides, Task, parsed_overrides
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    from tgdsl.rl.env import TouchEnv
    from tgdsl.rl.playing.policy import PolicyFile
    from tgdsl.rl.playing.record import PlayRecord
    from tgdsl.rl.playing.rollout import Actor
    from tgdsl.view.trace import TouchTrace

_FILES = {"record": "played.npz", "video": "played.mp4"}


@dataclass(frozen=True)
class Play:
    """Step a task's environments, show returns, score and reward terms, and write a record and a video that shows touch."""

    task: Task
    policy: OptionalFile = None
    """A learned policy that acts: a TorchScript file, as tgdsl train and rsl_rl's export_policy_to_jit write it."""
    groups: tuple[str, ...] = ()
    """Groups of observations that the policy takes, in its order; default: as in its card; without a card, as in
    proprio, tactile_sensors and goal that the task has."""
    actions: Annotated[str, tyro.conf.arg(metavar="ACTIONS")] = "zero"
    """Who acts where there is no policy: zero, random, script (the task's own, if it has one), or FILE.py:FUNCTION, which takes
    the environment and its observations by group and returns actions (env, joint) from −1 to 1."""
    envs: int = 16
    """Environments; the video shows the first."""
    seconds: float | None = None
    """Duration [s]; default: an episode's."""
    seed: int = 0
    """Seed of everything random."""
    device: str = "cpu"
    """Where physics and touch are computed: cpu, or cuda."""
    out: Annotated[Path, OUT_FOLDER] = Path("out")
    """Folder for played.npz and played.mp4."""
    video: bool = True
    """Whether to draw the video."""
    camera: str | None = None
    """The scene's camera of the video; default: the first, or MuJoCo's free camera where there is none."""
    set: Overrides = ()

    def run(self) -> None:
        """Step, show, and write the files."""
        from tgdsl.files.write import check_writable
        from tgdsl.rl.playing.policy import read_policy
        from tgdsl.rl.playing.record import PlayRecord
        from tgdsl.rl.playing.rollout import check_actions, steps_of

        files = {name: check_writable(self.out / file) for name, file in _FILES.items()}
        if self.policy is not None and self.actions != "zero":
            raise TgdslError(f"--policy {self.policy} and --actions {self.actions}: expected one of them")
        if self.groups and self.policy is None:
            raise TgdslError("--groups belong to a policy; give one with --policy")
        check_actions(self.actions)
        policy = None if self.policy is None else read_policy(self.policy)
        with StatusLine() as progress:
            env = self._env(progress)
        try:
            steps = steps_of(env, self.seconds)
            record = PlayRecord(env, steps)
            trace = self._steps(env, self._actor(env, policy), record, steps)
            record.write(files["record"])
            print(f"record: {files['record']}")
            if self.video:
                self._draw(env, record, trace, files["video"])
        finally:
            env.close()

    def _env(self, progress: StatusLine) -> TouchEnv:
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.playing.video import check_camera

        overrides = parsed_overrides(self.set)
        env = TouchEnv(self.task, self.envs, device=self.device, seed=self.seed, overrides=overrides, progress=progress)
        check_camera(env.sim.model, self.camera)
        return env

    def _actor(self, env: TouchEnv, saved: PolicyFile | None) -> Actor:
        from tgdsl.rl.playing.policy import policy_for
        from tgdsl.rl.playing.rollout import actor_of

        if saved is None:
            return actor_of(env, self.actions, self.seed)
        policy = policy_for(env, saved, self.groups)
        for line in policy.changes:
            print(f"changed since the policy was learned: {line}")
        return policy

    def _steps(self, env: TouchEnv, actor: Actor, record: PlayRecord, steps: int) -> TouchTrace | None:
        """Make all steps, and return what the first environment's taxels read; None if no taxel is read."""
        from tqdm import tqdm

        from tgdsl.console.progress import LiveTable
        from tgdsl.rl.playing.record import Tally
        from tgdsl.rl.playing.rollout import rollout
        from tgdsl.view.picture import chosen_output
        from tgdsl.view.trace import TouchTrace

        live, tally = LiveTable(), Tally(env)
        on_taxels = [output for output in env.touch.outputs if output.rows == "taxel" and output.kind != "surface_distance"]
        felt = {output.name: env.now.readings[output.name] for output in on_taxels}  # a distance is read without touch too
        trace = TouchTrace(env.touch, chosen_output(env.touch, felt), steps) if felt else None
        with tqdm(total=steps, desc="playing", unit="step", disable=None, leave=False) as bar:
            for moment in rollout(actor, env, steps):
                record.add(moment)
                tally.add(moment.step.info)
                if trace is not None:
                    trace.add(moment.index + 1, env.now.readings)
                bar.update()
                with bar.external_write_mode():
                    time = (moment.index + 1) * env.control_step
                    live.show(tally.lines(time), is_last=moment.index == steps - 1)
        return trace

    def _draw(self, env: TouchEnv, record: PlayRecord, trace: TouchTrace | None, file: Path) -> None:
        """Draw the video, or say why there is none."""
        from tgdsl.rl.playing.video import VideoError, video

        try:
            with StatusLine() as progress:
                video(env.sim.env_model(0), record.poses(0), env.control_step, file, self.camera, progress, trace)
        except VideoError as error:
            print(f"no video: {error}")
        else:
            print(f"video:  {file}")
