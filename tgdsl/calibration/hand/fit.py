"""Fit of a fingertip's counts to known forces: force = rotation · (scale ∘ (counts − tare)).

Rotation and scale minimise the sum of squared errors of the force, in turn: the rotation by Procrustes' problem (Schönemann,
*Psychometrika* 31, 1966), which also finds mirrored axes, the scales each by linear least squares. The start is the linear
least-squares map. If the axes are known to be parallel to the link's, each axis is a straight line.

Shapes: `sample` readings used, `axis` x, y, z along the link (or, for scale and tare, along the sensor), `step` the instants
at which a force is known, `component` force components of one or more fingertips.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize_scalar

from tgdsl.errors import TgdslError

Forces = Float[np.ndarray, "sample 3"]
AxesModel = Literal["rotation", "signs"]

_LOADED = 0.02
"""Least spread of the forces along a loaded direction, as a share of the spread along the strongest one."""
_MAX_TURNS = 500
_SETTLED = 1e-12
_GRID_S = 0.002


class FitError(TgdslError):
    """Loads that do not determine a fit: too few, not in all directions, or beyond the sensor's range."""


@dataclass(frozen=True, eq=False)
class FingerFit:
    """Fit of a fingertip's counts to forces, and its errors."""

    scale: Float[np.ndarray, " axis"]  # N per count along the sensor's axes
    rotation: Float[np.ndarray, "axis axis"]  # from the sensor's axes to the link's; it may mirror
    tare: Float[np.ndarray, " axis"]  # counts without force
    force: Forces  # known forces, along the link's axes [N]
    error: Forces  # fitted less known forces [N]

    @property
    def rms(self) -> Float[np.ndarray, " axis"]:
        """Root mean square of the error, per axis of the link [N]."""
        return np.sqrt(np.mean(self.error**2, axis=0))

    @property
    def max_error(self) -> Float[np.ndarray, " axis"]:
        """Largest error, per axis of the link [N]."""
        return abs(self.error).max(axis=0)

    @property
    def r_squared(self) -> Float[np.ndarray, " axis"]:
        """Part of the known force's variance that the fit explains, per axis of the link; NaN where the force is always one."""
        variance = self.force.var(axis=0)
        left = np.full(3, np.nan)
        return 1 - np.divide(np.mean(self.error**2, axis=0), variance, out=left, where=variance > 0)


def fit_finger(
    counts: Forces,
    force: Forces,
    *,
    axes: AxesModel = "rotation",
    tare: Float[np.ndarray, " axis"] | None = None,
) -> FingerFit:
    """Fit one fingertip.

    Args:
        counts: What it read; none at the end of its range.
        force: The force on it at the same instants, along its link's axes [N].
        axes: `rotation`: any; `signs`: the sensor's axes are parallel to the link's, and only their signs are sought.
        tare: Counts without force; default: fitted, for which loads must differ in each direction; no load is one.

    Raises:
        FitError: If there are fewer than four samples, or loads do not reach in all directions; it says which are missing.
    """
    if len(counts) < 4:
        raise FitError(f"{len(counts)} frames, expected at least 4")
    middle = (counts.mean(axis=0), force.mean(axis=0)) if tare is None else (tare, np.zeros(3))
    centred_counts, centred_force = counts - middle[0], force - middle[1]
    _expect_loads(centred_force, has_tare=tare is not None)
    _expect_response(centred_counts)
    solve = _signs if axes == "signs" else _rotation
    rotation, scale = solve(centred_counts, centred_force)
    zero = middle[0] - (rotation.T @ middle[1]) / scale
    return FingerFit(scale, rotation, zero, force, (scale * (counts - zero)) @ rotation.T - force)


def time_offset(
    time: Float[np.ndarray, " sample"],
    counts: Float[np.ndarray, "sample component"],
    known_time: Float[np.ndarray, " step"],
    known_force: Float[np.ndarray, "step component"],
    max_offset_s: float,
) -> float:
    """Return what to add to the known forces' times [s] so that they [N] fit the counts best, up to `max_offset_s` either way.

    First by cross-correlation of how far counts and forces are from their medians, then by the residual of a linear fit.

    Raises:
        FitError: If there is nothing to compare: no force, no response, or no time in common.
    """
    size = np.linalg.norm(counts - np.median(counts, axis=0), axis=1)
    known_size = np.linalg.norm(known_force - np.median(known_force, axis=0), axis=1)
    if not size.any() or not known_size.any():
        constant = "the known forces" if size.any() else "the counts"
        raise FitError(f"{constant} are always the same: no time offset fits them")
    step = max(_GRID_S, max_offset_s / 5000)
    offsets = np.arange(-max_offset_s, max_offset_s + step, step)
    scores = [_correlation(time, size, known_time + offset, known_size) for offset in offsets]
    if not np.isfinite(scores).any():
        raise FitError("counts and known forces have no time in common")
    best = float(offsets[int(np.nanargmax(scores))])

    def misfit(offset: float) -> float:
        forces, is_inside = forces_at(time, known_time + offset, known_force)
        terms = np.column_stack([counts[is_inside], np.ones(int(is_inside.sum()))])
        error = forces[is_inside] - terms @ np.linalg.lstsq(terms, forces[is_inside], rcond=None)[0]
        return float(np.mean(error**2))

    width = 5 * step
    result: Any = minimize_scalar(misfit, bounds=(best - width, best + width), method="bounded", options={"xatol": 1e-5})
    return float(result.x)


