"""`tgdsl train`: a policy is learned in a task's environments."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tgdsl.commands import arguments as args
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    from tgdsl.rl.load import LoadedTask
    from tgdsl.rl.playing.policy import PolicyFile
    from tgdsl.rl.playing.rollout import Moment
    from tgdsl.rl.train.folder import RunFolder
    from tgdsl.rl.train.learner import Learner
    from tgdsl.rl.train.ranks import Ranks
    from tgdsl.rl.train.run import Run
    from tgdsl.view.mirror import LoopPage

ENVS = 8192
INITIAL_STD = "train.networks.initial_std:"


@dataclass(frozen=True)
class Train:
    """Train a policy by PPO with the document's `train` settings; write checkpoints, the policy, and its evaluation."""

    task: args.Task
    envs: args.OptionalInt = None
    """Environments per process; default: 8192, or the number of the resumed run."""
    device: args.DeviceName = "cuda"
    """Device of physics, touch and networks: cuda, cuda:1 or cpu. With torchrun, each process takes one GPU."""
    iterations: args.OptionalInt = None
    """Iterations of the whole run, including earlier parts; default: `train.iterations` of the document."""
    minutes: args.OptionalFloat = None
    """Learning time from now on, without start-up [min]; default: no limit."""
    seed: args.OptionalInt = None
    """Seed of all random numbers; default: 0, or the seed of the resumed run."""
    resume: args.OptionalFolder = None
    """Folder of an earlier run to continue from its last checkpoint, with its overrides; default: a new run. With another
    --out, a new run starts from that checkpoint, with the overrides of this command only."""
    init: args.OptionalFile = None
    """A policy, or the folder of its run, whose weights and deviations the new run starts from: a teacher's or a student's. The
    critic starts from scratch, and learns alone in the first 25 iterations."""
    out: args.OptionalOutFolder = None
    """Folder of the run; default: out/NAME, by the document's name, or the folder of the resumed run."""
    episodes: int = 1000
    """Episodes of the final evaluation; 0: no evaluation."""
    view: bool = False
    """Show the training environments in the browser."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.rl.load import load_task

        try:
            import tgdsl.rl.train.learner  # noqa: F401
        except ImportError as error:
            raise TgdslError(f'to learn needs rsl-rl-lib, and what that needs: pip install "tgdsl[rl]" ({error})') from error
        from tgdsl.rl.playing.policy import read_policy
        from tgdsl.rl.train.folder import RunFolder, read_checkpoint
        from tgdsl.rl.train.ranks import Ranks

        ranks = Ranks.of()
        device = ranks.device(self.device)
        args.check_learning_device(device)
        folder = RunFolder(self.out or self.resume or Path("out") / self.task.stem)
        source = RunFolder(self.resume) if self.resume else None
        last_start = source.last_start() if source else {}
        is_same = source is not None and folder.path.resolve() == source.path.resolve()
        overrides = args.joined_overrides(last_start.get("overrides", {}) if is_same else {}, args.parsed_overrides(self.set))
        loaded = load_task(self.task, overrides)
        if self.init is not None and self.resume is not None:
            raise TgdslError(
                "found both --init and --resume, expected one: --resume goes on from a checkpoint, with its critic"
            )
        start = read_policy(self.init) if self.init is not None else None
        args.check_least(self, envs=1, iterations=1, minutes=0.0, episodes=0)
        with folder.lock() if ranks.is_first else nullcontext():
            if ranks.is_first:
                folder.check(is_resumed=is_same)
            state = read_checkpoint(source.checkpoint) if source else None
            ranks.join(device)
            try:
                self._learn(loaded, folder, ranks, device, overrides, last_start, state, start)
            finally:
                ranks.leave()

    def _learn(
        self,
        loaded: LoadedTask,
        folder: RunFolder,
        ranks: Ranks,
        device: str,
        overrides: dict[str, Any],
        before: dict[str, Any],
        state: dict[str, Any] | None,
        start: PolicyFile | None,
    ) -> None:
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.train.folder import changes, run_origin
        from tgdsl.rl.train.learner import Learner
        from tgdsl.rl.train.run import Run, restore

        envs = self.envs or before.get("envs", ENVS)
        seed = self.seed if self.seed is not None else before.get("seed", 0)
        with StatusLine() as progress:
            env = TouchEnv(loaded, envs, device=device, seed=seed, first_env=ranks.rank * envs, progress=progress)
        try:
            learner = Learner(env, loaded, seed, ranks)
            if state is not None and self.resume is not None:
                restore(learner, state, self.resume / "checkpoint.pt")
                learner.change_rates(before.get("spec", {}).get("train", {}))
            origin = run_origin(loaded, env, seed, overrides, ranks.size)
            if start is not None:
                learner.start_from(start)
                origin["starts_from"] = str(start.file)
            if self.resume is not None:
                origin["goes_on_from"] = str(self.resume)
            if ranks.is_first:
                for line in changes(before, origin, type(loaded.spec)) if before else ():
                    end = "; a run that goes on keeps its deviations" if line.startswith(INITIAL_STD) else ""
                    print(f"changed since the run began: {line}{end}")
                folder.begin(origin, loaded, env)
            resume = shlex.join(["tgdsl", "train", str(self.task), "--device", self.device, "--resume", str(folder.path)])
            run = Run(learner, folder, loaded.spec.train.checkpoint, resume, state["seconds"] if state else 0.0)
            if ranks.is_first and run.board is None:
                print(f"TensorBoard is not installed: the curve is in {folder.curve} alone")
            with learner_page(learner) if self.view and ranks.is_first else nullcontext():
                run.learn_with_bar(self.iterations, self.minutes, loaded.spec.train.iterations)
            if ranks.is_first:
                with run.named_in_file_errors():
                    self._finish(learner, folder, origin, run)
        finally:
            env.close()

    def _finish(self, learner: Learner, folder: RunFolder, origin: dict[str, Any], run: Run) -> None:
        """Write the policy, evaluate it unless the run was stopped, and say so."""
        from tgdsl.rl.playing.evaluation import evaluate
        from tgdsl.rl.playing.policy import policy_for, read_policy

        command = shlex.join(["tgdsl", *sys.argv[1:]])
        card = learner.card(origin, run.seconds, command)
        learner.write_policy(card, folder.policy)
        folder.evaluation.unlink(missing_ok=True)  # of what the policy was before
        summary = f"{learner.iteration} iterations, {learner.samples:,} steps, {run.seconds / 60:.1f} min"
        print(f"policy: {folder.policy}, after {summary}")
        run.end_if_stopped()
        if self.episodes:
            with StatusLine() as progress:
                actor = policy_for(learner.env, read_policy(folder.policy))
                evaluation = evaluate(learner.env, actor, self.episodes, progress=progress)
            learner.write_policy(card | {"score": evaluation.plain()}, folder.policy)
            args.write_json(folder.evaluation, evaluation.plain())
            print(evaluation)


@contextmanager
def learner_page(learner: Learner) -> Iterator[LoopPage]:
    """Show the environments of a learner in the browser; its page takes the processor time that learning leaves."""
    from tgdsl.rl.playing.stage import LearnerStage
    from tgdsl.view.mirror import LOWEST_PRIORITY, LoopPage

    stage = LearnerStage(learner.env)
    page = LoopPage(stage, priority=LOWEST_PRIORITY)
    print(f"view: {page.url}", flush=True)

    def send(moment: Moment) -> None:
        stage.keep(moment)
        page.refresh()

    learner.on_step = send
    try:
        yield page
    finally:
        learner.on_step = None
        page.close()
