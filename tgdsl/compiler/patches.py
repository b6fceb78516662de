"""Resolve a document's names on robot and scene: links with their taxels, objects, rigid bodies, joints.

Mistakes are noted at the place of the name.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np

from tgdsl.console.progress import Progress
from tgdsl.errors import Problem, SampleError, did_you_mean
from tgdsl.fields.models import Selection, SpecModel
from tgdsl.fields.regions import OnGeoms
from tgdsl.formats.joints import RobotJoints
from tgdsl.formats.model import Model
from tgdsl.geometry.shapes import SHAPES
from tgdsl.layout.layout import Layout, Link
from tgdsl.placement.reach import Colliders
from tgdsl.placement.sample.sample import Drawn, Samples, sample
from tgdsl.plan.inputs import ContactPart
from tgdsl.schema.load import Loaded, LoadedLayout
from tgdsl.schema.objects import NUM_SIZES, ObjectSpec, TemperaturePerEnv
from tgdsl.schema.placement import Placement, Points
from tgdsl.schema.select import Report, is_plain, matching, select
from tgdsl.schema.yaml import Path
from tgdsl.sensors.base import OnJointsSpec
from tgdsl.surfaces.bulk import PRIMITIVES, bulk
from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.sensed import DistanceOptions, ObjectHeat, SensedObject
from tgdsl.surfaces.surface import Surface

DrawnOn = dict[Hashable, Drawn]  # what placements on one surface share, by the geoms that are sampled


@dataclass(frozen=True)
class Patch:
    """A link with taxels: its name and body, the sampled geoms, and their placement."""

    link: Link
    geoms: tuple[Geom, ...]
    placement: Placement
    path: Path

    @property
    def as_collided(self) -> bool:
        """Whether its taxels are on the convex hulls that the simulator collides."""
        return not isinstance(self.placement, Points) and self.placement.surface == "collision"


def names_of(robot: Model) -> list[list[str]]:
    """Return the names that selectors match: each body's; each named geom's, with its mesh's and its body's."""
    return [[body] for body in robot.bodies] + [[*geom.names, geom.body] for geom in robot.geoms if geom.names]


def reporter(owner: Loaded | LoadedLayout, path: Path, problems: list[Problem]) -> Report:
    """Return a function that notes mistakes of a pattern at the pattern's place.

    A pattern that names a group with a mistake is not reported again.
    """
    layout = owner.layout if isinstance(owner, Loaded) else owner

    def report(where: tuple[str, int], message: str, hint: str) -> None:
        written = owner.raw(path)  # `links: a` and `links: [a]` stand for `links: {include: [a]}`
        place = where if isinstance(written, dict) else where[1:] if isinstance(written, list) else ()
        pattern = owner.raw((*path, *place))
        if layout is None or pattern in layout.spec.groups or layout.raw(("groups", str(pattern))) is None:
            problems.append(owner.problem((*path, *place), message, hint))

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
    drawn: DrawnOn,
    progress: Progress,
) -> Layout:
    """Return the taxels of links.

    `objects` are bodies of the robot's file that are no links; what placements on one surface share is added to `drawn`.
    """
    parts: list[Samples] = []
    for i, patch in enumerate(patches):
        progress(f"placing taxels on {patch.link.name} ({i + 1} of {len(patches)} links)")
        try:
            covered = colliders.cover_of(patch.link.body, patch.geoms, objects)
            surface, name = _surface(colliders.robot, patch), patch.link.name
            shared = drawn.setdefault((patch.as_collided, *(geom.id for geom in patch.geoms)), {})
            parts.append(sample(surface, patch.placement, layout.folder, name, covered, shared))
        except SampleError as error:
            layout.note(patch.path, f'link "{patch.link.name}": {error.what}', error.hint)
    loaded.raise_problems()
    if not parts:  # all sensors are on links, whatever their taxels
        return Layout.of_links((), {})
    columns = ("pos", "normal", "tangent", "radius", "area", "cell")
    return Layout(
        links=tuple(patch.link for patch in patches),
        groups=_groups(layout, patches),
        link_id=np.repeat(np.arange(len(patches)), [len(part.pos) for part in parts]),
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in columns},
    )


def _surface(robot: Model, patch: Patch) -> Surface:
    """Return the triangles that a link's taxels are sampled on."""
    if patch.as_collided and not all(geom.is_colliding for geom in patch.geoms):
        apart = next(geom for geom in patch.geoms if not geom.is_colliding)
        raise SampleError(f"the simulator does not collide {apart.shown}", "expected `surface: mesh`")
    return robot.surface(patch.geoms, patch.as_collided)


def _groups(layout: LoadedLayout, patches: list[Patch]) -> dict[str, tuple[str, ...]]:
    candidates = [[patch.link.name, patch.link.body] for patch in patches]
    spec = layout.spec.groups
    members = {group: select(selection, candidates, spec, lambda *_: None) for group, selection in sorted(spec.items())}
    return {group: tuple(patches[i].link.name for i in ids) for group, ids in members.items() if ids}


