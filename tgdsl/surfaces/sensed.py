"""An object that can be sensed: its geoms, those of each of its variants, and how distances to them are found.

It is NumPy, and knows neither MuJoCo nor the document.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tgdsl.surfaces.geom import SurfaceGeom


@dataclass(frozen=True)
class DistanceOptions:
    """How the distance to triangles is found.

    Attributes:
        query: `sdf` from a grid that is computed beforehand, `raycast` by the triangles themselves.
        tolerance: Largest error of a grid [m].
        max_bytes: Largest size of a grid [bytes].
    """

    query: Literal["sdf", "raycast"] = "sdf"
    tolerance: float = 5e-5
    max_bytes: int = 64 * 2**20


@dataclass(frozen=True, eq=False)
class SensedObject:
    """An object that can be sensed.

    Attributes:
        name: Its name in the document.
        body: Its body.
        variants: The geoms of each of its variants; of a single one if it is the same everywhere.
        is_sized: Whether the size of its geom is part of the state.
        bodies: Its body and those that are welded to it, by their indices in the scene.
        touched: Geoms of the scene that the solver's contacts with it act on.
        distance: How the distance to its triangles is found.
    """

    name: str
    body: str
    variants: tuple[tuple[SurfaceGeom, ...], ...]
    is_sized: bool
    bodies: tuple[int, ...]
    touched: frozenset[int]
    distance: DistanceOptions
