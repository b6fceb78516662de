"""`tgdsl calibrate hand`, as users run it, on logs of emulated hands."""

import time
from dataclasses import replace

import numpy as np
import pytest
import tyro
from first_order_hands import first_order_hand
from hand_logs import random_readings
from resting_hands import TARE

from tgdsl.commands.calibrate import CalibrateHand
from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import Emulator, TipForces
from tgdsl.runtime.xhand1.log.log import LogWriter, open_log

SCALE, TURN = np.array([0.05, 0.05, 0.02]), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, -1]])
PRESSES = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [0, 0, -2], [1, 1, -3], [-1, 0, -1], [0, -1, -1]])


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """Return a folder with a log of an index finger pressed in steps, and its `--load` arguments."""
    folder = tmp_path_factory.mktemp("pressed")
    now = np.zeros(3)

    def force(time_s, position):
        counts = TARE.copy()
        counts[1] += now @ TURN / SCALE
        return TipForces(counts, np.zeros((5, 120, 3)))

    loads: list[str] = []
    with (
        Emulator(first_order_hand(forces=force)) as emulator,
        XHand1.open(emulator.device) as hand,
        LogWriter(folder / "press.npz") as log,
    ):
        first = hand.read(20.0)
        log.add(first)
        for press in PRESSES:
            now[:] = press
            hand.read(20.0)  # may be of an earlier request
            times = []
            for _ in range(12):
                reading = hand.read(20.0)
                log.add(reading)
                times.append(reading.requested_at - first.received_at)
            loads += ["--load", f"{max(times[0] - 1e-4, 0)}", f"{times[-1] + 1e-4}", *(f"{value:g}" for value in press)]
    return folder, loads


@pytest.mark.slow
def test_the_help_names_the_fingers(capsys):
    with pytest.raises(SystemExit):
        tyro.cli(CalibrateHand, args=["--help"])
    output = capsys.readouterr().out
    assert all(f"{option} {{thumb,index,middle,ring,pinky}}" in output for option in ("--finger", "--others"))


def test_calibrate_with_loads(pressed, here, tmp_path):
    folder, loads = pressed
    log = str(folder / "press.npz")
    code, output, error = here(
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
    assert "# ring: not loaded; scale and rotation as for index\n" in text
    assert output.splitlines()[0].startswith(f"index: {12 * len(PRESSES)} readings; scale 0.05000")
    assert output.splitlines()[-2:] == ["calibration: out/hand.yaml", "picture:     hand.calibration.png"]
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


@pytest.mark.slow
def test_calibrate_with_forces_over_time(here, tmp_path):
    """Counts follow a force with a clock that is 0.3 s behind; the fit finds scale, axes and offset."""

    def force_at(seconds):
        press = np.maximum(np.sin(9 * seconds) + 0.5 * np.sin(23 * seconds + 1), 0)
        return np.stack([press * np.sin(7 * seconds), press * np.cos(12 * seconds), -3 * press], axis=-1)

    started = time.monotonic()

    def force(time_s, position):
        counts = TARE.copy()
        counts[3] += force_at(time_s - started) @ TURN / SCALE
        return TipForces(counts, np.zeros((5, 120, 3)))

    with (
        Emulator(first_order_hand(forces=force)) as emulator,
        XHand1.open(emulator.device) as hand,
        LogWriter(tmp_path / "a.npz") as log,
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
    code, output, error = here(tmp_path, "calibrate", "hand", "--log", "a.npz", *arguments)
    assert code == 0, error
    first = output.splitlines()[0].split()
    assert output.splitlines()[0].endswith("fingertips with loads: ring")
    # A state is measured when its request arrives, at least a millisecond after it was sent.
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


@pytest.mark.slow
def test_calibrate_with_a_simulation(here, tmp_path):
    """A ring finger with other axes logs the forces of a simulated run 70 ms later, as counts."""
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "hand.yaml").write_text(DOCUMENT)
    steps = 0.01 * np.arange(1, 400)
    press = np.maximum(np.sin(9 * steps) + 0.5 * np.sin(23 * steps + 1), 0)
    taxel = 0.25 * np.stack([press * np.sin(7 * steps), press * np.cos(12 * steps), -3 * press], axis=-1)
    skin = np.zeros((len(steps), 1, 5, 3))
    skin[:, 0, :4] = taxel[:, None]
    np.savez(tmp_path / "readings.npz", time=steps, skin=skin.astype(np.float32))
    readings = random_readings(7.0 + 0.07 + steps)
    with LogWriter(tmp_path / "a.npz") as log:
        for i, reading in enumerate(readings):
            total = np.tile(TARE, (5, 1, 1))[0]
            total[3] += 4 * taxel[i] @ TURN / SCALE
            quiet = np.zeros((5, 120, 3), dtype=np.int16)
            state = replace(reading.state, total_force=np.round(total).astype(np.int16), taxel_force=quiet)
            log.add(replace(reading, state=state))
    arguments = ("--simulation", "readings.npz", "--document", "hand.yaml", "--reading", "skin", "--others", "ring")
    code, output, error = here(tmp_path, "calibrate", "hand", "--log", "a.npz", *arguments)
    assert code == 0, error
    # The log starts at its first reading, the run 10 ms earlier; readings were requested 8 ms before they arrived.
    assert float(output.split()[4]) == pytest.approx(-0.01 - 0.008, abs=1e-3)
    assert output.splitlines()[0].endswith("fingertips with loads: ring")
    calibration = load_calibration(tmp_path / "hand.calibration.yaml")
    assert calibration.scale[3] == pytest.approx(SCALE, rel=0.01)
    assert calibration.rotation[3] == pytest.approx(TURN, abs=0.01)
    assert calibration.tare[3] == pytest.approx(TARE[3], abs=0.3)
    code, _, error = here(tmp_path, "calibrate", "hand", "--log", "a.npz", *arguments[:4], "--force")
    assert (code, error) == (2, 'tgdsl: the document has no reading "touch"; it has skin\n')


def test_impossible_calibrations_are_refused(pressed, here, tmp_path):
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
