"""Samples of a log with known forces on fingertips.

Known are either constant loads over intervals of the log, as a YAML file says, or forces over time, as of a simulation.

    tgdsl: 1
    loads:
      - {finger: index, start: 0, end: 2 s, force: [0, 0, 0]}
      - {finger: index, start: 3.5 s, end: 6 s, force: [0, 0, -2 N]}    # on the fingertip, along its link's axes

Shapes: `reading` of the log, `finger`, `taxel` as in `protocol`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, model_validator

from tgdsl.calibration.hand.fit import FitError, Forces, forces_at
from tgdsl.errors import TgdslError
from tgdsl.fields.models import Quantity, SpecModel
from tgdsl.files.arrays import read_arrays
from tgdsl.module.module import TactileModule
from tgdsl.runtime.xhand1.log.log import HandLog
from tgdsl.runtime.xhand1.observe import TIP_BODIES
from tgdsl.runtime.xhand1.wire.protocol import FINGERS, NUM_TAXELS
from tgdsl.schema.load import read_spec

Seconds = Annotated[float, Quantity("time", ge=0.0)]
Newton = Annotated[float, Quantity("force")]
FORCE_CHANNELS = ("force_x", "force_y", "force_z")


class Load(SpecModel):
    """A constant force on one fingertip for a while."""

    finger: Literal["thumb", "index", "middle", "ring", "pinky"]
    """The finger."""
    start: Seconds
    """Start, after the log's first reading [s]."""
    end: Seconds
    """End [s]."""
    force: tuple[Newton, Newton, Newton]
    """The force on the fingertip, along its link's axes [N]."""

    @model_validator(mode="after")
    def _check(self) -> Load:
        if not self.start < self.end:
            raise ValueError(f"from {self.start:g} s to {self.end:g} s, expected an end after the start")
        return self


class LoadsSpec(SpecModel):
    """Known loads."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    loads: Annotated[tuple[Load, ...], Field(min_length=1)]
    """The loads; the fit of a finger's tare needs one of [0, 0, 0]."""


