"""Logs of the real hand in one `.npz` file: every reading bit for bit, every failure, the hand's identity and calibration.

Arrays of the file, readable with `numpy.load`:

- `sequence`, `requested_at`, `received_at` (reading,): number of the exchange, and its times [s] on the clock of
  `time.monotonic` of the computer that recorded;
- one array (reading, …) for each attribute of `HandState`, by its name, value for value;
- `fault_time`, `fault_kind`, `fault_message`, `fault_reading` (fault,): time of each failure, its error class and message, and
  the number of earlier readings;
- `about`: text (JSON) with the format's version, the hand's identity, its calibration's text and the time of day at the start.

An hour at the wire's highest rate, 119 readings a second, is 430,000 records of 4 kB: too much for memory. Records go to a
spool file in the same folder and are copied into the log at the end; a few MB are in memory at a time.

Shapes: `reading` the readings, `fault` the failures; others as in `protocol`.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import tempfile
import time
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import TgdslError
from tgdsl.files.write import as_file_error, atomic_open
from tgdsl.runtime.xhand1.calibration import Calibration, parse_calibration
from tgdsl.runtime.xhand1.driver import Reading, XHand1
from tgdsl.runtime.xhand1.wire import errors
from tgdsl.runtime.xhand1.wire.errors import HandClosedError, HandError
from tgdsl.runtime.xhand1.wire.ports import HandIdentity
from tgdsl.runtime.xhand1.wire.protocol import STATE_SIZE, HandState, decode_state

FORMAT = 1
TIMES = {"sequence": "<i8", "requested_at": "<f8", "received_at": "<f8"}
STATE = tuple(field.name for field in fields(HandState))
_ZERO = decode_state(bytes(STATE_SIZE))
RECORD = np.dtype([*TIMES.items(), *((name, getattr(_ZERO, name).dtype, getattr(_ZERO, name).shape) for name in STATE)])
"""One reading: the arrays of a log, row by row."""
CHUNK = 256  # readings that are in memory at a time: 1 MB of them
_DAMAGE = (OSError, EOFError, ValueError, KeyError, TypeError, RuntimeError, zlib.error, zipfile.BadZipFile, struct.error)
"""Errors that a damaged archive raises."""


class LogError(TgdslError):
    """A log that cannot be read or written: damaged, cut, of another format, or holding nothing."""


class Fault(NamedTuple):
    """A failure: when no reading came, and why."""

    time: float  # when it was noticed, on the clock of the readings [s]
    kind: str  # name of the error's class
    message: str  # what it said

    @classmethod
    def of(cls, error: HandError, time: float) -> Fault:
        """Return the failure that is an error at a time [s]."""
        return cls(time, type(error).__name__, str(error))

    def error(self) -> HandError:
        """Return the error as it was; of a class that is not known here, as its base."""
        kind = getattr(errors, self.kind, None)
        if isinstance(kind, type) and issubclass(kind, HandError):
            return kind(self.message)
        return HandError(f"{self.kind}: {self.message}")


@dataclass(frozen=True, eq=False)
class HandLog:
    """A log that was checked from end to end. Times and failures are in memory; readings are read from the file on demand."""

    path: Path
    identity: HandIdentity | None  # None if it was not asked
    calibration: Calibration | None  # what its counts meant when it was recorded; None if nothing was known
    started_at: float  # time of day at the start [s since 1970], for people
    sequence: Int[np.ndarray, " reading"]  # number of the exchange of each reading
    requested_at: Float[np.ndarray, " reading"]  # when each was asked for [s]
    received_at: Float[np.ndarray, " reading"]  # when each was here [s]
    faults: tuple[Fault, ...] = field(repr=False)  # in order
    fault_reading: Int[np.ndarray, " fault"]  # how many readings had come before each

    @property
    def num_readings(self) -> int:
        return len(self.sequence)

    @property
    def seconds(self) -> float:
        """Time from the first reading to the last reading or failure [s]."""
        return max([float(self.received_at[-1]), *(fault.time for fault in self.faults)]) - float(self.received_at[0])

    def column(self, name: str) -> np.ndarray:
        """Return one array of the file, all readings at once: `total_force` (reading, finger, 3) and so on."""
        with zipfile.ZipFile(self.path) as archive:
            return _array(archive, name)

    def readings(self) -> Iterator[Reading]:
        """Yield the readings in order, as they were; `CHUNK` of them are in memory at a time."""
        with ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(self.path))
            members = {name: stack.enter_context(archive.open(f"{name}.npy")) for name in STATE}
            for member in members.values():
                np.lib.format.read_magic(member)
                np.lib.format.read_array_header_1_0(member)
            for first in range(0, self.num_readings, CHUNK):
                last = min(first + CHUNK, self.num_readings)
                chunk = {
                    name: np.frombuffer(member.read((last - first) * RECORD[name].itemsize), RECORD[name].base).reshape(
                        last - first, *RECORD[name].shape
                    )
                    for name, member in members.items()
                }
                for i in range(first, last):
                    state = HandState(**{name: rows[i - first] for name, rows in chunk.items()})
                    yield Reading(int(self.sequence[i]), float(self.requested_at[i]), float(self.received_at[i]), state)


def is_hand_log(path: Path) -> bool:
    """Return whether a file is an archive with a log's description, damaged or not."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "about.npy" in archive.namelist()


