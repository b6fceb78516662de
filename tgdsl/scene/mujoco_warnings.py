"""MuJoCo's warnings as Python warnings: one per message, with the file's name; no output and no MUJOCO_LOG.TXT.

MuJoCo warns in two ways: from its C library, which would print and log, on any thread; and as Python warnings. A Python
exception in the C library's callback ends the process, so messages are collected and raised as warnings afterwards.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco

IRRELEVANT = "Attaching a spec with an empty prefix"
"""Our scenes attach robots under their own names on purpose, and MuJoCo never saves these scenes."""

DIVERGENCE = "Nan, Inf or huge value in"  # prefix of messages about divergence, which simulators detect themselves


@contextmanager
def collected_messages() -> Iterator[list[str]]:
    """Collect what MuJoCo's C library would print and log."""
    previous, messages = mujoco.get_mju_user_warning(), list[str]()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield messages
    finally:
        mujoco.set_mju_user_warning(previous)


@contextmanager
def muted_mujoco() -> Iterator[None]:
    with collected_messages(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def located_warnings(file: object, stacklevel: int = 4) -> Iterator[None]:
    """Repeat each different warning of MuJoCo's model reader once at the end; if reading fails, there is only the error.

    Args:
        file: Name that begins each warning; warnings of our own readers begin with it already.
        stacklevel: As for `warnings.warn`, counted from here.
    """
    with collected_messages() as messages, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    texts = [(_named(message, file), UserWarning) for message in messages]
    texts += [(_named(str(w.message), file) if w.category is UserWarning else str(w.message), w.category) for w in caught]
    for text, category in dict.fromkeys(texts):
        if IRRELEVANT not in text:
            warnings.warn(text, category, stacklevel=stacklevel)


def _named(message: str, file: object) -> str:
    return message if message.startswith(str(file)) else f"{file}: MuJoCo: {' '.join(message.split())}"


class StepWarnings:
    """MuJoCo's warnings while it steps: one per kind of message, none about divergence, which `EnvFaults` reports."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def warn(self, messages: Sequence[str]) -> None:
        """Warn of new kinds of messages."""
        for message in messages:
            kind = re.sub(r"\d[\d.e+-]*", "", message)  # without time and element numbers
            if kind not in self._told and DIVERGENCE not in message:
                self._told.add(kind)
                warnings.warn(f"MuJoCo: {' '.join(message.split())}; shown once", stacklevel=5)
