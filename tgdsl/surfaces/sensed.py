"""An object that can be sensed: its geoms, those of each of its variants, and how distances to them are found.

It is NumPy, and knows neither MuJoCo nor the document.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from tgdsl.fields.materials import Material
from tgdsl.surfaces.geom import SurfaceGeom


@dataclass(frozen=True)
class DistanceOptions:
    """How the distance to triangles is found."""

    # `sdf` from a grid that is computed beforehand, `raycast` by the triangles themselves
    query: Literal["sdf", "raycast"] = "sdf"
    tolerance: float = 5e-5  # largest error of a grid [m]
    max_bytes: int = 64 * 2**20  # largest size of a grid [bytes]


@dataclass(frozen=True, eq=False)
class ObjectHeat:
    """What the flow of heat needs to know of an object.

    Shapes: `variant` variants of the object; a single one if it is the same everywhere.
    """

    # when an episode begins [°C]; None: that of the surroundings. If it is per environment, what the simulator begins with.
    temperature: float | None
    is_per_env: bool  # whether the temperature is part of the state: its field `object_temperature`
    # what it may be made of; if there are several, the state's field `object_material` says which
    materials: tuple[Material, ...]
    cells: tuple[int, int, int] | None  # numbers of cells of its grid along x, y, z; None: it has one temperature
    volume: Float[np.ndarray, " variant"]  # volume of its geoms [m³]
    area: Float[np.ndarray, " variant"]  # area of their surface [m²]
    box_center: Float[np.ndarray, "variant 3"]  # centre of their bounding box in the frame of its body [m]
    box_size: Float[np.ndarray, "variant 3"]  # full lengths of that box along the axes of this frame [m]
    curvature: Float[np.ndarray, " variant"]  # mean curvature of the surface [1/m]: see `bulk.Bulk`


@dataclass(frozen=True, eq=False)
class SensedObject:
    """An object that can be sensed."""

    name: str  # its name in the document
    body: str  # its body
    # the geoms of each of its variants; of a single one if it is the same everywhere
    variants: tuple[tuple[SurfaceGeom, ...], ...]
    is_sized: bool  # whether the size of its geom is part of the state
    bodies: tuple[int, ...]  # its body and those that are welded to it, by their indices in the scene
    touched: frozenset[int]  # geoms of the scene that the solver's contacts with it act on
    distance: DistanceOptions  # how the distance to its triangles is found
    # what the flow of heat needs to know of it; None if the document does not say what it is made of
    heat: ObjectHeat | None = None
