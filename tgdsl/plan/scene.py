"""The instrumented scene, as an artefact carries it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Asset:
    """A file that the scene needs: its name in the MJCF, its path, and its bytes."""

    key: str
    path: str
    sha256: str


@dataclass(frozen=True)
class SceneGeom:
    """A geom that an object has in some environments."""

    size: tuple[float, ...]  # its size as MuJoCo defines it [m]; nothing for a mesh
    pos: tuple[float, float, float]  # its frame's origin in the body's frame [m]
    quat: tuple[float, float, float, float]  # its orientation there, w, x, y, z
    density: float  # its density [kg/m³]
    mesh: str  # key of its mesh's asset, or nothing
    scale: float  # factor from the mesh file's unit to metres


@dataclass(frozen=True)
class SceneObject:
    """An object whose geometry differs between environments."""

    name: str  # its name in the document
    body: str  # its body in the scene
    types: tuple[str, ...]  # MuJoCo's types of the geoms that it has instead of the scene's own; none if only its size differs
    variants: tuple[tuple[SceneGeom | None, ...], ...]  # the geoms of each variant; None where it lacks one
    is_sized: bool  # whether the size of its geom is chosen per environment
    others: tuple[str, ...] = ()  # bodies that are other objects: they keep their geoms where they are welded to its body


@dataclass(frozen=True)
class Collider:
    """A primitive that a link of the robot collides with instead of the scene's geoms."""

    body: str  # the link's body in the scene
    type: str  # MuJoCo's type
    size: tuple[float, ...]  # its size as MuJoCo defines it [m]
    pos: tuple[float, float, float]  # its frame's origin in the body's frame [m]
    quat: tuple[float, float, float, float]  # its orientation there, w, x, y, z
    is_core: bool  # whether it also collides with links that have colliders; the others do not


@dataclass(frozen=True)
class SceneFile:
    """The instrumented scene, as text, for whoever simulates it."""

    mjcf: str  # the scene as MJCF, with the contact sensors that the module wants
    parts: Mapping[str, str]  # the MJCF files that it includes or attaches, by the names it has for them
    assets: tuple[Asset, ...]  # the meshes, textures and other files that they or the objects name
    objects: tuple[SceneObject, ...] = ()  # objects that differ between environments
    colliders: tuple[Collider, ...] = ()  # what links collide with instead of their geoms: see `scene.colliders`
