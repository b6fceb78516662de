"""Scenes that someone else has built: an `MjSpec`, an `MjModel` or a `Usd.Stage` as a model that depends on no file."""

from __future__ import annotations

import tempfile
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from tgdsl.errors import RobotError, TgdslError, listed
from tgdsl.formats.mjcf import mjcf_of
from tgdsl.formats.model import Model
from tgdsl.scene.compare import ROUNDED, TINY, differing_fields
from tgdsl.scene.mujoco_warnings import muted_mujoco

FILE = Path("<scene>")  # what messages call the scene
_KEPT = (
    *("nbody", "ngeom", "njnt", "nu", "ntendon", "neq", "npair", "nflex"),
    *("body_pos", "body_quat", "geom_type", "geom_size", "geom_pos", "geom_quat", "jnt_pos", "jnt_axis"),
)
"""What a scene that is written out again must have kept."""


def built_scene(scene: Any) -> Model:
    """Return a scene as a model.

    Geometry is bit-identical to the scene's. Its MJCF text, for simulations of the artefact, has six digits if it comes from an
    `MjSpec`; textures are left behind.

    Raises:
        RobotError: If MuJoCo cannot compile the scene, or an `MjModel` has something that only its `MjSpec` tells.
        TgdslError: If it is something else.
    """
    if isinstance(scene, mujoco.MjSpec):
        return _of_spec(scene)
    if isinstance(scene, mujoco.MjModel):
        return _of_model(scene)
    from tgdsl.formats.usd.reader import read_usd
    from tgdsl.formats.usd.stage import usd_modules

    if not isinstance(scene, usd_modules().Usd.Stage):
        raise TgdslError(f"scene is an MjSpec, an MjModel or a Usd.Stage, found {type(scene).__name__}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scene.usdc")
        scene.Export(str(path))
        return replace(read_usd(path), file=FILE)


def _of_spec(scene: mujoco.MjSpec) -> Model:
    spec = scene.copy()
    try:
        with muted_mujoco():
            compiled = spec.compile()
            text = _self_contained(mjcf_of(spec), compiled)
            return Model(FILE, mujoco.MjSpec.from_string(text), compiled, is_rounded=True, mjcf=text)
    except ValueError as error:
        raise RobotError(f"{FILE}: {' '.join(str(error).split())}") from error


def _self_contained(text: str, model: mujoco.MjModel) -> str:
    """Return MJCF with its meshes and height fields in line, and its textures plain."""
    from tgdsl.formats.usd.attributes import file_vertices

    root = ET.fromstring(text)
    for mesh in root.iterfind("asset/mesh[@file]"):
        i = model.mesh(mesh.get("name", "")).id
        faces = model.mesh_face[model.mesh_faceadr[i] :][: model.mesh_facenum[i]]
        for attribute in ("file", "content_type", "scale", "refpos", "refquat"):
            mesh.attrib.pop(attribute, None)
        mesh.set("vertex", _numbers(file_vertices(model, i)))
        mesh.set("face", _numbers(faces))
    for field in root.iterfind("asset/hfield[@file]"):
        i = model.hfield(field.get("name", "")).id
        rows, columns = int(model.hfield_nrow[i]), int(model.hfield_ncol[i])
        del field.attrib["file"]
        heights = model.hfield_data[model.hfield_adr[i] :][: rows * columns].reshape(rows, columns)
        for name, value in (("nrow", str(rows)), ("ncol", str(columns)), ("elevation", _numbers(heights[::-1]))):
            field.set(name, value)
    for texture in root.iterfind("asset/texture"):
        if any(name.startswith("file") for name in texture.attrib):
            plain = {name: texture.get(name, "") for name in ("name", "type") if name in texture.attrib}
            texture.attrib.clear()
            texture.attrib.update(plain | {"builtin": "flat", "width": "2", "height": "2"})
    return ET.tostring(root, encoding="unicode")


def _numbers(values: np.ndarray) -> str:
    return " ".join(map(repr, values.ravel().tolist()))


def _of_model(compiled: mujoco.MjModel) -> Model:
    from tgdsl.formats.usd.reader import read_usd
    from tgdsl.formats.usd.write import write_usd

    names = mujoco.MjSpec()
    for i in range(compiled.nmesh):
        names.add_mesh(name=compiled.mesh(i).name)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what counts is compared below
        path = Path(folder, "scene.usdc")
        try:
            write_usd(Model(FILE, names, compiled, is_rounded=False), path)
        except RobotError as error:
            raise RobotError(f"{error}; pass the MjSpec that this MjModel was compiled from") from error
        model = read_usd(path)
    is_plane = model.compiled.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    if len(is_plane) == compiled.ngeom:  # a plane collides without end: its size says how much of it is drawn
        model.compiled.geom_size[is_plane] = compiled.geom_size[is_plane]
    if lost := [name for name in differing_fields(compiled, model.compiled, is_rounded=True) if name in _KEPT]:
        problem = f"{FILE}: from this MjModel alone, {listed(lost)} would change"
        raise RobotError(f"{problem}; pass the MjSpec that this MjModel was compiled from")
    return replace(model, file=FILE, compiled=compiled)


def differences(model: Model, scene: Model) -> Iterator[str]:
    """Yield what differs of the named bodies of a model in a scene that holds it: their geoms, joints and places."""
    for name in model.bodies[1:]:
        if name not in scene.bodies:
            yield f'the scene has no body "{name}"'
            continue
        one, other = (dict(_parts(each.compiled, name)) for each in (model, scene))
        if model.compiled.body_parentid[model.compiled.body(name).id] == 0:
            del one["place"]
        for part, values in one.items():
            if values.shape != other[part].shape:
                yield f"body {name}: {len(values)} {part} and {len(other[part])}"
            elif not np.allclose(values, other[part], rtol=ROUNDED, atol=TINY):
                yield f"body {name}: {part}"


def _parts(model: mujoco.MjModel, body: str) -> Iterator[tuple[str, np.ndarray]]:
    i = model.body(body).id
    geoms, joints = np.flatnonzero(model.geom_bodyid == i), np.flatnonzero(model.jnt_bodyid == i)
    yield "place", np.concatenate([model.body_pos[i], model.body_quat[i]])
    yield "geoms", np.column_stack([a[geoms] for a in (model.geom_type, model.geom_size, model.geom_pos, model.geom_quat)])
    yield "joints", np.column_stack([a[joints] for a in (model.jnt_type, model.jnt_pos, model.jnt_axis)])
