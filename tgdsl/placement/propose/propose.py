"""A first layout for a robot without one: groups and taxels guessed from its tree, joints and surfaces.

Every guess is written to the file, where a reader can change it. A `Draft` changes it before it is written.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
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
from tgdsl.placement.sample.sample import Drawn, Samples, sample
from tgdsl.schema.placement import MAX_COUNT, Poisson
from tgdsl.schema.select import matching
from tgdsl.surfaces.surface import Surface

FACTORS = {"low": 0.25, "med": 1.0, "high": 4.0}  # each resolution's share of the density
COVERING = 0.75  # radius over the square root of the area per taxel: discs on a triangular grid cover it from 0.62 on
ROOM = 1e-3  # a box is larger than a link's surface by this [m]
BEFORE = "before the link from which the fingers part; --include adds it"
BESIDE = "no part of a hand; --include adds it"
NO_LIMITS = "no joint of the hand has limits: its hinges are assumed to turn by 30 deg to either side"
SCENERY = "stands or floats by itself: taken for scenery or an object; --include adds it"
NESTED = {"tips": (), "palm": (), "fingers": ("tips",), "hand": ("fingers", "palm", "tips")}
"""The groups, and by which others each is written where it holds all their links."""
Box = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class LinkProposal:
    """The taxels of a link."""

    name: str  # its body
    density: float  # taxels per area at `med` [1/m²]
    facing: tuple[float, ...] | None  # direction of its inner side in the link's frame; None: it is covered all around
    doubt: str  # what speaks against that side, or why there is none; empty if nothing does
    box: Box | None  # corners of the part with taxels, such as the part without a tower, in the link's frame [m]; None: all
    area: float  # surface to be covered [m²]
    counts: dict[str, int]  # number of taxels at each resolution
    options: Options  # options by which taxels are where they can feel
    within: float = WITHIN_DEG  # largest angle between a normal and `facing` [deg]
    is_guess: bool = True  # whether side and box are guessed, not chosen
    geoms: tuple[str, ...] = ()  # names of its geoms, if they are several: each could be a link

    @property
    def region(self) -> tuple[Any, ...]:
        """Side, angle and box: the part of the link with taxels."""
        return self.facing, self.within, self.box


@dataclass(frozen=True)
class Proposal:
    """A layout."""

    density: float  # taxels per area at `med`, where a link has no other [1/m²]
    members: dict[str, tuple[str, ...]]  # links of each group; empty without groups
    links: tuple[LinkProposal, ...]  # links with taxels, in the robot's body order
    left_out: tuple[tuple[str, str], ...]  # bodies without taxels, and why
    shared: tuple[str, ...]  # names of links that other links' geoms or meshes have too
    is_collided: bool  # whether the simulator collides its links: all or none
    is_misread: bool = False  # whether limits of its hinges look like radians that were read as degrees
    chosen_groups: frozenset[str] = frozenset()  # groups whose links are chosen, not guessed

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The groups that have links, as selections; `fingers` and `hand` name groups that they contain."""
        nonempty = {name for name, links in self.members.items() if links}
        return {name: self._selection(name, nonempty) for name in self.members if name in nonempty}

    def _selection(self, group: str, known: set[str]) -> tuple[str, ...]:
        links, inner, covered = self.members[group], list[str](), set[str]()
        for other in NESTED[group]:
            part = set(self.members[other])
            if part <= {*links} and not part <= covered:
                inner.append(other)
                covered |= part
        patterns = [escaped(name) for name in links if name not in covered]
        # A pattern such as [p]alm means the link even if another group has its name.
        return (*inner, *(f"[{pattern[0]}]{pattern[1:]}" if pattern in known - {group} else pattern for pattern in patterns))

    def placement(self, link: LinkProposal, resolution: str) -> dict[str, Any]:
        """Return how a link is sampled, as the grammar has it."""
        result: dict[str, Any] = {"method": "poisson", "count": link.counts[resolution]}
        radius_mm = float(f"{1e3 * COVERING / np.sqrt(link.density * FACTORS[resolution]):.2g}")
        result |= {"radius": f"{radius_mm:g} mm", **link.options}
        region: list[dict[str, Any]] = []
        if link.facing is not None:
            region.append({"facing": [float(x) for x in link.facing], "within": f"{link.within:g} deg"})
        if link.box is not None:
            region.append({"box": {"min": list(link.box[0]), "max": list(link.box[1])}})
        if region:
            result["region"] = region[0] if len(region) == 1 else region
        return result

    def mapping(self) -> dict[str, Any]:
        resolutions = {r: {escaped(link.name): self.placement(link, r) for link in self.links} for r in FACTORS}
        groups = {"groups": {name: list(members) for name, members in self.groups.items()}} if self.groups else {}
        return {"tgdsl": 1, **groups, "resolutions": resolutions}


