"""Fits parameters of a document's sensors to recordings.

fit = tgdsl.calibrate("skin.yaml", ["press.npz", "drag.npz"], ["skin.thickness", "skin.poissons_ratio"], reading="offset")
print(fit)
fit.plot("fit.png")
fit.document("fitted.yaml")
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field
from scipy.stats import qmc

from tgdsl.calibration import checks
from tgdsl.calibration.checks import CORRELATED, UNKNOWN, WORSE, HoldOut, Intervals, TargetErrors, Uncertainty
from tgdsl.calibration.hand.recording import recording_of
from tgdsl.calibration.model import Model, Parameter
from tgdsl.calibration.problem import Problem, ReadingMap, Solution
from tgdsl.calibration.recordings import Arrays, Recording, load_recording
from tgdsl.compiler.pipeline import Document
from tgdsl.console.progress import Progress, silent
from tgdsl.console.tables import text_table
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.fields.models import SpecModel
from tgdsl.files.write import atomic_write
from tgdsl.module.module import TactileModule
from tgdsl.runtime.xhand1.log.log import is_hand_log, open_log
from tgdsl.schema.load import read_spec
from tgdsl.schema.yaml import with_values
from tgdsl.sensors import Kind

CONTINUED = 3  # starts that are refined to their minimum
HUBER = 1.345  # residual over its scale from which a row counts less (95 % efficiency for normal noise)
ROUNDS = 4  # largest number of estimates of rows' weights and targets' noise


@dataclass(frozen=True)
class FittedParameter:
    """A fitted parameter: its value, the ends of its 95 % interval, and whether the data identify it."""

    parameter: Parameter
    value: float
    low: float
    high: float
    is_identified: bool

    @property
    def path(self) -> str:
        """Sensor and field."""
        return self.parameter.path


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted parameters, and the quality of the fit. `print(fit)` shows all of it."""

    parameters: Mapping[str, FittedParameter]  # fitted parameters, by path
    # offsets of poses [m] and clocks [s], gains and coefficients of the readings' maps, by name
    nuisances: Mapping[str, float]
    errors: tuple[TargetErrors, ...]  # errors, one for each target
    warnings: tuple[str, ...]  # parameters that the data do not identify, and signs of a wrong model
    problem: Problem  # the problem that was solved
    solution: Solution  # its solution

    def __str__(self) -> str:
        parts = []
        if self.parameters:
            rows = [
                (f.path, f"{f.value:.5g}", f"{f.low:.4g} to {f.high:.4g}", f.parameter.unit) for f in self.parameters.values()
            ]
            parts.append(text_table(("parameter", "value", "95 %", "unit"), rows))
        errors = [(e.recording, e.reading, *e.texts(4)) for e in self.errors]
        parts.append(text_table(("recording", "reading", "relative RMSE", "held out", "floor", "without a sensor"), errors))
        if self.nuisances:
            parts.append(text_table(("nuisance", "value"), [(name, f"{value:.4g}") for name, value in self.nuisances.items()]))
        parts += ["\n".join(f"warning: {text}" for text in self.warnings)] if self.warnings else []
        return "\n\n".join(parts)

    def plot(self, path: str | Path) -> Path:
        """Draw each target, its fit and the residuals into a PNG file; return its path."""
        from tgdsl.calibration.picture import picture

        return picture(self.problem, self.solution, self.errors, Path(path))

    def document(self, path: str | Path) -> Path:
        """Write the document with the fitted values and its comments; return its path.

        Raises:
            TgdslError: If the document is a mapping; if the file is that document, or would be in another folder, where its
                paths are wrong.
        """
        source = self.problem.model.document
        if isinstance(source, Mapping):
            raise TgdslError("the document is a mapping; set its values from `fit.parameters`")
        values = {
            ("sensors", *f.path.split(".")): (float(f"{f.value:.6g}"), f"fitted, 95 %: {f.low:.4g} to {f.high:.4g}")
            for f in self.parameters.values()
        }
        out = Path(path)
        if out.resolve() == Path(source).resolve():
            raise TgdslError(f"{out}: this is the document that the fit began with; expected another file")
        if out.resolve().parent != Path(source).resolve().parent:
            raise TgdslError(f"{out}: file names in {source} are relative to its folder; write the fitted document there")
        atomic_write(out, with_values(Path(source), values).encode())
        return out


