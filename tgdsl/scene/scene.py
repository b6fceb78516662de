"""Scenes as an artefact carries them, compiled by MuJoCo: what both the compiler and the simulators need of it."""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from tgdsl.errors import ArtifactError, RobotError
from tgdsl.files.find import robots_folder
from tgdsl.plan.scene import Asset, SceneFile, SceneGeom, SceneObject
from tgdsl.scene.asset_paths import ROBOTS, resolve_asset
from tgdsl.scene.colliders import INHERITED, free_bit, with_colliders
from tgdsl.scene.mujoco_warnings import muted_mujoco
from tgdsl.scene.options import Options, set_options

FORCED, IF_NEEDED = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE, mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
WEIGHED = ("type", "size", "pos", "quat", "density", "mass", "meshname")  # what a geom's mass and inertia depend on


def weigh(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """Give a body the mass and inertia of all of its geoms: MuJoCo's own in a model with nothing else in it."""
    alone = mujoco.MjSpec()
    alone.assets = spec.assets
    copy = alone.worldbody.add_body()
    for name in sorted({geom.meshname for geom in body.geoms} - {""}):
        mesh = spec.mesh(name)
        alone.add_mesh(name=name, file=mesh.file, scale=mesh.scale, inertia=mesh.inertia)
    for geom in body.geoms:
        added = copy.add_geom()
        for attribute in WEIGHED:
            setattr(added, attribute, getattr(geom, attribute))
    with muted_mujoco():
        model = alone.compile()
    _set_inertial(body, model, 1)


def freeze(spec: mujoco.MjSpec, new: Set[str], weighed: Set[str]) -> None:
    """Give the scene's bodies the inertias that its compiler makes for them, and let it change none from then on."""
    compiler = spec.compiler
    total = compiler.settotalmass
    if not (compiler.boundmass or compiler.boundinertia or total > 0 or compiler.inertiafromgeom == FORCED):
        return
    with muted_mujoco():
        model = spec.compile()
    added = sum(float(model.body(name).mass[0]) for name in new)
    factor = total / (float(model.body_mass.sum()) - added) if total > 0 else 1.0
    for body in spec.bodies[1:]:
        if body.name not in weighed:
            _set_inertial(body, model, body.id, factor)
    compiler.boundmass, compiler.boundinertia, compiler.settotalmass = 0.0, 0.0, -1.0
    compiler.inertiafromgeom = IF_NEEDED


def _set_inertial(body: mujoco.MjsBody, model: mujoco.MjModel, id: int, factor: float = 1.0) -> None:
    """Give a body a compiled body's inertia, explicitly."""
    body.explicitinertial = True
    body.mass, body.inertia = float(model.body_mass[id]) * factor, model.body_inertia[id] * factor
    body.ipos, body.iquat = model.body_ipos[id], model.body_iquat[id]
    body.fullinertia = np.full(6, np.nan)
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


_STL_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_OBJ_NAME, _OBJ_FACE = re.compile(rb"^[ \t]*[og](?:[ \t].*)?$", re.MULTILINE), re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE)
OFF_CENTER = 2e-6  # distance [m] of a body's centre of mass from its origin at which MuJoCo takes it for off the origin


def compiled(scene: SceneFile, assets: Mapping[str, bytes]) -> mujoco.MjModel:
    with muted_mujoco():
        return _spec(scene, assets).compile()


def _spec(scene: SceneFile, assets: Mapping[str, bytes]) -> mujoco.MjSpec:
    parts = {name: text.encode() for name, text in scene.parts.items()}
    contents = {key: readable(key, content) for key, content in assets.items()}
    return with_colliders(mujoco.MjSpec.from_string(scene.mjcf, include=parts, assets=contents), scene.colliders)


def readable(name: str, content: bytes) -> bytes:
    """Return a file as MuJoCo reads it: text STL in binary, an OBJ file of several objects, or groups, as one; others as is."""
    if Path(name).suffix.lower() == ".obj":
        return _OBJ_NAME.sub(b"", content) if num_objects(content) > 1 else content
    if Path(name).suffix.lower() != ".stl" or content.lstrip()[:5].lower() != b"solid":
        return content
    try:
        corners = np.array(_STL_VERTEX.findall(content)).astype(np.float32).reshape(-1, 3, 3)
    except ValueError:
        return content  # MuJoCo will name it
    triangles = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")])
    triangles["corners"] = corners
    return bytes(80) + len(corners).to_bytes(4, "little") + triangles.tobytes() if len(corners) else content


def num_objects(content: bytes) -> int:
    return sum(_OBJ_FACE.search(part) is not None for part in _OBJ_NAME.split(content))


