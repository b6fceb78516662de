"""Files that appear whole: their permissions are those of any new file, and nothing of the process is changed for it."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hand_logs import random_readings, write_log

from tgdsl.files.files import whole_file, write_whole

REPOSITORY = Path(__file__).parents[2]
SCRIPT = """
import sys, numpy as np, tgdsl
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from hand_logs import random_readings, write_log
from joint_scenes import ALL, joint_module
from tgdsl.formats.robot import export_model
from tgdsl.runtime.rollout import Recorder
out = Path(sys.argv[1])
touch = joint_module(out, {"policy": ALL})
tgdsl.save(touch, out / "a.safetensors")
Recorder(touch, 1, 1).write(out / "a.npz", np.zeros((1, 4)))
write_log(out / "log.npz", random_readings(np.arange(3.0)))
export_model(out / "scene.xml", out / "a.usda")
(out / "plain").touch()
"""
WRITTEN = ("a.safetensors", "a.npz", "log.npz", "a.usda")


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_permissions_are_those_of_a_new_file(tmp_path, umask):
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, str(tmp_path), str(REPOSITORY / "tests")]
    run = subprocess.run(command, env=environment, umask=umask, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    expected = (tmp_path / "plain").stat().st_mode & 0o777
    assert expected == 0o666 & ~umask
    assert {name: (tmp_path / name).stat().st_mode & 0o777 for name in WRITTEN} == dict.fromkeys(WRITTEN, expected)


def test_the_process_keeps_its_umask(tmp_path, monkeypatch):
    """It is one for all threads: whoever changes it for a moment changes the files of others."""

    def refuse(mask):
        raise AssertionError("the umask was changed")

    monkeypatch.setattr(os, "umask", refuse)
    write_whole(tmp_path / "a.txt", b"text")
    write_log(tmp_path / "a.npz", random_readings(np.arange(3.0)))
    assert (tmp_path / "a.txt").read_bytes() == b"text"


def test_a_file_takes_the_place_of_another_or_leaves_it(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")

    def fail_half_way():
        with whole_file(target) as temporary:
            temporary.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_half_way()
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert target.read_text() == "old"
    with whole_file(target) as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".txt")
        temporary.write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert target.read_text() == "new"
