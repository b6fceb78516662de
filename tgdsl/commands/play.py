"""Commands that act in a task's environments: play, evaluate, deploy; and the grasps that episodes begin from."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands import arguments as args
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError
from tgdsl.files.write import check_writable, with_folder

if TYPE_CHECKING:
    from mujoco import MjModel

    from tgdsl.rl.deploying.deploy import Deployment
    from tgdsl.rl.env import TouchEnv
    from tgdsl.rl.playing.record import PlayRecord
    from tgdsl.rl.playing.rollout import Actor
    from tgdsl.runtime.xhand1.motion import MotionLimits
    from tgdsl.view.trace import TouchTrace


@dataclass(frozen=True)
class Play:
    """Step a task's environments, show returns, score and reward terms, and write a record and a video that shows touch."""

    task: args.Task
    policy: args.OptionalFile = None
    """A learned policy that acts: a TorchScript file, as tgdsl train and rsl_rl's export_policy_to_jit write it."""
    groups: args.Groups = ()
    actions: Annotated[str, tyro.conf.arg(metavar="ACTIONS")] = "zero"
    """Who acts where there is no policy: zero, random, script (the task's own, if it has one), or FILE.py:FUNCTION, which takes
    the environment and its observations by group and returns actions (env, joint) from −1 to 1."""
    envs: int = 16
    """Environments; the video shows the first."""
    seconds: args.OptionalFloat = None
    """Duration [s]; default: an episode's."""
    seed: args.Seed = 0
    device: args.Device = "cpu"
    out: args.OutFolder = Path("out")
    """Folder for played.npz and played.mp4."""
    video: bool = True
    """Whether to draw the video."""
    camera: args.OptionalText = None
    """The scene's camera of the video; default: the first, or MuJoCo's free camera where there is none."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.playing.record import PlayRecord
        from tgdsl.rl.playing.rollout import check_actions, steps_of
        from tgdsl.rl.playing.video import check_camera

        record_file, video_file = (check_writable(self.out / name) for name in ("played.npz", "played.mp4"))
        if self.policy is not None and self.actions != "zero":
            raise TgdslError(f"--policy {self.policy} and --actions {self.actions}: expected one of them")
        policy = args.saved_policy(self.policy, self.groups)
        check_actions(self.actions)
        with StatusLine() as progress:
            options = {"overrides": args.parsed_overrides(self.set), "progress": progress}
            env = TouchEnv(self.task, self.envs, device=self.device, seed=self.seed, **options)
            check_camera(env.sim.model, self.camera)
        try:
            steps = steps_of(env, self.seconds)
            record = PlayRecord(env, steps)
            trace = self._steps(env, args.actor_for(env, policy, self.actions, self.seed, self.groups), record, steps)
            record.write(record_file)
            print(f"record: {record_file}")
            if self.video:
                self._draw(env, record, trace, video_file)
        finally:
            env.close()

    def _steps(self, env: TouchEnv, actor: Actor, record: PlayRecord, steps: int) -> TouchTrace | None:
        """Make all steps, and return what the first environment's taxels read; None if no taxel is read."""
        from tgdsl.console.progress import LiveTable
        from tgdsl.rl.playing.record import Tally
        from tgdsl.rl.playing.rollout import rollout
        from tgdsl.view.picture import chosen_output
        from tgdsl.view.trace import TouchTrace

        live, tally = LiveTable(), Tally(env)
        on_taxels = [output for output in env.touch.outputs if output.rows == "taxel" and output.kind != "surface_distance"]
        felt = {output.name: env.now.readings[output.name] for output in on_taxels}  # a distance is read without touch too
        trace = TouchTrace(env.touch, chosen_output(env.touch, felt), steps) if felt else None
        with args.progress_bar("playing", steps) as bar:
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


