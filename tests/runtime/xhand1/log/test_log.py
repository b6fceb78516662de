"""Logs are read back bit for bit, or an error names the fault in the file."""

import json
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from faulty_lines import Faults, FaultyEmulator
from first_order_hands import first_order_hand
from hand_logs import assert_same_reading, random_readings, write_log
from xhand1_hands import Stamps

from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import Reading, XHand1
from tgdsl.runtime.xhand1.log.log import CHUNK, RECORD, STATE, Fault, LogError, LogWriter, events, open_log
from tgdsl.runtime.xhand1.wire import errors
from tgdsl.runtime.xhand1.wire.errors import HandClosedError, HandError, HandTimeoutError
from tgdsl.runtime.xhand1.wire.ports import HandIdentity
from tgdsl.runtime.xhand1.wire.protocol import STATE_SIZE

IDENTITY = HandIdentity("/dev/ttyUSB7", 3, b"\x01\xff", None, b"SN-1\0\0", b"")


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """Return readings of more than two chunks, and their log."""
    readings = random_readings(1e5 + 0.0084 * np.arange(2 * CHUNK + 7))
    return readings, write_log(tmp_path_factory.mktemp("log") / "hand.npz", readings)


def test_readings_round_trip_bit_for_bit(logged):
    readings, path = logged
    log = open_log(path)
    loaded = list(log.readings())
    assert log.num_readings == len(loaded) == len(readings)
    for reading, expected in zip(loaded, readings, strict=True):
        assert_same_reading(reading, expected)
    assert log.seconds == pytest.approx(0.0084 * (len(readings) - 1))
    assert log.faults == ()
    assert (log.identity, log.calibration) == (None, None)


def test_a_log_is_plain_numpy(logged):
    readings, path = logged
    with np.load(path) as archive:
        assert set(archive.files) == {*RECORD.names, "about", "fault_time", "fault_kind", "fault_message", "fault_reading"}
        for name in STATE:
            assert (archive[name] == np.stack([getattr(reading.state, name) for reading in readings])).all()
        assert archive["received_at"].tolist() == [reading.received_at for reading in readings]
    assert (open_log(path).column("total_force") == np.stack([r.state.total_force for r in readings])).all()


def test_a_record_holds_every_byte_of_the_wire():
    """Forces take two bytes here and one on the wire; all other fields have the wire's size."""
    wide = sum(RECORD[name].itemsize // 2 for name in ("total_force", "taxel_force"))
    assert sum(RECORD[name].itemsize for name in STATE) - wide == STATE_SIZE


def test_identity_calibration_and_faults_round_trip(tmp_path):
    rng = np.random.default_rng(1)
    rotation = np.linalg.qr(rng.normal(size=(5, 3, 3)))[0]
    calibration = Calibration(
        "N", rng.uniform(0.1, 1, (5, 3)), rotation, rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), "it's"
    )
    faults = (Fault.of(HandTimeoutError("no reply — 30 ms"), 1.05), Fault.of(errors.HandDisconnectedError("gone"), 1.13))
    path = write_log(
        tmp_path / "a.npz", random_readings(np.array([1.0, 1.2])), faults, identity=IDENTITY, calibration=calibration
    )
    log = open_log(path)
    assert (log.identity, log.faults) == (IDENTITY, faults)
    assert log.fault_reading.tolist() == [1, 1]
    assert log.calibration is not None
    assert (log.calibration.units, log.calibration.hand) == ("N", "it's")
    for name in ("scale", "rotation", "bias", "tare"):
        assert (getattr(log.calibration, name) == getattr(calibration, name)).all()
    assert [type(fault.error()) for fault in log.faults] == [HandTimeoutError, errors.HandDisconnectedError]
    assert str(log.faults[0].error()) == "no reply — 30 ms"


@pytest.mark.parametrize(
    ("kind", "says"), [("NewError", "NewError: x"), ("TgdslError", "TgdslError: x"), ("annotations", "annotations: x")]
)
def test_a_fault_of_an_unknown_class_is_a_hand_error(kind, says):
    error = Fault(0.0, kind, "x").error()
    assert (type(error), str(error)) == (HandError, says)


# writing


def test_a_log_replaces_the_file_when_it_is_closed(tmp_path):
    path, readings = tmp_path / "a.npz", random_readings(np.array([1.0, 1.1]))
    path.write_text("older")
    with LogWriter(path) as log:
        log.add(readings[0])
        assert path.read_text() == "older"
    assert open_log(path).num_readings == 1
    with pytest.raises(LogError, match="this log is closed"):
        log.add(readings[1])
    log.close()
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]


def test_readings_before_an_exception_are_kept(tmp_path):
    def fail(path, readings) -> None:
        with LogWriter(path) as log:
            for reading in readings:
                log.add(reading)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail(tmp_path / "a.npz", random_readings(np.array([1.0])))
    assert open_log(tmp_path / "a.npz").num_readings == 1
    with pytest.raises(ZeroDivisionError):
        fail(tmp_path / "b.npz", [])
    assert not (tmp_path / "b.npz").exists()


