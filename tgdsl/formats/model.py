"""A robot or scene as MuJoCo compiled it, read as NumPy: its bodies, and geoms as triangles in their body's frame."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.errors import RobotError
from tgdsl.scene.mujoco_warnings import muted_mujoco
from tgdsl.surfaces.geom import Geom, round_shape
from tgdsl.surfaces.surface import Surface

LEAST_INERTIA = 1e-9  # least principal moment of a body whose inertia in the file is not physical [kg·m²]
SHAPE_NAMES = {int(kind): name.removeprefix("mjGEOM_").lower() for name, kind in mujoco.mjtGeom.__members__.items()}


@dataclass(frozen=True, eq=False)
class Model:
    """A robot or scene file, compiled."""

    file: Path  # the file it came from
    spec: mujoco.MjSpec  # MuJoCo's editable model
    compiled: mujoco.MjModel  # MuJoCo's compiled model
    is_rounded: bool  # whether `mjcf` has six digits, as of URDF
    mjcf: str = ""  # the MJCF that it was turned into, if its file is no MJCF; else empty
    rewritten: Mapping[str, Path] = field(default_factory=dict)  # files of meshes that `spec` has rewritten in memory

    def changed(self, change: Callable[[mujoco.MjSpec], object]) -> Model:
        """Return the model with a change of its spec, recompiled."""
        spec = self.spec.copy()
        change(spec)
        try:
            with muted_mujoco():
                return replace(self, spec=spec, compiled=spec.compile())
        except ValueError as error:
            raise RobotError(f"{self.file}: {' '.join(str(error).split())}") from error

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        names = (self.compiled.body(i).name for i in range(self.compiled.nbody))
        return tuple(name for name in names if name)

    def body_path(self, i: int) -> str:
        """Return a body's name; for an unnamed body its path: `forearm/[2]` is the forearm's second child."""
        if name := self.compiled.body(i).name:
            return name
        parent = int(self.compiled.body_parentid[i])
        children = np.flatnonzero(self.compiled.body_parentid == parent).tolist()
        number = [child for child in children if child].index(i) + 1  # the world is its own parent
        return f"{self.body_path(parent)}/[{number}]"

    @cached_property
    def geoms(self) -> tuple[Geom, ...]:
        result = (self.geom(i) for i in range(self.compiled.ngeom))
        return tuple(geom for geom in result if geom.body)

    def geom(self, i: int) -> Geom:
        """Return a geom by its index."""
        model = self.compiled
        shape = SHAPE_NAMES.get(int(model.geom_type[i]), "unknown")
        return Geom(
            id=i,
            name=model.geom(i).name,
            mesh=model.mesh(model.geom_dataid[i]).name if shape in ("mesh", "sdf") else "",
            body=model.body(model.geom_bodyid[i]).name,
            shape=shape,
            size=model.geom_size[i].copy(),
            pos=model.geom_pos[i].copy(),
            rotation=_matrix(model.geom_quat[i]),
            is_colliding=bool(model.geom_contype[i] or model.geom_conaffinity[i] or i in self._paired),
        )

    @cached_property
    def _paired(self) -> frozenset[int]:
        return frozenset((*self.compiled.pair_geom1.tolist(), *self.compiled.pair_geom2.tolist()))

    def touchable(self, body: str) -> tuple[Geom, ...]:
        geoms = tuple(geom for geom in self.geoms if geom.body == body)
        return tuple(geom for geom in geoms if geom.is_colliding) or geoms

    def rigid_bodies(self, body: str, others: Collection[str] = ()) -> tuple[int, ...]:
        """Return the indices of a body and of those below that are welded to it: they have no joint. Parents come first."""
        model = self.compiled
        results = [int(model.body(body).id)]
        for i in range(results[0] + 1, model.nbody if results[0] else 0):
            if model.body_parentid[i] in results and not model.body_jntnum[i] and model.body(i).name not in others:
                results.append(i)
        return tuple(results)

    def rigid_geoms(self, bodies: Sequence[int]) -> tuple[Geom, ...]:
        """Return the geoms of bodies that are one rigid body, see `rigid_bodies`, in the first one's frame."""
        model = self.compiled
        placed = {bodies[0]: (np.zeros(3), np.eye(3))}
        for i in bodies[1:]:
            pos, rotation = placed[int(model.body_parentid[i])]
            placed[i] = pos + rotation @ model.body_pos[i], rotation @ _matrix(model.body_quat[i])
        results = []
        for i in np.flatnonzero(np.isin(model.geom_bodyid, bodies)).tolist():
            geom, body = self.geom(i), int(model.geom_bodyid[i])
            if body != bodies[0]:
                pos, rotation = placed[body]
                geom = replace(geom, pos=pos + rotation @ geom.pos, rotation=rotation @ geom.rotation)
            results.append(geom)
        return tuple(results)

    def can_collide(self, first: str, second: str) -> bool:
        return self.geoms_can_collide(*([geom.id for geom in self.touchable(body)] for body in (first, second)))

    @property
    def flag_without_contacts(self) -> str:
        """The scene's `<flag>` that is disabled and without which MuJoCo makes no contacts; empty if there is none."""
        off, flags = mujoco.mjtDisableBit, self.compiled.opt.disableflags
        return "contact" if flags & off.mjDSBL_CONTACT else "constraint" if flags & off.mjDSBL_CONSTRAINT else ""

    def geoms_can_collide(self, geoms: Iterable[int], others: Iterable[int]) -> bool:
        """Return whether MuJoCo can ever report a contact between some geoms and some others, by their indices."""
        model = self.compiled
        if self.flag_without_contacts:
            return False
        pairs = {frozenset(ids) for ids in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
        for a, b in itertools.product(geoms, others):
            if frozenset((a, b)) in pairs:
                return True
            one, two = sorted(int(model.geom_bodyid[i]) for i in (a, b))
            masks = model.geom_contype[a] & model.geom_conaffinity[b]
            masks |= model.geom_contype[b] & model.geom_conaffinity[a]
            if masks and (one << 16) + two not in model.exclude_signature and not self._welded(one, two):
                return True
        return False

    def _welded(self, one: int, two: int) -> bool:
        """MuJoCo collides no two geoms of one rigid cluster, nor of what cannot move, nor (by default) of parent and child."""
        model = self.compiled
        one, two = model.body_weldid[one], model.body_weldid[two]
        if one == two or not (model.body_dofnum[one] or model.body_dofnum[two]):
            return True
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT or not one or not two:
            return False
        parent_one, parent_two = (model.body_weldid[model.body_parentid[i]] for i in (one, two))
        return bool(one == parent_two or two == parent_one)

    def surface(self, geoms: tuple[Geom, ...], as_collided: bool = False) -> Surface:
        """Return the triangles of some geoms of one body, in that body's frame."""
        parts = []
        for geom in geoms:
            of_mesh = self.hull if as_collided else self.mesh
            part = of_mesh(geom) if geom.shape == "mesh" else self._tessellated(geom)
            parts.append(part.placed(geom.pos, geom.rotation))
        return Surface.joined(parts)

    def mesh(self, geom: Geom) -> Surface:
        """Return the triangles of a mesh geom, in the geom's own frame."""
        model, mesh = self.compiled, int(self.compiled.geom_dataid[geom.id])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        vertices = model.mesh_vert[first : first + count]
        first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        return _surface(vertices, model.mesh_face[first : first + count], geom)

    def hull(self, geom: Geom) -> Surface:
        """Return the convex hull that MuJoCo collides of a mesh geom, in the geom's own frame; the mesh if it has none."""
        model, mesh = self.compiled, int(self.compiled.geom_dataid[geom.id])
        first = int(model.mesh_graphadr[mesh])
        surface = self.mesh(geom)
        if first < 0:
            return surface
        count = int(model.mesh_graph[first])  # a graph starts with its number of vertices, of faces, then two tables of these
        ids = model.mesh_graph[first + 2 + count : first + 2 + 2 * count]
        import trimesh

        hull = trimesh.convex.convex_hull(surface.vertices[ids])
        return _surface(hull.vertices, hull.faces, geom)

    def _tessellated(self, geom: Geom) -> Surface:
        tessellation = _tessellation(geom.shape, tuple(geom.size.tolist()))
        if tessellation is None:
            raise RobotError(f"{self.file}: {geom.shown} of body {geom.body} has no bounded surface to put taxels on")
        return _surface(*tessellation, geom)


@lru_cache(maxsize=256)
def _tessellation(shape: str, size: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the vertices [m] and faces of a primitive; None for other shapes."""
    import trimesh

    if shape == "box":
        mesh = trimesh.creation.box(2 * np.array(size))
    elif shape == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=size[0])
    elif shape == "ellipsoid":
        mesh = trimesh.creation.icosphere(subdivisions=4).apply_scale(size)
    elif shape == "cylinder":
        mesh = round_shape(trimesh.creation.cylinder, size, sections=96)
    elif shape == "capsule":
        mesh = round_shape(trimesh.creation.capsule, size, count=[64, 64])
        mesh.apply_translation([0, 0, -mesh.bounds.mean(axis=0)[2]])
    else:
        return None
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _surface(vertices: np.ndarray, faces: np.ndarray, geom: Geom) -> Surface:
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    return Surface(vertices, faces, np.zeros(len(faces), dtype=np.int64), (geom.names,))


def _matrix(quat: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()
