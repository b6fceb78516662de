"""Quality of a fit: errors on held-out data, confidence intervals, and identifiability.

A profile interval contains the values of a parameter whose best fit, all else free, is worse by less than Student's t allows
(Bates and Watts, *Nonlinear Regression Analysis*, 1988, section 6.1); it assumes independent normal noise. A bootstrap interval
comes from fits to rows, or samples, drawn with replacement; it also holds where residuals are model errors rather than noise.

Shapes: `unknown` entries of a problem's x, `fold` parts held out in turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy import stats

from tgdsl.calibration.problem import Problem, Solution
from tgdsl.console.progress import Progress

HoldOut = Literal["none", "taxel", "blocks", "time", "recording"]
Intervals = Literal["profile", "bootstrap", "none"]
LEVEL = 0.95
CORRELATED = 0.95
UNKNOWN = 0.9  # width of an interval, as a share of the parameter's range, from which the parameter is not identified
WORSE = 1.2  # ratio of held-out to in-sample error from which a fit gets a warning
RESAMPLES = 100


@dataclass(frozen=True)
class TargetErrors:
    """Relative RMSE of a target: the residuals' RMS over the target's."""

    recording: str  # name of the recording
    reading: str  # the reading
    error: float  # in-sample
    held_out: float | None  # on held-out numbers; None without any
    floor: float | None  # of the target's noise; None: unknown
    alone: float  # of the reading's map without any sensor
    rms: float  # RMS of the target, in its unit
    unit: str  # unit of the reading

    def texts(self, digits: int) -> tuple[str, ...]:
        """Return `error`, `held_out`, `floor` and `alone` with so many decimals; empty where None."""
        return tuple(
            "" if value is None else f"{value:.{digits}f}" for value in (self.error, self.held_out, self.floor, self.alone)
        )


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of the unknowns, from the derivatives at the optimum."""

    sigma: Float[np.ndarray, " unknown"]  # standard deviation of each unknown in x; infinite where nothing depends on it
    correlation: Float[np.ndarray, "unknown unknown"]  # correlations of the unknowns
    noise: float  # standard deviation of the weighted residuals
    degrees: int  # degrees of freedom


def uncertainty(problem: Problem, solution: Solution) -> Uncertainty:
    """Return the uncertainty of the unknowns."""
    num = len(solution.x)
    jacobian = problem.jacobian(solution.x, problem.weights(), range(num), are_fixed=True)
    spent = problem.num_parameters + sum(len(best) for best in solution.coefficients)
    degrees = max(problem.num_numbers - spent, 1)
    noise = float(np.sqrt(solution.cost / degrees))
    size = np.linalg.norm(jacobian, axis=0)
    ids = np.flatnonzero(size > 1e-6 * noise)
    covariance, sigma, correlation = np.zeros((num, num)), np.full(num, np.inf), np.eye(num)
    if ids.size:
        scaled = jacobian[:, ids] / size[ids]
        inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)
        covariance[np.ix_(ids, ids)] = noise**2 * inverse / np.outer(size[ids], size[ids])
        sigma[ids] = np.sqrt(np.diag(covariance)[ids])
        correlation[np.ix_(ids, ids)] = covariance[np.ix_(ids, ids)] / np.outer(sigma[ids], sigma[ids])
    return Uncertainty(sigma, correlation, noise, degrees)


def profile_interval(problem: Problem, solution: Solution, known: Uncertainty, j: int) -> tuple[float, float]:
    """Return the profile interval of a parameter, in x; 0 or 1 where it reaches the end of its range."""
    limit = float(stats.t.ppf(0.5 + LEVEL / 2, known.degrees))
    best, at = solution.cost, solution.x[j]

    def end(side: float) -> float:
        bound = 0.0 if side < 0 else 1.0
        inside, inside_t, x = at, 0.0, solution.x.copy()
        step = min(limit * known.sigma[j], abs(bound - at))
        for _ in range(8):
            place = float(np.clip(inside + side * step, 0.0, 1.0)) if step else bound
            x[j] = place
            fitted = problem.minimise(x, fixed=(j,), are_fixed=True, max_steps=8)
            t = float(np.sqrt(max(fitted.cost - best, 0.0)) / known.noise)
            if abs(t - limit) < 0.02 * limit:
                return place
            if t < limit and place == bound:
                return bound
            if t < limit:
                inside, inside_t, x = place, t, fitted.x.copy()
                step = min((limit - t) / max(t, 0.05 * limit) * max(abs(place - at), 1e-6), abs(bound - place))
            else:
                step = (limit - inside_t) / (t - inside_t) * abs(place - inside)
        return place

    return end(-1.0), end(1.0)


