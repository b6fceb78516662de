"""The surfaces of a robot's links: triangles for the links' geometry, and samples of the touchable surface, which are slow.

A link is sampled on its meshes, unless their hollows are deeper inside the collision hulls than a taxel's radius. Surface
inside other colliding geoms in the initial state is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tgdsl.errors import RobotError, SampleError
from tgdsl.formats.model import Model
from tgdsl.placement.propose.hands import free_standing, kinematic_tree, loose_parts
from tgdsl.placement.reach import Colliders
from tgdsl.placement.sample import poisson
from tgdsl.placement.sample.poisson import Pool
from tgdsl.surfaces import meshlab
from tgdsl.surfaces.region import Region
from tgdsl.surfaces.surface import Surface

NOT_COLLIDED = "the simulator does not collide it, so contacts never reach it"
HIDDEN = "behind bodies fixed in front of it; --include adds it"
COVERED = "all of it is inside other links in the initial state"
MAX_MARKER = 2e-5  # largest surface of a marker, such as a ball of a millimetre at a fingertip [m²]
MIN_AREA = 1e-8  # a surface smaller than this is degenerate [m²]
_NO_AREA = "a surface without area"
_ANYWHERE = Region(is_geom=None, facings=(), boxes=(), spheres=())
Options = Mapping[str, str | bool]  # options of a placement, `surface` and `exposed`, as the grammar has them


@dataclass(frozen=True, eq=False)
class LinkSurface:
    """Samples of a body's touchable surface, in its frame."""

    pool: Pool  # points on it
    options: Options = field(default_factory=dict)  # options of a placement that samples it


def link_meshes(robot: Model) -> tuple[dict[str, Surface], list[tuple[str, str]]]:
    """Return the touchable triangles of each named body, and the bodies that have none, and why."""
    meshes: dict[str, Surface] = {}
    left_out = [("world", "no link")] if robot.touchable("world") else []
    for body in robot.bodies[1:]:
        geoms = robot.touchable(body)
        if not geoms:
            left_out.append((body, "no geoms"))
            continue
        try:
            surface = robot.surface(geoms, as_collided=True)
        except RobotError as error:
            left_out.append((body, _reason(robot, error)))
            continue
        area = float(surface.face_areas.sum())
        if area > MAX_MARKER:
            meshes[body] = surface
        else:
            left_out.append((body, f"a marker: its surface is {1e4 * area:.2g} cm²" if area > MIN_AREA else _NO_AREA))
    model = robot.compiled
    for name in [model.body(body).name for body in loose_parts(kinematic_tree(robot, meshes))]:
        del meshes[name]
        left_out.append((name, "a marker: it touches nothing that it is fixed to"))
    unnamed = [i for i in range(model.nbody) if not model.body(i).name and model.body_geomnum[i]]
    left_out += [(robot.body_path(i), "no name, so no document can mean it") for i in unnamed]
    return meshes, left_out


class Sampler:
    """Samples links where they can feel.

    Attributes:
        meshes: Touchable triangles of the links that may have taxels.
        left_out: Other links, and why they have none.
        is_collided: Whether the simulator collides any link that is no scenery.
    """

    def __init__(self, robot: Model):
        """Leave out what the simulator does not collide, unless it collides nothing, as of a robot that is only seen."""
        self.robot, self.colliders = robot, Colliders(robot)
        self._pools: dict[tuple[str, bool], Pool | None] = {}  # by link, and whether on its hulls
        self.meshes, self.left_out = link_meshes(robot)
        ids = {name: int(robot.compiled.body(name).id) for name in self.meshes}
        scenery = set(free_standing(kinematic_tree(robot, self.meshes)))
        links = [name for name in self.meshes if ids[name] not in scenery]
        self._feeling = {name for name in links if self.colliders.collides(ids[name])}
        self.is_collided = bool(self._feeling)
        for name in links if self.is_collided else []:
            if name not in self._feeling:
                self.drop(name, NOT_COLLIDED)

    def drop(self, name: str, why: str) -> None:
        del self.meshes[name]
        self.left_out.append((name, why))

    def sampled(self, name: str, radius: float) -> LinkSurface | str:
        """Return the surface of a link that taxels of a radius [m] can touch, or the reason why there is none."""
        try:
            pool = self._pool(name, as_collided=False)
        except (RobotError, SampleError) as error:
            return _reason(self.robot, error)
        if pool is None:
            return "nothing that can be touched from outside"
        if pool.area < MIN_AREA:
            return _NO_AREA
        return self._exposed(name, pool, radius) if name in self._feeling else LinkSurface(pool)

    def _exposed(self, name: str, pool: Pool, radius: float) -> LinkSurface | str:
        """Return the exposed surface of a colliding link, from points on its meshes."""
        geoms, options = self.robot.touchable(name), dict[str, str | bool]()
        if not all(geom.is_colliding for geom in geoms):
            return LinkSurface(pool)
        is_covered = self.colliders.cover_of(name, geoms)
        covered = is_covered(pool.pos)
        body = int(self.robot.compiled.body(name).id)
        buried, _ = self.colliders.is_buried(body, pool.pos, np.full(len(pool.pos), radius))
        if (buried & ~covered).any():
            options["surface"] = "collision"
            on_hulls = self._pool(name, as_collided=True)
            if on_hulls is None:
                return COVERED
            pool, covered = on_hulls, is_covered(on_hulls.pos)
        if covered.any():
            options["exposed"] = True
            pool = Pool(pool.pos[~covered], pool.normal[~covered], pool.point_area[~covered])
        return LinkSurface(pool, options) if pool.area > MIN_AREA else COVERED

    def _pool(self, name: str, as_collided: bool) -> Pool | None:
        """Return points on the outer surface of a link; None if nothing of it can be touched from outside."""
        if (name, as_collided) not in self._pools:
            try:
                shell = meshlab.outer_shell(self.robot.surface(self.robot.touchable(name), as_collided))
            except ImportError as error:
                raise SampleError(f"sampling needs pymeshlab: {error}", "pip install pymeshlab") from error
            self._pools[name, as_collided] = poisson.pool(shell, _ANYWHERE, seed=0, count=1, spacing=None)
        return self._pools[name, as_collided]


def _reason(robot: Model, error: Exception) -> str:
    return str(error).removeprefix(f"{robot.file}: ")
