"""A first layout for a robot that nobody has described: groups and taxels guessed from its tree, joints and surfaces.

Every guess is written down in the file, for its reader to keep or to change.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from tgdsl.errors import RobotError, SampleError, TgdslError
from tgdsl.formats.model import Model
from tgdsl.placement.propose.exposure import MIN_AREA, Options, exposed_pool, surface_pool
from tgdsl.placement.propose.flexion import UNCLEAR, Flexion, InnerSide
from tgdsl.placement.propose.hands import KinematicTree, free_standing, kinematic_tree
from tgdsl.placement.propose.scope import chosen_hands, included, outside
from tgdsl.placement.reach import Colliders
from tgdsl.placement.sample.poisson import Pool

FACTORS = {"low": 0.25, "med": 1.0, "high": 4.0}
"""Each resolution's share of the density."""
WITHIN_DEG = 75
"""Largest angle between a taxel's normal and the inner side of its link [deg]."""
MIN_SHARE = 0.1
"""Least share of a link's surface that its inner side must hold to be believed."""
COVERING = 0.75
"""Radius over the square root of the area per taxel: discs on a triangular grid cover it from 0.62 on."""
MAX_COUNT = 1_000_000
"""The most taxels that the grammar lets a link have."""
_USUAL = 4e4
"""The density that `closing_motion` takes [1/m²]: 4/cm²."""
NOT_COLLIDED = "the simulator does not collide it, so contacts never reach it"
COVERED = "all of it is inside other links in the initial state"


