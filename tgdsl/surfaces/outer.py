"""The surface that separates a mesh's inside from its outside, to which distances are measured.

Files have parts that are inside out, parts within or across others, faces that two parts share, and holes. `outward` winds the
parts outwards; a point is inside if they wind around it (Jacobson, Kavan and Sorkine-Hornung, *Robust inside-outside
segmentation using generalized winding numbers*, SIGGRAPH 2013; fast: Barill et al., SIGGRAPH 2018). Faces that cross or touch
are cut there; pieces with the inside on one side stay. Each loop of open edges gets a lid, a fan of faces around the mean of
its corners. Sheets, with the inside on neither side, stay. Of faces that cover each other one stays.

Shapes: `v` vertices, `f` and `g` faces, `n` points.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tgdsl.errors import BakeError
from tgdsl.surfaces.surface import Surface, face_cross, hole_caps, merged, winding_number

TOUCH = 1e-6  # distance at which faces touch, over the mesh's size: MuJoCo's vertices are float32
STEP = 1e-5  # distance in front of and behind a face at which points are tested for being inside, over the mesh's size
OPEN = "is not closed; its winding number decides which points are inside"
TWISTED = "has parts whose faces cannot be wound consistently; their winding is as in its file"
UNCUT = "has too many crossing faces to cut; faces that are partly inside count as surface"


@dataclass(frozen=True, eq=False)
class Outer:
    """The outer surface of a mesh."""

    vertices: Float[np.ndarray, "v 3"]  # positions [m]
    # vertex indices, counter-clockwise seen from outside; sheets have each face twice, once from either side
    faces: Int[np.ndarray, "f 3"]
    uncut: Int[np.ndarray, "g 3"]  # the mesh's faces that are partly or wholly in `faces`, uncut; on the same vertices
    flaws: tuple[str, ...]  # flaws of the mesh, as predicates for a warning


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
        # Parts may share faces, but a repeated face can become a separate part.
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
    in_front, behind = is_inside(vertices, closed, sides.reshape(-1, 3)).reshape(sides.shape[:3])
    is_within = (in_front & behind).all(axis=1)
    in_front, behind = in_front[:, 0], behind[:, 0]
    is_sheet = ~in_front & ~behind
    is_kept = ~is_within & ~_is_repeated(corners, normal, cells, crossed)
    flaws = {OPEN: len(caps) > 0, TWISTED: not parts.is_orientable, UNCUT: not crossed.is_complete}
    is_turned = in_front & ~behind
    return _assembled(vertices, closed, cells, is_kept, is_turned, is_sheet, tuple(flaw for flaw in flaws if flaws[flaw]))


def is_inside(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], pos: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Return whether closed faces wind around each point, in either sense."""
    if not len(pos):
        return np.zeros(0, bool)
    winding = np.abs(np.atleast_1d(igl.fast_winding_number(vertices, faces, np.ascontiguousarray(pos))))
    doubtful = np.flatnonzero(np.abs(winding - 0.5) < 0.1)
    if len(doubtful):
        winding[doubtful] = np.abs(winding_number(vertices, faces, pos[doubtful]))
    return winding >= 0.5


@dataclass(frozen=True, eq=False)
class _Cells:
    """The cells of cut faces: whole faces first, then the cells of the others."""

    owner: Int[np.ndarray, " n"]  # the face of each
    middle: Float[np.ndarray, "n 3"]  # a point in it [m]
    corners: list[Float[np.ndarray, "_ 3"]]  # corners of the cells that are not whole faces [m]


def _cells(corners: Float[np.ndarray, "f 3 3"], crossed: Crossings, tolerance: float) -> _Cells:
    """Return the cells of cut faces."""
    order = np.argsort(crossed.cut, kind="stable")
    names, begin = np.unique(crossed.cut[order], return_index=True)
    polygons, owner = [], []
    for name, segments in zip(names.tolist(), np.split(crossed.segments[order], begin[1:]), strict=False):
        pieces = cut_cells(corners[name], segments, tolerance)
        if len(pieces) > 1:
            polygons += pieces
            owner += [name] * len(pieces)
    whole = np.setdiff1d(np.arange(len(corners)), owner)
    middle = [corners[whole].mean(axis=1), *(polygon.mean(axis=0, keepdims=True) for polygon in polygons)]
    return _Cells(np.concatenate([whole, np.array(owner, np.int64)]), np.concatenate(middle), polygons)


