"""Commands stopped from outside: Ctrl-C, a closed pipe, a full disk, invalid paths."""

import os
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tgdsl.runtime.batch.simulation import BatchSimulation

REPOSITORY = Path(__file__).parents[2]
SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos="0 0 .029">
      <joint name="lift" type="slide" axis="0 0 1"/><geom type="box" size=".02 .02 .02" mass=".25"/>
    </body>
  </worldbody>
  <actuator><motor joint="lift"/></actuator>
</mujoco>
"""
DOCUMENT = """tgdsl: 1
robot:
  model: scene.xml
  layout: {resolutions: {low: {pad: {method: grid, rows: 2, columns: 3, direction: [0, 0, -1], radius: 4 mm}}}}
objects: {cube: {body: cube}}
sensors: {touch: {kind: contact_depth, links: pad, feels: [cube]}}
"""
STAGE = """#usda 1.0
(
    defaultPrim = "cube"
    metersPerUnit = 1
    upAxis = "Z"
)
def Cube "cube" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"])
{
    double size = 0.04
}
"""


@pytest.fixture
def base(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "pad.yaml").write_text(DOCUMENT)
    (tmp_path / "cube.usda").write_text(STAGE)
    return tmp_path


def run_process(folder, arguments, out):
    """Run a command in a process, whose exit flushes its output; return exit code and stderr."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "NO_COLOR": "1", "COLUMNS": "200"}
    command = [sys.executable, "-m", "tgdsl", *arguments]
    process = subprocess.run(command, cwd=folder, env=environment, stdout=out, stderr=subprocess.PIPE, text=True, check=False)
    return process.returncode, process.stderr


def files_in(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


# Ctrl-C


@pytest.mark.parametrize("where", ["stepping", "writing"])
def test_ctrl_c_ends_cleanly(base, here, monkeypatch, where):
    """No partial files remain, and old files stay."""
    (base / "out").mkdir()
    (base / "out" / "readings.npz").write_bytes(b"before")

    def interrupted(*arguments, **_):
        if where == "writing":
            arguments[0].write(b"half")
        raise KeyboardInterrupt

    if where == "stepping":
        monkeypatch.setattr(BatchSimulation, "step", interrupted)
    else:
        monkeypatch.setattr(np, "savez_compressed", interrupted)
    files_before = files_in(base)
    code, _, error = here(base, "run", "pad.yaml", "--seconds", "0.1")
    assert (code, error.splitlines()[-1]) == (130, "interrupted")
    assert files_in(base) == files_before
    assert (base / "out" / "readings.npz").read_bytes() == b"before"


# Closed pipes


@pytest.mark.parametrize("arguments", [("examples", "list"), ("run", "--help"), ("--version",)])
def test_a_pipe_closed_before_the_first_line(tmp_path, arguments):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as out:
        assert run_process(tmp_path, arguments, out) == (1, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("arguments", [("examples", "list"), ("--version",)])
def test_output_to_a_full_disk(tmp_path, arguments):
    with Path("/dev/full").open("wb") as full:
        assert run_process(tmp_path, arguments, full) == (2, "tgdsl: standard output: No space left on device\n")


# Files that cannot be written


@contextmanager
def files_of_at_most(num_bytes):
    """Limit the size of each file that this process writes inside, and no longer: coverage writes files between the phases of a test."""
    limits, keeps_no_bytecode = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # Python would keep the first bytes of a module's bytecode
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        sys.dont_write_bytecode = keeps_no_bytecode


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (("compile", "pad.yaml", "-o", "new/x.safetensors"), "new/x.safetensors"),
        (("run", "pad.yaml", "--seconds", "0.1"), "out/readings.npz"),
        (("schema",), "tgdsl.schema.json"),
        (("layout", "new", "scene.xml"), "layout.yaml"),
        (("import", "cube.usda"), "cube.xml"),
    ],
)
def test_a_file_that_grows_too_large_is_named_and_removed(base, here, arguments, file):
    files_before = files_in(base)
    with files_of_at_most(100):
        code, _, error = here(base, *arguments)
    assert (code, error.splitlines()[-1]) == (2, f"tgdsl: {file}: File too large")
    assert files_in(base) == files_before


def test_a_picture_that_grows_too_large(base, here):
    with files_of_at_most(3000):
        code, _, error = here(base, "run", "pad.yaml", "--seconds", "0.05")
    assert (code, error.splitlines()[-1]) == (2, "tgdsl: out/picture.png: File too large")
    assert files_in(base / "out") == ["readings.npz"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "pad.yaml", "-o", "pad.yaml"), "pad.yaml/readings.npz: {base}/pad.yaml is a file, expected a folder"),
        (("run", "pad.yaml", "-o", "made"), "made/picture.png: this is a folder, expected a file's name"),
        (("compile", "pad.yaml", "-o", "made"), "made: this is a folder, expected a file's name"),
        (("compile", "pad.yaml", "-o", "pad.yaml/x"), "pad.yaml/x: {base}/pad.yaml is a file, expected a folder"),
        (("import", "none.usd", "-o", "made"), "made: this is a folder, expected a file's name"),
        (("export-usd", "scene.xml", "-o", "made"), "made: this is a folder, expected a file's name"),
        (("layout", "new", "scene.xml", "-o", "made"), "made: this is a folder, expected a file's name"),
        (("render", "xhand1", "-o", "made"), "cannot write made: this is a folder, expected a file's name"),
        (("schema", "-o", "made"), "made: this is a folder, expected a file's name"),
    ],
)
def test_a_wrong_path_is_refused_before_the_work(base, here, monkeypatch, arguments, message):
    (base / "made" / "picture.png").mkdir(parents=True)
    monkeypatch.setattr("tgdsl.compiler.pipeline.compile_document", None)  # nothing may be compiled
    files_before = sorted(base.rglob("*"))
    code, _, error = here(base, *arguments)
    assert (code, error) == (2, f"tgdsl: {message.format(base=base)}\n")
    assert sorted(base.rglob("*")) == files_before


# Controls


def test_an_invalid_control_is_named_by_its_index(base, here):
    controls = np.zeros((5, 2, 1))
    controls[3, 1, 0] = np.nan
    controls[4] = np.inf
    np.savez(base / "c.npz", ctrl=controls)
    code, _, error = here(base, "run", "pad.yaml", "--controls", "c.npz", "--num-envs", "2")
    assert (code, error) == (2, "tgdsl: c.npz: `ctrl[3, 1, 0]` is nan, and 2 more: expected finite numbers\n")


def test_a_step_that_fails_is_named(base, here):
    controls = np.zeros((5, 2, 1))
    controls[3, 1] = 9e9  # on 0.25 kg: beyond the accelerations that MuJoCo accepts
    np.savez(base / "c.npz", ctrl=controls)
    code, _, error = here(base, "run", "pad.yaml", "--controls", "c.npz", "--num-envs", "2")
    assert code == 2
    assert error.startswith("tgdsl: control step 3 of 5: environments 1 diverged")
    assert not (base / "out").exists()


def test_readings_beyond_memory_are_refused(base, here):
    code, _, error = here(base, "run", "pad.yaml", "--num-envs", "1000", "--seconds", "1e5")
    assert code == 2
    assert error.startswith("tgdsl: readings of 1000 environments at 10000000 steps need about ")
    code, _, error = here(base, "run", "pad.yaml", "--seconds", "1e12")
    assert code == 2
    assert error.startswith("tgdsl: controls of 100000000000000 steps need about ")
