"""The surface that separates a mesh's inside from its outside: what distances to the mesh are measured to.

Files have parts that are inside out, parts within or across others, faces that two parts share, and holes. The parts are wound
outwards (`parts.outward`), so that a point is inside where they wind around it (Jacobson, Kavan and Sorkine-Hornung, *Robust
inside-outside segmentation using generalized winding numbers*, SIGGRAPH 2013; fast: Barill et al., SIGGRAPH 2018). Faces that
cross or touch are cut there, and the pieces that have the inside on one side stay. Each loop of open edges gets a lid, a fan
around the mean of its corners, which is such a face too. Sheets, which have the inside on no side, stay. Of faces that cover
each other one stays.

Shapes: `v` vertices, `f` and `g` faces, `n` points.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int

from tgdsl.errors import BakeError
from tgdsl.surfaces.crossings import Crossings, cells, crossings
from tgdsl.surfaces.holes import merged
from tgdsl.surfaces.parts import outward
from tgdsl.surfaces.surface import Surface, face_cross

TOUCH = 1e-6  # distance at which faces touch, over the mesh's size: MuJoCo has its vertices in float32
STEP = 1e-5  # distance in front of and behind a face at which one looks whether it is inside, over the mesh's size
OPEN = "is not closed; what is inside is decided by its winding number"
TWISTED = "has parts whose faces cannot be made to agree which side is out; they are as in its file"
UNCUT = "has more faces that cross than are cut; those that are partly inside count as surface"


@dataclass(frozen=True, eq=False)
class Outer:
    """The outer surface of a mesh."""

    vertices: Float[np.ndarray, "v 3"]  # positions [m]
    # vertex indices, counter-clockwise seen from outside; sheets have each face twice, once from either side
    faces: Int[np.ndarray, "f 3"]
    uncut: Int[np.ndarray, "g 3"]  # the mesh's faces of which there is something in `faces`, whole; on the same vertices
    flaws: tuple[str, ...]  # what of the mesh its user should know, to be put after its name


def outer(surface: Surface) -> Outer:
    """Return the outer surface of a mesh.

    Raises:
        BakeError: If no face has an area.
    """
    vertices, faces, source = merged(surface)
    has_area = _has_area(vertices[faces])
    faces, written = faces[has_area], surface.faces[source[has_area]]
    if not len(faces):
        raise BakeError("a surface to bake needs a face with an area")
    parts = outward(vertices, faces, written)
    if len(parts.caps):
        # Parts may share faces, but one that is there once too often is a part of its own.
        first = _distinct(faces)
        parts = min(parts, outward(vertices, faces[first], written[first]), key=lambda candidate: len(candidate.caps))
    vertices, caps = parts.vertices, parts.caps[_has_area(parts.vertices[parts.caps])]
    closed = np.concatenate([parts.faces, caps])
    corners, size = vertices[closed], float(np.linalg.norm(np.ptp(vertices, axis=0)))
    normal = face_cross(corners)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    crossed = crossings(corners, normal, TOUCH * size)
    cells = _cells(corners, crossed, TOUCH * size)
    step = STEP * size * normal[cells.owner]
    pos = cells.middle[:, None]
    if not crossed.is_complete:
        # A face is within others only if its corners are too.
        pos = np.concatenate([pos, 0.02 * pos + 0.98 * corners], axis=1)
    sides = np.stack([pos + step[:, None], pos - step[:, None]])
    before, behind = is_inside(vertices, closed, sides.reshape(-1, 3)).reshape(sides.shape[:3])
    is_within = (before & behind).all(axis=1)
    before, behind = before[:, 0], behind[:, 0]
    is_sheet = ~before & ~behind
    is_kept = ~is_within & ~_is_repeated(corners, normal, cells, crossed)
    flaws = {OPEN: len(caps) > 0, TWISTED: not parts.is_orientable, UNCUT: not crossed.is_complete}
    is_turned = before & ~behind
    return _assembled(vertices, closed, cells, is_kept, is_turned, is_sheet, tuple(flaw for flaw in flaws if flaws[flaw]))


def is_inside(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], pos: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Return which points closed faces wind around, in either sense."""
    if not len(pos):
        return np.zeros(0, bool)
    winding = np.abs(np.atleast_1d(igl.fast_winding_number(vertices, faces, np.ascontiguousarray(pos))))
    doubtful = np.flatnonzero(np.abs(winding - 0.5) < 0.1)
    if len(doubtful):
        winding[doubtful] = np.abs(igl.winding_number(vertices, faces, np.ascontiguousarray(pos[doubtful])))
    return winding >= 0.5


