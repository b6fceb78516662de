"""Closed lofts of super-elliptic sections: the surfaces of our own hand models, each from a table of dimensions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

ROUNDING = 6
"""Decimals of the coordinates in metres: rounding to micrometres makes the files the same on every machine."""
_FINE = 400  # points of a section's half before it is spread evenly


@dataclass(frozen=True)
class Station:
    """A cross section of a link; lengths in millimetres, in the loft's frame.

    Attributes:
        at: Position along the link's long axis.
        center: Middle of the section on the lateral axis.
        half_width: Half of its extent on the lateral axis.
        front: Coordinate of its summit on the pad's side.
        back: Coordinate of its summit on the other side.
        middle: Coordinate on the facing axis where it is widest; None: the shape's.
        front_exponent: Exponent of its front half: 2 is an ellipse, more is boxier; None: the shape's.
        back_exponent: The same of its back half.
    """

    at: float
    center: float
    half_width: float
    front: float
    back: float
    middle: float | None = None
    front_exponent: float | None = None
    back_exponent: float | None = None


@dataclass(frozen=True)
class Relief:
    """A front that is no super-ellipse: a height above each point of a table; curves between are monotone.

    Attributes:
        lateral: Columns of the table: positions on the lateral axis [mm]. Beyond the outermost the height stays the same.
        rows: Position along the long axis [mm], and the front's coordinate on the facing axis at each column [mm].
    """

    lateral: tuple[float, ...]
    rows: tuple[tuple[float, tuple[float, ...]], ...]

    def height(self, at: float, lateral: np.ndarray) -> np.ndarray:
        """Return the front's coordinate on the facing axis [mm]."""
        ats = np.array([row for row, _ in self.rows])
        table = PchipInterpolator(ats, np.array([heights for _, heights in self.rows]))(np.clip(at, ats[0], ats[-1]))
        return PchipInterpolator(self.lateral, table)(np.clip(lateral, self.lateral[0], self.lateral[-1]))


@dataclass(frozen=True)
class Shape:
    """A link's outer surface.

    Attributes:
        along: Index of the long axis: 0 for x, 1 for y, 2 for z.
        facing: Index of the axis that the pad faces.
        num_around: Vertices of a section, a multiple of four.
        stations: The sections that are given, in ascending order; those between follow a monotone curve through them.
        num_rings: Sections in the mesh; None: just the stations.
        middle: Coordinate on the facing axis where sections are widest [mm], of stations that give none.
        front_exponent: Exponent of the sections' front halves: 2 is an ellipse, more is boxier; likewise.
        back_exponent: The same of their back halves; likewise.
        turn: Angle about the long axis from the loft's frame to the body's [deg].
        relief: What lowers the front below the sections, if anything does.
        least_lateral: Where a plane cuts the sections off on the lateral axis, if one does [mm].
        is_even: Whether a section's vertices are spread evenly over each half of it, rather than over its angle.
    """

    along: int
    facing: int
    num_around: int
    stations: tuple[Station, ...]
    num_rings: int | None = None
    middle: float = 0.0
    front_exponent: float = 2.0
    back_exponent: float = 2.0
    turn: float = 0.0
    relief: Relief | None = None
    least_lateral: float | None = None
    is_even: bool = False

    @property
    def lateral(self) -> int:
        """Index of the axis across the link."""
        return 3 - self.along - self.facing


def _row(shape: Shape, station: Station) -> tuple[float, ...]:
    """Return the eight numbers of a station, the shape's in place of those that it leaves open."""
    own = (station.middle, station.front_exponent, station.back_exponent)
    common = (shape.middle, shape.front_exponent, shape.back_exponent)
    rest = (mine if mine is not None else its for mine, its in zip(own, common, strict=True))
    return (station.at, station.center, station.half_width, station.front, station.back, *rest)


