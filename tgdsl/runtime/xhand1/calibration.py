"""What fingertip counts mean, for one hand: a YAML file of scale, axes, bias and tare per finger.

    force = rotation · (scale ∘ (counts − tare)) + bias

`counts` are the hand's own, `tare` what it reads unloaded, `scale` is along the sensor's axes, `rotation` turns them into the
axes of the fingertip's link in the robot file, and `bias` is in the file's unit. What unit and axes the counts have is not
published: without a file they stay counts along the sensor's axes.

Shapes: `finger` thumb, index, middle, ring, pinky.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Num
from pydantic import model_validator

from tgdsl.fields.models import Number, Positive, SpecModel
from tgdsl.runtime.xhand1.driver import Tare
from tgdsl.runtime.xhand1.wire.protocol import FINGERS
from tgdsl.schema.load import parse_spec, read_spec

Sign = Literal[-1, 1]
Row = tuple[Number, Number, Number]
_ORTHOGONAL = 1e-4  # largest error of a rotation's product with its transpose: five written digits


class FingerSpec(SpecModel):
    """One fingertip."""

    scale: tuple[Positive, Positive, Positive] | None = None
    """Unit per count along the sensor's x, y, z; default, where the unit is counts: 1."""
    signs: tuple[Sign, Sign, Sign] | None = None
    """1 or -1 for each of the sensor's axes, if they are parallel to the link's."""
    rotation: tuple[Row, Row, Row] | None = None
    """Rows of the matrix that takes the sensor's axes to the link's; it may also mirror or exchange axes."""
    bias: Row = (0.0, 0.0, 0.0)
    """Offset of the force, along the link's axes [unit]."""
    tare: Row = (0.0, 0.0, 0.0)
    """What the sensor reads unloaded [counts]."""

    @model_validator(mode="after")
    def _check(self) -> FingerSpec:
        if self.signs is not None and self.rotation is not None:
            raise ValueError("found `signs` and `rotation`, expected one of them")
        matrix = self.matrix
        error = np.abs(matrix @ matrix.T - np.eye(3)).max()
        if error > _ORTHOGONAL:
            raise ValueError(f"rotation is off by {error:.2g}, expected rows of length 1 at right angles")
        return self

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The rotation, whichever way it is written."""
        if self.rotation is not None:
            return np.array(self.rotation, dtype=np.float64)
        return np.diag(np.array(self.signs or (1, 1, 1), dtype=np.float64))


class FingersSpec(SpecModel):
    """All fingertips."""

    thumb: FingerSpec
    index: FingerSpec
    middle: FingerSpec
    ring: FingerSpec
    pinky: FingerSpec


class CalibrationSpec(SpecModel):
    """What one hand's counts mean."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    hand: str | None = None
    """Which hand it is for, in the user's words."""
    units: Literal["counts", "N"] = "counts"
    """Unit of the forces that come out."""
    contact_threshold: Positive | None = None
    """Force above which a fingertip is in contact, for the observation `agg_bool` [unit]."""
    fingers: FingersSpec
    """The fingertips."""

    @model_validator(mode="after")
    def _check(self) -> CalibrationSpec:
        without = [name for name in FINGERS if getattr(self.fingers, name).scale is None]
        if self.units == "N" and without:
            raise ValueError(f"the unit is N, but {', '.join(without)} without `scale`; expected N per count")
        return self


_REQUIRED = ("tgdsl", "fingers")
_PARTS = ("scale", "rotation", "bias", "tare")


@dataclass(frozen=True, eq=False)
class Calibration:
    """What one hand's counts mean."""

    units: Literal["counts", "N"]  # unit of what `apply` returns
    scale: Float[np.ndarray, "finger 3"]  # unit per count, along the sensor's axes
    rotation: Float[np.ndarray, "finger 3 3"]  # from the sensor's axes to the link's
    bias: Float[np.ndarray, "finger 3"]  # offset of the force [units]
    tare: Float[np.ndarray, "finger 3"]  # what the sensors read unloaded [counts]
    hand: str = ""  # which hand it is for, or empty
    contact_threshold: float | None = None  # force above which a fingertip is in contact [units]; None if that was not said

    @classmethod
    def none(cls) -> Calibration:
        num = len(FINGERS)
        zero = np.zeros((num, 3))
        return cls("counts", np.ones((num, 3)), np.tile(np.eye(3), (num, 1, 1)), zero, zero)

    def apply(self, counts: Num[np.ndarray, "*batch finger 3"]) -> Float[np.ndarray, "*batch finger 3"]:
        """Return the force on each fingertip, along its link's axes [units], from `HandState.total_force`."""
        along_sensor = self.scale * (counts - self.tare)
        return np.einsum("fij,...fj->...fi", self.rotation, along_sensor) + self.bias

    def counts_of(self, force: Float[np.ndarray, "*batch finger 3"]) -> Float[np.ndarray, "*batch finger 3"]:
        """Return the counts, not rounded, that `apply` makes a force of, along the links' axes [units]."""
        return np.einsum("fij,...fi->...fj", self.rotation, force - self.bias) / self.scale + self.tare

    def with_tare(self, tare: Tare) -> Calibration:
        return replace(self, tare=tare.mean)

    def text(self) -> str:
        """Return the YAML that `load_calibration` reads."""
        lines = ["tgdsl: 1", f"units: {self.units}"]
        lines += [f"hand: {json.dumps(self.hand, ensure_ascii=False)}"] if self.hand else []
        lines += [] if self.contact_threshold is None else [f"contact_threshold: {self.contact_threshold!r}"]
        lines.append("fingers:")
        for i, name in enumerate(FINGERS):
            lines.append(f"  {name}:")
            lines += [f"    {part}: {json.dumps(getattr(self, part)[i].tolist())}" for part in _PARTS]
        return "\n".join(lines) + "\n"


def load_calibration(path: Path) -> Calibration:
    """Read a calibration file.

    Raises:
        SpecError: All its mistakes, each at its place.
    """
    return _calibration(read_spec(path, CalibrationSpec, _REQUIRED)[0])


def parse_calibration(text: str) -> Calibration:
    """Read the text of a calibration, as a log holds it."""
    return _calibration(parse_spec(text.encode(), "calibration", CalibrationSpec, _REQUIRED)[0])


def _calibration(spec: CalibrationSpec) -> Calibration:
    fingers = [getattr(spec.fingers, name) for name in FINGERS]
    return Calibration(
        spec.units,
        np.array([finger.scale or (1.0, 1.0, 1.0) for finger in fingers], dtype=np.float64),
        np.stack([finger.matrix for finger in fingers]),
        np.array([finger.bias for finger in fingers], dtype=np.float64),
        np.array([finger.tare for finger in fingers], dtype=np.float64),
        spec.hand or "",
        spec.contact_threshold,
    )
