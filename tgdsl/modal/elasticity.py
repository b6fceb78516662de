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

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree
from skfem import ElementHex2

from tgdsl.modal.cells import POINTS, Crossings, Filled, Lines, gauss, refused
from tgdsl.modal.modes import interpolated

_ELEMENT = ElementHex2()
NODES = 27


def _shape_functions(pos: Float[np.ndarray, "point 3"]) -> tuple[np.ndarray, np.ndarray]:
    results = [_ELEMENT.lbasis(pos.T, node) for node in range(NODES)]
    return np.stack([value for value, _ in results]), np.stack([gradient for _, gradient in results])


@dataclass(frozen=True, eq=False)
class Elements:
    """Finite elements on the cells that a body fills."""

    filled: Filled  # the cells
    nodes: Int[np.ndarray, "cell 27"]  # nodes of each
    pos: Float[np.ndarray, "node 3"]  # where the nodes are

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
        weight = _shape_functions(within)[0].T.ravel()
        starts = NODES * np.arange(len(cell) + 1)
        weights = csr_array((weight, self.nodes[cell].ravel(), starts), shape=(len(cell), len(self.pos)))
        return (weights @ values.reshape(len(self.pos), -1)).reshape(len(cell), 3, values.shape[1])


SHIFT = -1e-3  # shift of the eigenvalues: below all of them, so that the factorised matrix is positive definite
RIGID = 1e-7
"""Eigenvalue below which a mode is a rigid motion: rounding makes it 1e-11 to 1e-9, bending of a rod 1 : 1,000 is at 4e-5."""
NUM_RIGID = 6
RESIDUAL = 1e-7
"""Relative residual at which the iteration ends; eigenvalues are then right to its square, mode shapes to about that."""
BLOCK = 12  # vectors that are iterated together: no fewer than modes may have one frequency
DEPENDENT = 1e-20  # squared length below which a vector depends on others, over the largest
FAINT = 1e-13
"""Unknowns whose mass is less than this share of the largest are held at 0: the body hardly reaches into their cells."""

Solve = Callable[[np.ndarray], np.ndarray]  # solves with a factorised matrix, for several right-hand sides


@dataclass(frozen=True, eq=False)
class Vibration:
    """Modes of vibration by ascending frequency, rigid motions left out."""

    wave_number: Float[np.ndarray, " mode"]  # ω L/c
    shape: Float[np.ndarray, "dof mode"]  # displacements of the unknowns, of unit modal mass


