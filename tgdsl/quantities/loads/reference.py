"""Loads in float64, pair by pair and slot by slot: the oracle of `gathering`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tgdsl.quantities.contacts.reference import completed
from tgdsl.quantities.loads.part import LoadsPart
from tgdsl.quantities.reference import ReferenceScene

FIELDS = ("contact_pos", "contact_force", "contact_normal")


@dataclass(frozen=True, eq=False)
class ReferenceLoads:
    """What each body and object do to one another: see `request.PairLoads`.

    Attributes:
        force: Sum of the contacts' normal forces [N].
        sliding: Normal force times sliding speed [W].
        center: Centre of the contacts weighted by force [m].
        along: Mean of their normals weighted by force, into what rings.
    """

    force: Float[np.ndarray, "body object"]
    sliding: Float[np.ndarray, "body object"]
    center: Float[np.ndarray, "body object 3"]
    along: Float[np.ndarray, "body object 3"]


def reference(part: LoadsPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferenceLoads:
    """Return the loads of a sensor's bodies and objects."""
    own, fields = part.uses[use], scene.fields
    force, sliding, center, along = (np.zeros((*own.pairs.shape, *rest)) for rest in ((), (), (3,), (3,)))
    for (b, o), pair in np.ndenumerate(own.pairs):
        if pair == len(scene.contact_pairs):
            continue
        link, target = scene.body(scene.bodies[own.bodies[b]]), scene.body(scene.bodies[own.objects[o]])
        ringing, sign = (target, -1.0) if own.center == "object" else (link, 1.0)
        slots = [list(row) for row in zip(*(fields[name][pair] for name in FIELDS), strict=True) if np.any(row[1:])]
        contacts = [[pos, on_link, np.zeros(3), normal] for pos, on_link, normal in slots]
        for pos, on_link, _, normal in completed(contacts, fields["contact_netforce"][pair]):
            pressed = max(0.0, float(on_link @ normal))
            apart = target.velocity_at(pos) - link.velocity_at(pos)
            force[b, o] += pressed
            sliding[b, o] += pressed * float(np.linalg.norm(apart - (apart @ normal) * normal))
            center[b, o] += pressed * (ringing.rotation.T @ (pos - ringing.pos))
            along[b, o] += pressed * sign * (ringing.rotation.T @ normal)
        center[b, o] /= force[b, o] or 1.0
        along[b, o] /= force[b, o] or 1.0
    return ReferenceLoads(force, sliding, center, along)
