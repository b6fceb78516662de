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

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError
from tgdsl.formats.model import Model
from tgdsl.placement.propose.exposure import Options
from tgdsl.placement.propose.flexion import UNCLEAR, Flexion, InnerSide
from tgdsl.placement.propose.front import MIN_SHARE, WITHIN_DEG, PalmFront, hidden, palm_parts
from tgdsl.placement.propose.hands import kinematic_tree
from tgdsl.placement.propose.limits import RADIANS_AS_DEGREES, angles_are_misread
from tgdsl.placement.propose.scope import chosen_hands, included, outside
from tgdsl.placement.propose.surfaces import HIDDEN, LinkSurface, Sampler, link_meshes

FACTORS = {"low": 0.25, "med": 1.0, "high": 4.0}
"""Each resolution's share of the density."""
COVERING = 0.75
"""Radius over the square root of the area per taxel: discs on a triangular grid cover it from 0.62 on."""
MAX_COUNT = 1_000_000
"""The most taxels that the grammar lets a link have."""
ROOM = 1e-3
"""A box is larger than a link's surface by this [m]."""
Box = tuple[()] | tuple[tuple[float, ...], tuple[float, ...]]


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
        box: Lower and upper corner of what is no tower beside the hand, in the link's frame [m]; empty if it is all of it.
    """

    name: str
    area: float
    facing: tuple[float, ...] | None
    doubt: str
    counts: dict[str, int]
    options: Options
    box: Box = ()


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
        is_misread: Whether limits of its hinges look like radians that were read as degrees.
    """

    density: float
    groups: dict[str, tuple[str, ...]]
    links: tuple[LinkProposal, ...]
    left_out: tuple[tuple[str, str], ...]
    shared: tuple[str, ...]
    is_collided: bool
    is_misread: bool = False

    def radius_mm(self, resolution: str) -> float:
        """Return the sensing radius at a resolution, to two digits [mm]."""
        return float(f"{1e3 * COVERING / np.sqrt(self.density * FACTORS[resolution]):.2g}")

    def placement(self, link: LinkProposal, resolution: str) -> dict[str, Any]:
        """Return how a link is sampled, as the grammar has it."""
        result: dict[str, Any] = {"method": "poisson", "count": link.counts[resolution]}
        result |= {"radius": f"{self.radius_mm(resolution):g} mm", **link.options}
        if link.facing is not None:
            facing = {"facing": [float(x) for x in link.facing], "within": f"{WITHIN_DEG} deg"}
            box = dict(zip(("min", "max"), map(list, link.box), strict=False))
            result["region"] = [facing, {"box": box}] if link.box else facing
        return result

    def mapping(self) -> dict[str, Any]:
        """Return the layout as the grammar has it."""
        resolutions = {r: {escaped(link.name): self.placement(link, r) for link in self.links} for r in FACTORS}
        groups = {"groups": {name: list(members) for name, members in self.groups.items()}} if self.groups else {}
        return {"tgdsl": 1, **groups, "resolutions": resolutions}


