"""A compiled geom as NumPy: its shape, size and place in its body's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tgdsl.surfaces.surface import Surface


@dataclass(frozen=True, eq=False)
class Geom:
    """A compiled geom, in its body's frame.

    Attributes:
        id: MuJoCo's index.
        name: Its name, or empty.
        mesh: Name of its mesh, or empty.
        body: Name of its body.
        shape: MuJoCo's name of its type.
        size: Its size as MuJoCo defines it [m].
        pos: Its frame's origin [m].
        rotation: Rotates geom vectors into the body frame.
        is_colliding: Whether it can collide at all.
    """

    id: int
    name: str
    mesh: str
    body: str
    shape: str
    size: Float[np.ndarray, " 3"]
    pos: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    is_colliding: bool

    @property
    def is_centred(self) -> bool:
        """Whether its frame is the body's."""
        return not self.pos.any() and np.array_equal(self.rotation, np.eye(3))

    @property
    def names(self) -> tuple[str, ...]:
        """The names that a selector can find it by."""
        return tuple(name for name in (self.name, self.mesh) if name)

    @property
    def shown(self) -> str:
        """How a message names it."""
        return f'geom "{self.name or self.mesh}"' if self.names else f"unnamed {self.shape} geom {self.id}"


@dataclass(frozen=True, eq=False)
class SurfaceGeom:
    """A geom whose distance, area or points are wanted: a primitive, or triangles.

    Attributes:
        geom: The compiled geom.
        surface: Its triangles in its own frame; None for a primitive.
        mesh: The mesh whose convex hull the surface is, in the same frame; None if it is none.
    """

    geom: Geom
    surface: Surface | None
    mesh: Surface | None = None

    @property
    def shape(self) -> str:
        """The primitive's type, or `mesh`."""
        return self.geom.shape if self.surface is None else "mesh"
