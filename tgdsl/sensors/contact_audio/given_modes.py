"""The modes of each body that rings: those listed, or those of its shape; modal analysis is called here alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tgdsl.console.progress import Progress, silent
from tgdsl.modal.modes import Modes
from tgdsl.modal.spec import ShapeModes
from tgdsl.sensors.contact_audio.spec import ModesField
from tgdsl.surfaces.surface import Surface


def modes_of(given: ModesField, name: str, surface: Callable[[], Surface], below: float, progress: Progress = silent) -> Modes:
    """Return the modes of a body.

    Args:
        given: What the document says of them.
        name: What the body is called in messages.
        surface: Returns its surface in its frame; called where its shape is wanted.
        below: Frequency beyond which a mode is not heard [Hz]. Those that are listed are returned all the same.
        progress: Called with a line of text for each long job.

    Raises:
        LowerError: If its shape gives none.
    """
    if isinstance(given, ShapeModes):
        from tgdsl.modal.analysis import analysed

        return analysed(name, surface(), given, below, progress)
    ordered = sorted(given, key=lambda mode: mode.frequency)
    return Modes(
        frequency=np.array([mode.frequency for mode in ordered]),
        decay=np.array([mode.decay for mode in ordered]),
        gain=np.array([mode.gain for mode in ordered]),
    )