def propose(
    robot: Model, density: float, with_groups: bool = True, include: Sequence[str] = (), progress: Progress = silent
) -> Proposal:
    """Return a layout for a robot; the same robot gives the same layout. See `Draft`."""
    return Draft(robot, density, with_groups, include, progress).proposal


class Draft:
    """A proposal that can be changed link by link and group by group.

    Attributes:
        robot: The robot.
        proposal: The current layout; assign an earlier one to undo changes.
    """

    def __init__(
        self,
        robot: Model,
        density: float,
        with_groups: bool = True,
        include: Sequence[str] = (),
        progress: Progress = silent,
    ):
        """Guess.

        Raises:
            TgdslError: If no link can be sampled, if the density asks for more taxels than a link can have, or if a name to
                include matches no link that can have taxels.
        """
        self.robot, self._sampler = robot, Sampler(robot)
        self._pools: dict[str, tuple[Any, Drawn]] = {}  # by link: the surface, and the pools on it
        flexions, surfaces = _sampled_hands(self._sampler, include, progress, density)
        left_out = tuple(self._sampler.left_out)
        if not surfaces:
            problem = "; ".join(f'"{name}": {why}' for name, why in left_out)
            raise TgdslError(f"{robot.file}: no link has a surface for taxels" + (f" ({problem})" if problem else ""))
        names = {int(robot.compiled.body(name).id): name for name in surfaces}
        bodies = ((flexion, b) for flexion in flexions for b in (*flexion.hand.mounts, *flexion.hand.fingers))
        asked_for = InnerSide(None, "asked for with --include")
        self._sides = dict.fromkeys(surfaces, asked_for) | {names[b]: flexion.inner_side(b) for flexion, b in bodies}
        self._boxes = {names[b]: box for flexion in flexions for b, box in _boxes(flexion).items()}
        self._surfaces = {name: (density, surface) for name, surface in surfaces.items()}
        links = tuple(self._guess(name, density) for name in robot.bodies if name in surfaces)
        self._members = _members(flexions, names, tuple(surfaces)) if with_groups else {}
        # A selection by a link's name also takes other links' geoms and meshes of that name.
        elsewhere = {name for geom in robot.geoms if geom.body in surfaces for name in geom.names if name != geom.body}
        shared, is_misread = tuple(name for name in surfaces if name in elsewhere), angles_are_misread(robot.compiled)
        self.proposal = Proposal(density, self._members, links, left_out, shared, self._sampler.is_collided, is_misread)

    def change(self, names: Collection[str], density: float | None = None, **region: Any) -> None:
        """Change the density [1/m²] of links, or their region: `facing`, `within` and `box` of `LinkProposal`.

        A density common to all links becomes the layout's. A value equal to its guess counts as a guess again.

        Raises:
            TgdslError: If the density is not positive or asks for too many taxels, or a region misses a link's surface. The
                proposal then stays unchanged.
        """
        if density is not None and not density > 0:
            raise TgdslError(f"density: {density * 1e-4:g}/cm2 is out of range, expected more than 0")
        if not 0 < region.get("within", WITHIN_DEG) <= 180:
            raise TgdslError(f"within: {region['within']:g} deg is out of range, expected more than 0 and at most 180")
        links = tuple(
            self._changed(link, density or link.density, region) if link.name in names else link for link in self.proposal.links
        )
        densities = {link.density for link in links}
        common = densities.pop() if len(densities) == 1 else self.proposal.density
        self.proposal = replace(self.proposal, links=links, density=common)

    def set_group(self, group: str, names: Collection[str]) -> None:
        """Give a group other links."""
        members = {**self.proposal.members, group: tuple(name for name in self._surfaces if name in names)}
        changed = frozenset(name for name, links in members.items() if links != self._members[name])
        self.proposal = replace(self.proposal, members=members, chosen_groups=changed)

    def bounds(self, name: str) -> Box:
        """Return the corners of a box around a link's surface, in its frame [m]."""
        return _around(self._sampler.meshes[name])

    def samples(self, link: LinkProposal, resolution: str) -> Samples:
        """Return the taxels of a link, as a compiled document has them.

        Raises:
            SampleError: If the region holds too little of the link's surface.
        """
        placement, geoms = Poisson.model_validate(self.proposal.placement(link, resolution)), self.robot.touchable(link.name)
        surface = self.robot.surface(geoms, placement.surface == "collision")
        is_covered = self._sampler.colliders.cover_of(link.name, geoms)
        drawn_on = placement.surface, placement.region
        if self._pools.get(link.name, ((), {}))[0] != drawn_on:
            self._pools[link.name] = drawn_on, {}
        return sample(surface, placement, Path(), link.name, is_covered, self._pools[link.name][1])

    def _changed(self, link: LinkProposal, density: float, region: Mapping[str, Any]) -> LinkProposal:
        guess = self._guess(link.name, density)
        result = replace(guess if link.is_guess else replace(link, density=density), **region)
        if result.region == guess.region:
            return guess
        return _measured(replace(result, doubt="", is_guess=False), self._surface(link.name, density))

    def _guess(self, name: str, density: float) -> LinkProposal:
        link = _link(name, self._surface(name, density), self._sides[name], self._boxes.get(name), density)
        geoms = [geom.names for geom in self.robot.touchable(name)]
        return replace(link, geoms=tuple(names[0] for names in geoms if names)) if len(geoms) > 1 else link

    def _surface(self, name: str, density: float) -> LinkSurface:
        """Return samples of a link for a density."""
        if self._surfaces[name][0] != density:
            surface = self._sampler.sampled(name, _least_radius(density))
            if isinstance(surface, str):
                raise TgdslError(f'link "{name}": {surface}')
            self._surfaces[name] = density, surface
        return self._surfaces[name][1]


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
    """Return the bodies with surface outside all hands, with the reason why a layout leaves them out."""
    within = {body for flexion in flexions for body in (*flexion.hand.mounts, *flexion.hand.fingers)}
    ancestors = {s for flexion in flexions for s in tree.path(flexion.hand.base)[1:]}
    carrying = {b for flexion in flexions for m in flexion.hand.mounts for b in tree.within(flexion.hand.base, m)}
    scenery = set(free_standing(tree))
    result: dict[int, str] = {}
    for body in sorted(tree.surface.keys() - within):
        is_before = tree.segment[body] in ancestors or body in carrying
        result[body] = SCENERY if body in scenery else BEFORE if is_before else BESIDE
    return result