@dataclass(frozen=True, eq=False)
class _Cells:
    """What faces are cut into: whole faces first, then the cells of the others."""

    owner: Int[np.ndarray, " n"]  # the face of each
    middle: Float[np.ndarray, "n 3"]  # a point in it [m]
    corners: list[Float[np.ndarray, "_ 3"]]  # of those that are no whole faces, corners [m]


def _cells(corners: Float[np.ndarray, "f 3 3"], crossed: Crossings, tolerance: float) -> _Cells:
    """Return the cells that faces are cut into."""
    order = np.argsort(crossed.cut, kind="stable")
    names, begin = np.unique(crossed.cut[order], return_index=True)
    polygons, owner = [], []
    for name, segments in zip(names.tolist(), np.split(crossed.segments[order], begin[1:]), strict=False):
        pieces = cells(corners[name], segments, tolerance)
        if len(pieces) > 1:
            polygons += pieces
            owner += [name] * len(pieces)
    whole = np.setdiff1d(np.arange(len(corners)), owner)
    middle = [corners[whole].mean(axis=1), *(polygon.mean(axis=0, keepdims=True) for polygon in polygons)]
    return _Cells(np.concatenate([whole, np.array(owner, np.int64)]), np.concatenate(middle), polygons)


def _is_repeated(
    corners: Float[np.ndarray, "f 3 3"], normal: Float[np.ndarray, "f 3"], cells: _Cells, crossed: Crossings
) -> Bool[np.ndarray, " n"]:
    """Return which cells an earlier face of the same plane covers."""
    order = np.argsort(cells.owner, kind="stable")
    begin, end = (np.searchsorted(cells.owner[order], crossed.covered, side) for side in ("left", "right"))
    pair = np.repeat(np.arange(len(crossed.covered)), end - begin)
    cell = order[np.arange(len(pair)) - np.repeat(np.cumsum(end - begin) - end, end - begin)]
    cover, is_over = crossed.cover[pair], np.ones(len(pair), bool)
    for k in range(3):
        start, along = corners[cover, k], corners[cover, (k + 1) % 3] - corners[cover, k]
        is_over &= (np.cross(along, cells.middle[cell] - start) * normal[cover]).sum(axis=1) > 0
    return np.bincount(cell[is_over], minlength=len(cells.owner)) > 0


def _assembled(
    vertices: np.ndarray,
    faces: np.ndarray,
    cells: _Cells,
    is_kept: np.ndarray,
    is_turned: np.ndarray,
    is_sheet: np.ndarray,
    flaws: tuple[str, ...],
) -> Outer:
    """Return the surface of the cells that are kept; faces all of whose cells are kept alike are whole."""
    kind = np.where(is_kept, 1 + is_turned + 2 * is_sheet, 0)
    lowest, highest = np.full(len(faces), 9), np.zeros(len(faces), np.int64)
    np.minimum.at(lowest, cells.owner, kind)
    np.maximum.at(highest, cells.owner, kind)
    is_whole = (lowest == highest) & (highest > 0)
    triangles, kinds, new = [faces[is_whole]], [highest[is_whole]], [vertices]
    count = len(vertices)
    first = len(cells.owner) - len(cells.corners)
    for i in np.flatnonzero((kind > 0) & ~is_whole[cells.owner]).tolist():
        polygon = cells.corners[i - first]
        fan = np.arange(1, len(polygon) - 1)
        triangles.append(count + np.stack([np.zeros_like(fan), fan, fan + 1], axis=1))
        kinds.append(np.full(len(fan), kind[i]))
        new.append(polygon)
        count += len(polygon)
    vertices, triangles, kinds = np.concatenate(new), np.concatenate(triangles), np.concatenate(kinds)
    has_area = _has_area(vertices[triangles])
    triangles, kinds = triangles[has_area], kinds[has_area]
    triangles = np.where((kinds == 2)[:, None], triangles[:, ::-1], triangles)
    triangles = np.concatenate([triangles, triangles[kinds == 3][:, ::-1]])
    both = np.concatenate([triangles, faces[highest > 0]])
    vertices, used = np.unique(vertices[both].reshape(-1, 3), axis=0, return_inverse=True)
    both = used.reshape(-1, 3)
    return Outer(vertices, both[: len(triangles)], both[len(triangles) :], flaws)


def _distinct(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " g"]:
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return np.sort(np.unique(turned, axis=0, return_index=True)[1])


def _has_area(corners: Float[np.ndarray, "f 3 3"]) -> Bool[np.ndarray, " f"]:
    sides = corners - np.roll(corners, 1, axis=1)
    longest = (sides**2).sum(axis=2).max(axis=1, initial=0)
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > 1e-9 * longest
