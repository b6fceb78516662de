"""A first layout for a robot that nobody has described: groups and taxels guessed from its tree, joints and surfaces.

Every guess is written down in the file, for its reader to keep or to change.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from tgdsl.errors import RobotError, SampleError, TgdslError
from tgdsl.formats.model import Model
from tgdsl.placement.propose.flexion import Flexion
from tgdsl.placement.propose.hands import Hand, free_standing, hands, kinematic_tree
from tgdsl.placement.sample import poisson
from tgdsl.surfaces import meshlab
from tgdsl.surfaces.region import Region

FACTORS = {"low": 0.25, "med": 1.0, "high": 4.0}
"""Each resolution's share of the density."""
WITHIN_DEG = 75
"""Largest angle between a taxel's normal and the inner side of its link [deg]."""
MIN_SHARE = 0.1
"""Least share of a link's surface that its inner side must hold to be believed."""
COVERING = 0.75
"""Radius over the square root of the area per taxel: discs on a triangular grid cover it from 0.62 on."""
MIN_AREA = 1e-8
"""A surface smaller than this is degenerate [m²]."""
MAX_COUNT = 1_000_000
"""The most taxels that the grammar lets a link have."""
_ANYWHERE = Region(is_geom=None, facings=(), boxes=(), spheres=())


@dataclass(frozen=True, eq=False)
class LinkSurface:
    """Samples of the outer surface of a body, in its frame.

    Attributes:
        area: Its whole surface [m²].
        centroid: Its centre [m].
        normals: Outward unit normals of points that stand for equal areas.
    """

    area: float
    centroid: Float[np.ndarray, " 3"]
    normals: Float[np.ndarray, "point 3"]


@dataclass(frozen=True)
class LinkProposal:
    """The taxels of a link.

    Attributes:
        name: Its body.
        area: Surface to be covered [m²].
        facing: Direction of its inner side in the link's frame; None: it is covered all around.
        counts: Number of taxels at each resolution.
    """

    name: str
    area: float
    facing: tuple[float, ...] | None
    counts: dict[str, int]


@dataclass(frozen=True)
class Proposal:
    """A layout.

    Attributes:
        density: Taxels per area at `med` [1/m²].
        groups: Names of groups, and of links and groups in each.
        links: Links with taxels, in the robot's body order.
        left_out: Bodies without taxels, and why.
        shared: Names of links that other links' geoms or meshes have too.
    """

    density: float
    groups: dict[str, tuple[str, ...]]
    links: tuple[LinkProposal, ...]
    left_out: tuple[tuple[str, str], ...]
    shared: tuple[str, ...]

    def radius_mm(self, resolution: str) -> float:
        """Return the sensing radius at a resolution, to two digits [mm]."""
        return float(f"{1e3 * COVERING / np.sqrt(self.density * FACTORS[resolution]):.2g}")

    def placement(self, link: LinkProposal, resolution: str) -> dict[str, Any]:
        """Return how a link is sampled, as the grammar has it."""
        found: dict[str, Any] = {"method": "poisson", "count": link.counts[resolution]}
        found["radius"] = f"{self.radius_mm(resolution):g} mm"
        if link.facing is not None:
            found["region"] = {"facing": [float(x) for x in link.facing], "within": f"{WITHIN_DEG} deg"}
        return found

    def mapping(self) -> dict[str, Any]:
        """Return the layout as the grammar has it."""
        resolutions = {r: {escaped(link.name): self.placement(link, r) for link in self.links} for r in FACTORS}
        groups = {"groups": {name: list(members) for name, members in self.groups.items()}} if self.groups else {}
        return {"tgdsl": 1, **groups, "resolutions": resolutions}


def propose(robot: Model, density: float, with_groups: bool = True) -> Proposal:
    """Return a layout for a robot; the same robot gives the same layout.

    Args:
        robot: The robot.
        density: Taxels per area at `med` [1/m²].
        with_groups: Whether to propose link groups.

    Raises:
        TgdslError: If no link can be sampled, or if the density asks for more taxels than a link can have.
    """
    surfaces, left_out = _link_surfaces(robot)
    tree = kinematic_tree(robot, {n: s.area for n, s in surfaces.items()}, {n: s.centroid for n, s in surfaces.items()})
    names = {int(robot.compiled.body(name).id): name for name in surfaces}
    for body in free_standing(tree):
        del surfaces[names[body]]
        left_out.append((names[body], "stands or floats by itself: taken for scenery or an object"))
    if not surfaces:
        what = "; ".join(f'"{name}": {why}' for name, why in left_out)
        raise TgdslError(f"{robot.file}: no link has a surface for taxels" + (f" ({what})" if what else ""))
    found = hands(tree)
    facing: dict[str, tuple[float, ...] | None] = {}
    for hand in found:
        flexion = Flexion(tree, hand)
        wanted = [*hand.fingers, *([hand.palm] if hand.palm is not None else [])]
        facing |= {names[body]: flexion.direction(body) for body in wanted}
    links = tuple(_link(name, surfaces[name], facing.get(name), density) for name in robot.bodies if name in surfaces)
    groups = _groups(found, names, tuple(surfaces)) if with_groups else {}
    return Proposal(density, groups, links, tuple(left_out), _shared(robot, tuple(surfaces)))


