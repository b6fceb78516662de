"""An elastomer pad laid flat: where its edge is, where its taxels are, and triangles between them.

The surface that was declared as the pad is unrolled to the plane and meshed anew with quadratic triangles. Fields on the plane
are along two axes, whose directions at each taxel and at each point of the edge tie them to the body frame: parallel on a flat
pad, along and across the arc on a cylinder.

Shapes: `taxel` taxels, `node` nodes of the elements, `edge` nodes on the pad's edge, `m` elements, `f` triangles of the
surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tgdsl.sensors.elastomer.flatten import flatten, has_area, jacobians
from tgdsl.sensors.elastomer.mesh import mesh
from tgdsl.sensors.elastomer.sheet import Sheet, components, half_edges, loops, open_sides, opened, refused, welded
from tgdsl.surfaces.surface import Surface

REACH = 1e-3
"""Largest distance of a taxel from the pad's surface [m]."""
BESIDE = 1e-4
"""Largest distance of a taxel from the pad's edge, measured outwards along the surface [m]."""
FACING = 0.5
"""Least cosine between a taxel's normal and that of the surface it sits on."""


@dataclass(frozen=True, eq=False)
class Pad:
    """A pad in the plane, and how the plane lies on the body.

    Attributes:
        nodes: Places in the plane [m]: the corners of the elements, then the middles of their sides.
        triangles: Nodes of each element: three corners, counter-clockwise, then the middles of sides 01, 12 and 20.
        edge: Nodes on the pad's edge, ascending.
        taxel_nodes: Nodes of the element that holds each taxel.
        taxel_weights: What each of them contributes to a field at the taxel.
        edge_pos: Place of each node of `edge` on the surface, body frame [m].
        edge_normal: Outward unit normal of the surface there, body frame.
        edge_axes: Unit tangents along the two axes of the plane there, body frame.
        taxel_axes: The same at each taxel, perpendicular to the taxel's own normal.
    """

    nodes: Float[np.ndarray, "node 2"]
    triangles: Int[np.ndarray, "m 6"]
    edge: Int[np.ndarray, " edge"]
    taxel_nodes: Int[np.ndarray, "taxel 6"]
    taxel_weights: Float[np.ndarray, "taxel 6"]
    edge_pos: Float[np.ndarray, "edge 3"]
    edge_normal: Float[np.ndarray, "edge 3"]
    edge_axes: Float[np.ndarray, "edge 2 3"]
    taxel_axes: Float[np.ndarray, "taxel 2 3"]


def unroll(
    surface: Surface, pos: Float[np.ndarray, "taxel 3"], normal: Float[np.ndarray, "taxel 3"], element_size: float
) -> Pad:
    """Lay the part of a surface that holds the taxels flat and mesh it.

    Args:
        surface: The triangles declared as the pad, body frame [m]; a soup, parts without taxels are ignored.
        pos: Taxels' positions, body frame [m].
        normal: Taxels' outward unit normals, body frame.
        element_size: Length of the elements at the pad's edge [m].

    Raises:
        LowerError: A taxel is not on the pad, taxels are on two parts of it, or it is not a sheet that can be unrolled.
    """
    if not len(surface.faces):
        raise refused("the pad's region holds no triangle of the surface", "give a region that holds all taxels of the link")
    soup = welded(surface.corners)
    face, weights = _seated(soup, pos, normal)
    part = components(soup.faces)
    held, count = np.unique(part[face], return_counts=True)
    if len(held) > 1:
        other = int(np.flatnonzero(part[face] != part[face[0]])[0])
        raise refused(
            f"the pad has {len(held)} parts that are not joined and hold {', '.join(map(str, count))} taxels: "
            f"taxel 0 is on one, taxel {other} on another",
            "give each part its own link in the layout, or a region that joins them",
        )
    chosen = np.flatnonzero(part == held[0])
    sheet = opened(Sheet(soup.vertices, soup.faces[chosen]))
    plane = flatten(sheet)
    face = np.searchsorted(chosen, face)
    taxel_plane = np.einsum("tk,tkx->tx", weights, plane[sheet.faces[face]])
    return _assembled(sheet, plane, taxel_plane, _axes(jacobians(sheet, plane)[face], normal), element_size)


