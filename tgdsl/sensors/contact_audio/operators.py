"""A step of the modes, and a block of samples as one matrix: what of it depends on the time step, in float64.

    heard = Hᵀ (Re z, Im z, u) + Σ_n ξ_n h(t_n),   z′ = p z + b u + Σ_n ξ_n e(t_n)

with the phasors z of the modes at the start of a step [N·s] and what drives them in it: u, an impulse at its start [N·s], or
with `model: force` the rise of the force [N], and `GRAINS` impulses of noise ξ_n [N·s], each at one of `SLOTS` times t_n of its
part of the step. H and h hold the samples' sines, p, b and e what is left of phasors and drives at the end. All are exact,
whatever the step. A phasor that is turned by the same rounded
factor at every step drifts by 3e-8 a step. So in float32 p is rounded down at some steps and up at others, such that its mean
is exact: up at step n where the fractional part of n (√5 − 1)/2 is below the share of a unit in the last place by which it is
above the lower number. What is left are roundings that do not add up.

Shapes: `row` bodies that ring, `mode` modes of the one with most, `part` real and imaginary part, `both` the real parts of all
modes, then their imaginary ones, `sample` samples of a block, `band` bands, `grain` impulses of noise, `slot` times of each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from tgdsl.tensors.fusion import materialised

GRAINS = 4
"""Impulses of noise in a physics step, one in each of as many equal parts: the same for any number of samples."""
SLOTS = 16
"""Times in its part of the step at which one of them may arrive."""
HIGHEST = 0.45
"""Largest frequency that is heard, in sample rates."""
Arrays = Mapping[str, np.ndarray]

# Functions, not floats of the module: under dynamic shapes torch.compile makes those inputs of the graph.


def golden() -> float:
    """Return the golden ratio's fraction: modulo 1, its multiples fill the unit interval most evenly of all numbers'."""
    return 0.6180339887498949


def least() -> float:
    """Return up to where a component of a phasor is flushed to zero [N·s]."""
    return 1e-12


def quiet() -> float:
    """Return the energy E₀ that levels are relative to, of 1 µm/s [m²/s²]."""
    return 1e-12


def highest(samples: int, step: float) -> float:
    """Return the largest frequency that blocks of so many samples hold [Hz]."""
    return HIGHEST * samples / step


def strike_phasors(frequency: np.ndarray, samples: int, step: float, is_paper: bool) -> Complex[np.ndarray, "row mode"]:
    """Return the phasor that a unit impulse adds to each mode: 1, or e^(iθ)/sin θ of the two-pole response."""
    if not is_paper:
        return np.ones_like(frequency, dtype=np.complex128)
    angle = 2 * math.pi * frequency * step / samples
    return np.exp(1j * angle) / np.where(np.sin(angle) != 0, np.sin(angle), 1.0)


def radiated() -> float:
    """Return the sound pressure at 1 m per velocity of a surface of 0.01 m², ρc √(A/4π), of air at 20 °C [Pa·s/m]."""
    return 1.204 * 343.2 * 0.028209479177387815  # a float of a module, such as math.pi, is an input of a compiled graph


def operators(constants: Arrays, step: float) -> dict[str, np.ndarray]:
    """Return what of a sensor's constants depends on the time step [s].

    Args:
        constants: `frequency` [Hz], `decay` [1/s], `gain` [1/kg], each (row, mode), 0 where a row has fewer; `samples`;
            `settling` [s]; `scrape` [kg]; `is_paper` of the paper's response; `is_force` where the force drives; `band` (row,
            mode, band) of bands; `shape_value` where each mode has a drive of its own.
        step: The time step.
    """
    samples, scrape = int(constants["samples"]), float(constants["scrape"])
    is_paper, is_force = "is_paper" in constants, "is_force" in constants
    frequency = constants["frequency"]
    is_heard = (frequency > 0) & (frequency <= highest(samples, step) * (1 + 1e-12))
    rate, gain = -constants["decay"] + 2j * math.pi * frequency, np.where(is_heard, constants["gain"], 0.0)
    times = np.arange(1, samples + 1) * step / samples
    arrival = times[:, None] if is_paper else (np.arange(GRAINS * SLOTS) * step / (GRAINS * SLOTS)).reshape(GRAINS, SLOTS)
    begun = strike_phasors(frequency, samples, step, is_paper)
    over = rate.real / np.where(is_heard, rate.imag, 1.0)
    seen = gain * (1.0 - 1j * over) if is_force else -1j * gain  # heard is Re(seen z)

    def factors(time: np.ndarray) -> np.ndarray:
        """Return e^((−d + 2πif) t), (row, mode, *time); 0 of modes that are not heard, and before an impulse."""
        shape = (..., *[None] * time.ndim)
        return np.where(is_heard[shape] & (time >= -1e-12 * step), np.exp(rate[shape] * np.maximum(time, 0.0)), 0.0)

    def struck(time: np.ndarray) -> np.ndarray:
        """Return the phasors (row, mode, time) of a unit impulse, or of a force that rises evenly by 1 N in the step."""
        if not is_force:
            return begun[..., None] * factors(time - (step / samples if is_paper else 0.0))
        square = np.where(is_heard, rate, 1.0)[..., None] ** 2
        return np.where(is_heard[..., None], np.expm1(rate[..., None] * time) / (square * step), 0.0)

    kept = math.exp(-step / float(constants["settling"]))
    turn = factors(np.array(step))
    added = struck(np.array([step]))[..., 0]
    result = {
        "kept": np.asarray(kept),
        "leaked": np.asarray(1.0 - kept),
        "step": np.asarray(step),
        "driven": np.concatenate([np.real(added), np.imag(added)], axis=1),
        **{name: _by_parts(name, part) for name, part in _rounded("turn", np.stack([np.real(turn), np.imag(turn)])).items()},
    }
    if scrape > 0:
        result["noise"] = np.asarray(math.sqrt(scrape * step / len(arrival)))
        left = (begun[..., None, None] * factors(step - arrival)).transpose(2, 3, 0, 1)
        result["grain_left"] = np.concatenate([np.real(left), np.imag(left)], axis=3)
    if "band" in constants:
        energy = 0.5 * (gain**2)[..., None] * constants["band"]
        return result | {"energy": np.concatenate([energy, energy], axis=1)}
    free, heard = seen[..., None] * factors(times), np.real(seen[..., None] * struck(times))
    has_each = "shape_value" in constants
    parts = [np.real(free), -np.imag(free), heard if has_each else heard.sum(axis=1, keepdims=True)]
    result["heard"] = np.concatenate(parts, axis=1)
    if scrape > 0:
        own = np.real((seen * begun)[..., None, None, None] * factors(times - arrival[..., None])).transpose(2, 3, 0, 1, 4)
        result["grain_heard"] = own if has_each else own.sum(axis=3)
    return result


def _rounded(name: str, exact: np.ndarray) -> dict[str, np.ndarray]:
    """Return the float32 numbers below and above each number, and how far on the way from one to the other it is."""
    nearest = exact.astype(np.float32)
    low = np.where(nearest > exact, np.nextafter(nearest, np.float32(-np.inf)), nearest)
    high = np.nextafter(low, np.float32(np.inf))
    low, high = low.astype(np.float64), high.astype(np.float64)
    return {f"{name}_low": low, f"{name}_high": high, f"{name}_share": (exact - low) / (high - low)}


def _by_parts(name: str, turn: Float[np.ndarray, "2 row mode"]) -> Float[np.ndarray, "2 row both"]:
    real, imag = turn
    sign = 1.0 if name.endswith("share") else -1.0
    return np.stack([np.concatenate([real, real], axis=-1), np.concatenate([sign * imag, imag], axis=-1)])


def turn_of(constants: Mapping[str, Tensor], count: Tensor) -> Float[Tensor, "2 row both"]:
    """Return p as a step uses it, for both parts of z: exact in float64, rounded down or up in float32.

    Args:
        constants: The module's.
        count: Number of the step, int64; any steps will do that follow one another.
    """
    low, high, share = (constants[f"turn_{name}"] for name in ("low", "high", "share"))
    if low.dtype == torch.float64:
        return low + share * (high - low)
    result = torch.where(torch.frac(count.double() * golden()).to(low.dtype) < share, high, low)
    return result if result.is_cuda else materialised(result)  # on a CPU it is else chosen again for each environment
