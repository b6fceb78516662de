"""Objects with geoms of their own: new bodies of the scene, variants as geoms of it, and places that the variants share."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco

from tgdsl.errors import RobotError
from tgdsl.files.find import is_file
from tgdsl.formats.model import Model
from tgdsl.plan.scene import Asset, SceneGeom, SceneObject
from tgdsl.quantities.bake import aligned
from tgdsl.scene.mujoco_warnings import muted_mujoco, told_of
from tgdsl.scene.scene import Choice, geom_name, placeholder_name, portable, readable, with_choices
from tgdsl.schema.objects import MeshGeom, ObjectSpec, PrimitiveGeom

Report = Callable[[tuple[str | int, ...], str, str], None]
"""Called with the place of a mistake below the object, what it is, and a hint."""


@dataclass
class Meshes:
    """Mesh files that variants name, by the keys that the scene has for them."""

    assets: dict[str, Asset] = field(default_factory=dict)
    contents: dict[str, bytes] = field(default_factory=dict)

    def add(self, path: Path) -> str:
        """Read a file and return its key."""
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        key = f"{digest[:32]}{path.suffix.lower()}"
        self.assets[key], self.contents[key] = Asset(key, portable(path), digest), content
        return key


@dataclass(frozen=True)
class NewBody:
    """A body that the scene is given."""

    name: str  # its name
    pos: tuple[float, float, float]  # where it starts, in the world [m]
    quat: tuple[float, float, float, float]  # how it is turned there, w, x, y, z
    is_free: bool  # whether it moves freely, or is fixed to the world
    group: int = 0  # of its geoms: one that weighs, where the scene's compiler takes all inertias from geoms
    contype: int = 1  # muJoCo's bits of its geoms
    conaffinity: int = 1  # the same

    @property
    def geom(self) -> dict[str, tuple[Any, ...]]:
        """Fields of its placeholder, which its geoms inherit: MuJoCo's own values, not those of the scene's `<default>`."""
        return PLAIN | {"contype": (self.contype,), "conaffinity": (self.conaffinity,), "group": (self.group,)}


WATER = 1000.0  # muJoCo's density of geoms [kg/m³]
PLACEHOLDER = 0.01  # radius of the ball that a new body has until it is given its own geoms [m]
PLAIN: dict[str, tuple[float, ...]] = {
    "condim": (3,),
    "priority": (0,),
    "friction": (1, 0.005, 0.0001),
    "solmix": (1,),
    "solref": (0.02, 1),
    "solimp": (0.9, 0.95, 0.001, 0.5, 2),
    "margin": (0,),
    "gap": (0,),
    "rgba": (0.5, 0.5, 0.5, 1),
}
"""MuJoCo's own contact parameters: those of a scene's `<default>` are for the scene's geoms."""
INERTIAL = {"pos": (0.0, 0.0, 0.0), "mass": (1.0,), "diaginertia": (1.0, 1.0, 1.0)}
"""Of a body until it has its own geoms, so that it compiles whatever the scene's compiler makes of inertias."""


def with_bodies(scene: Model, bodies: Sequence[NewBody]) -> Model:
    """Return a scene with new bodies after all of its own; in its keyframes they are where they start.

    Raises:
        RobotError: If MuJoCo cannot compile it.
    """
    if not bodies:
        return scene
    spec = scene.spec.copy()
    for new in bodies:
        body = spec.worldbody.add_body(name=new.name, pos=new.pos, quat=new.quat)
        body.explicitinertial, body.mass, body.inertia, body.ipos = True, 1.0, [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]
        geom = body.add_geom(name=placeholder_name(new.name), type=mujoco.mjtGeom.mjGEOM_SPHERE)
        for name, value in new.geom.items():
            setattr(geom, name, value if len(value) > 1 else next(iter(value)))
        geom.size, geom.density = [PLACEHOLDER, 0, 0], WATER
        if new.is_free:
            body.add_freejoint().align = mujoco.mjtAlignFree.mjALIGNFREE_FALSE
    for key in spec.keys:
        if len(key.qpos):
            key.qpos = [*key.qpos, *start_qpos(bodies)]
    try:
        with muted_mujoco():
            return replace(scene, spec=spec, compiled=spec.compile())
    except ValueError as error:
        raise RobotError(f"{scene.file}: {' '.join(str(error).split())}") from error