def open_log(path: str | Path) -> HandLog:
    """Read a log's times and failures, and check every byte of it.

    Raises:
        LogError: If it cannot be read, is no log, is damaged or cut, or of another format.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            if "about.npy" not in archive.namelist():
                raise LogError(f"{path}: no log of `tgdsl hand record`: this .npz file has no array `about`")
            if (damaged := archive.testzip()) is not None:
                raise LogError(f"{path}: this log is damaged: its array {damaged.removesuffix('.npy')} has a wrong checksum")
            about = json.loads(str(_array(archive, "about")))
            if about["format"] != FORMAT:
                raise LogError(f"{path}: a log of format {about['format']}, this version of tgdsl reads format {FORMAT}")
            for name in STATE:
                archive.getinfo(f"{name}.npy")
            parts = [_array(archive, f"fault_{name}") for name in ("time", "kind", "message")]
            return HandLog(
                path,
                None if about["hand"] is None else HandIdentity.from_json(about["hand"]),
                None if about["calibration"] is None else parse_calibration(about["calibration"]),
                float(about["started_at"]),
                *(_array(archive, name) for name in TIMES),
                faults=tuple(Fault(float(t), str(kind), str(text)) for t, kind, text in zip(*parts, strict=True)),
                fault_reading=_array(archive, "fault_reading"),
            )
    except _DAMAGE as error:
        if isinstance(error, FileNotFoundError | IsADirectoryError | PermissionError):
            raise LogError(f"{path}: cannot read this log: {error.strerror}") from error
        raise LogError(f"{path}: this log is damaged, cut, or no .npz file: {error}") from error


def _array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(f"{name}.npy") as member:
        return np.lib.format.read_array(member, allow_pickle=False)


def events(hand: XHand1, seconds: float) -> Iterator[Reading | Fault]:
    """Yield every reading of a hand, and every failure, as they come, for some seconds, which may be infinite.

    Raises:
        HandClosedError: If the hand was closed.
    """
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            yield hand.read()
        except HandClosedError:
            raise
        except HandError as error:
            yield Fault.of(error, time.monotonic())


class LogWriter:
    """Writes a log. Use it as a context manager, or call `close`; the file appears whole, at the end, or not at all.

    If the block fails, the records added so far are written.
    """

    def __init__(self, path: str | Path, *, identity: HandIdentity | None = None, calibration: Calibration | None = None):
        """Make the spool; a file that is there is replaced at the end.

        Raises:
            OSError: If the folder cannot be written to.
        """
        self._path = Path(path)
        self._about = {
            "format": FORMAT,
            "hand": None if identity is None else identity.as_json(),
            "calibration": None if calibration is None else calibration.text(),
            "started_at": time.time(),
        }
        self._faults: list[tuple[Fault, int]] = []  # and how many readings had come before
        self.num_readings = 0
        self._spool: IO[bytes] | None = tempfile.TemporaryFile(dir=self._path.parent)  # noqa: SIM115  closed by `close`

    @property
    def num_faults(self) -> int:
        """How many failures were added."""
        return len(self._faults)

    def add(self, event: Reading | Fault) -> None:
        """Add a reading or a failure."""
        if self._spool is None:
            raise LogError(f"{self._path}: this log is closed")
        if isinstance(event, Fault):
            self._faults.append((event, self.num_readings))
            return
        record = np.zeros((), RECORD)
        for name in RECORD.names or ():
            record[name] = getattr(event if name in TIMES else event.state, name)
        with as_file_error(self._path):
            self._spool.write(record.tobytes())
        self.num_readings += 1

    def close(self) -> None:
        """Write the file.

        Raises:
            LogError: If there is not one reading to write.
        """
        spool, self._spool = self._spool, None
        if spool is None:
            return
        with spool:
            self.num_readings = spool.seek(0, os.SEEK_END) // RECORD.itemsize  # Ctrl-C may have struck within `add`
            if not self.num_readings:
                raise LogError(f"{self._path}: not one reading came, so nothing was written")
            with atomic_open(self._path) as file:
                self._write(file, spool)
                file.flush()
                os.fsync(file.fileno())

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        # That there was nothing to write is not worth hiding why.
        with contextlib.suppress(LogError) if error is not None else contextlib.nullcontext():
            self.close()

    def _write(self, file: IO[bytes], spool: IO[bytes]) -> None:
        faults = [fault for fault, _ in self._faults]
        spool.flush()
        records = np.memmap(spool, RECORD, mode="r", shape=(self.num_readings,))  # type: ignore[arg-type]
        np.savez_compressed(
            file,
            about=np.array(json.dumps(self._about, sort_keys=True)),
            fault_reading=np.array([num for _, num in self._faults], dtype="<i8"),
            fault_time=np.array([fault.time for fault in faults], dtype=np.float64),
            fault_kind=np.array([fault.kind for fault in faults], dtype=np.str_),
            fault_message=np.array([fault.message for fault in faults], dtype=np.str_),
            **{name: records[name] for name in RECORD.names or ()},  # type: ignore[arg-type]
        )
