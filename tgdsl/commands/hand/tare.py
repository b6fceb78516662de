"""`tgdsl hand tare`: what the fingertips read unloaded, to a calibration file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tgdsl.commands.arguments import OUT, OptionalFile, Replace, refuse_to_replace
from tgdsl.commands.hand.arguments import HandId, Port, calibration_of
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    from tgdsl.runtime.xhand1 import driver

_TRIES = 5


@dataclass(frozen=True)
class Tare:
    """Read the fingertips while nothing touches them, and write that into a calibration file."""

    out: Annotated[Path, OUT] = Path("hand.calibration.yaml")
    """The calibration file to write."""
    port: Port = None
    hand_id: HandId = None
    calibration: OptionalFile = None
    """A calibration file that gives everything except the tare; default: counts."""
    frames: int = 20
    """Readings to average, at least 5."""
    max_spread: float = 4.0
    """Largest difference between two readings of a component that still counts as untouched [counts]."""
    force: Replace = False

    def run(self) -> None:
        """Write the file and print the tare."""
        from tgdsl.files.write import atomic_write, with_folder
        from tgdsl.runtime.xhand1.calibration import Calibration
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.wire.ports import the_hand
        from tgdsl.runtime.xhand1.wire.protocol import FINGERS

        refuse_to_replace(self.out, self.force)
        base, found = calibration_of(self.calibration) or Calibration.none(), the_hand(self.port, self.hand_id)
        with XHand1.open(found.device, found.addresses) as hand:
            tare = _tare(hand, self.frames)
        spreads = [
            f"{name} {axis} by {spread:g}"
            for name, row in zip(FINGERS, tare.spread, strict=True)
            for axis, spread in zip("xyz", row, strict=True)
            if spread > self.max_spread
        ]
        if spreads:
            problem = f"the fingertips were not still over {self.frames} readings: {', '.join(spreads)} counts"
            raise TgdslError(f"{problem}, expected at most {self.max_spread:g}; leave the hand untouched, or see --max-spread")
        atomic_write(with_folder(self.out), base.with_tare(tare).text().encode())
        for name, mean, spread in zip(FINGERS, tare.mean, tare.spread, strict=True):
            print(f"{name:<7} tare {mean[0]:7.2f} {mean[1]:7.2f} {mean[2]:7.2f}   spread {max(spread):g} counts")
        print(f"calibration: {self.out}")


def _tare(hand: driver.XHand1, num_frames: int) -> driver.Tare:
    """Tare a hand, again if a reply is lost or damaged on the way; after a few times that is an error."""
    from tgdsl.runtime.xhand1.wire.errors import HandTimeoutError

    for _ in range(_TRIES - 1):
        try:
            return hand.tare(num_frames)
        except HandTimeoutError:
            continue
    return hand.tare(num_frames)
