"""Surfaces of elastomer pads whose shape is known: plates, plates with corners and holes, cylinders, cones, caps."""

from collections.abc import Callable

import numpy as np

from tgdsl.surfaces.surface import Surface

MM = 1e-3
UP = np.array([0.0, 0.0, 1.0])


def soup(corners: np.ndarray) -> Surface:
    """Triangles (f, 3, 3) that share no vertex, as a mesh file's are."""
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return Surface(corners.reshape(-1, 3).astype(float), faces, np.zeros(len(faces), dtype=np.int64), (("pad",),))


def sheet(lift: Callable[[np.ndarray, np.ndarray], np.ndarray], rows: np.ndarray, columns: np.ndarray) -> Surface:
    """Two triangles for each cell of a grid (s, t), its corners where `lift` puts them (…, 3)."""
    s, t = np.meshgrid(rows, columns, indexing="ij")
    at = lift(s, t)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    return soup(np.concatenate([np.stack([a, b, c], axis=2).reshape(-1, 3, 3), np.stack([a, c, d], axis=2).reshape(-1, 3, 3)]))


def flat(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def plate(width: float = 25 * MM, length: float = 20 * MM, cells: tuple[int, int] = (1, 1)) -> Surface:
    """A rectangle from the origin along x and y that faces up."""
    return sheet(flat, np.linspace(0, width, cells[0] + 1), np.linspace(0, length, cells[1] + 1))


def slivers(width: float = 25 * MM, length: float = 20 * MM) -> Surface:
    """The same rectangle in triangles 1000 long and 3 high."""
    return plate(width, length, (1, round(1000 / 3 * length / width)))


def l_shape(arm: float = 10 * MM) -> Surface:
    """Three of four squares around the origin: the one with x, y > 0 is missing."""
    squares = [(-arm, -arm), (0.0, -arm), (-arm, 0.0)]
    return Surface.joined([moved(plate(arm, arm), np.eye(3), np.array([*at, 0.0])) for at in squares])


def ring(inner: float = 4 * MM, outer: float = 10 * MM, sides: int = 16) -> Surface:
    """A polygon around the origin with a polygonal hole."""
    return sheet(
        lambda r, a: flat(r * np.cos(a), r * np.sin(a)), np.array([inner, outer]), np.linspace(0, 2 * np.pi, sides + 1)
    )


def disc(radius: float = 10 * MM, sides: int = 720) -> Surface:
    angle = 2 * np.pi * np.arange(sides + 1) / sides
    rim = radius * flat(np.cos(angle), np.sin(angle))
    return soup(np.stack([np.zeros_like(rim[1:]), rim[:-1], rim[1:]], axis=1))


def wound(radius: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A plate (s, t) wound about the z axis, s along the arc from −y over x to y, seen from outside."""
    return lambda s, t: np.stack([radius * np.cos(s / radius), radius * np.sin(s / radius), t], axis=-1)


def cylinder(radius: float = 8 * MM, turn: float = np.pi, length: float = 20 * MM, cells: tuple[int, int] = (64, 1)) -> Surface:
    """A part of a cylinder about z, symmetric about the x axis."""
    arc = np.linspace(-turn / 2, turn / 2, cells[0] + 1) * radius
    return sheet(wound(radius), arc, np.linspace(0, length, cells[1] + 1))


def cap(radius: float = 10 * MM, half_angle: float = 0.25, cells: tuple[int, int] = (8, 48)) -> Surface:
    """A spherical cap about +z; the triangles at the pole that vanish stay in."""
    polar, around = np.linspace(0, half_angle, cells[0] + 1), np.linspace(0, 2 * np.pi, cells[1] + 1)
    return sheet(
        lambda p, a: radius * np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1), polar, around
    )


def moved(surface: Surface, rotation: np.ndarray, offset: np.ndarray) -> Surface:
    return Surface(surface.vertices @ rotation.T + offset, surface.faces, surface.face_geom, surface.geoms)


def upward(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Taxels (taxel, 2) on a plate: their positions and normals."""
    return flat(places[:, 0], places[:, 1]), np.tile(UP, (len(places), 1))
