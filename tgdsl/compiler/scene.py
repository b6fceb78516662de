"""The instrumented scene as text: contact sensors for a module's pairs, and objects whose geoms the document sets."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco

from tgdsl.errors import RobotError, listed
from tgdsl.files.find import is_file
from tgdsl.formats.model import Model
from tgdsl.plan.inputs import ContactPart, Inputs, Touching, contact_sensor_names
from tgdsl.plan.scene import Asset, Collider, SceneFile, SceneGeom, SceneObject
from tgdsl.quantities.bake import aligned
from tgdsl.scene.asset_paths import ENDINGS, FOLDER_ATTRIBUTES
from tgdsl.scene.compare import differing_fields
from tgdsl.scene.mujoco_warnings import located_warnings, muted_mujoco
from tgdsl.scene.scene import Choice, compiled, geom_name, placeholder_name, portable, readable, with_choices
from tgdsl.schema.objects import MeshGeom, ObjectSpec, PrimitiveGeom

SLOT_DATA = ("found", "force", "torque", "pos", "normal", "tangent")
"""The data of a contact sensor per contact, in MuJoCo's order."""
SENSED = ("found", "force", "torque", "dist", "pos", "normal", "tangent")  # the same and the distance, in MuJoCo's order
MIXED_NUM = 64
"""Contacts per sensor if geoms have gaps and different margins: the nearest contacts may then carry no force."""
OBJECT_TYPES = {"body": mujoco.mjtObj.mjOBJ_BODY, "subtree": mujoco.mjtObj.mjOBJ_XBODY, "geom": mujoco.mjtObj.mjOBJ_GEOM}
"""MuJoCo's object types of contact parts."""
REDUCTIONS = ("none", "mindist", "maxforce", "netforce")  # MuJoCo's ways to reduce contacts, in the order of its numbers
ASSET_TAGS = ("mesh", "texture", "hfield", "skin")  # elements of an MJCF file's `<asset>` that name a file
FILE_ATTRIBUTES = ("file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")))
"""How they name it: the sides of a cube's texture have one each."""


