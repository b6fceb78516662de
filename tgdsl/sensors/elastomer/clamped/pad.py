"""An elastomer pad laid flat: where its edge is, where its taxels are, and triangles between them.

The surface that was declared as the pad is unrolled to the plane and remeshed with quadratic triangles. Fields on the plane
are along two axes, whose directions at each taxel and at each point of the edge tie them to the body frame: parallel on a flat
pad, along and across the arc on a cylinder.

Shapes: `taxel` taxels, `node` nodes of the elements, `edge` nodes on the pad's edge, `m` elements, `f` triangles of the
surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from skfem import CellBasis, ElementTriP2

from tgdsl.sensors.elastomer.clamped.flatten import flatten, has_area, jacobians
from tgdsl.sensors.elastomer.clamped.mesh import mesh
from tgdsl.sensors.elastomer.clamped.sheet import Sheet, open_sides, opened, refused, welded
from tgdsl.surfaces.surface import Surface

MAX_OFFSET = 1e-3
"""Largest distance of a taxel from the pad's surface [m]."""
BESIDE = 1e-4
"""Largest distance of a taxel from the pad's edge, measured outwards along the surface [m]."""
FACING = 0.5
"""Least cosine between a taxel's normal and the surface normal under it."""


@dataclass(frozen=True, eq=False)
class Pad:
    """A pad in the plane, and how the plane lies on the body.

    Attributes:
        basis: Quadratic elements in the plane [m]; nodes are their degrees of freedom.
        edge: Nodes on the pad's edge, ascending.
        at_taxels: Matrix from values at the nodes to values at the taxels.
        edge_pos: Place of each node of `edge` on the surface, body frame [m].
        edge_normal: Outward unit normal of the surface there, body frame.
        edge_axes: Unit tangents along the two axes of the plane there, body frame.
        taxel_axes: The same at each taxel, perpendicular to the taxel's own normal.
    """

    basis: CellBasis
    edge: Int[np.ndarray, " edge"]
    at_taxels: csr_matrix
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
    part = np.asarray(igl.facet_components(soup.faces)[1])
    held, count = np.unique(part[face], return_counts=True)
    if len(held) > 1:
        other = int(np.flatnonzero(part[face] != part[face[0]])[0])
        raise refused(
            f"the pad has {len(held)} parts that are not joined and hold {', '.join(map(str, count))} taxels: "
            f"taxel 0 is on one, taxel {other} on another",
            "give each part its own link in the layout, or a region that joins them",
        )
    part_faces = np.flatnonzero(part == held[0])
    sheet = opened(Sheet(soup.vertices, soup.faces[part_faces]))
    plane = flatten(sheet)
    face = np.searchsorted(part_faces, face)
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
    basis = CellBasis(mesh([plane[loop] for loop in igl.boundary_loop_all(sheet.faces)], element_size), ElementTriP2())
    edge = np.sort(basis.get_dofs().flatten())
    face, at = _located(plane, sheet.faces, basis.doflocs.T[edge])
    space = sheet.vertices[sheet.faces[face]]
    normal = np.cross(space[:, 1] - space[:, 0], space[:, 2] - space[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Pad(
        basis=basis,
        edge=edge,
        at_taxels=_interpolation(basis, taxel_plane),
        edge_pos=np.einsum("ek,ekx->ex", at, space),
        edge_normal=normal,
        edge_axes=_axes(jacobians(sheet, plane)[face], normal),
        taxel_axes=taxel_axes,
    )


def _interpolation(basis: CellBasis, where: Float[np.ndarray, "q 2"]) -> csr_matrix:
    """Return the matrix from nodes to values at points: as `CellBasis.probes`, but points may be just outside the mesh."""
    element, at = _located(basis.mesh.p.T, basis.mesh.t.T, where)
    weights = np.stack([ElementTriP2().lbasis(at.T[1:], k)[0] for k in range(basis.Nbfun)])
    rows = np.tile(np.arange(len(where)), basis.Nbfun)
    return csr_matrix((weights.ravel(), (rows, basis.element_dofs[:, element].ravel())), shape=(len(where), basis.N))


def _located(
    points: Float[np.ndarray, "v 2"], faces: Int[np.ndarray, "f 3"], where: Float[np.ndarray, "q 2"]
) -> tuple[Int[np.ndarray, " q"], Float[np.ndarray, "q 3"]]:
    """Return the triangle of the plane that is nearest to each point, and the point's barycentric coordinates in it."""
    index = np.flatnonzero(has_area(points, faces))
    lifted, queries = (np.pad(part, ((0, 0), (0, 1))) for part in (points, where))
    face = index[np.asarray(igl.point_mesh_squared_distance(queries, lifted, faces[index].astype(np.int64))[1])]
    return face, np.asarray(igl.barycentric_coordinates(queries, *(lifted[faces[face, k]] for k in range(3))))


def _axes(jacobian: Float[np.ndarray, "q 3 2"], normal: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, "q 2 3"]:
    tangent = jacobian - normal[:, :, None] * np.einsum("qx,qxu->qu", normal, jacobian)[:, None, :]
    left, _, right = np.linalg.svd(tangent, full_matrices=False)
    return np.swapaxes(left @ right, 1, 2)


def _seated(
    sheet: Sheet, pos: Float[np.ndarray, "taxel 3"], normal: Float[np.ndarray, "taxel 3"]
) -> tuple[Int[np.ndarray, " taxel"], Float[np.ndarray, "taxel 3"]]:
    """Return the triangle that each taxel sits on, and the barycentric coordinates of the place.

    Raises:
        LowerError: A taxel is farther than `MAX_OFFSET` from the surface or outside its edge.
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
        near = facing[((low[facing] <= point + MAX_OFFSET) & (point - MAX_OFFSET <= high[facing])).all(axis=1)]
        facing = near if len(near) else facing
        if not len(facing):
            raise refused(
                f"taxel {i} is not on the pad: no part of it faces as the taxel does",
                "give a region that holds all taxels of the link",
            )
        nearest = igl.point_mesh_squared_distance(point[None], sheet.vertices, sheet.faces[facing])
        best, place = (np.asarray(part) for part in nearest[1:])
        face[i] = facing[best[0]]
        at = weights[i] = np.asarray(igl.barycentric_coordinates(place, *corners[face[i], :, None]))[0]
        offset = point - place[0]
        rim = (is_open[face[i]] & (np.roll(at, 1) < 1e-9)).any()  # side k is opposite corner k − 1
        beside = float(np.linalg.norm(offset - (offset @ up[face[i]]) * up[face[i]]))
        _check_seat(i, float(np.linalg.norm(offset)), beside if rim else 0.0)
    return face, weights


def _check_seat(taxel: int, distance: float, beside: float) -> None:
    """Refuse a taxel that is too far from the surface, or too far outside its edge [m]."""
    if distance <= MAX_OFFSET and beside <= BESIDE:
        return
    place, limit = ("off the pad's surface", MAX_OFFSET) if distance > MAX_OFFSET else ("beside the pad's edge", BESIDE)
    raise refused(
        f"taxel {taxel} is {1e3 * distance:.3g} mm {place}, {1e3 * limit:.3g} mm are allowed",
        "give a region that holds all taxels of the link",
    )
