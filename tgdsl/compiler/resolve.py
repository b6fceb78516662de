"""From a Spec and a robot to a Layout: the links with taxels, the taxels' places, and the objects that they can sense."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.compiler.patches import (
    DrawnOn,
    LinkBodies,
    Patch,
    check_named_bodies,
    check_regions,
    link_bodies,
    matched,
    names_of,
    patches_of,
    reporter,
    sampled,
    sensed_object,
    sensor_joints,
)
from tgdsl.compiler.scene import Files, NewBody, OwnObjects, scene_object, variant_scenes, with_bodies
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError, Problem, RobotError, SampleError, SpecError, did_you_mean, listed
from tgdsl.fields.models import Selection
from tgdsl.fields.regions import RegionPart
from tgdsl.files.find import colliders_file, is_file, robot_names
from tgdsl.formats.built import differences
from tgdsl.formats.joints import RobotJoints, robot_joints
from tgdsl.formats.model import Model
from tgdsl.formats.robot import load_model
from tgdsl.layout.layout import Layout, Link
from tgdsl.placement.reach import Colliders, Reach, reach
from tgdsl.plan.scene import Collider
from tgdsl.scene.colliders import bits_that_meet, with_colliders
from tgdsl.schema.load import GIVEN, Loaded, LoadedLayout, load_colliders
from tgdsl.schema.select import select
from tgdsl.schema.yaml import Path
from tgdsl.sensors.base import SensorSpec
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.region import clip
from tgdsl.surfaces.sensed import SensedObject
from tgdsl.surfaces.surface import Surface


def own_objects(loaded: Loaded, scene: Model, links: Set[str]) -> tuple[Model, OwnObjects]:
    """Return the scene with the document's new bodies, and the objects whose geoms or sizes the document sets.

    `links` are bodies that carry taxels.
    """
    bodies, objects, meshes = _new_bodies(loaded, scene), [], Files()
    scene = with_bodies(scene, bodies)
    body_of = {name: target.body_of(name) for name, target in loaded.spec.objects.items()}
    for name, target in loaded.spec.objects.items():
        body = body_of[name]
        if not (target.compounds or target.size == "per_env") or body not in scene.bodies:
            continue

        def report(place: Path, message: str, hint: str = "", name: str = name) -> None:
            loaded.note(("objects", name, *place), message, hint)

        same_body = [other for other, part in body_of.items() if part == body and other != name]
        rigid = [scene.compiled.body(i).name for i in scene.rigid_bodies(body, _other_bodies(loaded, body))]
        if carrying := [part for part in rigid if part in links]:
            report(("body",), f'body "{carrying[0]}" carries taxels, so its geoms cannot be others')
        elif same_body:
            report(("body",), f'the geoms of body "{body}" are this object\'s, but object "{same_body[0]}" has it too')
        elif not any(geom.body == body for geom in scene.geoms):
            report(("body",), f'body "{body}" has no geom', "its first geom says what `geom` does not, such as friction")
        else:
            new_body = scene_object(name, target, loaded.folder, meshes, report)
            objects.append(replace(new_body, others=tuple(sorted(_other_bodies(loaded, body)))))
    return scene, OwnObjects(bodies, tuple(objects), meshes)


def _other_bodies(loaded: Loaded, body: str) -> set[str]:
    return {target.body_of(name) for name, target in loaded.spec.objects.items()} - {body}


def _new_bodies(loaded: Loaded, scene: Model) -> tuple[NewBody, ...]:
    compiler, new = scene.spec.compiler, []
    is_forced = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    low = int(compiler.inertiagrouprange[0])
    group = low if is_forced and low > 0 else 0
    for name, target in loaded.spec.objects.items():
        if target.body is None and name in scene.bodies:
            problem = f'the scene has a body "{name}" already'
            loaded.note(("objects", name), problem, f"`body: {name}` gives that one these geoms")
        elif target.body is None:
            pos, quat = target.pos or (0.0, 0.0, 0.0), target.quat or (1.0, 0.0, 0.0, 0.0)
            written, default = (target.contype, target.conaffinity), bits_that_meet(scene.spec.geoms)
            bits = [bit if mask is None else mask for mask, bit in zip(written, default, strict=True)]
            new.append(NewBody(name, pos, quat, target.joint != "fixed", group, *bits))
    return tuple(new)


def sensed_objects(loaded: Loaded, scene: Model, own: OwnObjects) -> dict[str, SensedObject]:
    """Return the objects that some sensor senses."""
    felt = {name for sensor in loaded.spec.sensors.values() for name in sensor.objects}
    with_geoms = {target.name: target for target in own.objects if target.types}
    is_faulty = bool(loaded.problems)
    objects: dict[str, SensedObject] = {}
    for name, target in loaded.spec.objects.items():
        path: Path = ("objects", name, "body" if target.body is not None else "geom")
        body = target.body_of(name)
        if body not in scene.bodies:
            loaded.note(path, f'no body is named "{body}"', did_you_mean(body, scene.bodies, "bodies"))
        elif not (is_faulty and (target.compounds or target.size == "per_env")):  # else its mistakes are known already
            variants = variant_scenes(scene, with_geoms[name], own.meshes.contents) if target.compounds else []
            sensed = sensed_object(name, body, target, scene, variants, _other_bodies(loaded, body), partial(loaded.note, path))
            objects |= {name: sensed} if name in felt else {}
    return objects


@dataclass(frozen=True, eq=False)
class Models:
    """The models of a document's files, for all resolutions."""

    robot: Model | None  # the robot; None if a mistake of the document says why there is none
    scene: Model | None  # the model that holds robot and objects, or None
    drawn: DrawnOn = field(default_factory=dict)  # what the placements of several resolutions share

    @cached_property
    def colliders(self) -> Colliders:
        """The robot's collision geometry."""
        assert self.robot is not None
        return Colliders(self.robot)


