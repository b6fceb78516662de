"""URDF for MuJoCo: mesh paths resolved, links on fixed joints kept as bodies, invalid inertias replaced with a warning.

Other people's files also have tags of other programs with undeclared prefixes, geoms that share a name, and links that move
but weigh nothing.
"""

from __future__ import annotations

import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping
from pathlib import Path

import mujoco
import numpy as np

from tgdsl.errors import RobotError, listed
from tgdsl.formats.mesh_files import BY_MUJOCO, BY_TRIMESH, Y_UP, in_other_case, put_in_line
from tgdsl.formats.mjcf import mjcf_of, rewrite_meshes
from tgdsl.formats.model import LEAST_INERTIA, Model

EDGE = 1e-8
"""Relative rounding error of an inertia's triangle inequality in a file [1], as of a plate, whose largest moment is the sum of
the others; twice as much is added, because MuJoCo's check is exact."""
LEAST_MASS = 1e-6  # mass of a moving link that has none, and no geometry that MuJoCo could infer it from [kg]
_PREFIX = re.compile(r"[<\s]([A-Za-z_][\w.-]*):[A-Za-z_]")
_ROOT = re.compile(r"<robot\b")


def read_urdf(path: Path) -> Model:
    """Read and compile a URDF file.

    Raises:
        RobotError: If the file is not XML, or a mesh file is missing.
        ValueError: If MuJoCo cannot read or compile it.
    """
    text, files = as_mujoco_text(path)
    spec = mujoco.MjSpec.from_string(text)
    _fill_meshes(path, spec, files)
    rewritten = rewrite_meshes(spec)
    compiled = _compile(spec)
    if overlaps := _overlaps_with_base(compiled):
        for pair in overlaps:
            spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
        compiled = spec.compile()
        pairs = listed([f"{base} and {link}" for base, link in overlaps])
        warnings.warn(f"{path}: links that overlap where a joint connects them do not collide: {pairs}", stacklevel=4)
    return Model(path, spec, compiled, is_rounded=True, mjcf=mjcf_of(spec), rewritten=rewritten)