def closing_motion(robot: Model) -> Mapping[str, tuple[float, float]]:
    """Return how the hands of a robot close: by name, each joint's open and closed end [rad, of slides m].

    A joint that has no name, or of which it is not clear which end is the closed one, is not in it.
    """
    surfaces, _ = _link_surfaces(robot)
    tree = kinematic_tree(robot, {n: s.area for n, s in surfaces.items()}, {n: s.centroid for n, s in surfaces.items()})
    model, motion = robot.compiled, {}
    for hand in hands(tree):
        for joint, closed in Flexion(tree, hand).closed.items():
            low, high = model.jnt_range[joint].tolist()
            motion[model.joint(joint).name] = (low if closed > 0.5 * (low + high) else high, closed)
    return {name: ends for name, ends in motion.items() if name}


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
        if surface is None or surface.area < MIN_AREA:
            left_out.append((body, "a surface without area" if surface else "nothing that can be touched from outside"))
        else:
            surfaces[body] = surface
    model = robot.compiled
    unnamed = [i for i in range(model.nbody) if not model.body(i).name and model.body_geomnum[i]]
    left_out += [(robot.body_path(i), "no name, so no document can mean it") for i in unnamed]
    return surfaces, left_out


def _link_surface(robot: Model, body: str) -> LinkSurface | None:
    surface = robot.surface(robot.touchable(body))
    if not surface.face_areas.sum() > MIN_AREA:
        return LinkSurface(0.0, np.zeros(3), np.zeros((0, 3)))
    try:
        shell = meshlab.outer_shell(surface)
    except ImportError as error:
        raise SampleError(f"sampling needs pymeshlab: {error}", "pip install pymeshlab") from error
    pool = poisson.pool(shell, _ANYWHERE, seed=0, count=1, spacing=None)
    return None if pool is None else LinkSurface(pool.area, pool.pos.mean(axis=0), pool.normal)


def _link(name: str, surface: LinkSurface, facing: tuple[float, ...] | None, density: float) -> LinkProposal:
    share = 1.0
    if facing is not None:
        share = float(_faces(surface.normals, facing).mean())
        if share < MIN_SHARE:
            share, facing = 1.0, None
    area = share * surface.area
    counts = {resolution: max(1, round(area * density * factor)) for resolution, factor in FACTORS.items()}
    if max(counts.values()) > MAX_COUNT:
        raise TgdslError(
            f'link "{name}" would have {max(counts.values())} taxels, expected at most {MAX_COUNT}; lower the density'
        )
    return LinkProposal(name, area, facing, counts)


def _faces(normals: Float[np.ndarray, "n 3"], facing: tuple[float, ...]) -> Bool[np.ndarray, " n"]:
    direction = np.array(facing) / np.linalg.norm(facing)
    return normals @ direction >= np.cos(np.radians(WITHIN_DEG))


def _groups(found: Sequence[Hand], names: dict[int, str], links: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the groups that have members; `fingers` and `hand` name those that they contain."""
    order = {name: i for i, name in enumerate(links)}
    tips = {names[body] for hand in found for body in hand.tips}
    palms = {names[hand.palm] for hand in found if hand.palm is not None}
    fingers = {names[body] for hand in found for body in hand.fingers}
    rest = set(links) - fingers - palms
    known = {name for name, members in (("tips", tips), ("palm", palms), ("fingers", fingers), ("hand", links)) if members}

    def members(*groups: str, bodies: set[str]) -> tuple[str, ...]:
        patterns = (_own(escaped(name), known) for name in sorted(bodies, key=order.__getitem__))
        return (*(group for group in groups if group in known), *patterns)

    wanted = {
        "tips": members(bodies=tips),
        "palm": members(bodies=palms),
        "fingers": members("tips", bodies=fingers - tips) if fingers else (),
        "hand": members("fingers", "palm", bodies=rest),
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