def calibrate(
    document: Document,
    recordings: Sequence[str | Path | Arrays] | str | Path | Arrays,
    fit: Sequence[str] = (),
    *,
    reading: ReadingMap | Mapping[str, ReadingMap] = "none",
    gain: bool = False,
    robust: bool = False,
    hold_out: HoldOut = "none",
    folds: int = 6,
    starts: int = 8,
    intervals: Intervals = "profile",
    seed: int = 0,
    overrides: Mapping[str, Any] | None = None,
    kinds: Sequence[Kind] = (),
    progress: Progress = silent,
) -> Fit:
    """Fit parameters of sensors to recordings.

    Args:
        document: A YAML file, or the same as a mapping. The search starts from its values.
        recordings: `.npz` files, YAML documents of CSV files, or arrays; `tgdsl.calibration.recordings` describes the format.
            Or logs of an XHand1 that pressed fixtures: see `tgdsl.calibration.hand.recording`.
        fit: Parameters as `sensor.field`, or with a range to search: `skin.thickness=1 mm:9 mm`. Without any, only
            nuisances are fitted: the document predicts the recordings.
        reading: Nuisance parameters of each recording's frame: an `offset` of each channel (the camera moved), a `scale` about
            the middle of the rows as well, or an `affine` function of the rows' positions. For all readings, or by name.
        gain: Fit one gain per recording.
        robust: Give outliers, such as lost markers, less weight (Huber's loss).
        hold_out: Parts that are held out in turn, to measure the error on unseen data: random rows (`taxel`), `blocks` of
            neighbouring rows, blocks of `time`, or each `recording` (only its nuisances are fitted then).
        folds: Number of held-out parts.
        starts: Number of starting points: the document's values, and points of a Sobol sequence in the ranges.
        intervals: 95 % intervals by `profile` (for independent noise), by `bootstrap` of rows or samples, or `none`.
        seed: Seed of starting points, folds and the bootstrap.
        overrides: Values by dotted path, as for `tgdsl.compile`.
        kinds: Your own kinds of sensors.
        progress: Called with a line of text for each part of the work.

    Raises:
        SpecError: All mistakes in the document, or in a recording, by its keys.
        TgdslError: If a parameter does not exist or is no number, or there are fewer numbers than unknowns.
    """
    for each in reading.values() if isinstance(reading, Mapping) else [reading]:
        _check_choice("reading", each, get_args(ReadingMap))
    _check_choice("hold_out", hold_out, get_args(HoldOut))
    _check_choice("intervals", intervals, get_args(Intervals))
    progress("compiling")
    model = Model(document, fit, overrides, kinds)
    sources = [recordings] if isinstance(recordings, (str, Path, Mapping)) else list(recordings)
    if not sources:
        raise TgdslError("there is no recording, expected at least one: an .npz file, or a YAML document of CSV files")
    names = ["<arrays>"] if len(sources) == 1 else [f"<arrays {i}>" for i in range(1, len(sources) + 1)]
    loaded = [_loaded(source, name, model.module) for source, name in zip(sources, names, strict=True)]
    problem = Problem(model, loaded, reading, gain)
    if hold_out in ("taxel", "blocks") and all(part.target.value.shape[1] == 1 for part in problem.parts):
        raise TgdslError(f"hold_out: {hold_out}: each target has one row; expected time or recording")
    if hold_out == "recording" and len(loaded) == 1:
        raise TgdslError("hold_out: recording: there is one recording, expected several; or blocks, taxel or time")
    solution = _best(problem, starts, seed, robust, progress)
    out = None if hold_out == "none" else checks.held_out(problem, solution, hold_out, folds, seed, progress)
    uncertainty = checks.uncertainty(problem, solution)
    fitted = _parameters(problem, solution, uncertainty, intervals, seed, progress)
    errors = _errors(problem, solution, out)
    notes = _warnings(problem, solution, uncertainty, fitted, errors)
    model.set(problem.values(solution.x))
    return Fit({f.path: f for f in fitted}, _nuisances(problem, solution), errors, notes, problem, solution)


def _check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise TgdslError(f'{name}: found "{value}"; {did_you_mean(str(value), choices, "values")}')


def _loaded(source: str | Path | Arrays, name: str, touch: TactileModule) -> Recording:
    """Read a recording, or a log of an XHand1."""
    outputs = {output.name: output for output in touch.outputs}
    if not isinstance(source, Mapping) and is_hand_log(Path(source)):
        source, name = recording_of(open_log(source), touch), str(source)
    return load_recording(source, touch.inputs, outputs, name)


