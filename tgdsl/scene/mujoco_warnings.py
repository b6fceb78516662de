"""What MuJoCo warns of: one Python warning a message with the file named, nothing printed, no MUJOCO_LOG.TXT.

MuJoCo tells in two ways: through its C library, which would print and log, from any thread; and as Python warnings. A Python
exception in the former's callback ends the process, so messages are collected first and told when MuJoCo is done.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco

IRRELEVANT = "Attaching a spec with an empty prefix"
"""A robot attached under its own names is just what a scene of ours wants, and scenes are never saved by MuJoCo."""

DIVERGENCE = "Nan, Inf or huge value in"  # how messages begin of values that simulators look at themselves


@contextmanager
def collected_messages() -> Iterator[list[str]]:
    """Collect what MuJoCo's C library would print and log."""
    before, messages = mujoco.get_mju_user_warning(), list[str]()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield messages
    finally:
        mujoco.set_mju_user_warning(before)


@contextmanager
def muted_mujoco() -> Iterator[None]:
    with collected_messages(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def told_of(file: object, stacklevel: int = 4) -> Iterator[None]:
    """Warn once of each thing that MuJoCo warns of while it reads a model, when it has done; of what fails, the error tells.

    Args:
        file: What each warning names first, unless it does so already, as those of readers of ours do.
        stacklevel: As for `warnings.warn`, counted from here.
    """
    with collected_messages() as messages, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    told = [(_named(message, file), UserWarning) for message in messages]
    told += [(_named(str(w.message), file) if w.category is UserWarning else str(w.message), w.category) for w in caught]
    for text, category in dict.fromkeys(told):
        if IRRELEVANT not in text:
            warnings.warn(text, category, stacklevel=stacklevel)


def _named(message: str, file: object) -> str:
    return message if message.startswith(str(file)) else f"{file}: MuJoCo: {' '.join(message.split())}"


class StepWarnings:
    """What MuJoCo warns of while it steps: each thing is told once, and of divergence nothing, of which faults tell."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def tell(self, messages: Sequence[str]) -> None:
        """Warn of what is new."""
        for message in messages:
            kind = re.sub(r"\d[\d.e+-]*", "", message)  # without the instant and the numbers of what it is about
            if kind not in self._told and DIVERGENCE not in message:
                self._told.add(kind)
                warnings.warn(f"MuJoCo: {' '.join(message.split())}; this is said once", stacklevel=5)