def rings(shape: Shape) -> np.ndarray:
    """Return at, center, half_width, front, back, middle and the exponents of every ring, shape (num_rings, 8) [mm].

    A number of rings is spread evenly over the length of the outline, so that the rounded ends get enough of them.
    """
    rows = np.array([_row(shape, station) for station in shape.stations])
    if shape.num_rings is None:
        return rows
    steps = np.linalg.norm(np.diff(rows[:, [0, 2, 3]], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    return PchipInterpolator(distance, rows)(np.linspace(0.0, distance[-1], shape.num_rings))


def _curve(shape: Shape, ring: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the points of a ring at some angles: lateral and facing coordinate, shape (n, 2) [mm]."""
    at, center, half_width, front, back, middle, front_exponent, back_exponent = ring
    is_front = np.sin(angle) >= 0
    power = 2 / np.where(is_front, front_exponent, back_exponent)
    lateral = center + half_width * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power
    depth = np.where(is_front, front - middle, middle - back)
    facing = middle + depth * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power
    if shape.relief is not None:
        facing = np.where(is_front, np.minimum(facing, shape.relief.height(at, lateral)), facing)
    if shape.least_lateral is not None:
        lateral = np.maximum(lateral, shape.least_lateral)
    return np.stack([lateral, facing], axis=1)


def _even(shape: Shape, ring: np.ndarray) -> np.ndarray:
    """Return the vertices of a ring, spread evenly over its front half and over its back half, shape (n, 2) [mm]."""
    halves = []
    for start in (0.0, np.pi):
        curve = _curve(shape, ring, np.linspace(start, start + np.pi, _FINE + 1))
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        wanted = np.linspace(0.0, length[-1], shape.num_around // 2 + 1)[:-1]
        halves.append(np.stack([np.interp(wanted, length, curve[:, i]) for i in range(2)], axis=1))
    return np.concatenate(halves)


def section(shape: Shape, ring: np.ndarray) -> np.ndarray:
    """Return the vertices of a ring in the loft's frame, counter-clockwise about the long axis or against it [mm]."""
    angle = 2 * np.pi * np.arange(shape.num_around) / shape.num_around
    vertices = np.empty((shape.num_around, 3))
    vertices[:, shape.along] = ring[0]
    vertices[:, [shape.lateral, shape.facing]] = _even(shape, ring) if shape.is_even else _curve(shape, ring, angle)
    return vertices


def loft(shape: Shape) -> trimesh.Trimesh:
    """Return the closed surface through all rings, ends capped, faces outward, in the body's frame [m]."""
    sections = [section(shape, ring) for ring in rings(shape)]
    num = shape.num_around
    vertices = np.concatenate([*sections, [sections[0].mean(axis=0)], [sections[-1].mean(axis=0)]]) / 1000
    if shape.turn:
        vertices = Rotation.from_euler("xyz"[shape.along], shape.turn, degrees=True).apply(vertices)
    here, following = np.arange(num), np.roll(np.arange(num), -1)
    faces = []
    for k in range(len(sections) - 1):
        low, high = k * num, (k + 1) * num
        faces.append(np.stack([low + here, low + following, high + following], axis=1))
        faces.append(np.stack([low + here, high + following, high + here], axis=1))
    last = (len(sections) - 1) * num
    faces.append(np.stack([following, here, np.full(num, len(vertices) - 2)], axis=1))
    faces.append(np.stack([last + here, last + following, np.full(num, len(vertices) - 1)], axis=1))
    mesh = trimesh.Trimesh(vertices.round(ROUNDING), np.concatenate(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def write(shapes: Mapping[str, Shape], folder: Path) -> None:
    """Write the surface of each shape as an STL file of its name.

    Raises:
        SystemExit: If one is not a closed surface.
    """
    folder.mkdir(exist_ok=True)
    for name, shape in shapes.items():
        mesh = loft(shape)
        if not (mesh.is_watertight and mesh.is_winding_consistent):
            raise SystemExit(f"{name} is not a closed surface")
        mesh.export(folder / f"{name}.stl")
        print(f"{name}: {len(mesh.faces)} triangles, {mesh.volume * 1e6:.1f} cm³")
