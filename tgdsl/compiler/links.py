"""Which bodies a document's links are: that of their name or taxels, and what is welded to it from below."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from tgdsl.compiler.sensed import Report, contact_parts
from tgdsl.formats.model import Model
from tgdsl.plan.inputs import ContactPart

LinkBodies = Mapping[str, tuple[int, ...]]
"""Indices of the bodies that each link's body is one rigid body with, its own first, by its name."""


def link_bodies(scene: Model, links: Collection[str], objects: Collection[str]) -> dict[str, tuple[int, ...]]:
    """Return the bodies that each link's body is one rigid body with: see `Inputs.parts_of_link`.

    Args:
        scene: The scene.
        links: Bodies that carry taxels of the layout, or are links of a sensor.
        objects: Bodies of objects.
    """
    apart = {*links, *objects}
    return {link: scene.rigid_bodies(link, apart) for link in sorted(links)}


def link_parts(scene: Model, bodies: tuple[int, ...], report: Report) -> tuple[ContactPart, ...]:
    """Return the geoms that contacts with a link act on; nothing where no body but its own has geoms that collide.

    Args:
        scene: The scene.
        bodies: Its bodies, by `link_bodies`.
        report: Called where a geom has no name that would tell it apart.
    """
    colliding = [geom for geom in scene.rigid_geoms(bodies) if geom.is_colliding]
    if not any(scene.compiled.geom_bodyid[geom.id] != bodies[0] for geom in colliding):
        return ()
    return contact_parts(scene, bodies, {geom.id for geom in colliding}, report)