@dataclass(frozen=True, eq=False)
class LinkSurface:
    """Samples of the outer surface of a body, in its frame.

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

    @property
    def centroid(self) -> Float[np.ndarray, " 3"]:
        """Its centre [m]."""
        return self.pool.point_area @ self.pool.pos / self.pool.area


@dataclass(frozen=True)
class LinkProposal:
    """The taxels of a link.

    Attributes:
        name: Its body.
        area: Surface to be covered [m²].
        facing: Direction of its inner side in the link's frame; None: it is covered all around.
        doubt: What speaks against that side, or why there is none; empty if nothing does.
        counts: Number of taxels at each resolution.
        options: Options by which taxels are where they can feel.
    """

    name: str
    area: float
    facing: tuple[float, ...] | None
    doubt: str
    counts: dict[str, int]
    options: Options


@dataclass(frozen=True)
class Proposal:
    """A layout.

    Attributes:
        density: Taxels per area at `med` [1/m²].
        groups: Names of groups, and of links and groups in each.
        links: Links with taxels, in the robot's body order.
        left_out: Bodies without taxels, and why.
        shared: Names of links that other links' geoms or meshes have too.
        is_collided: Whether the simulator collides its links; else none of them.
    """

    density: float
    groups: dict[str, tuple[str, ...]]
    links: tuple[LinkProposal, ...]
    left_out: tuple[tuple[str, str], ...]
    shared: tuple[str, ...]
    is_collided: bool

    def radius_mm(self, resolution: str) -> float:
        """Return the sensing radius at a resolution, to two digits [mm]."""
        return float(f"{1e3 * COVERING / np.sqrt(self.density * FACTORS[resolution]):.2g}")

    def placement(self, link: LinkProposal, resolution: str) -> dict[str, Any]:
        """Return how a link is sampled, as the grammar has it."""
        found: dict[str, Any] = {"method": "poisson", "count": link.counts[resolution]}
        found |= {"radius": f"{self.radius_mm(resolution):g} mm", **link.options}
        if link.facing is not None:
            found["region"] = {"facing": [float(x) for x in link.facing], "within": f"{WITHIN_DEG} deg"}
        return found

    def mapping(self) -> dict[str, Any]:
        """Return the layout as the grammar has it."""
        resolutions = {r: {escaped(link.name): self.placement(link, r) for link in self.links} for r in FACTORS}
        groups = {"groups": {name: list(members) for name, members in self.groups.items()}} if self.groups else {}
        return {"tgdsl": 1, **groups, "resolutions": resolutions}


def propose(robot: Model, density: float, with_groups: bool = True, include: Sequence[str] = ()) -> Proposal:
    """Return a layout for a robot; the same robot gives the same layout.

    Args:
        robot: The robot.
        density: Taxels per area at `med` [1/m²].
        with_groups: Whether to propose link groups.
        include: Names or shell wildcards of links outside its hands that are to have taxels too.

    Raises:
        TgdslError: If no link can be sampled, if the density asks for more taxels than a link can have, or if a name to include
            matches no link that can have taxels.
    """
    surfaces, left_out, is_collided = _touchable(robot, density)
    asked = included(include, tuple(surfaces), dict(left_out))
    tree = _tree(robot, surfaces)
    names = {int(robot.compiled.body(name).id): name for name in surfaces}
    found = chosen_hands(tree)
    for body, why in outside(tree, found).items():
        if names[body] not in asked:
            del surfaces[names[body]]
            left_out.append((names[body], why))
    if not surfaces:
        what = "; ".join(f'"{name}": {why}' for name, why in left_out)
        raise TgdslError(f"{robot.file}: no link has a surface for taxels" + (f" ({what})" if what else ""))
    sides = {names[b]: flexion.inner_side(b) for flexion in found for b in (*flexion.hand.mounts, *flexion.hand.fingers)}
    asked_for = InnerSide(None, "asked for with --include")
    links = tuple(_link(name, surfaces[name], sides.get(name, asked_for), density) for name in robot.bodies if name in surfaces)
    groups = _groups(found, names, tuple(surfaces)) if with_groups else {}
    return Proposal(density, groups, links, tuple(left_out), _shared(robot, tuple(surfaces)), is_collided)


def closing_motion(robot: Model) -> Mapping[str, tuple[float, float]]:
    """Return how the hands of a robot close: by name, each joint's open and closed end [rad, of slides m].

    A joint that has no name, or of which it is not clear which end is the closed one, is not in it.
    """
    surfaces, _, _ = _touchable(robot, _USUAL)
    motion: dict[str, tuple[float, float]] = {}
    for flexion in chosen_hands(_tree(robot, surfaces)):
        motion |= {robot.compiled.joint(joint).name: ends for joint, ends in flexion.motion().items()}
    return {name: ends for name, ends in motion.items() if name}


def _touchable(robot: Model, density: float) -> tuple[dict[str, LinkSurface], list[tuple[str, str]], bool]:
    """Return what can be touched of each link, the others and why nothing can, and whether the simulator collides any."""
    surfaces, left_out = _link_surfaces(robot)
    is_collided = _keep_what_feels(robot, surfaces, left_out, density)
    return surfaces, left_out, is_collided


def _tree(robot: Model, surfaces: Mapping[str, LinkSurface]) -> KinematicTree:
    return kinematic_tree(robot, {n: s.area for n, s in surfaces.items()}, {n: s.centroid for n, s in surfaces.items()})


def _keep_what_feels(robot: Model, surfaces: dict[str, LinkSurface], left_out: list[tuple[str, str]], density: float) -> bool:
    """Leave of each link's surface what can be touched in the simulator, and leave out links of which nothing can be.

    Links that the simulator does not collide are kept if it collides none, as those of a robot that is only seen.

    Returns:
        Whether it collides any that is no scenery.
    """
    colliders, radius = Colliders(robot), 0.95 * COVERING / np.sqrt(density * max(FACTORS.values()))
    ids = {name: int(robot.compiled.body(name).id) for name in surfaces}
    scenery = set(free_standing(_tree(robot, surfaces))) if surfaces else set()
    links = [name for name in surfaces if ids[name] not in scenery]
    collided = [name for name in links if colliders.collides(ids[name])]
    for name in links if collided else []:
        own = surfaces.pop(name)
        pool, options = exposed_pool(robot, colliders, name, own.pool, radius) if name in collided else (None, {})
        if pool is not None:
            surfaces[name] = LinkSurface(pool, options)
        else:
            left_out.append((name, COVERED if name in collided else NOT_COLLIDED))
    return bool(collided)


def _link_surfaces(robot: Model) -> tuple[dict[str, LinkSurface], list[tuple[str, str]]]:
    """Return what can be touched of each named body with geoms, and why some cannot be sampled."""
    surfaces: dict[str, LinkSurface] = {}
    left_out = [("world", "no link")] if robot.touchable("world") else []
    for body in robot.bodies[1:]:
        geoms = robot.touchable(body)
        if not geoms:
            left_out.append((body, "no geoms"))
            continue
        try:
            surface = _link_surface(robot, body)
        except (RobotError, SampleError) as error:
            left_out.append((body, str(error).removeprefix(f"{robot.file}: ")))
            continue
        if isinstance(surface, LinkSurface):
            surfaces[body] = surface
        else:
            left_out.append((body, surface))
    model = robot.compiled
    unnamed = [i for i in range(model.nbody) if not model.body(i).name and model.body_geomnum[i]]
    left_out += [(robot.body_path(i), "no name, so no document can mean it") for i in unnamed]
    return surfaces, left_out


def _link_surface(robot: Model, body: str) -> LinkSurface | str:
    """Return what can be touched of a body, or why nothing can."""
    surface = robot.surface(robot.touchable(body))
    pool = surface_pool(surface) if surface.face_areas.sum() > MIN_AREA else None
    if pool is None:
        has_area = surface.face_areas.sum() > MIN_AREA
        return "nothing that can be touched from outside" if has_area else "a surface without area"
    return LinkSurface(pool) if pool.area >= MIN_AREA else "a surface without area"


def _link(name: str, surface: LinkSurface, side: InnerSide, density: float) -> LinkProposal:
    share, facing, doubt = 1.0, side.facing, side.doubt
    if facing is not None:
        pool = surface.pool
        share = float(pool.point_area[_faces(pool.normal, facing)].sum()) / pool.area
        if share < MIN_SHARE:
            share, facing, doubt = 1.0, None, UNCLEAR
    area = share * surface.area
    counts = {resolution: max(1, round(area * density * factor)) for resolution, factor in FACTORS.items()}
    if max(counts.values()) > MAX_COUNT:
        raise TgdslError(
            f'link "{name}" would have {max(counts.values())} taxels, expected at most {MAX_COUNT}; lower the density'
        )
    return LinkProposal(name, area, facing, doubt, counts, surface.options)


def _faces(normals: Float[np.ndarray, "n 3"], facing: tuple[float, ...]) -> Bool[np.ndarray, " n"]:
    direction = np.array(facing) / np.linalg.norm(facing)
    return normals @ direction >= np.cos(np.radians(WITHIN_DEG))


def _groups(found: Sequence[Flexion], names: dict[int, str], links: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the groups that have members; `fingers` and `hand` name those that they contain."""
    order = {name: i for i, name in enumerate(links)}
    tips = {names[body] for flexion in found for body in flexion.tips}
    palms = {names[flexion.hand.palm] for flexion in found if flexion.hand.palm is not None}
    fingers = {names[body] for flexion in found for body in flexion.hand.fingers}
    mounts = {names[body] for flexion in found for body in flexion.hand.mounts} - palms
    known = {name for name, members in (("tips", tips), ("palm", palms), ("fingers", fingers), ("hand", links)) if members}

    def members(*groups: str, bodies: set[str]) -> tuple[str, ...]:
        patterns = (_own(escaped(name), known) for name in sorted(bodies, key=order.__getitem__))
        return (*(group for group in groups if group in known), *patterns)

    wanted = {
        "tips": members(bodies=tips),
        "palm": members(bodies=palms),
        "fingers": members("tips", bodies=fingers - tips) if fingers else (),
        "hand": members("fingers", "palm", bodies=mounts),
    }
    return {name: group for name, group in wanted.items() if group}


def escaped(name: str) -> str:
    """Return the pattern that matches a name and nothing else."""
    return re.sub(r"[*?\[]", r"[\g<0>]", name)


def _own(pattern: str, groups: set[str]) -> str:
    """Return a pattern that means the link even if a group has its name."""
    return f"[{pattern[0]}]{pattern[1:]}" if pattern in groups else pattern


def _shared(robot: Model, links: tuple[str, ...]) -> tuple[str, ...]:
    """Return links whose name some geom or mesh of another link has too: a selection takes both."""
    elsewhere = {name for geom in robot.geoms if geom.body in links for name in geom.names if name != geom.body}
    return tuple(name for name in links if name in elsewhere)
