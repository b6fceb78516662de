"""Which bodies a document's links are: that of their name or taxels, and what is welded to it from below; and its joints."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from tgdsl.compiler.sensed import Report, contact_parts
from tgdsl.errors import did_you_mean
from tgdsl.formats.joints import RobotJoints
from tgdsl.formats.model import Model
from tgdsl.plan.inputs import ContactPart
from tgdsl.schema.loaded import Loaded
from tgdsl.schema.select import matching
from tgdsl.schema.yaml import Path
from tgdsl.sensors.base import OnJointsSpec

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
