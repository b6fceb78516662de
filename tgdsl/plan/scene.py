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
    """A geom that an object has in some environments.

    Attributes:
        size: Its size as MuJoCo defines it [m]; nothing for a mesh.
        pos: Its frame's origin in the body's frame [m].
        quat: Its orientation there, w, x, y, z.
        density: Its density [kg/m³].
        mesh: Key of its mesh's asset, or nothing.
        scale: Factor from the mesh file's unit to metres.
    """

    size: tuple[float, ...]
    pos: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    density: float
    mesh: str
    scale: float


@dataclass(frozen=True)
class SceneObject:
    """An object whose geometry differs between environments.

    Attributes:
        name: Its name in the document.
        body: Its body in the scene.
        types: MuJoCo's types of the geoms that it has instead of the scene's own; none if only its size differs.
        variants: Which of these geoms each variant has, and how; None where it lacks one.
        is_sized: Whether the size of its geom is chosen per environment.
        others: Bodies that are other objects: they keep their geoms where they are welded to its body.
    """

    name: str
    body: str
    types: tuple[str, ...]
    variants: tuple[tuple[SceneGeom | None, ...], ...]
    is_sized: bool
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class Collider:
    """A primitive that a link of the robot collides with instead of the scene's geoms.

    Attributes:
        body: The link's body in the scene.
        type: MuJoCo's type.
        size: Its size as MuJoCo defines it [m].
        pos: Its frame's origin in the body's frame [m].
        quat: Its orientation there, w, x, y, z.
        is_core: Whether links that have colliders meet it too; the others meet what is no such link alone.
    """

    body: str
    type: str
    size: tuple[float, ...]
    pos: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    is_core: bool


@dataclass(frozen=True)
class SceneFile:
    """The instrumented scene, as text, for whoever simulates it.

    Attributes:
        mjcf: The scene as MJCF, with the contact sensors that the module wants.
        parts: The MJCF files that it includes or attaches, by the names it has for them.
        assets: The meshes, textures and other files that they or the objects name.
        objects: Objects that differ between environments.
        colliders: What links collide with instead of their geoms: see `scene.colliders`.
    """

    mjcf: str
    parts: Mapping[str, str]
    assets: tuple[Asset, ...]
    objects: tuple[SceneObject, ...] = ()
    colliders: tuple[Collider, ...] = ()
