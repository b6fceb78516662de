"""Scenes out: contact sensors added for just the pairs that a module wants, and the scene as text with its assets' hashes."""

from __future__ import annotations

import hashlib
from pathlib import Path

import mujoco
import numpy as np

from tgdsl.compiler.robot import Model, muted_mujoco, xml_files
from tgdsl.errors import RobotError
from tgdsl.plan import Asset, Inputs, SceneFile, contact_sensor_names
from tgdsl.schema.files import robots_folder

_SLOT_FIELDS = ("contact_pos", "contact_force", "contact_torque", "contact_normal")
_FOUND = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)
_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_SLOT_DATA = _FOUND + _FORCE
for _part in ("TORQUE", "POS", "NORMAL", "TANGENT"):
    _SLOT_DATA += 1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{_part}"))
_REDUCE_NONE, _REDUCE_NETFORCE = 0, 3

ASSET_KINDS = ("meshes", "textures", "hfields", "skins")


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
    wants_slots = any(name in inputs.fields for name in _SLOT_FIELDS)
    for pair in inputs.pairs:
        target = inputs.bodies_of[pair.object]
        for body in (pair.link, target):
            if body not in bodies:
                raise RobotError(f'this model has no body "{body}", which the module wants contacts of')
        point, net = contact_sensor_names(pair)
        wanted = [(point, _SLOT_DATA if wants_slots else _FOUND, _REDUCE_NONE, max(inputs.slots, 1))]
        if "contact_netforce" in inputs.fields:
            wanted.append((net, _FOUND + _FORCE, _REDUCE_NETFORCE, 1))
        for name, data, reduce, num in wanted:
            if name not in present:
                spec.add_sensor(
                    name=name,
                    type=mujoco.mjtSensor.mjSENS_CONTACT,
                    objtype=mujoco.mjtObj.mjOBJ_BODY,
                    objname=target,
                    reftype=mujoco.mjtObj.mjOBJ_BODY,
                    refname=pair.link,
                    intprm=[data, reduce, num],
                )
    return spec


def scene_file(model: Model, inputs: Inputs) -> SceneFile:
    """Return a model with the contact sensors that a module wants, as text.

    Its assets are named by content, so the text does not depend on where they lie; it is read back and compared, so that
    nothing MuJoCo fails to save goes unnoticed.

    Raises:
        RobotError: If an asset cannot be found, or the saved scene is not the one that was loaded.
    """
    with muted_mujoco():
        spec = instrument(model.spec, inputs)
        try:
            compiled = spec.compile()
        except ValueError as error:
            raise RobotError(f"{model.file}: {error}") from error
        assets, contents = _named_by_content(model, spec)
        text = spec.to_xml()
        again = mujoco.MjSpec.from_string(text, assets=contents).compile()
    for name in ("body_pos", "body_quat", "body_mass", "geom_pos", "geom_quat", "geom_size", "geom_friction", "jnt_range"):
        saved, loaded = getattr(again, name), getattr(compiled, name)
        if saved.shape != loaded.shape or not np.allclose(saved, loaded, rtol=1e-5, atol=1e-6):
            raise RobotError(f"{model.file}: MuJoCo does not save this scene faithfully ({name} differs)")
    for kind in ("body", "geom", "joint", "actuator", "sensor"):
        if _names(again, kind) != _names(compiled, kind):
            raise RobotError(f"{model.file}: MuJoCo does not save this scene faithfully (names of {kind}s differ)")
    return SceneFile(text, tuple(sorted(assets, key=lambda asset: asset.key)))


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    count = {"body": model.nbody, "geom": model.ngeom, "joint": model.njnt, "actuator": model.nu, "sensor": model.nsensor}
    return [getattr(model, kind)(i).name for i in range(count[kind])]


def _named_by_content(model: Model, spec: mujoco.MjSpec) -> tuple[list[Asset], dict[str, bytes]]:
    folders = list(dict.fromkeys(path.parent for path in xml_files(model.file)))
    assets: dict[str, Asset] = {}
    contents: dict[str, bytes] = {}
    for kind in ASSET_KINDS:
        for element in getattr(spec, kind):
            if not getattr(element, "file", ""):
                continue
            path = _found(model, element, folders)
            content = path.read_bytes()
            digest = hashlib.sha256(content).hexdigest()
            key = f"{digest[:32]}{path.suffix.lower()}"
            assets[key] = Asset(key, portable(path), digest)
            contents[key] = content
            element.file = key
    spec.meshdir = spec.texturedir = ""
    return list(assets.values()), contents


def _found(model: Model, element: mujoco.MjsMesh | mujoco.MjsTexture, folders: list[Path]) -> Path:
    compiler = element.compiler
    subfolder = compiler.texturedir if isinstance(element, mujoco.MjsTexture) else compiler.meshdir
    for folder in folders:
        for path in (folder / subfolder / element.file, folder / element.file):
            if path.is_file():
                return path.resolve()
    raise RobotError(f'{model.file}: asset "{element.file}" was not found beside any of the files that make up this model')


def portable(path: Path) -> str:
    """Return a path as an artefact keeps it: `robots:` and the rest for a robot that comes with tgdsl, else absolute."""
    folder = robots_folder().resolve()
    return f"robots:{path.relative_to(folder).as_posix()}" if path.is_relative_to(folder) else path.as_posix()
