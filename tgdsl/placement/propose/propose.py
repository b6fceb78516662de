"""A first layout for a robot that nobody has described: groups and taxels guessed from its tree, joints and surfaces.

Every guess is written down in the file, for its reader to keep or to change.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.formats.model import Model
from tgdsl.placement.propose.flexion import MIN_SHARE, UNCLEAR, WITHIN_DEG, Flexion, InnerSide, PalmFront, hidden, palm_parts
from tgdsl.placement.propose.hands import (
    RADIANS_AS_DEGREES,
    KinematicTree,
    angles_are_misread,
    free_standing,
    hands,
    kinematic_tree,
    with_assumed_limits,
)
from tgdsl.placement.propose.surfaces import HIDDEN, LinkSurface, Options, Sampler, link_meshes
from tgdsl.schema.select import matching

FACTORS = {"low": 0.25, "med": 1.0, "high": 4.0}  # each resolution's share of the density
COVERING = 0.75  # radius over the square root of the area per taxel: discs on a triangular grid cover it from 0.62 on
MAX_COUNT = 1_000_000  # the most taxels that the grammar lets a link have
ROOM = 1e-3  # a box is larger than a link's surface by this [m]
BEFORE = "before the link from which the fingers part; --include adds it"
BESIDE = "no part of a hand; --include adds it"
NO_LIMITS = "no joint of the hand has limits: its hinges are taken to turn by 30 deg to either side"
SCENERY = "stands or floats by itself: taken for scenery or an object; --include adds it"
Box = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class LinkProposal:
    """The taxels of a link."""

    name: str  # its body
    area: float  # surface to be covered [m²]
    facing: tuple[float, ...] | None  # direction of its inner side in the link's frame; None: it is covered all around
    doubt: str  # what speaks against that side, or why there is none; empty if nothing does
    counts: dict[str, int]  # number of taxels at each resolution
    options: Options  # options by which taxels are where they can feel
    box: Box | None = None  # corners of the part without a tower, in the link's frame [m]; None: all of it


@dataclass(frozen=True)
class Proposal:
    """A layout."""

    density: float  # taxels per area at `med` [1/m²]
    groups: dict[str, tuple[str, ...]]  # names of groups, and of links and groups in each
    links: tuple[LinkProposal, ...]  # links with taxels, in the robot's body order
    left_out: tuple[tuple[str, str], ...]  # bodies without taxels, and why
    shared: tuple[str, ...]  # names of links that other links' geoms or meshes have too
    is_collided: bool  # whether the simulator collides its links; else none of them
    is_misread: bool = False  # whether limits of its hinges look like radians that were read as degrees

    def placement(self, link: LinkProposal, resolution: str) -> dict[str, Any]:
        """Return how a link is sampled, as the grammar has it."""
        result: dict[str, Any] = {"method": "poisson", "count": link.counts[resolution]}
        radius_mm = float(f"{1e3 * COVERING / np.sqrt(self.density * FACTORS[resolution]):.2g}")
        result |= {"radius": f"{radius_mm:g} mm", **link.options}
        if link.facing is not None:
            facing = {"facing": [float(x) for x in link.facing], "within": f"{WITHIN_DEG} deg"}
            result["region"] = facing
            if link.box is not None:
                low, high = link.box
                result["region"] = [facing, {"box": {"min": list(low), "max": list(high)}}]
        return result

    def mapping(self) -> dict[str, Any]:
        resolutions = {r: {escaped(link.name): self.placement(link, r) for link in self.links} for r in FACTORS}
        groups = {"groups": {name: list(members) for name, members in self.groups.items()}} if self.groups else {}
        return {"tgdsl": 1, **groups, "resolutions": resolutions}


def propose(
    robot: Model, density: float, with_groups: bool = True, include: Sequence[str] = (), progress: Progress = silent
) -> Proposal:
    """Return a layout for a robot; the same robot gives the same layout.

    Raises:
        TgdslError: If no link can be sampled, if the density asks for more taxels than a link can have, or if a name to include
            matches no link that can have taxels.
    """
    sampler = Sampler(robot, 0.95 * COVERING / np.sqrt(density * max(FACTORS.values())))
    flexions, surfaces = _sampled_hands(sampler, include, progress)
    left_out = tuple(sampler.left_out)
    if not surfaces:
        problem = "; ".join(f'"{name}": {why}' for name, why in left_out)
        raise TgdslError(f"{robot.file}: no link has a surface for taxels" + (f" ({problem})" if problem else ""))
    names = {int(robot.compiled.body(name).id): name for name in surfaces}
    sides = {names[b]: flexion.inner_side(b) for flexion in flexions for b in (*flexion.hand.mounts, *flexion.hand.fingers)}
    asked_for = InnerSide(None, "asked for with --include")
    boxes = {names[b]: box for flexion in flexions for b, box in _boxes(flexion).items()}
    links = tuple(
        _link(name, surfaces[name], sides.get(name, asked_for), boxes.get(name), density)
        for name in robot.bodies
        if name in surfaces
    )
    groups = _groups(flexions, names, tuple(surfaces)) if with_groups else {}
    # A selection by a link's name also takes other links' geoms and meshes of that name.
    elsewhere = {name for geom in robot.geoms if geom.body in surfaces for name in geom.names if name != geom.body}
    shared, is_misread = tuple(name for name in surfaces if name in elsewhere), angles_are_misread(robot.compiled)
    return Proposal(density, groups, links, left_out, shared, sampler.is_collided, is_misread)


def closing_motion(robot: Model) -> Mapping[str, tuple[float, float]]:
    """Return how the hands of a robot close: by name, each joint's open and closed end [rad, of slides m].

    Joints without a name or a clear closed end are left out. Where limits are misread, see `angles_are_misread`, the ends are
    those in the simulator.
    """
    scale = RADIANS_AS_DEGREES if angles_are_misread(robot.compiled) else 1.0
    motion: dict[str, tuple[float, float]] = {}
    tree = kinematic_tree(robot, link_meshes(robot)[0])
    for flexion in chosen_hands(tree):
        if flexion.tree is tree:  # not within assumed limits
            motion |= {robot.compiled.joint(i).name: (one / scale, two / scale) for i, (one, two) in flexion.motion().items()}
    return {name: ends for name, ends in motion.items() if name}


def chosen_hands(tree: KinematicTree) -> list[Flexion]:
    """Return the hands of a robot that close, by two chains or a jaw; if none does, all candidates."""
    results = [Flexion(tree, hand) for hand in hands(tree)]
    closing = _closing(results)
    if not closing:
        free = replace(tree, model=with_assumed_limits(tree.model), doubt=NO_LIMITS)
        closing = _closing([Flexion(free, hand) for hand in hands(free) if hand.jaw is None])
    for flexion in closing:
        if flexion.hand.palm is not None:
            flexion.hand = replace(flexion.hand, mounts=PalmFront(flexion).mounts())
    return closing or results


def _closing(flexions: Sequence[Flexion]) -> list[Flexion]:
    return [flexion for flexion in flexions if flexion.num_closing > (flexion.hand.jaw is None)]


def _outside(tree: KinematicTree, flexions: Sequence[Flexion]) -> dict[int, str]:
    """Return the bodies with surface that are in no hand, and why a layout leaves them out."""
    within = {body for flexion in flexions for body in (*flexion.hand.mounts, *flexion.hand.fingers)}
    before = {s for flexion in flexions for s in tree.path(flexion.hand.base)[1:]}
    carrying = {b for flexion in flexions for m in flexion.hand.mounts for b in tree.within(flexion.hand.base, m)}
    scenery = set(free_standing(tree))
    result: dict[int, str] = {}
    for body in sorted(tree.area.keys() - within):
        is_before = tree.segment[body] in before or body in carrying
        result[body] = SCENERY if body in scenery else BEFORE if is_before else BESIDE
    return result


def _included(patterns: Sequence[str], names: Sequence[str], left_out: Mapping[str, str]) -> set[str]:
    """Return the links that some patterns ask for."""
    result: set[str] = set()
    for pattern in patterns:
        links = {pattern} & {*names} or {*matching(pattern, names)}
        if not links:
            barred = [name for name in left_out if name == pattern or name in matching(pattern, [name])]
            why = [f'"{name}" can have no taxels: {left_out[name]}' for name in barred]
            problem = "; ".join(why) or f'no link matches "{pattern}"; {did_you_mean(pattern, names, "links")}'
            raise TgdslError(f"--include: {problem}")
        result |= links
    return result


def _sampled_hands(
    sampler: Sampler, include: Sequence[str], progress: Progress
) -> tuple[list[Flexion], dict[str, LinkSurface]]:
    """Return the hands, and samples of their links and of those to include, in the robot's body order."""
    surfaces: dict[str, LinkSurface] = {}
    while True:
        include_names = _included(include, tuple(sampler.meshes), dict(sampler.left_out))
        tree = kinematic_tree(sampler.robot, sampler.meshes)
        flexions = chosen_hands(tree)
        names = {body: sampler.robot.compiled.body(body).name for body in tree.area}
        reasons = {names[body]: why for body, why in _outside(tree, flexions).items()}
        dropped = {names[body]: HIDDEN for flexion in flexions for body in hidden(flexion) if names[body] not in include_names}
        links = [name for name in sampler.meshes if name not in reasons or name in include_names]
        for i, name in enumerate(links if not dropped else []):
            if name not in surfaces:
                progress(f"sampling {name} ({i + 1} of {len(links)} links)")
                surface = sampler.sampled(name)
                if isinstance(surface, str):
                    dropped[name] = surface
                else:
                    surfaces[name] = surface
        for name, why in dropped.items():
            sampler.drop(name, why)
        if not dropped:
            sampler.left_out += [(name, why) for name, why in reasons.items() if name not in include_names]
            return flexions, {name: surfaces[name] for name in links}


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


