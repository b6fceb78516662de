"""Commands on a real hand: `tgdsl hand probe`, `monitor`, `tare`, `record` and `replay`. None can move a joint.

What is sent are version and register requests, which hold no set-point, and the exchange that asks for mode 0 with no gain and
no current: its reply is the only reading of touch that is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.errors import TgdslError
from tgdsl.files.files import with_folder, writable, write_whole

if TYPE_CHECKING:
    from tgdsl.runtime.xhand1.calibration import Calibration
    from tgdsl.runtime.xhand1.driver import Tare, XHand1

_TARE_TRIES = 5
CalibrationFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]


@dataclass(frozen=True)
class Probe:
    """List the serial ports and the hands that answer on them: versions, names and serial numbers."""

    port: str | None = None
    """The only port to ask; default: all. Whatever is on a port is sent a few bytes, so name it if that could do harm."""
    hand_id: int | None = None
    """The only id to ask for; default: 0 to 7."""

    def run(self) -> None:
        """Print the list."""
        from tgdsl.runtime.xhand1.identity import identify
        from tgdsl.runtime.xhand1.wire.ports import ask_ports

        asked = ask_ports(self.port, self.hand_id)
        if not asked:
            print("this computer has no serial port")
        for port in asked:
            print(port)
            for found in port.hands:
                print(f"  {identify(found)}")


@dataclass(frozen=True)
class Monitor:
    """Show what the hand feels, live, until Ctrl-C."""

    port: str | None = None
    """The hand's serial port; default: that of the only hand found."""
    hand_id: int | None = None
    """The hand's id, where several are on one port."""
    calibration: CalibrationFile = None
    """The hand's calibration file; default: forces are counts."""
    seconds: float = math.inf
    """For how long [s]; default: until Ctrl-C."""

    def run(self) -> None:
        """Draw the table over itself; at the end, once more."""
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.log.record import events
        from tgdsl.runtime.xhand1.wire.ports import the_hand
        from tgdsl.view.hand import HandView

        calibration, found = _calibration(self.calibration), the_hand(self.port, self.hand_id)
        view = HandView(calibration, f"{found.device}: hand {found.addresses.hand_id}")
        with XHand1.open(found.device, found.addresses) as hand:
            try:
                for event in events(hand, self.seconds):
                    view.show(event)
            except KeyboardInterrupt:
                pass
            finally:
                view.end()


@dataclass(frozen=True)
class TareHand:
    """Read the fingertips while nothing touches them, and write that into a calibration file."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = Path("hand.calibration.yaml")
    """The calibration file to write."""
    port: str | None = None
    """The hand's serial port; default: that of the only hand found."""
    hand_id: int | None = None
    """The hand's id, where several are on one port."""
    calibration: CalibrationFile = None
    """A calibration file from which all but the tare is taken; default: counts."""
    frames: int = 20
    """Readings to average, at least 5."""
    max_spread: float = 4.0
    """Largest difference between two readings of a component that still counts as untouched [counts]."""
    force: bool = False
    """Replace the file if it is there."""

    def run(self) -> None:
        """Write the file and print the tare."""
        from tgdsl.runtime.xhand1.calibration import Calibration
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.wire.payloads import FINGERS
        from tgdsl.runtime.xhand1.wire.ports import the_hand

        refuse_to_replace(self.out, self.force)
        base, found = _calibration(self.calibration) or Calibration.none(), the_hand(self.port, self.hand_id)
        with XHand1.open(found.device, found.addresses) as hand:
            tare = _tare(hand, self.frames)
        spreads = [
            f"{name} {axis} by {spread:g}"
            for name, row in zip(FINGERS, tare.spread, strict=True)
            for axis, spread in zip("xyz", row, strict=True)
            if spread > self.max_spread
        ]
        if spreads:
            what = f"the fingertips were not still over {self.frames} readings: {', '.join(spreads)} counts"
            raise TgdslError(f"{what}, expected at most {self.max_spread:g}; leave the hand untouched, or see --max-spread")
        write_whole(with_folder(self.out), base.with_tare(tare).text().encode())
        for name, mean, spread in zip(FINGERS, tare.mean, tare.spread, strict=True):
            print(f"{name:<7} tare {mean[0]:7.2f} {mean[1]:7.2f} {mean[2]:7.2f}   spread {max(spread):g} counts")
        print(f"calibration: {self.out}")


