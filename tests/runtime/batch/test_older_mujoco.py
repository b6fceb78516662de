"""MuJoCo before 3.17 has no `mujoco.batch`: everything works except simulating on the CPU."""

import sys

import mujoco
import pytest
from press_scene import DOCUMENT, SCENE

import tgdsl
from tgdsl.errors import SimulationError


def test_older_mujoco_compiles_and_reads_but_cannot_simulate(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.batch", None)  # importing it is an error
    if mujoco.__version__ >= "3.17":
        monkeypatch.setattr(mujoco, "__version__", "3.16.0")
    (tmp_path / "press.xml").write_text(SCENE)
    (tmp_path / "press.yaml").write_text(DOCUMENT)
    touch = tgdsl.compile(tmp_path / "press.yaml")
    assert touch(touch.example_state(2)).keys() == {"touch", "near"}
    with pytest.raises(SimulationError, match=r'^MuJoCo 3\.1.* has no `mujoco\.batch`.* pip install "mujoco>=3\.17"$'):
        tgdsl.simulate(touch, 2)
