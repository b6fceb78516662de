"""Modes of vibration of a body: what an impulse on it makes ring.

An impulse J [N·s] at the time 0 makes the body sound as

    s(t) = J Σ_i g_i e^(−d_i t) sin(2π f_i t)                                                 [m/s]

with the frequency f_i [Hz], the decay rate d_i of the amplitude [1/s], and the gain g_i [1/kg] of each mode. With mode shapes
φ_i normalised to the mass, ∫ρ φ_i² dV = 1, it is g_i = φ_i(struck) φ_i(heard), both by the component along the surface's
normal, and s the pseudo-velocity ω q of the surface: its displacement q times ω = 2πf, which has the amplitude of its velocity
and no jump at the impulse.

Shapes: `mode` modes of one body, `point` points of its surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class SurfaceGains:
    """By how much more or less a mode is struck at a point of the surface than by its gain.

    Attributes:
        pos: The points, in the body's frame [m].
        share: φ_i at each point along the normal, over its root mean square over the surface; with its sign [1].
    """

    pos: Float[np.ndarray, "point 3"]
    share: Float[np.ndarray, "point mode"]


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of a body, by ascending frequency.

    Attributes:
        frequency: f, of the undamped mode's ringing [Hz].
        decay: Rate d at which its amplitude decays [1/s].
        gain: Amplitude of s per impulse, g [1/kg].
        at: How strongly each is struck at points of the surface; None: alike everywhere.
    """

    frequency: Float[np.ndarray, " mode"]
    decay: Float[np.ndarray, " mode"]
    gain: Float[np.ndarray, " mode"]
    at: SurfaceGains | None = None