def scene_model(scene: SceneFile) -> mujoco.MjModel:
    """Return the compiled model of a scene with the first variant of each object; assets are read from their recorded paths.

    Raises:
        ArtifactError: If an asset is missing or is not the one that the scene was compiled with.
    """
    return SceneModels(scene).model({})


@dataclass(frozen=True)
class Choice:
    """An object's variant and size in one environment."""

    variant: int = 0  # index of its variant
    size: tuple[float, float, float] | None = None  # its size as MuJoCo defines it [m]; None: the scene's or the variant's


def with_choices(spec: mujoco.MjSpec, objects: Sequence[SceneObject], choices: Mapping[str, Choice]) -> mujoco.MjSpec:
    """Give objects the geoms of one variant each: the spec is changed in place and returned.

    Bodies welded to an object's body lose their geoms. All choices have the same geoms and meshes, so that MuJoCo's data layout
    is the same. Geoms absent from a variant weigh nothing, are invisible, and need a bit of `conaffinity` that no geom has. A
    custom number marks absent geoms. Bodies without inertia in the scene get their geoms' inertia.
    """
    new = {target.body for target in objects if spec.geom(placeholder_name(target.body)) is not None}
    weighed = new | {target.body for target in objects if target.types and not spec.body(target.body).explicitinertial}
    if weighed:
        freeze(spec, new, weighed)
    for target in objects:
        choice = choices.get(target.name, Choice())
        body = spec.body(target.body)
        if target.types:
            template = body.geoms[0]
            for i in range(len(target.types)):
                _add_geom(spec, target, i, choice.variant, template)
            for geom in (*body.geoms[: -len(target.types)], *_welded_geoms(body, target.others)):
                spec.delete(geom)
        if choice.size is not None:
            body.geoms[_sized_geom(target, choice.variant)].size = choice.size
        if target.body in weighed:
            weigh(spec, body)
    return spec


def _welded_geoms(body: mujoco.MjsBody, others: Sequence[str]) -> list[mujoco.MjsGeom]:
    below = [child for child in body.bodies if not child.joints and child.name not in others]
    return [geom for child in below for geom in (*child.geoms, *_welded_geoms(child, others))]


def _sized_geom(target: SceneObject, variant: int) -> int:
    return next(i for i, geom in enumerate(target.variants[variant]) if geom is not None) if target.types else 0


def geom_name(target: SceneObject, i: int) -> str:
    return f"tgdsl/{target.name}/{i}"


def placeholder_name(body: str) -> str:
    return f"tgdsl/{body}/placeholder"


def is_absent(model: mujoco.MjModel, geom: int) -> bool:
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, _absence(model.geom(geom).name))
    return number >= 0 and bool(model.numeric_data[model.numeric_adr[number]])


def _absence(name: str) -> str:
    return f"{name}/is_absent"


def _add_geom(spec: mujoco.MjSpec, target: SceneObject, i: int, variant: int, template: mujoco.MjsGeom) -> None:
    """Add one variant's geom i of an object to its body, and the meshes of this geom in all variants."""
    meshes = {}
    for v, geoms in enumerate(target.variants):
        shape = geoms[i]
        if shape is not None and shape.mesh:
            meshes[v] = f"tgdsl/{target.name}/{v}/{i}"
            spec.add_mesh(name=meshes[v], file=shape.mesh, scale=[shape.scale] * 3)
    source = target.variants[variant][i]
    like = source or next(geoms[i] for geoms in target.variants if geoms[i] is not None)
    assert isinstance(like, SceneGeom)
    geom = spec.body(target.body).add_geom(
        name=geom_name(target, i),
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{target.types[i].upper()}"),
        size=[*like.size, 0.0, 0.0, 0.0][:3],
        pos=like.pos,
        quat=like.quat,
        density=like.density,
    )
    geom.mass, geom.fromto = np.nan, np.full(6, np.nan)  # whatever the scene's defaults say
    geom.typeinertia, geom.fluid_ellipsoid = mujoco.mjtGeomInertia.mjINERTIA_VOLUME, 0.0
    if meshes:
        geom.meshname = meshes.get(variant, next(iter(meshes.values())))
    for name in INHERITED:
        setattr(geom, name, getattr(template, name))
    spec.add_numeric(name=_absence(geom.name), data=[float(source is None)])
    if source is None:
        geom.contype, geom.conaffinity = free_bit(spec, "objects that vary", RobotError), 0
        geom.mass, geom.density = 0.0, 0.0
        geom.rgba = [0.0, 0.0, 0.0, 0.0]
        geom.material = ""