def _included(patterns: Sequence[str], names: Sequence[str], left_out: Mapping[str, str]) -> set[str]:
    """Return the links that match the patterns."""
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


def _least_radius(density: float) -> float:
    """Return a little less than the radius of taxels at the finest resolution [m]."""
    return 0.95 * COVERING / float(np.sqrt(density * max(FACTORS.values())))


def _sampled_hands(
    sampler: Sampler, include: Sequence[str], progress: Progress, density: float
) -> tuple[list[Flexion], dict[str, LinkSurface]]:
    """Return the hands, and samples of their links and of those to include, in the robot's body order."""
    surfaces: dict[str, LinkSurface] = {}
    while True:
        include_names = _included(include, tuple(sampler.meshes), dict(sampler.left_out))
        tree = kinematic_tree(sampler.robot, sampler.meshes)
        flexions = chosen_hands(tree)
        names = {body: sampler.robot.compiled.body(body).name for body in tree.surface}
        reasons = {names[body]: why for body, why in _outside(tree, flexions).items()}
        dropped = {names[body]: HIDDEN for flexion in flexions for body in hidden(flexion) if names[body] not in include_names}
        links = [name for name in sampler.meshes if name not in reasons or name in include_names]
        for i, name in enumerate(links if not dropped else []):
            if name not in surfaces:
                progress(f"sampling {name} ({i + 1} of {len(links)} links)")
                surface = sampler.sampled(name, _least_radius(density))
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
    """Return a box for each mount with a tower outside the hand: it ends where the tower rises above the rest."""
    result: dict[int, Box] = {}
    if flexion.hand.palm is None:
        return result
    front = PalmFront(flexion)
    for body in flexion.hand.mounts:
        facing, limit = np.array(flexion.palm_side(body).facing), front.limit(body)
        if limit is not None and np.abs(facing).max() == 1.0:  # the box of a region stands along the axes
            low, high = map(list, _around(flexion.tree.surface[body]))
            axis = int(np.abs(facing).argmax())
            (high if facing[axis] > 0 else low)[axis] = round(float(facing[axis] * limit), 4)
            result[body] = tuple(low), tuple(high)
    return result


