"""`tgdsl hand` and `tgdsl calibrate hand`, as users run them, against emulated hands."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hand_logs import random_readings

from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import Emulator
from tgdsl.runtime.xhand1.emulator.faulty_line import Faults
from tgdsl.runtime.xhand1.emulator.hand import EmulatedHand, TipForces
from tgdsl.runtime.xhand1.log import record
from tgdsl.runtime.xhand1.log.log import open_log
from tgdsl.runtime.xhand1.wire import ports
from tgdsl.runtime.xhand1.wire.payloads import PASSIVE, encode_command
from tgdsl.runtime.xhand1.wire.protocol import Command, Register
from tgdsl.runtime.xhand1.wire.serial_port import PortInfo

REPOSITORY = Path(__file__).parents[2]
TARE = np.array([[5.0, -3.0, 8.0], [1.0, 2.0, 3.0], [-4.0, 0.0, 12.0], [0.0, 0.0, 0.0], [9.0, 9.0, 9.0]])
ALLOWED = {Command.VERSION, Command.READ_REGISTER, Command.EXCHANGE}


def resting(time_s, position):
    return TipForces(TARE, np.zeros((5, 120, 3)))


@pytest.fixture
def emulator():
    """A hand at rest; at the end, no request may have held a set-point that moves a joint."""
    registers = {Register.SERIAL_NUMBER: b"X1-0042" + bytes(25), Register.NAME: b"\xff\x00", Register.SIDE: b"\x01"}
    with Emulator(EmulatedHand(forces=resting, registers=registers)) as emulator:
        yield emulator
        assert {frame.command for _, frame in emulator.requests} <= ALLOWED
        assert {frame.payload for _, frame in emulator.requests if frame.command == Command.EXCHANGE} <= {
            encode_command(PASSIVE)
        }
        assert emulator.hand.is_passive
        assert not emulator.hand.position.any()


@pytest.fixture
def plugged(monkeypatch):
    """Say which serial ports this computer has."""

    def plug(*devices: str) -> None:
        found = tuple(PortInfo(device, "an adapter" if i == 0 else "", "") for i, device in enumerate(devices))
        monkeypatch.setattr(ports, "list_ports", lambda: found)

    return plug


def pseudo_terminal() -> tuple[int, int, str]:
    """Return a serial port on which nobody answers."""
    ends = os.openpty()
    return *ends, os.ttyname(ends[1])


# probe


def test_probe(emulator, plugged, here, tmp_path):
    one, other, silent = pseudo_terminal()
    try:
        plugged(emulator.device, silent, "/dev/none")
        code, said, error = here(tmp_path, "hand", "probe")
    finally:
        os.close(one)
        os.close(other)
    assert (code, error) == (0, "")
    lines = said.splitlines()
    assert lines[0] == f"{emulator.device} (an adapter)"
    identity = 'version "tgdsl emulator", side 01, serial number "X1-0042", name ff 00'
    assert lines[1] == f"  {emulator.device}: hand 0, {identity}"
    assert lines[2] == f"{silent}: no hand answers"
    assert lines[3].startswith("/dev/none: /dev/none cannot be opened at 3000000 baud: ")
    assert len(lines) == 4
    assert {frame.command for _, frame in emulator.requests} == {Command.VERSION, Command.READ_REGISTER}


def test_probe_of_one_port(emulator, plugged, here, tmp_path):
    plugged("/dev/none")
    code, said, _ = here(tmp_path, "hand", "probe", "--port", emulator.device)
    assert (code, len(said.splitlines())) == (0, 2)
    code, _, error = here(tmp_path, "hand", "probe", "--port", "/dev/none")
    assert code == 2
    assert error.startswith("tgdsl: /dev/none cannot be opened")


def test_a_computer_without_ports(plugged, here, tmp_path):
    plugged()
    assert here(tmp_path, "hand", "probe") == (0, "this computer has no serial port\n", "")
    assert here(tmp_path, "hand", "monitor") == (2, "", "tgdsl: no hand answers; this computer has no serial port\n")


def test_no_hand_or_several_are_an_error_that_lists_them(emulator, plugged, here, tmp_path):
    with Emulator(EmulatedHand(3)) as second:
        plugged(emulator.device, second.device)
        code, _, error = here(tmp_path, "hand", "monitor", "--seconds", "0.1")
        assert code == 2
        found = f"{emulator.device} (id 0), {second.device} (id 3)"
        assert error == f"tgdsl: 2 hands answer: {found}; choose one with --port or --hand-id\n"
        code, said, error = here(tmp_path, "hand", "monitor", "--seconds", "0.1", "--hand-id", "3")
        assert code == 0, error
        assert said.startswith(f"{second.device}: hand 3\n")
        code, _, error = here(tmp_path, "hand", "monitor", "--hand-id", "5")
        assert (
            error
            == f"tgdsl: no hand with id 5 answers; {emulator.device} (an adapter): no hand answers; {second.device}: no hand answers\n"
        )
    emulator.set_faults(Faults(silence=1.0))
    plugged(emulator.device)
    code, _, error = here(tmp_path, "hand", "monitor")
    assert error == f"tgdsl: no hand answers; {emulator.device} (an adapter): no hand answers\n"
    code, _, error = here(tmp_path, "hand", "monitor", "--port", emulator.device)
    assert error == f"tgdsl: no hand answers on {emulator.device}; is it switched on, and is this its port?\n"


# monitor


def test_monitor_shows_the_last_state_on_a_pipe(emulator, plugged, here, tmp_path):
    plugged(emulator.device)
    code, said, error = here(tmp_path, "hand", "monitor", "--seconds", "0.3", "--hand-id", "0")
    assert (code, error) == (0, "")
    lines = said.splitlines()
    assert lines[0] == f"{emulator.device}: hand 0"
    assert lines[1].split()[:3:2] == ["reading", "age"]
    assert lines[3].split() == ["fingertip", "x", "y", "z", "|force|", "counts", "°C"]
    assert lines[4].split()[:6] == ["thumb", "5.00", "-3.00", "8.00", "9.90", "25"]
    assert lines[8].split()[:4] == ["pinky", "9.00", "9.00", "9.00"]
    assert lines[11].split() == ["thumb_bend", "0.000", "0", "25", "–"]
    assert len(lines) == 23


def test_monitor_in_newton_and_what_cannot_be(emulator, plugged, here, tmp_path):
    newton = Calibration("N", np.full((5, 3), 0.1), np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3)), TARE)
    (tmp_path / "hand.yaml").write_text(newton.text())
    arguments = ("hand", "monitor", "--port", emulator.device, "--hand-id", "0", "--seconds", "0.2", "--calibration")
    code, said, _ = here(tmp_path, *arguments, "hand.yaml")
    assert code == 0
    assert said.splitlines()[3].split()[-2:] == ["N", "°C"]
    assert said.splitlines()[4].split()[:5] == ["thumb", "0.00", "0.00", "0.00", "0.00"]
    code, _, error = here(tmp_path, *arguments, "none.yaml")
    assert (code, error) == (2, "none.yaml: cannot read this file: No such file or directory\n1 mistake\n")
    assert sum(frame.command == Command.EXCHANGE for _, frame in emulator.requests) < 200


# tare


def test_tare(emulator, plugged, here, tmp_path):
    plugged(emulator.device)
    code, said, error = here(tmp_path, "hand", "tare", "-o", "new/hand.yaml")
    assert code == 0, error
    assert said.splitlines()[0] == "thumb   tare    5.00   -3.00    8.00   spread 0 counts"
    assert said.endswith("calibration: new/hand.yaml\n")
    calibration = load_calibration(tmp_path / "new" / "hand.yaml")
    assert (calibration.tare == TARE).all()
    assert calibration.units == "counts"
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["hand.yaml"]


def test_tare_replaces_nothing_unasked_and_keeps_the_rest(emulator, here, tmp_path):
    base = Calibration("N", np.full((5, 3), 0.2), np.tile(-np.eye(3), (5, 1, 1)), np.ones((5, 3)), np.zeros((5, 3)), "mine")
    (tmp_path / "hand.yaml").write_text(base.text())
    arguments = ("hand", "tare", "--port", emulator.device, "-o", "hand.yaml", "--calibration", "hand.yaml", "--frames", "5")
    code, _, error = here(tmp_path, *arguments)
    what = "hand.yaml: this file is there already; give --force to replace it, or another name"
    assert (code, error) == (2, f"tgdsl: {what}\n")
    assert not emulator.requests
    assert (tmp_path / "hand.yaml").read_text() == base.text()
    assert here(tmp_path, *arguments, "--force")[0] == 0
    found = load_calibration(tmp_path / "hand.yaml")
    assert (found.units, found.hand) == ("N", "mine")
    assert (found.tare == TARE).all()
    assert (found.rotation == base.rotation).all() and (found.bias == base.bias).all()


def test_tare_of_a_hand_that_is_touched(here, tmp_path):
    calls = iter(range(10**6))

    def moving(time_s, position):
        force = TARE.copy()
        force[1, 2] += 12 * (next(calls) % 2)
        return TipForces(force, np.zeros((5, 120, 3)))

    with Emulator(EmulatedHand(forces=moving)) as emulator:
        tare = ("hand", "tare", "--port", emulator.device, "--hand-id", "0")
        code, _, error = here(tmp_path, *tare)
        assert code == 2
        assert error.startswith(
            "tgdsl: the fingertips were not still over 20 readings: index z by 12 counts, expected at most 4;"
        )
        assert not list(tmp_path.iterdir())
        assert here(tmp_path, *tare, "--max-spread", "12")[0] == 0
        code, _, error = here(tmp_path, *tare, "--frames", "4", "--force")
        assert error == "tgdsl: a tare over 4 frames, expected at least 5\n"


# record and replay


def test_record_and_replay(emulator, plugged, here, tmp_path):
    plugged(emulator.device)
    assert here(tmp_path, "hand", "tare", "-o", "hand.yaml")[0] == 0
    code, said, error = here(tmp_path, "hand", "record", "logs/a.npz", "--seconds", "0.5", "--calibration", "hand.yaml")
    assert code == 0, error
    log = open_log(tmp_path / "logs" / "a.npz")
    size = log.path.stat().st_size
    assert said.splitlines()[-1] == f"logs/a.npz: {log.num_readings} readings, {len(log.faults)} failures, {size} bytes"
    assert log.num_readings >= 1
    assert log.identity is not None and log.identity.serial_number == b"X1-0042" + bytes(25)
    assert log.calibration is not None and (log.calibration.tare == TARE).all()
    code, said, error = here(tmp_path, "hand", "replay", "logs/a.npz", "--speed", "inf")
    assert (code, error) == (0, "")
    lines = said.splitlines()
    assert lines[0].startswith(f"{emulator.device}: hand 0, version") and lines[0].endswith("(logs/a.npz)")
    assert lines[4].split()[:5] == ["thumb", "0.00", "0.00", "0.00", "0.00"]
    assert lines[-1] == f"{log.num_readings} readings, {len(log.faults)} failures in {log.seconds:.2f} s"
    code, _, error = here(tmp_path, "hand", "record", "logs/a.npz", "--seconds", "0.1")
    assert (code, "there already" in error) == (2, True)
    code, _, error = here(tmp_path, "hand", "record", "b.npz", "--seconds", "0")
    assert (code, error) == (2, "tgdsl: --seconds 0: expected more than 0\n")
    assert not (tmp_path / "b.npz").exists()


def test_replay_of_what_is_no_log(here, tmp_path):
    (tmp_path / "a.npz").write_text("text")
    code, _, error = here(tmp_path, "hand", "replay", "a.npz")
    assert (code, error) == (2, "tgdsl: a.npz: this log is damaged, cut, or no .npz file: File is not a zip file\n")


def test_a_recording_through_failures_shows_and_keeps_them(emulator, here, tmp_path, monkeypatch):
    """The line is cut after ten readings, and a recording ends with the failures that follow."""
    plain = record.events

    def cut(hand, seconds):
        num_faults = 0
        for i, event in enumerate(plain(hand, seconds)):
            if i == 10:
                emulator.set_faults(Faults(silence=1.0))
            yield event
            num_faults += hasattr(event, "kind")
            if num_faults == 3:
                return

    monkeypatch.setattr(record, "events", cut)
    code, said, error = here(tmp_path, "hand", "record", "a.npz", "--port", emulator.device, "--hand-id", "0")
    assert code == 0, error
    assert "NO NEW READING: " in said
    log = open_log(tmp_path / "a.npz")
    assert len(log.faults) == 3
    code, said, _ = here(tmp_path, "hand", "replay", "a.npz", "--speed", "1000")
    assert code == 0
    assert f"NO NEW READING: {log.faults[-1].kind}: {log.faults[-1].message}" in said


@pytest.mark.parametrize("action", ["monitor", "record"])
def test_ctrl_c_closes_the_port_and_keeps_the_log(emulator, tmp_path, action):
    environment = {**os.environ, "PYTHONWARNINGS": "error", "PYTHONPATH": str(REPOSITORY), "NO_COLOR": "1"}
    arguments = ["monitor"] if action == "monitor" else ["record", "a.npz"]
    # What a shell starts in the background ignores SIGINT, and so do its children, tests among them.
    heeding = "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); runpy.run_module('tgdsl', run_name='__main__')"
    command = [sys.executable, "-c", heeding, "hand", *arguments, "--port", emulator.device, "--hand-id", "0"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            while sum(frame.command == Command.EXCHANGE for _, frame in list(emulator.requests)) < 100:
                assert process.poll() is None, process.communicate()
                time.sleep(0.01)
            process.send_signal(signal.SIGINT)
            said, error = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, error) == (0, "")
    assert said.splitlines()[0].startswith(f"{emulator.device}: hand 0")
    if action == "record":
        assert open_log(tmp_path / "a.npz").num_readings >= 1
        assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]
    with XHand1.open(emulator.device) as hand:  # the port is free again
        hand.read(20.0)


# calibrate

SCALE, TURN = np.array([0.05, 0.05, 0.02]), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, -1]])
PRESSES = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [0, 0, -2], [1, 1, -3], [-1, 0, -1], [0, -1, -1]])


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """A log of an index finger that is pressed in steps, and what `--load` says of them."""
    folder = tmp_path_factory.mktemp("pressed")
    now = np.zeros(3)

    def force(time_s, position):
        counts = TARE.copy()
        counts[1] += now @ TURN / SCALE
        return TipForces(counts, np.zeros((5, 120, 3)))

    loads: list[str] = []
    with (
        Emulator(EmulatedHand(forces=force)) as emulator,
        XHand1.open(emulator.device) as hand,
        record.LogWriter(folder / "press.npz") as log,
    ):
        first = hand.read(20.0)
        log.add(first)
        for press in PRESSES:
            now[:] = press
            hand.read(20.0)  # may have been asked for before
            times = []
            for _ in range(12):
                reading = hand.read(20.0)
                log.add(reading)
                times.append(reading.requested_at - first.received_at)
            loads += ["--load", f"{max(times[0] - 1e-4, 0)}", f"{times[-1] + 1e-4}", *(f"{value:g}" for value in press)]
    return folder, loads


def test_calibrate_with_loads(pressed, here, tmp_path):
    folder, loads = pressed
    log = str(folder / "press.npz")
    code, said, error = here(
        tmp_path, "calibrate", "hand", "--log", log, "--finger", "index", *loads, "--others", "index", "-o", "out/hand.yaml"
    )
    assert code == 0, error
    calibration = load_calibration(tmp_path / "out" / "hand.yaml")
    assert calibration.units == "N"
    assert calibration.rotation[1] == pytest.approx(TURN, abs=1e-6)
    assert calibration.scale == pytest.approx(np.tile(SCALE, (5, 1)), rel=1e-6)
    assert calibration.tare[1] == pytest.approx(TARE[1], abs=1e-4)
    text = (tmp_path / "out" / "hand.yaml").read_text()
    assert text.startswith("# index: fitted to press.npz; scale 0.05000 0.05000 0.02000 N per count, ")
    assert "# ring: not loaded; scale and rotation are those of index\n" in text
    assert said.splitlines()[0].startswith(f"index: {12 * len(PRESSES)} readings; scale 0.05000")
    assert said.splitlines()[-2:] == ["calibration: out/hand.yaml", "picture:     hand.calibration.png"]
    assert (tmp_path / "hand.calibration.png").read_bytes().startswith(b"\x89PNG")


def test_calibrate_with_a_file_of_loads(pressed, here, tmp_path):
    folder, loads = pressed
    rows = [loads[i + 1 : i + 6] for i in range(0, len(loads), 6)]
    lines = [f"  - {{finger: index, start: {a}, end: {b}, force: [{x}, {y}, {z} N]}}\n" for a, b, x, y, z in rows]
    (tmp_path / "loads.yaml").write_text("tgdsl: 1\nloads:\n" + "".join(lines))
    base = Calibration("N", np.full((5, 3), 0.3), np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3)), np.zeros((5, 3)))
    (tmp_path / "base.yaml").write_text(base.text())
    log = str(folder / "press.npz")
    code, _, error = here(
        tmp_path, "calibrate", "hand", "--log", log, "--loads", "loads.yaml", "--calibration", "base.yaml", "--plot", "fit.png"
    )
    assert code == 0, error
    calibration = load_calibration(tmp_path / "hand.calibration.yaml")
    assert calibration.scale[1] == pytest.approx(SCALE, rel=1e-6)
    assert (calibration.scale[[0, 2, 3, 4]] == 0.3).all()
    assert (tmp_path / "fit.png").exists()


def test_calibrate_with_forces_over_time(here, tmp_path):
    """The counts follow a force that another clock, 0.3 s behind, says; the fit finds scale, axes and offset."""

    def force_at(seconds):
        press = np.maximum(np.sin(9 * seconds) + 0.5 * np.sin(23 * seconds + 1), 0)
        return np.stack([press * np.sin(7 * seconds), press * np.cos(12 * seconds), -3 * press], axis=-1)

    started = time.monotonic()

    def force(time_s, position):
        counts = TARE.copy()
        counts[3] += force_at(time_s - started) @ TURN / SCALE
        return TipForces(counts, np.zeros((5, 120, 3)))

    with (
        Emulator(EmulatedHand(forces=force)) as emulator,
        XHand1.open(emulator.device) as hand,
        record.LogWriter(tmp_path / "a.npz") as log,
    ):
        for _ in range(300):
            log.add(hand.read(20.0))
    log = open_log(tmp_path / "a.npz")
    late = log.received_at[0] - started - 0.3
    steps = np.arange(-1, log.seconds + 2, 0.005)
    forces = np.zeros((len(steps), 5, 3))
    forces[:, 3] = force_at(steps + late + 0.3)
    np.savez(tmp_path / "known.npz", time=steps + 0.3, tip_force=forces)
    arguments = ("--simulation", "known.npz", "--others", "ring")
    code, said, error = here(tmp_path, "calibrate", "hand", "--log", "a.npz", *arguments)
    assert code == 0, error
    first = said.splitlines()[0].split()
    assert said.splitlines()[0].endswith("fingertips with loads: ring")
    # A state is of the moment when the request has arrived, which is a millisecond or more after it was sent.
    assert float(first[4]) == pytest.approx(-0.3, abs=0.02)
    calibration = load_calibration(tmp_path / "hand.calibration.yaml")
    assert calibration.scale[3] == pytest.approx(SCALE, rel=0.1)
    assert calibration.rotation[3] == pytest.approx(TURN, abs=0.1)


SCENE = """
<mujoco>
  <worldbody>
    <body name="right_hand_ring_link2"><geom type="box" size=".03 .03 .01"/></body>
    <body name="right_hand_pinky_link2" pos="0 0 1"><geom size=".01"/></body>
    <body name="cube" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  </worldbody>
