"""USD geometry as MuJoCo's shapes in a body's frame: primitives where their scale allows, else meshes; volume, inertia."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from tgdsl.formats.usd.stage import Matrix, Prim, Stage, rotation_and_scale
from tgdsl.surfaces.surface import Surface, merged

CIRCULAR = 1e-5  # relative difference of two scales up to which a circle stays one: scales are often authored in float32
CONVEX = 1e-3  # a closed mesh whose volume is less than its hull's by at most this share counts as convex
FLAT = 1e-6  # a mesh whose thickness is at most this share of its length has no hull
SCHEMAS = ("Mesh", "Cube", "Sphere", "Capsule", "Capsule_1", "Cylinder", "Cylinder_1", "Cone", "Plane")
"""Geometry that can be read."""
SECTIONS = 64  # corners of a circle where a round shape becomes a mesh: its area is 0.16 % too small
Vertices = Float[np.ndarray, "vertex 3"]
Faces = Int[np.ndarray, "face 3"]
MassProperties = tuple[float, Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]


@dataclass(frozen=True, eq=False)
class Shape:
    """A shape in its body's frame."""

    kind: str  # MuJoCo's name of its type
    size: tuple[float, ...]  # its size as MuJoCo defines it [m]
    pose: Matrix  # its frame in the body frame [m]
    vertices: Vertices | None = None  # of a mesh, in the shape's frame [m]
    faces: Faces | None = None  # of a mesh; they look outwards

    @cached_property
    def hull(self) -> trimesh.Trimesh | None:
        """The hull of a mesh, or None if it is flat."""
        assert self.vertices is not None
        spread = np.linalg.svd(self.vertices - self.vertices.mean(axis=0), compute_uv=False)
        if len(self.vertices) < 4 or spread[2] <= FLAT * spread[0]:
            return None
        return trimesh.convex.convex_hull(self.vertices)

    @property
    def is_convex(self) -> bool:
        hull, closed = self.hull, self._closed
        return hull is not None and closed is not None and bool(closed.volume >= (1 - CONVEX) * hull.volume)

    @cached_property
    def _closed(self) -> trimesh.Trimesh | None:
        assert self.vertices is not None and self.faces is not None
        vertices, faces, _ = merged(Surface(self.vertices, self.faces, np.zeros(len(self.faces), int), ((),)))
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return mesh if mesh.is_volume else None

    def mass_properties(self, is_hull: bool) -> MassProperties:
        """Return volume [m³], centre of mass [m] and inertia about it at density one [m⁵], in the body's frame."""
        if self.kind != "mesh":
            return self.mujoco_mass_properties()
        solid = None if is_hull else self._closed
        solid = self.hull if solid is None else solid
        if solid is None:
            return 0.0, np.zeros(3), np.zeros((3, 3))
        rotation = self.pose[:3, :3]
        return (
            float(solid.volume),
            rotation @ np.asarray(solid.center_mass) + self.pose[:3, 3],
            rotation @ np.asarray(solid.moment_inertia) @ rotation.T,
        )

    def mujoco_mass_properties(self, model: str = "") -> MassProperties:
        """Return the same as MuJoCo computes it, or of a shell its area [m²]."""
        spec = mujoco.MjSpec()
        geom = spec.worldbody.add_body().add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{self.kind.upper()}"), density=1.0)
        geom.pos, geom.quat = self.pose[:3, 3], quaternion(self.pose)
        if self.kind == "mesh":
            assert self.vertices is not None and self.faces is not None
            inertia = getattr(mujoco.mjtMeshInertia, f"mjMESH_INERTIA_{model.upper()}")
            vertices, faces = self.vertices.ravel().tolist(), self.faces.ravel().tolist()
            spec.add_mesh(name="mesh", uservert=vertices, userface=faces, inertia=inertia)
            geom.meshname = "mesh"
        else:
            geom.size[: len(self.size)] = self.size
            if model:
                geom.typeinertia = mujoco.mjtGeomInertia.mjINERTIA_SHELL
        compiled = spec.compile()
        axes = Rotation.from_quat(compiled.body_iquat[1], scalar_first=True).as_matrix()
        return float(compiled.body_mass[1]), compiled.body_ipos[1].copy(), axes @ np.diag(compiled.body_inertia[1]) @ axes.T