class SceneModels:
    """The models of a scene whose objects differ between environments, all of one layout, each compiled once while in use."""

    def __init__(
        self, scene: SceneFile, options: Options | None = None, prepare: Callable[[mujoco.MjSpec], None] | None = None
    ):
        """Read the assets."""
        self.objects = {target.name: target for target in scene.objects}
        with muted_mujoco():
            self._base = _spec(scene, {asset.key: _content(asset) for asset in scene.assets})
            set_options(self._base, options or {})
            if prepare is not None:
                prepare(self._base)
        self._models: dict[tuple[Choice, ...], mujoco.MjModel] = {}
        self._off_center: tuple[str, ...] = ()
        for target in scene.objects:
            models = [self.model({target.name: Choice(v)}) for v in range(len(target.variants))]
            # MuJoCo stores less for a body whose centre of mass is its origin.
            if len({(model.nC, model.nM, model.nD, model.nB) for model in models}) > 1:
                self._off_center += (target.body,)
        if self._off_center:
            self._models.clear()

    def first(self) -> mujoco.MjSpec:
        with muted_mujoco():
            return with_choices(self._base.copy(), list(self.objects.values()), {})

    def model(self, choices: Mapping[str, Choice]) -> mujoco.MjModel:
        """Return the scene with some choices of objects; the others have their first variant."""
        key = tuple(choices.get(name, Choice()) for name in self.objects)
        if key not in self._models:
            try:
                with muted_mujoco():
                    self._models[key] = self._compiled(choices)
            except ValueError as error:
                raise RobotError(f"MuJoCo cannot compile the scene with {dict(choices)}: {error}") from error
        return self._models[key]

    def models(self, choices: Sequence[Mapping[str, Choice]]) -> list[mujoco.MjModel]:
        """Return the model of each environment, and drop unused ones: new sizes would accumulate models."""
        results = [self.model(choice) for choice in choices]
        used = {id(model) for model in results}
        self._models = {key: model for key, model in self._models.items() if id(model) in used}
        return results

    def size(self, name: str, choice: Choice) -> tuple[float, float, float]:
        """Return the size of an object whose size may be chosen, as MuJoCo defines it [m]."""
        if choice.size is not None:
            return choice.size
        target, model = self.objects[name], self.model({name: choice})
        x, y, z = model.geom_size[model.body(target.body).geomadr[0] + _sized_geom(target, choice.variant)]
        return float(x), float(y), float(z)

    def type(self, name: str, variant: int) -> str:
        target, model = self.objects[name], self.model({name: Choice(variant)})
        kind = model.geom_type[model.body(target.body).geomadr[0] + _sized_geom(target, variant)]
        return mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()

    def _compiled(self, choices: Mapping[str, Choice]) -> mujoco.MjModel:
        spec = with_choices(self._base.copy(), list(self.objects.values()), choices)
        model = spec.compile()
        for name in self._off_center:
            body, id = spec.body(name), model.body(name).id
            body.mass, body.inertia = model.body_mass[id], model.body_inertia[id]
            body.iquat, body.ipos = model.body_iquat[id], model.body_ipos[id] + np.array([OFF_CENTER, 0, 0])
        return spec.compile() if self._off_center else model


def _content(asset: Asset) -> bytes:
    path = asset.path
    try:
        path = resolve_asset(asset, robots_folder())
        content = path.read_bytes()
    except OSError as error:
        place = error.filename or path
        raise ArtifactError(f"asset {place} of the scene cannot be read: {error.strerror}; compile again") from error
    if hashlib.sha256(content).hexdigest() != asset.sha256:
        raise ArtifactError(f"asset {path} has changed since the scene was compiled; compile again")
    return content


def portable(path: Path) -> str:
    folder, path = robots_folder().resolve(), path.resolve()
    return f"{ROBOTS}{path.relative_to(folder).as_posix()}" if path.is_relative_to(folder) else path.as_posix()


def scene_digest(scene: SceneFile) -> str:
    """Return a hash of a scene: its files, assets, objects and colliders, without the contact sensors that a module wants."""
    root = ET.fromstring(scene.mjcf)
    for sensors in root.findall("sensor"):
        for sensor in [element for element in sensors if element.get("name", "").startswith("tgdsl/")]:
            sensors.remove(sensor)
        if not len(sensors):
            root.remove(sensors)
    texts = [ET.tostring(root, encoding="unicode"), *scene.parts.values(), repr(scene.objects)]
    texts += [repr(scene.colliders)] if scene.colliders else []
    result = hashlib.sha256(b"tgdsl scene 1")
    for part in [*texts, *sorted(asset.sha256 for asset in scene.assets)]:
        result.update(f"{len(part)} {part}".encode())
    return result.hexdigest()