@dataclass(frozen=True, eq=False)
class Resolved:
    """A spec's meaning on one robot."""

    layout: Layout  # taxels of the links that some sensor has; of all links if the document has no sensors
    links: dict[str, tuple[str, ...]]  # names of each sensor's links
    objects: dict[str, SensedObject]  # the sensed geoms of each object
    own: OwnObjects  # the objects whose geoms or sizes the document sets
    scene: Model  # the model that holds robot and objects
    robot: Model  # the robot's own model
    unused: tuple[tuple[str, str], ...]  # links and objects that are not needed, and why
    patches: Mapping[str, Patch]  # the links that carry taxels
    colliders: Colliders  # the robot's collision geometry
    reach: Reach  # which taxels the collision geometry leaves exposed
    on_links: frozenset[str]  # the sensors with one place per link, whatever its taxels
    link_bodies: LinkBodies  # the bodies of each link that carries taxels or is a sensor's
    joints: RobotJoints  # the robot's joints and actuators
    on_joints: Mapping[str, tuple[str, ...]]  # names of the joints of each sensor that is on joints
    primitives: tuple[Collider, ...] = ()  # collision shapes that replace the links' geoms
    layouts: dict[str, Layout] = field(default_factory=dict)  # taxels of all links at the other requested resolutions

    def surface_of(self, link: str, region: Sequence[RegionPart]) -> Surface:
        """Return the triangles of a link, or of a region of it, in its body's frame."""
        patch = self.patches.get(link)
        geoms = self.robot.touchable(link) if patch is None else patch.geoms
        if not geoms:
            raise LowerError(f'link "{link}" has no geoms', field="links")
        try:
            surface = self.robot.surface(geoms, patch is not None and patch.as_collided)
        except RobotError as error:
            raise LowerError(str(error), field="links") from error
        try:
            return clip(surface, region) if region else surface
        except SampleError as error:
            raise LowerError(error.what, hint=error.hint) from error

    def anchor_of(self, joint: str) -> Float[np.ndarray, " 3"]:
        """Return where a joint's anchor is in the frame of the body that it moves [m]."""
        return self.scene.compiled.jnt_pos[self.scene.compiled.joint(joint).id].copy()

    def surface_of_object(self, name: str) -> Surface:
        """Return the triangles of an object's geoms in its body's frame [m], meshes as they are, not their hulls."""
        parts = []
        for geom in self.objects[name].variants[0]:
            mesh = geom.surface if geom.mesh is None else geom.mesh
            try:
                placed = self.scene.surface((geom.geom,)) if mesh is None else mesh.placed(geom.geom.pos, geom.geom.rotation)
            except RobotError as error:
                raise LowerError(str(error), field="feels") from error
            parts.append(placed)
        return Surface.joined(parts)

    def geoms_of(self, link: str) -> tuple[SurfaceGeom, ...]:
        """Return the geoms that a link's taxels sit on: meshes as they are, or their convex hulls if the layout says so."""
        triangles = self.robot.hull if self.patches[link].as_collided else self.robot.mesh
        return tuple(SurfaceGeom(geom, triangles(geom) if geom.shape == "mesh" else None) for geom in self.patches[link].geoms)

    def layout_on(self, sensor: str) -> tuple[np.ndarray, Layout]:
        """Return the taxels of a sensor, and its layout; for a sensor on links, no taxels and a layout of the links."""
        names = self.links[sensor]
        if sensor in self.on_links:
            joints = self.on_joints.get(sensor, ())
            model = self.scene.compiled
            moved = [model.body(model.jnt_bodyid[model.joint(joint).id]).name for joint in joints]
            links = (*(Link(name, name) for name in names), *map(Link, joints, moved))
            return np.zeros(0, dtype=np.int64), Layout.of_links(links, self.layout.groups)
        taxels = self.layout.taxels_of(names)
        return taxels, self.layout.take(taxels)


