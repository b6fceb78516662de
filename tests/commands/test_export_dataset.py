"""`tgdsl export-dataset`: arguments that it refuses before it writes anything."""

import numpy as np
import pytest
from small_tasks import small_task

from tgdsl.errors import TgdslError

RECORDING = "expected a recording of tgdsl run, or a log of tgdsl hand record"


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 and no more", b"no archive"])
def test_a_damaged_file_is_named(tmp_path, here, content):
    (tmp_path / "run.npz").write_bytes(content)
    code, _, error = here(tmp_path, "export-dataset", "run.npz")
    assert code == 2 and f"run.npz: {RECORDING}: " in error


def test_a_file_without_arrays_is_named(tmp_path, here):
    np.savez(tmp_path / "run.npz")
    code, _, error = here(tmp_path, "export-dataset", "run.npz")
    assert code == 2 and f"run.npz: found no array; {RECORDING}" in error


def test_a_folder_that_cannot_be_made_is_named(tmp_path, here):
    (tmp_path / "file").touch()
    code, _, error = here(tmp_path, "export-dataset", "run.npz", "--out", "file/data")
    assert code == 2 and "file is a file, expected a folder" in error
    code, _, error = here(tmp_path, "export-dataset", "run.npz", "--out", "/proc/data")
    assert code == 2 and "/proc/data: " in error


@pytest.mark.filterwarnings("ignore:.*no hinge turns by more than")
@pytest.mark.usefixtures("no_pictures")
def test_a_recording_must_have_steps_and_fit_its_document(tmp_path, here):
    small_task(tmp_path)
    sensors = tmp_path / "sensors.yaml"
    sensors.write_text(sensors.read_text() + "  push: {kind: kinematic_taxel, links: tip, feels: [item]}\n")
    code, _, error = here(tmp_path, "run", "sensors.yaml", "--seconds", "0.2")
    assert code == 0, error
    with np.load(tmp_path / "out/readings.npz") as file:
        arrays = dict(file)
    changes = {
        "run.npz: 1 steps, expected two at least": {"time": arrays["time"][:1]},
        "run.npz: 1 positions and ": {"qpos": arrays["qpos"][..., :1]},
    }
    for message, change in changes.items():
        np.savez(tmp_path / "run.npz", **{**arrays, **change})
        code, _, error = here(tmp_path, "export-dataset", "run.npz")
        assert code == 2 and message in error, error
    code, _, error = here(tmp_path, "export-dataset", "out/readings.npz", "--fps", "0")
    assert code == 2 and "--fps 0: expected more than 0" in error


def test_a_hand_acts_in_real_time_unless_lockstep_is_asked_for(tmp_path, here, monkeypatch):
    asked = []

    def refuse(*_, lockstep, **options):
        asked.append(lockstep)
        raise TgdslError("no hand")

    monkeypatch.setattr("tgdsl.rl.deploying.deploy.Deployment", refuse)
    for more in ((), ("--lockstep",)):
        result = here(tmp_path, "export-dataset", "task.yaml", "--policy", "p.pt", "--source", "emulator", *more)
        assert result == (2, "", "tgdsl: no hand\n")
    assert asked == [False, True]
