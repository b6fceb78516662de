"""Taxels that cannot feel what their sensors are to feel: which these are, and the warning that names them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tgdsl.compiler.lowered import LoweredSensor
from tgdsl.compiler.passes import Pruned
from tgdsl.compiler.resolve import Resolved
from tgdsl.errors import UnfeltWarning
from tgdsl.layout.unfelt import BURIED, COVERED, Unfelt, unfelt_ids
from tgdsl.placement.reach import unfelt

SHOWN = 8
"""Links and reasons that the warning names; the account of the module names all."""


def unfelt_taxels(resolved: Resolved, sensors: Sequence[LoweredSensor], pruned: Pruned) -> tuple[Unfelt, ...]:
    """Return the taxels with a sensor that cannot feel what it is to feel there.

    A sensor that reads contacts cannot on a body that is never in contact with its objects. Where no object collides with a
    body, nothing keeps the objects out of it, so that no taxel is too deep in it. Readings of bodies are not of taxels.

    Args:
        resolved: The document on its robot.
        sensors: Its sensors, lowered.
        pruned: The pairs that can meet.
    """
    layout, within = resolved.layout, resolved.reach
    names = np.array([link.body for link in layout.links], dtype=object)[layout.link_id]
    is_deaf, is_kept_out = np.zeros(layout.num_taxels, dtype=bool), np.zeros(layout.num_taxels, dtype=bool)
    is_deep = within.is_buried | (within.cover >= 0)
    for sensor in sensors:
        objects = {name for request in sensor.requests for name in request.objects}
        if not objects or sensor.rows.name != "taxel":
            continue
        if any(request.is_gated or request.wants_contacts for request in sensor.requests):
            met = {pair.link for pair in pruned.contact_pairs if pair.object in objects}
            is_deaf[sensor.taxels] |= ~np.isin(names[sensor.taxels], sorted(met))
        touched = set().union(*(resolved.objects[name].touched for name in objects))
        deep = sensor.taxels[is_deep[sensor.taxels]]
        for body in dict.fromkeys(names[deep]):
            own = [geom.id for geom in resolved.scene.rigid_geoms(resolved.link_bodies[body]) if geom.is_colliding]
            is_kept_out[deep[names[deep] == body]] |= resolved.scene.geoms_can_collide(own, touched)
    within = replace(
        within,
        is_collided=~is_deaf | (layout.radius == 0),
        is_buried=within.is_buried & is_kept_out,
        cover=np.where(is_kept_out, within.cover, -1),
    )
    return unfelt(resolved.colliders, layout, within)


def warn_of_unfelt(file: str, found: Sequence[Unfelt], num_taxels: int) -> None:
    """Warn once of all taxels that cannot feel, by link and reason.

    Args:
        file: Name of the document.
        found: The taxels.
        num_taxels: Number of all taxels.
    """
    if found:
        what = f"{len(unfelt_ids(found))} of {num_taxels} taxels cannot feel: {'; '.join(map(str, found[:SHOWN]))}"
        what += f"; and {len(found) - SHOWN} more, see `explain`" if len(found) > SHOWN else ""
        hints = {BURIED: "`surface: collision`", COVERED: "`exposed: true`"}
        wanted = [hint for reason, hint in hints.items() if any(own.reason == reason for own in found)]
        what += f"; in the layout {' and '.join(wanted)} would place them elsewhere" if wanted else ""
        warnings.warn(f"{file}: {what}", UnfeltWarning, stacklevel=3)