def _is_repeated(
    corners: Float[np.ndarray, "f 3 3"], normal: Float[np.ndarray, "f 3"], cells: _Cells, crossed: Crossings
) -> Bool[np.ndarray, " n"]:
    """Return whether an earlier face in the same plane covers each cell."""
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
    """Return the surface of the selected cells; a face stays whole if all its cells are treated equally."""
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


LEAF = 32  # faces whose boxes are compared with all near ones at once
CHUNK = 1 << 18  # pairs that are tested at once
MAX_PAIRS = 20_000_000  # largest number of pairs of faces whose boxes overlap
MAX_SEGMENTS = 200_000  # largest number of segments along which faces are cut
ROUNDING = 1e-3  # distance at which a cell's corner is on a line, over the tolerance


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where faces of a surface meet, apart from their borders."""

    cut: Int[np.ndarray, " s"]  # faces that others cross or touch
    segments: Float[np.ndarray, "s 2 3"]  # segments along which they are cut [m]
    # faces in the plane of earlier faces, which may cover them and along whose border they are cut
    covered: Int[np.ndarray, " n"]
    cover: Int[np.ndarray, " n"]  # the earlier faces
    is_complete: bool = True  # False if there are too many crossings; the arrays are then empty


def crossings(corners: Float[np.ndarray, "f 3 3"], normal: Float[np.ndarray, "f 3"], tolerance: float) -> Crossings:
    """Return the crossings of faces with these corners [m] and unit normals, if there are not too many.

    Faces touch at a distance of `tolerance` [m].
    """
    edges = np.roll(corners, -1, axis=1) - corners
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    none = np.zeros(0, np.int64)
    skipped = Crossings(none, np.zeros((0, 2, 3)), none, none, is_complete=False)
    pairs = _near_pairs(corners.min(axis=1) - tolerance, corners.max(axis=1) + tolerance)
    if pairs is None:
        return skipped
    cut, segments, covered, cover = [none], [np.zeros((0, 2, 3))], [none], [none]
    for start in range(0, len(pairs), CHUNK):
        i, j = pairs[start : start + CHUNK].T
        of_i, of_j = (_heights(corners[b], normal[b], corners[a], tolerance) for a, b in ((i, j), (j, i)))
        meets = ~((of_j > 0).all(axis=1) | (of_j < 0).all(axis=1) | (of_i > 0).all(axis=1) | (of_i < 0).all(axis=1))
        i, j, of_i, of_j = i[meets], j[meets], of_i[meets], of_j[meets]
        is_flat = ~of_i.any(axis=1) | ~of_j.any(axis=1)
        covered.append(j[is_flat])
        cover.append(i[is_flat])
        border = np.stack([corners[i[is_flat]], np.roll(corners[i[is_flat]], -1, axis=1)], axis=2)
        candidates = [(np.repeat(j[is_flat], 3), border.reshape(-1, 2, 3))]
        for face, other, height in ((i, j, of_j), (j, i, of_i)):
            is_cut, sections = _sections(corners[other[~is_flat]], height[~is_flat])
            candidates.append((face[~is_flat][is_cut], sections))
        for face, sections in candidates:
            inward = np.cross(normal[face][:, None], edges[face])
            depth = np.einsum("nekc,nkc->nek", sections[:, :, None] - corners[face][:, None], inward)
            is_cut, sections = _clipped(sections, depth, tolerance)
            cut.append(face[is_cut])
            segments.append(sections)
        if sum(map(len, cut)) > MAX_SEGMENTS:
            return skipped
    return Crossings(np.concatenate(cut), np.concatenate(segments), np.concatenate(covered), np.concatenate(cover))


def _near_pairs(low: Float[np.ndarray, "f 3"], high: Float[np.ndarray, "f 3"]) -> Int[np.ndarray, "n 2"] | None:
    """Return the pairs of boxes that overlap, the lower index first; None if there are too many."""
    everything = np.arange(len(low))
    result, waiting, count = [np.zeros((0, 2), np.int64)], [(everything, everything)], 0
    while waiting:
        members, near = waiting.pop()
        box_low, box_high = low[members].min(axis=0), high[members].max(axis=0)
        near = near[((low[near] <= box_high) & (high[near] >= box_low)).all(axis=1)]
        if len(members) > LEAF:
            middle = low[members] + high[members]
            members = members[np.argsort(middle[:, np.ptp(middle, axis=0).argmax()], kind="stable")]
            waiting += [(members[: len(members) // 2], near), (members[len(members) // 2 :], near)]
            continue
        meets = members[:, None] < near
        for axis in range(3):
            meets &= (low[members, axis, None] <= high[near, axis]) & (high[members, axis, None] >= low[near, axis])
        a, b = np.nonzero(meets)
        result.append(np.stack([members[a], near[b]], axis=1))
        count += len(a)
        if count > MAX_PAIRS:
            return None
    return np.concatenate(result)


def _heights(base: np.ndarray, normal: np.ndarray, corners: np.ndarray, tolerance: float) -> Float[np.ndarray, "n 3"]:
    height = np.einsum("nki,ni->nk", corners - base[:, :1], normal)
    height[np.abs(height) <= tolerance] = 0.0
    return height


def _sections(corners: Float[np.ndarray, "n 3 3"], height: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles that a plane cuts, by their corners' heights above it, and the two ends of each section [m]."""
    after, onward = np.roll(height, -1, axis=1), np.roll(corners, -1, axis=1)
    crosses = height * after < 0
    part = np.divide(height, height - after, out=np.zeros_like(height), where=crosses)
    ends = np.concatenate([corners, corners + part[:, :, None] * (onward - corners)], axis=1)
    is_end = np.concatenate([height == 0, crosses], axis=1)
    result = np.flatnonzero(is_end.sum(axis=1) == 2)
    return result, ends[result][is_end[result]].reshape(-1, 2, 3)


