"""Files that an artefact names: paths are checked before any file is opened, because artefacts are untrusted input.

An artefact's scene is text for MuJoCo, which opens every file that a text names. So the text may name only the artefact's
parts and assets. An asset's path is absolute or below the folder of tgdsl's robots, without `..`, and has the ending of a
mesh, a texture, a height field or a skin.
"""

from __future__ import annotations

import os
import re
import stat
import xml.etree.ElementTree as ET
from pathlib import Path

from tgdsl.errors import ArtifactError, listed
from tgdsl.plan.scene import Asset, SceneFile

ROBOTS = "robots:"  # how the place of a file begins that comes with tgdsl
ENDINGS = (".stl", ".obj", ".msh", ".png", ".ktx", ".skn", ".bin")
"""Endings of the files that a scene may name; `.bin`: a height field's own numbers."""
FOLDER_ATTRIBUTES = ("assetdir", "meshdir", "texturedir")  # attributes of `<compiler>` that say in which folder assets lie
_KEY = re.compile(r"[0-9a-f]{32}(\.\w+)")
_ABSOLUTE = re.compile(r"/|[A-Za-z]:/")


def check_scene(scene: SceneFile) -> None:
    """Refuse a scene that names files in places where an artefact's files cannot be; nothing is opened.

    Raises:
        ArtifactError: With the place.
    """
    for asset in scene.assets:
        _check_key(asset.key, ENDINGS)
        if wrong := _wrong_path(asset.path):
            raise ArtifactError(f'asset "{asset.path}" {wrong}')
    for key in scene.parts:
        _check_key(key, (".xml",))
    assets = {asset.key for asset in scene.assets}
    for text in (scene.mjcf, *scene.parts.values()):
        _check_text(text, {*scene.parts}, assets)
    for target in scene.objects:
        for geom in (geom for variant in target.variants for geom in variant if geom is not None and geom.mesh):
            if geom.mesh not in assets:
                raise ArtifactError(
                    f'object "{target.name}" names the file "{geom.mesh}", which is none of the scene\'s assets'
                )


def resolve_asset(asset: Asset, robots: Path) -> Path:
    """Return where an asset is, a file that is in its place itself and not by a link."""
    inside = asset.path.removeprefix(ROBOTS)
    is_own = inside != asset.path
    path = robots.resolve() / inside if is_own else Path(asset.path)
    real = Path(os.path.realpath(path))
    if not path.is_absolute() or (is_own and not real.is_relative_to(robots.resolve())):
        raise ArtifactError(f'asset "{asset.path}" of the scene is no place on this machine; compile again')
    if real != path:
        raise ArtifactError(f"asset {path} of the scene is a link to {real}; compile again")
    if not stat.S_ISREG(path.stat().st_mode):
        raise ArtifactError(f"asset {path} of the scene is not a file; compile again")
    return path


def _check_key(key: str, endings: tuple[str, ...]) -> None:
    match = _KEY.fullmatch(key)
    if match is None or match[1] not in endings:
        raise ArtifactError(f'the scene has a file by the name "{key}", expected a hash with the ending {listed(endings)}')


def _wrong_path(path: str) -> str:
    """Return why a path cannot be an asset's, or nothing."""
    inside = path.removeprefix(ROBOTS)
    is_own = inside != path
    if "\\" in path or "\0" in path:
        return "is not a path with / between its parts"
    if is_own == bool(_ABSOLUTE.match(inside)):
        return f"is not below {ROBOTS}" if is_own else f"is not an absolute path, nor one below {ROBOTS}"
    if {"", ".", ".."} & {*inside.removeprefix("/").split("/")}:
        return "leads out of its folder" if ".." in inside.split("/") else "is not a plain path"
    if Path(inside).suffix.lower() not in ENDINGS:
        return f"is not a mesh, texture, height field or skin; their endings are {listed(ENDINGS)}"
    return ""


def _check_text(text: str, parts: set[str], assets: set[str]) -> None:
    """Refuse a text that names files which the artefact does not list."""
    if "<!DOCTYPE" in text:
        raise ArtifactError("the scene's text has a DOCTYPE, which MJCF has not")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise ArtifactError(f"the scene's text is not XML: {error}") from error
    for element in root.iter():
        keys = parts if element.tag in ("include", "model") else assets
        for name, value in element.attrib.items():
            if name.startswith("file") and value not in keys:
                raise ArtifactError(f'the scene\'s text names the file "{value}", which the artefact does not list')
            if name in FOLDER_ATTRIBUTES:
                raise ArtifactError(f"the scene's text names the folder \"{value}\"; an artefact's files have none")
