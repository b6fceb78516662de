"""The recorded log of an XHand1 as a source: the path of an `.npz` file."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path

from tgdsl.module.module import TactileModule
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.source_kind import SourceKind
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.connect import HandConnection, given_calibration
from tgdsl.runtime.xhand1.fingertips import warn_of_noise
from tgdsl.runtime.xhand1.log.replay import ReplaySource
from tgdsl.runtime.xhand1.observe import HandObserver


def _open(
    touch: TactileModule, source: str, *, control_step: float, calibration: Calibration | str | Path | None, lockstep: bool
) -> Connection:
    speed = math.inf if lockstep else 1.0
    replay = ReplaySource(Path(source), control_step=control_step, speed=speed, calibration=given_calibration(calibration))
    with ExitStack() as opened:
        opened.callback(replay.close)
        observer = HandObserver(touch, replay.calibration, control_step, is_log=True)
        warn_of_noise(touch.plan)
        opened.pop_all()
    return HandConnection(replay, observer)


LOG = SourceKind("log", 'the path of a log, "….npz"', _open, recognise=lambda source: source.endswith(".npz"))
"""A hand that was recorded."""
