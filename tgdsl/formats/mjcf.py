"""MJCF: read by MuJoCo itself, and written with its in-line meshes as files."""

from __future__ import annotations

import hashlib
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import mujoco

from tgdsl.errors import listed
from tgdsl.files.write import atomic_write_all
from tgdsl.formats.mesh_files import in_other_case, refuse_unreadable
from tgdsl.formats.model import Model
from tgdsl.scene.scene import num_objects, readable


def read_mjcf(path: Path) -> Model:
    """Read and compile an MJCF file.

    Raises:
        RobotError: If it names meshes that MuJoCo does not read.
        ValueError: If MuJoCo cannot read or compile it.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    refuse_unreadable(path, spec)
    rewritten = rewrite_meshes(spec)
    try:
        compiled = spec.copy().compile()  # a copy: compiling stores results in the spec, such as hulls that geoms may not need
    except ValueError as error:
        files = [Path(spec.modelfiledir, spec.meshdir, mesh.file) for mesh in spec.meshes if mesh.file]
        raise ValueError(f"{error}{in_other_case(file for file in files if not file.is_file())}") from error
    return Model(path, spec, compiled, is_rounded=False, rewritten=rewritten)


def rewrite_meshes(spec: mujoco.MjSpec) -> dict[str, Path]:
    """Rewrite in memory a model's mesh files that MuJoCo cannot read; return the files by their new names."""
    files, whole = {}, []
    for mesh in spec.meshes:
        file = Path(spec.modelfiledir, spec.meshdir, mesh.file)
        if file.is_file() and (content := readable(mesh.file, original := file.read_bytes())) is not original:
            if (num := num_objects(original)) > 1:
                whole.append(f"{file.name} ({num})")
            # MuJoCo knows files in memory by their names, without folders.
            key = f"{hashlib.sha256(content).hexdigest()}{file.suffix.lower()}"
            spec.assets[key], files[key] = content, file
            mesh.name, mesh.file = mesh.name or file.stem, key
    if whole:
        problem = "MuJoCo reads the first object of an OBJ file alone; here those with several are read whole"
        warnings.warn(f"{problem}: {listed(whole)}; other programs simulate the first of them", stacklevel=5)
    return files


def mjcf_of(spec: mujoco.MjSpec) -> str:
    """Return a compiled spec as MJCF that MuJoCo compiles again."""
    root = ET.fromstring(spec.to_xml())
    for inertial in root.iter("inertial"):
        moments = [float(moment) for moment in inertial.get("diaginertia", "").split()]
        if moments and max(moments) > (bound := sum(moments) - max(moments)):
            moments[moments.index(max(moments))] = bound * (1.0 - 1e-12)
            inertial.set("diaginertia", " ".join(map(repr, moments)))
    return ET.tostring(root, encoding="unicode")


def xml_files(path: Path) -> Iterator[Path]:
    """Yield a model file and all the files that it includes or attaches, each once."""
    seen: list[Path] = []
    waiting = [path.resolve()]
    while waiting:
        current = waiting.pop(0)
        if current in seen or not current.is_file():
            continue
        seen.append(current)
        yield current
        try:
            root = ET.parse(current).getroot()
        except ET.ParseError:
            continue
        for element in root.iter():
            if element.tag in ("include", "model") and element.get("file"):
                waiting.append((current.parent / element.get("file", "")).resolve())


def write_mjcf(text: str, out: Path) -> None:
    """Write MJCF, with its inline meshes as `.obj` files in the folder `<stem>_assets` next to it.

    On an error no partial output is left.

    Raises:
        FileError: If it cannot be written.
    """
    root, out = ET.fromstring(text), Path(out)
    folder, contents = out.with_name(f"{out.stem}_assets"), {}
    names: list[str] = []
    for mesh in root.iterfind("asset/mesh[@vertex]"):
        name = _file_name(mesh.get("name", ""), names)
        points, corners = mesh.attrib.pop("vertex").split(), [int(index) + 1 for index in mesh.attrib.pop("face").split()]
        lines = [f"v {' '.join(points[i : i + 3])}" for i in range(0, len(points), 3)]
        lines += [f"f {' '.join(map(str, corners[i : i + 3]))}" for i in range(0, len(corners), 3)]
        contents[folder / name] = "\n".join([*lines, ""]).encode()
        mesh.set("file", name)
    if names:
        root.findall("compiler")[0].set("meshdir", folder.name)
    ET.indent(root)
    contents[out] = (ET.tostring(root, encoding="unicode") + "\n").encode()
    atomic_write_all(contents)


def _file_name(name: str, taken: list[str]) -> str:
    """Return a file name for a mesh, and take it; names that only differ in case are one on some file systems."""
    stem = re.sub(r"[^\w.-]", "_", name) or "mesh"
    file, number = f"{stem}.obj", 1
    while file.lower() in map(str.lower, taken):
        number += 1
        file = f"{stem}_{number}.obj"
    taken.append(file)
    return file
