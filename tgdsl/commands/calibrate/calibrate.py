"""`tgdsl calibrate`: parameters of sensors, or a real hand's counts, from recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from tgdsl.commands.calibrate.hand import CalibrateHand
from tgdsl.commands.calibrate.sensor import CalibrateSensor

Action = Annotated[CalibrateSensor, tyro.conf.subcommand("sensor")] | Annotated[CalibrateHand, tyro.conf.subcommand("hand")]
"""What can be calibrated, by its name."""


@dataclass(frozen=True)
class Calibrate:
    """Fit to recordings: sensor fits parameters of a document's sensors, hand the counts of a real hand's fingertips."""

    action: Annotated[Action, tyro.conf.arg(name="")]
    """What to calibrate."""

    def run(self) -> None:
        """Do it."""
        self.action.run()
