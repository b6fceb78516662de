"""Findings about an installation, from made-up versions."""

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


def installed_packages(monkeypatch, **versions):
    """Return the packages of REQUIREMENTS in fitting versions or in these; None: not installed."""
    installed = FITTING | {name.replace("_", "-"): version for name, version in versions.items()}

    def version(name):
        if installed.get(name) is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return installed[name]

    monkeypatch.setattr(importlib.metadata, "version", version)
    return packages(REQUIREMENTS)


def levels_and_texts(installed, gpu=False):
    devices = {"cpu": "", **({"cuda:0": ""} if gpu else {})}
    return {
        (finding.level, finding.what)
        for finding in findings(installed, COMPILERS, devices, {})
        if finding.what != "torch sees no GPU"
    }


def test_packages_of_other_platforms_and_of_development_are_left_out(monkeypatch):
    assert installed_packages(monkeypatch) == (
        Package("mujoco", "3.17.0", "!=4.0.0,<5,>=3.17.0", ""),
        Package("numpy", "2.4.6", ">=2.0", ""),
        Package("torch", "2.10.0", ">=2.10", ""),
        Package("mujoco-warp", "3.17.2", "<3.18,>=3.17.0", "gpu"),
    )
    assert levels_and_texts(installed_packages(monkeypatch)) == set()


def test_an_unsupported_version_is_a_fault(monkeypatch):
    installed = installed_packages(monkeypatch, numpy="1.26.4")
    assert levels_and_texts(installed) == {("fault", "numpy is 1.26.4, expected >=2.0")}
    assert levels_and_texts(installed_packages(monkeypatch, torch=None)) == {
        ("fault", "torch is not installed, and tgdsl cannot do without it")
    }


@pytest.mark.parametrize("version", ["4.0.0", "4.0.0.0"])
def test_mujoco_with_the_fault_in_its_solver_is_named(monkeypatch, version):
    assert ("fault", "MuJoCo 4.0.0 has a fault in its solver where Jacobians are sparse") in levels_and_texts(
        installed_packages(monkeypatch, mujoco=version, mujoco_warp=None)
    )


def test_versions_of_mujoco_and_mujoco_warp_must_match(monkeypatch):
    assert levels_and_texts(installed_packages(monkeypatch, mujoco="3.18.1")) == {
        ("fault", "MuJoCo 3.18.1 with MuJoCo Warp 3.17.2")
    }


def test_a_missing_package_names_its_extra(monkeypatch):
    (finding,) = (
        f for f in findings(installed_packages(monkeypatch, mujoco_warp=None), COMPILERS, {"cpu": "", "cuda:0": ""}, {})
    )
    assert (finding.level, finding.what) == ("missing", "mujoco-warp is not installed")
    assert 'pip install "tgdsl[gpu]"' in finding.then


def test_missing_triton_is_reported_with_a_gpu_only(monkeypatch):
    without = (Package("triton", None, ">=3.6", "dev"),)
    assert levels_and_texts(without) == set()
    assert levels_and_texts(without, gpu=True) == {("slower", "triton is not installed")}


def test_faults_come_first(monkeypatch):
    sorted_findings = findings(
        installed_packages(monkeypatch, numpy="1.0", mujoco_warp=None, torch="2.13.0"), {CPP: None}, {"cpu": ""}, {}
    )
    assert [finding.level for finding in sorted_findings] == ["fault", "slower", "missing", "note", "note"]


def test_every_optional_package_is_explained():
    """Extras for users only: those for development serve the tests."""
    optional = {
        requirement.name.lower()
        for requirement in map(Requirement, importlib.metadata.requires("tgdsl") or ())
        if requirement.marker is not None and not any(f'"{extra}"' in str(requirement.marker) for extra in DEVELOPMENT)
    }
    assert optional
    assert optional <= WITHOUT.keys()


def test_this_installation(monkeypatch, tmp_path):
    """Caches are as large as their files; versions are those that torch and MuJoCo report."""
    import mujoco

    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "own"))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "inductor"))
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "warp"))
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / f"{'0' * 64}.npz").write_bytes(b"12345")
    (tmp_path / "inductor" / "ab").mkdir(parents=True)
    (tmp_path / "inductor" / "ab" / "kernel.so").write_bytes(b"123")
    (tmp_path / "inductor" / "link.so").symlink_to("ab/kernel.so")
    installation = examine()
    versions = {package.name: package.installed for package in installation.packages}
    assert (versions["torch"], versions["mujoco"]) == (torch.__version__, mujoco.__version__)
    assert installation.caches == {str(tmp_path / "own"): 5, str(tmp_path / "inductor"): 3, str(tmp_path / "warp"): None}
    assert folder_size(tmp_path) == 8
    assert installation.devices["cpu"] == f"{torch.get_num_threads()} threads"
    assert len(installation.devices) == 1 + torch.cuda.device_count()
    assert not installation.opengl["glfw"] or "DISPLAY" in os.environ or sys.platform != "linux"


def test_the_command(monkeypatch, capsys):
    """A table or JSON; only faults exit with code 1."""
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
    with pytest.raises(SystemExit) as error:
        Doctor().run()
    assert error.value.code == 1
    output = capsys.readouterr().out
    assert "numpy    1.0        >=2.0" in output and "/nowhere  none yet" in output
    assert 'fault: numpy is 1.0, expected >=2.0: pip install "numpy>=2.0"\n' in output
    assert "egl        draws" in output
    assert "missing: no OpenGL by MUJOCO_GL=glfw: `tgdsl play --video` is refused: set MUJOCO_GL=egl\n" in output


def located_warnings(sound):
    return findings((Package("numpy", "1.0", ">=2.0", ""),), COMPILERS, sound.devices, {"glfw": False, "egl": True})
