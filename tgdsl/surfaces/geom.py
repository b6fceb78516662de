"""A compiled geom as NumPy: its shape, size and place in its body's frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from tgdsl.surfaces.surface import Surface

_LARGE = 1024.0  # scale at which trimesh makes round shapes: a power of two keeps the bits of their vertices


@dataclass(frozen=True, eq=False)
class Geom:
    """A compiled geom, in its body's frame."""

    id: int  # MuJoCo's index
    name: str  # its name, or empty
    mesh: str  # name of its mesh, or empty
    body: str  # name of its body
    shape: str  # MuJoCo's name of its type
    size: Float[np.ndarray, " 3"]  # its size as MuJoCo defines it [m]
    pos: Float[np.ndarray, " 3"]  # its frame's origin [m]
    rotation: Float[np.ndarray, "3 3"]  # rotates geom vectors into the body frame
    is_colliding: bool  # whether it can collide at all

    @property
    def is_centred(self) -> bool:
        """Whether its frame is the body's."""
        return not self.pos.any() and np.array_equal(self.rotation, np.eye(3))

    @property
    def names(self) -> tuple[str, ...]:
        """The names that a selector matches."""
        return tuple(name for name in (self.name, self.mesh) if name)

    @property
    def shown(self) -> str:
        """Its name in messages."""
        return f'geom "{self.name or self.mesh}"' if self.names else f"unnamed {self.shape} geom {self.id}"


@dataclass(frozen=True, eq=False)
class SurfaceGeom:
    """A geom whose distance, area or points are wanted: a primitive, or triangles."""

    geom: Geom  # the compiled geom
    surface: Surface | None  # its triangles in its own frame; None for a primitive
    mesh: Surface | None = None  # the mesh whose convex hull the surface is, in the same frame; None if it is none

    @property
    def shape(self) -> str:
        """The primitive's type, or `mesh`."""
        return self.geom.shape if self.surface is None else "mesh"


def round_shape(make: Callable[..., Any], size: Sequence[float], **detail: Any) -> Any:
    """Return trimesh's mesh of a capsule or a cylinder of some radius and half length [m], without holes.

    trimesh drops triangles below 1e-8 m², such as those near the ends of a capsule of 9 mm.
    """
    return make(radius=_LARGE * size[0], height=2 * _LARGE * size[1], **detail).apply_scale(1 / _LARGE)
