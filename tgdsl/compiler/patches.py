"""The links that a layout gives taxels, and the taxels on them.

Selections of names are looked up here: what they mean, and what is wrong with them, at its place.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tgdsl.console.progress import Progress
from tgdsl.errors import Problem, SampleError, did_you_mean
from tgdsl.fields.models import Selection, SpecModel
from tgdsl.fields.regions import OnGeoms
from tgdsl.formats.model import Model
from tgdsl.layout.layout import Layout, Link
from tgdsl.placement.reach import Colliders
from tgdsl.placement.sample.poisson import Pool
from tgdsl.placement.sample.sample import Samples, sample
from tgdsl.schema.load import Loaded, LoadedLayout
from tgdsl.schema.placement import Placement, Points
from tgdsl.schema.select import Report, is_plain, matching, select
from tgdsl.schema.yaml import Path
from tgdsl.surfaces.geom import Geom
from tgdsl.surfaces.surface import Surface

Pools = dict[Hashable, dict[Hashable, Pool | None]]  # points that were drawn on links, by the geoms that are sampled and by how


@dataclass(frozen=True)
class Patch:
    """A link that the layout gives taxels: its name and body, the geoms that are sampled, and how."""

    link: Link
    geoms: tuple[Geom, ...]
    placement: Placement
    path: Path

    @property
    def as_collided(self) -> bool:
        """Whether its taxels are on the convex hulls that the simulator collides."""
        return not isinstance(self.placement, Points) and self.placement.surface == "collision"


def names_of(robot: Model) -> list[list[str]]:
    """Return the names that selectors know: of bodies, geoms and meshes, each with those of what it belongs to."""
    return [[body] for body in robot.bodies] + [[*geom.names, geom.body] for geom in robot.geoms if geom.names]


def reporter(owner: Loaded | LoadedLayout, path: Path, problems: list[Problem]) -> Report:
    """Return a function that notes what is wrong with a pattern, at the place where the pattern stands.

    That a pattern is the name of a group which was left out, as it has a mistake of its own, is no other mistake.
    """
    layout = owner.layout if isinstance(owner, Loaded) else owner

    def report(where: tuple[str, int], what: str, hint: str) -> None:
        written = owner.raw(path)  # `links: a` and `links: [a]` stand for `links: {include: [a]}`
        place = where if isinstance(written, dict) else where[1:] if isinstance(written, list) else ()
        pattern = owner.raw((*path, *place))
        if layout is None or pattern in layout.spec.groups or layout.raw(("groups", str(pattern))) is None:
            problems.append(owner.problem((*path, *place), what, hint))

    return report


def _geom_selections(owner: Loaded | LoadedLayout, value: object, path: Path) -> Iterator[tuple[Path, Selection]]:
    """Yield each selection of geoms in a part of a document, and where it stands."""
    if isinstance(value, OnGeoms):
        yield (*path, "geoms"), value.geoms
    elif isinstance(value, SpecModel):
        for name in type(value).model_fields:
            yield from _geom_selections(owner, getattr(value, name), (*path, name))
    elif isinstance(value, tuple):
        is_list = isinstance(owner.raw(path), list)  # one region may stand for a list of one
        for i, part in enumerate(value):
            yield from _geom_selections(owner, part, (*path, i) if is_list else path)


def check_regions(owner: Loaded | LoadedLayout, value: object, path: Path, robot: Model, problems: list[Problem]) -> None:
    """Note the plain names that regions exclude and that nothing has; what they include is looked up on each link."""
    names = sorted({name for geom in robot.geoms for name in geom.names})
    for place, selection in _geom_selections(owner, value, path):
        report = reporter(owner, place, problems)
        for i, name in enumerate(selection.exclude):
            if is_plain(name) and name not in names:
                report(("exclude", i), f'no geom or mesh matches "{name}"', did_you_mean(name, names, "geoms and meshes"))


def patches_of(loaded: Loaded, layout: LoadedLayout, robot: Model, placements: dict[str, Placement]) -> list[Patch]:
    """Return the links that carry taxels, in the robot's body order."""
    result: dict[str, Patch] = {}
    for pattern, placement in placements.items():
        path: Path = ("resolutions", str(loaded.resolution), pattern)
        check_regions(layout, placement, path, robot, loaded.problems)
        hits = matched(robot, pattern)
        if not hits:
            all_names = [name for names in names_of(robot) for name in names]
            problem = f'no body, geom or mesh matches "{pattern}"'
            layout.note(path, problem, did_you_mean(pattern, all_names, "links"), on_key=True)
        for link, geoms in hits:
            if link.name in result:
                problem = f'link "{link.name}" already has a layout, by "{result[link.name].path[-1]}"'
                layout.note(path, problem, "give each link one", on_key=True)
            elif not geoms:
                layout.note(path, f'link "{link.name}" has no geoms', on_key=True)
            else:
                result[link.name] = Patch(link, geoms, placement, path)
    order = {body: i for i, body in enumerate(robot.bodies)}
    return sorted(result.values(), key=lambda patch: (order[patch.link.body], patch.geoms[0].id))