</mujoco>
"""
DOCUMENT = """tgdsl: 1
robot:
  model: scene.xml
  layout:
    resolutions:
      low:
        right_hand_ring_link2: {method: grid, rows: 2, columns: 2, direction: [0, 0, -1], radius: 4 mm}
        right_hand_pinky_link2: {method: points, points: [{pos: [0, 0, 0.01], normal: [0, 0, 1], radius: 4 mm}]}
objects: {cube: {body: cube}}
resolution: low
sensors: {skin: {kind: kinematic_taxel, links: "*", feels: [cube], outputs: [force]}}
"""


def test_calibrate_beside_a_simulation(here, tmp_path):
    """A log of the same forces as the readings of a run, 70 ms later, as counts of a ring finger with other axes."""
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "hand.yaml").write_text(DOCUMENT)
    steps = 0.01 * np.arange(1, 400)
    press = np.maximum(np.sin(9 * steps) + 0.5 * np.sin(23 * steps + 1), 0)
    taxel = 0.25 * np.stack([press * np.sin(7 * steps), press * np.cos(12 * steps), -3 * press], axis=-1)
    skin = np.zeros((len(steps), 1, 5, 3))
    skin[:, 0, :4] = taxel[:, None]
    np.savez(tmp_path / "readings.npz", time=steps, skin=skin.astype(np.float32))
    readings = random_readings(7.0 + 0.07 + steps)
    with record.LogWriter(tmp_path / "a.npz") as log:
        for i, reading in enumerate(readings):
            total = np.tile(TARE, (5, 1, 1))[0]
            total[3] += 4 * taxel[i] @ TURN / SCALE
            quiet = np.zeros((5, 120, 3), dtype=np.int16)
            state = replace(reading.state, total_force=np.round(total).astype(np.int16), taxel_force=quiet)
            log.add(replace(reading, state=state))
    arguments = ("--simulation", "readings.npz", "--document", "hand.yaml", "--reading", "skin", "--others", "ring")
    code, said, error = here(tmp_path, "calibrate", "hand", "--log", "a.npz", *arguments)
    assert code == 0, error
    # The log counts from its first reading, the run from 10 ms before; and what is read was asked for 8 ms earlier.
    assert float(said.split()[4]) == pytest.approx(-0.01 - 0.008, abs=1e-3)
    assert said.splitlines()[0].endswith("fingertips with loads: ring")
    calibration = load_calibration(tmp_path / "hand.calibration.yaml")
    assert calibration.scale[3] == pytest.approx(SCALE, rel=0.01)
    assert calibration.rotation[3] == pytest.approx(TURN, abs=0.01)
    assert calibration.tare[3] == pytest.approx(TARE[3], abs=0.3)
    code, _, error = here(tmp_path, "calibrate", "hand", "--log", "a.npz", *arguments[:4], "--force")
    assert (code, error) == (2, 'tgdsl: the document has no reading "touch"; it has skin\n')


def test_calibrations_that_cannot_be(pressed, here, tmp_path):
    folder, loads = pressed
    log = str(folder / "press.npz")
    (tmp_path / "there.yaml").write_text("")
    one_of = "expected the known forces as one of --loads FILE, --finger with --load, or --simulation FILE"
    cases = {
        (): one_of,
        ("--loads", "x.yaml", "--simulation", "y.npz"): one_of,
        ("--load", "0", "1", "0", "0", "2"): "--load: expected --finger to say which finger it is on",
        ("--finger", "index", "--load", "2", "1", "0", "0", "2"): "--load 2 1 0 0 2: from 2 s to 1 s, expected an end after the start",
        ("--finger", "index", *loads[:12]): "index: no load along y or z of the link; expected loads along x, y and z, and no load",
        ("--finger", "index", *loads): "thumb, middle, ring, pinky: no load was on them",
        ("--finger", "index", *loads, "-o", "there.yaml"): "there.yaml: this file is there already",
        ("--simulation", "none.npz"): "none.npz: expected an .npz file with arrays time and tip_force",
    }  # fmt: skip
    for arguments, message in cases.items():
        code, _, error = here(tmp_path, "calibrate", "hand", "--log", log, *arguments)
        assert code == 2
        assert error.startswith(f"tgdsl: {message}"), error
    code, _, error = here(tmp_path, "calibrate", "hand", "--log", "none.npz", "--loads", "x.yaml")
    assert error == "tgdsl: none.npz: cannot read this log: No such file or directory\n"
    assert [file.name for file in tmp_path.iterdir()] == ["there.yaml"]
