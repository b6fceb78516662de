"""`tgdsl calibrate sensor`, as users run it."""

import numpy as np
import pytest
from recorded_presses import document, recording

import tgdsl


@pytest.fixture
def folder(tmp_path):
    np.savez(tmp_path / "press.npz", **recording(document(tmp_path)))
    return tmp_path


def test_calibrate_sensor(here, folder):
    arguments = ["--fit", "touch.normal_stiffness", "touch.depth_exponent", "--starts", "1", "--hold-out", "time"]
    files = ["--out", "fitted.yaml", "--plot", "fit.png"]
    code, output, error = here(folder, "calibrate", "sensor", "touch.yaml", "press.npz", *arguments, *files)
    assert code == 0, error
    assert output.splitlines()[-2:] == ["document: fitted.yaml", "picture:  fit.png"]
    assert "touch.depth_exponent" in output and "press.npz: clock of touch" in output
    assert tgdsl.compile(folder / "fitted.yaml").plan.sensors[0].constants["depth_exponent"] == pytest.approx(1.3, abs=0.05)
    assert (folder / "fit.png").read_bytes().startswith(b"\x89PNG")
    code, _, error = here(folder, "calibrate", "sensor", "touch.yaml", "press.npz", *arguments, *files)
    assert code == 2 and "this file is there already" in error


def test_mistakes_in_a_recording_are_named(here, folder):
    arrays = dict(np.load(folder / "press.npz"))
    del arrays["clock:touch"], arrays["unit:touch"]
    np.savez(folder / "bad.npz", **arrays)
    code, _, error = here(folder, "calibrate", "sensor", "touch.yaml", "bad.npz")
    assert code == 2
    assert error.splitlines()[0].startswith("bad.npz: clock:touch: this clock of the target is missing")
    assert error.splitlines()[-1] == "2 mistakes"
