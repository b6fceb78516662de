"""URDF for MuJoCo: mesh paths resolved, links on fixed joints kept as bodies, invalid inertias replaced with a warning."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from tgdsl.errors import RobotError, listed
from tgdsl.formats.mesh_files import BY_MUJOCO, BY_TRIMESH, Y_UP, put_in_line
from tgdsl.formats.mjcf import rewrite_meshes
from tgdsl.formats.model import LEAST_INERTIA, Model


def read_urdf(path: Path) -> Model:
    """Read and compile a URDF file.

    Raises:
        RobotError: If the file is not XML, or a mesh cannot be found.
        ValueError: If MuJoCo cannot read or compile it.
    """
    text, files = as_mujoco_text(path)
    spec = mujoco.MjSpec.from_string(text)
    _fill_meshes(path, spec, files)
    rewritten = rewrite_meshes(spec)
    compiled = spec.compile()
    return Model(path, spec, compiled, is_urdf=True, mjcf=spec.to_xml(), rewritten=rewritten)


def _fill_meshes(path: Path, spec: mujoco.MjSpec, files: Mapping[str, Path]) -> None:
    """Have each mesh name its file, or hold its triangles where MuJoCo does not read such files, of which a warning tells."""
    read_here = dict[Path, None]()
    for mesh in spec.meshes:
        file = files[Path(mesh.file).stem]
        if file.suffix.lower() in BY_TRIMESH:
            put_in_line(mesh, file)
            read_here[file] = None
        else:
            mesh.file = str(file)
    if read_here:
        axes = " and with Y not turned up to Z" if any(file.suffix.lower() in Y_UP for file in read_here) else ""
        names = listed([file.name for file in read_here])
        warnings.warn(f"{path}: meshes read by trimesh, without textures{axes}: {names}", stacklevel=5)


def as_mujoco_text(path: Path) -> tuple[str, dict[str, Path]]:
    """Return a URDF's text with what MuJoCo needs to read it, and the file of each mesh by the stem of its name in there.

    Mesh files are found (`package://` is looked up in the folders above the file), links on fixed joints keep their own
    bodies, and inertias that no rigid body can have are replaced by a ball's of about the same size.

    Raises:
        RobotError: If the file is not XML, or a mesh cannot be found.
    """
    try:
        tree = ET.parse(path)
    except ET.ParseError as error:
        raise RobotError(f"{path}: not XML: {error}") from error
    robot = tree.getroot()
    files: dict[str, Path] = {}
    for mesh in robot.iter("mesh"):
        file = _mesh_file(mesh.get("filename", ""), path)
        if file.suffix.lower() not in (*BY_MUJOCO, *BY_TRIMESH):
            raise RobotError(f'{path}: mesh "{file.name}": expected one of {listed((*BY_MUJOCO, *BY_TRIMESH))}')
        stem, number = file.stem, 1
        while files.setdefault(stem, file) != file:  # MuJoCo tells a URDF's meshes apart by this alone
            number += 1
            stem = f"{file.stem}_{number}"
        mesh.set("filename", f"{stem}{file.suffix}")
    mended = [link.get("name", "") for link in robot.iter("link") if _mend(link)]
    if mended:
        warnings.warn(f"{path}: inertias that no body can have were mended: {listed(mended)}", stacklevel=5)
    settings = robot.find("mujoco")
    settings = ET.SubElement(robot, "mujoco") if settings is None else settings
    compiler = settings.find("compiler")
    compiler = ET.SubElement(settings, "compiler") if compiler is None else compiler
    compiler.attrib |= {"strippath": "false", "fusestatic": "false", "discardvisual": "false", "meshdir": ""}
    return ET.tostring(robot, encoding="unicode"), files


def _mesh_file(name: str, urdf: Path) -> Path:
    if name.startswith("package://"):
        inside = name.removeprefix("package://")
        package, _, rest = inside.partition("/")
        for folder in urdf.resolve().parents:
            if folder.name == package and (folder / rest).is_file():
                return folder / rest
            if (folder / inside).is_file():
                return folder / inside
        raise RobotError(f'{urdf}: mesh "{name}": no folder above the file holds "{inside}"')
    found = urdf.resolve().parent / name.removeprefix("file://")
    if not found.is_file():
        raise RobotError(f'{urdf}: mesh "{name}": there is no file {found}')
    return found


def _mend(link: ET.Element) -> bool:
    """Replace the link's inertia if its principal moments are not positive or break the triangle inequality."""
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return False
    try:
        xx, yy, zz, xy, xz, yz = (float(inertia.get(f"i{axes}", "0")) for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
    except ValueError:
        return False  # MuJoCo will name the line
    low, middle, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if low > 0 and low + middle >= high * (1 - 1e-9):
        return False
    moment = max((xx + yy + zz) / 3.0, LEAST_INERTIA)
    for axes in ("xx", "yy", "zz"):
        inertia.set(f"i{axes}", repr(moment))
    for axes in ("xy", "xz", "yz"):
        inertia.set(f"i{axes}", "0")
    return True
