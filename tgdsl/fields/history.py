"""`history:` of a sensor, what is read of its last calls."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, StrictBool, StrictInt, WithJsonSchema, model_validator

from tgdsl.fields.models import SpecModel, Usual


class HistorySpec(SpecModel):
    """What is read of the last calls."""

    length: Annotated[StrictInt, Field(ge=1), Usual("number", high=1000.0)]
    """Calls that count, this one included; before there are so many since a reset, the first one stands for the missing."""
    reduce: Literal["stack", "last", "median", "mean"] = "stack"
    """`stack`: all of them, oldest first, as a further dimension; or one reading made of them."""
    view: StrictBool = False
    """Whether a stack is handed out as a view of the module's own memory, which the next call overwrites and which
    carries no gradient; default: a copy."""

    @model_validator(mode="after")
    def _is_used(self) -> HistorySpec:
        if self.view and self.reduce != "stack":
            raise ValueError("`view` is used by `reduce: stack` alone, expected it to be left out")
        return self


History = Annotated[
    HistorySpec,
    BeforeValidator(lambda found: {"length": found} if isinstance(found, int) else found),
    WithJsonSchema({"anyOf": [{"type": "integer", "minimum": 1}, HistorySpec.model_json_schema()]}),
]
