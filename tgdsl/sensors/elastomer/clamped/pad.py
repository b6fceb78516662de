"""An elastomer pad laid flat: where its edge is, where its taxels are, and triangles between them.

The surface that was declared as the pad is unrolled to the plane and remeshed with quadratic triangles. Fields on the plane
are along two axes, whose directions at each taxel and at each point of the edge tie them to the body frame: parallel on a flat
pad, along and across the arc on a cylinder.

Shapes: `taxel` taxels, `node` nodes of the elements, `edge` nodes on the pad's edge, `m` elements, `f` triangles of the
surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import block_diag, bmat, csr_matrix
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay, KDTree
from skfem import BilinearForm, CellBasis, ElementTriP2, MeshTri
from skfem.helpers import dot

from tgdsl.sensors.elastomer.clamped.sheet import Sheet, flatten, has_area, jacobians, open_sides, opened, refused, welded
from tgdsl.surfaces.surface import Surface

MAX_CORNERS = 20_000  # bound on the corners of all triangles; the finite elements have four nodes for each
MAX_CELLS = 1_000_000  # bound on the area of the pad's bounding box over the square of the element size
SHAPE = 0.05  # how far the meshed edge may be from the pad's own, in element sizes
GRADE = 0.5  # growth of the size of triangles with the distance from the edge
COARSEST = 3  # inside, triangles are at most 2^this element sizes large
CLEARANCE = 0.6  # distance of inner points from the edge, in element sizes
BISECTIONS = 40  # times that pieces of the edge may be bisected


def mesh(outline: list[Float[np.ndarray, "n 2"]], size: float) -> MeshTri:
    """Return triangles of about `size` [m] at the edge that fill the closed loops of `outline` [m].

    Remeshing a region of the plane: triangles that are fine along the edge, where a clamped field varies, and coarser inside.

    The edge is thinned to the vertices that give it its shape and cut into pieces no longer than the element size; inside stand
    the points of nested triangular lattices: those with a spacing of 2^k sizes where the edge is at least 2^k / `GRADE` sizes
    away; Delaunay's triangulation joins them, pieces of the edge that it misses are bisected, and what lies outside is removed.
    Neither scikit-fem nor libigl meshes an outline, and the meshers that do are not under a free licence.

    Shapes: `n` vertices of a loop, `p` points, `m` triangles, `seg` pieces of the edge.

    Raises:
        LowerError: There would be more than `MAX_CORNERS` corners, or no triangulation keeps to the edge.
    """
    points, pieces = _edge([loop / size for loop in outline])
    inner = _inside(points, pieces)
    if len(points) + len(inner) > MAX_CORNERS:
        raise refused(
            f"the pad needs {len(points) + len(inner)} corners of triangles at an element size of {1e3 * size:.3g} mm, "
            f"{MAX_CORNERS} are allowed",
            "give a smaller region, a larger thickness or less drag",
        )
    triangulation = _triangulation(points, inner)
    for _ in range(BISECTIONS - 1):
        missing = ~np.isin(_sides(pieces), _sides(np.asarray(triangulation.facets).T))
        if not missing.any():
            break
        points, pieces = _bisected(points, pieces, missing)
        triangulation = _triangulation(points, inner)
    middles = np.asarray(triangulation.p).T[np.asarray(triangulation.t).T].mean(axis=1)
    within = np.flatnonzero(_is_within(middles, points, pieces))
    _check_edge(triangulation, within, pieces)
    inside = triangulation.restrict(within)
    assert isinstance(inside, MeshTri)
    return inside.scaled(size)


def _triangulation(points: np.ndarray, inner: np.ndarray) -> MeshTri:
    """Return Delaunay's triangulation of corners, without triangles that have no area."""
    corners = np.concatenate([points, inner])
    triangles = Delaunay(corners).simplices.astype(np.int64)
    triangles = triangles[np.abs(igl.doublearea(corners, triangles)) > 1e-7]
    return MeshTri(np.ascontiguousarray(corners.T), np.ascontiguousarray(triangles.T), sort_t=False)


def _sides(ends: Int[np.ndarray, "seg 2"]) -> Int[np.ndarray, " seg"]:
    return np.sort(ends, axis=1).astype(np.int64) @ [1 << 32, 1]


def _edge(outline: list[Float[np.ndarray, "n 2"]]) -> tuple[Float[np.ndarray, "p 2"], Int[np.ndarray, "seg 2"]]:
    """Return points along the loops, at most one apart, and the pieces between them; points that coincide are one."""
    loops = [_sampled(loop) for loop in outline]
    points = np.concatenate(loops)
    after = np.concatenate([np.roll(np.arange(len(loop)), -1) + at for loop, at in zip(loops, _starts(loops), strict=True)])
    same = np.arange(len(points))
    for first, second in sorted(KDTree(points).query_pairs(1e-6)):
        same[second] = same[first]
    distinct, index = np.unique(same, return_inverse=True)
    pieces = np.stack([index, index[after]], axis=1)
    return points[distinct], pieces[pieces[:, 0] != pieces[:, 1]].astype(np.int64)