@dataclass(frozen=True)
class Evaluate:
    """Play episodes without exploration, the same for all policies; print the score with its 95 % interval, and the gait."""

    task: args.Task
    policy: args.OptionalFile = None
    """A learned policy, as for tgdsl play; default: none, the joints are not moved."""
    groups: args.Groups = ()
    episodes: int = 1000
    """How many episodes count."""
    envs: int = 256
    """Environments; of each, as many episodes count."""
    device: args.Device = "cpu"
    seed: args.OptionalInt = None
    """Seed of the episodes; default: one that is the same for all policies."""
    out: args.OptionalOut = None
    """A JSON file to write; default: none."""
    require: Annotated[str | None, args.optional("BOUNDS")] = None
    """What score, held and gait have to be, such as "coasting<0.1, penetration<2 mm, held>=95 %"; if they are not, the exit
    code is 1."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.playing.evaluation import SEED, evaluate, parse_requirements

        args.check_least(self, episodes=1, envs=1)
        required = [] if self.require is None else parse_requirements(self.require)
        if self.out is not None:
            check_writable(self.out)
        policy = args.saved_policy(self.policy, self.groups)
        seed, envs = SEED if self.seed is None else self.seed, min(self.envs, self.episodes)
        with StatusLine() as progress:
            overrides = args.parsed_overrides(self.set)
            env = TouchEnv(self.task, envs, device=self.device, seed=seed, overrides=overrides, progress=progress)
        try:
            variants = env.task.setup.num_variants
            if envs < variants:
                played = "1 is" if envs == 1 else f"the first {envs} are"
                print(f'of the {variants} variants of "{env.spec.object}" {played} played: there are no more environments')
            actor = args.actor_for(env, policy, groups=self.groups)
            with StatusLine() as progress:
                evaluation = evaluate(env, actor, self.episodes, seed, progress)
        finally:
            env.close()
        print(f"{evaluation}\n\n{evaluation.gait}")
        if self.out is not None:
            args.write_json(with_folder(self.out), evaluation.plain())
        if failures := [failure for one in required if (failure := one.failure(evaluation)) is not None]:
            print("\n".join(failures), file=sys.stderr)
            sys.exit(1)


@dataclass(frozen=True)
class Deploy:
    """Let a policy act on a source at its task's control rate; print score, latency and rate.

    A simulation and an emulated hand have the task's scene, which says how well it went; a real hand and a log have none.
    """

    task: args.Task
    policy: args.File
    """A learned policy that feels with fingertips: a student of tgdsl distill, with its card."""
    source: Annotated[str, tyro.conf.arg(metavar="SOURCE")] = "simulation"
    """simulation, warp, emulator, xhand1:PORT, or a log (.npz)."""
    episodes: int = 1
    """Number of episodes; in a scene, the first ones of tgdsl evaluate."""
    seconds: args.OptionalFloat = None
    """Longest duration of each [s]; default: an episode's, or the whole log."""
    goal: args.OptionalNumbers = ()
    """What the policy is asked for, in the task's units, such as a force [N]; default: what the scene's task asks for."""
    groups: args.Groups = ()
    start: Annotated[str | None, args.optional("KEYFRAME")] = None
    """Keyframe to which a real hand's joints go before the policy acts; default: it begins where they are."""
    calibration: args.OptionalFile = None
    """What a hand's counts mean; default: of a log its own, else they stay counts."""
    lockstep: bool = False
    """Whether an emulator's scene waits for each step, and a log is read as fast as possible."""
    speed: args.OptionalFloat = None
    """Leave for a real hand to move, with --current-limit and --kp: how fast its set-points may move [rad/s]."""
    current_limit: args.OptionalInt = None
    """Largest motor current [mA]."""
    kp: args.OptionalInt = None
    """Proportional gain [hand's unit]."""
    seed: args.OptionalInt = None
    """Seed of the scene; default: that of tgdsl evaluate."""
    out: args.OptionalOut = None
    """An .npz file to write: observations, actions, targets, latencies and scores of each control step."""
    set: args.Overrides = ()

    def run(self) -> None:
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
                overrides=args.parsed_overrides(self.set),
                seed=SEED if self.seed is None else self.seed,
                start=self.start,
                calibration=self.calibration,
                motion=self._motion(),
                lockstep=self.lockstep,
                progress=progress,
            )
        args.print_changes("policy", deployment.prepared.changes)
        self._act(deployment)

    def _act(self, deployment: Deployment) -> None:
        """Make all steps and report them; Ctrl-C ends them early."""
        from tgdsl.rl.deploying.deploy import DeployRecord

        record = DeployRecord(deployment.prepared.moved.names)
        failed: TgdslError | None = None
        with args.progress_bar("acting") as bar:
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
        """Return the limits of motion, if all three are given; joint ranges come from the task's scene."""
        from tgdsl.runtime.xhand1.motion import MotionLimits

        limits = {name: getattr(self, name) for name in ("speed", "current_limit", "kp")}
        missing = [f"--{name.replace('_', '-')}" for name, value in limits.items() if value is None]
        if 0 < len(missing) < len(limits):
            raise TgdslError(f"{', '.join(missing)}: missing; a hand moves only with a speed, a current limit and a gain")
        return None if missing else partial(MotionLimits.of_robot, **limits)


@dataclass(frozen=True)
class Grasps:
    """Sample the grasps that episodes of a task begin from; the task finds them in the user's cache, or in a file."""

    document: args.Task
    num: args.OptionalInt = None
    """How many, as many of each variant of the object; default: as the document says."""
    seed: args.OptionalInt = None
    """Seed of everything random; default: as the document says."""
    out: args.OptionalOut = None
    """A file to write them to, for `grasps: {file: …}` of the document; default: the user's cache alone."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.files.cache import folder
        from tgdsl.rl.grasps.grasps import grasp_spec, write_grasps
        from tgdsl.rl.grasps.sampling import cached_grasps
        from tgdsl.rl.load import load_task
        from tgdsl.rl.sensed import compile_sensed
        from tgdsl.rl.start import moved_joints

        if self.out is not None:
            check_writable(self.out)
        given = {f"grasps.{name}": value for name in ("num", "seed") if (value := getattr(self, name)) is not None}
        loaded = load_task(self.document, args.parsed_overrides(self.set) | given)
        spec = grasp_spec(loaded.spec)
        if spec is None:
            raise TgdslError(f"{self.document}: episodes of the task {loaded.spec.task} do not begin with grasps")
        with StatusLine() as progress:
            sensed = compile_sensed(loaded, "cpu", progress, only=("link_contact",))
        joints, scene = moved_joints(loaded, sensed), sensed.touch.plan.scene
        with args.progress_bar("sampling", spec.num, "grasp") as bar:

            def count(num: int, _: int) -> None:
                bar.update(num - bar.n)

            grasps = cached_grasps(loaded, scene, joints, count)
        variants = len(set(grasps.variant.tolist()))
        print(f"{len(grasps)} grasps of {variants} variant{'s' if variants > 1 else ''} of {grasps.object}: {folder()}")
        if self.out is not None:
            write_grasps(grasps, self.out)
            print(f"file: {self.out}")
        elif given:
            print("the task finds these where its document, or --set, has the same `grasps: {num, seed}`")