def resolve(loaded: Loaded, progress: Progress = silent, models: Models | None = None) -> Resolved:
    """Place a document's sensors on its robot; models of the same document that were read before may be given."""
    progress("reading robot and scene")
    models = models_of(loaded) if models is None else models
    robot, scene = models.robot, models.scene
    patches: list[Patch] = []
    links: dict[str, tuple[str, ...]] = {}
    objects: dict[str, SensedObject] = {}
    new_objects, primitives = OwnObjects(), ()
    joints, on_joints = RobotJoints((), 0, frozenset(), (), ()), {}
    on_links = frozenset(
        name for name, sensor_spec in loaded.spec.sensors.items() if loaded.is_without_layout or not sensor_spec.is_on_taxels
    )
    if robot is not None and loaded.is_without_layout:
        links = _sensor_links(loaded, {}, robot, [], on_links)
    elif robot is not None and loaded.layout is not None and not _is_foreign(loaded, loaded.layout, robot):
        for group, selection in loaded.layout.spec.groups.items():  # patterns that match nothing
            report = reporter(loaded.layout, ("groups", group), loaded.problems)
            select(selection, names_of(robot), loaded.layout.spec.groups, report, group)
        placements = loaded.layout.spec.resolutions.get(loaded.resolution or "")
        if placements is not None:
            patches = patches_of(loaded, loaded.layout, robot, placements)
            links = _sensor_links(loaded, loaded.layout.spec.groups, robot, patches, on_links)
    if robot is not None and scene is not None:
        _check_bodies(loaded, scene, patches)
        scene, new_objects = own_objects(loaded, scene, {patch.link.body for patch in patches})
        primitives = _primitives(loaded, scene)
        scene = scene.changed(lambda spec: with_colliders(spec, primitives)) if primitives else scene
        objects = sensed_objects(loaded, scene, new_objects)
        check_named_bodies(loaded, scene)
        joints = robot_joints(robot, scene)
        on_joints = dict(sensor_joints(loaded, joints))
    loaded.raise_problems()
    assert robot is not None and scene is not None
    needed = {link for name, sensor_links in links.items() for link in sensor_links if name not in on_links}
    needed = needed if links else {patch.link.name for patch in patches}
    colliders, felt = models.colliders, _object_bodies(loaded, robot)
    layout = Layout.of_links((), {})
    if loaded.layout is not None:
        placed = [patch for patch in patches if patch.link.name in needed]
        layout = sampled(loaded, loaded.layout, colliders, placed, felt, models.drawn, progress)
    loaded.raise_problems()
    unused = [(f"link {p.link.name}", "no sensor is on its taxels") for p in patches if p.link.name not in needed]
    unused += [(f"object {name}", "no sensor feels it") for name in loaded.spec.objects if name not in objects]
    listed_bodies = {target.body_of(name) for name, target in loaded.spec.objects.items()}
    carrying = {patch.link.body for patch in patches}.union(*(links[name] for name in on_links))
    parts_of = link_bodies(scene, carrying, listed_bodies)
    rigid = {i for bodies in (*(sensed.bodies for sensed in objects.values()), *parts_of.values()) for i in bodies}
    unused += [(f"body {body}", why) for body, why in _unlisted(robot, scene, listed_bodies, rigid)]
    by_link, within = {p.link.name: p for p in patches}, reach(colliders, layout, felt)
    own_links = (on_links, parts_of, joints, on_joints, primitives)
    return Resolved(layout, links, objects, new_objects, scene, robot, tuple(unused), by_link, colliders, within, *own_links)


