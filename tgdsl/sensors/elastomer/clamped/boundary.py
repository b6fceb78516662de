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
from scipy.sparse import block_diag, bmat, csr_matrix
from scipy.sparse.linalg import splu
from skfem import BilinearForm
from skfem.helpers import dot

from tgdsl.sensors.elastomer.clamped.mesh import MAX_CORNERS
from tgdsl.sensors.elastomer.clamped.pad import Pad
from tgdsl.sensors.elastomer.clamped.sheet import refused

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