def cut_cells(
    triangle: Float[np.ndarray, "3 3"], segments: Float[np.ndarray, "s 2 3"], tolerance: float
) -> list[Float[np.ndarray, "_ 3"]]:
    """Return the convex cells of a triangle, cut along the lines of segments in its plane until no segment crosses a cell.

    Segments along a cell's border, or nearer to it than the tolerance [m], do not count.
    """
    x = triangle[1] - triangle[0]
    x /= np.linalg.norm(x)
    y = triangle[2] - triangle[0]
    y = y - (y @ x) * x
    axes = np.stack([x, y / np.linalg.norm(y)])
    waiting = [((triangle - triangle[0]) @ axes.T, (segments - triangle[0]) @ axes.T)]
    done = []
    while waiting:
        cell, inner = waiting.pop()
        if len(inner):
            edge = _next(cell) - cell
            inward = edge[:, ::-1] * [-1.0, 1.0] / np.sqrt((edge**2).sum(axis=1, keepdims=True))
            inner = _clipped(inner, inner @ inward.T - (cell * inward).sum(axis=1), tolerance)[1]
        if not len(inner):
            done.append(cell @ axes + triangle[0])
            continue
        way = inner[:, 1] - inner[:, 0]
        longest = (way**2).sum(axis=1).argmax()
        side = (cell - inner[longest, 0]) @ (way[longest, ::-1] * [-1.0, 1.0]) / np.sqrt((way[longest] ** 2).sum())
        side[np.abs(side) < ROUNDING * tolerance] = 0.0  # or else cells have sides of no direction
        inner = np.delete(inner, longest, axis=0)
        waiting += [(_half(cell, part), inner) for part in (side, -side)]
    return done


