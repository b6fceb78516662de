"""Triangles to pixels: an orthographic camera, a z-buffer and simple shading, in NumPy; no GL, no display.

Shapes: `taxel` taxels of one sensor or layout, `face` triangles, `h` and `w` rows and columns of pixels, row 0 at the bottom.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from tgdsl.scene.scene import is_absent
from tgdsl.view.dots import Dots, Pose, Taxels

Array = np.ndarray
GeomType = mujoco.mjtGeom
_PRIMITIVES = {
    GeomType.mjGEOM_BOX: lambda size: trimesh.creation.box(2 * size),
    GeomType.mjGEOM_SPHERE: lambda size: trimesh.creation.icosphere(subdivisions=3, radius=size[0]),
    GeomType.mjGEOM_ELLIPSOID: lambda size: trimesh.creation.icosphere(subdivisions=3).apply_scale(size),
    GeomType.mjGEOM_CYLINDER: lambda size: trimesh.creation.cylinder(size[0], 2 * size[1], sections=64),
    GeomType.mjGEOM_CAPSULE: lambda size: trimesh.creation.capsule(2 * size[1], size[0], count=[32, 32]),
}


class Camera(NamedTuple):
    """An orthographic camera: image axes and viewing direction as unit vectors of the world, and a point that it looks at."""

    right: Float[Array, " 3"]
    up: Float[Array, " 3"]
    toward: Float[Array, " 3"]
    centre: Float[Array, " 3"]

    def project(self, points: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return image x, image y and nearness to the camera [m], from the centre."""
        return (points - self.centre) @ np.stack([self.right, self.up, self.toward]).T


