"""Least squares between a model's readings and recordings: parameters, nuisances, weights.

The unknowns x are the parameters, each from 0 to 1 in its range, then the nuisances of the recordings in units of their
standard deviations: offsets of state fields and of clocks, each with a normal prior. Linear unknowns are solved for at each x:
the reading's offset or affine map, its gain, and the parameters in which all readings are linear (variable projection: Golub
and Pereyra, *SIAM Journal on Numerical Analysis* 10, 1973, 413).

Shapes: `unknown` entries of x, `number` numbers of a target, flat.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares, lsq_linear

from tgdsl.calibration.model import InfeasibleError, Model
from tgdsl.calibration.recordings import Recording, Target
from tgdsl.errors import TgdslError

ReadingMap = Literal["none", "offset", "scale", "affine"]
STEP = 3e-4  # of finite differences in x: small to a range and to a prior's width, large to the error of a tabulated field
WIDTHS = 6.0  # largest nuisance, in standard deviations
LINEAR = 1e-7  # relative deviation from a straight line up to which a reading is linear in a parameter
Weights = Sequence[Float[np.ndarray, " number"]]


class Nuisance(NamedTuple):
    """An unknown offset of a recording: of one number of a state field (at one step or all), or of a target's clock."""

    label: str
    recording: int
    key: str
    index: tuple[int, ...] | None
    width: float


class Part(NamedTuple):
    """One target of one recording, flat."""

    recording: int  # which recording it is of
    target: Target
    value: Float[np.ndarray, " number"]
    weight: Float[np.ndarray, " number"]
    columns: Float[np.ndarray, "number coefficient"]  # effect of the reading's map per unit of its coefficients
    names: tuple[str, ...]  # of the coefficients


@dataclass(frozen=True, eq=False)
class Solution:
    """The model's result at some x."""

    x: Float[np.ndarray, " unknown"]  # the unknowns, with the linear parameters as solved for
    residual: Float[np.ndarray, " residual"]  # weighted residuals, then the nuisances
    predicted: tuple[Float[np.ndarray, " number"], ...]  # readings of each part, by all of the model
    # coefficients of each part's map, the gain last if there is one
    coefficients: tuple[Float[np.ndarray, " coefficient"], ...]

    @property
    def cost(self) -> float:
        """Sum of the squared residuals."""
        return float(self.residual @ self.residual)


