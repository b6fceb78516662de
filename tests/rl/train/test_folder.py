"""A run's folder: its lock, its curve after a kill, and files that are no run."""

import contextlib
import subprocess
import sys

import pytest
import trimesh
from small_tasks import small_task

from tgdsl.errors import TgdslError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.train.folder import RunFolder, changes, run_origin


def row_of(iteration):
    return {"iteration": iteration, "samples": 8 * iteration, "seconds": 0.5 * iteration, "Loss/value": 0.25}


def test_a_curve_resumes_after_any_truncation(tmp_path):
    """A kill may leave any part of the header and first row; only complete rows are kept."""
    folder = RunFolder(tmp_path)
    for iteration in (1, 2):
        folder.add_row(row_of(iteration))
    content = folder.curve.read_bytes()
    header, first, second = content.splitlines(keepends=True)
    assert header == b"iteration,samples,seconds,Loss/value\n"
    for size in range(len(content) + 1):
        folder.curve.write_bytes(content[:size])
        num_rows = (size >= len(header + first)) + (size == len(content))
        assert [row["iteration"] for row in folder.rows()] == ["1", "2"][:num_rows], size
        folder.keep_rows(1)
        assert folder.curve.read_bytes() == (header + first if num_rows else b""), size
        folder.add_row(row_of(2))
        assert folder.curve.read_bytes() == (content if num_rows else header + second), size


@pytest.mark.parametrize(
    ("text", "line", "found"),
    [
        ("iteration,samp1,\n1,2,3\nx,2,3\n", 3, "'x,2,3'"),
        ("\0\0\n\0\n", 2, "'\\x00'"),
        ("iteration,samples,seconds\n1,2,3\n\0,,\n", 3, "'\\x00,,'"),
        ("iteration,samples,seconds\n1,2\n2,3,4\n", 2, "'1,2'"),
        ("iteration,samples,seconds\n1,2,3,4,5\n", 2, "'1,2,3,4,5'"),
    ],
    ids=["torn", "zeros", "zeros later", "too few", "too many"],
)
def test_an_invalid_curve_is_refused_before_a_run_resumes(tmp_path, text, line, found):
    folder = RunFolder(tmp_path)
    folder.checkpoint.write_bytes(b"")
    folder.curve.write_text(text)
    with pytest.raises(TgdslError) as raised:
        folder.check(is_resumed=True)
    assert str(raised.value).startswith(f"{folder.curve}:{line}: found {found}")
    assert str(raised.value).endswith("; move this file away, and the run goes on with a new one")
    assert folder.curve.read_text() == text


def is_locked(folder):
    """Return whether a second lock of the folder is refused."""
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(folder.lock())
        except TgdslError as error:
            return "run: another process runs in this folder; wait until it has ended" in str(error)
    return False


def test_two_processes_do_not_run_in_one_folder(tmp_path):
    """A run locks its folder; killing the process releases the lock."""
    folder = RunFolder(tmp_path / "run")
    with folder.lock():
        assert is_locked(RunFolder(folder.path))
    assert not is_locked(folder)
    folder.path.mkdir(exist_ok=True)
    code = (
        "import fcntl, os, sys, time; fcntl.flock(os.open(sys.argv[1], 0), fcntl.LOCK_EX); print(flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(folder.path)], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert is_locked(folder)
        other.kill()
        other.wait()
        assert not is_locked(folder) and list(folder.path.iterdir()) == []


@pytest.mark.parametrize("text", ["[]", '{"runs": 3}', "{", "\0"])
def test_a_run_file_without_starts_is_refused(tmp_path, text):
    folder = RunFolder(tmp_path)
    folder.run.write_text(text)
    with pytest.raises(TgdslError, match=r"run\.json: (expected a file that tgdsl wrote|cannot read this file)"):
        folder.last_start()


def test_moving_files_is_not_a_change(tmp_path, monkeypatch):
    origins = []
    for name in ("here", "there"):
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.chdir(folder)
        small_task(folder)
        trimesh.creation.box([0.01, 0.01, 0.01]).export(folder / "cap.stl")
        scene = (folder / "scene.xml").read_text()
        scene = scene.replace("<worldbody>", '<asset><mesh name="cap" file="cap.stl"/></asset><worldbody>')
        geom = '<geom name="cap" type="mesh" mesh="cap" contype="0" conaffinity="0" mass="0"/></body>'
        (folder / "scene.xml").write_text(scene.replace("</body>", geom, 1))
        env = TouchEnv("task.yaml", 1)
        origins.append(run_origin(env.loaded, env, 0, {}, 1))
    assert changes(*origins, type(env.loaded.spec)) == []
