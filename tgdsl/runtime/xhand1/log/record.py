"""Recording a hand: its readings and failures as they come, and the file that they go to.

An hour at the highest rate that the wire allows, 119 readings a second, is 430,000 records of 4 kB: too much to keep. They are
appended to a spool beside the file, and put into the file when all is over; a few MB are in memory at a time.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from tgdsl.files.write import as_file_error, atomic_open
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.identity import HandIdentity
from tgdsl.runtime.xhand1.log.log import CHUNK, FORMAT, RECORD, STATE, Fault, LogError
from tgdsl.runtime.xhand1.reader import Reading
from tgdsl.runtime.xhand1.wire.errors import HandClosedError, HandError

_COMPRESSION = 1


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

    What was added is written also if the block that adds it fails.

    Attributes:
        num_readings: How many readings were added.
        num_faults: How many failures were added.
    """

    def __init__(self, path: str | Path, *, identity: HandIdentity | None = None, calibration: Calibration | None = None):
        """Make the spool.

        Args:
            path: The file; one that is there is replaced.
            identity: The hand.
            calibration: What its counts mean.

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
        self._faults: list[Fault] = []
        self._fault_readings: list[int] = []
        self.num_readings = 0
        self._spool: IO[bytes] | None = tempfile.TemporaryFile(dir=self._path.parent)  # noqa: SIM115  closed by `close`

    @property
    def num_faults(self) -> int:
        """How many failures were added."""
        return len(self._faults)

    def add(self, event: Reading | Fault) -> None:
        """Add a reading or a failure.

        Raises:
            LogError: If the log is closed.
            FileError: If it cannot be kept.
        """
        if self._spool is None:
            raise LogError(f"{self._path}: this log is closed")
        if isinstance(event, Fault):
            self._fault_readings.append(self.num_readings)
            self._faults.append(event)
            return
        with as_file_error(self._path):
            self._spool.write(_record(event).tobytes())
        self.num_readings += 1

    def close(self) -> None:
        """Write the file.

        Raises:
            LogError: If there is not one reading to write.
            FileError: If it cannot be written.
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
        texts = {"fault_kind": [f.kind for f in self._faults], "fault_message": [f.message for f in self._faults]}
        arrays = {
            "about": np.array(json.dumps(self._about, sort_keys=True)),
            "fault_reading": np.array(self._fault_readings[: len(self._faults)], dtype="<i8"),
            "fault_time": np.array([fault.time for fault in self._faults], dtype=np.float64),
            **{name: np.array(values, dtype=np.str_) for name, values in texts.items()},
        }
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=_COMPRESSION) as archive:
            for name, values in arrays.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, values, version=(1, 0), allow_pickle=False)
            for name in RECORD.names or ():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    self._write_column(member, spool, name)

    def _write_column(self, member: Any, spool: IO[bytes], name: str) -> None:
        dtype = RECORD[name]
        header = {"descr": dtype.base.str, "fortran_order": False, "shape": (self.num_readings, *dtype.shape)}
        np.lib.format.write_array_header_1_0(member, header)
        spool.seek(0)
        for first in range(0, self.num_readings, CHUNK):
            data = spool.read(min(CHUNK, self.num_readings - first) * RECORD.itemsize)
            member.write(np.ascontiguousarray(np.frombuffer(data, RECORD)[name]).tobytes())


def _record(reading: Reading) -> np.ndarray:
    record = np.zeros((), RECORD)
    record["sequence"], record["requested_at"] = reading.sequence, reading.requested_at
    record["received_at"] = reading.received_at
    for name in STATE:
        record[name] = getattr(reading.state, name)
    return record
