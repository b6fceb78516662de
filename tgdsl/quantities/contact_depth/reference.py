"""Contact depth in float64, in the world frame and one point at a time: the oracle of `query`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tgdsl.geometry.reference import TIE
from tgdsl.quantities.contact_depth.part import ContactDepthPart
from tgdsl.quantities.geoms.reference import ReferenceGeom, distance_to, geoms_of
from tgdsl.quantities.reference import ReferenceBody, ReferenceScene

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class ReferencePenetration:
    """What a sensor's probes feel, in their links' frames: the fields of `Penetration`, one row per taxel.

    `distance` [m] and its gradient `outward` are those of `distances`, one column per object; `rotation` and `offset` [m]
    those of `frames`.
    """

    depth: Float[Array, " taxel"]
    normal: Float[Array, "taxel 3"]
    velocity: Float[Array, "taxel 3"]
    angular: Float[Array, "taxel 3"]
    distance: Float[Array, "taxel object"]
    outward: Float[Array, "taxel object 3"]
    rotation: Float[Array, "taxel object 3 3"]
    offset: Float[Array, "taxel object 3"]


def reference(part: ContactDepthPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferencePenetration:
    """Return what a sensor's probes meet, link by link."""
    own, layout = part.uses[use], scene.layout
    radius = own.reach[:, scene.rows].max(axis=0, initial=-np.inf)
    found = []
    for i, link in enumerate(layout.links):
        objects: list[tuple[ReferenceBody, list[ReferenceGeom]] | None] = []
        for o in (part.queries[own.query].objects[o] for o in own.objects):
            target, table = scene.objects[o], part.geoms[o]
            assert table is not None
            is_felt = target.body != link.body and (scene.is_touching(link.body, target.name) or not own.is_gated)
            geoms = geoms_of(table, scene.variant(target), scene.size(target))
            objects.append((scene.object_body(target), geoms) if is_felt else None)
        at = layout.link_id == i
        found.append(penetration(scene.body(link.body), layout.pos[at], radius[at], objects))
    names = ReferencePenetration.__dataclass_fields__
    return ReferencePenetration(**{name: np.concatenate([getattr(one, name) for one in found]) for name in names})


def penetration(
    link: ReferenceBody,
    pos: Float[Array, "taxel 3"],
    radius: Float[Array, " taxel"],
    objects: Sequence[tuple[ReferenceBody, Sequence[ReferenceGeom]] | None],
) -> ReferencePenetration:
    """Query the probes of one link against the objects that it may feel; None stands for one that it may not.

    The paper's equations word for word: q = p_L + R_L x, d = max(0, max_g (R − φ_g(q))), m = ∇φ at the deepest geom,
    v = R_Lᵀ (v_C(q) − v_L(q)). A probe whose radius is −∞ is inactive.
    """
    normal, velocity, angular = np.zeros((3, len(pos), 3))
    distance, outward = np.full((len(pos), len(objects)), np.inf), np.zeros((len(pos), len(objects), 3))
    rotations, offsets = np.zeros((len(pos), len(objects), 3, 3)), np.zeros((len(pos), len(objects), 3))
    felt = ReferencePenetration(np.zeros(len(pos)), normal, velocity, angular, distance, outward, rotations, offsets)
    into_link = link.rotation.T
    for j, x in enumerate(pos):
        q = link.pos + link.rotation @ x
        for k, target in enumerate(objects):
            if target is None or radius[j] == -np.inf:
                continue
            body, geoms = target
            felt.rotation[j, k] = body.rotation.T @ link.rotation
            felt.offset[j, k] = body.rotation.T @ (link.pos - body.pos)
            felt.distance[j, k], gradient = distance_to(geoms, body.rotation.T @ (q - body.pos))
            felt.outward[j, k] = into_link @ body.rotation @ gradient
            depth, before = radius[j] - felt.distance[j, k], felt.depth[j]
            felt.depth[j] = max(depth, before)
            if depth > (before + TIE if before > 0 else 0.0):
                felt.normal[j] = felt.outward[j, k]
                felt.velocity[j] = into_link @ (body.velocity_at(q) - link.velocity_at(q))
                felt.angular[j] = into_link @ (body.angvel - link.angvel)
    return felt
