"""`tgdsl hand`: all commands on a real hand. None can move a joint.

They send version and register requests, which hold no set-point, and the exchange that requests mode 0 without gain or current:
its reply is the only known reading of touch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands import arguments as args
from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_write, with_folder

if TYPE_CHECKING:
    from tgdsl.runtime.xhand1 import driver
    from tgdsl.view.hand_table import HandView

Port = Annotated[
    str | None,
    args.optional("PORT"),
    tyro.conf.arg(
        help="The hand's serial port, or `emulator`, an emulated hand at rest; default: the port of the only hand found."
    ),
]
HandId = Annotated[
    args.OptionalInt, tyro.conf.arg(help="The hand's id, if several hands share the port; default: the only one.")
]
Duration = Annotated[float, tyro.conf.arg(help="Duration [s]; default: until Ctrl-C.", help_behavior_hint="")]
TRIES = 5  # of a tare whose replies are lost or damaged on the way


@contextmanager
def _until_ctrl_c(view: HandView) -> Iterator[None]:
    """End the block at Ctrl-C as if it had finished; then draw the view's last state."""
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        view.end()


@dataclass(frozen=True)
class Probe:
    """List serial ports and the hands on them: versions, names and serial numbers."""

    port: Annotated[str | None, args.optional("PORT")] = None
    """The port to ask; default: all. Every device on a port receives a few bytes, so name the port if that could do harm."""
    hand_id: args.OptionalInt = None
    """The id to ask for; default: 0 to 7."""

    def run(self) -> None:
        from tgdsl.runtime.xhand1.wire.ports import ask_ports, identify

        ports = ask_ports(self.port, self.hand_id)
        if not ports:
            print("this computer has no serial port")
        for port in ports:
            print(port)
            for hand in port.hands:
                print(f"  {identify(hand)}")


@dataclass(frozen=True)
class Monitor:
    """Show the forces at the fingertips, live."""

    port: Port = None
    hand_id: HandId = None
    calibration: args.OptionalFile = None
    """The hand's calibration file; default: forces stay in counts."""
    seconds: Duration = math.inf

    def run(self) -> None:
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.log.log import events
        from tgdsl.runtime.xhand1.wire.ports import the_hand
        from tgdsl.view.hand_table import HandView

        calibration, hand_port = args.calibration_of(self.calibration), the_hand(self.port, self.hand_id)
        view = HandView(calibration, f"{hand_port.device}: hand {hand_port.addresses.hand_id}")
        with XHand1.open(hand_port.device, hand_port.addresses) as hand, _until_ctrl_c(view):
            for event in events(hand, self.seconds):
                view.show(event)


@dataclass(frozen=True)
class Tare:
    """Measure the counts of untouched fingertips, and write them to a calibration file."""

    out: args.Out = Path("hand.calibration.yaml")
    """The calibration file to write."""
    port: Port = None
    hand_id: HandId = None
    calibration: args.OptionalFile = None
    """A calibration file whose tare is replaced; default: a new calibration, whose forces stay in counts."""
    frames: int = 20
    """Number of readings to average, at least 5."""
    max_spread: float = 4.0
    """Largest spread of a component's readings; above it the fingertip counts as touched [counts]."""
    force: args.Replace = False

    def run(self) -> None:
        from tgdsl.runtime.xhand1.calibration import Calibration
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.wire.ports import the_hand
        from tgdsl.runtime.xhand1.wire.protocol import FINGERS

        args.refuse_to_replace(self.out, self.force)
        base, hand_port = args.calibration_of(self.calibration) or Calibration.none(), the_hand(self.port, self.hand_id)
        with XHand1.open(hand_port.device, hand_port.addresses) as hand:
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
    """Tare a hand, again if a reply is lost or damaged on the way."""
    from tgdsl.runtime.xhand1.wire.errors import HandTimeoutError

    for _ in range(TRIES - 1):
        try:
            return hand.tare(num_frames)
        except HandTimeoutError:
            continue
    return hand.tare(num_frames)


@dataclass(frozen=True)
class Record:
    """Record a log of a hand, for `tgdsl hand replay`, `tgdsl calibrate hand` and `ReplaySource`."""

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT.npz")]
    """The log to write."""
    seconds: Duration = math.inf
    port: Port = None
    hand_id: HandId = None
    calibration: args.OptionalFile = None
    """The hand's calibration file, which the log includes; default: none, forces stay in counts."""
    force: args.Replace = False

    def run(self) -> None:
        from tgdsl.runtime.xhand1.driver import XHand1
        from tgdsl.runtime.xhand1.log.log import LogWriter, events
        from tgdsl.runtime.xhand1.wire.ports import identify, the_hand
        from tgdsl.view.hand_table import HandView

        args.refuse_to_replace(self.out, self.force)
        if not self.seconds > 0:
            raise TgdslError(f"--seconds {self.seconds:g}: expected more than 0")
        calibration, hand_port = args.calibration_of(self.calibration), the_hand(self.port, self.hand_id)
        identity = identify(hand_port)
        view = HandView(calibration, str(identity))
        with (
            LogWriter(with_folder(self.out), identity=identity, calibration=calibration) as log,
            XHand1.open(hand_port.device, hand_port.addresses) as hand,
            _until_ctrl_c(view),
        ):
            for event in events(hand, self.seconds):
                log.add(event)
                view.show(event)
        print(f"{self.out}: {log.num_readings} readings, {log.num_faults} failures, {self.out.stat().st_size} bytes")


@dataclass(frozen=True)
class Replay:
    """Show a log as `tgdsl hand monitor` shows a hand."""

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG.npz")]
    """The log."""
    speed: float = 1.0
    """Speed relative to real time; inf is as fast as possible."""
    calibration: args.OptionalFile = None
    """The hand's calibration file; default: the log's."""

    def run(self) -> None:
        from tgdsl.runtime.xhand1.log.log import Fault
        from tgdsl.runtime.xhand1.log.replay import ReplaySource
        from tgdsl.runtime.xhand1.wire.errors import HandError
        from tgdsl.view.hand_table import HandView

        source = ReplaySource(self.log, speed=self.speed, calibration=args.calibration_of(self.calibration))
        log = source.log
        view = HandView(source.calibration, f"{log.identity or 'an unnamed hand'}   ({self.log})")
        with source, _until_ctrl_c(view):
            view.show(source.sample().reading, now=source.now)
            while not source.is_over:
                try:
                    source.step()
                    view.show(source.sample().reading, now=source.now)
                except HandError as error:
                    view.show(Fault.of(error, source.now), now=source.now)
        print(f"{log.num_readings} readings, {len(log.faults)} failures in {log.seconds:.2f} s")


@dataclass(frozen=True)
class Hand:
    """Read a real XHand1. These commands never move a joint."""

    action: Annotated[args.subcommands(Probe, Monitor, Tare, Record, Replay), tyro.conf.arg(name="")]  # type: ignore[valid-type]
    """What to do."""

    def run(self) -> None:
        """Do it; Ctrl-C ends it with the hand's port closed."""
        if isinstance(self.action, Replay) or self.action.port != "emulator":
            self.action.run()
            return
        from tgdsl.runtime.xhand1.emulator.emulator import Emulator

        with Emulator() as emulator:
            replace(self.action, port=emulator.device).run()
