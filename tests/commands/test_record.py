"""`tgdsl hand record` and `replay` with an emulated hand, and Ctrl-C."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from faulty_lines import Faults
from hand_logs import random_readings, write_log
from resting_hands import TARE

from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.log import log as log_file
from tgdsl.runtime.xhand1.log.log import open_log
from tgdsl.runtime.xhand1.wire.protocol import Command


def test_record_and_replay(emulator, plugged, here, tmp_path):
    plugged(emulator.device)
    assert here(tmp_path, "hand", "tare", "-o", "hand.yaml")[0] == 0
    code, output, error = here(tmp_path, "hand", "record", "logs/a.npz", "--seconds", "0.5", "--calibration", "hand.yaml")
    assert code == 0, error
    log = open_log(tmp_path / "logs" / "a.npz")
    size = log.path.stat().st_size
    assert output.splitlines()[-1] == f"logs/a.npz: {log.num_readings} readings, {len(log.faults)} failures, {size} bytes"
    assert log.num_readings >= 1
    assert log.identity is not None and log.identity.serial_number == b"X1-0042" + bytes(25)
    assert log.calibration is not None and (log.calibration.tare == TARE).all()
    code, output, error = here(tmp_path, "hand", "replay", "logs/a.npz", "--speed", "inf")
    assert (code, error) == (0, "")
    lines = output.splitlines()
    assert lines[0].startswith(f"{emulator.device}: hand 0, version") and lines[0].endswith("(logs/a.npz)")
    assert lines[4].split()[:5] == ["thumb", "0.00", "0.00", "0.00", "0.00"]
    assert lines[-1] == f"{log.num_readings} readings, {len(log.faults)} failures in {log.seconds:.2f} s"
    code, _, error = here(tmp_path, "hand", "record", "logs/a.npz", "--seconds", "0.1")
    assert (code, "there already" in error) == (2, True)
    code, _, error = here(tmp_path, "hand", "record", "b.npz", "--seconds", "0")
    assert (code, error) == (2, "tgdsl: --seconds 0: expected more than 0\n")
    assert not (tmp_path / "b.npz").exists()


@pytest.mark.parametrize("number", [1, 3])
def test_replay_ends_with_the_last_reading(here, tmp_path, number):
    """Also if it is the first one; it is as old as its transfer took."""
    *_, last = readings = random_readings(0.01 * np.arange(number))
    write_log(tmp_path / "a.npz", readings)
    code, output, error = here(tmp_path, "hand", "replay", "a.npz", "--speed", "inf")
    assert (code, error) == (0, "")
    assert output.splitlines()[1].startswith(f"reading {last.sequence}   age 8 ms ")


def test_replay_of_another_file_is_refused(here, tmp_path):
    (tmp_path / "a.npz").write_text("text")
    code, _, error = here(tmp_path, "hand", "replay", "a.npz")
    assert (code, error) == (2, "tgdsl: a.npz: this log is damaged, cut, or no .npz file: File is not a zip file\n")


def test_a_recording_through_failures_shows_and_keeps_them(emulator, here, tmp_path, monkeypatch):
    """The line is cut after ten readings; the recording ends with the failures that follow."""
    plain = log_file.events

    def cut(hand, seconds):
        num_faults = 0
        for i, event in enumerate(plain(hand, seconds)):
            if i == 10:
                emulator.set_faults(Faults(silence=1.0))
            yield event
            num_faults += hasattr(event, "kind")
            if num_faults == 3:
                return

    monkeypatch.setattr(log_file, "events", cut)
    code, output, error = here(tmp_path, "hand", "record", "a.npz", "--port", emulator.device, "--hand-id", "0")
    assert code == 0, error
    assert "NO NEW READING: " in output
    log = open_log(tmp_path / "a.npz")
    assert len(log.faults) == 3
    code, output, _ = here(tmp_path, "hand", "replay", "a.npz", "--speed", "1000")
    assert code == 0
    assert f"NO NEW READING: {log.faults[-1].kind}: {log.faults[-1].message}" in output


@pytest.fixture
def interrupt():
    """Return a function that presses Ctrl-C once a condition holds, even if the process was started to ignore it."""
    old_handler = signal.signal(signal.SIGINT, signal.default_int_handler)

    def press(is_time):
        while not is_time():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    yield lambda is_time: threading.Thread(target=press, args=(is_time,), daemon=True).start()
    signal.signal(signal.SIGINT, old_handler)


@pytest.mark.parametrize("words", [("monitor",), ("record", "a.npz")])
def test_ctrl_c_closes_the_port_and_keeps_the_log(emulator, here, interrupt, tmp_path, words):
    arguments = ("--seconds", "60", "--port", emulator.device, "--hand-id", "0")
    interrupt(lambda: sum(frame.command == Command.EXCHANGE for _, frame in list(emulator.requests)) >= 100)
    code, output, error = here(tmp_path, "hand", *words, *arguments)
    assert (code, error) == (0, "")
    assert output.splitlines()[0].startswith(f"{emulator.device}: hand 0")
    if words[0] == "record":
        log = open_log(tmp_path / "a.npz")
        assert log.num_readings >= 1 and log.seconds < 50
        assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]
    with XHand1.open(emulator.device) as hand:  # the port is free again
        hand.read(20.0)
