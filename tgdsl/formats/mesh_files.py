"""Mesh files that MuJoCo does not read itself, read by trimesh: glTF, COLLADA, PLY and OFF.

A file's scene becomes one mesh, with each node's transform applied; materials and textures are left out. Coordinates stay in
the file's frame: glTF's are metres with Y up by its specification, and are not rotated to Z up. yourdfpy, trimesh, three.js'
urdf-loader and SAPIEN do the same, and most glTF files of hands target them (dex-urdf's are in link frames); RViz 2 since
2025 and Drake rotate them. COLLADA's `up_axis` is ignored too, as by RViz; its unit is applied, as by most URDF loaders.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import RobotError, listed

BY_MUJOCO = (".stl", ".obj", ".msh")  # endings of the mesh files that MuJoCo reads
BY_TRIMESH = (".glb", ".gltf", ".dae", ".ply", ".off")  # endings of the mesh files read here
Y_UP = (".glb", ".gltf", ".dae")  # endings of formats whose up axis is, or may be, Y
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")
"""Prefixes of glTF extensions that do not change triangles."""
DIGITS = 6  # significant digits of coordinates: what MuJoCo writes in MJCF


def triangles(file: Path) -> tuple[Float[np.ndarray, "vertex 3"], Int[np.ndarray, "face 3"]]:
    """Return the vertices and faces of a mesh file, in its own unit (COLLADA's in metres); equal vertices are one."""
    import trimesh

    kwargs: dict[str, Any] = {}
    if file.suffix.lower() in (".glb", ".gltf"):
        kwargs["skip_materials"] = True
        _check_extensions(file)
    try:
        scene = trimesh.load_scene(file, **kwargs)
        mesh = scene.to_mesh()
    except ImportError as error:
        raise RobotError(f"{file}: this mesh needs another package: {error}; or convert it to .stl or .obj") from error
    except Exception as error:  # trimesh raises whatever its parsers do
        raise RobotError(f"{file}: trimesh cannot read this mesh: {type(error).__name__}: {error}") from error
    if file.suffix.lower() == ".dae":
        mesh.apply_scale(trimesh.units.unit_conversion(scene.units or "meters", "meters"))
    vertices = np.array([[float(f"{x:.{DIGITS}g}") for x in vertex] for vertex in np.asarray(mesh.vertices)]).reshape(-1, 3)
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)]
    one, two, three = faces.T
    faces = faces[(one != two) & (two != three) & (three != one)]
    if not len(faces):
        raise RobotError(f"{file}: this mesh file holds no triangles")
    return vertices, faces.astype(np.int64)


def put_in_line(mesh: mujoco.MjsMesh, file: Path) -> None:
    """Give a mesh of a MuJoCo model the triangles of a file instead of the file's name; a flat mesh weighs as a shell."""
    vertices, faces = triangles(file)
    mesh.file = ""
    mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
    if np.linalg.matrix_rank(vertices - vertices[0], tol=1e-6 * np.ptp(vertices)) < 3:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def in_other_case(files: Iterable[Path]) -> str:
    """Return the end of a message on missing files, which names a file whose name differs in case alone; empty if none does."""
    alike = [other.name for file in files for other in file.parent.glob("*") if other.name.lower() == file.name.lower()]
    return f"; there is {alike[0]}" if alike else ""


def refuse_unreadable(model_file: Path, spec: mujoco.MjSpec) -> None:
    """Refuse MJCF that names meshes that MuJoCo does not read."""
    named = {mesh.file for mesh in spec.meshes if mesh.file and not mesh.content_type}
    if wrong := sorted(name for name in named if Path(name).suffix.lower() not in BY_MUJOCO):
        problem = f"MJCF's meshes are files of {listed(BY_MUJOCO)}, found {listed(wrong)}"
        raise RobotError(f"{model_file}: {problem}; convert them, such as by trimesh.load_scene(FILE).to_mesh().export(OTHER)")


def _check_extensions(file: Path) -> None:
    content = file.read_bytes()
    if content[:4] == b"glTF":
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    try:
        extensions = json.loads(content).get("extensionsRequired", [])
    except (ValueError, AttributeError) as error:
        raise RobotError(f"{file}: not glTF 2.0: {error}") from error
    if unknown := [name for name in extensions if not name.startswith(_HARMLESS)]:
        raise RobotError(f"{file}: this mesh is stored by {listed(unknown)}, which cannot be read; export it without")