def _best(problem: Problem, starts: int, seed: int, robust: bool, progress: Progress) -> Solution:
    """Return the best of several minima, with the weights of rows and the noise of targets estimated."""
    problem.find_linear()
    places, num = [problem.start], problem.num_parameters - len(problem.linear)
    if num and starts > 1:
        sobol = qmc.Sobol(problem.num_parameters, seed=seed)  # pyright: ignore[reportCallIssue]
        drawn = sobol.random(1 << (starts - 1).bit_length())[: starts - 1]
        places += [np.concatenate([0.02 + 0.96 * u, np.zeros(len(problem.nuisances))]) for u in drawn]
    weights = problem.weights()
    progress(f"comparing {len(places)} starting points")
    ranked = sorted(places, key=lambda x: problem.solve(x, weights).cost)
    places_to_try = [places[0], *[x for x in ranked if x is not places[0]][: CONTINUED - 1]]
    rough = []
    for i, x in enumerate(places_to_try):
        progress(f"fitting from starting point {i + 1} of {len(places_to_try)}")
        rough.append(problem.minimise(x, max_steps=12))
    progress("fitting from the best of them")
    solution = problem.minimise(min(rough, key=lambda each: each.cost).x)
    for i in range(ROUNDS):
        progress(f"estimating the noise, round {i + 1} of at most {ROUNDS}")
        previous = problem.sigma.copy()
        problem.estimate(solution, HUBER if robust else None)
        if not robust and abs(problem.sigma / previous - 1).max() < 0.02:
            break
        if not robust and len(problem.parts) == 1 and not problem.nuisances:
            solution = problem.solve(solution.x, problem.weights())
            break
        solution = problem.minimise(solution.x, max_steps=20)
    return solution


def _parameters(
    problem: Problem, solution: Solution, uncertainty: Uncertainty, intervals: Intervals, seed: int, progress: Progress
) -> list[FittedParameter]:
    ends = checks.bootstrap_intervals(problem, solution, seed, progress) if intervals == "bootstrap" else None
    result = []
    for j, parameter in enumerate(problem.model.parameters):
        progress(f"interval of {parameter.path}")
        if intervals == "none":
            low, high = np.clip(solution.x[j] + np.array([-1.96, 1.96]) * uncertainty.sigma[j], 0.0, 1.0)
        else:
            low, high = checks.profile_interval(problem, solution, uncertainty, j) if ends is None else ends[j]
        is_identified = bool(high - low < UNKNOWN and uncertainty.sigma[j] < UNKNOWN)
        value = parameter.value(solution.x[j])
        result.append(FittedParameter(parameter, value, parameter.value(low), parameter.value(high), is_identified))
    return result


def _nuisances(problem: Problem, solution: Solution) -> dict[str, float]:
    shifts = zip(problem.nuisances, solution.x[problem.num_parameters :], strict=True)
    result = {nuisance.label: float(u * nuisance.width) for nuisance, u in shifts}
    for part, best in zip(problem.parts, solution.coefficients, strict=True):
        names = [*part.names, *(["gain"] if problem.gain else [])]
        of = f"{problem.recordings[part.recording].name}: {part.target.reading}"
        result |= {f"{of} {name}": float(value) for name, value in zip(names, best, strict=True)}
    return result


def _errors(problem: Problem, solution: Solution, out: Sequence[float] | None) -> tuple[TargetErrors, ...]:
    inside, alone = problem.errors(solution.predicted), problem.errors(problem.alone())
    result = []
    for i, part in enumerate(problem.parts):
        size = problem.rms(i)
        floor = part.target.floor / size if part.target.floor and size else None
        name = problem.recordings[part.recording].name
        held = None if out is None else out[i]
        result.append(TargetErrors(name, part.target.reading, inside[i], held, floor, alone[i], size, part.target.unit))
    return tuple(result)


