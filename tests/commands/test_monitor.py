"""`tgdsl hand monitor` against an emulated hand."""

import numpy as np
from resting_hands import TARE

from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
from tgdsl.runtime.xhand1.wire.protocol import Command


def test_monitor_shows_the_last_state_on_a_pipe(emulator, plugged, here, tmp_path):
    plugged(emulator.device)
    code, output, error = here(tmp_path, "hand", "monitor", "--seconds", "0.3", "--hand-id", "0")
    assert (code, error) == (0, "")
    lines = output.splitlines()
    assert lines[0] == f"{emulator.device}: hand 0"
    assert lines[1].split()[:3:2] == ["reading", "age"]
    assert lines[3].split() == ["fingertip", "x", "y", "z", "|force|", "counts", "°C"]
    assert lines[4].split()[:6] == ["thumb", "5.00", "-3.00", "8.00", "9.90", "25"]
    assert lines[8].split()[:4] == ["pinky", "9.00", "9.00", "9.00"]
    assert lines[11].split() == ["thumb_bend", "0.000", "0", "25", "–"]
    assert len(lines) == 23


def test_monitor_shows_newtons_with_a_calibration(emulator, plugged, here, tmp_path):
    newton = Calibration("N", np.full((5, 3), 0.1), np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3)), TARE)
    (tmp_path / "hand.yaml").write_text(newton.text())
    arguments = ("hand", "monitor", "--port", emulator.device, "--hand-id", "0", "--seconds", "0.2", "--calibration")
    code, output, _ = here(tmp_path, *arguments, "hand.yaml")
    assert code == 0
    assert output.splitlines()[3].split()[-2:] == ["N", "°C"]
    assert output.splitlines()[4].split()[:5] == ["thumb", "0.00", "0.00", "0.00", "0.00"]
    code, _, error = here(tmp_path, *arguments, "none.yaml")
    assert (code, error) == (2, "none.yaml: cannot read this file: No such file or directory\n1 mistake\n")
    assert sum(frame.command == Command.EXCHANGE for _, frame in emulator.requests) < 200


def test_commands_on_an_emulated_hand_by_name(here, tmp_path):
    code, output, error = here(tmp_path, "hand", "monitor", "--port", "emulator", "--seconds", "0.3", "--hand-id", "0")
    assert (code, error) == (0, "")
    assert output.splitlines()[4].split()[:5] == ["thumb", "0.00", "0.00", "0.00", "0.00"]
    code, output, error = here(tmp_path, "hand", "probe", "--port", "emulator", "--hand-id", "0")
    assert (code, error) == (0, "")
    assert "emulated" in output
    code, _, error = here(tmp_path, "hand", "tare", "--port", "emulator", "--hand-id", "0", "-o", "tare.yaml")
    assert (code, error) == (0, "")
    assert not load_calibration(tmp_path / "tare.yaml").tare.any()