class Problem:
    """Recordings and a model with unknown parameters."""

    def __init__(
        self,
        model: Model,
        recordings: Sequence[Recording],
        reading: ReadingMap | Mapping[str, ReadingMap] = "none",
        gain: bool = False,
    ):
        """Collect the unknowns.

        `reading` is the kind of each recording's map, for all readings or by name; `gain`: whether each also has a gain.
        """
        self.model, self.recordings, self.gain = model, tuple(recordings), gain
        self.places = {t.reading: None if t.is_sum else _places(model, t.reading) for r in recordings for t in r.targets}
        maps: Mapping[str, ReadingMap] = reading if isinstance(reading, Mapping) else dict.fromkeys(self.places, reading)
        self.parts = tuple(
            _part(i, target, maps.get(target.reading, "none"), self.places[target.reading], model)
            for i, recording in enumerate(recordings)
            for target in recording.targets
        )
        self.nuisances = tuple(nuisance for i, r in enumerate(recordings) for nuisance in _nuisances(i, r, model))
        self.sigma = np.array([max(part.target.floor, 0.3 * _rms(part.value, part.weight)) for part in self.parts])
        self._robust = [np.ones_like(part.value) for part in self.parts]
        self.linear: tuple[int, ...] = ()
        self.num_parameters = len(model.parameters)  # the nuisances follow them in x
        self.names = (*(p.path for p in model.parameters), *(nuisance.label for nuisance in self.nuisances))
        free = np.full(len(self.nuisances), WIDTHS)
        self.bounds = np.append(np.zeros(self.num_parameters), -free), np.append(np.ones(self.num_parameters), free)
        # the unknowns as the document and the recordings have them
        self.start = np.append([p.place(p.start) for p in model.parameters], np.zeros(len(self.nuisances)))
        self.num_numbers = sum(int((part.weight > 0).sum()) for part in self.parts)
        unknowns = len(self.names) + sum(part.columns.shape[1] + gain for part in self.parts)
        if self.num_numbers <= unknowns:
            names = ", ".join(recording.name for recording in recordings)
            problem = f"{self.num_numbers} numbers in all, expected more than the {unknowns} unknowns: {', '.join(self.names)}"
            raise TgdslError(f"{names}: {problem}")

    def values(self, x: np.ndarray) -> tuple[float, ...]:
        """Return the parameters at x."""
        return tuple(p.value(u) for p, u in zip(self.model.parameters, x, strict=False))

    def weights(self) -> list[np.ndarray]:
        """Return the recordings' weights, reduced for rows that a robust fit trusts less."""
        return [part.weight * robust for part, robust in zip(self.parts, self._robust, strict=True)]

    def predicted(self, x: np.ndarray) -> list[np.ndarray]:
        """Return the readings of each part, without their maps; zeros where no sensor has such parameters."""
        try:
            self.model.set(self.values(x))
        except InfeasibleError:
            return [np.zeros_like(part.value) for part in self.parts]
        shifts = dict(zip(self.nuisances, x[self.num_parameters :], strict=True))
        result, fields = [], [self._shifted(i, shifts) for i in range(len(self.recordings))]
        for part in self.parts:
            clock = sum(u * n.width for n, u in shifts.items() if (n.recording, n.key) == (part.recording, _clock(part.target)))
            recording = self.recordings[part.recording]
            result.append(self.model.predicted(recording, part.target, fields[part.recording], clock).reshape(-1))
        return result

    def _shifted(self, i: int, shifts: Mapping[Nuisance, float]) -> dict[str, np.ndarray]:
        fields = dict(self.recordings[i].fields)
        for nuisance, u in shifts.items():
            if nuisance.recording == i and nuisance.index is not None:
                value, (step, *rest) = fields[nuisance.key].copy(), nuisance.index
                value[(slice(None) if step < 0 else step, *rest)] += u * nuisance.width
                fields[nuisance.key] = value
        return fields

    def find_linear(self) -> None:
        """Find the parameters in which all readings are linear, alone and together; a recording's gain stands for them."""
        if self.gain:
            return
        base, linear = np.concatenate(self.predicted(self.start)), []

        def change(*js: int, by: float = 1.0) -> np.ndarray:
            x = self.start.copy()
            for j in js:
                x[j] = self.model.parameters[j].place(self._beside(j, by))
            return np.concatenate(self.predicted(x)) - base

        for j in range(self.num_parameters):
            one = change(j)
            scale = LINEAR * max(float(abs(one).max()), 1e-300)
            if abs(change(j, by=0.5) - 0.5 * one).max() > scale or not one.any():
                continue
            if all(abs(change(i, j) - change(i) - one).max() <= LINEAR * abs(change(i, j)).max() for i in linear):
                linear.append(j)
        self.linear = tuple(linear)

    def _beside(self, j: int, part: float) -> float:
        """Return a parameter's value part of the way from its start to the farther bound, at most twice the start."""
        p = self.model.parameters[j]
        reach = p.high - p.start if p.high - p.start >= p.start - p.low else p.low - p.start
        size = min(abs(reach), abs(p.start) or abs(reach))
        return p.start + part * np.copysign(size, reach)

    def solve(self, x: np.ndarray, weights: Weights, are_fixed: bool = False) -> Solution:
        """Return the solution at x with linear unknowns solved for, except linear parameters if `are_fixed`."""
        root = [np.sqrt(w) / sigma for w, sigma in zip(weights, self.sigma, strict=True)]
        x, base = self._solve_linear(x.copy(), root) if self.linear and not are_fixed else (x.copy(), self.predicted(x))
        predicted, coefficients, residuals = [], [], []
        for i, part in enumerate(self.parts):
            columns = np.column_stack([part.columns, base[i]]) if self.gain else part.columns
            fixed = np.zeros_like(base[i]) if self.gain else base[i]
            best = np.linalg.lstsq(columns * root[i][:, None], (part.value - fixed) * root[i], rcond=None)[0]
            predicted.append(fixed + columns @ best)
            coefficients.append(best)
            residuals.append((predicted[-1] - part.value) * root[i])
        residual = np.concatenate([*residuals, x[self.num_parameters :]])
        return Solution(x, residual, tuple(predicted), tuple(coefficients))

    def _solve_linear(self, x: np.ndarray, root: Weights) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return x with the linear parameters solved for, and the readings there."""
        parameters = [self.model.parameters[j] for j in self.linear]
        for j, p in zip(self.linear, parameters, strict=True):
            x[j] = p.place(p.start)
        base, slopes = self.predicted(x), []
        for j, p in zip(self.linear, parameters, strict=True):
            beside, value = x.copy(), self._beside(j, 1.0)
            beside[j] = p.place(value)
            slopes.append([(one - zero) / (value - p.start) for one, zero in zip(self.predicted(beside), base, strict=True)])
        left = np.concatenate([self._projected(i, part.value - base[i], root[i]) for i, part in enumerate(self.parts)])
        right = [[self._projected(i, slope[i], root[i]) for i in range(len(self.parts))] for slope in slopes]
        matrix = np.stack([np.concatenate(column) for column in right], axis=1)
        size = np.linalg.norm(matrix, axis=0)
        size = np.where(size > 1e-12 * np.linalg.norm(left), size, np.inf)  # of no effect: no step
        limits = np.array([[p.low - p.start, p.high - p.start] for p in parameters]).T
        steps = lsq_linear(matrix / size, left, limits * np.where(np.isinf(size), 1.0, size)).x / size
        for j, p, step, slope in zip(self.linear, parameters, steps, slopes, strict=True):
            x[j] = p.place(p.start + step)
            base = [value + step * part for value, part in zip(base, slope, strict=True)]
        return x, base

    def _projected(self, i: int, value: np.ndarray, root: np.ndarray) -> np.ndarray:
        """Return weighted numbers, without the component that a part's map explains."""
        columns, value = self.parts[i].columns * root[:, None], value * root
        return value - columns @ np.linalg.lstsq(columns, value, rcond=None)[0]

    def jacobian(self, x: np.ndarray, weights: Weights, free: Sequence[int], are_fixed: bool) -> np.ndarray:
        """Return the derivatives of the residuals by some unknowns, by forward differences within the bounds."""
        base, columns = self.solve(x, weights, are_fixed).residual, []
        for j in free:
            beside = x.copy()
            beside[j] += STEP if x[j] + STEP <= self.bounds[1][j] else -STEP
            columns.append((self.solve(beside, weights, are_fixed).residual - base) / (beside[j] - x[j]))
        return np.stack(columns, axis=1) if columns else np.zeros((len(base), 0))

    def minimise(
        self,
        x: np.ndarray,
        weights: Weights | None = None,
        fixed: Sequence[int] = (),
        are_fixed: bool = False,
        max_steps: int = 60,
    ) -> Solution:
        """Return the least sum of squares from a start.

        Args:
            x: The start.
            weights: Weights of each part; default: the recordings'.
            fixed: Unknowns that stay constant.
            are_fixed: Whether linear parameters are searched like the others, not solved for.
            max_steps: Largest number of steps.
        """
        weights = self.weights() if weights is None else weights
        solved = () if are_fixed else self.linear
        free = [j for j in range(len(x)) if j not in fixed and j not in solved]
        if not free:
            return self.solve(x, weights, are_fixed)
        low, high = (bound[free] for bound in self.bounds)

        def whole(part: np.ndarray) -> np.ndarray:
            result = x.copy()
            result[free] = part
            return result

        result = least_squares(
            lambda part: self.solve(whole(part), weights, are_fixed).residual,
            np.clip(x[free], low + 1e-6 * (high - low), high - 1e-6 * (high - low)),
            jac=lambda part: self.jacobian(whole(part), weights, free, are_fixed),  # type: ignore[arg-type]
            bounds=(low, high),
            x_scale="jac",
            ftol=1e-9,
            xtol=1e-7,
            gtol=1e-10,
            max_nfev=max_steps,
        )
        return self.solve(whole(result.x), weights, are_fixed)

    def errors(self, predicted: Sequence[np.ndarray]) -> list[float]:
        """Return the relative RMSE of each part: the residual's RMS over the target's."""
        pairs = zip(self.parts, predicted, strict=True)
        return [_rms(part.value - value, part.weight) / (_rms(part.value, part.weight) or 1.0) for part, value in pairs]

    def rms(self, i: int) -> float:
        """Return the RMS of a part's target, in its unit."""
        return _rms(self.parts[i].value, self.parts[i].weight)

    def estimate(self, solution: Solution, huber: float | None) -> None:
        """Estimate the noise of each part, no less than its floor, and with Huber's constant the weights of rows."""
        for i, (part, predicted) in enumerate(zip(self.parts, solution.predicted, strict=True)):
            error = part.value - predicted
            if huber is not None:
                shape = part.target.value.shape
                used = part.weight.reshape(shape)
                size = np.sqrt((used * error.reshape(shape) ** 2).mean(axis=2))
                typical = np.median(size[used.any(axis=2)])
                row = np.minimum(1.0, huber * typical / np.maximum(size, 1e-300))
                self._robust[i] = np.broadcast_to(row[:, :, None], shape).reshape(-1)
            self.sigma[i] = max(part.target.floor, _rms(error, part.weight * self._robust[i]), 1e-6 * self.rms(i))

    def alone(self) -> list[np.ndarray]:
        """Return the part of each target that its map explains without any sensor."""
        result = []
        for part in self.parts:
            root = np.sqrt(part.weight)
            best = np.linalg.lstsq(part.columns * root[:, None], part.value * root, rcond=None)[0]
            result.append(part.columns @ best)
        return result