def taxels_of_all_links(loaded: Loaded, models: Models) -> Layout:
    """Return where a document's resolution puts taxels, on links without sensors too."""
    robot, layout = models.robot, loaded.layout
    assert robot is not None and layout is not None
    patches = patches_of(loaded, layout, robot, layout.spec.resolutions[loaded.resolution or ""])
    loaded.raise_problems()
    return sampled(loaded, layout, models.colliders, patches, _object_bodies(loaded, robot), models.drawn, silent)


def _object_bodies(loaded: Loaded, robot: Model) -> tuple[int, ...]:
    named = {target.body_of(name) for name, target in loaded.spec.objects.items()} & set(robot.bodies)
    return tuple(sorted({i for body in named for i in robot.rigid_bodies(body, named - {body})}))


def _unlisted(robot: Model, scene: Model, listed: Collection[str], rigid: Collection[int]) -> Iterator[tuple[str, str]]:
    """Yield the bodies with geoms of the scene that are neither the robot's nor an object's, and why nothing feels them."""
    model, listed_bodies = scene.compiled, {*robot.bodies[1:], *listed}
    robot_bodies = {robot.body_path(i) for i in range(1, robot.compiled.nbody)}
    for i in range(model.nbody):
        name = scene.body_path(i)
        is_known = name in listed_bodies or i in rigid or (not model.body(i).name and name in robot_bodies)
        if model.body_geomnum[i] and not is_known:
            yield name, "not listed under `objects`" if model.body(i).name else "no name, so `objects` cannot list it"


def models_of(loaded: Loaded, given: Model | None = None) -> Models:
    """Load the robot, and the scene if there is one; a file that does not exist is a mistake of the document.

    If a scene is `given`, the models that the document names must be those in it.
    """
    model_name, relative = loaded.spec.robot.model, "paths are relative to this document"
    robot = scene = None
    if given is not None and model_name == GIVEN:
        robot = given
    elif loaded.robot_file is None:
        hint = relative if "/" in model_name else did_you_mean(model_name, robot_names(), "robots")
        loaded.note(("robot", "model"), f'there is no file or robot "{model_name}"', hint)
    else:
        robot = load_model(loaded.robot_file)
    if loaded.spec.scene is None:
        scene = None if loaded.raw(("scene",)) is not None else robot  # a faulty scene is reported already
    elif is_file(loaded.folder / loaded.spec.scene.model):
        scene = load_model(loaded.folder / loaded.spec.scene.model)
    else:
        loaded.note(("scene", "model"), f'there is no file "{loaded.spec.scene.model}"', relative)
    if given is None:
        return Models(robot, scene)
    for key, model in {"robot": robot, "scene": scene if scene is not robot else None}.items():
        if model is not None and model is not given and (differing := list(differences(model, given))):
            problem = f"this model is not the one in the given scene: {listed(differing, 4)}"
            loaded.note((key, "model"), problem, "without `model`, names are the scene's")
    return Models(robot, given)


