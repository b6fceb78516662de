"""Release threshold of bits: the depth below which a taxel in contact is no longer; it replaces the kind's own threshold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

from torch import Tensor

from tgdsl.fields.models import Range, RangeOf, SpecModel, Usual
from tgdsl.sensors.noise.stage import NoMemory, Number, Stage, Table


class ReleaseKnobs(SpecModel):
    """Knob of the release threshold."""

    release_threshold: Annotated[Annotated[Range, RangeOf("length", ge=0.0)] | None, Usual("length", high=0.1)] = None
    """Depth below which a `contact` taxel switches off again [m]; default: the sensor's own."""


class ReleaseValues(NamedTuple):
    """Depth [m]."""

    release_threshold: Tensor


class ReleaseStage(Stage[ReleaseValues, NoMemory]):
    """Leaves the signal as it is: `decide` of the kind reads the threshold among its constants."""

    name = "release_threshold"
    Knobs = ReleaseKnobs
    numbers = {"release_threshold": Number(16, unit=" m")}
    Values = ReleaseValues

    def values_of(self, knobs: Any) -> Mapping[str, Range]:
        return {"release_threshold": knobs.release_threshold or (-1.0, -1.0)}

    def active(self, values: Table) -> tuple[str, ...]:
        return self.terms if (values["release_threshold"] >= 0).all() else ()


RELEASE = ReleaseStage()