def _clipped(
    segments: Float[np.ndarray, "s 2 d"], depth: Float[np.ndarray, "s 2 k"], tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the segments that pass through the interior of convex cells, and their ends there."""
    slope = depth[:, 1] - depth[:, 0]
    at = np.divide(-depth[:, 0], slope, out=np.zeros_like(slope), where=slope != 0)
    begin = np.where(slope > 0, at, 0.0).max(axis=1).clip(0, 1)
    end = np.where(slope < 0, at, 1.0).min(axis=1).clip(0, 1)
    way = segments[:, 1] - segments[:, 0]
    middle = depth[:, 0] + (0.5 * (begin + end))[:, None] * slope
    length = (end - begin) * np.sqrt((way**2).sum(axis=1))
    result = np.flatnonzero((middle.min(axis=1) > tolerance) & (length > tolerance))
    return result, segments[result, :1] + np.stack([begin, end], axis=1)[result, :, None] * way[result, None]


def _next(cell: np.ndarray) -> np.ndarray:
    return np.concatenate([cell[1:], cell[:1]])


def _half(cell: Float[np.ndarray, "k 2"], side: Float[np.ndarray, " k"]) -> np.ndarray:
    """Return the part of a convex cell on one side of a line; `side`: its corners' signed distances from the line."""
    after, onward = _next(side), _next(cell)
    crosses = side * after < 0
    part = np.divide(side, side - after, out=np.zeros_like(side), where=crosses)
    both = np.concatenate([cell, cell + part[:, None] * (onward - cell)], axis=1)
    result = both.reshape(-1, 2)[np.column_stack([side >= 0, crosses]).reshape(-1)]
    return result[(result != _next(result)).any(axis=1)]


FLAT = 1e-9  # volume below which a part encloses none, over the cube of its size
ENCLOSED = 0.9  # least winding number of a part for points within it: on its surface it is 1/2, at a notch more


@dataclass(frozen=True, eq=False)
class Parts:
    """A surface whose parts are wound outwards and share no vertices."""

    vertices: Float[np.ndarray, "w 3"]  # positions [m]
    faces: Int[np.ndarray, "f 3"]  # vertex indices, counter-clockwise seen from outside
    caps: Int[np.ndarray, "g 3"]  # triangles that close the parts' holes, wound like the faces
    is_orientable: bool  # whether every part can be wound consistently; other parts keep their winding


def outward(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], written: Int[np.ndarray, "f 3"]) -> Parts:
    """Return a surface with its parts wound outwards; a part within a larger one keeps its winding relative to it.

    An inner shell wound against the shell around it thus remains a cavity, even if both are inside out. `faces` refer to
    distinct vertices; `written` are the file's faces, whose vertices may coincide.
    """
    part, is_turned, is_orientable = _coherent(vertices, faces, *_neighbours(vertices, faces, written))
    faces = np.where(is_turned[:, None], faces[:, ::-1], faces)
    num = int(part.max()) + 1
    corner, flat = np.unique(part[:, None] * len(vertices) + faces, return_inverse=True)
    faces, part_of_vertex = flat.reshape(-1, 3), corner // len(vertices)
    vertices, caps = hole_caps(vertices[corner % len(vertices)], faces)
    closed, closed_part = np.concatenate([faces, caps]), np.concatenate([part, part_of_vertex[caps[:, 0]]])
    is_inverted = _inside_out(vertices, closed, closed_part, num)[closed_part]
    closed = np.where(is_inverted[:, None], closed[:, ::-1], closed)
    return Parts(vertices, closed[: len(faces)], closed[len(faces) :], is_orientable)


def _coherent(
    vertices: np.ndarray, faces: np.ndarray, first: np.ndarray, second: np.ndarray, agrees: np.ndarray
) -> tuple[Int[np.ndarray, " f"], Bool[np.ndarray, " f"], bool]:
    """Return each face's part, whether it is wound against most of the part's area, and whether all parts are orientable."""
    num = len(faces)
    # Each face is two nodes, as it is and turned; nodes that agree are connected.
    start, end = np.tile(first, 2), np.where(np.tile(agrees, 2), np.tile(second, 2), np.tile(second + num, 2))
    start[len(first) :] += num
    end[len(first) :] = np.where(agrees, second + num, second)
    label = connected_components(coo_array((np.ones(len(start), bool), (start, end)), (2 * num,) * 2), directed=False)[1]
    joined = coo_array((np.ones(len(first), bool), (first, second)), (num, num))
    part = connected_components(joined, directed=False)[1]
    root = np.unique(part, return_index=True)[1][part]
    is_turned = label[:num] != label[root]
    area = np.asarray(igl.doublearea(vertices, faces))
    is_turned ^= (np.bincount(part, np.where(is_turned, area, -area)) > 0)[part]
    is_twisted = label[:num] == label[num:]
    return part.astype(np.int64), is_turned & ~is_twisted, not is_twisted.any()


