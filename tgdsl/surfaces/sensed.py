"""An object that can be sensed: the geoms of each of its variants, and the options of distances to them.

Plain NumPy, without MuJoCo or the document.
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
    """Options of distances to triangles."""

    # `sdf`: from a precomputed grid; `raycast`: from the triangles
    query: Literal["sdf", "raycast"] = "sdf"
    tolerance: float = 5e-5  # largest error of a grid [m]
    max_bytes: int = 64 * 2**20  # largest size of a grid [bytes]


@dataclass(frozen=True, eq=False)
class ObjectHeat:
    """Thermal data of an object.

    Shapes: `variant` variants of the object; a single one if all environments have the same.
    """

    # temperature at the start of an episode [°C]; None: ambient. If it is per environment, the simulator's initial value.
    temperature: float | None
    is_per_env: bool  # whether the temperature is part of the state: its field `object_temperature`
    # its possible materials; with several, the state's field `object_material` selects one
    materials: tuple[Material, ...]
    cells: tuple[int, int, int] | None  # numbers of cells of its grid along x, y, z; None: one temperature
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
    # the geoms of each of its variants; a single one if all environments have the same
    variants: tuple[tuple[SurfaceGeom, ...], ...]
    is_sized: bool  # whether the size of its geom is part of the state
    bodies: tuple[int, ...]  # its body and the bodies welded to it, by their indices in the scene
    touched: frozenset[int]  # geoms of the scene that the solver's contacts with it act on
    distance: DistanceOptions  # options of the distance to its triangles
    heat: ObjectHeat | None = None  # its thermal data; None if the document gives it no material
