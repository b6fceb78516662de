"""`tgdsl view`: a live page in the browser of a document, a task, a recorded run, or an XHand1 and its logs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from os.path import isfile  # of a text that can be no file's name, it is False
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands import arguments as args
from tgdsl.console.progress import StatusLine
from tgdsl.errors import SpecError, TgdslError

if TYPE_CHECKING:
    from tgdsl.view.stages import Stage


@dataclass(frozen=True)
class View:
    """Open a live page in the browser: robot and objects, taxels coloured by their readings, a slider per actuator.

    The page of a document follows the files: a document, layout or robot that is saved is shown within seconds, mistakes with
    their lines.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """A document or a task (.yaml), an artefact (.safetensors), readings of `tgdsl run` or a log of `tgdsl hand record` (.npz),
    `xhand1`, `xhand1:PORT` or `emulator`. A real hand is only read, never moved."""
    policy: args.OptionalFile = None
    """The policy that acts in a task; default: zero actions."""
    calibration: args.OptionalFile = None
    """The hand's calibration file; default: the log's, otherwise forces stay in counts."""
    envs: Annotated[int, tyro.conf.arg(metavar="INT")] = 1
    """Number of environments; the page shows one at a time."""
    port: int = 8080
    """Port of the page; if it is in use, the next free one."""
    address: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address of the server; with 0.0.0.0 others in the network can see and control the scene."""
    seed: args.Seed = 0
    seconds: args.OptionalFloat = None
    """Time after which the page closes [s]; default: at Ctrl-C."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.view.page import Page

        with StatusLine() as progress:
            stage = self._stage(progress)
            progress("starting the page")
            page = Page(stage, self.address, self.port)
        print(f"{self.source}: {page.url}   (Ctrl-C ends it)", flush=True)
        try:
            page.run(self._watch(), float("inf") if self.seconds is None else self.seconds)
        except KeyboardInterrupt:
            pass
        finally:
            page.close()
            page.stage.close()

    def _stage(self, progress: StatusLine | None = None) -> Stage:
        """Return what the source is shown as."""
        from tgdsl.runtime.xhand1.log.log import is_hand_log, open_log
        from tgdsl.view.hand_stage import HandLogStage, live_hand
        from tgdsl.view.stages import RunStage, SceneStage, read_run

        if str(self.source).partition(":")[0] in ("xhand1", "emulator"):
            return live_hand(self.source, args.calibration_of(self.calibration))
        if is_hand_log(self.source):
            return HandLogStage(open_log(self.source), args.calibration_of(self.calibration))
        if self.calibration is not None:
            raise TgdslError(f"--calibration {self.calibration}: {self.source} is neither a hand nor the log of one")
        if self.source.suffix == ".npz":
            document = Path(str(read_run(self.source)["document"]))
            return RunStage(args.module_of(document, self.set, progress), self.source)
        if self._is_task():
            return self._task_stage(progress)
        if self.policy is not None:
            raise TgdslError(f"--policy {self.policy}: {self.source} is no task's document")
        return SceneStage(args.module_of(self.source, self.set, progress), self.envs)

    def _is_task(self) -> bool:
        from tgdsl.schema.load import read_source

        value = read_source(self.source).value if self.source.suffix in (".yaml", ".yml") else None
        return isinstance(value, dict) and "task" in value

    def _task_stage(self, progress: StatusLine | None) -> Stage:
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.playing.stage import TaskStage

        saved = args.saved_policy(self.policy)
        env = TouchEnv(self.source, self.envs, seed=self.seed, overrides=args.parsed_overrides(self.set), progress=progress)
        return TaskStage(env, args.actor_for(env, saved, seed=self.seed), self.seed)

    def _watch(self) -> Callable[[], Stage | str | None]:
        """Return a function that compiles the source again if it, or a file that it names, has been saved since."""
        seen = _named(self.source)

        def watch() -> Stage | str | None:
            nonlocal seen
            if all(_saved(file) == when for file, when in seen.items()) or _saved(self.source) is None:
                return None
            seen = _named(self.source)
            try:
                return self._stage()
            except TgdslError as error:  # a document's mistakes, each with its line
                return str(error)

        return watch


def _saved(file: Path) -> int | None:
    """Return when a file was saved; None while an editor replaces it."""
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return None


def _named(document: Path) -> dict[Path, int | None]:
    """Return when a document, and the files that it and the YAML files among them name, were saved."""
    result, left = dict[Path, int | None](), [document]
    while left:
        if (file := left.pop()) not in result:
            result[file] = _saved(file)
            if file.suffix in (".yaml", ".yml"):
                left += [path for text in _texts(file) if isfile(path := file.parent / text)]
    return result


def _texts(file: Path) -> list[str]:
    """Return all texts of a YAML file, which may be names of files; none if it cannot be read."""
    from tgdsl.schema.load import read_source

    left, result = list[object](), list[str]()
    with suppress(SpecError):
        left.append(read_source(file).value)
    while left:
        value = left.pop()
        left += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        result += [value] if isinstance(value, str) else []
    return result