def shape_of(stage: Stage, prim: Prim, place: Matrix) -> Shape:
    """Return the shape of a prim of `SCHEMAS`."""
    schema = str(prim.GetTypeName())
    if schema == "Mesh":
        return mesh_shape(*read_mesh(stage, prim), place)
    if schema == "Plane":
        return _plane_shape(stage, prim, place)
    split = rotation_and_scale(place[:3, :3])
    if schema == "Sphere":
        return _sphere_shape(_sizes(stage, prim, "radius")[0], np.zeros(3), place)
    if schema == "Cube":
        half = _sizes(stage, prim, "size")[0] / 2
        return box_shape(np.full(3, -half), np.full(3, half), place)
    axis = str(stage.value(prim, "axis"))
    half = _sizes(stage, prim, "height", is_least_zero=schema.startswith("Capsule"))[0] / 2
    if schema.endswith("_1"):
        low, high = _sizes(stage, prim, "radiusBottom", "radiusTop", is_least_zero=True)
    else:
        low, high = (_sizes(stage, prim, "radius")[0],) * 2
    across, along = _scales(split[1] if split else None, axis)
    pose = place.copy()
    pose[:3, :3] = (split[0] if split else np.eye(3)) @ rotation_from_z(axis)
    if schema.startswith("Cylinder"):
        if low == high and across:
            return Shape("cylinder", (low * across, half * along), pose)
        return mesh_shape(*surface_of_revolution([(low, -half), (high, half)], axis), place)
    if schema.startswith("Capsule"):
        if low == high and across and abs(across - along) <= CIRCULAR * along:
            return Shape("capsule", (low * across, half * along), pose) if half else Shape("sphere", (low * across,), pose)
        return mesh_shape(*surface_of_revolution(capsule_profile(high, -half, half, low), axis), place)
    return mesh_shape(*surface_of_revolution([(low, -half), (0.0, half)], axis), place)


def _sizes(stage: Stage, prim: Prim, *names: str, is_least_zero: bool = False) -> list[float]:
    values = [stage.number(prim, name) for name in names]
    for name, value in zip(names, values, strict=True):
        if not np.isfinite(value) or value < 0 or (value == 0 and not is_least_zero):
            raise stage.error(prim, f"{name} is {value!r}; expected more than 0")
    return values


def _scales(scale: Float[np.ndarray, " 3"] | None, axis: str) -> tuple[float, float]:
    """Return the scale across an axis and along it; zero across if it is not the same all around, or there is shear."""
    if scale is None:
        return 0.0, 0.0
    along = "XYZ".index(axis)
    first, second = np.abs(np.delete(scale, along))
    return (float(first) if abs(first - second) <= CIRCULAR * first else 0.0), float(abs(scale[along]))


def mesh_shape(vertices: Vertices, faces: Faces, place: Matrix) -> Shape:
    """Return a mesh: its scale goes into its vertices, the rest of the transform into its pose."""
    linear, pose = place[:3, :3], place.copy()
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
    split = rotation_and_scale(linear)
    if split is None:
        pose[:3, :3] = np.eye(3)
        return Shape("mesh", (), pose, vertices @ linear.T, faces)
    pose[:3, :3], scale = split
    return Shape("mesh", (), pose, vertices * scale, faces)


