"""A run's folder: its origin, its progress, and what it has learned.

- `run.json`: the task with all defaults, overrides, seed, versions, hashes; an entry per start
- `task.yaml`, the sensors' document, the module of a user's task: copies
- `taxels.csv`: the taxels of all sensors
- `curve.csv`: a row per iteration
- `checkpoint.pt`: its state, to resume: see `run.py`
- `policy.pt`: the policy without exploration and its card, for `tgdsl play --policy`
- `policy.onnx`: the same for ONNX Runtime
- `evaluation.json`: the evaluation at the end
- `events.out.*`: TensorBoard's, if that is installed
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import hashlib
import io
import json
import os
import platform
import re
import sys
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from tgdsl.errors import TgdslError
from tgdsl.files.write import TEMPORARY, as_file_error, atomic_open, atomic_write, check_writable, new_folder, with_folder
from tgdsl.plan.plan import Plan
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.playing.policy import differences, provenance, spec_differences, taxel_csv
from tgdsl.rl.spec import TaskSpec

PACKAGES = ("tgdsl", "torch", "rsl-rl-lib", "tensordict", "mujoco", "mujoco-warp", "warp-lang", "numpy")
FORMAT = 1  # of checkpoints


class RunFolder:
    """The files of a run, at its `path`."""

    def __init__(self, path: Path):
        self.path, self.run, self.curve, self.board = path, path / "run.json", path / "curve.csv", path / "events.out.tfevents"
        self.checkpoint, self.policy, self.evaluation = (
            path / name for name in ("checkpoint.pt", "policy.pt", "evaluation.json")
        )

    @property
    def has_run(self) -> bool:
        """Whether there is a run with a checkpoint or an iteration."""
        return self.checkpoint.exists() or bool(self.rows())

    def check(self, is_resumed: bool) -> None:
        """Check that a run can begin or resume here, without writing."""
        if not is_resumed and self.has_run:
            raise TgdslError(f"{self.path}: this folder holds a run; go on with --resume {self.path}, or give another --out")
        if is_resumed and not self.checkpoint.is_file():
            raise TgdslError(f"{self.path}: there is no checkpoint.pt to go on with")
        if is_resumed:
            self.rows()
        check_writable(self.checkpoint)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the folder; the lock ends with the process. The folder is created, and removed if it stays empty."""
        with new_folder(check_writable(self.run)):
            folder = os.open(self.path, os.O_RDONLY)
            try:
                try:
                    fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError as error:
                    problem = "another process runs in this folder; wait until it has ended, or give another --out"
                    raise TgdslError(f"{self.path}: {problem}") from error
                except OSError:  # of a file system that has no locks
                    pass
                yield
            finally:
                os.close(folder)

    def begin(self, origin: Mapping[str, Any], loaded: LoadedTask, env: TouchEnv) -> None:
        """Write the origin of a run, or of its resumption; entries without a run are dropped."""
        with_folder(self.run)
        for file in self.path.iterdir():  # temporary files that a run which was killed has left
            if re.fullmatch(TEMPORARY.pattern + r"\.\w+", file.name):
                file.unlink(missing_ok=True)
        starts = [*(self._starts() if self.has_run else []), dict(origin)]
        atomic_write(self.run, (json.dumps({"starts": starts}, indent=2, ensure_ascii=False) + "\n").encode())
        for name, file in documents(loaded).items():
            atomic_write(self.path / name, file.read_bytes())
        atomic_write(self.path / "taxels.csv", taxel_csv(env.touch).encode())

    def last_start(self) -> dict[str, Any]:
        """Return the origin of the run's last start."""
        starts = self._starts()
        if not starts:
            raise TgdslError(f"{self.path}: there is no run to go on with: run.json is missing or empty")
        return starts[-1]

    def rows(self) -> list[dict[str, str]]:
        """Return the complete rows of the curve; a killed run may leave half a line, a machine that loses power zeros."""
        text = self.curve.read_text(encoding="utf-8", errors="replace") if self.curve.is_file() else ""
        complete = text[: text.rfind("\n") + 1]
        lines = csv.DictReader(io.StringIO(complete))
        rows = list[dict[str, str]]()
        for row in lines:
            if None in row or None in row.values() or not row.get("iteration", "").isdecimal():
                line = complete.splitlines()[lines.line_num - 1]
                expected = f"a value for each of {', '.join(lines.fieldnames or ())}"
                hint = "move this file away, and the run goes on with a new one"
                raise TgdslError(f"{self.curve}:{lines.line_num}: found {line!r}, expected {expected}; {hint}")
            rows.append(row)
        return rows

    def keep_rows(self, iterations: int) -> None:
        """Keep the curve's complete rows up to an iteration; later iterations run again."""
        rows = [row for row in self.rows() if int(row["iteration"]) <= iterations]
        text = io.StringIO()
        if rows:
            writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        if self.curve.is_file():
            atomic_write(self.curve, text.getvalue().encode())

    def add_row(self, row: Mapping[str, float | int]) -> None:
        """Append a row to the curve, with the columns of its header."""
        with as_file_error(self.curve), self.curve.open("a+", newline="", encoding="utf-8") as file:
            file.seek(0)
            names = next(csv.reader([file.readline()]), None) or list(row)
            file.seek(0, io.SEEK_END)
            writer = csv.DictWriter(file, names, restval="", extrasaction="ignore", lineterminator="\n")
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()})

    def _starts(self) -> list[dict[str, Any]]:
        try:
            return json.loads(self.run.read_text(encoding="utf-8"))["starts"] if self.run.is_file() else []
        except (OSError, ValueError) as error:
            raise TgdslError(f"{self.run}: cannot read this file: {error}") from error
        except (KeyError, TypeError) as error:
            raise TgdslError(f"{self.run}: expected a file that tgdsl wrote, with `starts`; give another --out") from error


