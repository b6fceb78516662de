"""From a Spec and a robot to a Layout: which links carry taxels, where these sit, and what they can feel."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tgdsl.compiler.objects import own_objects, sensed_objects
from tgdsl.compiler.variants import OwnObjects
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError, Problem, SampleError, did_you_mean, listed
from tgdsl.fields.models import Selection, SpecModel
from tgdsl.fields.regions import OnGeoms, RegionPart
from tgdsl.files.find import is_file, robot_names
from tgdsl.formats.model import Model
from tgdsl.formats.robot import load_model
from tgdsl.layout.layout import Layout, Link
from tgdsl.placement.sample.sample import Samples, sample
from tgdsl.schema.loaded import Loaded, LoadedLayout
from tgdsl.schema.placement import Placement
from tgdsl.schema.select import Report, is_plain, matching, select
from tgdsl.schema.yaml import Path
from tgdsl.sensors.base import SensorSpec
from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.region import clip
from tgdsl.surfaces.sensed import SensedObject
from tgdsl.surfaces.surface import Surface


@dataclass(frozen=True)
class Patch:
    """A link that the layout gives taxels: its name and body, the geoms that are sampled, and how."""

    link: Link
    geoms: tuple[Geom, ...]
    placement: Placement
    path: Path


@dataclass(frozen=True, eq=False)
class Resolved:
    """A spec's meaning on one robot.

    Attributes:
        layout: Taxels of the links that some sensor has; of all links if the document has no sensors.
        links: Names of each sensor's links.
        objects: What can be felt of each object that is felt.
        own: The objects with geoms or sizes of their own.
        scene: The model that holds robot and objects.
        robot: The robot's own model.
        unused: What has taxels or can be felt but is not needed, and why.
        patches: The links that carry taxels.
        on_links: The sensors that have a place on each link, whatever its taxels.
    """

    layout: Layout
    links: dict[str, tuple[str, ...]]
    objects: dict[str, SensedObject]
    own: OwnObjects
    scene: Model
    robot: Model
    unused: tuple[tuple[str, str], ...]
    patches: Mapping[str, Patch]
    on_links: frozenset[str] = frozenset()

    def surface_of(self, link: str, region: Sequence[RegionPart]) -> Surface:
        """Return the triangles of a link, or of a region of it, in its body's frame.

        Raises:
            LowerError: If the region holds nothing of the link.
        """
        surface = self.robot.surface(self.patches[link].geoms)
        try:
            return clip(surface, region) if region else surface
        except SampleError as error:
            raise LowerError(error.what, hint=error.hint) from error

    def geoms_of(self, link: str) -> tuple[SurfaceGeom, ...]:
        """Return the geoms that a link's taxels sit on: meshes as they are, not their convex hulls."""
        geoms = self.patches[link].geoms
        return tuple(SurfaceGeom(geom, self.robot.mesh(geom) if geom.shape == "mesh" else None) for geom in geoms)

    def layout_on(self, sensor: str) -> tuple[np.ndarray, Layout]:
        """Return the taxels of a sensor, and its layout; of one that is on links, no taxels and the links."""
        names = self.links[sensor]
        if sensor in self.on_links:
            links = tuple(Link(name, name) for name in names)
            return np.zeros(0, dtype=np.int64), Layout.of_links(links, self.layout.groups)
        taxels = self.layout.taxels_of(names)
        return taxels, self.layout.take(taxels)


def resolve(loaded: Loaded, progress: Progress = silent) -> Resolved:
    """Place a document's sensors on its robot.

    Args:
        loaded: The document.
        progress: Is told what is done.

    Raises:
        SpecError: All mistakes found so far, those of reading included.
        RobotError: If a model file cannot be read.
    """
    progress("reading robot and scene")
    robot, scene = _models(loaded)
    patches: list[Patch] = []
    links: dict[str, tuple[str, ...]] = {}
    objects: dict[str, SensedObject] = {}
    own = OwnObjects()
    if robot is not None and loaded.layout is not None and not _is_foreign(loaded, loaded.layout, robot):
        _check_groups(loaded.layout, robot, loaded.problems)
        placements = loaded.layout.spec.resolutions.get(loaded.resolution or "")
        if placements is not None:
            patches = _patches(loaded, loaded.layout, robot, placements)
            links = _sensor_links(loaded, loaded.layout, robot, patches)
    if robot is not None and scene is not None:
        _check_bodies(loaded, robot, scene, patches)
        scene, own = own_objects(loaded, scene, {patch.link.body for patch in patches})
        objects = sensed_objects(loaded, scene, own)
    loaded.raise_problems()
    assert robot is not None and scene is not None and loaded.layout is not None
    on_links = frozenset(name for name, sensor in loaded.spec.sensors.items() if not sensor.is_on_taxels)
    needed = {link for name, own in links.items() for link in own if name not in on_links}
    needed = needed if links else {patch.link.name for patch in patches}
    layout = _sampled(loaded, loaded.layout, robot, [patch for patch in patches if patch.link.name in needed], progress)
    loaded.raise_problems()
    unused = [(f"link {p.link.name}", "no sensor is on its taxels") for p in patches if p.link.name not in needed]
    unused += [(f"object {name}", "no sensor feels it") for name in loaded.spec.objects if name not in objects]
    unused += [(f"body {body}", why) for body, why in _unlisted(loaded, robot, scene, objects)]
    return Resolved(layout, links, objects, own, scene, robot, tuple(unused), {p.link.name: p for p in patches}, on_links)


