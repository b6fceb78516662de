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
class ObjectHeat:
    """What the flow of heat needs to know of an object.

    Shapes: `variant` variants of the object; a single one if it is the same everywhere.

    Attributes:
        temperature: When an episode begins [°C]; None: that of the surroundings. If it is per environment, what the simulator
            begins with.
        is_per_env: Whether the temperature is part of the state: its field `object_temperature`.
        materials: What it may be made of; if there are several, the state's field `object_material` says which.
        cells: Numbers of cells of its grid along x, y, z; None: it has one temperature.
        volume: Volume of its geoms [m³].
        area: Area of their surface [m²].
        box_center: Centre of their bounding box in the frame of its body [m].
        box_size: Full lengths of that box along the axes of this frame [m].
        curvature: Mean curvature of the surface [1/m]: see `bulk.Bulk`.
    """

    temperature: float | None
    is_per_env: bool
    materials: tuple[Material, ...]
    cells: tuple[int, int, int] | None
    volume: Float[np.ndarray, " variant"]
    area: Float[np.ndarray, " variant"]
    box_center: Float[np.ndarray, "variant 3"]
    box_size: Float[np.ndarray, "variant 3"]
    curvature: Float[np.ndarray, " variant"]


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
        heat: What the flow of heat needs to know of it; None if the document does not say what it is made of.
    """

    name: str
    body: str
    variants: tuple[tuple[SurfaceGeom, ...], ...]
    is_sized: bool
    bodies: tuple[int, ...]
    touched: frozenset[int]
    distance: DistanceOptions
    heat: ObjectHeat | None = None
