"""`tgdsl hand record`: all that a hand says, to a log."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import OptionalFile, Replace, refuse_to_replace
from tgdsl.commands.hand.arguments import HandId, Port, calibration_of, until_ctrl_c
from tgdsl.errors import TgdslError


@dataclass(frozen=True)
class Record:
    """Record everything that the hand says, for `tgdsl hand replay`, `tgdsl calibrate hand` and `ReplaySource`."""

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT.npz")]
    """The log to write."""
    seconds: float = math.inf
    """For how long [s]; default: until Ctrl-C."""
    port: Port = None
    hand_id: HandId = None
    calibration: OptionalFile = None
    """The hand's calibration file, which goes into the log; default: none."""
    force: Replace = False

    def run(self) -> None:
        """Write the log; after Ctrl-C too."""
        from tgdsl.files.write import with_folder
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.log.log import LogWriter, events
        from tgdsl.runtime.xhand1.wire.ports import identify, the_hand
        from tgdsl.view.hand_table import HandView

        refuse_to_replace(self.out, self.force)
        if not self.seconds > 0:
            raise TgdslError(f"--seconds {self.seconds:g}: expected more than 0")
        calibration, found = calibration_of(self.calibration), the_hand(self.port, self.hand_id)
        identity = identify(found)
        view = HandView(calibration, str(identity))
        with (
            LogWriter(with_folder(self.out), identity=identity, calibration=calibration) as log,
            XHand1.open(found.device, found.addresses) as hand,
            until_ctrl_c(view),
        ):
            for event in events(hand, self.seconds):
                log.add(event)
                view.show(event)
        print(f"{self.out}: {log.num_readings} readings, {log.num_faults} failures, {self.out.stat().st_size} bytes")
