"""Small surfaces and placements for the tests of the sampler."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydantic import TypeAdapter

from tgdsl.errors import SampleError
from tgdsl.placement.sample.sample import sample
from tgdsl.schema.placement import Placement
from tgdsl.surfaces.surface import Surface

HERE = Path()
DOWN = [0, 0, -1]


def placement(method: str, **keys: object) -> Placement:
    keys = {"method": method, "radius": 0.002} | keys
    return TypeAdapter(Placement).validate_python({key: value for key, value in keys.items() if value is not None})


def plate(normal: np.ndarray, size: float = 0.02) -> trimesh.Trimesh:
    """An open square whose edges run along y and across."""
    across = np.cross([0.0, 1.0, 0.0], normal)
    corners = [a * across + b * np.array([0, 1.0, 0]) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return trimesh.Trimesh(size / 2 * np.array(corners), [[0, 2, 1], [0, 3, 2]], process=False)


def error_of(surface: Surface, where: Placement, folder: Path = HERE) -> SampleError:
    with pytest.raises(SampleError) as caught:
        sample(surface, where, folder)
    return caught.value


def shaken(surface: Surface, noise: float, seed: int) -> Surface:
    """The same surface as another file may have it: vertices off by up to `noise` and renumbered, faces reordered and begun elsewhere."""
    draw = np.random.default_rng(seed)
    _, place = np.unique(surface.vertices, axis=0, return_inverse=True)  # vertices in one place move together
    vertices = surface.vertices + draw.uniform(-noise, noise, surface.vertices.shape)[place.ravel()]
    number, order = draw.permutation(len(vertices)), draw.permutation(len(surface.faces))
    first = draw.integers(3, size=len(order))
    faces = np.take_along_axis(surface.faces[order], (first[:, None] + np.arange(3)) % 3, axis=1)
    return Surface(vertices[number], np.argsort(number)[faces], surface.face_geom[order], surface.geoms)
