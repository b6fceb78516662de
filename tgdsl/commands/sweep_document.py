"""The document of a sweep, and the runs that follow from it."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StrictInt

from tgdsl.commands.distill import Distill
from tgdsl.commands.train import Train
from tgdsl.errors import Problem, SpecError, did_you_mean
from tgdsl.fields.models import NonNegative, Positive, SpecModel
from tgdsl.rl.load import load_task
from tgdsl.schema.load import read_spec
from tgdsl.schema.yaml import Source

COMMANDS = {"train": Train, "distill": Distill}
OWN = ("task", "out", "resume", "set")  # options that a sweep gives itself
# options that are whole numbers, and the least value of each; None: any
WHOLE = {"--iterations": 1, "--envs": 1, "--episodes": 0, "--seeds": 1, "--seed": None}
LONGEST = 200  # most characters of a run's name, which is a folder's


class SweepSpec(SpecModel):
    """Settings whose combinations are run, each by a separate command."""

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


@dataclass(frozen=True)
class Trial:
    """One run of a sweep."""

    name: str
    settings: dict[str, Any]  # its values of the matrix
    words: tuple[str, ...]  # of the command line, without `--out` and `--resume`


def load_sweep(file: Path) -> tuple[SweepSpec, list[Trial]]:
    """Return a sweep's spec and its trials; every trial's task is read, so that mistakes are named before one begins.

    Raises:
        SpecError: All mistakes, with file, line and column.
    """
    spec, source = read_spec(file, SweepSpec, ("tgdsl", "task", "matrix"))
    for check in (_check_options, _check_values, _check_below):
        if problems := check(source, spec, file.parent):
            raise SpecError(problems)
    task, trials = file.parent / spec.task, []
    for values in itertools.product(*spec.matrix.values()):
        settings = dict(zip(spec.matrix, values, strict=True))
        every = {**spec.fixed, **settings}
        load_task(task, {name: value for name, value in every.items() if not name.startswith("--")})
        words = [spec.command, str(task.resolve())]
        for name, value in every.items():
            text = value if isinstance(value, str) else json.dumps(value)
            text = str((file.parent / text).resolve()) if name == "--teacher" else text
            words += [name, text] if name.startswith("--") else ["--set", f"{name}={text}"]
        name = ",".join(f"{name.lstrip('-')}={value}" for name, value in settings.items())
        trials.append(Trial(re.sub(r"[^\w.=,+-]", "_", name), settings, tuple(words)))
    if problem := _name_problem(trials):
        raise SpecError([source.problem(("matrix",), problem)])
    return spec, trials


def _check_options(source: Source, spec: SweepSpec, folder: Path) -> list[Problem]:
    """Return options that the command lacks, or needs."""
    options = {f"--{option.name}" for option in fields(COMMANDS[spec.command]) if option.name not in OWN}
    problems = [
        source.problem(
            (place, name),
            f"`tgdsl {spec.command}` has no option {name} that a sweep may set",
            did_you_mean(name, options, "options"),
            on_key=True,
        )
        for place in ("fixed", "matrix")
        for name in getattr(spec, place)
        if name.startswith("--") and name not in options
    ]
    if not problems and "--teacher" in options - spec.fixed.keys() - spec.matrix.keys():
        problems.append(source.problem(("command",), f"`tgdsl {spec.command}` needs a --teacher, under fixed or matrix"))
    return problems


def _check_values(source: Source, spec: SweepSpec, folder: Path) -> list[Problem]:
    """Return values of options that the command does not take."""
    fixed = [(("fixed", name), name, value) for name, value in spec.fixed.items()]
    listed = [(("matrix", name, i), name, value) for name, values in spec.matrix.items() for i, value in enumerate(values)]
    is_timed = "--minutes" in spec.fixed or "--minutes" in spec.matrix
    return [
        source.problem(path, f"{name} is {json.dumps(value, default=str)}, expected {expected}")
        for path, name, value in (*fixed, *listed)
        if name.startswith("--") and (expected := _expected(name, value, folder, is_timed))
    ]


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


def _check_below(source: Source, spec: SweepSpec, folder: Path) -> list[Problem]:
    """Return settings that stand twice, or lie below another one, which would replace them."""
    places = [(place, name) for place in ("fixed", "matrix") for name in getattr(spec, place)]
    problems = []
    for (place, name), (other, above) in itertools.product(places, places):
        if (place, other) == ("matrix", "fixed") and name == above:
            problems.append(source.problem((place, name), f"{name} stands under {other} too", on_key=True))
        if name.startswith(f"{above}."):
            problem = f"lies below {other}.{above}, which would replace it: write it there, or single values here"
            problems.append(source.problem((place, name), f"{name} {problem}", on_key=True))
    return problems


def _name_problem(trials: list[Trial]) -> str:
    """Return why trials cannot have folders by their names; empty: they can."""
    trial_of: dict[str, Trial] = {}
    for trial in trials:
        if len(trial.name) > LONGEST:
            length = f"{len(trial.name)} characters, expected {LONGEST} at most"
            return f"the name of a run's folder has {length}: {trial.name[:60]}…"
        if (other := trial_of.setdefault(trial.name, trial)) is not trial:
            alike = "two combinations are the same" if other.words == trial.words else "two combinations have one name"
            return f"{alike}: {trial.name}"
    return ""
