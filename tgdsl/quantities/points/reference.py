"""Points in float64, by way of the world frame and one at a time: the oracle of `points`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tgdsl.quantities.geoms.reference import distance_to, geoms_of
from tgdsl.quantities.points.part import PointsPart
from tgdsl.quantities.reference import ReferenceScene

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class ReferencePoints:
    """Points sampled on one object, in the frame of one link that they may meet: a row of `points.LinkPoints` as arrays.

    Attributes:
        taxels: The link's taxels.
        pos: Where they are [m].
        distance: Signed distance to the link's own surface [m]; +∞ where the gate is closed.
        gradient: Its unit gradient.
        area: Surface that each stands for [m²].
    """

    taxels: Int[Array, " own"]
    pos: Float[Array, "point 3"]
    distance: Float[Array, " point"]
    gradient: Float[Array, "point 3"]
    area: float


def reference(part: PointsPart[np.ndarray], use: int, scene: ReferenceScene) -> tuple[ReferencePoints, ...]:
    """Return the points of each object of a use as each link sees them that it may meet."""
    own, layout = part.uses[use], scene.layout
    numbers = {link.name: (i, link.body) for i, link in enumerate(layout.links)}
    found = []
    for met in own.objects:
        cloud = part.clouds[met.cloud]
        target = scene.objects[cloud.object]
        body, variant = scene.object_body(target), scene.variant(target)
        world = cloud.points[:, variant].T @ body.rotation.T + body.pos
        area = float(cloud.area[variant])
        for row in met.links:
            assert part.surfaces is not None
            i, name = numbers[part.links[row]]
            link, geoms = scene.body(name), geoms_of(part.surfaces, row)
            pos = (world - link.pos) @ link.rotation
            phi, gradient = (np.array(one) for one in zip(*(distance_to(geoms, z) for z in pos), strict=True))
            if own.is_gated and not scene.is_touching(name, target.name):
                phi = np.full(len(pos), np.inf)
            found.append(ReferencePoints(np.flatnonzero(layout.link_id == i), pos, phi, gradient, area))
    return tuple(found)