ObjectReport = Callable[[str, str], None]  # called with a mistake of an object, and a hint
LEAST_VOLUME = 1e-9
"""Volume over area^3/2 below which the volume is rounding, as of an open surface with inconsistent winding."""


def sensed_object(
    name: str,
    body: str,
    target: ObjectSpec,
    scene: Model,
    variants: Sequence[tuple[Model, tuple[str, ...]]],
    others: Collection[str],
    report: ObjectReport,
) -> SensedObject:
    """Return an object with its sensed geoms: the colliding, the visible, the named, or the document's.

    Bodies welded below its body are part of it. The solver's contacts with it are on its colliding geoms; for a surface that
    is only visible, on the colliding geoms of the whole object.
    """
    bodies = scene.rigid_bodies(body, others)
    if target.compounds:
        touched = scene.touchable(body)
        models = [(model, tuple(geom for geom in model.geoms if geom.name in names)) for model, names in variants]
        parts, felt = [geoms for _, geoms in models], [_sensed(geoms, body, target, model, report) for model, geoms in models]
    else:
        rigid_geoms = scene.rigid_geoms(bodies)
        selected = _selected(rigid_geoms, body, target, report)
        colliding = (tuple(geom for geom in geoms if geom.is_colliding) for geoms in (selected, rigid_geoms))
        touched = next(filter(None, colliding), ())
        parts, felt = [rigid_geoms], [_sensed(selected, body, target, scene, report)]
    if target.size == "per_env":
        for geoms in parts:
            if len(geoms) != 1 or geoms[0].shape not in NUM_SIZES:
                shapes = ", ".join(geom.shape for geom in geoms)
                hint = f"primitives: {', '.join(NUM_SIZES)}"
                report(f'with `size: per_env` the body "{body}" has one geom, a primitive; found {shapes}', hint)
                break
    return SensedObject(
        name=name,
        body=body,
        variants=tuple(felt),
        is_sized=target.size == "per_env",
        bodies=bodies,
        touched=frozenset(geom.id for geom in touched),
        distance=DistanceOptions(target.query, target.tolerance, target.max_bytes),
        heat=_heat(felt, body, target, report),
    )


def _heat(felt: Sequence[Sequence[SurfaceGeom]], body: str, target: ObjectSpec, report: ObjectReport) -> ObjectHeat | None:
    """Return an object's thermal data; None if the document gives it no material."""
    if target.material is None or not all(felt):
        return None
    for geom in itertools.chain(*felt):
        if geom.shape not in ("mesh", *PRIMITIVES):
            hint = f"give `material` to bodies of {', '.join(PRIMITIVES)}, mesh"
            report(f'{geom.geom.shown} of body "{body}" has no volume that could hold heat', hint)
            return None
    each = [bulk(geoms) for geoms in felt]
    if not all(one.volume > LEAST_VOLUME * one.area**1.5 for one in each):
        report(f'the geoms of body "{body}" enclose no volume that could hold heat', "")
        return None
    start = target.temperature
    return ObjectHeat(
        temperature=start.per_env if isinstance(start, TemperaturePerEnv) else start,
        is_per_env=isinstance(start, TemperaturePerEnv),
        materials=target.material,
        cells=target.cells,
        volume=np.array([one.volume for one in each]),
        area=np.array([one.area for one in each]),
        box_center=np.array([one.center for one in each]),
        box_size=np.array([one.high - one.low for one in each]),
        curvature=np.array([one.curvature for one in each]),
    )


def contact_parts(scene: Model, bodies: Sequence[int], touched: Set[int], report: ObjectReport) -> tuple[ContactPart, ...]:
    """Return the geoms of contacts with an object or a link, as parts that MuJoCo's contact sensors can name.

    `bodies` are one rigid body, its own body first; `report` is called for a geom that needs a name and has none.
    """
    model, first = scene.compiled, bodies[0]
    body_geoms = {body: {g.id for g in scene.rigid_geoms((body,)) if g.is_colliding} for body in bodies}
    below = [first]
    for i in range(first + 1, model.nbody if first else 0):
        below += [i] if model.body_parentid[i] in below else []
    if below == list(bodies) and set().union(*body_geoms.values()) <= touched:
        return (ContactPart("subtree" if len(below) > 1 else "body", model.body(first).name),)
    parts = []
    for body, geoms in body_geoms.items():
        if geoms and geoms <= touched and model.body(body).name:
            parts.append(ContactPart("body", model.body(body).name))
            continue
        for geom in (geom for geom in scene.rigid_geoms((body,)) if geom.id in geoms & touched):
            if not geom.name:
                problem = f"{geom.shown} has no name, so its contacts cannot be distinguished from others"
                report(problem, "name it, or its body, in the scene")
            parts.append(ContactPart("geom", geom.name))
    return tuple(parts) or (ContactPart("body", model.body(first).name),)