def _link(name: str, surface: LinkSurface, side: InnerSide, box: Box | None, density: float) -> LinkProposal:
    share, facing, doubt = 1.0, side.facing, side.doubt
    if facing is not None:
        pool = surface.pool
        direction = np.array(facing) / np.linalg.norm(facing)
        is_in = pool.normal @ direction >= np.cos(np.radians(WITHIN_DEG))
        if box is not None:
            is_in &= ((pool.pos >= box[0]) & (pool.pos <= box[1])).all(axis=1)
        share = float(pool.point_area[is_in].sum()) / pool.area
        if share < MIN_SHARE:
            share, facing, doubt, box = 1.0, None, UNCLEAR, None
    area = share * surface.pool.area
    # Areas that people draw often hold half a taxel more, and the last bits of an area shall not decide.
    counts = {name: max(1, int(np.floor(area * density * factor + 0.501))) for name, factor in FACTORS.items()}
    if max(counts.values()) > MAX_COUNT:
        raise TgdslError(
            f'link "{name}" would have {max(counts.values())} taxels, expected at most {MAX_COUNT}; lower the density'
        )
    return LinkProposal(name, area, facing, doubt, counts, surface.options, box)


def _groups(flexions: Sequence[Flexion], names: dict[int, str], links: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the groups that have members; `fingers` and `hand` name those that they contain."""
    order = {name: i for i, name in enumerate(links)}
    tips = {names[body] for flexion in flexions for body in flexion.tips}
    palms = {names[body] for flexion in flexions for body in palm_parts(flexion)}
    fingers = {names[body] for flexion in flexions for body in flexion.hand.fingers}
    mounts = {names[body] for flexion in flexions for body in flexion.hand.mounts} - palms
    known = {name for name, members in (("tips", tips), ("palm", palms), ("fingers", fingers), ("hand", links)) if members}

    def members(group: str, *others: str, bodies: set[str]) -> tuple[str, ...]:
        patterns = [escaped(name) for name in sorted(bodies, key=order.__getitem__)]
        # A pattern such as [p]alm means the link even if another group has its name.
        links = [f"[{pattern[0]}]{pattern[1:]}" if pattern in known - {group} else pattern for pattern in patterns]
        return (*(other for other in others if other in known), *links)

    wanted = {
        "tips": members("tips", bodies=tips),
        "palm": members("palm", bodies=palms),
        "fingers": members("fingers", "tips", bodies=fingers - tips) if fingers else (),
        "hand": members("hand", "fingers", "palm", bodies=mounts),
    }
    return {name: group for name, group in wanted.items() if group}


def escaped(name: str) -> str:
    return re.sub(r"[*?\[]", r"[\g<0>]", name)