def _warnings(
    problem: Problem,
    solution: Solution,
    uncertainty: Uncertainty,
    fitted: Sequence[FittedParameter],
    errors: Sequence[TargetErrors],
) -> tuple[str, ...]:
    """Return unidentified parameters and signs of a wrong model, each with name and number."""
    notes, names = [], problem.names
    is_silent = np.isinf(uncertainty.sigma).any() and not any(part.any() for part in problem.predicted(solution.x))
    for j, each in enumerate(fitted):
        parameter, u = each.parameter, solution.x[j]
        if np.isinf(uncertainty.sigma[j]):
            silent = "the sensors read 0 in all samples: does an object touch them? Poses are in m"
            hint = silent if is_silent else "leave it out"
            notes.append(f"{each.path}: no reading depends on it; {hint}")
        elif not each.is_identified:
            notes.append(f"{each.path}: the data do not tell it: 95 % are {each.low:.4g} to {each.high:.4g} {parameter.unit}")
        if min(u, 1 - u) < 1e-3:
            end = parameter.low if u < 0.5 else parameter.high
            notes.append(f"{each.path}: at the end of its range, {end:.4g} {parameter.unit}")
    size = uncertainty.correlation.shape[0]
    for i in range(size):
        for j in range(i + 1, size):
            rho = uncertainty.correlation[i, j]
            if i < problem.num_parameters and abs(rho) > CORRELATED:
                notes.append(f"{names[i]} and {names[j]}: correlation {rho:.3f}, the data tell a combination of both")
    for nuisance, u in zip(problem.nuisances, solution.x[problem.num_parameters :], strict=True):
        if abs(u) > 3:
            notes.append(f"{nuisance.label}: {u:.1f} standard deviations from the recorded value")
    for i, (e, part) in enumerate(zip(errors, problem.parts, strict=True)):
        name = f"{e.recording}: {e.reading}"
        if problem.gain and solution.coefficients[i][-1] < 0:
            notes.append(f"{name}: the gain {solution.coefficients[i][-1]:.3g} is negative")
        if e.held_out is not None and e.held_out > WORSE * e.error:
            notes.append(
                f"{name}: held-out error {e.held_out:.4f}, {e.held_out / e.error - 1:.0%} above {e.error:.4f} in-sample"
            )
        if e.floor is not None and e.error < e.floor * (1 - 2 / np.sqrt(2 * (part.weight > 0).sum())):
            notes.append(f"{name}: error {e.error:.4f} below the floor {e.floor:.4f}: noise is fitted")
        if part.columns.shape[1] and 1 - e.alone > e.alone - e.error:
            notes.append(f"{name}: the reading's own map explains more (1 → {e.alone:.3f}) than the sensor (→ {e.error:.3f})")
    return tuple(notes)


class CandidateSpec(SpecModel):
    """A model to compare: changes of the document, and fitted parameters."""

    set: dict[str, Any] = {}
    """Values by dotted path, as `--set` takes them."""
    fit: tuple[str, ...] = ()
    """Parameters, as `--fit` takes them."""


class ComparisonSpec(SpecModel):
    """Models to compare."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    compare: Annotated[dict[str, CandidateSpec], Field(min_length=1)]
    """The models by name."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Fits of several models to the same recordings, by name. `print(comparison)` shows one table."""

    fits: Mapping[str, Fit]

    def __str__(self) -> str:
        rows = []
        for name, fit in self.fits.items():
            values = ", ".join(f"{path} {fitted.value:.4g}" for path, fitted in fit.parameters.items())
            rows += [(name, e.recording, e.reading, *e.texts(3), values) for e in fit.errors]
        head = ("model", "recording", "reading", "error", "held out", "floor", "without a sensor", "parameters")
        notes = [f"{name}: {text}" for name, fit in self.fits.items() for text in fit.warnings]
        return "\n".join([text_table(head, rows), *([""] if notes else []), *notes])


def compare(
    document: Document,
    recordings: Sequence[str | Path | Arrays] | str | Path | Arrays,
    models: str | Path | Mapping[str, Mapping[str, Any]],
    *,
    overrides: Mapping[str, Any] | None = None,
    progress: Progress = silent,
    **options: Any,
) -> Comparison:
    """Fit several kernels or kinds to the same recordings.

    A file of models::

        tgdsl: 1
        compare:
          half space:
            set: {sensors.skin: {kind: elastomer, kernel: half_space, ...}}
            fit: [skin.poissons_ratio]
          as written: {}

    Args:
        document: A YAML file, or the same as a mapping.
        recordings: What to fit them to, as `tgdsl.calibrate` takes them.
        models: A YAML file with `compare:`, or what stands there as a mapping: by name `set` and `fit`.
        overrides: Values by dotted path, for all models.
        progress: Called with a line of text for each part of the work.
        options: Other options of `tgdsl.calibrate`, for all models.

    Raises:
        SpecError: All mistakes in the file, the document or a recording.
        TgdslError: As `tgdsl.calibrate`.
    """
    source = {"tgdsl": 1, "compare": models} if isinstance(models, Mapping) else Path(models)
    spec, _ = read_spec(source, ComparisonSpec, ("tgdsl", "compare"))
    fits = {}
    for name, each in spec.compare.items():
        progress(f"model {name}")
        fits[name] = calibrate(
            document, recordings, each.fit, overrides={**(overrides or {}), **each.set}, progress=progress, **options
        )
    return Comparison(fits)