def vibration(stiffness: csc_array, mass: csc_array, count: int) -> Vibration:
    """Return the lowest modes of a free body.

    The lowest modes of vibration of a free body: generalised eigenproblem by shift and inversion, rigid motions told apart.

    In units of the body's size, and with E = 1 and ρ = 1: eigenvalues are (ω L/c)² with c = √(E/ρ). Shapes: `dof` unknowns,
    `mode`.

    Args:
        stiffness: "dof dof".
        mass: "dof dof".
        count: How many, rigid motions not counted; fewer if there are not so many unknowns.

    Raises:
        LowerError: If the body has other than six rigid motions, or the iteration does not converge.
    """
    diagonal = mass.diagonal()
    held = diagonal > FAINT * diagonal.max()
    # Scaled to a unit diagonal, so that unknowns of hardly filled cells do not spoil the condition.
    scale = diags_array(1 / np.sqrt((stiffness.diagonal() - SHIFT * diagonal)[held]))
    inner_stiffness, inner_mass = (csc_array(scale @ matrix[held][:, held] @ scale) for matrix in (stiffness, mass))
    factor = splu(
        csc_array(inner_stiffness - SHIFT * inner_mass),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    value, vector = _lowest(inner_mass, factor.solve, min(count + NUM_RIGID, int(held.sum())))
    vector = scale @ vector
    rigid = int((value < RIGID).sum())
    if rigid != NUM_RIGID:
        raise refused(f"it has {rigid} motions without strain, a free body in one piece has {NUM_RIGID}", "join its parts")
    shape = np.zeros((len(diagonal), len(value)))
    shape[held] = vector
    return Vibration(np.sqrt(value[NUM_RIGID:]), shape[:, NUM_RIGID:])


def _lowest(mass: csc_array, solve: Solve, count: int) -> tuple[Float[np.ndarray, " mode"], Float[np.ndarray, "dof mode"]]:
    """Return eigenvalues and eigenvectors, of multiple eigenvalues all, by Lanczos' iteration of a block of vectors."""
    # scipy's `eigsh` iterates one vector, and ends before it has found all of multiple eigenvalues: of a ball four of five.
    size = len(mass.diagonal())
    most = min(size, 6 * count + 10 * BLOCK)
    basis, projected = np.zeros((size, most)), np.zeros((most, most))
    block, _ = _orthonormal(np.random.default_rng(0).standard_normal((size, min(BLOCK, size))), mass)
    dim = 0
    while block.shape[1] and dim + block.shape[1] <= most:
        columns = slice(dim, dim + block.shape[1])
        basis[:, columns] = block
        dim = columns.stop
        new = solve(mass @ block)
        for _ in range(2):
            along = basis[:, :dim].T @ (mass @ new)
            projected[:dim, columns] += along
            new -= basis[:, :dim] @ along
        block, rest = _orthonormal(new, mass)
        inverse, vector = np.linalg.eigh(projected[:dim, :dim], UPLO="U")
        inverse, vector = inverse[::-1][:count], vector[:, ::-1][:, :count]
        error = np.linalg.norm(rest @ vector[columns], axis=0)
        if dim >= count and (error <= RESIDUAL * inverse).all():
            return SHIFT + 1 / inverse, basis[:, :dim] @ vector
    raise refused("the iteration for its modes does not converge", "repair the mesh")


def _orthonormal(vectors: np.ndarray, mass: csc_array) -> tuple[np.ndarray, np.ndarray]:
    """Return an orthonormal basis of some vectors, and them in it; what depends on the others is left out."""
    square, rotation = np.linalg.eigh(vectors.T @ (mass @ vectors))
    is_independent = square > DEPENDENT * square.max(initial=0.0)
    scale = np.sqrt(square[is_independent])
    return vectors @ (rotation[:, is_independent] / scale), scale[:, None] * rotation[:, is_independent].T


ALONG = (9, 17, 25, 33, 49, 65, 97)  # nodes on the longest side that are tried
MAX_NODES = 6000  # most nodes of a grid: 2.3 MB for 32 fields
TOLERANCE = 0.01  # error of a field, over the root mean square of its group, with which a grid is fine enough
TRUSTED = 0.25  # share of a cell that is filled above which its displacement is used throughout; of others only on the surface
MAX_POINTS = 4000  # points of the surface at which the error is measured


@dataclass(frozen=True, eq=False)
class ShapeGrid:
    """Fields at the nodes of a grid."""

    low: Float[np.ndarray, " 3"]  # place of its first node
    step: Float[np.ndarray, " 3"]  # spacing of the nodes along each axis
    num: Int[np.ndarray, " 3"]  # number of nodes along each axis, two or more
    value: Float[np.ndarray, "node 3 field"]  # the fields there, as vectors
    error: Float[np.ndarray, " field"]  # root mean square of what interpolation is off by along the normal


def on_grid(elements: Elements, crossings: Crossings, lines: Lines, fields: Float[np.ndarray, "dof field"]) -> ShapeGrid:
    """Return fields on a grid through the box of a body.

    Mode shapes on a grid through a body, interpolated between its nodes: how strongly modes are struck where, and along what.

    Displacement is smooth within a body, from one side of a wall to the other too, so eight nodes around a point do, and a
    direction says which side it is of. A node outside the body has what the nearest point of its surface has. The spacing is
    the first of `ALONG` nodes on the longest side with which the largest of the fields' errors is within `TOLERANCE`, or the
    finest of at most `MAX_NODES` nodes. Errors are of the component along the normal, root mean squares over points of the
    surface that are no nodes.

    Everything is in the grid's axes, and in units of the body's size. Shapes: `node` nodes of the grid, z running fastest,
    `dof` unknowns of the elements, `field` fields as `modes.loudness` has them, `x` points of the surface.

    Args:
        elements: The body's.
        crossings: Points of its surface.
        lines: The planes between its cells.
        fields: Values of the elements' unknowns.
    """
    low, high = np.array([line[0] for line in lines]), np.array([line[-1] for line in lines])
    every = slice(None, None, -(-len(crossings.cell) // MAX_POINTS))
    at, normal, area = crossings.pos[every], crossings.normal[every], crossings.area[every]
    exact = np.einsum("xif,xi->xf", elements.displacement(crossings.cell[every], at, fields), normal)
    near, best = KDTree(crossings.pos), None
    for along in ALONG:
        num = np.maximum(np.rint((high - low) / (high - low).max() * (along - 1)).astype(np.int64) + 1, 2)
        if best is not None and num.prod() > MAX_NODES:
            break
        step = (high - low) / (num - 1)
        node = np.stack(np.meshgrid(*(np.arange(count) for count in num), indexing="ij"), axis=-1).reshape(-1, 3)
        value = _at(elements, crossings, near, lines, low + node * step, fields).astype(np.float32)
        off = np.einsum("xif,xi->xf", interpolated(low, step, num, value, at), normal) - exact
        error = np.sqrt(area @ off**2 / area.sum())
        best = ShapeGrid(low, step, num, value, error)
        if (error <= TOLERANCE).all():
            break
    assert best is not None
    return best


def _at(
    elements: Elements, crossings: Crossings, near: KDTree, lines: Lines, pos: Float[np.ndarray, "node 3"], fields: np.ndarray
) -> Float[np.ndarray, "node 3 field"]:
    """Return fields at points: of the elements within the body's cells, elsewhere of the nearest surface point."""
    filled = elements.filled
    row = np.full([len(line) - 1 for line in lines], -1)
    is_trusted = filled.weight.sum(axis=1) > TRUSTED
    row[tuple(filled.index[is_trusted].T)] = np.flatnonzero(is_trusted)
    index = [
        np.clip(np.searchsorted(line, part, side="right") - 1, 0, len(line) - 2)
        for line, part in zip(lines, pos.T, strict=True)
    ]
    cell = row[tuple(index)]
    outside = cell < 0
    _, nearest = near.query(pos[outside])
    cell[outside] = crossings.cell[nearest]
    pos = pos.copy()
    pos[outside] = crossings.pos[nearest]
    return elements.displacement(cell, pos, fields)