def bootstrap_intervals(problem: Problem, solution: Solution, seed: int, progress: Progress) -> Float[np.ndarray, "unknown 2"]:
    """Return intervals of all parameters, in x, from fits to rows (of several samples of few rows: samples) drawn again."""
    rng, places = np.random.default_rng(seed), []
    for i in range(RESAMPLES):
        progress(f"bootstrap: fit {i + 1} of {RESAMPLES}")
        weights = []
        for part in problem.parts:
            samples, rows, _ = part.target.value.shape
            by_row = rows >= samples
            counts = np.bincount(rng.integers(0, max(rows, samples), max(rows, samples)), minlength=max(rows, samples))
            shape = (1, rows, 1) if by_row else (samples, 1, 1)
            weights.append(part.weight * np.broadcast_to(counts.reshape(shape), part.target.value.shape).reshape(-1))
        places.append(problem.minimise(solution.x, weights, max_steps=10).x)
    tail = 50 * (1 - LEVEL)
    return np.percentile(np.stack(places), [tail, 100 - tail], axis=0).T


def held_out(problem: Problem, solution: Solution, by: HoldOut, folds: int, seed: int, progress: Progress) -> list[float]:
    """Return the relative RMSE of each part on held-out numbers, each held out once."""
    predicted = [np.zeros_like(part.value) for part in problem.parts]
    for i, masks in enumerate(_masks(problem, by, folds, seed)):
        progress(f"fitting without held-out part {i + 1}")
        weights = [np.where(mask, 0.0, part.weight) for mask, part in zip(masks, problem.parts, strict=True)]
        fitted = problem.minimise(solution.x, weights, max_steps=20)
        if by == "recording":  # fit its nuisances, with the parameters of the others
            fitted = problem.minimise(fitted.x, fixed=range(problem.num_parameters), are_fixed=True, max_steps=20)
        for value, fold_prediction, mask in zip(predicted, fitted.predicted, masks, strict=True):
            value[mask] = fold_prediction[mask]
    return problem.errors(predicted)


def _masks(problem: Problem, by: HoldOut, folds: int, seed: int) -> Iterator[list[np.ndarray]]:
    """Yield which numbers of each part are held out."""
    rng = np.random.default_rng(seed)
    if by == "recording":
        for i in range(len(problem.recordings)):
            yield [np.full(len(part.value), part.recording == i) for part in problem.parts]
        return
    fold_of = []
    for part in problem.parts:
        samples, rows, _ = part.target.value.shape
        if by == "time":
            of_sample = np.arange(samples) * folds // max(samples, 1)
            fold_of.append(np.broadcast_to(of_sample[:, None, None], part.target.value.shape).reshape(-1))
            continue
        places = problem.places[part.target.reading]
        of_row = rng.permutation(np.arange(rows) % folds) if by == "taxel" or places is None else _blocks(places, folds)
        fold_of.append(np.broadcast_to(of_row[None, :, None], part.target.value.shape).reshape(-1))
    for fold in range(folds):
        yield [folds_of_part == fold for folds_of_part in fold_of]


def _blocks(places: np.ndarray, folds: int) -> np.ndarray:
    """Return the block of each row: equal counts along the first principal direction, then along the second."""
    along = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2]
    num, columns = len(places), max(1, round(np.sqrt(folds)))
    strip = np.argsort(np.argsort(places @ along[0], kind="stable")) * columns // num
    result = np.zeros(num, dtype=np.int64)
    for i in range(columns):
        ids = np.flatnonzero(strip == i)
        rank = np.argsort(np.argsort(places[ids] @ along[min(1, len(along) - 1)], kind="stable"))
        first, last = i * folds // columns, (i + 1) * folds // columns
        result[ids] = first + rank * (last - first) // len(ids)
    return result
