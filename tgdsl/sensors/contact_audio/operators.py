"""A block of samples as one matrix: what of it depends on the modes and the time step, in float64.

    heard = Hᵀ x,   z′ = Pᵀ x,   x = (Re z, Im z, u)

with the phasors z of the modes at the start of a step [N·s] and impulses u at `GRAINS` times within it [N·s]; H holds the
samples' sines, P what is left of each phasor at the end. Both are exact, whatever the step. A phasor turned by a rounded factor
would drift by 10⁻⁸ a step, so P is kept as a rounded matrix and what rounding left out, which are added up in float64.

Shapes: `row` bodies that ring, `mode` modes of the one with most, `part` real parts, imaginary parts and impulses, `sample`
samples of a block, `band` bands, `grain` times of impulses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

GRAINS = 4
"""Times within a physics step at which noise strikes: the same for any number of samples, so that the noise is."""
HIGHEST = 0.45
"""Largest frequency that is heard, in sample rates."""
Arrays = Mapping[str, np.ndarray]


def highest(samples: int, step: float) -> float:
    """Return the largest frequency that blocks of so many samples hold [Hz]."""
    return HIGHEST * samples / step


def strike_times(samples: int, step: float, is_paper: bool, has_noise: bool) -> Float[np.ndarray, " grain"]:
    """Return when impulses act [s], impacts first: from the start of the step on, of the paper's response at each sample."""
    if is_paper:
        return np.arange(1, samples + 1 if has_noise else 2) * step / samples
    return np.arange(GRAINS if has_noise else 1) * step / GRAINS


def strike_phasors(frequency: np.ndarray, samples: int, step: float, is_paper: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the phasor that a unit impulse adds to each mode: 1, or e^(iθ)/sin θ of the two-pole response."""
    if not is_paper:
        return np.ones_like(frequency), np.zeros_like(frequency)
    angle = 2 * math.pi * frequency * step / samples
    sine = np.where(np.sin(angle) != 0, np.sin(angle), 1.0)
    return np.cos(angle) / sine, np.ones_like(frequency)


def operators(constants: Arrays, step: float) -> dict[str, np.ndarray]:
    """Return what of a sensor's constants depends on the time step [s].

    Args:
        constants: `frequency` [Hz], `decay` [1/s], `gain` [1/kg], each (row, mode), 0 where a row has fewer; `samples`;
            `settling` [s]; `scrape` [kg]; `is_paper` of the paper's response; `band` (row, mode, band) of bands.
        step: The time step.
    """
    samples, is_paper, scrape = int(constants["samples"]), "is_paper" in constants, float(constants["scrape"])
    frequency, decay = constants["frequency"], constants["decay"]
    is_heard = (frequency > 0) & (frequency <= highest(samples, step) * (1 + 1e-12))
    gain = np.where(is_heard, constants["gain"], 0.0)
    times, strikes = np.arange(1, samples + 1) * step / samples, strike_times(samples, step, is_paper, scrape > 0)

    def factors(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return real and imaginary part of e^((−d + 2πif) t), (row, mode, *time), of silent modes 0 and before the start."""
        shape = (..., *[None] * time.ndim)
        size = np.where(time >= -1e-12 * step, is_heard[shape] * np.exp(-decay[shape] * np.maximum(time, 0.0)), 0.0)
        angle = 2 * math.pi * frequency[shape] * time
        return size * np.cos(angle), size * np.sin(angle)

    real, imag = factors(times)
    begun = strike_phasors(frequency, samples, step, is_paper)
    late_real, late_imag = factors(times - strikes[:, None])
    found = {
        "mixed": _advance(factors(np.array(step)), begun, factors(step - strikes)),
        "kept": np.asarray(math.exp(-step / float(constants["settling"]))),
        "step": np.asarray(step),
        "strike_time": strikes,
    }
    if scrape > 0:
        found["noise"] = np.asarray(math.sqrt(scrape * step / len(strikes)))
    if "band" in constants:
        energy = 0.5 * (gain**2)[..., None] * constants["band"]
        found["heard"] = np.concatenate([energy, energy], axis=1)
    else:
        struck = begun[0][..., None, None] * late_imag + begun[1][..., None, None] * late_real
        of_impulses = (gain[..., None, None] * struck).sum(axis=1)
        found["heard"] = np.concatenate([gain[..., None] * imag, gain[..., None] * real, of_impulses], axis=1)
    rounded = found.pop("mixed")
    found["advance"] = rounded.astype(np.float32).astype(np.float64)
    found["advance_low"] = rounded - found["advance"]
    return found


def _advance(
    turn: tuple[np.ndarray, np.ndarray], begun: tuple[np.ndarray, np.ndarray], late: tuple[np.ndarray, np.ndarray]
) -> Float[np.ndarray, "row part both"]:
    """Return P: from phasors and impulses to phasors at the end of the step.

    Args:
        turn: The factor of each phasor, (row, mode).
        begun: What a unit impulse adds to it, (row, mode).
        late: The factor from the time of each impulse on, (row, mode, grain).
    """
    rows, modes, grains = late[0].shape
    made = np.zeros((rows, 2 * modes + grains, 2 * modes))
    each = np.arange(modes)
    made[:, each, each], made[:, modes + each, each] = turn[0], -turn[1]
    made[:, each, modes + each], made[:, modes + each, modes + each] = turn[1], turn[0]
    real = begun[0][..., None] * late[0] - begun[1][..., None] * late[1]
    imag = begun[0][..., None] * late[1] + begun[1][..., None] * late[0]
    made[:, 2 * modes :, :modes], made[:, 2 * modes :, modes:] = real.swapaxes(1, 2), imag.swapaxes(1, 2)
    return made
