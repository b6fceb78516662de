"""What is said of an installation, by versions written by hand."""

import importlib.metadata
import json
import os
import sys

import pytest
import torch
from packaging.requirements import Requirement

from tgdsl.commands.report import Doctor
from tgdsl.report import doctor
from tgdsl.report.doctor import CPP, DEVELOPMENT, WITHOUT, Package, examine, findings, folder_size, packages

FITTING = {
    "mujoco": "3.17.0",
    "mujoco-warp": "3.17.2",
    "numpy": "2.4.6",
    "torch": "2.10.0",
}
REQUIREMENTS = [
    "numpy>=2.0",
    "mujoco!=4.0.0,<5,>=3.17.0",
    "torch>=2.10",
    "mujoco-warp<3.18,>=3.17.0; extra == 'gpu'",
    "mujoco-warp<3.18,>=3.17.0; extra == 'dev'",
    "ruff>=0.11; extra == 'dev'",
    "triton>=3.6; sys_platform == 'nowhere' and extra == 'dev'",
]
COMPILERS = {CPP: "/usr/bin/g++"}


def known(monkeypatch, **versions):
    """The packages of REQUIREMENTS, in versions that fit or in others; None: not installed."""
    there = FITTING | {name.replace("_", "-"): version for name, version in versions.items()}

    def version(name):
        if there.get(name) is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return there[name]

    monkeypatch.setattr(importlib.metadata, "version", version)
    return packages(REQUIREMENTS)


def told(found, gpu=False):
    places = {"cpu": "", **({"cuda:0": ""} if gpu else {})}
    return {(each.level, each.what) for each in findings(found, COMPILERS, places, {}) if each.what != "torch sees no GPU"}


def test_packages_are_those_of_this_platform_and_not_of_tgdsls_own_development(monkeypatch):
    assert known(monkeypatch) == (
        Package("mujoco", "3.17.0", "!=4.0.0,<5,>=3.17.0", ""),
        Package("numpy", "2.4.6", ">=2.0", ""),
        Package("torch", "2.10.0", ">=2.10", ""),
        Package("mujoco-warp", "3.17.2", "<3.18,>=3.17.0", "gpu"),
    )
    assert told(known(monkeypatch)) == set()


def test_a_version_that_is_not_wanted_is_a_fault(monkeypatch):
    found = known(monkeypatch, numpy="1.26.4")
    assert told(found) == {("fault", "numpy is 1.26.4, expected >=2.0")}
    assert told(known(monkeypatch, torch=None)) == {("fault", "torch is not installed, and tgdsl cannot do without it")}


@pytest.mark.parametrize("version", ["4.0.0", "4.0.0.0"])
def test_mujoco_with_the_fault_in_its_solver_is_named(monkeypatch, version):
    assert ("fault", "MuJoCo 4.0.0 has a fault in its solver where Jacobians are sparse") in told(
        known(monkeypatch, mujoco=version, mujoco_warp=None)
    )


def test_a_simulator_beside_another_versions_models_is_a_fault(monkeypatch):
    assert told(known(monkeypatch, mujoco="3.18.1")) == {("fault", "MuJoCo 3.18.1 with MuJoCo Warp 3.17.2")}


def test_what_is_missing_says_what_cannot_be_done(monkeypatch):
    (finding,) = (f for f in findings(known(monkeypatch, mujoco_warp=None), COMPILERS, {"cpu": "", "cuda:0": ""}, {}))
    assert (finding.level, finding.what) == ("missing", "mujoco-warp is not installed")
    assert 'pip install "tgdsl[gpu]"' in finding.then


def test_triton_is_missed_where_there_is_a_gpu(monkeypatch):
    without = (Package("triton", None, ">=3.6", "dev"),)
    assert told(without) == set()
    assert told(without, gpu=True) == {("slower", "triton is not installed")}


def test_faults_are_told_first(monkeypatch):
    found = findings(known(monkeypatch, numpy="1.0", mujoco_warp=None, torch="2.13.0"), {CPP: None}, {"cpu": ""}, {})
    assert [finding.level for finding in found] == ["fault", "slower", "missing", "note", "note"]


def test_every_optional_package_of_ours_is_explained():
    """What the extras for users bring; those for development bring what only tests need."""
    own = {
        requirement.name.lower()
        for requirement in map(Requirement, importlib.metadata.requires("tgdsl") or ())
        if requirement.marker is not None and not any(f'"{extra}"' in str(requirement.marker) for extra in DEVELOPMENT)
    }
    assert own
    assert own <= WITHOUT.keys()


def test_this_installation(monkeypatch, tmp_path):
    """Caches are as large as their files; torch's and MuJoCo's versions are their own."""
    import mujoco

    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "own"))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "inductor"))
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "warp"))
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / f"{'0' * 64}.npz").write_bytes(b"12345")
    (tmp_path / "inductor" / "ab").mkdir(parents=True)
    (tmp_path / "inductor" / "ab" / "kernel.so").write_bytes(b"123")
    (tmp_path / "inductor" / "link.so").symlink_to("ab/kernel.so")
    found = examine()
    versions = {package.name: package.installed for package in found.packages}
    assert (versions["torch"], versions["mujoco"]) == (torch.__version__, mujoco.__version__)
    assert found.caches == {str(tmp_path / "own"): 5, str(tmp_path / "inductor"): 3, str(tmp_path / "warp"): None}
    assert folder_size(tmp_path) == 8
    assert found.devices["cpu"] == f"{torch.get_num_threads()} threads"
    assert len(found.devices) == 1 + torch.cuda.device_count()
    assert not found.opengl["glfw"] or "DISPLAY" in os.environ or sys.platform != "linux"


def test_the_command(monkeypatch, capsys):
    """A table, or JSON; exit code 1 at a fault alone."""
    sound = examine()
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(doctor, "examine", lambda: sound)
    Doctor(json=True).run()
    assert json.loads(capsys.readouterr().out)["system"]["tgdsl"] == importlib.metadata.version("tgdsl")
    broken = doctor.Installation(
        sound.system,
        (Package("numpy", "1.0", ">=2.0", ""),),
        {"cpu": ""},
        COMPILERS,
        {"egl": True},
        {"/nowhere": None},
        located_warnings(sound),
    )
    monkeypatch.setattr(doctor, "examine", lambda: broken)
    with pytest.raises(SystemExit) as stopped:
        Doctor().run()
    assert stopped.value.code == 1
    printed = capsys.readouterr().out
    assert "numpy    1.0        >=2.0" in printed and "/nowhere  none yet" in printed
    assert 'fault: numpy is 1.0, expected >=2.0: pip install "numpy>=2.0"\n' in printed
    assert "egl        draws" in printed
    assert "missing: no OpenGL by MUJOCO_GL=glfw: `tgdsl play --video` is refused: set MUJOCO_GL=egl\n" in printed


def located_warnings(sound):
    return findings((Package("numpy", "1.0", ">=2.0", ""),), COMPILERS, sound.devices, {"glfw": False, "egl": True})
