"""The state of an installation: packages, devices, compilers and caches, and the consequences of missing parts.

Imports are avoided: a package is detected by its metadata, a compiler by its program.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from packaging.requirements import Requirement
from packaging.version import Version

from tgdsl.console.tables import text_table
from tgdsl.errors import TgdslError
from tgdsl.files import cache

Level = Literal["fault", "slower", "missing", "note"]
"""`fault`: an installed package computes wrongly or refuses to work; `slower`: the same readings take longer; `missing`: a
feature is unavailable; `note`: no action is needed."""

DEVELOPMENT = ("dev", "docs")  # the extras that only tgdsl's own development needs

WITHOUT: Mapping[str, tuple[Level, str]] = {
    "gymnasium": ("missing", "no vector environments of gymnasium: TouchEnv and rsl_rl's adapter remain"),
    "imageio-ffmpeg": ("missing", "`tgdsl play --video` is refused"),
    "mcap": ("missing", "`tgdsl export-dataset --to mcap` is refused"),
    "mujoco-warp": ("missing", 'physics on a GPU is refused: `tgdsl.simulate(device="cuda")`; MuJoCo on the CPU remains'),
    "onnx": ("missing", "`tgdsl export --to onnx` is refused"),
    "onnxruntime": ("missing", "`tgdsl verify` is refused for ONNX files"),
    "onnxscript": ("missing", "`tgdsl export --to onnx` is refused"),
    "pandas": ("missing", "`tgdsl export-dataset --to lerobot` is refused"),
    "pyarrow": ("missing", "`tgdsl export-dataset --to lerobot` is refused"),
    "pycollada": ("missing", "Collada meshes (.dae) of URDF files are refused"),
    "pyserial": ("missing", "a real hand cannot be connected; its emulator and logs remain"),
    "ray": ("missing", "`tgdsl sweep` is refused; single runs remain"),
    "rsl-rl-lib": ("missing", "`tgdsl train` is refused; environments remain"),
    "soundfile": ("missing", "`tgdsl listen` is refused"),
    "tensordict": ("missing", "`tgdsl train` and the adapter for rsl_rl are refused"),
    "triton": ("slower", "on a GPU, torch's operations stand in for the kernels written in Triton; a CPU needs none"),
    "viser": ("missing", "`tgdsl view` and `tgdsl.show` are refused"),
    "warp-lang": ("missing", "`query: raycast` is refused; analytic shapes and distance grids remain"),
    "zarr": ("missing", "`tgdsl export-dataset --to zarr` is refused"),
}
"""Consequences of a missing optional package."""
CPP = "C++, for modules on a CPU"
OPENGL = ("glfw", "egl", "osmesa") if sys.platform == "linux" else ("glfw",)
"""Values of `MUJOCO_GL`: the first, MuJoCo's default, needs a display; on other systems there is no other."""
_DRAW = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"


@dataclass(frozen=True)
class Package:
    """A package that tgdsl uses."""

    name: str  # its name
    installed: str | None  # the installed version; None: not installed
    wanted: str  # the versions that tgdsl works with, as pip writes them
    extra: str  # the extra that installs it, as in `pip install "tgdsl[gpu]"`; empty: always installed

    @property
    def fits(self) -> bool:
        """Whether the installed version is among the wanted ones; True without the package."""
        return self.installed is None or Requirement(f"x{self.wanted}").specifier.contains(self.installed, prereleases=True)


@dataclass(frozen=True)
class Finding:
    """Something that a user should know."""

    level: Level  # how bad it is
    what: str  # the result, in words
    then: str  # the consequence, or what to do


