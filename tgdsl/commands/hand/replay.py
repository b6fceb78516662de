"""`tgdsl hand replay`: a log, shown as the hand was."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import OptionalFile
from tgdsl.commands.hand.arguments import calibration_of, until_ctrl_c


@dataclass(frozen=True)
class Replay:
    """Show a log as `monitor` showed the hand."""

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG.npz")]
    """The log."""
    speed: float = 1.0
    """How much faster than it was; `inf` is as fast as possible."""
    calibration: OptionalFile = None
    """A calibration file; default: the log's."""

    def run(self) -> None:
        """Draw the table over itself; at the end, once more."""
        from tgdsl.runtime.xhand1.log.log import Fault
        from tgdsl.runtime.xhand1.log.replay import ReplaySource
        from tgdsl.runtime.xhand1.wire.errors import HandError
        from tgdsl.view.hand_table import HandView

        source = ReplaySource(self.log, speed=self.speed, calibration=calibration_of(self.calibration))
        log = source.log
        view = HandView(source.calibration, f"{log.identity or 'an unnamed hand'}   ({self.log})")
        with source, until_ctrl_c(view):
            view.show(source.sample().reading, now=source.now)
            while not source.is_over:
                try:
                    source.step()
                    view.show(source.sample().reading, now=source.now)
                except HandError as error:
                    view.show(Fault.of(error, source.now), now=source.now)
        print(f"{log.num_readings} readings, {len(log.faults)} failures in {log.seconds:.2f} s")