def test_an_empty_log_or_a_full_disk_leaves_no_file(tmp_path, monkeypatch):
    with pytest.raises(LogError, match="not one reading came, so nothing was written"), LogWriter(tmp_path / "a.npz") as log:
        log.add(Fault(1.0, "HandTimeoutError", "x"))
    monkeypatch.setattr("os.fsync", lambda file: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left"), LogWriter(tmp_path / "a.npz") as log:
        log.add(random_readings(np.array([1.0]))[0])
    assert not list(tmp_path.iterdir())


def test_a_long_log_takes_little_memory(tmp_path):
    """60 MB of readings; memory holds NumPy's buffer of 16 MB twice, as an array and as bytes."""
    reading = random_readings(np.array([1.0]))[0]
    tracemalloc.start()
    try:
        with LogWriter(tmp_path / "a.npz") as log:
            for i in range(15_000):
                log.add(Reading(i, 0.01 * i, 0.01 * i, reading.state))
        num_readings = sum(1 for _ in open_log(tmp_path / "a.npz").readings())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert num_readings == 15_000
    assert peak < 40e6


# invalid files


def small_log(tmp_path) -> bytes:
    return write_log(
        tmp_path / "small.npz", random_readings(np.array([1.0, 1.1, 1.2])), (Fault(1.15, "HandError", "x"),)
    ).read_bytes()


def test_a_truncated_log_is_refused(tmp_path):
    content = small_log(tmp_path)
    for end in [0, 1, 10, *range(100, len(content), 997), len(content) - 1]:
        (tmp_path / "cut.npz").write_bytes(content[:end])
        with pytest.raises(LogError, match=r"cut\.npz: this log is damaged, cut, or no \.npz file: "):
            open_log(tmp_path / "cut.npz")


def test_a_changed_byte_is_detected_or_harmless(tmp_path):
    content, expected, rng = (
        bytearray(small_log(tmp_path)),
        random_readings(np.array([1.0, 1.1, 1.2])),
        np.random.default_rng(3),
    )
    num_refused = 0
    for index in rng.choice(len(content), 400, replace=False):
        byte = content[index]
        content[index] ^= int(rng.integers(1, 256))
        (tmp_path / "changed.npz").write_bytes(content)
        content[index] = byte
        try:
            readings = list(open_log(tmp_path / "changed.npz").readings())
        except LogError:
            num_refused += 1
            continue
        for reading, expected_reading in zip(readings, expected, strict=True):
            assert_same_reading(reading, expected_reading)
    assert num_refused > 300


def error_of(tmp_path, name: str, change) -> LogError:
    """Return the error for a log with one changed array."""
    small_log(tmp_path)
    with np.load(tmp_path / "small.npz") as archive:
        arrays = dict(archive)
    changed = change(arrays[name])
    arrays.update({name: changed} if changed is not None else {})
    if changed is None:
        del arrays[name]
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(LogError) as caught:
        open_log(tmp_path / "x.npz")
    return caught.value


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("about", lambda a: None, "no log of `tgdsl hand record`: this .npz file has no array `about`"),
        ("about", lambda a: np.array(json.dumps(json.loads(str(a)) | {"format": 2})), "a log of format 2, this version of tgdsl reads format 1"),
        ("about", lambda a: np.array("{"), "damaged, cut, or no .npz file: Expecting property name"),
        ("about", lambda a: np.array("[]"), "damaged, cut, or no .npz file: "),
        ("position", lambda a: None, "There is no item named 'position.npy'"),
        ("fault_kind", lambda a: a[:0], "damaged"),
    ],
)  # fmt: skip
def test_invalid_arrays_are_refused(tmp_path, name, change, says):
    assert says in str(error_of(tmp_path, name, change))


def test_files_that_are_not_logs_are_refused(tmp_path):
    with pytest.raises(LogError, match=r"none\.npz: cannot read this log: No such file or directory"):
        open_log(tmp_path / "none.npz")
    with pytest.raises(LogError, match="cannot read this log: Is a directory"):
        open_log(tmp_path)
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(LogError, match=r"damaged, cut, or no \.npz file: File is not a zip file"):
        open_log(tmp_path / "text.npz")


def test_a_recording_goes_on_after_failures(tmp_path):
    stamps = Stamps()
    with (
        FaultyEmulator(first_order_hand(forces=stamps)) as emulator,
        XHand1.open(emulator.device) as hand,
        LogWriter(tmp_path / "a.npz") as log,
    ):
        num_more = 0
        for event in events(hand, 60.0):
            log.add(event)
            if log.num_readings == 30 and not log.num_faults:
                emulator.set_faults(Faults(silence=1.0))
            if isinstance(event, Fault):
                emulator.set_faults(Faults())
            num_more += bool(log.num_faults) and isinstance(event, Reading)
            if num_more == 20:
                break
    log = open_log(tmp_path / "a.npz")
    times = [stamps.check(reading) for reading in log.readings()]
    assert len(times) > 20  # a busy machine may have lost one before the thirtieth
    assert all(earlier < later for earlier, later in pairwise(times))
    assert log.faults
    assert all(isinstance(fault.error(), HandTimeoutError) for fault in log.faults)
    assert log.received_at[0] < log.faults[0].time < log.received_at[-1]


def test_a_closed_hand_ends_a_recording():
    with FaultyEmulator() as emulator:
        hand = XHand1.open(emulator.device)
        stream = events(hand, 60.0)
        next(stream)
        hand.close()
        with pytest.raises(HandClosedError):
            for _ in stream:
                pass
