"""The triangles of a model's bodies, and which bodies are the robot's.

Shapes: `face` triangles.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.layout.layout import Link
from tgdsl.scene.scene import is_absent
from tgdsl.surfaces.geom import round_shape
from tgdsl.view.markers import Pose
from tgdsl.view.raster import Mesh

Array = np.ndarray
GeomType = mujoco.mjtGeom
_NO_COLOUR = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default for geoms: a material counts where a geom has this colour
_PRIMITIVES = {
    GeomType.mjGEOM_BOX: lambda size: trimesh.creation.box(2 * size),
    GeomType.mjGEOM_SPHERE: lambda size: trimesh.creation.icosphere(subdivisions=3, radius=size[0]),
    GeomType.mjGEOM_ELLIPSOID: lambda size: trimesh.creation.icosphere(subdivisions=3).apply_scale(size),
    GeomType.mjGEOM_CYLINDER: lambda size: round_shape(trimesh.creation.cylinder, size, sections=64),
    GeomType.mjGEOM_CAPSULE: lambda size: round_shape(trimesh.creation.capsule, size, count=[32, 32]),
}


def robot_bodies(model: mujoco.MjModel, carriers: set[int]) -> tuple[set[int], set[int]]:
    """Return the bodies to fit in the view (the smallest subtree that holds all carriers of taxels), and all of the robot's."""
    above = [[0]]
    for body in range(1, model.nbody):
        above.append([*above[model.body_parentid[body]], body])
    roots = {int(model.body_rootid[body]) for body in carriers}
    robot = {body for body in range(model.nbody) if model.body_rootid[body] in roots}
    root = max(set.intersection(*(set(above[body]) for body in carriers)))
    return {body for body in robot if root in above[body]}, robot


def mesh_of(model: mujoco.MjModel, pose: Pose, bodies: set[int], links: Iterable[Link] = ()) -> Mesh:
    """Return the triangles of some bodies in the world: see `body_surfaces`."""
    parts = [Mesh(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0, dtype=np.int64))]
    links = list(links)
    for body in sorted(bodies):
        rotation = Rotation.from_quat(pose.quat[body], scalar_first=True).as_matrix().T
        for corners, normals, _ in body_surfaces(model, body, links):
            parts.append(Mesh(corners @ rotation + pose.pos[body], normals @ rotation, np.full(len(corners), body)))
    return Mesh(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class Surface(NamedTuple):
    """Triangles of one colour in the frame of their body."""

    corners: Float[Array, "face 3 3"]  # [m]
    normals: Float[Array, "face 3 3"]
    colour: tuple[float, float, float, float] | None  # red, green, blue, opacity, from 0 to 1; None: the model gives none


def body_surfaces(model: mujoco.MjModel, body: int, links: Iterable[Link] = ()) -> list[Surface]:
    """Return the triangles of a body by colour: of its geoms that collide, or else of all; no planes.

    If one of `links` has its taxels on a geom or mesh that does not collide, the non-colliding geoms are shown instead.
    """
    by_colour: dict[tuple[float, float, float, float] | None, list[tuple[Array, Array]]] = {}
    for geom in _shown_geoms(model, body, links):
        corners, normals = _triangles(model, geom)
        rotation = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).as_matrix().T
        if len(corners):
            part = corners @ rotation + model.geom_pos[geom], normals @ rotation
            by_colour.setdefault(geom_colour(model, geom), []).append(part)
    return [
        Surface(np.concatenate([corners for corners, _ in parts]), np.concatenate([normals for _, normals in parts]), colour)
        for colour, parts in by_colour.items()
    ]


def geom_colour(model: mujoco.MjModel, geom: int) -> tuple[float, float, float, float] | None:
    """Return a geom's colour, or else its material's times the mean of the material's texture; None if it has neither."""
    geom_rgba, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    if not np.allclose(geom_rgba, _NO_COLOUR) or material < 0:
        return None if np.allclose(geom_rgba, _NO_COLOUR) else tuple(geom_rgba.tolist())
    rgba = model.mat_rgba[material].astype(np.float64)
    texture = int(model.mat_texid[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    if texture >= 0:
        channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
        num = int(model.tex_height[texture]) * int(model.tex_width[texture])
        pixels = model.tex_data[start : start + channels * num].reshape(num, channels)
        rgba[:3] *= pixels[:, :3].mean(axis=0) / 255
    return tuple(rgba.tolist())


def _shown_geoms(model: mujoco.MjModel, body: int, links: Iterable[Link]) -> list[int]:
    names = {link.name for link in links}
    geoms = [i for i in range(model.ngeom) if model.geom_bodyid[i] == body and not is_absent(model, i)]
    colliding = [i for i in geoms if model.geom_contype[i] or model.geom_conaffinity[i]]
    passive = [i for i in geoms if i not in colliding]
    is_on_passive = any(names & _names(model, i) for i in passive) and not any(names & _names(model, i) for i in colliding)
    return (passive if is_on_passive else colliding) or geoms


def _names(model: mujoco.MjModel, geom: int) -> set[str]:
    mesh = model.mesh(model.geom_dataid[geom]).name if model.geom_dataid[geom] >= 0 else ""
    return {model.geom(geom).name, mesh, f"{model.body(model.geom_bodyid[geom]).name}/{mesh}"} - {""}


def _triangles(model: mujoco.MjModel, geom: int) -> tuple[Float[Array, "face 3 3"], Float[Array, "face 3 3"]]:
    """Return corners and normals of a geom in its own frame; none of one without a bounded surface."""
    kind, mesh = GeomType(int(model.geom_type[geom])), int(model.geom_dataid[geom])
    if kind in (GeomType.mjGEOM_MESH, GeomType.mjGEOM_SDF) and mesh >= 0:
        first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        vertices = model.mesh_face[first : first + count] + model.mesh_vertadr[mesh]
        normals = model.mesh_facenormal[first : first + count] + model.mesh_normaladr[mesh]
        return model.mesh_vert[vertices].astype(np.float64), model.mesh_normal[normals].astype(np.float64)
    if kind not in _PRIMITIVES:
        return np.zeros((0, 3, 3)), np.zeros((0, 3, 3))
    shape = _PRIMITIVES[kind](model.geom_size[geom])
    shape.apply_translation(-shape.bounds.mean(axis=0))  # trimesh puts capsules elsewhere in some versions
    is_flat = kind in (GeomType.mjGEOM_BOX, GeomType.mjGEOM_CYLINDER)
    normals = shape.face_normals[:, None].repeat(3, axis=1) if is_flat else shape.vertex_normals[shape.faces]
    return np.array(shape.triangles), normals


def shapes_of(model: mujoco.MjModel) -> bytes:
    """Return what differs between models of the same bodies whose objects differ."""
    names = ("geom_size", "geom_type", "geom_dataid", "geom_pos", "geom_contype", "numeric_data")
    return b"".join(getattr(model, name).tobytes() for name in names)
