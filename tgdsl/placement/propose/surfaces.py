"""The surfaces of a robot's links: triangles, which say where links are; and samples of what can be touched, which are slow."""

from __future__ import annotations

from dataclasses import dataclass, field

from tgdsl.errors import RobotError, SampleError
from tgdsl.formats.model import Model
from tgdsl.placement.propose.exposure import MIN_AREA, Options, exposed_pool, surface_pool
from tgdsl.placement.propose.hands import free_standing, kinematic_tree, loose_parts
from tgdsl.placement.reach import Colliders
from tgdsl.placement.sample.poisson import Pool
from tgdsl.surfaces.surface import Surface

NOT_COLLIDED = "the simulator does not collide it, so contacts never reach it"
HIDDEN = "behind what is fixed in front of it; --include adds it"
COVERED = "all of it is inside other links in the initial state"
MAX_MARKER = 2e-5
"""A link with no more surface than this only marks a place, such as a ball of a millimetre at a fingertip [m²]."""
_NO_AREA = "a surface without area"


@dataclass(frozen=True, eq=False)
class LinkSurface:
    """Samples of what can be touched of a body, in its frame.

    Attributes:
        pool: Points on it.
        options: Options of a placement that samples it.
    """

    pool: Pool
    options: Options = field(default_factory=dict)

    @property
    def area(self) -> float:
        """Its whole surface [m²]."""
        return self.pool.area


def link_meshes(robot: Model) -> tuple[dict[str, Surface], list[tuple[str, str]]]:
    """Return the touchable triangles of each named body, and the bodies that have none, and why.

    Meshes are their convex hulls, as MuJoCo collides them: what is inside of a mesh would shift its middle.
    """
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

    def __init__(self, robot: Model, radius: float):
        """Leave out what the simulator does not collide, unless it collides nothing, as of a robot that is only seen.

        Args:
            robot: The robot.
            radius: The least sensing radius of a taxel [m].
        """
        self.robot, self.radius, self.colliders = robot, radius, Colliders(robot)
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
        """Leave a link out."""
        del self.meshes[name]
        self.left_out.append((name, why))

    def sampled(self, name: str) -> LinkSurface | str:
        """Return what can be touched of a link, or why nothing can."""
        try:
            pool = surface_pool(self.robot.surface(self.robot.touchable(name)))
        except (RobotError, SampleError) as error:
            return _reason(self.robot, error)
        if pool is None:
            return "nothing that can be touched from outside"
        if pool.area < MIN_AREA:
            return _NO_AREA
        if name not in self._feeling:
            return LinkSurface(pool)
        exposed, options = exposed_pool(self.robot, self.colliders, name, pool, self.radius)
        return LinkSurface(exposed, options) if exposed is not None else COVERED


def _reason(robot: Model, error: Exception) -> str:
    return str(error).removeprefix(f"{robot.file}: ")
