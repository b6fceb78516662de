"""How strongly modes are struck and heard: mode shapes along the surface's normal, and modes of one frequency taken together.

Modes whose frequencies are nearer than `ALIKE` are one: a square plate, a can or a ball has pairs and multiplets that symmetry
makes equal, any mixture of which is a mode as well. What is computed for a group is the same for all mixtures. With φ the
column of its mode shapes along the surface's normal and M = (1/A) ∫ φ φᵀ dA their mean products over it, an impulse J at the
point x makes all of them ring in phase, at amplitudes φ(x) J; the root mean square over the surface of what is then heard is

    √(φᵀ(x) M φ(x)) J,   and its root mean square over all x   g J,   g = ‖M‖ = √(Σ M_ij²)

For a single mode these are |φ(x)| a J and a² J, where a² is the mean of φ². Groups that hardly move the surface along its
normal, such as torsion of a ball, are left out: they are neither struck nor heard.

Shapes: `x` points of the surface, `mode` modes, `group` groups of modes of one frequency.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tgdsl.modal.cells import Crossings

INAUDIBLE = 1e-3
"""Gain below which a group is left out, over the largest gain."""
ALIKE = 1e-3
"""Relative difference of frequencies up to which modes are one: less than the elements resolve."""


@dataclass(frozen=True, eq=False)
class Loudness:
    """Modes of one frequency taken together.

    Attributes:
        wave_number: ω L/c, root mean square of each group.
        multiplicity: How many modes it has.
        gain: g, per mass of the body: dimensionless.
        share: √(φᵀ M φ)/g at points of the surface; of a single mode φ/a with its sign.
    """

    wave_number: Float[np.ndarray, " group"]
    multiplicity: Int[np.ndarray, " group"]
    gain: Float[np.ndarray, " group"]
    share: Float[np.ndarray, "x group"]


def groups(wave_number: Float[np.ndarray, " mode"]) -> list[slice]:
    """Return which modes, by ascending frequency, are one: those up to `ALIKE` above the first of them."""
    found, start = [], 0
    for mode in range(1, len(wave_number) + 1):
        if mode == len(wave_number) or wave_number[mode] > (1 + ALIKE) * wave_number[start]:
            found.append(slice(start, mode))
            start = mode
    return found


def loudness(
    wave_number: Float[np.ndarray, " mode"], normal: Float[np.ndarray, "x mode"], area: Float[np.ndarray, " x"], mass: float
) -> Loudness:
    """Return the groups of modes that are heard; the last one, which more modes could belong to, is left out.

    Args:
        wave_number: Of each mode, ascending.
        normal: Mode shapes of unit modal mass along the normals.
        area: Surface that each point stands for.
        mass: The body's.
    """
    found = groups(wave_number)[:-1]
    gain, share = np.zeros(len(found)), np.zeros((len(area), len(found)))
    for i, own in enumerate(found):
        shape = normal[:, own] * np.sqrt(mass)
        products = (shape * area[:, None]).T @ shape / area.sum()
        gain[i] = np.linalg.norm(products)
        if shape.shape[1] == 1:
            share[:, i] = signed(shape[:, 0]) / np.sqrt(gain[i]) if gain[i] > 0 else 0.0
        elif gain[i] > 0:
            share[:, i] = np.sqrt(np.maximum(np.einsum("xi,ij,xj->x", shape, products, shape), 0.0)) / gain[i]
    square = np.array([np.mean(wave_number[own] ** 2) for own in found])
    multiplicity = np.array([own.stop - own.start for own in found], np.int64)
    heard = gain > INAUDIBLE * gain.max(initial=0.0)
    return Loudness(np.sqrt(square)[heard], multiplicity[heard], gain[heard], share[:, heard])


def signed(shape: Float[np.ndarray, " x"]) -> Float[np.ndarray, " x"]:
    """Return a mode shape with the sign that makes it positive at the first of its points that are about the largest."""
    size = np.abs(shape)
    first = int(np.argmax(size > (1 - 1e-6) * size.max(initial=0.0)))
    return shape if not len(shape) or shape[first] >= 0 else -shape


def picked(crossings: Crossings) -> Int[np.ndarray, " x"]:
    """Return one point for each cell and side that its surface faces: the one nearest to the middle of these points."""
    axis = np.abs(crossings.normal).argmax(axis=1)
    faces_up = crossings.normal[np.arange(len(axis)), axis] > 0
    _, which = np.unique(6 * crossings.cell + 2 * axis + faces_up, return_inverse=True)
    which = which.reshape(-1)
    count = np.bincount(which)
    middle = np.stack([np.bincount(which, part) / count for part in crossings.pos.T], axis=1)
    off = np.linalg.norm(crossings.pos - middle[which], axis=1)
    order = np.lexsort((off, which))
    return order[np.concatenate([[0], np.cumsum(count)[:-1]])]