def forces_at(
    time: Float[np.ndarray, " sample"],
    known_time: Float[np.ndarray, " step"],
    known_force: Float[np.ndarray, "step component"],
) -> tuple[Float[np.ndarray, "sample component"], Bool[np.ndarray, " sample"]]:
    """Return known forces at other times, linear in between, and which of the times lie within theirs."""
    result = np.column_stack([np.interp(time, known_time, component) for component in known_force.T])
    return result, (time >= known_time[0]) & (time <= known_time[-1])


def _correlation(time: np.ndarray, size: np.ndarray, known_time: np.ndarray, known_size: np.ndarray) -> float:
    is_inside = (time >= known_time[0]) & (time <= known_time[-1])
    if is_inside.sum() < max(4, 0.5 * min(len(time), len(known_time))):
        return np.nan
    a, b = size[is_inside], np.interp(time[is_inside], known_time, known_size)
    a, b = a - a.mean(), b - b.mean()
    norm = np.linalg.norm(a) * np.linalg.norm(b)
    return float(a @ b / norm) if norm > 0 else np.nan


def _expect_loads(force: Forces, has_tare: bool) -> None:
    """Raise an error that names the axis, or else the direction, without load."""
    strength, directions = _spread(force)
    limit = _LOADED * strength.max()
    if strength.min() > limit:
        return
    along = np.sqrt(np.mean(force**2, axis=0))
    missing = [name for name, size in zip("xyz", along, strict=True) if size <= limit]
    problem = f"no load along {' or '.join(missing)} of the link"
    if not missing:
        weak = ", ".join(f"{value:.2f}" for value in directions[int(np.argmin(strength))])
        problem = f"no load in the direction ({weak}) of the link: all loads lie in a plane"
    than = "" if has_tare else ", and no load as one of them, or keep the tare"
    raise FitError(f"{problem}; expected loads along x, y and z{than}")


def _expect_response(counts: Forces) -> None:
    strength, directions = _spread(counts)
    if strength.min() > 1e-3 * strength.max():
        return
    weak = directions[int(np.argmin(strength))]
    which = "xyz"[int(np.argmax(abs(weak)))]
    problem = f"the fingertip's counts along its {which}"
    raise FitError(f"{problem} say nothing of the loads: they do not change, or follow the others")


def _spread(vectors: Forces) -> tuple[np.ndarray, np.ndarray]:
    _, values, directions = np.linalg.svd(vectors, full_matrices=False)
    return values / np.sqrt(len(vectors)), directions


def _signs(counts: Forces, force: Forces) -> tuple[np.ndarray, np.ndarray]:
    slope = (counts * force).sum(axis=0) / (counts**2).sum(axis=0)
    return np.diag(np.where(slope < 0, -1.0, 1.0)), _positive(abs(slope))


def _rotation(counts: Forces, force: Forces) -> tuple[np.ndarray, np.ndarray]:
    linear = np.linalg.lstsq(counts, force, rcond=None)[0].T
    scale = np.linalg.norm(linear, axis=0)
    rotation = np.eye(3)
    for _ in range(_MAX_TURNS):
        left, _, right = np.linalg.svd(force.T @ (counts * scale))
        rotation = left @ right
        along_sensor = force @ rotation
        new = (counts * along_sensor).sum(axis=0) / (counts**2).sum(axis=0)
        is_settled = abs(new - scale).max() <= _SETTLED * abs(scale).max()
        scale = new
        if is_settled:
            break
    return rotation, _positive(scale)


def _positive(scale: np.ndarray) -> np.ndarray:
    if not (scale > 0).all():
        weak = " or ".join(name for name, value in zip("xyz", scale, strict=True) if not value > 0)
        raise FitError(f"the fingertip's counts along its {weak} do not follow the loads")
    return scale
