"""`tgdsl hand monitor`: what a hand feels, live."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tgdsl.commands.arguments import OptionalFile
from tgdsl.commands.hand.arguments import HandId, Port, calibration_of, until_ctrl_c


@dataclass(frozen=True)
class Monitor:
    """Show what the hand feels, live, until Ctrl-C."""

    port: Port = None
    hand_id: HandId = None
    calibration: OptionalFile = None
    """The hand's calibration file; default: forces are counts."""
    seconds: float = math.inf
    """For how long [s]; default: until Ctrl-C."""

    def run(self) -> None:
        """Draw the table over itself; at the end, once more."""
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.log.log import events
        from tgdsl.runtime.xhand1.wire.ports import the_hand
        from tgdsl.view.hand_table import HandView

        calibration, found = calibration_of(self.calibration), the_hand(self.port, self.hand_id)
        view = HandView(calibration, f"{found.device}: hand {found.addresses.hand_id}")
        with XHand1.open(found.device, found.addresses) as hand, until_ctrl_c(view):
            for event in events(hand, self.seconds):
                view.show(event)