def instrument(spec: mujoco.MjSpec, inputs: Inputs) -> mujoco.MjSpec:
    """Add the contact sensors of a module to a MuJoCo model: one per pair of `inputs.pairs`.

    The object is the sensor's first side and the link its second, so that MuJoCo's force acts on the link, and its normal
    points out of the object. Existing sensors of the same name stay.

    Args:
        spec: The model, changed in place; compile it afterwards.
        inputs: Inputs of the module: `touch.inputs`.

    Returns:
        The same model.

    Raises:
        RobotError: If the model lacks a body, or is compiled already.
    """
    if not isinstance(spec, mujoco.MjSpec):
        problem = f"tgdsl.instrument wants a mujoco.MjSpec, found {type(spec).__name__}: a compiled model takes no more sensors"
        raise RobotError(f"{problem}; read it with mujoco.MjSpec.from_file, and compile it afterwards")
    present = {sensor.name for sensor in spec.sensors}
    for contact_sensor in _contact_sensors(inputs, spec):
        if contact_sensor.name not in present:
            fields = sum(1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{part.upper()}")) for part in contact_sensor.data)
            spec.add_sensor(
                name=contact_sensor.name,
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=OBJECT_TYPES[contact_sensor.between.object.kind],
                objname=contact_sensor.between.object.name,
                reftype=OBJECT_TYPES[contact_sensor.between.link.kind],
                refname=contact_sensor.between.link.name,
                intprm=[fields, REDUCTIONS.index(contact_sensor.reduce), contact_sensor.num],
            )
    return spec


class ContactSensor(NamedTuple):
    """A contact sensor between parts of an object and of a link: its data, reduction and number of contacts."""

    name: str
    between: Touching
    data: tuple[str, ...]
    reduce: str
    num: int


def _contact_sensors(inputs: Inputs, spec: mujoco.MjSpec) -> Iterator[ContactSensor]:
    """Yield the contact sensors that a module needs in a model."""
    wants_slots, wants_net = inputs.slots > 0, "contact_netforce" in inputs.fields
    for pair in inputs.pairs:
        for i, between in enumerate(inputs.touching(pair)):
            point, net = contact_sensor_names(pair, i)
            margins, has_gap = _margins(spec, between)
            data = SLOT_DATA if wants_slots else ("found", "force") if has_gap else ("found",)
            num = max(inputs.slots, 1)
            if has_gap:
                data = tuple(name for name in SENSED if name in (*data, "dist"))
                num = max(num, MIXED_NUM) if len(margins) > 1 else num
            yield ContactSensor(point, between, data, "mindist" if has_gap else "none", num)
            if wants_net:
                yield ContactSensor(net, between, ("found", "force"), "netforce", 1)


def _margins(spec: mujoco.MjSpec, between: Touching) -> tuple[set[tuple[float, float]], bool]:
    """Return the margins [m] of all pairs of geoms of an object and a link, and whether any of them has a gap."""
    first, second = (_geoms(spec, part) for part in between)
    names = [{geom.name for geom in geoms} for geoms in (first, second)]
    ways = (names, names[::-1])
    pairs = [pair for pair in spec.pairs if any(pair.geomname1 in a and pair.geomname2 in b for a, b in ways)]
    margins = {(float(a.margin), float(b.margin)) for a in first for b in second}
    has_gap = any(geom.gap > 0 for geom in (*first, *second, *pairs))
    return margins | {(float(pair.margin), 0.0) for pair in pairs}, has_gap


def _geoms(spec: mujoco.MjSpec, part: ContactPart) -> list[mujoco.MjsGeom]:
    result = (spec.geom if part.kind == "geom" else spec.body)(part.name)
    if result is None:
        kind = "geom" if part.kind == "geom" else "body"
        raise RobotError(f'this model has no {kind} "{part.name}", which the module wants contacts of')
    if part.kind == "geom":
        return [result]
    return result.find_all("geom") if part.kind == "subtree" else list(result.geoms)


def scene_file(model: Model, inputs: Inputs, own: OwnObjects | None = None, colliders: tuple[Collider, ...] = ()) -> SceneFile:
    """Return a scene as text, with a module's contact sensors, and the objects whose geoms the document sets.

    The text is copied from the scene's files; only file names change. Files and assets are named by content, so the scene
    does not depend on their folders. The copy is compiled and compared with the original, so that no loss goes unnoticed.
    """
    own = OwnObjects() if own is None else own
    files = Files(dict(own.meshes.assets), dict(own.meshes.contents))
    copy = _Kept(start_qpos(own.bodies), files)
    root = ET.fromstring(model.mjcf) if model.mjcf else ET.parse(model.file).getroot()
    for mesh in root.iter("mesh") if model.mjcf else ():
        if (name := mesh.get("file", "")) in model.rewritten:
            mesh.set("file", str(model.rewritten[name]))
    main = copy.rewritten(root, model.file, [model.file.parent])
    if own.bodies:
        main.append(as_worldbody(own.bodies))
    sensors = ET.SubElement(main, "sensor")
    for sensor in _contact_sensors(inputs, model.spec):
        one, two = sensor.between
        ends = {f"{one.kind}1": one.name, f"{two.kind}2": two.name}
        attributes = {"data": " ".join(sensor.data), "reduce": sensor.reduce, "num": str(sensor.num)}
        ET.SubElement(sensors, "contact", {"name": sensor.name, **ends, **attributes})
    scene = SceneFile(
        mjcf=ET.tostring(main, encoding="unicode"),
        parts=dict(sorted(copy.parts.items())),
        assets=tuple(sorted(files.assets.values(), key=lambda asset: asset.key)),
        objects=own.objects,
        colliders=colliders,
    )
    try:
        again = compiled(scene, files.contents)
    except ValueError as error:
        raise RobotError(f"{model.file}: MuJoCo cannot read the saved copy of this scene: {error}") from error
    _compare(model, inputs, again)
    return scene


@dataclass
class Files:
    """Files and other files that a scene names, by the keys that it has for them."""

    assets: dict[str, Asset] = field(default_factory=dict)
    contents: dict[str, bytes] = field(default_factory=dict)

    def add(self, path: Path) -> str:
        """Read a file and return its key."""
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        key = f"{digest[:32]}{path.suffix.lower()}"
        self.assets[key], self.contents[key] = Asset(key, portable(path), digest), content
        return key


class _Kept:
    """Collects the parts and assets of a scene while its files are rewritten to name them by content."""

    def __init__(self, qpos: list[float], files: Files) -> None:
        self.qpos = "".join(f" {value!r}" for value in qpos)  # what new bodies add to the keyframes
        self.parts: dict[str, str] = {}
        self.files = files

    def rewritten(
        self, root: ET.Element, file: Path, folders: list[Path], settings: dict[str, str] | None = None
    ) -> ET.Element:
        subfolders = {"mesh": "meshdir", "skin": "meshdir", "hfield": "meshdir", "texture": "texturedir"}
        settings = _folder_settings(root, file, folders) if settings is None else settings
        for compiler in root.iter("compiler"):
            for attribute in FOLDER_ATTRIBUTES:
                compiler.attrib.pop(attribute, None)
        for element in root.iter():
            name = element.get("file")
            if element.tag == "key" and element.get("qpos"):
                element.set("qpos", element.get("qpos", "") + self.qpos)
            if element.tag in ("include", "model") and name:
                element.set("file", self._part(_resolved_path(name, [""], folders, file), folders, element.tag, settings))
            elif element.tag in ASSET_TAGS:
                if name:
                    element.set("name", element.get("name", Path(name).stem))
                subdirs = [settings.get(subfolders[element.tag], settings.get("assetdir", "")), ""]
                for attribute in FILE_ATTRIBUTES:
                    if element.get(attribute):
                        element.set(attribute, self._asset(_resolved_path(element.get(attribute, ""), subdirs, folders, file)))
        return root

    def _part(self, path: Path, folders: list[Path], tag: str, settings: dict[str, str]) -> str:
        is_include = tag == "include"
        around = [*folders, path.parent] if is_include else [path.parent]
        try:
            root = self.rewritten(ET.parse(path).getroot(), path, around, settings if is_include else None)
        except ET.ParseError as error:
            raise RobotError(f"{path}: not XML: {error}") from error
        text = ET.tostring(root, encoding="unicode")
        key = f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.xml"
        self.parts[key] = text
        return key

    def _asset(self, path: Path) -> str:
        if path.suffix.lower() not in ENDINGS:
            raise RobotError(f"{path}: a mesh, texture, height field or skin has one of the endings {listed(ENDINGS)}")
        return self.files.add(path)


def _folder_settings(root: ET.Element, file: Path, folders: list[Path]) -> dict[str, str]:
    """Return the folder attributes of a file: MuJoCo reads what it includes as part of it, and the last one counts."""
    settings: dict[str, str] = {}
    for element in root.iter():
        if element.tag == "compiler":
            settings |= {name: value for name, value in element.attrib.items() if name in FOLDER_ATTRIBUTES}
        elif element.tag == "include" and (name := element.get("file")):
            path = _resolved_path(name, [""], folders, file)
            settings |= _folder_settings(ET.parse(path).getroot(), path, [*folders, path.parent])
    return settings


def _resolved_path(name: str, subfolders: list[str], folders: list[Path], file: Path) -> Path:
    for folder in folders:
        for subfolder in subfolders:
            if (path := folder / subfolder / name).is_file():
                return path.resolve()
    raise RobotError(f'{file}: the file "{name}" that it names was not found')


def _compare(model: Model, inputs: Inputs, again: mujoco.MjModel) -> None:
    """Refuse a saved scene that differs from the loaded one with its contact sensors."""
    with muted_mujoco():
        loaded = instrument(model.spec.copy(), inputs).compile()
    if names := differing_fields(loaded, again, model.is_rounded):
        raise RobotError(f"{model.file}: this scene cannot be saved faithfully: in MuJoCo's model {listed(names)} would differ")


Report = Callable[[tuple[str | int, ...], str, str], None]
"""Called with the mistake's place below the object, a message, and a hint."""


@dataclass(frozen=True)
class NewBody:
    """A body that the document adds to the scene."""

    name: str
    pos: tuple[float, float, float]  # initial position in the world [m]
    quat: tuple[float, float, float, float]  # initial orientation, w, x, y, z
    is_free: bool  # whether it moves freely, or is fixed to the world
    group: int = 0  # its geoms' group: one that counts if the scene's compiler infers all inertias from geoms
    contype: int = 1  # MuJoCo's bits of its geoms
    conaffinity: int = 1

    @property
    def geom(self) -> dict[str, tuple[Any, ...]]:
        """Fields of its placeholder, which its geoms inherit: MuJoCo's defaults, not the scene's `<default>`."""
        return PLAIN | {"contype": (self.contype,), "conaffinity": (self.conaffinity,), "group": (self.group,)}


WATER = 1000.0  # MuJoCo's density of geoms [kg/m³]
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
"""MuJoCo's default contact parameters: a scene's `<default>` applies to the scene's geoms only."""
INERTIAL = {"pos": (0.0, 0.0, 0.0), "mass": (1.0,), "diaginertia": (1.0, 1.0, 1.0)}
"""A body's inertia until it has geoms: it then compiles with any inertia settings of the scene's compiler."""


def with_bodies(scene: Model, bodies: Sequence[NewBody]) -> Model:
    """Return a scene with new bodies after its own; its keyframes have them at their initial poses."""
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
    """Return the initial `qpos` of new bodies."""
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
    """Objects whose geoms or sizes the document sets, the new bodies among them, and their mesh files."""

    bodies: tuple[NewBody, ...] = ()
    objects: tuple[SceneObject, ...] = ()
    meshes: Files = field(default_factory=Files)


def scene_object(name: str, target: ObjectSpec, folder: Path, meshes: Files, report: Report) -> SceneObject:
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


def _scene_geom(geom: PrimitiveGeom | MeshGeom, folder: Path, meshes: Files, report: Callable[[str], None]) -> SceneGeom | None:
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
        with located_warnings(path):
            trial.compile()
    except ValueError as error:
        report(f'MuJoCo cannot read mesh file "{geom.mesh}": {" ".join(str(error).split()).replace(key, path.name)}')
        return None
    return SceneGeom((), geom.pos, geom.quat, geom.density, key, geom.scale)


def variant_scenes(scene: Model, target: SceneObject, contents: Mapping[str, bytes]) -> list[tuple[Model, tuple[str, ...]]]:
    """Return the scene with each variant of an object, and the names of the geoms that the variant has."""
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
