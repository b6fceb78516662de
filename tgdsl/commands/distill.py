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

from tgdsl.commands import arguments as args
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError
from tgdsl.files.write import check_writable

if TYPE_CHECKING:
    from tgdsl.rl.load import LoadedTask
    from tgdsl.rl.students.results import Row
    from tgdsl.rl.train.run import Run

Names = Annotated[str | None, args.optional("A,B,…")]
ENVS = 13824
# keys of a task's document that an option of the command replaces
OPTIONS = {"touch": "types", "placement": "placements", "noise": "noise", "resolution": "resolutions"}


@dataclass(frozen=True)
class Distill:
    """Teach students by DAgger with the document's `distill` settings, and evaluate them; write students, curves and a table.

    Each combination of type, placement, noise and seed has a student. All students of a resolution share one simulation.
    """

    task: args.Task
    teacher: args.OptionalFile = None
    """The teacher: a policy of `tgdsl train`, and its card; required for a new run."""
    types: Names = None
    """Types of touch, as for the key `touch` of a task (`none` is one of them), or all; default: all."""
    placements: Names = None
    """Link groups with taxels; default: the document's `placement`."""
    noise: Names = None
    """Noise profiles; default: the document's `noise`."""
    resolutions: Names = None
    """Resolutions of the layout, in one simulation after the other; default: the document's `resolution`."""
    seeds: args.OptionalInt = None
    """Seeds per type, placement and noise; default: 3."""
    envs: args.OptionalInt = None
    """Environments per simulation; default: about 13824, a multiple of the number of students."""
    device: args.Device = "cuda"
    iterations: args.OptionalInt = None
    """Iterations per simulation, including earlier parts of the run; default: `distill.iterations` of the document."""
    minutes: args.OptionalFloat = None
    """Learning time per simulation from now on, without start-up [min]; default: no limit."""
    seed: args.OptionalInt = None
    """Seed of the environments; default: 0."""
    resume: args.OptionalFolder = None
    """Folder of an earlier run to continue from its last checkpoints, with its students and overrides; default: a new run."""
    out: args.OptionalOutFolder = None
    """Folder of the run, with a subfolder per resolution; default: out/NAME_students."""
    episodes: int = 1000
    """Episodes per student in the final evaluation; 0: no evaluation."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.rl.load import load_task
        from tgdsl.rl.train.folder import RunFolder

        if self.resume is not None and self.out is not None:
            raise TgdslError(f"--out {self.out}: a run goes on in its own folder, {self.resume}")
        folder = self.resume or self.out or Path("out") / f"{self.task.stem}_students"
        last_start = _read(folder) if self.resume else {}
        new = args.parsed_overrides(self.set)
        overrides = args.joined_overrides(last_start.get("overrides", {}), new)
        loaded = load_task(self.task, overrides)
        self._check(new, last_start.get("overrides", {}))
        settings = self._settings(loaded, last_start, folder)
        parts = [_Part(self, name, settings, overrides, folder / name) for name in settings["resolutions"]]
        settings["envs"] = parts[0].envs
        with RunFolder(folder).lock():
            self._teach(loaded, folder, parts)

    def _teach(self, loaded: LoadedTask, folder: Path, parts: list[_Part]) -> None:
        """Teach the students of each resolution, and write the table of all."""
        from tgdsl.rl.students.results import shown, write_table

        if self.resume is None:
            _check_new(folder, [part.resolution for part in parts])
        for part in parts:
            part.check(is_resumed=self.resume is not None)
        args.print_changes("teacher", parts[0].teacher.changes)
        rows: list[Row] = []
        unit, table = "", folder / "table.csv"
        for part in parts:
            part_rows, unit = part.teach(folder / "distill.json" if part is parts[0] else None)
            rows += part_rows
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
        args.check_least(self, envs=1, iterations=1, minutes=0.0, episodes=0, seeds=1)
        args.check_learning_device(self.device)

    def _settings(self, loaded: LoadedTask, before: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Return who is taught, by whom and where, as plain values; `before`: the same of a run that goes on in a folder."""
        spec = loaded.spec
        options: dict[str, Any] = {"teacher": self._teacher(before, folder)}
        options |= {name: _names(getattr(self, name)) for name in OPTIONS.values()}
        options |= {name: getattr(self, name) for name in ("seeds", "envs", "seed")}
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
        """Return the teacher's file; a run that goes on keeps its teacher, which has the same bytes wherever it is now."""
        from tgdsl.rl.train.folder import RunFolder

        if self.teacher is None or not before:
            return None if self.teacher is None else str(self.teacher)
        if self.teacher.resolve() == Path(before["teacher"]).resolve():
            return before["teacher"]
        parts = [RunFolder(folder / name) for name in before["resolutions"]]
        hashes = {part.last_start().get("teacher_sha256") for part in parts if part.run.is_file()}
        if self.teacher.is_file() and hashes == {hashlib.sha256(self.teacher.read_bytes()).hexdigest()}:
            return str(self.teacher)
        raise TgdslError(f"--teacher {self.teacher}: this run began with {before['teacher']}; begin another one")