def start_qpos(bodies: Sequence[NewBody]) -> list[float]:
    """Return what new bodies add to `qpos` where they start."""
    return [value for new in bodies if new.is_free for value in (*new.pos, *new.quat)]


def as_worldbody(bodies: Sequence[NewBody]) -> ET.Element:
    """Return new bodies as MJCF."""
    world = ET.Element("worldbody")
    for new in bodies:
        place = {"pos": " ".join(map(repr, new.pos)), "quat": " ".join(map(repr, new.quat))}
        body = ET.SubElement(world, "body", {"name": new.name, **place})
        if new.is_free:
            ET.SubElement(body, "freejoint", {"align": "false"})
        ET.SubElement(body, "inertial", {name: " ".join(map(repr, value)) for name, value in INERTIAL.items()})
        numbers = new.geom | {"size": (PLACEHOLDER, 0, 0), "density": (WATER,)}
        attributes = {name: " ".join(map(repr, value)) for name, value in numbers.items()}
        ET.SubElement(body, "geom", {"name": placeholder_name(new.name), "type": "sphere"} | attributes)
    return world


@dataclass
class OwnObjects:
    """Objects with geoms or sizes of their own: the new bodies among them, what they are like, and their mesh files."""

    bodies: tuple[NewBody, ...] = ()
    objects: tuple[SceneObject, ...] = ()
    meshes: Meshes = field(default_factory=Meshes)


def scene_object(name: str, target: ObjectSpec, folder: Path, meshes: Meshes, report: Report) -> SceneObject:
    """Return an object's variants as geoms of the scene; mesh files are looked up from the document's folder."""
    compounds = target.compounds
    types, tables = aligned([[geom.type if isinstance(geom, PrimitiveGeom) else "mesh" for geom in c] for c in compounds])

    def place(v: int) -> tuple[str | int, ...]:
        return ("geom",) if target.geom is not None else ("variants", v)

    variants = []
    for v, (compound, table) in enumerate(zip(compounds, tables, strict=True)):
        geoms = [_scene_geom(geom, folder, meshes, lambda what, v=v: report(place(v), what, "")) for geom in compound]
        variants.append(tuple(None if i is None else geoms[i] for i in table))
    return SceneObject(name, target.body_of(name), types, tuple(variants), target.size == "per_env")


def _scene_geom(
    geom: PrimitiveGeom | MeshGeom, folder: Path, meshes: Meshes, report: Callable[[str], None]
) -> SceneGeom | None:
    if isinstance(geom, PrimitiveGeom):
        return SceneGeom(geom.size, geom.pos, geom.quat, geom.density, "", 1.0)
    path = (folder / geom.mesh).resolve()
    if not is_file(path):
        report(f'there is no file "{geom.mesh}"')
        return None
    key = meshes.add(path)
    trial = mujoco.MjSpec()
    trial.assets = {key: readable(key, meshes.contents[key])}
    trial.add_mesh(name=path.stem, file=key)
    try:
        with told_of(path):
            trial.compile()
    except ValueError as error:
        report(f'MuJoCo cannot read mesh file "{geom.mesh}": {" ".join(str(error).split()).replace(key, path.name)}')
        return None
    return SceneGeom((), geom.pos, geom.quat, geom.density, key, geom.scale)


def variant_scenes(scene: Model, target: SceneObject, contents: Mapping[str, bytes]) -> list[tuple[Model, tuple[str, ...]]]:
    """Return the scene with each variant of an object, and the names of the geoms that the variant has.

    Raises:
        RobotError: If MuJoCo cannot compile it.
    """
    results = []
    for variant, geoms in enumerate(target.variants):
        spec = scene.spec.copy()
        spec.assets = {**spec.assets, **{key: readable(key, content) for key, content in contents.items()}}
        try:
            with muted_mujoco():
                spec = with_choices(spec, [target], {target.name: Choice(variant)})
                model = replace(scene, spec=spec, compiled=spec.compile())
        except ValueError as error:
            message = " ".join(str(error).split())
            raise RobotError(f"{scene.file}: object {target.name}, variant {variant}: {message}") from error
        results.append((model, tuple(geom_name(target, i) for i, geom in enumerate(geoms) if geom is not None)))
    return results
