"""The wheel, built from the sdist, in an empty environment outside the clone: its robots and examples compile and run."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
DOCUMENT = """\
tgdsl: 1
robot: {model: xhand1}
objects:
  ball: {geom: {type: sphere, size: [15 mm], density: 600}, pos: [0.08, 0, 0.15]}
resolution: low
sensors:
  touch: {kind: contact_depth, links: tips, feels: [ball]}
"""
VERSIONS = ("3.11", "3.13")
MINUTES_TO_INSTALL = 6


def python_of(version: str) -> Path | None:
    """Return an interpreter of a version: this one, one on PATH that starts, or one of pyenv."""
    candidates = [sys.executable, shutil.which(f"python{version}"), *Path.home().glob(f".pyenv/versions/{version}*/bin/python")]
    for candidate in filter(None, candidates):
        asked = subprocess.run([candidate, "--version"], capture_output=True, text=True)
        if asked.returncode == 0 and asked.stdout.startswith(f"Python {version}."):
            return Path(candidate)
    return None


def skip_offline(ran: subprocess.CompletedProcess) -> None:
    """Skip the test where pip reached no index; fail it where pip failed otherwise."""
    if ran.returncode and "connection" in ran.stderr.lower():
        pytest.skip(f"pip reaches no index: {ran.stderr[-300:]}")
    assert ran.returncode == 0, ran.stderr[-2000:]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this clone's sdist."""
    folder = tmp_path_factory.mktemp("wheel")
    pip, python = [sys.executable, "-m", "pip"], {**os.environ, "PYTHONPATH": str(folder / "hatchling")}
    for command in (
        [*pip, "install", "--quiet", "--target", folder / "hatchling", "hatchling"],
        [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", folder],
    ):
        skip_offline(subprocess.run(command, cwd=REPOSITORY, env=python, capture_output=True, text=True))
    (sdist,) = folder.glob("*.tar.gz")
    built = [*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, sdist]
    skip_offline(subprocess.run(built, capture_output=True, text=True))
    return next(folder.glob("*.whl"))


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_a_robot_of_the_wheel_compiles_and_runs(wheel, version, tmp_path):
    python = python_of(version)
    if python is None:
        pytest.skip(f"there is no Python {version}")
    subprocess.run([python, "-m", "venv", tmp_path / "venv"], check=True, capture_output=True)
    commands = tmp_path / "venv" / "bin"
    pip = [commands / "pip", "install", "--quiet", "--no-compile", "-c", REPOSITORY / "constraints.txt", wheel]
    if sys.version.startswith(f"{version}.") and all(map(python_of, VERSIONS)):
        # The environment of the other version shows that the wheel's requirements are enough; this one shares the packages installed here.
        (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
        (site / "installed.pth").write_text(sysconfig.get_path("purelib"))
        pip[2:3] = ["--quiet", "--no-deps", "--force-reinstall"]
    try:
        installed = subprocess.run(pip, capture_output=True, text=True, timeout=60 * MINUTES_TO_INSTALL)
    except subprocess.TimeoutExpired:
        pytest.skip(f"torch and the rest were not installed for Python {version} in {MINUTES_TO_INSTALL} minutes")
    skip_offline(installed)

    (tmp_path / "hand.yaml").write_text(DOCUMENT)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    for arguments in (
        ["run", "hand.yaml", "--seconds", "0.05"],
        ["examples", "list"],
        ["examples", "copy", "xhand1_palm", "tasks/find_ridge"],
        ["compile", "examples/xhand1_palm.yaml"],
        ["play", "examples/tasks/find_ridge.yaml", "--policy", "policies/find_ridge.pt", "--seconds", "0.1", "--no-video"],
    ):
        ran = subprocess.run([commands / "tgdsl", *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "out" / "readings.npz").is_file() and (tmp_path / "out" / "picture.png").is_file()
    where = subprocess.run(
        [commands / "python", "-c", "import tgdsl; print(tgdsl.__file__)"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert where.stdout.startswith(str(tmp_path))
    shutil.rmtree(tmp_path / "venv")  # some gigabytes
