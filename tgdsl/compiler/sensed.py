"""What is felt of an object, which bodies and joints a document's links are, and the geoms that contacts act on."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence, Set

import numpy as np

from tgdsl.errors import did_you_mean
from tgdsl.formats.joints import RobotJoints
from tgdsl.formats.model import Model
from tgdsl.geometry.shapes import SHAPES
from tgdsl.plan.inputs import ContactPart
from tgdsl.schema.load import Loaded
from tgdsl.schema.objects import NUM_SIZES, ObjectSpec, TemperaturePerEnv
from tgdsl.schema.select import matching
from tgdsl.schema.yaml import Path
from tgdsl.sensors.base import OnJointsSpec
from tgdsl.surfaces.bulk import PRIMITIVES, bulk
from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.sensed import DistanceOptions, ObjectHeat, SensedObject

Report = Callable[[str, str], None]  # called with what is wrong with an object, and a hint
LEAST_VOLUME = 1e-9
"""Volume over area^3/2 up to which it is rounding, as where faces of an open surface do not agree which side is out."""


def sensed_object(
    name: str,
    body: str,
    target: ObjectSpec,
    scene: Model,
    variants: Sequence[tuple[Model, tuple[str, ...]]],
    others: Collection[str],
    report: Report,
) -> SensedObject:
    """Return an object's geoms that count: the colliding, the visible, the named, or its own ones.

    Bodies that are welded to its body from below are part of it, and the solver's contacts with it are those on its geoms that
    collide. A surface that is only seen has none of its own: contacts with it are those of the whole object.
    """
    bodies = scene.rigid_bodies(body, others)
    if target.compounds:
        touched = scene.touchable(body)
        parts = [tuple(geom for geom in model.geoms if geom.name in names) for model, names in variants]
        felt = [
            _felt(variant_geoms, body, target, model, report) for variant_geoms, (model, _) in zip(parts, variants, strict=True)
        ]
    else:
        rigid_geoms = scene.rigid_geoms(bodies)
        selected = _chosen(rigid_geoms, body, target, report)
        touched = tuple(geom for geom in selected if geom.is_colliding) or tuple(
            geom for geom in rigid_geoms if geom.is_colliding
        )
        felt = [_felt(selected, body, target, scene, report)]
        parts = [rigid_geoms]
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


def _heat(felt: Sequence[Sequence[SurfaceGeom]], body: str, target: ObjectSpec, report: Report) -> ObjectHeat | None:
    """Return what the flow of heat needs to know of an object; None if the document gives it no material."""
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


def contact_parts(scene: Model, bodies: Sequence[int], touched: Set[int], report: Report) -> tuple[ContactPart, ...]:
    """Return the geoms that contacts with an object or a link act on as MuJoCo's contact sensors can name them.

    `bodies` are one rigid body, the first its own; `report` is called where a geom has no name that would tell it apart.
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
                problem = f"{geom.shown} has no name of its own, so the solver's contacts on it cannot be told from others"
                report(problem, "name it, or its body, in the scene")
            parts.append(ContactPart("geom", geom.name))
    return tuple(parts) or (ContactPart("body", model.body(first).name),)


def _felt(geoms: Sequence[Geom], body: str, target: ObjectSpec, scene: Model, report: Report) -> tuple[SurfaceGeom, ...]:
    felt = []
    for geom in geoms:
        if geom.shape == "mesh":
            mesh = scene.mesh(geom)
            felt.append(SurfaceGeom(geom, scene.hull(geom), mesh) if target.surface == "collision" else SurfaceGeom(geom, mesh))
        elif geom.shape in SHAPES:
            felt.append(SurfaceGeom(geom, None))
        else:
            problem = f'{geom.shown} of body "{body}" is of type {geom.shape}, which cannot be felt'
            report(problem, f"types that can: {', '.join(SHAPES)}, mesh")
    return tuple(felt)


def _chosen(own: tuple[Geom, ...], body: str, target: ObjectSpec, report: Report) -> tuple[Geom, ...]:
    if not own:
        report(f'body "{body}" has no geoms to feel', "")
    if target.surface == "collision":
        return tuple(geom for geom in own if geom.is_colliding) or own
    if target.surface == "visual":
        return tuple(geom for geom in own if not geom.is_colliding) or own
    named = tuple(geom for geom in own if any(matching(target.surface, [name]) for name in geom.names))
    if own and not named:
        names = sorted({name for geom in own for name in geom.names})
        report(f'no geom or mesh of body "{body}" matches "{target.surface}"', f"it has {', '.join(names)}")
    return named


LinkBodies = Mapping[str, tuple[int, ...]]
"""Indices of the bodies that each link's body is one rigid body with, its own first, by its name."""


def link_bodies(scene: Model, links: Collection[str], objects: Collection[str]) -> dict[str, tuple[int, ...]]:
    """Return the bodies that each link's body is one rigid body with: see `Inputs.parts_of_link`.

    `links` carry taxels of the layout or are links of a sensor, `objects` are bodies of objects.
    """
    apart = {*links, *objects}
    return {link: scene.rigid_bodies(link, apart) for link in sorted(links)}


def link_parts(scene: Model, bodies: tuple[int, ...], report: Report) -> tuple[ContactPart, ...]:
    """Return the geoms that contacts with a link act on, nothing where no body but its own has geoms that collide.

    `report` is called where a geom has no name that would tell it apart.
    """
    colliding = [geom for geom in scene.rigid_geoms(bodies) if geom.is_colliding]
    if not any(scene.compiled.geom_bodyid[geom.id] != bodies[0] for geom in colliding):
        return ()
    return contact_parts(scene, bodies, {geom.id for geom in colliding}, report)


def joints_matching(loaded: Loaded, path: Path, pattern: str, own: RobotJoints) -> list[str]:
    """Return the joints that a pattern matches, in their order; that there are none is noted."""
    hits = matching(pattern, [name for name in own.joints if name])
    if not hits:
        joint_names = [name for name in (*own.joints, *own.others) if name]
        problem, hint = f'no joint of the robot matches "{pattern}"', did_you_mean(pattern, joint_names, "joints")
        if matching(pattern, own.others):
            problem, hint = f'"{pattern}" is a ball or free joint', "it has no single position; expected hinges and slides"
        loaded.note(path, problem, hint)
    return hits


def sensor_joints(loaded: Loaded, own: RobotJoints) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each sensor that is on joints, and these; that there are none, or nameless ones, is noted."""
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
