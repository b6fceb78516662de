"""Linear elasticity of a body on the cells that it fills: quadratic elements, integrated over the body alone.

    ∫ λ (∇·u)(∇·v) + 2μ ε(u):ε(v) dV = ω² ∫ ρ u·v dV   for all v,   free of traction all around

The displacement is triquadratic in each cell (27 nodes) and continuous. Both integrals run over the part of each cell that the
body fills, so the surface need not run along the cells: the finite cell method (Parvizian, Düster, Rank, *Finite cell method*,
Computational Mechanics 41, 2007), without its fictitious material around the body, since a free surface needs none. It is
Ritz's method on the body itself: apart from errors of the integrals (`cells.py`), no frequency is below the exact one, and
rigid motions are exact. The mass is consistent.

A mesh of tetrahedra, which thin walls make large or flat, is not needed. fTetWild was tried (pytetwild 0.4.2, MPL-2.0): it
gives another mesh at each run, and cannot be imported without VTK.

In units of the body's size, and with E = 1 and ρ = 1. Shapes: `cell` cells, `node` nodes, `point` integration points of a cell,
`dof` unknowns: x, y, z of the first node, then of the next, `x` points of the surface, `mode` modes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from skfem import ElementHex2

from tgdsl.modal.cells import POINTS, Filled, gauss

_ELEMENT = ElementHex2()
NODES = 27


def _shape_functions(pos: Float[np.ndarray, "point 3"]) -> tuple[np.ndarray, np.ndarray]:
    results = [_ELEMENT.lbasis(pos.T, node) for node in range(NODES)]
    return np.stack([value for value, _ in results]), np.stack([gradient for _, gradient in results])


@dataclass(frozen=True, eq=False)
class Elements:
    """Finite elements on the cells that a body fills.

    Attributes:
        filled: The cells.
        nodes: Nodes of each.
        pos: Where the nodes are.
    """

    filled: Filled
    nodes: Int[np.ndarray, "cell 27"]
    pos: Float[np.ndarray, "node 3"]

    @staticmethod
    def of(filled: Filled) -> Elements:
        """Return the elements; cells that touch share the nodes where they do."""
        local = np.asarray(_ELEMENT.doflocs)
        place = 2 * filled.index[:, None] + np.rint(2 * local).astype(int)
        across = place.reshape(-1, 3).max(axis=0) + 1
        _, first, nodes = np.unique(
            np.ravel_multi_index(tuple(place.reshape(-1, 3).T), tuple(across)), return_index=True, return_inverse=True
        )
        pos = (filled.low[:, None] + filled.size[:, None] * local).reshape(-1, 3)[first]
        return Elements(filled, nodes.reshape(-1, NODES), pos)

    @cached_property
    def part(self) -> Int[np.ndarray, " cell"]:
        """Connected part of the body that each cell belongs to, the one of most volume first."""
        num = len(self.pos)
        ends = np.repeat(self.nodes[:, 0], NODES), self.nodes.ravel()
        _, label = connected_components(coo_array((np.ones(len(ends[0]), bool), ends), (num, num)), directed=False)
        part = label[self.nodes[:, 0]]
        order = np.argsort(-np.bincount(part, self.filled.volume), kind="stable")
        return np.argsort(order)[part]

    def matrices(self, poissons_ratio: float) -> tuple[csc_array, csc_array]:
        """Return stiffness and mass, "dof dof", with E = 1 and ρ = 1."""
        first = poissons_ratio / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio))
        shear = 1 / (2 * (1 + poissons_ratio))
        points = gauss(POINTS)[0]
        value, gradient = _shape_functions(np.stack(np.meshgrid(points, points, points, indexing="ij"), axis=-1).reshape(-1, 3))
        size, num = self.filled.size, len(self.nodes)
        weight = self.filled.weight * size.prod(axis=1)[:, None]

        def integrals(one: np.ndarray, other: np.ndarray) -> np.ndarray:
            products = (one[:, None] * other[None]).reshape(NODES * NODES, -1)
            return (weight @ products.T).reshape(num, NODES, NODES)

        stiffness = np.zeros((num, NODES, 3, NODES, 3))
        for i in range(3):
            for j in range(i, 3):
                integral = integrals(gradient[:, i], gradient[:, j]) / (size[:, i] * size[:, j])[:, None, None]
                stiffness[:, :, i, :, j] += first * integral
                stiffness[:, :, j, :, i] += shear * integral
                if i != j:
                    back = integral.swapaxes(1, 2)
                    stiffness[:, :, j, :, i] += first * back
                    stiffness[:, :, i, :, j] += shear * back
                else:
                    for k in range(3):
                        stiffness[:, :, k, :, k] += shear * integral
        mass = np.zeros_like(stiffness)
        for i in range(3):
            mass[:, :, i, :, i] = integrals(value, value)
        return self._assembled(stiffness), self._assembled(mass)

    def _assembled(self, local: np.ndarray) -> csc_array:
        dofs = (3 * self.nodes[:, :, None] + np.arange(3)).reshape(len(self.nodes), -1)
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        size = 3 * len(self.pos)
        result = csc_array(coo_array((local.ravel(), (rows.ravel(), columns.ravel())), (size, size)))
        result.sum_duplicates()
        result.eliminate_zeros()
        return result

    def displacement(
        self, cell: Int[np.ndarray, " x"], pos: Float[np.ndarray, "x 3"], values: Float[np.ndarray, "dof mode"]
    ) -> Float[np.ndarray, "x 3 mode"]:
        """Return what values of the unknowns are at points in cells."""
        within = (pos - self.filled.low[cell]) / self.filled.size[cell]
        at = values.reshape(len(self.pos), 3, -1)
        value = _shape_functions(within)[0]
        result = np.zeros((len(cell), 3, at.shape[2]))
        for node in range(NODES):
            result += value[node][:, None, None] * at[self.nodes[cell, node]]
        return result