class CheckpointError(TgdslError):
    """A checkpoint that cannot be read, or that does not fit."""


def write_checkpoint(state: Mapping[str, Any], file: Path) -> None:
    """Write a checkpoint to the disk, replacing an existing file atomically."""
    content = io.BytesIO()
    torch.save(dict(state), content)
    with atomic_open(file) as opened:
        opened.write(content.getbuffer())
        opened.flush()
        os.fsync(opened.fileno())


def read_checkpoint(file: Path) -> dict[str, Any]:
    """Return a checkpoint's state, on the CPU."""
    if not file.is_file():
        raise CheckpointError(f"{file}: there is no checkpoint")
    text = "a file of something else"
    try:
        content = io.BytesIO(file.read_bytes())
        state = torch.load(content, map_location="cpu", weights_only=True)
        if isinstance(state, dict) and state.get("format") == FORMAT:
            return state
        if isinstance(state, dict) and "format" in state:
            text = f"a checkpoint of format {state['format']}, not {FORMAT}, of another version of tgdsl"
        cause = None
    except OSError as error:
        raise CheckpointError(f"{file}: cannot read this file: {error.strerror or error}") from error
    except Exception as error:  # whatever torch and pickle raise
        if not zipfile.is_zipfile(content):
            text = f"{file.stat().st_size:,} bytes that are cut off, or of something else"
        cause = error
    hint = "put back a copy of one, or begin again with another --out"
    raise CheckpointError(f"{file}: found {text}, expected a checkpoint of `tgdsl train` or `tgdsl distill`; {hint}") from cause


def documents(loaded: LoadedTask) -> dict[str, Path]:
    """Return the files of the task's and the sensors' documents and of a user's task, by the names of their copies.

    Files with the same name get their folder's name as a prefix, as in `sub_palm.yaml`.
    """
    documents = [file for file in (Path(loaded.source.file), loaded.folder / loaded.spec.document) if file.is_file()]
    module = sys.modules.get(loaded.task.__module__)
    if not loaded.task.__module__.startswith("tgdsl.") and module is not None and module.__file__:
        documents.append(Path(module.__file__))
    if len({file.name for file in documents}) == len(documents):
        return {file.name: file for file in documents}
    return {f"{file.resolve().parent.name}_{file.name}": file for file in documents}


def run_origin(loaded: LoadedTask, env: TouchEnv, seed: int, overrides: Mapping[str, Any], processes: int) -> dict[str, Any]:
    """Return the origin of a run, as plain values."""
    device = env.device
    return {
        "task": loaded.source.file,
        "overrides": dict(overrides),
        "seed": seed,
        "envs": env.num_envs,
        "processes": processes,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine(),
        "spec": loaded.spec.model_dump(mode="json"),
        "groups": env.groups,
        "joints": list(env.joint_names),
        "module": _module_digest(env.touch.plan),
        "taxels": env.touch.taxels_id,
        **provenance(loaded, env.sim.model),
        "versions": versions(),
    }


def _module_digest(plan: Plan) -> str:
    """Return a hash of the compiled module, independent of its files' paths."""
    scene = replace(plan.scene, assets=tuple(replace(asset, path="") for asset in plan.scene.assets))
    plan = replace(plan, origin=replace(plan.origin, robot=""), scene=scene)
    return hashlib.sha256(plan.to_json().encode()).hexdigest()


def changes(before: Mapping[str, Any], now: Mapping[str, Any], model: type[TaskSpec]) -> list[str]:
    """Return the differences between the origins of two starts, a line each: the task's numbers, its seed, its sensors."""
    lines = spec_differences(before["spec"], now["spec"], model)
    lines += [line for name in ("seed", "envs") for line in differences(before[name], now[name], name)]
    descriptions = {"module": "the compiled module of the sensors' document", "taxels": "the table of taxels"}
    return lines + [description for name, description in descriptions.items() if before[name] != now[name]]


def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages that a run depends on."""
    result = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            result[package] = version(package)
        except PackageNotFoundError:
            continue
    return result
