"""The document of a sweep, and the runs that follow from it."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StrictInt

from tgdsl.commands.learning.distill import Distill
from tgdsl.commands.learning.train import Train
from tgdsl.errors import SpecError, did_you_mean
from tgdsl.fields.models import NonNegative, Positive, SpecModel
from tgdsl.rl.load import load_task
from tgdsl.schema.load import read_source
from tgdsl.schema.validation import validate
from tgdsl.schema.yaml import Source

COMMANDS = {"train": Train, "distill": Distill}
"""What a sweep may run."""
OWN = ("task", "out", "resume", "set")
"""Options that a sweep gives itself."""
WHOLE = {"--iterations": 1, "--envs": 1, "--episodes": 0, "--seeds": 1, "--seed": None}
"""Options that are whole numbers, and the least value of each; None: any."""


class SweepSpec(SpecModel):
    """Settings whose combinations are run, each by a command of its own."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    command: Literal["train", "distill"] = "train"
    """The command to run: `tgdsl train` or `tgdsl distill`."""
    task: str
    """The task's document, relative to this one."""
    fixed: dict[str, Any] = {}
    """Settings of all runs: values of the task by dotted path, and options of the command by name: `--seed: 1`.
    The path of a `--teacher` is relative to this document."""
    matrix: Annotated[dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]], Field(min_length=1)]
    """Settings that differ: each has a list, and every combination is run."""
    cpus: Positive = 1.0
    """Processors that a run takes."""
    gpus: NonNegative = 0.0
    """GPUs that a run takes; half a GPU: two runs share one."""
    retries: Annotated[StrictInt, Field(ge=0)] = 3
    """How often a run goes on whose worker has died."""


LONGEST = 200
"""Most characters of the name of a run, which a folder has."""


@dataclass(frozen=True)
class Trial:
    """One run of a sweep: its name, what of the matrix it has, and the command's words but for `--out` and `--resume`."""

    name: str
    settings: dict[str, Any]
    words: tuple[str, ...]


def load_sweep(file: Path) -> tuple[SweepSpec, list[Trial]]:
    """Return a sweep's spec and its trials; every trial's task is read, so that mistakes are named before one begins.

    Raises:
        SpecError: All mistakes, with file, line and column.
    """
    source = read_source(file)
    problems = list(source.problems)
    spec = validate(source, (), SweepSpec, problems, ("tgdsl", "task", "matrix"))
    if problems or not isinstance(spec, SweepSpec):
        raise SpecError(problems)
    _check_options(source, spec)
    _check_values(source, spec, file.parent)
    _check_below(source, spec)
    trials = []
    for values in itertools.product(*spec.matrix.values()):
        settings = dict(zip(spec.matrix, values, strict=True))
        every = {**spec.fixed, **settings}
        load_task(file.parent / spec.task, {name: value for name, value in every.items() if not name.startswith("--")})
        words = [spec.command, str((file.parent / spec.task).resolve())]
        for name, value in every.items():
            text = value if isinstance(value, str) else json.dumps(value)
            text = str((file.parent / text).resolve()) if name == "--teacher" else text
            words += [name, text] if name.startswith("--") else ["--set", f"{name}={text}"]
        name = ",".join(f"{name.lstrip('-')}={value}" for name, value in settings.items())
        trials.append(Trial(re.sub(r"[^\w.=,+-]", "_", name), settings, tuple(words)))
    _check_names(source, trials)
    return spec, trials


def _check_below(source: Source, spec: SweepSpec) -> None:
    """See that no setting lies below another one, which would replace it.

    Raises:
        SpecError: All that do.
    """
    places = [(place, name) for place in ("fixed", "matrix") for name in getattr(spec, place)]
    problems = []
    for place, name in places:
        for other, above in places:
            if (place, other) == ("matrix", "fixed") and name == above:
                problems.append(source.problem((place, name), f"{name} stands under {other} too", on_key=True))
            if name.startswith(f"{above}."):
                problem = f"lies below {other}.{above}, which would replace it: write it there, or single values here"
                problems.append(source.problem((place, name), f"{name} {problem}", on_key=True))
    if problems:
        raise SpecError(problems)


def _check_names(source: Source, trials: list[Trial]) -> None:
    """See that each trial has a name of its own, by which a folder can be called.

    Raises:
        SpecError: If not.
    """
    trial_of: dict[str, Trial] = {}
    for trial in trials:
        if len(trial.name) > LONGEST:
            problem = (
                f"the name of a run's folder has {len(trial.name)} characters, expected {LONGEST} at most: {trial.name[:60]}…"
            )
            raise SpecError([source.problem(("matrix",), problem)])
        if (other := trial_of.setdefault(trial.name, trial)) is not trial:
            alike = "two combinations are the same" if other.words == trial.words else "two combinations have one name"
            raise SpecError([source.problem(("matrix",), f"{alike}: {trial.name}")])


def _check_options(source: Source, spec: SweepSpec) -> None:
    options = {"--" + option.name for option in fields(COMMANDS[spec.command]) if option.name not in OWN}
    for place in ("fixed", "matrix"):
        for name in getattr(spec, place):
            if name.startswith("--") and name not in options:
                problem = f"`tgdsl {spec.command}` has no option {name} that a sweep may set"
                raise SpecError([source.problem((place, name), problem, did_you_mean(name, options, "options"), on_key=True)])
    if "--teacher" in options - spec.fixed.keys() - spec.matrix.keys():
        raise SpecError([source.problem(("command",), f"`tgdsl {spec.command}` needs a --teacher, under fixed or matrix")])


def _check_values(source: Source, spec: SweepSpec, folder: Path) -> None:
    """See that the command takes the options' values.

    Raises:
        SpecError: All values that it does not take.
    """
    fixed = [(("fixed", name), name, value) for name, value in spec.fixed.items()]
    listed = [(("matrix", name, i), name, value) for name, values in spec.matrix.items() for i, value in enumerate(values)]
    is_timed = "--minutes" in spec.fixed or "--minutes" in spec.matrix
    problems = []
    for path, name, value in (*fixed, *listed):
        if name.startswith("--") and (expected := _expected(name, value, folder, is_timed)):
            problems.append(source.problem(path, f"{name} is {json.dumps(value, default=str)}, expected {expected}"))
    if problems:
        raise SpecError(problems)


def _expected(name: str, value: Any, folder: Path, is_timed: bool) -> str:
    """Return what an option expects, where a value is something else; else nothing."""
    if name in WHOLE:
        least = WHOLE[name]
        is_right = type(value) is int and (least is None or value >= least)
        return "" if is_right else "a whole number" if least is None else f"a whole number of at least {least}"
    if name == "--minutes":
        return "" if type(value) in (int, float) and 0.0 < value < float("inf") else "a positive number"
    if not isinstance(value, str):
        return "a text, as on the command line"
    if name == "--device" and not re.fullmatch(r"cpu|cuda(:\d+)?", value):
        return "cuda or cpu"
    if name == "--teacher" and not (folder / value).is_file():
        return f"a policy: there is no file {folder / value}"
    if name == "--resolutions" and "," in value and is_timed:
        return "one, as --minutes count for each: list them under matrix"
    return ""
