"""`tgdsl hand`: all commands on a real hand. None can move a joint.

What is sent are version and register requests, which hold no set-point, and the exchange that asks for mode 0 with no gain and
no current: its reply is the only reading of touch that is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from tgdsl.commands.hand.monitor import Monitor
from tgdsl.commands.hand.probe import Probe
from tgdsl.commands.hand.record import Record
from tgdsl.commands.hand.replay import Replay
from tgdsl.commands.hand.tare import Tare

Action = (
    Annotated[Probe, tyro.conf.subcommand("probe")]
    | Annotated[Monitor, tyro.conf.subcommand("monitor")]
    | Annotated[Tare, tyro.conf.subcommand("tare")]
    | Annotated[Record, tyro.conf.subcommand("record")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
)
"""Every command on a hand by its name."""


@dataclass(frozen=True)
class Hand:
    """Read a real XHand1: probe, monitor, tare, record, replay. Nothing here can move a joint."""

    action: Annotated[Action, tyro.conf.arg(name="")]
    """What to do."""

    def run(self) -> None:
        """Do it; Ctrl-C ends it with the hand's port closed."""
        if isinstance(self.action, Replay) or self.action.port != "emulator":
            self.action.run()
            return
        from tgdsl.runtime.xhand1.emulator.emulator import Emulator

        with Emulator() as emulator:
            replace(self.action, port=emulator.device).run()
