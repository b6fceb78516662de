"""`tgdsl export-dataset`: episodes with touch as a dataset that others' tools read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tgdsl.commands import arguments as args
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError
from tgdsl.files.write import as_file_error, check_writable, with_folder

if TYPE_CHECKING:
    from tgdsl.rl.datasets.dataset import Episode, Header


@dataclass(frozen=True)
class ExportDataset:
    """Write episodes with touch as a dataset: joints, set-points, force per taxel, rewards, success."""

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """A task (.yaml), readings of `tgdsl run`, or a log of `tgdsl hand record` (.npz)."""
    to: Literal["lerobot", "mcap", "zarr"] = "lerobot"
    """Format: LeRobot v3.0, an MCAP file of JSON messages, or a Zarr store."""
    out: args.OptionalOutFolder = None
    """Folder of the dataset; default: out/NAME_FORMAT, such as out/find_ridge_lerobot."""
    policy: args.OptionalFile = None
    """Tasks: the policy that acts; default: --actions."""
    actions: Annotated[str, tyro.conf.arg(metavar="ACTIONS")] = "zero"
    """Tasks without a policy: the actions, as for `tgdsl play`."""
    source: Annotated[str, tyro.conf.arg(metavar="SOURCE")] = "environments"
    """Where a policy acts: environments (of the task, in parallel), or emulator, xhand1:PORT or a log, as for `tgdsl deploy`.
    The last three need a policy with `agg_force`."""
    episodes: int = 16
    """Tasks: number of episodes."""
    envs: int = 16
    """Tasks: number of parallel environments."""
    seconds: args.OptionalFloat = None
    """Hands: longest duration of an episode [s]; default: the task's."""
    fps: args.OptionalFloat = None
    """Frame rate [Hz]; default: one frame per control step, or 30 for a log."""
    reading: args.OptionalName = None
    """Name of the reading with forces on taxels; default: the first."""
    success_score: args.OptionalFloat = None
    """Least score of a success, in the task's unit; default: an episode that lasts to its time limit succeeds."""
    goal: args.OptionalNumbers = ()
    """Hands: the goal, in the task's units, such as a force [N]; default: the task's goals."""
    calibration: args.OptionalFile = None
    """Hands and logs: the calibration file; default: the log's."""
    side: Annotated[Literal["right", "left"] | None, args.optional("{right,left}")] = None
    """Logs: side of the hand, the prefix of link and joint names; default: names without a prefix."""
    lockstep: bool = False
    """Run faster than real time: the emulator waits for each step, a log is read as fast as possible."""
    device: args.DeviceName = "cpu"
    """Device of the environments: cpu or cuda."""
    seed: args.Seed = 0
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.rl.datasets.dataset import write_lerobot, write_mcap, write_zarr

        out = self.out or Path("out") / f"{self.input.stem}_{self.to}"
        if out.exists():
            raise TgdslError(f"{out}: is there already; remove it, or name another folder with --out")
        check_writable(out)
        args.check_least(self, episodes=1)
        header, episodes = self._recorded() if self.input.suffix == ".npz" else self._played()
        with (
            as_file_error(out),
            StatusLine() as progress,
            TemporaryDirectory(prefix=f".{out.name}", dir=with_folder(out).parent) as temporary,
        ):
            progress("writing episodes")
            partial = Path(temporary) / out.name
            partial.mkdir()
            write = {"lerobot": write_lerobot, "mcap": write_mcap, "zarr": write_zarr}[self.to]
            num, frames = write(header, episodes, partial)
            partial.rename(out)
        touch = f"touch in {header.unit} on {len(header.links)} links"
        print(f"{out}: {num} episodes, {frames} frames at {header.fps:g} Hz; {touch}")

    def _recorded(self) -> tuple[Header, Iterator[Episode]]:
        from tgdsl.files.arrays import read_arrays
        from tgdsl.rl.datasets.sources import of_log, of_run

        expected = "a recording of tgdsl run, or a log of tgdsl hand record"
        if self.policy is not None:
            raise TgdslError(f"--policy {self.policy}: a recording has its actions; a policy acts on a task: see --source")
        arrays = read_arrays(self.input, expected, only=("about", "document"))  # a log's readings may be gigabytes
        if "about" in arrays:
            return of_log(self.input, self.fps, args.calibration_of(self.calibration), self.side)
        document = str(arrays.get("document", ""))
        if not document:
            names = list(read_arrays(self.input, expected))
            contents = ", ".join([*names[:6], *(["…"] if len(names) > 6 else [])]) or "no array"
            hint = "to export what a policy does, name its task"
            raise TgdslError(f"{self.input}: found {contents}; expected {expected}; {hint}")
        with StatusLine() as progress:
            touch = args.module_of(Path(document), self.set, progress)
        return of_run(self.input, touch, self.fps, self.reading)

    def _played(self) -> tuple[Header, Iterator[Episode]]:
        from tgdsl.rl.datasets.sources import of_deployment, of_environments
        from tgdsl.rl.deploying.deploy import Deployment
        from tgdsl.rl.env import TouchEnv

        overrides, least = args.parsed_overrides(self.set), self.success_score
        if self.source != "environments":
            if self.policy is None:
                raise TgdslError(f"--source {self.source}: name the policy that acts there with --policy")
            with StatusLine() as progress:
                options = {"goal": self.goal, "overrides": overrides, "seed": self.seed, "lockstep": self.lockstep}
                options |= {"calibration": self.calibration, "progress": progress}
                deployment = Deployment(self.input, self.policy, self.source, **options)
            return of_deployment(deployment, self.episodes, self._unit(), self.seconds, self.fps, least)
        saved, envs = args.saved_policy(self.policy), min(self.envs, self.episodes)
        with StatusLine() as progress:
            env = TouchEnv(self.input, envs, device=self.device, seed=self.seed, overrides=overrides, progress=progress)
        actor = args.actor_for(env, saved, self.actions, self.seed)
        return of_environments(env, actor, self.episodes, self.fps, self.reading, least)

    def _unit(self) -> str:
        """Return the unit of a hand's forces: what the calibration says, or the log."""
        from tgdsl.runtime.xhand1.log.log import open_log

        calibration = args.calibration_of(self.calibration)
        if calibration is None and self.source.endswith(".npz"):
            calibration = open_log(self.source).calibration
        return "counts" if calibration is None else calibration.units
