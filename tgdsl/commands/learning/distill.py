"""`tgdsl distill`: students learn what a teacher does by what they feel, all of them in one simulation."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from tgdsl.commands.arguments import FOLDER, OUT_FOLDER, Overrides, Task, joined_overrides, parsed_overrides
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    from tgdsl.rl.load import LoadedTask
    from tgdsl.rl.spec import TaskSpec
    from tgdsl.rl.students.results import Row
    from tgdsl.rl.train.run import Run

Names = tyro.conf.arg(metavar="A,B,…")
ENVS = 13824
OPTIONS = {"touch": "types", "placement": "placements", "noise": "noise", "resolution": "resolutions"}
"""Keys of a task's document that an option of the command replaces."""


@dataclass(frozen=True)
class Distill:
    """Teach students by DAgger, as the document's `distill` says, and evaluate them; write a table, curves and the students.

    There is one per type, placement, noise and seed, all in one simulation per resolution.
    """

    task: Task
    teacher: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The teacher: a policy with its card, as tgdsl train writes it."""
    types: Annotated[str | None, Names] = None
    """What students feel: types as `touch` has them, none among them, or all; default: all."""
    placements: Annotated[str | None, Names] = None
    """Link groups that feel; default: the document's `placement`."""
    noise: Annotated[str | None, Names] = None
    """Profiles of noise; default: the document's `noise`."""
    resolutions: Annotated[str | None, Names] = None
    """How densely they feel: a simulation each, one after the other; default: the document's `resolution`."""
    seeds: int | None = None
    """Students of each kind; default: 3."""
    envs: int | None = None
    """Environments of a simulation; default: about 13824, so that they divide among the students."""
    device: str = "cuda"
    """Where physics, touch and networks are computed: cuda, or cpu."""
    iterations: int | None = None
    """Iterations of each simulation, those made before included; default: distill.iterations of the document."""
    minutes: float | None = None
    """Time to learn from now on in each simulation [min], start-up not counted; default: no limit."""
    seed: int | None = None
    """Seed of the environments; default: 0."""
    resume: Annotated[Path | None, FOLDER] = None
    """Folder of a run that goes on from its last checkpoints, with the same students and overrides."""
    out: Annotated[Path | None, OUT_FOLDER] = None
    """Folder of the run, with one per resolution in it; default: out/NAME_students."""
    episodes: int = 1000
    """Episodes of each student's evaluation at the end; 0: none."""
    set: Overrides = ()

    def run(self) -> None:
        """Teach.

        Raises:
            TgdslError: If something is wrong; nothing has run then.
        """
        from tgdsl.rl.load import load_task
        from tgdsl.rl.train.folder import RunFolder

        if self.resume is not None and self.out is not None:
            raise TgdslError(f"--out {self.out}: a run goes on in its own folder, {self.resume}")
        folder = self.resume or self.out or Path("out") / f"{self.task.stem}_students"
        last_start = _read(folder) if self.resume else {}
        given = parsed_overrides(self.set)
        overrides = joined_overrides(last_start.get("overrides", {}), given)
        loaded = load_task(self.task, overrides)
        self._check(given, last_start.get("overrides", {}))
        settings = self._asked(loaded, last_start, folder)
        prepared = [_Part(self, name, settings, overrides, folder / name) for name in settings["resolutions"]]
        settings["envs"] = prepared[0].envs
        with RunFolder(folder).lock():
            self._teach(loaded, folder, prepared)

    def _teach(self, loaded: LoadedTask, folder: Path, prepared: list[_Part]) -> None:
        """Teach the students of each resolution, and write the table of all."""
        from tgdsl.rl.students.results import shown, write_table

        if self.resume is None:
            _check_new(folder, [part.resolution for part in prepared])
        for part in prepared:
            part.check(is_resumed=self.resume is not None)
        for line in prepared[0].teacher.changes:
            print(f"changed since the teacher was learned: {line}")
        rows: list[Row] = []
        unit = ""
        table = folder / "table.csv"
        for part in prepared:
            part_result, unit = part.taught(folder / "distill.json" if part is prepared[0] else None)
            rows += part_result
        _warn_unlike(rows)
        if rows:
            write_table(rows, table)
            print(f"{shown(rows, unit, loaded.task.is_less_better)}\ntable: {table}")
        else:
            table.unlink(missing_ok=True)  # of what the students were before

    def _check(self, overrides: dict[str, str], before: dict[str, Any]) -> None:
        for key, option in OPTIONS.items():
            if key in overrides and (key == "touch" or getattr(self, option) is not None):
                raise TgdslError(f"--set {key}={overrides[key]}: --{option} says it of students")
            if key in overrides and self.resume is not None and overrides[key] != before.get(key):
                raise TgdslError(f"--set {key}={overrides[key]}: what students feel stays as it is in a run that goes on")
        for name, least in (("envs", 1), ("iterations", 1), ("minutes", 0.0), ("episodes", 0), ("seeds", 1)):
            value = getattr(self, name)
            if value is not None and not value >= least:
                raise TgdslError(f"--{name} {value}: expected at least {least}")

    def _asked(self, loaded: LoadedTask, before: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Return who is taught, by whom and where, as plain values.

        Args:
            loaded: The task's document.
            before: What a run that goes on began with.
            folder: Its folder.

        Raises:
            TgdslError: If a run that goes on shall teach others, there is no teacher, or no resolution, or one is named twice.
        """
        spec = loaded.spec
        options: dict[str, Any] = {
            "teacher": self._teacher(before, folder),
            "types": _names(self.types),
            "placements": _names(self.placements),
            "noise": _names(self.noise),
            "seeds": self.seeds,
            "resolutions": _names(self.resolutions),
            "envs": self.envs,
            "seed": self.seed,
        }
        for name, value in options.items():
            if before and name != "teacher" and value is not None and value != before[name]:
                raise TgdslError(f"--{name} {_text(value)}: this run began with {_text(before[name])}; begin another one")
        default = {"types": ["all"], "placements": [spec.placement], "noise": [spec.noise], "seeds": 3, "seed": 0}
        default |= {"resolutions": [spec.resolution or "default"], "envs": None, "teacher": None}
        settings = {name: value if value is not None else before.get(name, default[name]) for name, value in options.items()}
        if settings["teacher"] is None:
            raise TgdslError("--teacher FILE is missing: a policy, as tgdsl train writes it")
        names = settings["resolutions"]
        if not names:
            raise TgdslError("--resolutions: expected one at least")
        if self.resolutions is not None and "default" in names:
            problem = "that is what a run calls the document's own; leave it out, and --set resolution=default"
            raise TgdslError(f"--resolutions {_text(names)}: {problem}")
        if len(set(names)) < len(names):
            raise TgdslError(f"--resolutions {_text(names)}: one is named twice")
        return settings

    def _teacher(self, before: dict[str, Any], folder: Path) -> str | None:
        """Return the teacher's name; of a run that goes on the one that it began with, wherever that is now: told by its bytes.

        Raises:
            TgdslError: If another one is named.
        """
        from tgdsl.rl.train.folder import RunFolder

        if self.teacher is None or not before:
            return None if self.teacher is None else str(self.teacher)
        if self.teacher.resolve() == Path(before["teacher"]).resolve():
            return before["teacher"]
        parts = [RunFolder(folder / name) for name in before["resolutions"]]
        teacher_hashes = {part.last_start().get("teacher_sha256") for part in parts if part.run.is_file()}
        if self.teacher.is_file() and teacher_hashes == {hashlib.sha256(self.teacher.read_bytes()).hexdigest()}:
            return str(self.teacher)
        raise TgdslError(f"--teacher {self.teacher}: this run began with {before['teacher']}; begin another one")


class _Part:
    """The students of one resolution: one simulation."""

    def __init__(self, command: Distill, resolution: str, asked: dict[str, Any], overrides: dict[str, Any], folder: Path):
        """See that all fits together.

        Raises:
            TgdslError: If something does not.
        """
        from tgdsl.rl.load import load_task
        from tgdsl.rl.sensed import check_felt, num_variants
        from tgdsl.rl.students.keys import Teacher, check_blocks, feels, student_keys, students_task
        from tgdsl.rl.train.folder import RunFolder

        self._command, self.resolution, self._asked, self._folder = command, resolution, asked, RunFolder(folder)
        override = {} if resolution == "default" else {"resolution": resolution}
        self._given, self._overrides = overrides, overrides | override
        self._loaded = students_task(load_task(command.task, self._overrides))
        types = _known(self._loaded, asked["types"])
        self._keys = student_keys(types, asked["placements"], asked["noise"], asked["seeds"])
        self.teacher = Teacher(Path(asked["teacher"]), self._loaded)
        self._felt = feels(self._keys, self.teacher.felt)
        check_felt(self._loaded, self._felt)
        unit = len(self._keys) * num_variants(self._loaded)
        self.envs = asked["envs"] or max(1, ENVS // unit) * unit
        check_blocks(self.envs, len(self._keys), num_variants(self._loaded))

    def check(self, is_resumed: bool) -> None:
        """Read the checkpoint; see that the run can begin or go on in its folder, and that a teacher feels with its taxels.

        Raises:
            TgdslError: If not.
        """
        from tgdsl.files.write import check_writable
        from tgdsl.rl.sensed import compile_sensed
        from tgdsl.rl.train.folder import read_checkpoint

        self._goes_on = is_resumed and self._folder.has_run  # one that had not begun begins
        if self._goes_on:
            self._folder.check(is_resumed=True)
        self._state = read_checkpoint(self._folder.checkpoint) if self._goes_on else None
        check_writable(self._folder.checkpoint)
        self.teacher.check_taxels()
        if len(self._asked["resolutions"]) > 1:  # else it is compiled next
            compile_sensed(self._loaded, "cpu", feels=self._felt)

    def taught(self, file: Path | None) -> tuple[list[Row], str]:
        """Teach, write and evaluate; return the table's rows, and the unit of the score.

        Args:
            file: Where what the run goes on with is written, once nothing is refused any more; None: it has been.
        """
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.playing.policy import changes_around
        from tgdsl.rl.students.learner import Distiller
        from tgdsl.rl.train.folder import run_origin
        from tgdsl.rl.train.run import Run, restore

        command, folder, loaded, seed = self._command, self._folder, self._loaded, self._asked["seed"]
        state = self._state
        with StatusLine() as progress:
            env = TouchEnv(loaded, self.envs, device=command.device, seed=seed, feels=self._felt, progress=progress)
        try:
            distiller = Distiller(env, loaded, self.teacher.bound(env), self._keys, seed)
            for line in changes_around(self.teacher.card, loaded, env.sim.model) if file is not None else ():
                print(f"changed since the teacher was learned: {line}")
            if state is not None:
                restore(distiller, state, folder.checkpoint)
            origin = run_origin(loaded, env, seed, self._overrides, 1) | {"teacher": self._asked["teacher"]}
            origin["teacher_sha256"] = hashlib.sha256(self.teacher.saved.content).hexdigest()
            taught = {"students": [key.name for key in distiller.keys], "iteration": distiller.iteration}
            for line in self._changes(origin, type(loaded.spec)) if self._goes_on else ():
                print(f"changed since the run began: {line}")
            if file is not None:
                relative_path = os.path.relpath(Path(self._asked["teacher"]).resolve(), file.parent.resolve())
                _write(file, self._asked | {"overrides": self._given, "teacher_from_here": relative_path})
            folder.begin(origin | taught, loaded, env)
            run = Run(distiller, folder, loaded.spec.distill.checkpoint, state["seconds"] if state else 0.0)
            print(f"{len(self._keys)} students in {len(distiller.rollouts)} stacks, {self.envs} environments: {folder.path}")
            run.learn_with_bar(command.iterations, command.minutes, loaded.spec.distill.iterations)
            return self._finish(distiller, origin, run), env.task.score_unit
        finally:
            env.close()

    def _changes(self, origin: dict[str, Any], model: type[TaskSpec]) -> list[str]:
        """Return the changes since the run was last started, a line each."""
        from tgdsl.rl.train.folder import changes

        last_start = self._folder.last_start()
        other = last_start.get("teacher_sha256", origin["teacher_sha256"]) != origin["teacher_sha256"]
        return [*changes(last_start, origin, model), *(["the teacher's file"] if other else [])]

    def _finish(self, distiller: Any, origin: dict[str, Any], run: Run) -> list[Row]:
        """Evaluate the students unless the run was stopped, write them, and return the table's rows."""
        from tgdsl.rl.playing.evaluation import evaluate_each
        from tgdsl.rl.students.results import rows_of, write_students
        from tgdsl.rl.train.run import end_if_stopped

        command, keys, is_evaluated = self._command, distiller.keys, self._command.episodes > 0 and run.stopped_by is None
        result, text = [], shlex.join(["tgdsl", *sys.argv[1:]])
        with StatusLine() as progress:
            if is_evaluated:
                acting = distiller.acting()
                result = evaluate_each(distiller.env, acting, len(keys), command.episodes, progress=progress)
            students = self._folder.path / "students"
            write_students(distiller, self._loaded, origin, run.seconds, text, result, students, progress)
        resume = ("--device", command.device, "--resume", str(self._folder.path.parent))
        end_if_stopped(run, shlex.join(["tgdsl", "distill", str(command.task), *resume]))
        if not result:
            self._folder.evaluation.unlink(missing_ok=True)  # of what they were before
            return []
        plain = {key.name: evaluation.plain() for key, evaluation in zip(keys, result, strict=True)}
        _write(self._folder.evaluation, plain)
        return rows_of(keys, result, self.resolution, distiller.samples // len(keys), round(run.seconds / 60.0, 2))


def _warn_unlike(rows: list[Row]) -> None:
    """Say of resolutions that had unlike numbers of control steps: their scores do not compare."""
    steps = {row.resolution: row.samples for row in rows}
    if steps and max(steps.values()) > 1.1 * min(steps.values()):
        step_counts = ", ".join(f"{name} {number:,}" for name, number in steps.items())
        warnings.warn(
            f"students had unlike numbers of control steps, {step_counts}: `--iterations` makes them alike", stacklevel=3
        )


def _check_new(folder: Path, resolutions: list[str]) -> None:
    """See that a folder holds no run yet.

    Raises:
        TgdslError: If it does.
    """
    results_file = folder / "distill.json"
    other_files = [
        folder / "table.csv",
        *(folder / name / file for name in resolutions for file in ("run.json", "checkpoint.pt")),
    ]
    if results_file.exists():
        raise TgdslError(f"{folder}: this folder holds a run; go on with --resume {folder}, or give another --out")
    for file in other_files:
        if file.exists():
            raise TgdslError(f"{folder}: this folder holds {file.relative_to(folder)} of a run; give another --out")


def _known(loaded: LoadedTask, types: list[str]) -> list[str]:
    """Return the types, `all` as all that the sensors' document has sensors for."""
    from tgdsl.rl.sensed import types_of

    return [name for type_ in types for name in (types_of(loaded) if type_ == "all" else [type_])]


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _write(file: Path, plain: dict[str, Any]) -> None:
    from tgdsl.files.write import atomic_write, with_folder

    with_folder(file)
    atomic_write(file, (json.dumps(plain, indent=2, ensure_ascii=False) + "\n").encode())


def _read(folder: Path) -> dict[str, Any]:
    """Return what a run was asked for, its teacher as it is named in the working folder."""
    file = folder / "distill.json"
    try:
        result = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise TgdslError(f"{file}: there is no run of tgdsl distill to go on with: {error}") from error
    names = ("teacher", "types", "placements", "noise", "seeds", "resolutions", "envs", "seed", "overrides")
    if missing := [name for name in names if not isinstance(result, dict) or name not in result]:
        raise TgdslError(f"{file}: it has no {missing[0]}: this is not what tgdsl distill writes")
    teacher_file = (folder.resolve() / result.get("teacher_from_here", "")).resolve()
    is_elsewhere = teacher_file.is_file() and teacher_file != Path(result["teacher"]).resolve()
    return result | {"teacher": os.path.relpath(teacher_file)} if is_elsewhere else result
