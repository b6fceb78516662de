"""`tgdsl calibrate sensor`: parameters of a document's sensors, fitted to recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from tgdsl.commands.arguments import FILE, OUT, OptionalFile, Overrides, parsed_overrides, refuse_to_replace
from tgdsl.errors import TgdslError


@dataclass(frozen=True)
class CalibrateSensor:
    """Fit parameters of sensors to recordings; docs/reality.md describes the recordings."""

    document: Annotated[tyro.conf.Positional[Path], FILE]
    """The document; its values are where the search starts."""
    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RECORDING")]
    """The recordings: .npz files, or YAML documents of CSV files."""
    fit: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SENSOR.FIELD")] = ()
    """Parameters, or with a range to search: `skin.thickness="1 mm:9 mm"`; none: the document predicts the recordings."""
    compare: OptionalFile = None
    """YAML file with `compare:`, models that are fitted in turn; prints one table."""
    reading: Literal["none", "offset", "scale", "affine"] = "none"
    """Map of its own that each recording's reading may have: an offset, also a scale, or an affine map of the rows' places."""
    gain: bool = False
    """Each recording may have a gain of its own."""
    robust: bool = False
    """Rows far off, such as lost markers, count less."""
    hold_out: Literal["none", "taxel", "blocks", "time", "recording"] = "none"
    """What is left out in turn to measure the error on it."""
    folds: int = 6
    """Number of parts for that."""
    starts: int = 8
    """Starts of the search."""
    intervals: Literal["profile", "bootstrap", "none"] = "profile"
    """How 95 % intervals are computed; `none`: from the derivatives."""
    seed: int = 0
    """Seed of starts, folds and the bootstrap."""
    set: Overrides = ()
    out: Annotated[Path | None, OUT] = None
    """The document to write with the fitted values, beside the document."""
    plot: OptionalFile = None
    """The picture to write: targets, fits and residuals."""
    force: bool = False
    """Replace the files if they are there."""

    def run(self) -> None:
        """Fit, report, and write the files."""
        from tgdsl.calibration.compare import compare
        from tgdsl.calibration.fit import calibrate

        options: dict[str, Any] = {
            "reading": self.reading, "gain": self.gain, "robust": self.robust, "hold_out": self.hold_out, "folds": self.folds,
            "starts": self.starts, "intervals": self.intervals, "seed": self.seed, "overrides": parsed_overrides(self.set),
        }  # fmt: skip
        if self.compare is not None:
            if self.fit or self.out is not None or self.plot is not None:
                raise TgdslError("--compare prints a table of its own models, expected no --fit, --out or --plot")
            print(compare(self.document, list(self.recordings), self.compare, **options))
            return
        for file in (self.out, self.plot):
            if file is not None:
                refuse_to_replace(file, self.force)
        fit = calibrate(self.document, list(self.recordings), self.fit, **options)
        print(fit)
        if self.out is not None:
            print(f"document: {fit.document(self.out)}")
        if self.plot is not None:
            print(f"picture:  {fit.plot(self.plot)}")