def _rms(value: np.ndarray, weight: np.ndarray) -> float:
    return float(np.sqrt((weight * value**2).sum() / max(weight.sum(), 1e-300)))


def _clock(target: Target) -> str:
    return f"clock:{target.reading}"


def _places(model: Model, reading: str) -> np.ndarray | None:
    """Return the positions of a reading's rows in their link's frame (row, 3) [m]; None without positions."""
    table = model.module.rows.get(reading)
    is_stacked = any(output.name == reading and len(output.shape) > 2 for output in model.module.outputs)
    return None if table is None or is_stacked or "pos" not in (table.dtype.names or ()) else np.asarray(table["pos"])


def _part(i: int, target: Target, reading: ReadingMap, places: np.ndarray | None, model: Model) -> Part:
    """Return a target with the columns of its map."""
    output = next(output for output in model.module.outputs if output.name == target.reading)
    channels = [output.channels[channel] for channel in target.channels]
    samples, rows, num = target.value.shape
    columns: dict[str, np.ndarray] = {}  # of the rows and channels, by the coefficient's name
    eye = np.eye(num)
    if reading != "none":
        columns |= {f"offset {channel}": eye[c] for c, channel in enumerate(channels)}
    if reading in ("scale", "affine"):
        if places is None:
            raise TgdslError(f"reading: {reading}: the rows of {target.reading} have no places, expected offset")
        centred = places - places.mean(axis=0)
    if reading == "scale":
        axes = ["xyz".index(channel[-1]) if channel[-2:] in ("_x", "_y", "_z") else -1 for channel in channels]
        if min(axes) < 0:
            raise TgdslError(f"reading: scale: {', '.join(channels)} are not along x, y, z; expected offset or affine")
        columns["scale"] = centred[:, axes]
    if reading == "affine":
        _, spread, directions = np.linalg.svd(centred, full_matrices=False)
        for direction in directions[spread > 1e-6 * spread[0]]:
            name = "".join(f"{value:+.2g}{axis}" for value, axis in zip(direction, "xyz", strict=True) if abs(value) > 1e-9)
            along = (centred @ direction)[:, None]
            columns |= {f"{channel} along {name}": along * eye[c] for c, channel in enumerate(channels)}
    stacked = [np.broadcast_to(column, target.value.shape).reshape(-1) for column in columns.values()]
    matrix = np.stack(stacked, axis=1) if stacked else np.zeros((samples * rows * num, 0))
    return Part(i, target, target.value.reshape(-1), target.weight.reshape(-1), matrix, tuple(columns))


def _nuisances(i: int, recording: Recording, model: Model) -> list[Nuisance]:
    result = []
    for name, width in recording.widths.items():
        bodies = model.module.inputs.names["body"] if name in ("body_pos", "body_quat") else ()
        for index in map(tuple, np.argwhere(width > 0).tolist()):
            step, *rest = index
            item = f"{bodies[rest[0]]}" if bodies else str(rest[0])
            axis = "" if len(rest) < 2 else f".{'xyz'[rest[1]]}" if name == "body_pos" else f"[{rest[1]}]"
            when = "" if len(width) == 1 else f"@{step}"
            place = (-1 if len(width) == 1 else step, *rest)
            result.append(Nuisance(f"{recording.name}: {name} {item}{axis}{when}", i, name, place, float(width[index])))
    for target in recording.targets:
        if target.clock_width > 0:
            result.append(Nuisance(f"{recording.name}: clock of {target.reading}", i, _clock(target), None, target.clock_width))
    return result