def _neighbours(
    vertices: np.ndarray, faces: np.ndarray, written: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, " n"]]:
    """Return pairs of faces that are neighbours, and whether they run along their edge in opposite senses."""
    sides, unpaired, pairs = _sides(faces), np.arange(3 * len(faces)), [np.zeros((0, 2), np.int64)]
    is_forward = sides[:, 0] < sides[:, 1]
    for ends in (_sides(written), sides):
        _, which, count = np.unique(np.sort(ends[unpaired], axis=1), axis=0, return_inverse=True, return_counts=True)
        which = which.reshape(-1)
        order, begin = unpaired[np.argsort(which, kind="stable")], (np.cumsum(count) - count)[count == 2]
        pairs.append(np.stack([order[begin], order[begin + 1]], axis=1))
        unpaired, which = unpaired[count[which] != 2], which[count[which] != 2]
    is_shared = np.bincount(which)[which] > 2 if len(which) else np.zeros(0, bool)
    unpaired, which = unpaired[is_shared], which[is_shared]
    if len(unpaired):
        angle = _angles(vertices, np.sort(sides[unpaired], axis=1), np.roll(faces, 1, axis=1).T.reshape(-1)[unpaired], which)
        # At equal angles, sides that end a wedge come before sides that begin one.
        order = np.lexsort((~is_forward[unpaired], angle, which))
        groups = np.split(unpaired[order], np.flatnonzero(np.diff(which[order])) + 1)
        pairs += [np.array(wedges) for group in groups if (wedges := _wedges(group.tolist(), is_forward))]
    a, b = np.concatenate(pairs).T
    return a % len(faces), b % len(faces), is_forward[a] != is_forward[b]


def _sides(faces: np.ndarray) -> Int[np.ndarray, "n 2"]:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _angles(vertices: np.ndarray, edges: np.ndarray, opposite: np.ndarray, which: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the angles of faces around their edges, relative to the first face of each edge [rad]."""
    low, high = vertices[edges.T]
    along = (high - low) / np.linalg.norm(high - low, axis=1, keepdims=True)
    away = vertices[opposite] - low
    away -= (away * along).sum(axis=1, keepdims=True) * along
    _, first, same = np.unique(which, return_index=True, return_inverse=True)
    zero = away[first][same.reshape(-1)]
    angle = np.arctan2((np.cross(along, zero) * away).sum(axis=1), (zero * away).sum(axis=1))
    return np.round(angle % (2 * np.pi), 6) % np.round(2 * np.pi, 6)


def _wedges(sides: list[int], is_forward: np.ndarray) -> list[tuple[int, int]]:
    """Match the sides of one edge, in the order of their angle, as brackets: the solid is behind a face."""
    result, begun = [], list[int]()
    for side in sides:
        if not is_forward[side]:
            begun.append(side)
        elif begun:
            result.append((begun.pop(), side))
    ended = {side for _, side in result}
    for side in sides:
        if begun and is_forward[side] and side not in ended:
            result.append((begun.pop(), side))
    return result


def _inside_out(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, num: int) -> Bool[np.ndarray, " p"]:
    """Return whether to turn each closed part, by the sign of the volume of the largest part that contains it."""
    first = np.unique(part, return_index=True)[1]
    corners = vertices[faces] - vertices[faces[first, 0]][part][:, None]
    volume = np.bincount(part, np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])), num) / 6.0
    low, high = np.full((num, 3), np.inf), np.full((num, 3), -np.inf)
    np.minimum.at(low, part, vertices[faces].min(axis=1))
    np.maximum.at(high, part, vertices[faces].max(axis=1))
    is_inverted = volume < -FLAT * np.linalg.norm(high - low, axis=1) ** 3
    if not is_inverted.any() or is_inverted.all():
        return is_inverted
    order = np.argsort(part, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(part, minlength=num))[:-1])
    outermost = np.full(num, -1)
    for container in np.argsort(-np.abs(volume), kind="stable").tolist():
        is_near = (low >= low[container]).all(axis=1) & (high <= high[container]).all(axis=1)
        is_near &= (outermost < 0) & (np.abs(volume) < np.abs(volume[container]))
        near = np.flatnonzero(is_near)
        if len(near):
            tested = np.concatenate([members[i] for i in near])
            pos = np.concatenate([vertices[faces[tested]], vertices[faces[tested]].mean(axis=1, keepdims=True)], axis=1)
            winding = igl.fast_winding_number(vertices, faces[members[container]], pos.reshape(-1, 3))
            is_out = (np.abs(winding).reshape(-1, 4) < ENCLOSED).any(axis=1)
            outermost[near[np.bincount(part[tested], is_out, num)[near] == 0]] = container
    return is_inverted[np.where(outermost < 0, np.arange(num), outermost)]
