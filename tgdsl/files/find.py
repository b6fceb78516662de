"""Paths of files that a document names, and of the robots and examples that come with tgdsl."""

from __future__ import annotations

import os
from pathlib import Path

import tgdsl
from tgdsl.errors import TgdslError, did_you_mean

_PACKAGE = Path(tgdsl.__file__).parent


def is_file(path: Path) -> bool:
    """Return whether there is such a file; unlike `Path.is_file`, False for names that no file can have."""
    return os.path.isfile(path)


def shared_folder() -> Path:
    """Return the folder that has `robots`, `examples` and `policies`: in the installed package, or the top of a checkout."""
    installed = _PACKAGE / "_shared"
    return installed if installed.is_dir() else _PACKAGE.parent


def robots_folder() -> Path:
    """Return the folder of the robots that come with tgdsl."""
    return shared_folder() / "robots"


def robot_names() -> dict[str, Path]:
    """Return the model file of each robot known by name; a folder's own name means its right hand."""
    names: dict[str, Path] = {}
    for folder in sorted(path for path in robots_folder().iterdir() if path.is_dir()):
        for model in sorted(folder.glob("*.xml")):
            names[model.stem] = model
        if (folder / f"{folder.name}_right.xml").is_file():
            names.setdefault(folder.name, folder / f"{folder.name}_right.xml")
    return names


def robot_file(model: str, folder: Path) -> Path | None:
    """Return the file of a robot given by name or by a path relative to the document's folder; None if there is none."""
    if model in (names := robot_names()):
        return names[model]
    path = folder / model
    return path if is_file(path) else None


def robot_path(robot: str) -> Path:
    """Return the file of a robot given by its path, or by the name of one that comes with tgdsl.

    Raises:
        TgdslError: If there is neither.
    """
    path = robot_file(robot, Path())
    if path is None:
        raise TgdslError(f'there is no file or robot "{robot}"; {did_you_mean(robot, robot_names(), "robots")}')
    return path


def layout_file(model: Path) -> Path | None:
    """Return the layout next to a model file: for `hand/hand_left.xml`, `layout_left.yaml` or else `layout.yaml`."""
    return _next_to(model, "layout")


def colliders_file(model: Path) -> Path | None:
    """Return the colliders next to a model file: for `hand/hand_left.xml`, `colliders_left.yaml` or else `colliders.yaml`."""
    return _next_to(model, "colliders")


def _next_to(model: Path, name: str) -> Path | None:
    side = model.stem.removeprefix(f"{model.parent.name}_")
    names = (f"{name}_{side}.yaml", f"{name}.yaml")
    return next((model.parent / name for name in names if (model.parent / name).is_file()), None)


def layout_of(robot: str) -> Path | None:
    """Return the layout next to a robot's file; the robot is given by name or by its file."""
    model = robot_file(robot, Path())
    return None if model is None else layout_file(model)