def _compile(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model; meshes without volume, such as a sticker's, weigh as shells: MuJoCo's error names these."""
    while True:
        try:
            return spec.compile()
        except ValueError as error:
            flat = re.search(r"mesh volume is too small: (.*?) ?\. Try", str(error))
            mesh = spec.mesh(flat[1]) if flat else None
            if mesh is None or mesh.inertia == mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL:
                raise
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def _overlaps_with_base(model: mujoco.MjModel) -> list[tuple[str, str]]:
    """Return the links of the base, and links that a joint connects to it, that overlap in the initial pose."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    weld, parent = model.body_weldid, model.body_parentid
    pairs = set[tuple[int, int]]()
    for contact in data.contact:
        base, link = sorted(model.geom_bodyid[contact.geom].tolist(), key=lambda body: weld[body])
        if contact.dist < 0 and base > 0 and weld[base] == 0 and weld[parent[weld[link]]] == 0:
            pairs.add((base, link))
    return [(model.body(base).name, model.body(link).name) for base, link in sorted(pairs)]


def _fill_meshes(path: Path, spec: mujoco.MjSpec, files: Mapping[str, Path]) -> None:
    """Set each mesh's file, or its triangles, with a warning, where MuJoCo cannot read the format."""
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
    """Return a URDF's text, adapted for MuJoCo, and the file of each mesh by the stem of its name in the text.

    `package://` and `model://` are looked up in the folders above the file: by the name in a `package.xml`, or the folder's.
    A moving link without mass or geometry gets `LEAST_MASS`; an unphysical inertia becomes a ball's.

    Raises:
        RobotError: If the file is not XML, or a mesh file is missing.
    """
    robot = _root(path)
    _number_names(robot)
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
    joints = [joint for joint in robot.iter("joint") if joint.get("type") != "fixed"]
    moving = {child.get("link", "") for joint in joints for child in joint.iter("child")}
    mended = [link.get("name", "") for link in robot.iter("link") if _mend(link, moving)]
    if mended:
        warnings.warn(f"{path}: inertias that no body can have were mended: {listed(mended)}", stacklevel=5)
    settings = robot.find("mujoco")
    settings = ET.SubElement(robot, "mujoco") if settings is None else settings
    compiler = settings.find("compiler")
    compiler = ET.SubElement(settings, "compiler") if compiler is None else compiler
    compiler.attrib |= {"strippath": "false", "fusestatic": "false", "discardvisual": "false", "meshdir": ""}
    return ET.tostring(robot, encoding="unicode"), files


def _root(path: Path) -> ET.Element:
    """Return a URDF's root without tags of other programs, whose prefixes may be undeclared."""
    content = path.read_bytes()
    try:
        root = ET.fromstring(content)
    except ET.ParseError as error:
        if "unbound prefix" not in str(error):
            raise RobotError(f"{path}: not XML: {error}") from error
        text = content.decode(errors="replace")
        prefixes = sorted(set(_PREFIX.findall(text)) - {"xml", "xmlns"})
        declared = "".join(f' xmlns:{prefix}="{prefix}"' for prefix in prefixes)
        try:
            root = ET.fromstring(_ROOT.sub(f"<robot{declared}", text, count=1))
        except ET.ParseError:
            raise RobotError(f"{path}: not XML: {error}") from error
    if any(isinstance(part.tag, str) and part.tag.partition("}")[0].endswith("xacro") for part in root.iter()):
        raise RobotError(f"{path}: this is xacro, make URDF from it: xacro {path.name} > {path.name.partition('.')[0]}.urdf")
    for parent in list(root.iter()):
        for child in [child for child in parent if isinstance(child.tag, str) and child.tag.startswith("{")]:
            parent.remove(child)
    return root


def _number_names(robot: ET.Element) -> None:
    """Give geoms whose name another has too a number: the second `pad` is `pad_2`."""
    geoms = [part for link in robot.iter("link") for part in (*link.findall("collision"), *link.findall("visual"))]
    names = {part.get("name", "") for part in geoms}
    seen: set[str] = set()
    for part in geoms:
        name = unique = part.get("name", "")
        number = 1
        while unique in seen or (number > 1 and unique in names):
            number += 1
            unique = f"{name}_{number}"
        seen |= {unique} - {""}
        part.set("name", unique)


def _mesh_file(name: str, urdf: Path) -> Path:
    scheme, _, inside = name.partition("://")
    folders = urdf.resolve().parents
    if scheme in ("package", "model"):
        package, _, rest = inside.partition("/")
        packages = [folder / rest for folder in folders if package in (folder.name, _package_name(folder))]
        files, problem = [*packages, *(folder / inside for folder in folders)], f'no folder above the file holds "{inside}"'
    else:
        files = [folders[0] / name.removeprefix("file://")]
        problem = f"there is no file {files[0]}"
    for file in files:
        if file.is_file():
            return file
    raise RobotError(f'{urdf}: mesh "{name}": {problem}{in_other_case(files)}')


def _package_name(folder: Path) -> str | None:
    """Return the name that a ROS package gives itself; None if this folder is none."""
    file = folder / "package.xml"
    try:
        return ET.parse(file).getroot().findtext("name", "").strip() if file.is_file() else None
    except ET.ParseError as error:
        raise RobotError(f"{file}: not XML: {error}") from error


def _mend(link: ET.Element, moving: Collection[str]) -> bool:
    """Replace the link's inertia if its principal moments are missing, not positive or break the triangle inequality."""
    inertial, inertia = link.find("inertial"), link.find("inertial/inertia")
    if inertial is None:
        if link.get("name") not in moving or link.find("collision") is not None or link.find("visual") is not None:
            return False
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", {"value": "0"})
    mass = inertial.find("mass")
    if mass is not None and link.get("name") in moving and float(mass.get("value", "0")) <= 0.0:
        mass.set("value", repr(LEAST_MASS))
    if inertia is None:
        inertia = ET.SubElement(inertial, "inertia")
    try:
        xx, yy, zz, xy, xz, yz = (float(inertia.get(f"i{axes}", "0")) for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
    except ValueError:
        return False  # MuJoCo will name the line
    low, middle, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if low > 0 and low + middle >= high * (1 + EDGE):
        return False
    if low > 0 and low + middle >= high * (1 - EDGE):
        for axes, moment in zip(("xx", "yy", "zz"), (xx, yy, zz), strict=True):
            inertia.set(f"i{axes}", repr(float(moment + 2 * EDGE * high)))
        return False
    moment = max((xx + yy + zz) / 3.0, LEAST_INERTIA)
    for axes in ("xx", "yy", "zz"):
        inertia.set(f"i{axes}", repr(moment))
    for axes in ("xy", "xz", "yz"):
        inertia.set(f"i{axes}", "0")
    return True
