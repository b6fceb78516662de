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
    """Play a task: show returns, score and reward terms; write a record, and a video that shows touch."""

    task: args.Task
    policy: args.OptionalFile = None
    """The policy: a TorchScript file from `tgdsl train` or rsl_rl's export_policy_to_jit; default: --actions."""
    groups: args.Groups = ()
    actions: Annotated[str, tyro.conf.arg(metavar="ACTIONS")] = "zero"
    """Actions without a policy: zero, random, script (the task's script, if it has one), or FILE.py:FUNCTION. The function
    takes the environment and its observations by group, and returns actions (env, joint) between −1 and 1."""
    envs: int = 16
    """Number of environments; the video shows the first."""
    seconds: args.OptionalFloat = None
    """Duration [s]; default: one episode."""
    seed: args.Seed = 0
    device: args.Device = "cpu"
    out: args.OutFolder = Path("out")
    """Folder for played.npz and played.mp4."""
    video: bool = True
    """Draw the video."""
    camera: args.OptionalName = None
    """Camera of the video, by its name in the scene; default: the first, or MuJoCo's free camera if the scene has none."""
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
        readings = {output.name: env.now.readings[output.name] for output in on_taxels}  # a distance is read without touch too
        trace = TouchTrace(env.touch, chosen_output(env.touch, readings), steps) if readings else None
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
    """Play the same episodes for every policy, without exploration; print the score with its 95 % interval, and the gait."""

    task: args.Task
    policy: args.OptionalFile = None
    """The policy, as for `tgdsl play`; default: zero actions."""
    groups: args.Groups = ()
    episodes: int = 1000
    """Number of episodes that count."""
    envs: int = 256
    """Number of environments; equally many episodes of each one count."""
    device: args.Device = "cpu"
    seed: args.OptionalInt = None
    """Seed of the episodes; default: a fixed one, so that all policies play the same episodes."""
    out: args.OptionalOut = None
    """A JSON file for the results; default: no file."""
    require: Annotated[str | None, args.optional("BOUNDS")] = None
    """Bounds on score, held and gait, such as "coasting<0.1, penetration<2 mm, held>=95 %"; the exit code is 1 if one is not
    met. Default: no bounds."""
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
            moves = bool(env.sim.model.body(env.task.setup.object).weldid)  # else there is no gait
            with StatusLine() as progress:
                evaluation = evaluate(env, actor, self.episodes, seed, progress)
        finally:
            env.close()
        print(evaluation)
        if moves:
            print(f"\n{evaluation.gait}")
        if self.out is not None:
            args.write_json(with_folder(self.out), evaluation.plain())
        if failures := [failure for one in required if (failure := one.failure(evaluation)) is not None]:
            print("\n".join(failures), file=sys.stderr)
            sys.exit(1)


@dataclass(frozen=True)
class Deploy:
    """Run a policy on a simulation, a hand or a log at its task's control rate; print score, latency and rate.

    Simulations and the emulated hand have the task's scene, so the score is known; a real hand and a log have none.
    """

    task: args.Task
    policy: args.File
    """The policy: a student of `tgdsl distill` with touch at the fingertips, and its card."""
    source: Annotated[str, tyro.conf.arg(metavar="SOURCE")] = "simulation"
    """Where it acts: simulation (MuJoCo), warp (MuJoCo Warp), emulator (an emulated hand), xhand1:PORT, or a log (.npz)."""
    episodes: int = 1
    """Number of episodes; in a simulation, the first episodes of `tgdsl evaluate`."""
    seconds: args.OptionalFloat = None
    """Longest duration of an episode [s]; default: the task's, or the whole log."""
    goal: args.OptionalNumbers = ()
    """The goal, in the task's units, such as a force [N]; default: the task's goals."""
    groups: args.Groups = ()
    start: Annotated[str | None, args.optional("KEYFRAME")] = None
    """Keyframe to which a real hand moves before the policy acts; default: the present pose."""
    calibration: args.OptionalFile = None
    """The hand's calibration file; default: the log's, otherwise forces stay in counts."""
    lockstep: bool = False
    """Run faster than real time: the emulator waits for each step, a log is read as fast as possible."""
    speed: args.OptionalFloat = None
    """Largest speed of a real hand's set-points [rad/s]; default: the hand does not move. It needs all three limits to move."""
    current_limit: args.OptionalInt = None
    """Largest motor current of a real hand [mA]; default: the hand does not move."""
    kp: args.OptionalInt = None
    """Proportional gain of a real hand [the hand's unit]; default: the hand does not move."""
    seed: args.OptionalInt = None
    """Seed of the episodes; default: the seed of `tgdsl evaluate`."""
    out: args.OptionalOut = None
    """An .npz file for observations, actions, targets, latencies and scores of each control step; default: no file."""
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
    """Sample the grasps with which a task's episodes begin, into the user's cache or a file."""

    document: args.Task
    num: args.OptionalInt = None
    """Number of grasps, divided equally among the object's variants; default: `grasps.num` of the document."""
    seed: args.OptionalInt = None
    """Seed of all random numbers; default: `grasps.seed` of the document."""
    out: args.OptionalOut = None
    """A file for the grasps, for `grasps: {file: …}` of the document; default: only the user's cache."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.files.cache import folder
        from tgdsl.rl.grasps.grasps import grasp_spec, write_grasps
        from tgdsl.rl.grasps.sampling import cached_grasps
        from tgdsl.rl.load import load_task
        from tgdsl.rl.sensors import compile_sensors
        from tgdsl.rl.start import moved_joints

        if self.out is not None:
            check_writable(self.out)
        overrides = {f"grasps.{name}": value for name in ("num", "seed") if (value := getattr(self, name)) is not None}
        loaded = load_task(self.document, args.parsed_overrides(self.set) | overrides)
        spec = grasp_spec(loaded.spec)
        if spec is None:
            raise TgdslError(f"{self.document}: episodes of the task {loaded.spec.task} do not begin with grasps")
        with StatusLine() as progress:
            sensors = compile_sensors(loaded, "cpu", progress, only=("link_contact",))
        joints, scene = moved_joints(loaded, sensors), sensors.touch.plan.scene
        with args.progress_bar("sampling", spec.num, "grasp") as bar:

            def count(num: int, _: int) -> None:
                bar.update(num - bar.n)

            grasps = cached_grasps(loaded, scene, joints, count)
        variants = len(set(grasps.variant.tolist()))
        print(f"{len(grasps)} grasps of {variants} variant{'s' if variants > 1 else ''} of {grasps.object}: {folder()}")
        if self.out is not None:
            write_grasps(grasps, self.out)
            print(f"file: {self.out}")
        elif overrides:
            print("the task finds these where its document, or --set, has the same `grasps: {num, seed}`")