def _primitives(loaded: Loaded, scene: Model) -> tuple[Collider, ...]:
    """Return the primitive colliders that the document requests, from the file next to the robot's."""
    robot, note = loaded.spec.robot, partial(loaded.note, ("robot", "collision"))
    if robot.collision != "primitive":
        return ()
    if robot.model == GIVEN:
        problem = "primitive colliders are read from the robot's folder, and this document names no robot file"
        note(problem, "expected `collision: mesh`, or `robot: {model: …}`")
    if loaded.robot_file is None:
        return ()
    file = colliders_file(loaded.robot_file)
    if file is None:
        expected = loaded.robot_file.with_name("colliders.yaml")
        problem = f'"{robot.model}" has no primitive colliders: there is no file {expected}'
        note(problem, "expected `collision: mesh`, or such a file")
        return ()
    try:
        result = load_colliders(file)
    except SpecError as error:
        loaded.problems += error.problems
        return ()
    if unknown := [collider.body for collider in result if collider.body not in scene.bodies]:
        problem = f'{file.name} has colliders of "{unknown[0]}", which is no body of the scene'
        note(problem, did_you_mean(unknown[0], scene.bodies, "bodies"))
        return ()
    return result


def _is_foreign(loaded: Loaded, layout: LoadedLayout, robot: Model) -> bool:
    """Return whether a layout is for another robot, which is one mistake: this robot has none of its links."""
    keys = list(dict.fromkeys(key for placements in layout.spec.resolutions.values() for key in placements))
    if len(keys) < 2 or any(matched(robot, key) for key in keys):
        return False
    problem = f"this layout is for another robot: {robot.file.name} has none of its {len(keys)} links"
    hint = f"the layout has {listed(keys, 4)}; the robot has {listed([b for b in robot.bodies if b != 'world'], 4)}"
    loaded.note(("robot", "layout"), problem, hint)
    return True


def _sensor_links(
    loaded: Loaded, groups: Mapping[str, Selection], robot: Model, patches: list[Patch], on_links: Set[str]
) -> dict[str, tuple[str, ...]]:
    """Return the names of each sensor's links: of those with taxels, or of bodies if it is `on_links`."""
    with_taxels = [[patch.link.name, patch.link.body, *(n for g in patch.geoms for n in g.names)] for patch in patches]
    on_robot, bodies = names_of(robot), [body for body in robot.bodies if body != "world"]
    of_bodies = [[body, *(n for g in robot.geoms if g.body == body for n in g.names)] for body in bodies]
    link_names = [name for names in (*on_robot, *with_taxels) for name in names]
    links: dict[str, tuple[str, ...]] = {}
    for name, sensor in loaded.spec.sensors.items():
        path: Path = ("sensors", name, "links")
        if not isinstance(sensor, SensorSpec):
            links[name] = ()
            continue
        check_regions(loaded, sensor, path[:-1], robot, loaded.problems)
        missing: list[Problem] = []
        report = reporter(loaded, path, missing)
        if name in on_links:
            selected = select(sensor.links, of_bodies, groups, report)
            links[name] = tuple(bodies[i] for i in selected)
            loaded.problems += missing
        else:
            selected = select(sensor.links, with_taxels, groups, report, elsewhere=link_names)
            links[name] = tuple(patches[i].link.name for i in selected)
            if missing:
                # A name that only the layout lacks is another mistake than an unknown name.
                unknown: list[Problem] = []
                select(sensor.links, on_robot, groups, reporter(loaded, path, unknown), elsewhere=link_names)
                problem = f'the layout puts no taxels on what this selects at resolution "{loaded.resolution}"'
                hint = f"links with taxels: {listed([patch.link.name for patch in patches])}"
                loaded.problems += unknown or [loaded.problem(path, problem, hint)]
        if not selected and not missing:
            loaded.note(path, "`exclude` leaves no link")
    return links


def _check_bodies(loaded: Loaded, scene: Model, patches: list[Patch]) -> None:
    if missing := [patch.link.body for patch in patches if patch.link.body not in scene.bodies]:
        problem = f'the scene has no body "{missing[0]}", which the robot has'
        hint = did_you_mean(missing[0], scene.bodies, "bodies")
        loaded.note(("scene", "model"), problem, f"a scene keeps the robot's names; {hint}")