class Screen(NamedTuple):
    """The pixels that a camera fills.

    Attributes:
        camera: The camera.
        corner: The lower left pixel on the camera's image [m].
        scale: Pixels per metre.
        width: Number of columns.
        height: Number of rows.
    """

    camera: Camera
    corner: Float[Array, " 2"]
    scale: float
    width: int
    height: int

    def project(self, points: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return column [pixel], row [pixel] and nearness to the camera [m]."""
        placed = self.camera.project(points)
        placed[..., :2] = (placed[..., :2] - self.corner) * self.scale
        return placed


class Solid(NamedTuple):
    """Triangles in the world: corners [m], unit normals at the corners, and the body of each."""

    corners: Float[Array, "face 3 3"]
    normals: Float[Array, "face 3 3"]
    body: Int[Array, " face"]


class Shot(NamedTuple):
    """What each pixel shows: nearness [m] (−inf: nothing), the face, and the weights of its corners."""

    near: Float[Array, "h w"]
    face: Int[Array, "h w"]
    weights: Float[Array, "h w 3"]


def camera_for(dots: Dots, root: Float[Array, " 3"]) -> Camera:
    """Return a camera that the most strongly read taxels face, a little from the side.

    Args:
        dots: The taxels; where none reads anything, all count alike.
        root: Where the hand begins [m]: the image's up is the world's, or else leads away from here.
    """
    weight = dots.value if dots.is_read.any() else np.ones(len(dots.value))
    toward = unit(weight @ dots.normal, np.array([0.0, 0.0, 1.0]))
    along = dots.pos.mean(axis=0) - root
    for up in (np.array([0.0, 0.0, 1.0]), along, np.array([0.0, 1.0, 0.0])):
        across = up - (up @ toward) * toward
        if np.linalg.norm(across) > 0.5 * np.linalg.norm(up) > 0:
            break
    up = unit(across, up)
    toward = unit(toward - 0.38 * up + 0.28 * np.cross(up, toward), toward)
    right = unit(np.cross(up, toward), up)
    return Camera(right, np.cross(toward, right), toward, dots.pos.mean(axis=0))


def screen_for(camera: Camera, box: Float[Array, "2 2"], width: int, height: int) -> Screen:
    """Return the screen that shows a part of the camera's image, lower and upper corner [m], as large as it can."""
    scale = min(width / (box[1, 0] - box[0, 0]), height / (box[1, 1] - box[0, 1]))
    return Screen(camera, box.mean(axis=0) - np.array([width, height]) / 2 / scale, scale, width, height)


def is_seen(dots: Taxels, at: Array, shot: Shot, camera: Camera) -> Bool[Array, " taxel"]:
    """Return which taxels face the camera with nothing of the robot between."""
    height, width = shot.near.shape
    column = np.clip(np.rint(at[:, 0]), 0, width - 1).astype(int)
    row = np.clip(np.rint(at[:, 1]), 0, height - 1).astype(int)
    slack = np.maximum(0.2 * dots.size, 5e-4)  # [m] for taxels a little under the surface
    return (dots.normal @ camera.toward > 0) & (at[:, 2] + slack >= shot.near[row, column])


def robot_bodies(model: mujoco.MjModel, carriers: set[int]) -> tuple[set[int], set[int]]:
    """Return the bodies to fit in the view (the smallest subtree that holds all carriers of taxels), and all of the robot's."""
    above = [[0]]
    for body in range(1, model.nbody):
        above.append([*above[model.body_parentid[body]], body])
    roots = {int(model.body_rootid[body]) for body in carriers}
    robot = {body for body in range(model.nbody) if model.body_rootid[body] in roots}
    top = max(set.intersection(*(set(above[body]) for body in carriers)))
    return {body for body in robot if top in above[body]}, robot


def solid_of(model: mujoco.MjModel, pose: Pose, bodies: set[int]) -> Solid:
    """Return the triangles of some bodies: of their geoms that collide, or else of all; planes not."""
    parts = [Solid(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0, dtype=np.int64))]
    for body in sorted(bodies):
        own = [i for i in range(model.ngeom) if model.geom_bodyid[i] == body and not is_absent(model, i)]
        for geom in [i for i in own if model.geom_contype[i] or model.geom_conaffinity[i]] or own:
            corners, normals = _triangles(model, geom)
            in_body = Rotation.from_quat(model.geom_quat[geom], scalar_first=True)
            in_world = Rotation.from_quat(pose.quat[body], scalar_first=True)
            centre = pose.pos[body] + in_world.apply(model.geom_pos[geom])
            matrix = (in_world * in_body).as_matrix().T
            parts.append(Solid(corners @ matrix + centre, normals @ matrix, np.full(len(corners), body)))
    return Solid(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


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
    flat = kind in (GeomType.mjGEOM_BOX, GeomType.mjGEOM_CYLINDER)
    return np.array(shape.triangles), shape.face_normals[:, None].repeat(3, axis=1) if flat else shape.vertex_normals[
        shape.faces
    ]


def rasterise(corners: Float[Array, "face 3 3"], width: int, height: int) -> Shot:
    """Return what each pixel shows: the nearest triangle, by z-buffer.

    Args:
        corners: Corners as (column [pixel], row [pixel], nearness [m]).
        width: Number of columns.
        height: Number of rows.
    """
    face, row, left, right = _spans(corners, width, height)
    count = np.maximum(right - left + 1, 0)
    inside = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    face, row, column = np.repeat(face, count), np.repeat(row, count), np.repeat(left, count) + inside
    edges = corners[:, 1:, :2] - corners[:, :1, :2]
    inverse = np.linalg.pinv(edges) if len(edges) else edges
    relative = np.stack([column, row], axis=-1) - corners[face, 0, :2]
    second = np.einsum("pi,pij->pj", relative, inverse[face])
    weights = np.clip(np.column_stack([1 - second.sum(axis=1), second]), 0, 1)
    nearness = (weights * corners[face, :, 2]).sum(axis=1)
    pixel = row * width + column
    near = np.full(height * width, -np.inf)
    np.maximum.at(near, pixel, nearness)
    won = nearness == near[pixel]
    shot = Shot(near, np.full(height * width, -1), np.zeros((height * width, 3)))
    shot.face[pixel[won]] = face[won]
    shot.weights[pixel[won]] = weights[won]
    return Shot(*(part.reshape(height, width, *part.shape[1:]) for part in shot))


def _spans(corners: Array, width: int, height: int) -> tuple[Array, Array, Array, Array]:
    """Return face, row, first and last column of each run of pixels that a triangle covers in a row."""
    low = np.clip(np.ceil(corners[:, :, 1].min(axis=1)), 0, height).astype(int)
    high = np.clip(np.floor(corners[:, :, 1].max(axis=1)), -1, height - 1).astype(int)
    count = np.maximum(high - low + 1, 0)
    face = np.repeat(np.arange(len(corners)), count)
    row = np.repeat(low, count) + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    left, right = np.full(len(face), np.inf), np.full(len(face), -np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        (x, y), (x_end, y_end) = corners[face, first, :2].T, corners[face, second, :2].T
        rise = np.where(y_end == y, np.nan, y_end - y)
        part = (row - y) / rise
        crossing = np.where((part >= 0) & (part <= 1), x + part * (x_end - x), np.nan)
        left, right = np.fmin(left, crossing), np.fmax(right, crossing)
    left, right = np.where(left > right, 1, left), np.where(left > right, 0, right)
    first = np.clip(np.ceil(left - 1e-9), 0, width).astype(int)
    return face, row, first, np.clip(np.floor(right + 1e-9), -1, width - 1).astype(int)


def shaded(image: Array, shot: Shot, solid: Solid, colour: Array, camera: Camera, opacity: float, scale: float) -> Array:
    """Return the image with a solid drawn over it: lit from the upper right, edges in depth drawn dark."""
    drawn = shot.face >= 0
    face, weights = shot.face[drawn], shot.weights[drawn]
    normal = np.einsum("pi,pij->pj", weights, solid.normals[face])
    normal *= np.where(normal @ camera.toward < 0, -1, 1)[:, None]
    lit = 0.55 + 0.5 * np.clip(normal @ lamp(camera), 0, 1)
    image[drawn] += opacity * (np.minimum(colour[face] * lit[:, None], 1) - image[drawn])
    near = np.where(drawn, shot.near, -1.0)
    jump = np.maximum(*(np.abs(np.diff(near, axis=axis, append=near.take([-1], axis))) for axis in (0, 1)))
    image[jump > np.maximum(6 / scale, 0.002)] *= 0.62
    return image


def lamp(camera: Camera) -> Float[Array, " 3"]:
    """Return the direction to the light: behind the camera, to the upper right."""
    return unit(0.85 * camera.toward + 0.4 * camera.up + 0.35 * camera.right, camera.toward)


def smaller(image: Float[Array, "h w 3"], factor: int) -> Array:
    """Return an image with `factor` times fewer rows and columns, each pixel the mean of those that it replaces."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))


def unit(vector: Array, otherwise: Array) -> Array:
    """Return a vector at unit length, or another one where it vanishes."""
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else otherwise