@dataclass(frozen=True)
class Record:
    """Record everything that the hand says, for `tgdsl hand replay`, `tgdsl calibrate hand` and `ReplaySource`."""

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT.npz")]
    """The log to write."""
    seconds: float = math.inf
    """For how long [s]; default: until Ctrl-C."""
    port: str | None = None
    """The hand's serial port; default: that of the only hand found."""
    hand_id: int | None = None
    """The hand's id, where several are on one port."""
    calibration: CalibrationFile = None
    """The hand's calibration file, which goes into the log; default: none."""
    force: bool = False
    """Replace the file if it is there."""

    def run(self) -> None:
        """Write the log; after Ctrl-C too."""
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.identity import identify
        from tgdsl.runtime.xhand1.log.record import LogWriter, events
        from tgdsl.runtime.xhand1.wire.ports import the_hand
        from tgdsl.view.hand import HandView

        refuse_to_replace(self.out, self.force)
        if not self.seconds > 0:
            raise TgdslError(f"--seconds {self.seconds:g}: expected more than 0")
        calibration, found = _calibration(self.calibration), the_hand(self.port, self.hand_id)
        identity = identify(found)
        view = HandView(calibration, str(identity))
        with (
            LogWriter(with_folder(self.out), identity=identity, calibration=calibration) as log,
            XHand1.open(found.device, found.addresses) as hand,
        ):
            try:
                for event in events(hand, self.seconds):
                    log.add(event)
                    view.show(event)
            except KeyboardInterrupt:
                pass
            finally:
                view.end()
        print(f"{self.out}: {log.num_readings} readings, {log.num_faults} failures, {self.out.stat().st_size} bytes")


@dataclass(frozen=True)
class Replay:
    """Show a log as `monitor` showed the hand."""

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG.npz")]
    """The log."""
    speed: float = 1.0
    """How much faster than it was; `inf` is as fast as possible."""
    calibration: CalibrationFile = None
    """A calibration file; default: what is in the log."""

    def run(self) -> None:
        """Draw the table over itself; at the end, once more."""
        from tgdsl.runtime.xhand1.log.log import Fault
        from tgdsl.runtime.xhand1.log.replay import ReplaySource
        from tgdsl.runtime.xhand1.wire.errors import HandError
        from tgdsl.view.hand import HandView

        source = ReplaySource(self.log, speed=self.speed, calibration=_calibration(self.calibration))
        log = source.log
        view = HandView(source.calibration, f"{log.identity or 'an unnamed hand'}   ({self.log})")
        with source:
            try:
                view.show(source.sample().reading, now=source.now)
                while not source.is_over:
                    try:
                        source.step()
                        view.show(source.sample().reading, now=source.now)
                    except HandError as error:
                        view.show(Fault.of(error, source.now), now=source.now)
            except KeyboardInterrupt:
                pass
            finally:
                view.end()
        print(f"{log.num_readings} readings, {len(log.faults)} failures in {log.seconds:.2f} s")


_Action = (
    Annotated[Probe, tyro.conf.subcommand("probe")]
    | Annotated[Monitor, tyro.conf.subcommand("monitor")]
    | Annotated[TareHand, tyro.conf.subcommand("tare")]
    | Annotated[Record, tyro.conf.subcommand("record")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
)


@dataclass(frozen=True)
class Hand:
    """Read a real XHand1: probe, monitor, tare, record, replay. Nothing here can move a joint."""

    action: Annotated[_Action, tyro.conf.arg(name="")]
    """What to do."""

    def run(self) -> None:
        """Do it; Ctrl-C ends it with the hand's port closed."""
        self.action.run()


def refuse_to_replace(out: Path, is_forced: bool) -> None:
    """Raise an error if a file cannot be written, or is there and may not be replaced.

    Raises:
        TgdslError: If so.
    """
    if out.is_file() and not is_forced:
        raise TgdslError(f"{out}: this file is there already; give --force to replace it, or another name")
    writable(out)


def _tare(hand: XHand1, num_frames: int) -> Tare:
    """Tare a hand, anew if a reply is lost or damaged on the way; after a few times that is an error."""
    from tgdsl.runtime.xhand1.wire.errors import HandChecksumError, HandTimeoutError, StaleReadingError

    for _ in range(_TARE_TRIES - 1):
        try:
            return hand.tare(num_frames)
        except (HandTimeoutError, HandChecksumError, StaleReadingError):
            continue
    return hand.tare(num_frames)


def _calibration(path: Path | None) -> Calibration | None:
    from tgdsl.runtime.xhand1.calibration import load_calibration

    return None if path is None else load_calibration(path)
