"""The scene that an artefact carries, compiled again."""

from __future__ import annotations

import hashlib
from pathlib import Path

import mujoco

from tgdsl.errors import ArtifactError
from tgdsl.plan import Asset, SceneFile
from tgdsl.schema.files import robots_folder


def scene_model(scene: SceneFile) -> mujoco.MjModel:
    """Return the compiled model of a scene.

    Raises:
        ArtifactError: If an asset is missing or is not the one that the scene was compiled with.
    """
    spec = mujoco.MjSpec.from_string(scene.mjcf, assets={asset.key: _content(asset) for asset in scene.assets})
    return spec.compile()


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