def matched(robot: Model, pattern: str) -> list[tuple[Link, tuple[Geom, ...]]]:
    """Return the links that a layout's key names: bodies, else geoms by name, else the geoms of a mesh."""
    bodies = matching(pattern, [body for body in robot.bodies if body != "world"])
    if bodies:
        return [(Link(body, body), robot.touchable(body)) for body in bodies]
    geoms = [geom for geom in robot.geoms if geom.name and matching(pattern, [geom.name])]
    if geoms:
        return [(Link(geom.name, geom.body), (geom,)) for geom in geoms]
    of_mesh: dict[tuple[str, str], list[Geom]] = {}
    for geom in robot.geoms:
        if geom.mesh and matching(pattern, [geom.mesh]):
            of_mesh.setdefault((geom.mesh, geom.body), []).append(geom)
    meshes = [mesh for mesh, _ in of_mesh]
    links = []
    for (mesh, body), places in of_mesh.items():
        name = mesh if meshes.count(mesh) == 1 else f"{body}/{mesh}"
        links.append((Link(name, body), tuple(geom for geom in places if geom.is_colliding) or tuple(places)))
    return links


def sampled(
    loaded: Loaded,
    layout: LoadedLayout,
    colliders: Colliders,
    patches: list[Patch],
    objects: Sequence[int],
    pools: Pools,
    progress: Progress,
) -> Layout:
    """Return the taxels of links.

    `objects` are bodies of the robot's file that are no links; points that are drawn on links are added to `pools`.

    Raises:
        SpecError: If a surface cannot satisfy a placement; all mistakes found so far.
    """
    parts: list[Samples] = []
    for i, patch in enumerate(patches):
        progress(f"placing taxels on {patch.link.name} ({i + 1} of {len(patches)} links)")
        try:
            covered = colliders.cover_of(patch.link.body, patch.geoms, objects)
            surface, name = _surface(colliders.robot, patch), patch.link.name
            drawn = pools.setdefault((patch.as_collided, *(geom.id for geom in patch.geoms)), {})
            parts.append(sample(surface, patch.placement, layout.folder, name, covered, drawn))
        except SampleError as error:
            layout.note(patch.path, f'link "{patch.link.name}": {error.what}', error.hint)
    loaded.raise_problems()
    if not parts:  # all sensors are on links, whatever their taxels
        return Layout.of_links((), {})
    counts = [len(part.pos) for part in parts]
    return Layout(
        links=tuple(patch.link for patch in patches),
        groups=_groups(layout, patches),
        link_id=np.repeat(np.arange(len(patches)), counts),
        pos=np.concatenate([part.pos for part in parts]),
        normal=np.concatenate([part.normal for part in parts]),
        tangent=np.concatenate([part.tangent for part in parts]),
        radius=np.concatenate([part.radius for part in parts]),
        area=np.concatenate([part.area for part in parts]),
        cell=np.concatenate([part.cell for part in parts]),
    )


def _surface(robot: Model, patch: Patch) -> Surface:
    """Return the triangles that a link's taxels are sampled on."""
    if patch.as_collided and not all(geom.is_colliding for geom in patch.geoms):
        apart = next(geom for geom in patch.geoms if not geom.is_colliding)
        raise SampleError(f"the simulator does not collide {apart.shown}", "expected `surface: mesh`")
    return robot.surface(patch.geoms, patch.as_collided)


def _groups(layout: LoadedLayout, patches: list[Patch]) -> dict[str, tuple[str, ...]]:
    candidates = [[patch.link.name, patch.link.body] for patch in patches]
    groups: dict[str, tuple[str, ...]] = {}
    for group, selection in sorted(layout.spec.groups.items()):
        members = select(selection, candidates, layout.spec.groups, lambda where, what, hint: None)
        if members:
            groups[group] = tuple(patches[i].link.name for i in members)
    return groups
