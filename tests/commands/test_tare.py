"""`tgdsl hand tare` with emulated hands."""

import numpy as np
from first_order_hands import first_order_hand
from resting_hands import TARE

from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
from tgdsl.runtime.xhand1.emulator.emulator import Emulator, TipForces


def test_tare_writes_a_calibration(emulator, plugged, here, tmp_path):
    plugged(emulator.device)
    code, output, error = here(tmp_path, "hand", "tare", "-o", "new/hand.yaml")
    assert code == 0, error
    assert output.splitlines()[0] == "thumb   tare    5.00   -3.00    8.00   spread 0 counts"
    assert output.endswith("calibration: new/hand.yaml\n")
    calibration = load_calibration(tmp_path / "new" / "hand.yaml")
    assert (calibration.tare == TARE).all()
    assert calibration.units == "counts"
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["hand.yaml"]


def test_tare_replaces_files_only_if_forced_and_keeps_other_values(emulator, here, tmp_path):
    base = Calibration("N", np.full((5, 3), 0.2), np.tile(-np.eye(3), (5, 1, 1)), np.ones((5, 3)), np.zeros((5, 3)), "mine")
    (tmp_path / "hand.yaml").write_text(base.text())
    arguments = ("hand", "tare", "--port", emulator.device, "-o", "hand.yaml", "--calibration", "hand.yaml", "--frames", "5")
    code, _, error = here(tmp_path, *arguments)
    message = "hand.yaml: this file is there already; give --force to replace it, or another name"
    assert (code, error) == (2, f"tgdsl: {message}\n")
    assert not emulator.requests
    assert (tmp_path / "hand.yaml").read_text() == base.text()
    assert here(tmp_path, *arguments, "--force")[0] == 0
    calibration = load_calibration(tmp_path / "hand.yaml")
    assert (calibration.units, calibration.hand) == ("N", "mine")
    assert (calibration.tare == TARE).all()
    assert (calibration.rotation == base.rotation).all() and (calibration.bias == base.bias).all()


def test_tare_of_a_touched_hand_is_refused(here, tmp_path):
    calls = iter(range(10**6))

    def moving(time_s, position):
        force = TARE.copy()
        force[1, 2] += 12 * (next(calls) % 2)
        return TipForces(force, np.zeros((5, 120, 3)))

    with Emulator(first_order_hand(forces=moving)) as emulator:
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