@dataclass(frozen=True)
class Installation:
    """The state of an installation."""

    system: Mapping[str, str]  # python, operating system, processor, by name
    packages: tuple[Package, ...]  # the packages that tgdsl uses
    devices: Mapping[str, str]  # devices for modules, with torch's description
    compilers: Mapping[str, str | None]  # place or version of each compiler of kernels; None: there is none
    opengl: Mapping[str, bool]  # whether each value of `MUJOCO_GL` draws
    # cache folders and their sizes [bytes]; None: there is no such folder
    caches: Mapping[str, int | None]
    findings: tuple[Finding, ...]  # findings, the worst first

    @property
    def is_sound(self) -> bool:
        """Whether no finding is a fault."""
        return all(finding.level != "fault" for finding in self.findings)

    def __str__(self) -> str:
        width = max(map(len, self.system))
        draws = {name: "draws" if is_drawn else "does not draw" for name, is_drawn in self.opengl.items()}
        sizes = {name: "none yet" if size is None else f"{size / 2**20:.1f} MiB" for name, size in self.caches.items()}
        packages = [(p.name, p.installed or "–", p.wanted or "any", p.extra) for p in self.packages]
        return "\n\n".join(
            [
                "\n".join(f"{name.ljust(width)}  {value}" for name, value in self.system.items()),
                text_table(("package", "installed", "wanted", "extra"), packages),
                text_table(("device", ""), self.devices.items()),
                text_table(("compiler", ""), [(name, place or "none") for name, place in self.compilers.items()]),
                text_table(("MUJOCO_GL", ""), draws.items()),
                text_table(("cache", ""), sizes.items()),
                "\n".join(f"{finding.level}: {finding.what}: {finding.then}" for finding in self.findings),
            ]
        )


def examine() -> Installation:
    """Examine this installation; raise `TgdslError` if tgdsl is not installed: its metadata lists the wanted packages."""
    used, places, drawn_by = packages(), devices(), opengl()
    compiled_by = compilers(used)
    return Installation(system(), used, places, compiled_by, drawn_by, caches(), findings(used, compiled_by, places, drawn_by))


def system() -> dict[str, str]:
    """Return the versions of tgdsl, Python and the operating system, and the number of processors."""
    return {
        "tgdsl": importlib.metadata.version("tgdsl"),
        "Python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "processors": str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()),
    }


def packages(requirements: Sequence[str] | None = None) -> tuple[Package, ...]:
    """Return the packages that tgdsl uses, without those for its development only.

    `requirements` are as in the metadata of a package; default: tgdsl's.
    """
    if requirements is None:
        try:
            requirements = importlib.metadata.requires("tgdsl") or []
        except importlib.metadata.PackageNotFoundError as error:
            raise TgdslError("tgdsl is not installed, it is only imported: pip install -e .") from error
    result: dict[str, Package] = {}
    for text in requirements:
        requirement = Requirement(text)
        marker = str(requirement.marker or "")
        extra = match[1] if (match := re.search(r'extra == "(\w+)"', marker)) else ""
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = requirement.name.lower().replace("_", "-").replace(".", "-")
        if extra in DEVELOPMENT and name not in WITHOUT:
            continue
        if name not in result or result[name].extra in DEVELOPMENT:
            result[name] = Package(name, installed_version(name), str(requirement.specifier), extra)
    return tuple(sorted(result.values(), key=lambda package: (package.extra != "", package.name)))


def installed_version(name: str) -> str | None:
    """Return the version of a package; None if it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def devices() -> dict[str, str]:
    """Return the devices for modules, by torch's name."""
    import torch

    places = {"cpu": f"{torch.get_num_threads()} threads"}
    for i in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(i)
        places[f"cuda:{i}"] = f"{gpu.name}, {gpu.total_memory / 2**30:.0f} GiB, compute capability {gpu.major}.{gpu.minor}"
    return places


def compilers(known: Sequence[Package]) -> dict[str, str | None]:
    """Return the compilers of kernels."""
    from tgdsl.module.calls import cpp_compiler

    versions = {package.name: package.installed for package in known}
    return {
        CPP: cpp_compiler(),
        "Triton, for modules on a GPU": versions.get("triton"),
        "Warp, for physics on a GPU": versions.get("warp-lang"),
    }


def opengl() -> dict[str, bool]:
    """Return whether each value of `MUJOCO_GL` draws, tried in separate processes: MuJoCo reads the value once."""
    tried = {
        name: subprocess.Popen([sys.executable, "-c", _DRAW], env=os.environ | {"MUJOCO_GL": name}, stderr=subprocess.DEVNULL)
        for name in OPENGL
    }
    return {name: process.wait() == 0 for name, process in tried.items()}