class _Part:
    """The students of one resolution: one simulation."""

    def __init__(self, command: Distill, resolution: str, settings: dict[str, Any], overrides: dict[str, Any], folder: Path):
        from tgdsl.rl.load import load_task
        from tgdsl.rl.sensors import check_touch, num_variants, types_of
        from tgdsl.rl.students.keys import Teacher, check_blocks, student_keys, students_task, touches
        from tgdsl.rl.train.folder import RunFolder

        self._command, self.resolution, self._settings, self._folder = command, resolution, settings, RunFolder(folder)
        self._given, self._overrides = overrides, dict(overrides)
        if resolution != "default":
            self._overrides["resolution"] = resolution
        self._loaded = students_task(load_task(command.task, self._overrides))
        types = [name for type_ in settings["types"] for name in (types_of(self._loaded) if type_ == "all" else [type_])]
        self._keys = student_keys(types, settings["placements"], settings["noise"], settings["seeds"])
        self.teacher = Teacher(Path(settings["teacher"]), self._loaded)
        self._touches = touches(self._keys, self.teacher.touch)
        check_touch(self._loaded, self._touches)
        unit = len(self._keys) * num_variants(self._loaded)
        self.envs = settings["envs"] or max(1, ENVS // unit) * unit
        check_blocks(self.envs, len(self._keys), num_variants(self._loaded))

    def check(self, is_resumed: bool) -> None:
        """Read the checkpoint; raise an error if the run cannot begin or go on, or the teacher feels with other taxels."""
        from tgdsl.rl.sensors import compile_sensors
        from tgdsl.rl.train.folder import read_checkpoint

        self._goes_on = is_resumed and self._folder.has_run  # one that had not begun begins
        if self._goes_on:
            self._folder.check(is_resumed=True)
        self._state = read_checkpoint(self._folder.checkpoint) if self._goes_on else None
        check_writable(self._folder.checkpoint)
        self.teacher.check_taxels()
        if len(self._settings["resolutions"]) > 1:  # else it is compiled next
            compile_sensors(self._loaded, "cpu", touches=self._touches)

    def teach(self, file: Path | None) -> tuple[list[Row], str]:
        """Teach, write and evaluate; return the table's rows, and the unit of the score.

        The settings are written to `file`, if one is given, once nothing is refused any more.
        """
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.playing.policy import changes_around
        from tgdsl.rl.students.learner import Distiller
        from tgdsl.rl.train.folder import run_origin
        from tgdsl.rl.train.run import Run, restore

        command, folder, loaded, state = self._command, self._folder, self._loaded, self._state
        teacher_file, seed = self._settings["teacher"], self._settings["seed"]
        with StatusLine() as progress:
            env = TouchEnv(loaded, self.envs, device=command.device, seed=seed, touches=self._touches, progress=progress)
        try:
            distiller = Distiller(env, loaded, self.teacher.bound(env), self._keys, seed)
            if file is not None:
                args.print_changes("teacher", changes_around(self.teacher.card, loaded, env.sim.model))
            if state is not None:
                restore(distiller, state, folder.checkpoint)
            origin = run_origin(loaded, env, seed, self._overrides, 1) | {"teacher": teacher_file}
            origin["teacher_sha256"] = hashlib.sha256(self.teacher.saved.content).hexdigest()
            if self._goes_on:
                self._print_changes(origin)
            if file is not None:
                relative_path = os.path.relpath(Path(teacher_file).resolve(), file.parent.resolve())
                args.write_json(file, self._settings | {"overrides": self._given, "teacher_from_here": relative_path})
            students = {"students": [key.name for key in distiller.keys], "iteration": distiller.iteration}
            folder.begin(origin | students, loaded, env)
            words = ["tgdsl", "distill", str(command.task), "--device", command.device, "--resume", str(folder.path.parent)]
            seconds = state["seconds"] if state else 0.0
            run = Run(distiller, folder, loaded.spec.distill.checkpoint, shlex.join(words), seconds)
            print(f"{len(self._keys)} students in {len(distiller.rollouts)} stacks, {self.envs} environments: {folder.path}")
            run.learn_with_bar(command.iterations, command.minutes, loaded.spec.distill.iterations)
            with run.named_in_file_errors():
                return self._finish(distiller, origin, run), env.task.score_unit
        finally:
            env.close()

    def _print_changes(self, origin: dict[str, Any]) -> None:
        """Print the changes since the run's last start."""
        from tgdsl.rl.train.folder import changes

        last_start = self._folder.last_start()
        lines = list(changes(last_start, origin, type(self._loaded.spec)))
        if last_start.get("teacher_sha256", origin["teacher_sha256"]) != origin["teacher_sha256"]:
            lines.append("the teacher's file")
        for line in lines:
            print(f"changed since the run began: {line}")

    def _finish(self, distiller: Any, origin: dict[str, Any], run: Run) -> list[Row]:
        """Evaluate the students unless the run was stopped, write them, and return the table's rows."""
        from tgdsl.rl.playing.evaluation import evaluate_each
        from tgdsl.rl.students.results import rows_of, write_students

        command, keys, folder, result = self._command, distiller.keys, self._folder, []
        with StatusLine() as progress:
            if command.episodes > 0 and run.stopped_by is None:
                result = evaluate_each(distiller.env, distiller.acting(), len(keys), command.episodes, progress=progress)
            text, students = shlex.join(["tgdsl", *sys.argv[1:]]), folder.path / "students"
            write_students(distiller, self._loaded, origin, run.seconds, text, result, students, progress)
        run.end_if_stopped()
        if not result:
            folder.evaluation.unlink(missing_ok=True)  # of what they were before
            return []
        plain = {key.name: evaluation.plain() for key, evaluation in zip(keys, result, strict=True)}
        args.write_json(folder.evaluation, plain)
        return rows_of(
            keys,
            result,
            self._loaded.task.score_range,
            self.resolution,
            distiller.samples // len(keys),
            round(run.seconds / 60.0, 2),
        )


def _warn_unlike(rows: list[Row]) -> None:
    """Warn if students of some resolutions had more control steps than others: their scores do not compare."""
    steps = {row.resolution: row.samples for row in rows}
    if steps and max(steps.values()) > 1.1 * min(steps.values()):
        counts = ", ".join(f"{name} {number:,}" for name, number in steps.items())
        warnings.warn(f"students had unlike numbers of control steps, {counts}: `--iterations` makes them alike", stacklevel=3)


def _check_new(folder: Path, resolutions: list[str]) -> None:
    """Raise an error if a folder holds a run already."""
    if (folder / "distill.json").exists():
        raise TgdslError(f"{folder}: this folder holds a run; go on with --resume {folder}, or give another --out")
    student_files = [folder / name / file for name in resolutions for file in ("run.json", "checkpoint.pt")]
    for file in (folder / "table.csv", *student_files):
        if file.exists():
            raise TgdslError(f"{folder}: this folder holds {file.relative_to(folder)} of a run; give another --out")


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _read(folder: Path) -> dict[str, Any]:
    """Return the settings of a run, its teacher as it is named in the working folder."""
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