def _sensed(
    geoms: Sequence[Geom], body: str, target: ObjectSpec, scene: Model, report: ObjectReport
) -> tuple[SurfaceGeom, ...]:
    surfaces = []
    for geom in geoms:
        if geom.shape == "mesh":
            mesh = scene.mesh(geom)
            is_hull = target.surface == "collision"
            surfaces.append(SurfaceGeom(geom, scene.hull(geom), mesh) if is_hull else SurfaceGeom(geom, mesh))
        elif geom.shape in SHAPES:
            surfaces.append(SurfaceGeom(geom, None))
        else:
            problem = f'{geom.shown} of body "{body}" is of type {geom.shape}, which sensors do not support'
            report(problem, f"supported types: {', '.join(SHAPES)}, mesh")
    return tuple(surfaces)


def _selected(geoms: tuple[Geom, ...], body: str, target: ObjectSpec, report: ObjectReport) -> tuple[Geom, ...]:
    if not geoms:
        report(f'body "{body}" has no geoms to feel', "")
    if target.surface == "collision":
        return tuple(geom for geom in geoms if geom.is_colliding) or geoms
    if target.surface == "visual":
        return tuple(geom for geom in geoms if not geom.is_colliding) or geoms
    named = tuple(geom for geom in geoms if any(matching(target.surface, [name]) for name in geom.names))
    if geoms and not named:
        names = sorted({name for geom in geoms for name in geom.names})
        report(f'no geom or mesh of body "{body}" matches "{target.surface}"', f"it has {', '.join(names)}")
    return named


LinkBodies = Mapping[str, tuple[int, ...]]
"""By link, the indices of the bodies of its rigid body, the link's geoms body first."""


def link_bodies(scene: Model, links: Collection[str], objects: Collection[str]) -> dict[str, tuple[int, ...]]:
    """Return the bodies of each link's rigid body: see `Inputs.parts_of_link`.

    `links` carry taxels of the layout or are links of a sensor, `objects` are bodies of objects.
    """
    apart = {*links, *objects}
    return {link: scene.rigid_bodies(link, apart) for link in sorted(links)}


def link_parts(scene: Model, bodies: tuple[int, ...], report: ObjectReport) -> tuple[ContactPart, ...]:
    """Return the geoms of contacts with a link; nothing if only the link's own body has colliding geoms.

    `report` is called for a geom that needs a name and has none.
    """
    colliding = [geom for geom in scene.rigid_geoms(bodies) if geom.is_colliding]
    if not any(scene.compiled.geom_bodyid[geom.id] != bodies[0] for geom in colliding):
        return ()
    return contact_parts(scene, bodies, {geom.id for geom in colliding}, report)


def joints_matching(loaded: Loaded, path: Path, pattern: str, own: RobotJoints) -> list[str]:
    """Return the joints that a pattern matches, in the robot's order; a pattern without a match is noted."""
    hits = matching(pattern, [name for name in own.joints if name])
    if not hits:
        joint_names = [name for name in (*own.joints, *own.others) if name]
        problem, hint = f'no joint of the robot matches "{pattern}"', did_you_mean(pattern, joint_names, "joints")
        if matching(pattern, own.others):
            problem, hint = f'"{pattern}" is a ball or free joint', "it has no single position; expected hinges and slides"
        loaded.note(path, problem, hint)
    return hits


def sensor_joints(loaded: Loaded, own: RobotJoints) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each sensor on joints with its joints; sensors without joints, and nameless joints, are noted."""
    for name, spec in loaded.spec.sensors.items():
        if not isinstance(spec, OnJointsSpec):
            continue
        num_problems = len(loaded.problems)
        path: Path = ("sensors", name, "joints")
        if spec.joints is None:
            selected = own.joints[: own.num_actuated]
        else:
            hits = [joints_matching(loaded, (*path, k), pattern, own) for k, pattern in enumerate(spec.joints)]
            selected = tuple(dict.fromkeys(joint for joints in hits for joint in joints))
        if len(loaded.problems) == num_problems and not selected:
            problem, hint = "the robot has no actuated joints", 'name them: joints: ["*"]' if own.joints else ""
            loaded.note(("sensors", name), problem, hint)
        if "" in selected:
            problem = "an actuated joint of the robot has no name"
            loaded.note(("sensors", name), problem, "name it in the robot's file, or list `joints`")
        yield name, selected


def check_named_bodies(loaded: Loaded, scene: Model) -> None:
    """Note bodies that a sensor's spec names and the scene does not have."""
    for name, spec in loaded.spec.sensors.items():
        for field, body in spec.named_bodies.items():
            if body not in scene.bodies:
                problem = f'the scene has no body "{body}"'
                loaded.note(("sensors", name, field), problem, did_you_mean(body, scene.bodies, "bodies"))