@dataclass(frozen=True, eq=False)
class TipRecord:
    """Readings of a log's fingertips."""

    time: Float[np.ndarray, " reading"]  # when each reading was requested, after the first one arrived [s]
    counts: Float[np.ndarray, "reading finger 3"]  # their forces [counts]
    is_saturated: Bool[np.ndarray, "reading finger"]  # whether a component of the force is at the end of its range
    is_taxel_saturated: Bool[np.ndarray, "reading finger taxel"]  # the same of each taxel

    @classmethod
    def of(cls, log: HandLog, ignored_taxels: Sequence[int] = ()) -> TipRecord:
        """Read a log; the numbers of `ignored_taxels` do not count as saturated on any finger, as they always are."""
        if not all(0 <= taxel < NUM_TAXELS for taxel in ignored_taxels):
            raise FitError(f"taxels {', '.join(map(str, ignored_taxels))}: expected numbers from 0 to {NUM_TAXELS - 1}")
        states = [reading.state for reading in log.readings()]
        counts = np.array([state.total_force for state in states], dtype=np.float64).reshape(-1, len(FINGERS), 3)
        is_saturated = np.array([state.is_total_saturated.any(axis=-1) for state in states])
        is_taxel_saturated = np.array([state.is_taxel_saturated.any(axis=-1) for state in states])
        is_taxel_saturated[:, :, list(ignored_taxels)] = False
        return cls(log.requested_at - log.received_at[0], counts, is_saturated, is_taxel_saturated)


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one fingertip with known forces."""

    counts: Forces  # its readings [counts]
    force: Forces  # the force on it, along its link's axes [N]
    num_left_out: int  # samples left out because the sum or a taxel was at the end of its range
    saturated_taxels: tuple[int, ...]  # numbers of the taxels that were


def load_loads(path: Path) -> tuple[Load, ...]:
    """Read a file of loads; all its mistakes are one `SpecError`."""
    spec, _ = read_spec(path, LoadsSpec, ("tgdsl", "loads"))
    return spec.loads


def samples_under_loads(record: TipRecord, finger: str, loads: tuple[Load, ...]) -> Samples:
    """Return a fingertip's samples during its loads.

    Raises:
        FitError: If a load holds no reading, two overlap, or all of them are at the end of the range.
    """
    finger_loads = [load for load in loads if load.finger == finger]
    force = np.full((len(record.time), 3), np.nan)
    for load in finger_loads:
        is_during = (record.time >= load.start) & (record.time <= load.end)
        when = f"{finger}: from {load.start:g} s to {load.end:g} s"
        if not is_during.any():
            end = float(record.time[-1])
            raise FitError(f"{when} the log holds no reading; it goes from 0 s to {end:.3f} s")
        if np.isfinite(force[is_during]).any():
            raise FitError(f"{when} there are two loads at once")
        force[is_during] = load.force
    return _samples(record, finger, force)


def samples_under_forces(
    record: TipRecord, finger: str, time: Float[np.ndarray, " step"], force: Float[np.ndarray, "step 3"]
) -> Samples:
    """Return a fingertip's samples while a force along its link's axes [N] is known, linear between instants [s].

    Instants count from the log's first reading.

    Raises:
        FitError: If they have no time in common, or all samples are at the end of the range.
    """
    forces, is_inside = forces_at(record.time, time, force)
    return _samples(record, finger, np.where(is_inside[:, None], forces, np.nan))


def known_tip_forces(path: Path) -> tuple[Float[np.ndarray, " step"], dict[str, Float[np.ndarray, "step 3"]]]:
    """Return the times and forces of an `.npz` file with `time` (step,) [s] and `tip_force` (step, finger, 3) [N].

    Raises:
        TgdslError: If it is no such file.
    """
    arrays = _arrays(path, ("time", "tip_force"))
    time, force = arrays["time"], arrays["tip_force"]
    if force.shape != (len(time), len(FINGERS), 3):
        raise TgdslError(f"{path}: tip_force has shape {force.shape}, expected ({len(time)}, {len(FINGERS)}, 3)")
    return time, {name: force[:, i] for i, name in enumerate(FINGERS)}


def simulated_tip_forces(
    path: Path, touch: TactileModule, name: str, *, depth_scale: float = 1e4, env: int = 0
) -> tuple[Float[np.ndarray, " step"], dict[str, Float[np.ndarray, "step 3"]]]:
    """Return the times and the forces on fingertips that `tgdsl run` wrote, summed over each fingertip's taxels.

    Args:
        path: Its readings.npz.
        touch: The module that was run.
        name: A reading with forces, or with depths, which are summed along the normals as the observation `agg_force` does.
        depth_scale: That observation's scale [N/m].
        env: Which environment.

    Raises:
        TgdslError: If the file does not hold this reading, or it is no force on a fingertip.
    """
    outputs = {output.name: output for output in touch.outputs}
    if name not in outputs:
        raise TgdslError(f'the document has no reading "{name}"; it has {", ".join(outputs)}')
    output = outputs[name]
    arrays = _arrays(path, ("time", name))
    time, reading = arrays["time"], arrays[name]
    if reading.ndim != 4 or reading.shape[2:] != output.shape or not 0 <= env < reading.shape[1]:
        raise TgdslError(f"{path}: {name} has shape {reading.shape}, expected (step, more than {env}, {str(output.shape)[1:]}")
    taxels = touch.taxels[output.sensor]
    bodies = np.array(output.bodies) if output.rows == "body" else taxels["body"]
    if set(FORCE_CHANNELS) <= set(output.channels):
        force = reading[:, env][:, :, [output.channels.index(name) for name in FORCE_CHANNELS]].astype(np.float64)
    elif output.channels[:1] == ("depth",):
        force = depth_scale * reading[:, env, :, :1].astype(np.float64) * taxels["normal"]
    else:
        raise TgdslError(f"{name} has channels {', '.join(output.channels)}, expected forces or depths")
    is_tip = {finger: np.char.endswith(bodies.astype(np.str_), body) for finger, body in zip(FINGERS, TIP_BODIES, strict=True)}
    forces = {finger: force[:, is_own].sum(axis=1) for finger, is_own in is_tip.items() if is_own.any()}
    if not forces:
        raise TgdslError(f"{name} is on {', '.join(dict.fromkeys(bodies))}: none of them is a fingertip of an XHand1")
    return time, forces


def _samples(record: TipRecord, finger: str, force: Forces) -> Samples:
    """Return the samples whose force is known (finite) and that are within range."""
    i = FINGERS.index(finger)
    is_known = np.isfinite(force).all(axis=1)
    if not is_known.any():
        raise FitError(f"{finger}: there is no reading while its force is known")
    taxels = record.is_taxel_saturated[:, i]
    is_left_out = is_known & (record.is_saturated[:, i] | taxels.any(axis=1))
    saturated = tuple(int(taxel) for taxel in np.flatnonzero(taxels[is_known].any(axis=0)))
    is_used = is_known & ~is_left_out
    if not is_used.any():
        where = f"its sum or a taxel ({', '.join(map(str, saturated))}) is" if saturated else "its sum is"
        problem = f"{finger}: in all {int(is_known.sum())} readings {where} at the end of the range"
        raise FitError(f"{problem}; expected smaller loads, or taxels that are always there left out of this")
    return Samples(record.counts[is_used, i], force[is_used], int(is_left_out.sum()), saturated)


def _arrays(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    arrays = read_arrays(path, f"an .npz file with arrays {' and '.join(names)}")
    if missing := [name for name in names if name not in arrays]:
        held = sorted(name for name in arrays if ":" not in name)
        raise TgdslError(f"{path}: there is no array {' and '.join(missing)}; it holds {', '.join(held)}")
    return {name: arrays[name] for name in names}
