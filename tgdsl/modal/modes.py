"""Modes of vibration of a body: what an impulse on it makes ring.

An impulse J [N·s] at the time 0 makes the body sound as

    s(t) = J Σ_i g_i e^(−d_i t) sin(2π f_i t)                                                 [m/s]

with the frequency f_i [Hz], the decay rate d_i of the amplitude [1/s], and the gain g_i [1/kg] of each mode. With mode shapes
φ_i normalised to the mass, ∫ρ φ_i² dV = 1, it is g_i = φ_i(struck) φ_i(heard), both by the component along the surface's
normal, and s the pseudo-velocity ω q of the surface: its displacement q times ω = 2πf, which has the amplitude of its velocity
and no jump at the impulse.

Shapes: `mode` modes of one body, `point` points of it, `node` nodes of a grid, z running fastest, `field` fields of
its modes, one of each, and as many as there are mode shapes where symmetry makes these one mode, see `loudness.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class ModeShapes:
    """Mode shapes on a grid through the body, as vectors, over the root mean square of their normal component on the surface.

    Attributes:
        axes: The grid's axes, as rows, of the body's frame.
        low: Place of its first node along these axes [m].
        step: Spacing of its nodes along each [m].
        num: Number of its nodes along each, two or more.
        value: Fields at the nodes, along the grid's axes [1].
        owner: The mode of each field, ascending.
        error: Root mean square over the surface of what interpolation is off by, of each field [1].
    """

    axes: Float[np.ndarray, "3 3"]
    low: Float[np.ndarray, " 3"]
    step: Float[np.ndarray, " 3"]
    num: Int[np.ndarray, " 3"]
    value: Float[np.ndarray, "node 3 field"]
    owner: Int[np.ndarray, " field"]
    error: Float[np.ndarray, " field"]

    def share(self, pos: Float[np.ndarray, "point 3"], along: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point mode"]:
        """Return by how much more or less than by its gain each mode is struck at points, along a direction there [1].

        Args:
            pos: The points, in the body's frame [m].
            along: The direction, of unit length, in the body's frame.
        """
        from tgdsl.modal.loudness import of_groups
        from tgdsl.modal.shapes import interpolated

        result = interpolated(self.low, self.step, self.num, self.value, pos @ self.axes.T)
        return of_groups(np.einsum("xif,xi->xf", result, along @ self.axes.T), self.owner, int(self.owner.max()) + 1)

    def of(self, kept: Bool[np.ndarray, " mode"]) -> ModeShapes:
        """Return the shapes of some modes."""
        mine = kept[self.owner]
        number = np.cumsum(kept) - 1
        return replace(self, value=self.value[:, :, mine], owner=number[self.owner[mine]], error=self.error[mine])


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of a body, by ascending frequency.

    Attributes:
        frequency: f, of the undamped mode's ringing [Hz].
        decay: Rate d at which its amplitude decays [1/s].
        gain: Amplitude of s per impulse, g [1/kg].
        shapes: How strongly each is struck where and along what; None: alike everywhere.
    """

    frequency: Float[np.ndarray, " mode"]
    decay: Float[np.ndarray, " mode"]
    gain: Float[np.ndarray, " mode"]
    shapes: ModeShapes | None = None
