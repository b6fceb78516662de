"""Scenes as an artefact carries them, compiled by MuJoCo: what both the compiler and the simulators need of it."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import mujoco

from tgdsl.errors import ArtifactError
from tgdsl.plan import Asset, SceneFile
from tgdsl.schema.files import robots_folder


@contextmanager
def muted_mujoco() -> Iterator[None]:
    """Turn what MuJoCo would print and log while it reads a model into Python warnings.

    One is left out: a robot attached under its own names, with no prefix, is just what a scene of ours wants, and scenes are
    never saved by MuJoCo, which is what it warns of.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: warnings.warn(f"MuJoCo: {message}", stacklevel=2))
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*Attaching a spec with an empty prefix")
            yield
    finally:
        mujoco.set_mju_user_warning(before)


def compiled(scene: SceneFile, assets: Mapping[str, bytes]) -> mujoco.MjModel:
    """Compile a scene whose assets' contents are at hand."""
    with muted_mujoco():
        parts = {name: text.encode() for name, text in scene.parts.items()}
        return mujoco.MjSpec.from_string(scene.mjcf, include=parts, assets=dict(assets)).compile()


def scene_model(scene: SceneFile) -> mujoco.MjModel:
    """Return the compiled model of a scene, its assets read from where they were found.

    Raises:
        ArtifactError: If an asset is missing or is not the one that the scene was compiled with.
    """
    return compiled(scene, {asset.key: _content(asset) for asset in scene.assets})


def _content(asset: Asset) -> bytes:
    inside = asset.path.removeprefix("robots:")
    path = robots_folder() / inside if inside != asset.path else Path(asset.path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ArtifactError(f"asset {path} of the scene cannot be read: {error.strerror}; compile again") from error
    if hashlib.sha256(content).hexdigest() != asset.sha256:
        raise ArtifactError(f"asset {path} has changed since the scene was compiled; compile again")
    return content


def portable(path: Path) -> str:
    """Return a path as an artefact keeps it: `robots:` and the rest for a robot that comes with tgdsl, else absolute."""
    folder, path = robots_folder().resolve(), path.resolve()
    return f"robots:{path.relative_to(folder).as_posix()}" if path.is_relative_to(folder) else path.as_posix()