def propose(
    robot: Model,
    density: float,
    with_groups: bool = True,
    include: Sequence[str] = (),
    progress: Progress = silent,
) -> Proposal:
    """Return a layout for a robot; the same robot gives the same layout.

    Args:
        robot: The robot.
        density: Taxels per area at `med` [1/m²].
        with_groups: Whether to propose link groups.
        include: Names or shell wildcards of links outside its hands that are to have taxels too.
        progress: Called with a line of text for each long job.

    Raises:
        TgdslError: If no link can be sampled, if the density asks for more taxels than a link can have, or if a name to include
            matches no link that can have taxels.
    """
    sampler = Sampler(robot, 0.95 * COVERING / np.sqrt(density * max(FACTORS.values())))
    found, surfaces = _sampled_hands(sampler, include, progress)
    left_out = tuple(sampler.left_out)
    if not surfaces:
        problem = "; ".join(f'"{name}": {why}' for name, why in left_out)
        raise TgdslError(f"{robot.file}: no link has a surface for taxels" + (f" ({problem})" if problem else ""))
    names = {int(robot.compiled.body(name).id): name for name in surfaces}
    sides = {names[b]: flexion.inner_side(b) for flexion in found for b in (*flexion.hand.mounts, *flexion.hand.fingers)}
    asked_for = InnerSide(None, "asked for with --include")
    boxes = {names[b]: box for flexion in found for b, box in _boxes(flexion).items()}
    links = tuple(
        _link(name, surfaces[name], sides.get(name, asked_for), boxes.get(name, ()), density)
        for name in robot.bodies
        if name in surfaces
    )
    groups = _groups(found, names, tuple(surfaces)) if with_groups else {}
    shared, is_misread = _shared(robot, tuple(surfaces)), angles_are_misread(robot.compiled)
    return Proposal(density, groups, links, left_out, shared, sampler.is_collided, is_misread)


def closing_motion(robot: Model) -> Mapping[str, tuple[float, float]]:
    """Return how the hands of a robot close: by name, each joint's open and closed end [rad, of slides m].

    A joint that has no name, or of which it is not clear which end is the closed one, is not in it. Where limits are misread,
    see `angles_are_misread`, the ends are those that the simulator keeps to.
    """
    scale = RADIANS_AS_DEGREES if angles_are_misread(robot.compiled) else 1.0
    motion: dict[str, tuple[float, float]] = {}
    tree = kinematic_tree(robot, link_meshes(robot)[0])
    for flexion in chosen_hands(tree):
        if flexion.tree is tree:  # not within assumed limits
            motion |= {robot.compiled.joint(i).name: (one / scale, two / scale) for i, (one, two) in flexion.motion().items()}
    return {name: ends for name, ends in motion.items() if name}


def _sampled_hands(
    sampler: Sampler, include: Sequence[str], progress: Progress
) -> tuple[list[Flexion], dict[str, LinkSurface]]:
    """Return the hands, and samples of their links and of those to include, in the robot's body order.

    Only these are sampled. A link of which nothing can be touched is left out, and the hands are looked for again without it.
    """
    surfaces: dict[str, LinkSurface] = {}
    while True:
        asked = included(include, tuple(sampler.meshes), dict(sampler.left_out))
        tree = kinematic_tree(sampler.robot, sampler.meshes)
        result = chosen_hands(tree)
        outer = {sampler.robot.compiled.body(body).name: why for body, why in outside(tree, result).items()}
        behind = {sampler.robot.compiled.body(body).name for flexion in result for body in hidden(flexion)} - asked
        for name in behind:
            sampler.drop(name, HIDDEN)
        if behind:
            continue
        wanted = [name for name in sampler.meshes if name not in outer or name in asked]
        fresh: dict[str, LinkSurface | str] = {}
        for i, name in enumerate(wanted):
            if name not in surfaces:
                progress(f"sampling {name} ({i + 1} of {len(wanted)} links)")
                fresh[name] = sampler.sampled(name)
        surfaces |= {name: own for name, own in fresh.items() if isinstance(own, LinkSurface)}
        dropped = {name: own for name, own in fresh.items() if isinstance(own, str)}
        for name, why in dropped.items():
            sampler.drop(name, why)
        if not dropped:
            sampler.left_out += [(name, why) for name, why in outer.items() if name not in asked]
            return result, {name: surfaces[name] for name in wanted}


