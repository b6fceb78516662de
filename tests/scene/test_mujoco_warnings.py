"""MuJoCo's warnings are raised once, with the file's name, and neither printed nor logged."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from oracles.setups.scenes import pad

import tgdsl
from tgdsl.formats.robot import load_model
from tgdsl.scene.mujoco_warnings import StepWarnings, located_warnings

REPOSITORY = Path(__file__).parents[2]
INERTIAL = "<inertial><mass value='.1'/><inertia ixx='1e-5' iyy='1e-5' izz='1e-5' ixy='0' ixz='0' iyz='0'/></inertial>"
MIMIC = f"""<robot name='r'><link name='world'/><link name='b'>{INERTIAL}</link>
<joint name='j' type='floating'><mimic joint='k'/><parent link='world'/><child link='b'/></joint></robot>"""
DEPRECATED = "<mujoco><compiler settotalmass='3'/><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"


@pytest.mark.parametrize(
    ("name", "text", "what"), [("r.urdf", MIMIC, "<mimic> on joint 'j'"), ("r.xml", DEPRECATED, "settotalmass")]
)
def test_warnings_of_a_model_are_raised_once(tmp_path, monkeypatch, capfd, name, text, what):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    path.write_text(text)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_model(path)
    messages = [str(w.message) for w in caught]
    assert len(messages) == 1 and messages[0].startswith(f"{path}: MuJoCo: ") and what in messages[0]
    assert capfd.readouterr() == ("", "") and [p.name for p in tmp_path.iterdir()] == [name]


def test_warnings_as_errors_do_not_abort_the_process(tmp_path):
    """A Python exception inside MuJoCo's callback would abort it."""
    (tmp_path / "r.urdf").write_text(MIMIC)
    environment = {**os.environ, "PYTHONWARNINGS": "error", "PYTHONPATH": str(REPOSITORY)}
    code = "from pathlib import Path\nfrom tgdsl.formats.robot import load_model\nload_model(Path('r.urdf'))"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 1, result.stderr
    assert "UserWarning: r.urdf: MuJoCo: <mimic> on joint 'j' ignored" in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["r.urdf"]


def test_the_users_handler_is_restored():
    handler = lambda message: None  # noqa: E731
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(handler)
    try:
        with pytest.raises(ValueError, match="broken"), located_warnings("x"):
            raise ValueError("broken")
        assert mujoco.get_mju_user_warning() is handler
    finally:
        mujoco.set_mju_user_warning(before)


def test_other_warnings_keep_their_message_and_category():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with located_warnings("hand.xml"):
            warnings.warn("old", DeprecationWarning, stacklevel=1)
            warnings.warn("hand.xml: a reader's own", stacklevel=1)
            warnings.warn("Attaching a spec with an empty prefix", stacklevel=1)
    assert [(w.category, str(w.message)) for w in caught] == [
        (DeprecationWarning, "old"),
        (UserWarning, "hand.xml: a reader's own"),
    ]


def test_a_simulation_that_diverges_prints_and_logs_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    touch = pad(tmp_path, kind="contact")
    sim = tgdsl.simulate(touch, 3, threads=2)
    names = sorted(path.name for path in tmp_path.iterdir())
    sim.qvel[1] = np.nan
    with pytest.raises(tgdsl.SimulationError, match="environments 1 diverged"):
        sim.step()
    assert capfd.readouterr() == ("", "") and sorted(path.name for path in tmp_path.iterdir()) == names


def test_each_warning_of_a_step_is_raised_once_for_any_numbers():
    step_warnings = StepWarnings()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        step_warnings.warn(
            ["Pre-allocated constraint buffer is full (12). Time = 0.1000.\n\n", "Nan, Inf or huge value in QACC at DOF 0."]
        )
        step_warnings.warn(["Pre-allocated constraint buffer is full (13). Time = 0.2000.\n\n", "Another thing. Time = 1e-3."])
    assert [str(w.message) for w in caught] == [
        "MuJoCo: Pre-allocated constraint buffer is full (12). Time = 0.1000.; shown once",
        "MuJoCo: Another thing. Time = 1e-3.; shown once",
    ]
