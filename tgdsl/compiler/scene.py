"""Scenes out: contact sensors added for just the pairs that a module wants, and the scene as text with its assets' hashes."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import mujoco

from tgdsl.compiler.compare import differing
from tgdsl.compiler.robot import Model
from tgdsl.compiler.variants import OwnObjects, as_worldbody, start_qpos
from tgdsl.errors import RobotError, listed
from tgdsl.places import ENDINGS, FOLDER_ATTRIBUTES
from tgdsl.plan import SLOT_FIELDS, Asset, Inputs, SceneFile, contact_sensor_names
from tgdsl.scene import compiled, muted_mujoco, portable

SLOT_DATA = ("found", "force", "torque", "pos", "normal", "tangent")
"""What a contact sensor hands out of each contact, in MuJoCo's order."""
REDUCTIONS = ("none", "mindist", "maxforce", "netforce")
"""MuJoCo's ways to reduce contacts, in the order of its numbers."""
ASSET_TAGS = ("mesh", "texture", "hfield", "skin")
"""Elements of an MJCF file's `<asset>` that name a file."""
FILE_ATTRIBUTES = ("file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")))
"""How they name it: the sides of a cube's texture have one each."""


def instrument(spec: mujoco.MjSpec, inputs: Inputs) -> mujoco.MjSpec:
    """Add the contact sensors that a module wants to a MuJoCo model: those of `inputs.pairs`, and no others.

    Body 1 is the object and body 2 the link, so that MuJoCo's force is the one on the link and its normal points out of the
    object. Sensors that are already there, by name, are left as they are.

    Args:
        spec: The model, changed in place; compile it afterwards.
        inputs: What the module wants: `touch.inputs`.

    Returns:
        The same model.

    Raises:
        RobotError: If the model lacks a body.
    """
    bodies = {body.name for body in spec.bodies}
    present = {sensor.name for sensor in spec.sensors}
    for name, target, link, data, reduce, num in _contact_sensors(inputs):
        for body in (link, target):
            if body not in bodies:
                raise RobotError(f'this model has no body "{body}", which the module wants contacts of')
        if name not in present:
            fields = sum(1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{part.upper()}")) for part in data)
            spec.add_sensor(
                name=name,
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                objname=target,
                reftype=mujoco.mjtObj.mjOBJ_BODY,
                refname=link,
                intprm=[fields, REDUCTIONS.index(reduce), num],
            )
    return spec


def _contact_sensors(inputs: Inputs) -> Iterator[tuple[str, str, str, tuple[str, ...], str, int]]:
    """Yield name, object's body, link, data fields, reduction and number of contacts of each sensor that is wanted."""
    data = SLOT_DATA if any(name in inputs.fields for name in SLOT_FIELDS) else ("found",)
    for pair in inputs.pairs:
        point, net = contact_sensor_names(pair)
        yield point, inputs.bodies_of[pair.object], pair.link, data, "none", max(inputs.slots, 1)
        if "contact_netforce" in inputs.fields:
            yield net, inputs.bodies_of[pair.object], pair.link, ("found", "force"), "netforce", 1


def scene_file(model: Model, inputs: Inputs, own: OwnObjects | None = None) -> SceneFile:
    """Return a scene with the contact sensors that a module wants, as text, and the objects that have geoms of their own.

    The text is that of the scene's own files, to the letter but for file names: files and assets are named by content, so
    the scene does not depend on where they lie. It is compiled again and compared, so that nothing goes missing unnoticed.

    Raises:
        RobotError: If a file cannot be found, or what is kept is not what was loaded.
    """
    own = OwnObjects() if own is None else own
    kept = _Kept(start_qpos(own.bodies))
    kept.assets |= own.meshes.assets
    kept.contents |= own.meshes.contents
    if model.mjcf:
        root = ET.fromstring(model.mjcf)
        for mesh in root.iter("mesh"):
            if (name := mesh.get("file", "")) in model.rewritten:
                mesh.set("file", str(model.rewritten[name]))
        main = kept.rewritten(root, model.file, [model.file.parent])
    else:
        main = kept.rewritten(ET.parse(model.file).getroot(), model.file, [model.file.parent])
    if own.bodies:
        main.append(as_worldbody(own.bodies))
    sensors = ET.SubElement(main, "sensor")
    for name, body1, body2, data, reduce, num in _contact_sensors(inputs):
        attributes = {"name": name, "body1": body1, "body2": body2, "data": " ".join(data), "reduce": reduce, "num": str(num)}
        ET.SubElement(sensors, "contact", attributes)
    scene = SceneFile(
        mjcf=ET.tostring(main, encoding="unicode"),
        parts=dict(sorted(kept.parts.items())),
        assets=tuple(sorted(kept.assets.values(), key=lambda asset: asset.key)),
        objects=own.objects,
    )
    try:
        again = compiled(scene, kept.contents)
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
        """Rewrite one file.

        Args:
            root: Its content, changed in place.
            file: The file, for messages.
            folders: Where files that it names may lie: an included file's assets are looked up beside the including one,
                and then beside itself.
            settings: The folder attributes that hold in the including file, if there is one.
        """
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
                own = [settings.get(subfolders[element.tag], settings.get("assetdir", "")), ""]
                for attribute in FILE_ATTRIBUTES:
                    if element.get(attribute):
                        element.set(attribute, self._asset(_found(element.get(attribute, ""), own, folders, file)))
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
    """Refuse a kept scene that is not the loaded one with the contact sensors that are wanted.

    Raises:
        RobotError: If any field of its compiled model differs: see `compare.differing`.
    """
    with muted_mujoco():
        loaded = instrument(model.spec.copy(), inputs).compile()
    if names := differing(loaded, again, model.is_urdf):
        raise RobotError(f"{model.file}: this scene cannot be kept faithfully: in MuJoCo's model {listed(names)} would differ")
