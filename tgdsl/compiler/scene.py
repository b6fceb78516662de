"""Scenes out: contact sensors added for just the pairs that a module wants, and the scene as text with its assets' hashes."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco

from tgdsl.compiler.variants import OwnObjects, as_worldbody, start_qpos
from tgdsl.errors import RobotError, listed
from tgdsl.formats.model import Model
from tgdsl.plan.inputs import ContactPart, Inputs, Touching, contact_sensor_names
from tgdsl.plan.scene import Asset, Collider, SceneFile
from tgdsl.scene.asset_paths import ENDINGS, FOLDER_ATTRIBUTES
from tgdsl.scene.compare import differing_fields
from tgdsl.scene.mujoco_warnings import muted_mujoco
from tgdsl.scene.scene import compiled, portable

SLOT_DATA = ("found", "force", "torque", "pos", "normal", "tangent")
"""What a contact sensor hands out of each contact, in MuJoCo's order."""
SENSED = ("found", "force", "torque", "dist", "pos", "normal", "tangent")  # the same and the distance, in MuJoCo's order
MIXED_NUM = 64
"""Contacts that a sensor shows where geoms have gaps and different margins: the nearest need not be those that carry force."""
OBJECT_TYPES = {"body": mujoco.mjtObj.mjOBJ_BODY, "subtree": mujoco.mjtObj.mjOBJ_XBODY, "geom": mujoco.mjtObj.mjOBJ_GEOM}
"""MuJoCo's types of what a part of an object or link is."""
REDUCTIONS = ("none", "mindist", "maxforce", "netforce")  # muJoCo's ways to reduce contacts, in the order of its numbers
ASSET_TAGS = ("mesh", "texture", "hfield", "skin")  # elements of an MJCF file's `<asset>` that name a file
FILE_ATTRIBUTES = ("file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")))
"""How they name it: the sides of a cube's texture have one each."""


def instrument(spec: mujoco.MjSpec, inputs: Inputs) -> mujoco.MjSpec:
    """Add the contact sensors that a module wants to a MuJoCo model: those of `inputs.pairs`, and no others.

    The first side of a sensor is the object and the second the link, so that MuJoCo's force is the one on the link and its
    normal points out of the object. Sensors that are already there, by name, are left as they are.

    Args:
        spec: The model, changed in place; compile it afterwards.
        inputs: What the module wants: `touch.inputs`.

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
    """A contact sensor: between parts of an object and of a link, what it shows, how it reduces, of how many contacts."""

    name: str
    between: Touching
    data: tuple[str, ...]
    reduce: str
    num: int


def _contact_sensors(inputs: Inputs, spec: mujoco.MjSpec) -> Iterator[ContactSensor]:
    """Yield the contact sensors that are wanted of a model."""
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
    return [*result.geoms, *(geom for child in result.bodies if part.kind == "subtree" for geom in _below(child))]


def _below(body: mujoco.MjsBody) -> list[mujoco.MjsGeom]:
    return [*body.geoms, *(geom for child in body.bodies for geom in _below(child))]


def scene_file(model: Model, inputs: Inputs, own: OwnObjects | None = None, colliders: tuple[Collider, ...] = ()) -> SceneFile:
    """Return a scene with the contact sensors that a module wants, as text, and the objects that have geoms of their own.

    The text is that of the scene's own files, to the letter but for file names: files and assets are named by content, so
    the scene does not depend on where they lie. It is compiled again and compared, so that nothing goes missing unnoticed.

    Raises:
        RobotError: If a file is missing, or differs from the one that was loaded.
    """
    own = OwnObjects() if own is None else own
    copy = _Kept(start_qpos(own.bodies))
    copy.assets |= own.meshes.assets
    copy.contents |= own.meshes.contents
    if model.mjcf:
        root = ET.fromstring(model.mjcf)
        for mesh in root.iter("mesh"):
            if (name := mesh.get("file", "")) in model.rewritten:
                mesh.set("file", str(model.rewritten[name]))
        main = copy.rewritten(root, model.file, [model.file.parent])
    else:
        main = copy.rewritten(ET.parse(model.file).getroot(), model.file, [model.file.parent])
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
        assets=tuple(sorted(copy.assets.values(), key=lambda asset: asset.key)),
        objects=own.objects,
        colliders=colliders,
    )
    try:
        again = compiled(scene, copy.contents)
    except ValueError as error:
        raise RobotError(f"{model.file}: MuJoCo cannot read what is kept of this scene: {error}") from error
    _compare(model, inputs, again)
    return scene


class _Kept:
    """Collects the parts and assets of a scene while its files are rewritten to name them by content."""

    def __init__(self, qpos: list[float]) -> None:
        """Begin; `qpos` is what new bodies add to the keyframes."""
        self.qpos = "".join(f" {value!r}" for value in qpos)
        self.parts: dict[str, str] = {}
        self.assets: dict[str, Asset] = {}
        self.contents: dict[str, bytes] = {}

    def rewritten(
        self, root: ET.Element, file: Path, folders: list[Path], settings: dict[str, str] | None = None
    ) -> ET.Element:
        """Rewrite one file."""
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
                element.set("file", self._part(_found(name, [""], folders, file), folders, element.tag, settings))
            elif element.tag in ASSET_TAGS:
                if name:
                    element.set("name", element.get("name", Path(name).stem))
                subdirs = [settings.get(subfolders[element.tag], settings.get("assetdir", "")), ""]
                for attribute in FILE_ATTRIBUTES:
                    if element.get(attribute):
                        element.set(attribute, self._asset(_found(element.get(attribute, ""), subdirs, folders, file)))
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
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        key = f"{digest[:32]}{path.suffix.lower()}"
        self.assets[key] = Asset(key, portable(path), digest)
        self.contents[key] = content
        return key


def _folder_settings(root: ET.Element, file: Path, folders: list[Path]) -> dict[str, str]:
    """Return the folder attributes of a file: MuJoCo reads what it includes as part of it, and the last one counts."""
    settings: dict[str, str] = {}
    for element in root.iter():
        if element.tag == "compiler":
            settings |= {name: value for name, value in element.attrib.items() if name in FOLDER_ATTRIBUTES}
        elif element.tag == "include" and (name := element.get("file")):
            path = _found(name, [""], folders, file)
            settings |= _folder_settings(ET.parse(path).getroot(), path, [*folders, path.parent])
    return settings


def _found(name: str, subfolders: list[str], folders: list[Path], file: Path) -> Path:
    for folder in folders:
        for subfolder in subfolders:
            if (path := folder / subfolder / name).is_file():
                return path.resolve()
    raise RobotError(f'{file}: the file "{name}" that it names was not found')


def _compare(model: Model, inputs: Inputs, again: mujoco.MjModel) -> None:
    """Refuse a kept scene that is not the loaded one with the contact sensors that are wanted."""
    with muted_mujoco():
        loaded = instrument(model.spec.copy(), inputs).compile()
    if names := differing_fields(loaded, again, model.is_rounded):
        raise RobotError(f"{model.file}: this scene cannot be kept faithfully: in MuJoCo's model {listed(names)} would differ")