def _starts(parts: list[np.ndarray]) -> Int[np.ndarray, " part"]:
    return np.cumsum([0, *map(len, parts)])[:-1]


def _sampled(loop: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "p 2"]:
    """Return points on a loop: the vertices that give it its shape, and points evenly between them along the loop."""
    into, out = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    bend = np.abs(np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], (into * out).sum(axis=1)))
    loop = np.roll(loop, -int(np.argmax(bend)), axis=0)
    closed = np.concatenate([loop, loop[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    far = int(np.argmax(np.linalg.norm(loop - loop[0], axis=1)))
    # Douglas and Peucker, 1973
    halves = (igl.ramer_douglas_peucker(np.ascontiguousarray(half), SHAPE)[1] for half in (closed[: far + 1], closed[far:]))
    corners = np.unique(np.concatenate([at + np.asarray(half) for at, half in zip((0, far), halves, strict=True)]))
    places = [
        np.linspace(way[a], way[b], max(1, int(np.ceil(way[b] - way[a] - 1e-6))), endpoint=False) for a, b in pairwise(corners)
    ]
    place = np.concatenate(places)
    return np.stack([np.interp(place, way, closed[:, k]) for k in range(2)], axis=1)


def _inside(points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"]) -> Float[np.ndarray, "q 2"]:
    """Return the points of nested triangular lattices within the edge, unit spacing along it."""
    low, high = points.min(axis=0), points.max(axis=0)
    if float(np.prod(high - low)) > MAX_CELLS:
        raise refused(
            f"the pad is {high[0] - low[0]:.0f} by {high[1] - low[1]:.0f} elements large, "
            f"more than {MAX_CORNERS} corners of triangles would be needed",
            "give a smaller region, a larger thickness or less drag",
        )
    rows = int(np.ceil((high - low)[1] / np.sqrt(0.75))) + 1
    columns = int(np.ceil((high - low)[0])) + rows + 1
    i, j = (index.ravel() for index in np.meshgrid(np.arange(-rows // 2, columns), np.arange(rows), indexing="ij"))
    lattice = low + np.stack([i + 0.5 * j, np.sqrt(0.75) * j], axis=1)
    boxed = (lattice < high).all(axis=1) & (lattice > low).all(axis=1)
    i, j, lattice = i[boxed], j[boxed], lattice[boxed]
    distance = KDTree(_dense(points, pieces)).query(lattice, distance_upper_bound=2**COARSEST / GRADE)[0]  # beyond: inf
    level = np.clip(np.floor(np.log2(np.maximum(GRADE * distance, 1.0))), 0, COARSEST).astype(np.int64)
    is_used = ((i | j) % (1 << level) == 0) & (distance > CLEARANCE)
    lattice = lattice[is_used]
    return lattice[_is_within(lattice, points, pieces)]


def _dense(points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"]) -> Float[np.ndarray, "more 2"]:
    a, b = points[pieces[:, 0]], points[pieces[:, 1]]
    return np.concatenate([a + part * (b - a) for part in np.arange(4) / 4])


def _is_within(
    where: Float[np.ndarray, "q 2"], points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"]
) -> Bool[np.ndarray, " q"]:
    return np.abs(igl.winding_number(points, pieces, where)) > 0.5


def _bisected(
    points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"], which: Bool[np.ndarray, " seg"]
) -> tuple[Float[np.ndarray, "more 2"], Int[np.ndarray, "pieces 2"]]:
    """Return the edge with some pieces cut in the middle."""
    cut = pieces[which]
    middle = len(points) + np.arange(len(cut))
    halves = [np.stack([cut[:, 0], middle], axis=1), np.stack([middle, cut[:, 1]], axis=1)]
    return np.concatenate([points, points[cut].mean(axis=1)]), np.concatenate([pieces[~which], *halves])


def _check_edge(mesh: MeshTri, within: Int[np.ndarray, " m"], pieces: Int[np.ndarray, "seg 2"]) -> None:
    """Refuse triangles of a mesh whose edge is not the region's."""
    facet, count = np.unique(np.asarray(mesh.t2f)[:, within], return_counts=True)
    wrong = np.setxor1d(_sides(np.asarray(mesh.facets).T[facet[count == 1]]), _sides(pieces))
    if not len(within) or len(wrong):
        raise refused(
            f"no triangles fill the pad: {len(wrong)} pieces of its edge do not bound the mesh",
            "its outline may have spikes or slits; select a region with a plain outline",
        )


MAX_OFFSET = 1e-3  # largest distance of a taxel from the pad's surface [m]
BESIDE = 1e-4  # largest distance of a taxel from the pad's edge, measured outwards along the surface [m]
FACING = 0.5  # least cosine between a taxel's normal and the surface normal under it


@dataclass(frozen=True, eq=False)
class Pad:
    """A pad in the plane, and how the plane lies on the body."""

    basis: CellBasis  # quadratic elements in the plane [m]; nodes are their degrees of freedom
    edge: Int[np.ndarray, " edge"]  # nodes on the pad's edge, ascending
    at_taxels: csr_matrix  # matrix from values at the nodes to values at the taxels
    edge_pos: Float[np.ndarray, "edge 3"]  # place of each node of `edge` on the surface, body frame [m]
    edge_normal: Float[np.ndarray, "edge 3"]  # outward unit normal of the surface there, body frame
    edge_axes: Float[np.ndarray, "edge 2 3"]  # unit tangents along the two axes of the plane there, body frame
    taxel_axes: Float[np.ndarray, "taxel 2 3"]  # the same at each taxel, perpendicular to the taxel's own normal


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
    """Return the triangle that each taxel sits on, and the barycentric coordinates of the place."""
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


PER_LAYER = 4  # elements across the boundary layer
PER_EXTENT = 24  # elements along the pad, where it is not much larger than its boundary layer
CORNERS_PER_LENGTH = 9  # corners of triangles for each element along the edge, counted on graded meshes


def element_size(thickness: float, drag: float, extent: float) -> float:
    """Return the length of elements at the edge of a pad [m]: a quarter of the boundary layer t/√β, or finer on a small pad.

    Args:
        thickness: t [m].
        drag: β [1]; 0 for a pad that slides freely on its back.
        extent: Length of the pad [m]; the diagonal of its region's bounding box is on the safe side.

    Raises:
        LowerError: A square pad of this extent would need more than `MAX_CORNERS` corners of elements.
    """
    layer = thickness / np.sqrt(drag) if drag > 0 else np.inf
    size = float(min(layer / PER_LAYER, extent / PER_EXTENT))
    corners = CORNERS_PER_LENGTH * 4 * extent / size
    if corners > MAX_CORNERS:
        raise refused(
            f"a boundary layer of {1e3 * layer:.3g} mm (thickness {1e3 * thickness:.3g} mm over √{drag:.3g}) along a pad of "
            f"{1e3 * extent:.3g} mm needs elements of {1e3 * size:.3g} mm and about {corners:.0f} corners, "
            f"{MAX_CORNERS} are allowed",
            "give a smaller region, a larger thickness or less drag",
        )
    return size


def correction(pad: Pad, thickness: float, drag: float, bulk: float) -> Float[np.ndarray, "two_taxel two_edge"]:
    """Return the matrix from displacements of the edge's nodes to displacements of the taxels, [u, v] to [u, v].

    The clamped boundary of an elastomer pad: how a displacement of its edge spreads to the taxels.

        −∇²u + (β/t²) u − K ∇(∇·u) = 0   inside the pad,   u given on its edge

    u in-plane displacement [m], t thickness of the elastomer [m], β drag of the bonded back [1], K resistance to in-plane
    compression [1]. A displacement of the edge decays inwards over t/√β; a part along its own gradient over √(1 + K) t/√β. The
    map from the edge to the taxels is linear and fixed: quadratic finite elements give it as one matrix.

    Source: Chung et al., *Tactile Genesis*, appendix, "Clamped boundary condition". Departure: solved on the pad's own outline
    and on curved pads after unrolling, not on the taxels' regular grid.

    Shapes: `taxel` taxels, `edge` nodes on the pad's edge, `m` elements; vectors of displacements hold u of all, then v of all.

    Args:
        pad: The pad.
        thickness: t [m].
        drag: β [1].
        bulk: K [1].
    """
    apart = csr_matrix(BilinearForm(lambda u, v, _: dot(u.grad, v.grad) + drag / thickness**2 * u * v).assemble(pad.basis))
    if bulk == 0:
        return np.kron(np.eye(2), _spread(apart, pad.at_taxels, pad.edge))
    xx, xy, yy = (
        BilinearForm(lambda u, v, _, i=i, j=j: bulk * v.grad[i] * u.grad[j]).assemble(pad.basis)
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    edge = np.concatenate([pad.edge, pad.edge + pad.basis.N])
    stiffness = csr_matrix(bmat([[apart + xx, xy], [xy.T, apart + yy]]))
    return _spread(stiffness, csr_matrix(block_diag([pad.at_taxels] * 2)), edge)


def _spread(stiffness: csr_matrix, at_taxels: csr_matrix, edge: np.ndarray) -> np.ndarray:
    """Return values at taxels for unit values at edge nodes: W_e − W_i A_ii⁻¹ A_ie, by one solve for each taxel."""
    inner = np.setdiff1d(np.arange(len(stiffness.indptr) - 1), edge)
    if not len(inner):
        return at_taxels[:, edge].toarray()
    rows = stiffness[inner]
    factor = splu(
        rows[:, inner].tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    adjoint = factor.solve(at_taxels[:, inner].toarray().T)
    return at_taxels[:, edge].toarray() - (rows[:, edge].T @ adjoint).T