def _assembled(
    sheet: Sheet,
    plane: Float[np.ndarray, "v 2"],
    taxel_plane: Float[np.ndarray, "taxel 2"],
    taxel_axes: Float[np.ndarray, "taxel 2 3"],
    element_size: float,
) -> Pad:
    """Mesh a flattened sheet and find taxels in the mesh and the mesh's edge on the sheet."""
    corners = mesh([plane[loop] for loop in loops(sheet.faces)], element_size)
    nodes, triangles, edge = _quadratic(corners.points, corners.triangles)
    element, at = _located(corners.points[corners.triangles], taxel_plane)
    face, inside = _located(plane[sheet.faces], nodes[edge])
    space = sheet.vertices[sheet.faces[face]]
    normal = np.cross(space[:, 1] - space[:, 0], space[:, 2] - space[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Pad(
        nodes=nodes,
        triangles=triangles,
        edge=edge,
        taxel_nodes=triangles[element],
        taxel_weights=quadratic(at),
        edge_pos=np.einsum("ek,ekx->ex", inside, space),
        edge_normal=normal,
        edge_axes=_axes(jacobians(sheet, plane)[face], normal),
        taxel_axes=taxel_axes,
    )


def quadratic(at: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, "q 6"]:
    """Return the six quadratic shape functions at barycentric coordinates, corners first."""
    return np.concatenate([at * (2 * at - 1), 4 * at * np.roll(at, -1, axis=1)], axis=1)


def _quadratic(
    points: Float[np.ndarray, "p 2"], corners: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "node 2"], Int[np.ndarray, "m 6"], Int[np.ndarray, " edge"]]:
    """Add a node in the middle of each side; return nodes, elements and the nodes on the edge."""
    used, corners = np.unique(corners, return_inverse=True)
    points, corners = points[used], corners.reshape(-1, 3).astype(np.int64)
    ends = np.sort(np.stack(half_edges(corners), axis=1), axis=1)
    sides, side = np.unique(ends, axis=0, return_inverse=True)
    middles = len(points) + side.reshape(-1, 3)
    outer = open_sides(corners)
    edge = np.unique(np.concatenate([ends[outer].ravel(), middles.ravel()[outer]]))
    nodes = np.concatenate([points, points[sides].mean(axis=1)])
    return nodes, np.concatenate([corners, middles], axis=1).astype(np.int64), edge.astype(np.int64)


def _located(
    triangles: Float[np.ndarray, "f 3 2"], where: Float[np.ndarray, "q 2"]
) -> tuple[Int[np.ndarray, " q"], Float[np.ndarray, "q 3"]]:
    """Return the triangle that holds each point, or the nearest, and the point's barycentric coordinates in it."""
    index = np.flatnonzero(has_area(triangles.reshape(-1, 2), np.arange(3 * len(triangles)).reshape(-1, 3)))
    a, b, c = (triangles[index, k] for k in range(3))
    twice = _cross(b - a, c - a)
    low, high = triangles[index].min(axis=1), triangles[index].max(axis=1)
    slack = 0.02 * float((high - low).max())
    found, weights = np.zeros(len(where), dtype=np.int64), np.zeros((len(where), 3))
    heights = twice[:, None] / np.stack([np.linalg.norm(side, axis=1) for side in (c - b, a - c, b - a)], axis=1)
    for i, point in enumerate(where):
        near = np.flatnonzero(((low - slack <= point) & (point <= high + slack)).all(axis=1))
        near = near if len(near) else np.arange(len(index))
        at = np.stack([_cross(b[near] - point, c[near] - point), _cross(c[near] - point, a[near] - point)], axis=1)
        at /= twice[near, None]
        at = np.concatenate([at, 1 - at.sum(axis=1, keepdims=True)], axis=1)
        best = int(np.argmax((at * heights[near]).min(axis=1)))
        found[i], weights[i] = index[near[best]], at[best]
    return found, weights


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _axes(jacobian: Float[np.ndarray, "q 3 2"], normal: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, "q 2 3"]:
    """Return the orthonormal tangents nearest to the directions of the plane's axes, perpendicular to the normals."""
    tangent = jacobian - normal[:, :, None] * np.einsum("qx,qxu->qu", normal, jacobian)[:, None, :]
    left, _, right = np.linalg.svd(tangent, full_matrices=False)
    return np.swapaxes(left @ right, 1, 2)


def _seated(
    sheet: Sheet, pos: Float[np.ndarray, "taxel 3"], normal: Float[np.ndarray, "taxel 3"]
) -> tuple[Int[np.ndarray, " taxel"], Float[np.ndarray, "taxel 3"]]:
    """Return the triangle that each taxel sits on, and the barycentric coordinates of the place.

    Raises:
        LowerError: A taxel is farther than `REACH` from the surface or lies beside its edge.
    """
    corners = sheet.vertices[sheet.faces]
    is_open = np.zeros(3 * len(corners), dtype=bool)
    is_open[open_sides(sheet.faces)] = True
    is_open = is_open.reshape(-1, 3)
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = has_area(sheet.vertices, sheet.faces)
    up /= np.where(solid, np.linalg.norm(up, axis=1), 1.0)[:, None]
    low, high = corners.min(axis=1), corners.max(axis=1)
    face, weights = np.zeros(len(pos), dtype=np.int64), np.zeros((len(pos), 3))
    for i, (point, outward) in enumerate(zip(pos, normal, strict=True)):
        facing = np.flatnonzero(solid & (up @ outward >= FACING))
        near = facing[((low[facing] <= point + REACH) & (point - REACH <= high[facing])).all(axis=1)]
        facing = near if len(near) else facing
        if not len(facing):
            raise refused(
                f"taxel {i} is not on the pad: no part of it faces as the taxel does",
                "give a region that holds all taxels of the link",
            )
        at = _nearest(corners[facing], point)
        offset = point - np.einsum("fk,fkx->fx", at, corners[facing])
        distance = np.linalg.norm(offset, axis=1)
        best = int(np.argmin(distance))
        face[i], weights[i] = facing[best], at[best]
        rim = (is_open[face[i]] & (np.roll(at[best], 1) < 1e-9)).any()  # side k is opposite corner k − 1
        beside = float(np.linalg.norm(offset[best] - (offset[best] @ up[face[i]]) * up[face[i]]))
        _check_seat(i, float(distance[best]), beside if rim else 0.0)
    return face, weights


def _check_seat(taxel: int, distance: float, beside: float) -> None:
    """Refuse a taxel that is too far from the surface, or too far outside its edge [m]."""
    if distance <= REACH and beside <= BESIDE:
        return
    place, limit = ("off the pad's surface", REACH) if distance > REACH else ("beside the pad's edge", BESIDE)
    raise refused(
        f"taxel {taxel} is {1e3 * distance:.3g} mm {place}, {1e3 * limit:.3g} mm are allowed",
        "give a region that holds all taxels of the link",
    )


def _nearest(corners: Float[np.ndarray, "f 3 3"], point: Float[np.ndarray, 3]) -> Float[np.ndarray, "f 3"]:
    """Return barycentric coordinates of the point of each triangle that is nearest to a point."""
    e, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = point - corners[:, 0]
    ee, ed, dd = (e * e).sum(axis=1), (e * d).sum(axis=1), (d * d).sum(axis=1)
    ep, dp = (e * offset).sum(axis=1), (d * offset).sum(axis=1)
    u, v = np.stack([dd * ep - ed * dp, ee * dp - ed * ep]) / (ee * dd - ed**2)
    at = np.stack([1 - u - v, u, v], axis=1)
    outside = at.min(axis=1) < 0
    best = np.where(outside, np.inf, 0.0)
    for k in range(3):
        start, along = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        place = np.clip(((point - start) * along).sum(axis=1) / (along * along).sum(axis=1), 0.0, 1.0)
        gap = np.linalg.norm(point - start - place[:, None] * along, axis=1)
        closer = gap < best
        on_side = np.zeros_like(at)
        on_side[:, k], on_side[:, (k + 1) % 3] = 1 - place, place
        at, best = np.where(closer[:, None], on_side, at), np.where(closer, gap, best)
    return at
