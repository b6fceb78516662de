"""The lowest modes of vibration of a free body: generalised eigenproblem by shift and inversion, rigid motions told apart.

In units of the body's size, and with E = 1 and ρ = 1: eigenvalues are (ω L/c)² with c = √(E/ρ). Shapes: `dof` unknowns, `mode`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from tgdsl.modal.closed import refused

SHIFT = -1e-3
"""Shift of the eigenvalues: below all of them, so that the factorised matrix is positive definite."""
RIGID = 1e-7
"""Eigenvalue below which a mode is a rigid motion: rounding makes it 1e-11 to 1e-9, bending of a rod 1 : 1,000 is at 4e-5."""
NUM_RIGID = 6
TOLERANCE = 1e-7
"""Relative residual at which the iteration ends; eigenvalues are then right to its square, mode shapes to about that."""
BLOCK = 12
"""Vectors that are iterated together: no fewer than modes may have one frequency."""
DEPENDENT = 1e-20
"""Squared length below which a vector depends on others, over the largest."""
FAINT = 1e-13
"""Unknowns whose mass is less than this share of the largest are held at 0: the body hardly reaches into their cells."""

Solve = Callable[[np.ndarray], np.ndarray]
"""Solves with a factorised matrix, for several right-hand sides."""


@dataclass(frozen=True, eq=False)
class Vibration:
    """Modes of vibration by ascending frequency, rigid motions left out.

    Attributes:
        wave_number: ω L/c.
        shape: Displacements of the unknowns, of unit modal mass.
    """

    wave_number: Float[np.ndarray, " mode"]
    shape: Float[np.ndarray, "dof mode"]


def vibration(stiffness: csc_array, mass: csc_array, count: int) -> Vibration:
    """Return the lowest modes of a free body.

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
    """Return eigenvalues and eigenvectors, of multiple eigenvalues all, by Lanczos' iteration of a block of vectors.

    scipy's `eigsh` iterates one vector, and ends before it has found all vectors of the multiple eigenvalues that symmetric
    bodies have: of a ball four of five.
    """
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
        if dim >= count and (error <= TOLERANCE * inverse).all():
            return SHIFT + 1 / inverse, basis[:, :dim] @ vector
    raise refused("the iteration for its modes does not converge", "repair the mesh")


def _orthonormal(vectors: np.ndarray, mass: csc_array) -> tuple[np.ndarray, np.ndarray]:
    """Return an orthonormal basis of some vectors, and them in it; what depends on the others is left out."""
    square, rotation = np.linalg.eigh(vectors.T @ (mass @ vectors))
    is_independent = square > DEPENDENT * square.max(initial=0.0)
    scale = np.sqrt(square[is_independent])
    return vectors @ (rotation[:, is_independent] / scale), scale[:, None] * rotation[:, is_independent].T
