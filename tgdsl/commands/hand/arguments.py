"""What the commands on a real hand share: its port and id, its calibration, and a view that Ctrl-C ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from tgdsl.runtime.xhand1.calibration import Calibration
    from tgdsl.view.hand_table import HandView

Port = Annotated[
    str | None,
    tyro.conf.arg(
        help="The hand's serial port; default: the port of the only hand found. `emulator`: an emulated hand at rest."
    ),
]
HandId = Annotated[int | None, tyro.conf.arg(help="The hand's id, where several are on one port.")]


def calibration_of(path: Path | None) -> Calibration | None:
    """Return the calibration of a file, if there is one.

    Raises:
        SpecError: If the file has mistakes.
    """
    from tgdsl.runtime.xhand1.calibration import load_calibration

    return None if path is None else load_calibration(path)


@contextmanager
def until_ctrl_c(view: HandView) -> Iterator[None]:
    """End the block at Ctrl-C as if it had finished; then draw the view's last state."""
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        view.end()
