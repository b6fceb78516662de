"""The clamped boundary of an elastomer pad: how a displacement of its edge spreads to the taxels.

    −∇²u + (β/t²) u − K ∇(∇·u) = 0   inside the pad,   u given on its edge

u in-plane displacement [m], t thickness of the elastomer [m], β drag of the bonded back [1], K resistance to in-plane
compression [1]. A displacement of the edge decays inwards over t/√β; a part along its own gradient over √(1 + K) t/√β. The map
from the edge to the taxels is linear and fixed: quadratic finite elements give it as one matrix.

Source: Chung et al., *Tactile Genesis*, appendix, "Clamped boundary condition". Departure: solved on the pad's own outline and
on curved pads after unrolling, not on the taxels' regular grid.

Shapes: `taxel` taxels, `edge` nodes on the pad's edge, `m` elements; vectors of displacements hold u of all, then v of all.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.sparse import bmat, coo_matrix, csr_matrix
from scipy.sparse.linalg import splu

from tgdsl.sensors.elastomer.mesh import MAX_CORNERS
from tgdsl.sensors.elastomer.pad import Pad
from tgdsl.sensors.elastomer.sheet import refused

PER_LAYER = 4
"""Elements across the boundary layer."""
PER_EXTENT = 24
"""Elements along the pad, where it is not much larger than its boundary layer."""
CORNERS_PER_LENGTH = 9
"""Corners of triangles for each element along the edge, counted on graded meshes."""


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

    Args:
        pad: The pad.
        thickness: t [m].
        drag: β [1].
        bulk: K [1].
    """
    xx, xy, yy, mass = _integrals(pad)
    taxel = np.repeat(np.arange(len(pad.taxel_nodes)), 6)
    shape = (len(pad.taxel_nodes), len(pad.nodes))
    at_taxels = csr_matrix(coo_matrix((pad.taxel_weights.ravel(), (taxel, pad.taxel_nodes.ravel())), shape=shape))
    apart = xx + yy + drag / thickness**2 * mass
    if bulk == 0:
        one = _spread(apart, at_taxels, pad.edge)
        return np.block([[one, np.zeros_like(one)], [np.zeros_like(one), one]])
    stiffness = csr_matrix(bmat([[apart + bulk * xx, bulk * xy], [bulk * xy.T, apart + bulk * yy]]))
    edge = np.concatenate([pad.edge, pad.edge + len(pad.nodes)])
    return _spread(stiffness, csr_matrix(bmat([[at_taxels, None], [None, at_taxels]])), edge)


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


def _integrals(pad: Pad) -> tuple[csr_matrix, csr_matrix, csr_matrix, csr_matrix]:
    """Return ∫ ∂x φi ∂x φj, ∫ ∂x φi ∂y φj, ∫ ∂y φi ∂y φj and ∫ φi φj [m²] over the pad."""
    corners = pad.nodes[pad.triangles[:, :3]]
    side = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)  # opposite each corner
    twice = side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]
    slope = np.stack([-side[:, :, 1], side[:, :, 0]], axis=2) / twice[:, None, None]  # of each barycentric coordinate
    stiffness, mass = _reference()
    both = np.einsum("m,max,mby,abij->xymij", 0.5 * twice, slope, slope, stiffness, optimize=True)
    blocks = [both[0, 0], both[0, 1], both[1, 1], 0.5 * twice[:, None, None] * mass]
    row = np.repeat(pad.triangles, 6, axis=1).ravel()
    column = np.tile(pad.triangles, (1, 6)).ravel()
    count = len(pad.nodes)
    xx, xy, yy, m = (csr_matrix(coo_matrix((block.ravel(), (row, column)), shape=(count, count))) for block in blocks)
    return xx, xy, yy, m


def _reference() -> tuple[Float[np.ndarray, "3 3 6 6"], Float[np.ndarray, "6 6"]]:
    """Return the means over a triangle of ∂φi/∂λa ∂φj/∂λb and of φi φj, λ its barycentric coordinates.

    The first by the rule of the sides' middles, exact for quadratic products; the second in closed form (Zienkiewicz and
    Taylor, *The Finite Element Method*, vol. 1: mean of λ1^p λ2^q λ3^r is 2 p! q! r! / (p + q + r + 2)!).
    """
    stiffness = np.zeros((3, 3, 6, 6))
    for at in 0.5 * (1 - np.eye(3)):
        slope = np.zeros((3, 6))
        for k in range(3):
            following = (k + 1) % 3
            slope[k, k] = 4 * at[k] - 1
            slope[k, 3 + k], slope[following, 3 + k] = 4 * at[following], 4 * at[k]
        stiffness += np.einsum("ai,bj->abij", slope, slope) / 3
    apart, opposite = -1 / 180, -4 / 180
    mass = np.full((6, 6), 16 / 180)
    mass[:3, :3] = np.where(np.eye(3, dtype=bool), 6 / 180, apart)
    mass[3:, 3:] += np.eye(3) * 16 / 180
    mass[:3, 3:] = np.where(np.roll(np.eye(3, dtype=bool), 1, axis=1), opposite, 0.0)
    mass[3:, :3] = mass[:3, 3:].T
    return stiffness, mass
