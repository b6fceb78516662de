"""The document of a sweep, and the runs that follow from it."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StrictInt

from tgdsl.commands.learning.train import Train
from tgdsl.errors import SpecError, did_you_mean
from tgdsl.fields.models import NonNegative, Positive, SpecModel
from tgdsl.rl.load import load_task
from tgdsl.schema.load import read_source
from tgdsl.schema.validation import validate
from tgdsl.schema.yaml import Source

OWN = ("task", "out", "resume", "set")
"""Options that a sweep gives itself."""
WHOLE = {"--iterations": 1, "--envs": 1, "--episodes": 0}
"""Options that are whole numbers, and the least value of each."""


class SweepSpec(SpecModel):
    """Settings whose combinations are run, each by a command of its own."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    command: Literal["train"] = "train"
    """What is run."""
    task: str
    """The task's document, relative to this one."""
    fixed: dict[str, Any] = {}
    """Settings of all runs: values of the task by dotted path, and options of the command by name: `--seed: 1`."""
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
    _check_values(source, spec)
    trials = []
    for values in itertools.product(*spec.matrix.values()):
        settings = dict(zip(spec.matrix, values, strict=True))
        every = {**spec.fixed, **settings}
        load_task(file.parent / spec.task, {name: value for name, value in every.items() if not name.startswith("--")})
        words = [spec.command, str((file.parent / spec.task).resolve())]
        for name, value in every.items():
            text = value if isinstance(value, str) else json.dumps(value)
            words += [name, text] if name.startswith("--") else ["--set", f"{name}={text}"]
        name = ",".join(f"{name.lstrip('-')}={value}" for name, value in settings.items())
        trials.append(Trial(re.sub(r"[^\w.=,+-]", "_", name), settings, tuple(words)))
    if len({trial.name for trial in trials}) < len(trials):
        raise SpecError([source.problem(("matrix",), "two combinations are the same")])
    return spec, trials


def _check_options(source: Source, spec: SweepSpec) -> None:
    known = {"--" + own.name: own.name for own in fields(Train) if own.name not in OWN}
    for place in ("fixed", "matrix"):
        for name in getattr(spec, place):
            if name.startswith("--") and name not in known:
                what = f"`tgdsl {spec.command}` has no option {name} that a sweep may set"
                raise SpecError([source.problem((place, name), what, did_you_mean(name, known, "options"), on_key=True)])


def _check_values(source: Source, spec: SweepSpec) -> None:
    """See that options which are numbers have such values.

    Raises:
        SpecError: All values that are none.
    """
    fixed = [(("fixed", name), name, value) for name, value in spec.fixed.items()]
    listed = [(("matrix", name, i), name, value) for name, values in spec.matrix.items() for i, value in enumerate(values)]
    problems = []
    for path, name, value in (*fixed, *listed):
        expected = ""
        if name in WHOLE and not (type(value) is int and value >= WHOLE[name]):
            expected = f"a whole number of at least {WHOLE[name]}"
        if name == "--minutes" and not (type(value) in (int, float) and 0.0 < value < float("inf")):
            expected = "a positive number"
        if expected:
            problems.append(source.problem(path, f"{name} is {json.dumps(value, default=str)}, expected {expected}"))
    if problems:
        raise SpecError(problems)