def _boxes(flexion: Flexion) -> dict[int, Box]:
    """Return the boxes of the mounts of a hand that hold a tower beside it: they end where this rises above the rest."""
    result: dict[int, Box] = {}
    if flexion.hand.palm is None:
        return result
    front = PalmFront(flexion)
    for body in flexion.hand.mounts:
        if (limit := front.limit(body)) is not None:
            facing = np.array(flexion.palm_side(body).facing)
            corners = flexion.tree.surface[body].corners.reshape(-1, 3)
            low, high = corners.min(axis=0) - ROOM, corners.max(axis=0) + ROOM
            axis = int(np.abs(facing).argmax())
            (high if facing[axis] > 0 else low)[axis] = facing[axis] * limit
            result[body] = tuple(low.round(4).tolist()), tuple(high.round(4).tolist())
    return result


def _link(name: str, surface: LinkSurface, side: InnerSide, box: Box, density: float) -> LinkProposal:
    share, facing, doubt = 1.0, side.facing, side.doubt
    if facing is not None:
        pool = surface.pool
        is_in = _faces(pool.normal, facing)
        if box:
            is_in &= ((pool.pos >= box[0]) & (pool.pos <= box[1])).all(axis=1)
        share = float(pool.point_area[is_in].sum()) / pool.area
        if share < MIN_SHARE:
            share, facing, doubt, box = 1.0, None, UNCLEAR, ()
    area = share * surface.area
    counts = {resolution: max(1, _rounded(area * density * factor)) for resolution, factor in FACTORS.items()}
    if max(counts.values()) > MAX_COUNT:
        raise TgdslError(
            f'link "{name}" would have {max(counts.values())} taxels, expected at most {MAX_COUNT}; lower the density'
        )
    return LinkProposal(name, area, facing, doubt, counts, surface.options, box)


def _rounded(number: float) -> int:
    """Return the nearest integer; of what is within a thousandth of the middle of two, the larger.

    Areas that people draw often hold half a taxel more, and the last bits of an area shall not decide.
    """
    return int(np.floor(number + 0.501))


def _faces(normals: Float[np.ndarray, "n 3"], facing: tuple[float, ...]) -> Bool[np.ndarray, " n"]:
    direction = np.array(facing) / np.linalg.norm(facing)
    return normals @ direction >= np.cos(np.radians(WITHIN_DEG))


def _groups(found: Sequence[Flexion], names: dict[int, str], links: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the groups that have members; `fingers` and `hand` name those that they contain."""
    order = {name: i for i, name in enumerate(links)}
    tips = {names[body] for flexion in found for body in flexion.tips}
    palms = {names[body] for flexion in found for body in palm_parts(flexion)}
    fingers = {names[body] for flexion in found for body in flexion.hand.fingers}
    mounts = {names[body] for flexion in found for body in flexion.hand.mounts} - palms
    known = {name for name, members in (("tips", tips), ("palm", palms), ("fingers", fingers), ("hand", links)) if members}

    def members(group: str, *others: str, bodies: set[str]) -> tuple[str, ...]:
        patterns = (_own(escaped(name), known - {group}) for name in sorted(bodies, key=order.__getitem__))
        return (*(other for other in others if other in known), *patterns)

    wanted = {
        "tips": members("tips", bodies=tips),
        "palm": members("palm", bodies=palms),
        "fingers": members("fingers", "tips", bodies=fingers - tips) if fingers else (),
        "hand": members("hand", "fingers", "palm", bodies=mounts),
    }
    return {name: group for name, group in wanted.items() if group}


def escaped(name: str) -> str:
    """Return the pattern that matches a name and nothing else."""
    return re.sub(r"[*?\[]", r"[\g<0>]", name)


def _own(pattern: str, groups: set[str]) -> str:
    """Return a pattern that means the link even if another group has its name."""
    return f"[{pattern[0]}]{pattern[1:]}" if pattern in groups else pattern


def _shared(robot: Model, links: tuple[str, ...]) -> tuple[str, ...]:
    """Return links whose name some geom or mesh of another link has too: a selection takes both."""
    elsewhere = {name for geom in robot.geoms if geom.body in links for name in geom.names if name != geom.body}
    return tuple(name for name in links if name in elsewhere)
