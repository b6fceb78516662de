"""A kind of source as it registers: its name, how users name one, which options it knows, and how it is opened."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tgdsl.runtime.connection import Connection


@dataclass(frozen=True)
class SourceKind:
    """A kind of source that `tgdsl.connect` can open.

    Attributes:
        name: Its name, by which it is also recognised: alone, or with an address, "name:ADDRESS".
        expected: How users name a source of this kind, as errors list it: '"name" or "name:ADDRESS"'.
        open: Opens a source: `open(touch, source, *, option, …)`, given the module and the source as the user named it. The
            options that it knows are its keyword-only parameters: those of `connect` that it needs, and any of its own.
        recognise: Whether a source that a user named is of this kind; default: if its name is the kind's.
    """

    name: str
    expected: str
    open: Callable[..., Connection]
    recognise: Callable[[str], bool] | None = None

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the options that it knows."""
        return keyword_options(self.open)

    def recognises(self, source: str) -> bool:
        """Return whether a source that a user named is of this kind."""
        return source.partition(":")[0] == self.name if self.recognise is None else self.recognise(source)


@dataclass(frozen=True, kw_only=True)
class SimulatorKind(SourceKind):
    """A kind of source that `tgdsl.simulate` can make too.

    Attributes:
        devices: Types of torch devices whose physics it is taken for: "cpu", "cuda".
        simulate: Makes a simulation: `simulate(touch, num_envs, *, device, option, …)`.
    """

    devices: tuple[str, ...]
    simulate: Callable[..., Any]


def keyword_options(call: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of a function's keyword-only parameters."""
    return tuple(p.name for p in inspect.signature(call).parameters.values() if p.kind is p.KEYWORD_ONLY)