def _around(surface: Surface) -> Box:
    """Return the corners of a box around a surface, with a margin [m]."""
    corners = surface.corners.reshape(-1, 3)
    low, high = (corners.min(axis=0) - ROOM).round(4), (corners.max(axis=0) + ROOM).round(4)
    return tuple(low.tolist()), tuple(high.tolist())


def _link(name: str, surface: LinkSurface, side: InnerSide, box: Box | None, density: float) -> LinkProposal:
    """Return a link's guess: its whole surface if too little of it faces the inner side."""
    result = LinkProposal(name, density, side.facing, side.doubt, None if side.facing is None else box, 0.0, {}, {})
    if _share(result, surface) < MIN_SHARE:
        result = replace(result, facing=None, doubt=UNCLEAR, box=None)
    return _measured(result, surface)


def _share(link: LinkProposal, surface: LinkSurface) -> float:
    """Return the share of a surface that is in a link's region."""
    pool = surface.pool
    if link.facing is None and link.box is None:
        return 1.0
    is_in = np.ones(len(pool.pos), dtype=bool)
    if link.facing is not None:
        direction = np.array(link.facing) / np.linalg.norm(link.facing)
        is_in &= pool.normal @ direction >= np.cos(np.radians(link.within))
    if link.box is not None:
        is_in &= ((pool.pos >= link.box[0]) & (pool.pos <= link.box[1])).all(axis=1)
    return float(pool.point_area[is_in].sum()) / pool.area


def _measured(link: LinkProposal, surface: LinkSurface) -> LinkProposal:
    """Return a link with area, counts and options by its density and region."""
    area = _share(link, surface) * surface.pool.area
    if area == 0:
        raise TgdslError(f'link "{link.name}": its surface has nothing in this region')
    # Areas that people draw often hold half a taxel more, and the last bits of an area shall not decide.
    counts = {name: max(1, int(np.floor(area * link.density * factor + 0.501))) for name, factor in FACTORS.items()}
    if max(counts.values()) > MAX_COUNT:
        raise TgdslError(
            f'link "{link.name}" would have {max(counts.values())} taxels, expected at most {MAX_COUNT}; lower the density'
        )
    return replace(link, area=area, counts=counts, options=surface.options)


def _members(flexions: Sequence[Flexion], names: dict[int, str], links: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the links of each group, in their order."""
    tips = {names[body] for flexion in flexions for body in flexion.tips}
    palms = {names[body] for flexion in flexions for body in palm_parts(flexion)}
    fingers = {names[body] for flexion in flexions for body in flexion.hand.fingers}
    mounts = {names[body] for flexion in flexions for body in flexion.hand.mounts}
    fingers = fingers | tips if fingers else fingers
    groups = {"tips": tips, "palm": palms, "fingers": fingers, "hand": fingers | palms | mounts}
    return {group: tuple(name for name in links if name in members) for group, members in groups.items()}


def escaped(name: str) -> str:
    return re.sub(r"[*?\[]", r"[\g<0>]", name)