def caches() -> dict[str, int | None]:
    """Return the cache folders and their sizes [bytes]."""
    from tgdsl.tensors.torch_internals import inductor_cache

    sizes: dict[str, int | None] = {str(cache.folder()): sum(entry.size for entry in cache.entries())}
    shared = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    warp = Path(os.environ.get("WARP_CACHE_PATH") or Path(shared) / "warp")  # it has a folder for each version
    for folder in (inductor_cache(), warp):
        sizes[str(folder)] = folder_size(folder) if folder.is_dir() else None
    return sizes


def folder_size(folder: Path) -> int:
    """Return the size of all files below a folder [bytes]."""
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file() and not file.is_symlink())


def findings(
    known: Sequence[Package], compiled_by: Mapping[str, str | None], places: Mapping[str, str], drawn_by: Mapping[str, bool]
) -> tuple[Finding, ...]:
    """Return findings on packages, compilers, devices and OpenGL, the worst first."""
    has_gpu = any(name.startswith("cuda") for name in places)
    results = [finding for package in known if (finding := _of_package(package, has_gpu))] + _known_faults(known)
    if compiled_by[CPP] is None:
        then = "`module.compile()` on a CPU leaves it eager"
        results.append(Finding("slower", "no C++ compiler (g++, clang++ or $CXX)", then))
    if not has_gpu:
        then = "everything runs on the CPU; `python -m torch.utils.collect_env` says more"
        results.append(Finding("note", "torch sees no GPU", then))
    setting = os.environ.get("MUJOCO_GL", OPENGL[0])
    if not drawn_by.get(setting, True):
        drawing = [f"MUJOCO_GL={name}" for name, draws in drawn_by.items() if draws]
        then = f"set {drawing[0]}" if drawing else "install libegl1 or libosmesa6; pictures of `tgdsl run` need none"
        results.append(Finding("missing", f"no OpenGL by MUJOCO_GL={setting}: `tgdsl play --video` is refused", then))
    return tuple(sorted(results, key=lambda finding: get_args(Level).index(finding.level)))


def _of_package(package: Package, has_gpu: bool) -> Finding | None:
    """Return the finding on a package that is missing or has a wrong version."""
    name, install = package.name, f'pip install "{package.name}{package.wanted}"'
    if not package.fits:
        return Finding("fault", f"{name} is {package.installed}, expected {package.wanted}", install)
    if package.installed is not None:
        return None
    if not package.extra:
        return Finding("fault", f"{name} is not installed, and tgdsl cannot do without it", install)
    if name not in WITHOUT or (name == "triton" and not has_gpu):
        return None
    level, then = WITHOUT[name]
    target = name if package.extra in DEVELOPMENT else f'"tgdsl[{package.extra}]"'
    return Finding(level, f"{name} is not installed", f"{then} (pip install {target})")


def _known_faults(known: Sequence[Package]) -> list[Finding]:
    """Return known faults of installed versions that tgdsl's requirements allow."""
    versions = {package.name: package.installed for package in known}
    results = []
    mujoco, warp, torch = (versions.get(name) for name in ("mujoco", "mujoco-warp", "torch"))
    if mujoco and Version(mujoco) == Version("4.0.0"):
        problem = "MuJoCo 4.0.0 has a fault in its solver where Jacobians are sparse"
        results.append(Finding("fault", problem, "forces are wrong there: take another version"))
    if mujoco and warp and Version(mujoco).release[:2] != Version(warp).release[:2]:
        problem = f"MuJoCo {mujoco} with MuJoCo Warp {warp}"
        results.append(Finding("fault", problem, "their models differ between such versions: take the same of both"))
    if torch and Version(torch) >= Version("2.11"):
        problem = f"torch {torch} compiles a copy wrongly whose source is changed after it (pytorch#198131)"
        results.append(Finding("note", problem, "tgdsl compiles no such copy; avoid them in your own steps"))
    return results
