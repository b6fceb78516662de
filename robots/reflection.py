"""A reflection along an axis, and what it makes of names, of numbers as text and of STL files.

The reflection M turns one axis of the model's frame around, and every frame R becomes M R M. So each local quantity is mirrored
by the same M: points by M, rotations, which are pseudovectors, by −M. All this only changes signs: numbers keep their digits.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from tgdsl.errors import TgdslError

Signs = tuple[int, ...]
"""A factor ±1 per number of an attribute."""

SYMMETRIC = 1e-6
"""Meshes whose corners differ less from their mirror images, relative to the mesh's extent, are symmetric."""
STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


class MirrorError(TgdslError):
    """A model or layout that holds what cannot be mirrored, or what is not known here."""


@dataclass(frozen=True)
class Mirror:
    """A reflection, and the names of the two sides.

    Attributes:
        axis: Index of the axis that is turned around: 0, 1 or 2 for x, y or z of the model's frame.
        source: The side in the names of what is read.
        target: The side that it becomes.
    """

    axis: int = 1
    source: str = "right"
    target: str = "left"

    @property
    def polar(self) -> Signs:
        """The diagonal of M: what points and directions are multiplied by."""
        return tuple(-1 if i == self.axis else 1 for i in range(3))

    @property
    def axial(self) -> Signs:
        """The diagonal of −M: what axes of rotation are multiplied by."""
        return tuple(-sign for sign in self.polar)

    def renamed(self, text: str) -> str:
        """Return a text with the side exchanged wherever it stands as a word of its own, as in `right_hand` or `Right`."""
        for change in (str.lower, str.capitalize, str.upper):
            text = re.sub(rf"(?<![A-Za-z]){change(self.source)}(?![a-z])", change(self.target), text)
        return text

    def file(self, name: str) -> str:
        """Return a file's name with the side exchanged, or with the side appended if it has none."""
        path = PurePosixPath(name)
        renamed = self.renamed(path.name)
        return str(path.with_name(renamed if renamed != path.name else f"{path.stem}_{self.target}{path.suffix}"))

    def mesh_file(self, name: str) -> str:
        """Return a mesh's name with the side exchanged; without one it keeps its name, in a folder named like the side."""
        path = PurePosixPath(name)
        renamed = self.renamed(path.name)
        return str(path.with_name(renamed) if renamed != path.name else path.parent / self.target / path.name)


# ---- numbers as text


def flipped(number: str) -> str:
    """Return a number, also one with a unit, with the opposite sign and the same digits; zero has no sign."""
    bare = number.lstrip("+-")
    is_zero = not re.search(r"[1-9]", re.split(r"[eE]|\s", bare)[0])
    return bare if is_zero or number.startswith("-") else f"-{bare}"


def signed(text: str, signs: Signs) -> str:
    """Return white-space separated numbers times some signs; what separates them stays."""
    found = iter(signs)
    return re.sub(r"\S+", lambda match: match[0] if next(found) > 0 else flipped(match[0]), text)


# ---- meshes


def triangles(content: bytes) -> np.ndarray:
    """Return the records of a binary STL file.

    Raises:
        MirrorError: If it is none.
    """
    if len(content) < 84 or len(content) != 84 + STL.itemsize * int.from_bytes(content[80:84], "little"):
        raise MirrorError("not a binary STL file")
    return np.frombuffer(content, STL, offset=84)


def mirrored_stl(content: bytes, mirror: Mirror) -> bytes:
    """Return a binary STL file mirrored, triangle by triangle, with its outside still outside."""
    records = triangles(content).copy()
    signs = np.array(mirror.polar, dtype=np.float32)
    records["normal"] = records["normal"] * signs + np.float32(0)  # no −0
    records["corners"] = records["corners"][:, [0, 2, 1]] * signs + np.float32(0)
    return content[:84] + records.tobytes()


def same_triangles(one: bytes, other: bytes) -> bool:
    """Return whether two binary STL files hold the same triangles up to rounding, in any order.

    The same corners are not enough: cut along the other diagonal, a bent quadrangle is another surface.
    """
    both = [triangles(content)["corners"].astype(np.float64) for content in (one, other)]
    extent = float(np.ptp(both[0].reshape(-1, 3), axis=0).max())
    tables = []
    for corners in both:
        steps = np.round(corners / (SYMMETRIC * extent)).astype(np.int64)
        order = np.array([min(range(3), key=lambda i: tuple(triangle[i])) for triangle in steps])
        turned = np.take_along_axis(steps, ((order[:, None] + np.arange(3)) % 3)[..., None], axis=1).reshape(-1, 9)
        tables.append(turned[np.lexsort(turned.T)])
    return bool(np.array_equal(*tables))