def _unlisted(
    loaded: Loaded, robot: Model, scene: Model, objects: Mapping[str, SensedObject]
) -> Iterator[tuple[str, str]]:
    """Yield the bodies with geoms of the scene that are neither the robot's nor an object's, and why nothing feels them."""
    model = scene.compiled
    known = {*robot.bodies[1:], *(target.body_of(name) for name, target in loaded.spec.objects.items())}
    felt = {i for sensed in objects.values() for i in sensed.bodies}
    own = {robot.body_path(i) for i in range(1, robot.compiled.nbody)}
    for i in range(model.nbody):
        name = scene.body_path(i)
        is_known = name in known or i in felt or (not model.body(i).name and name in own)
        if model.body_geomnum[i] and not is_known:
            yield name, "not listed under `objects`" if model.body(i).name else "no name, so `objects` cannot list it"


def _models(loaded: Loaded) -> tuple[Model | None, Model | None]:
    """Load the robot, and the scene if there is one; a file that does not exist is a mistake of the document."""
    wanted = loaded.spec.robot.model
    robot = scene = None
    if loaded.robot_file is None:
        hint = did_you_mean(wanted, robot_names(), "robots") if "/" not in wanted else "paths are relative to this document"
        loaded.problems.append(loaded.problem(("robot", "model"), f'there is no file or robot "{wanted}"', hint))
    else:
        robot = load_model(loaded.robot_file)
    if loaded.spec.scene is None:
        is_faulty = loaded.raw(("scene",)) is not None  # and its mistake is reported already
        return robot, None if is_faulty else robot
    scene_file = loaded.folder / loaded.spec.scene.model
    if is_file(scene_file):
        scene = load_model(scene_file)
    else:
        what = f'there is no file "{loaded.spec.scene.model}"'
        loaded.problems.append(loaded.problem(("scene", "model"), what, "paths are relative to this document"))
    return robot, scene


def _is_foreign(loaded: Loaded, layout: LoadedLayout, robot: Model) -> bool:
    """Return whether a layout is for another robot, which is then one mistake: none of its links is on this one."""
    keys = list(dict.fromkeys(key for placements in layout.spec.resolutions.values() for key in placements))
    if len(keys) < 2 or any(_matched(robot, key) for key in keys):
        return False
    what = f"this layout is for another robot: {robot.file.name} has none of its {len(keys)} links"
    hint = f"the layout has {listed(keys, 4)}; the robot has {listed([b for b in robot.bodies if b != 'world'], 4)}"
    loaded.problems.append(loaded.problem(("robot", "layout"), what, hint))
    return True


def _names(robot: Model) -> list[list[str]]:
    """Return the names that selectors know: of bodies, geoms and meshes, each with those of what it belongs to."""
    return [[body] for body in robot.bodies] + [[*geom.names, geom.body] for geom in robot.geoms if geom.names]


def _check_groups(layout: LoadedLayout, robot: Model, problems: list[Problem]) -> None:
    for group, selection in layout.spec.groups.items():
        path: Path = ("groups", group)
        select(selection, _names(robot), layout.spec.groups, _reporter(layout, path, problems), group)


def _reporter(owner: Loaded | LoadedLayout, path: Path, problems: list[Problem]) -> Report:
    """Return a function that notes what is wrong with a pattern, at the place where the pattern stands."""

    def report(where: tuple[str, int], what: str, hint: str) -> None:
        written = owner.raw(path)  # `links: a` and `links: [a]` stand for `links: {include: [a]}`
        place = where if isinstance(written, dict) else where[1:] if isinstance(written, list) else ()
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


def _check_regions(owner: Loaded | LoadedLayout, value: object, path: Path, robot: Model, problems: list[Problem]) -> None:
    """Note the plain names that regions exclude and that nothing has; what they include is looked up on each link."""
    names = sorted({name for geom in robot.geoms for name in geom.names})
    for place, selection in _geom_selections(owner, value, path):
        report = _reporter(owner, place, problems)
        for i, name in enumerate(selection.exclude):
            if is_plain(name) and name not in names:
                report(("exclude", i), f'no geom or mesh matches "{name}"', did_you_mean(name, names, "geoms and meshes"))


