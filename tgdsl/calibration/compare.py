"""Several kernels or kinds fitted to the same recordings, in one table.

tgdsl: 1
compare:
  half space:
    set: {sensors.skin: {kind: elastomer, kernel: half_space, ...}}
    fit: [skin.poissons_ratio]
  as written: {}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from tgdsl.calibration.fit import Fit, calibrate
from tgdsl.calibration.recordings import Arrays
from tgdsl.compiler.pipeline import Document
from tgdsl.console.tables import text_table
from tgdsl.fields.models import SpecModel
from tgdsl.schema.load import read_spec


class CandidateSpec(SpecModel):
    """A model to compare: changes of the document, and what is fitted."""

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
    **options: Any,
) -> Comparison:
    """Fit several models to the same recordings.

    Args:
        document: A YAML file, or the same as a mapping.
        recordings: What to fit them to, as `tgdsl.calibrate` takes them.
        models: A YAML file with `compare:`, or what stands there as a mapping: by name `set` and `fit`.
        overrides: Values by dotted path, for all models.
        options: Other options of `tgdsl.calibrate`, for all models.

    Raises:
        SpecError: All mistakes in the file, the document or a recording.
        TgdslError: As `tgdsl.calibrate`.
    """
    source = {"tgdsl": 1, "compare": models} if isinstance(models, Mapping) else Path(models)
    spec, _ = read_spec(source, ComparisonSpec, ("tgdsl", "compare"))
    fits = {
        name: calibrate(document, recordings, each.fit, overrides={**(overrides or {}), **each.set}, **options)
        for name, each in spec.compare.items()
    }
    return Comparison(fits)