def box_shape(low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"], place: Matrix) -> Shape:
    """Return the box between two corners of a prim's space, as a mesh where shear makes it none."""
    split = rotation_and_scale(place[:3, :3])
    if split is None:
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
        faces = np.asarray(trimesh.creation.box().faces, dtype=np.int64)  # its corners come in the same order
        return mesh_shape(corners, faces, place)
    pose = place.copy()
    pose[:3, :3], scale = split
    pose[:3, 3] += place[:3, :3] @ ((low + high) / 2)
    x, y, z = (np.abs(scale) * (high - low) / 2).tolist()
    return Shape("box", (x, y, z), pose)


def _sphere_shape(radius: float, centre: Float[np.ndarray, " 3"], place: Matrix) -> Shape:
    """Return a ball under any linear map: an ellipsoid along its singular vectors."""
    linear, pose = place[:3, :3] * radius, place.copy()
    pose[:3, 3] += place[:3, :3] @ centre
    split = rotation_and_scale(linear)
    if split is None:
        axes, half, _ = np.linalg.svd(linear)
        pose[:3, :3] = axes * [1, 1, np.sign(np.linalg.det(axes))]
    else:
        pose[:3, :3], half = split[0], np.abs(split[1])
    x, y, z = half.tolist()
    return Shape("sphere", (x,), pose) if half.max() - half.min() <= CIRCULAR * x else Shape("ellipsoid", (x, y, z), pose)


def _plane_shape(stage: Stage, prim: Prim, place: Matrix) -> Shape:
    """Return a plane with its normal along its axis; width and length only say how much of it is drawn."""
    split = rotation_and_scale(place[:3, :3])
    if split is None:
        raise stage.error(prim, "a plane cannot be sheared")
    axis = str(stage.value(prim, "axis"))
    pose = place.copy()
    pose[:3, :3] = split[0] @ rotation_from_z(axis)
    width, length = _sizes(stage, prim, "width", "length")
    # Width and length lie along x and y of a plane whose normal is z; along z and y for x; along x and z for y.
    extents = {"X": (0, length, width), "Y": (width, 0, length), "Z": (width, length, 0)}[axis]
    half = np.abs(rotation_from_z(axis).T @ (np.abs(split[1]) * extents)) / 2
    return Shape("plane", (float(half[0]), float(half[1]), float(max(half)) / 100), pose)


def collision_shape(stage: Stage, prim: Prim, shape: Shape, place: Matrix) -> tuple[Shape, bool]:
    """Return a mesh's collision shape, and whether it is the mesh's hull because of its `physics:approximation`."""
    approximation = "none"
    if stage.has(prim, "PhysicsMeshCollisionAPI"):
        approximation = str(stage.value(prim, "physics:approximation"))
    assert shape.vertices is not None
    if approximation in ("boundingCube", "boundingSphere"):
        points = read_mesh(stage, prim)[0]
        low, high = points.min(axis=0), points.max(axis=0)
        if approximation == "boundingCube":
            return box_shape(low, high, place), False
        centre = place[:3, :3] @ ((low + high) / 2) + place[:3, 3]
        placed = points @ place[:3, :3].T + place[:3, 3]
        pose = np.eye(4)
        pose[:3, 3] = centre
        return Shape("sphere", (float(np.linalg.norm(placed - centre, axis=1).max()),), pose), False
    if shape.hull is None:
        raise stage.error(prim, "the mesh is flat: it has no hull to collide; use a plane or a thin box")
    if approximation != "convexHull" and not shape.is_convex:
        stage.drop(f'meshes with approximation "{approximation}" collide as their convex hulls', prim)
    return shape, approximation == "convexHull"


def read_mesh(stage: Stage, prim: Prim) -> tuple[Vertices, Faces]:
    """Return the control cage of a mesh as triangles, in its own space and unit; its faces look outwards."""
    time = stage.pxr.Usd.TimeCode.EarliestTime()
    mesh = stage.pxr.UsdGeom.Mesh(prim)
    points, counts, indices = (
        attribute.Get(time)
        for attribute in (mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    )
    for name, value in (("points", points), ("faceVertexCounts", counts), ("faceVertexIndices", indices)):
        if not value:
            raise stage.error(prim, f"the mesh has no {name}")
    vertices = np.array(points, dtype=np.float64)
    sizes, corners = np.array(counts, dtype=np.int64), np.array(indices, dtype=np.int64)
    if not np.isfinite(vertices).all():
        raise stage.error(prim, "the mesh has points that are not finite")
    if sizes.min() < 3:
        raise stage.error(prim, f"the mesh has a face with {sizes.min()} corners; expected 3 or more")
    if sizes.sum() != len(corners):
        raise stage.error(prim, f"faceVertexCounts add up to {sizes.sum()}, but there are {len(corners)} faceVertexIndices")
    if corners.min() < 0 or corners.max() >= len(vertices):
        wrong = corners.min() if corners.min() < 0 else corners.max()
        raise stage.error(prim, f"faceVertexIndices holds {wrong}; the mesh has {len(vertices)} points")
    faces = _triangles(vertices, sizes, corners)
    return vertices, faces[:, ::-1] if mesh.GetOrientationAttr().Get() == "leftHanded" else faces


def _triangles(vertices: Vertices, sizes: Int[np.ndarray, " polygon"], corners: Int[np.ndarray, " corner"]) -> Faces:
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    results = [corners[starts[sizes == 3, None] + np.arange(3)]]
    order = [np.flatnonzero(sizes == 3)]
    for polygon in np.flatnonzero(sizes > 3):
        ring = corners[starts[polygon] : starts[polygon] + sizes[polygon]]
        results.append(ring[_ear_clipping(vertices[ring])])
        order.append(np.full(len(ring) - 2, polygon))
    return np.concatenate(results)[np.argsort(np.concatenate(order), kind="stable")]


def _ear_clipping(ring: Vertices) -> Faces:
    """Triangulate a simple polygon by ear clipping."""
    following = np.roll(ring, -1, axis=0)
    normal = np.cross(ring - ring[0], following - ring[0]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    sign = -1.0 if normal[axis] < 0 else 1.0
    flat = np.delete(ring, axis, axis=1) * ([1.0, sign] if axis != 1 else [1.0, -sign])
    left, faces = list(range(len(ring))), []
    while len(left) > 3:
        at = next((i for i in range(len(left)) if _is_ear(flat, left, i)), 0)  # of a degenerate ring any corner will do
        faces.append([left[at - 1], left[at], left[(at + 1) % len(left)]])
        del left[at]
    return np.array([*faces, left], dtype=np.int64)


def _is_ear(flat: Float[np.ndarray, "corner 2"], left: list[int], at: int) -> bool:
    a, b, c = flat[left[at - 1]], flat[left[at]], flat[left[(at + 1) % len(left)]]
    if _cross(b - a, c - b) <= 0:
        return False
    rest = flat[[i for i in left if not any(np.array_equal(flat[i], corner) for corner in (a, b, c))]]
    if not len(rest):
        return True
    sides = np.stack([_cross(q - p, rest - p) for p, q in ((a, b), (b, c), (c, a))])
    return not (sides >= 0).all(axis=0).any()


def _cross(a: Float[np.ndarray, " 2"], b: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    return np.asarray(a[0] * b[..., 1] - a[1] * b[..., 0])


def surface_of_revolution(profile: list[tuple[float, float]], axis: str) -> tuple[Vertices, Faces]:
    """Return the surface of a convex solid of revolution as triangles."""
    tips = [(0.0, profile[end][1]) for end in (0, -1) if profile[end][0]]
    outline = [*tips[:1], *profile, *tips[1:]] if profile[0][0] else [*profile, *tips]
    mesh = trimesh.creation.revolve(outline, sections=SECTIONS)
    return np.asarray(mesh.vertices) @ rotation_from_z(axis).T, np.asarray(mesh.faces, dtype=np.int64)


def rotation_from_z(axis: str) -> Float[np.ndarray, "3 3"]:
    return np.eye(3)[:, {"X": [1, 2, 0], "Y": [2, 0, 1], "Z": [0, 1, 2]}[axis]]


def capsule_profile(radius: float, low: float, high: float, low_radius: float | None = None) -> list[tuple[float, float]]:
    """Return the profile of the hull of two balls, for `surface_of_revolution`."""
    low_radius = radius if low_radius is None else low_radius
    gap = high - low
    if gap <= abs(radius - low_radius):  # one holds the other
        low, radius = (high, radius) if radius >= low_radius else (low, low_radius)
        high, low_radius, gap = low, radius, 0.0
    lean = float(np.arcsin((low_radius - radius) / gap)) if gap else 0.0  # angle up to where the common tangent touches
    below = np.linspace(-np.pi / 2, lean, SECTIONS // 4 + 1)
    above = np.linspace(lean, np.pi / 2, SECTIONS // 4 + 1)
    rings = [(float(low_radius * np.cos(t)), float(low + low_radius * np.sin(t))) for t in below]
    rings += [(float(radius * np.cos(t)), float(high + radius * np.sin(t))) for t in above]
    return [(0.0, rings[0][1]), *rings[1:-1], (0.0, rings[-1][1])]


def quaternion(matrix: Float[np.ndarray, "row row"]) -> Float[np.ndarray, " 4"]:
    return Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True, scalar_first=True)