def _patches(loaded: Loaded, layout: LoadedLayout, robot: Model, placements: dict[str, Placement]) -> list[Patch]:
    """Return the links that carry taxels, in the robot's body order."""
    found: dict[str, Patch] = {}
    for pattern, placement in placements.items():
        path: Path = ("resolutions", str(loaded.resolution), pattern)
        _check_regions(layout, placement, path, robot, loaded.problems)
        hits = _matched(robot, pattern)
        if not hits:
            known = [name for names in _names(robot) for name in names]
            what = f'no body, geom or mesh matches "{pattern}"'
            loaded.problems.append(layout.problem(path, what, did_you_mean(pattern, known, "links"), on_key=True))
        for link, geoms in hits:
            if link.name in found:
                what = f'link "{link.name}" already has a layout, by "{found[link.name].path[-1]}"'
                loaded.problems.append(layout.problem(path, what, "give each link one", on_key=True))
            elif not geoms:
                loaded.problems.append(layout.problem(path, f'link "{link.name}" has no geoms', on_key=True))
            else:
                found[link.name] = Patch(link, geoms, placement, path)
    order = {body: i for i, body in enumerate(robot.bodies)}
    return sorted(found.values(), key=lambda patch: (order[patch.link.body], patch.geoms[0].id))


def _matched(robot: Model, pattern: str) -> list[tuple[Link, tuple[Geom, ...]]]:
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
    for (mesh, body), own in of_mesh.items():
        name = mesh if meshes.count(mesh) == 1 else f"{body}/{mesh}"
        links.append((Link(name, body), tuple(geom for geom in own if geom.is_colliding) or tuple(own)))
    return links


def _sensor_links(loaded: Loaded, layout: LoadedLayout, robot: Model, patches: list[Patch]) -> dict[str, tuple[str, ...]]:
    candidates = [[patch.link.name, patch.link.body, *(n for g in patch.geoms for n in g.names)] for patch in patches]
    on_robot = _names(robot)
    known = [name for names in (*on_robot, *candidates) for name in names]
    links: dict[str, tuple[str, ...]] = {}
    for name, sensor in loaded.spec.sensors.items():
        path: Path = ("sensors", name, "links")
        _check_regions(loaded, sensor, path[:-1], robot, loaded.problems)
        if not sensor.is_on_taxels:
            links[name] = _links_chosen(loaded, layout, robot, sensor, path)
            continue
        missing: list[Problem] = []
        chosen = select(sensor.links, candidates, layout.spec.groups, _reporter(loaded, path, missing), elsewhere=known)
        if missing:
            # A name that the robot has but the layout does not is another mistake than a name nobody has.
            unknown: list[Problem] = []
            select(sensor.links, on_robot, layout.spec.groups, _reporter(loaded, path, unknown), elsewhere=known)
            what = f'the layout puts no taxels on what this selects at resolution "{loaded.resolution}"'
            hint = f"links with taxels: {listed([patch.link.name for patch in patches])}"
            loaded.problems += unknown or [loaded.problem(path, what, hint)]
        elif not chosen:
            loaded.problems.append(loaded.problem(path, "`exclude` leaves no link"))
        links[name] = tuple(patches[i].link.name for i in chosen)
    return links


def _links_chosen(loaded: Loaded, layout: LoadedLayout, robot: Model, sensor: SensorSpec, path: Path) -> tuple[str, ...]:
    """Return the bodies of a sensor that has a place on each link."""
    bodies = [body for body in robot.bodies if body != "world"]
    own = [[body, *(n for g in robot.geoms if g.body == body for n in g.names)] for body in bodies]
    before = len(loaded.problems)
    chosen = select(sensor.links, own, layout.spec.groups, _reporter(loaded, path, loaded.problems))
    if not chosen and len(loaded.problems) == before:
        loaded.problems.append(loaded.problem(path, "`exclude` leaves no link"))
    return tuple(bodies[i] for i in chosen)


def _check_bodies(loaded: Loaded, robot: Model, scene: Model, patches: list[Patch]) -> None:
    missing = [patch.link.body for patch in patches if patch.link.body not in scene.bodies]
    if missing:
        what = f'the scene has no body "{missing[0]}", which the robot has'
        hint = did_you_mean(missing[0], scene.bodies, "bodies")
        loaded.problems.append(loaded.problem(("scene", "model"), what, f"a scene keeps the robot's names; {hint}"))


def _sampled(loaded: Loaded, layout: LoadedLayout, robot: Model, patches: list[Patch], progress: Progress) -> Layout:
    parts: list[Samples] = []
    for i, patch in enumerate(patches):
        progress(f"placing taxels on {patch.link.name} ({i + 1} of {len(patches)} links)")
        try:
            parts.append(sample(robot.surface(patch.geoms), patch.placement, layout.folder))
        except SampleError as error:
            what = f'link "{patch.link.name}": {error.what}'
            loaded.problems.append(layout.problem(patch.path, what, error.hint))
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


def _groups(layout: LoadedLayout, patches: list[Patch]) -> dict[str, tuple[str, ...]]:
    candidates = [[patch.link.name, patch.link.body] for patch in patches]
    groups: dict[str, tuple[str, ...]] = {}
    for group, selection in sorted(layout.spec.groups.items()):
        chosen = select(selection, candidates, layout.spec.groups, lambda where, what, hint: None)
        if chosen:
            groups[group] = tuple(patches[i].link.name for i in chosen)
    return groups
