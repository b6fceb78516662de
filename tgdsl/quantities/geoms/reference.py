"""Geoms in float64, one point at a time: the oracle of `distance`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tgdsl.geometry.reference import TIE, signed_distance
from tgdsl.quantities.geoms.tables import GeomTable

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class ReferenceGeom:
    """A geom in its body's frame: MuJoCo's type name and size [m], position [m], rotation matrix."""

    shape: str
    size: Float[Array, " 3"]
    pos: Float[Array, " 3"]
    rotation: Float[Array, "3 3"]


def geoms_of(table: GeomTable[np.ndarray], case: int, size: Float[Array, " 3"] | None = None) -> list[ReferenceGeom]:
    """Return the geoms of a case of a table; with a size, that of its only geom [m]."""
    found = []
    for g, shape in enumerate(table.shapes):
        if table.is_absent is None or not table.is_absent[case, g]:
            own = np.asarray(table.size[case, g]) if size is None else size
            found.append(ReferenceGeom(shape, own, table.pos[case, g], table.rotation[case, g].reshape(3, 3)))
    return found


def distance_to(geoms: Sequence[ReferenceGeom], point: Float[Array, " 3"]) -> tuple[float, Float[Array, " 3"]]:
    """Return the signed distance [m] of a point in a body's frame to its geoms, and its gradient; the first of equals wins."""
    least, outward = np.inf, np.zeros(3)
    for geom in geoms:
        phi, gradient = signed_distance(geom.shape, geom.size, geom.rotation.T @ (point - geom.pos))
        if phi < least - TIE:
            outward = geom.rotation @ gradient
        least = min(phi, least)
    return least, outward
