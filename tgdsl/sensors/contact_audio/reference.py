"""The definition of contact audio in float64: impulse by impulse, sample by sample, mode by mode.

Shapes: `row` bodies that ring, `sample` samples of a step.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from tgdsl.layout.layout import Layout
from tgdsl.quantities.contacts import Loads, PairLoads
from tgdsl.quantities.kinematics import Places
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import ReferenceAnswer, ReferenceContext, ReferenceState
from tgdsl.sensors.contact_audio.modes import (
    GRAINS,
    SLOTS,
    ContactAudioSpec,
    Ringing,
    highest,
    least,
    middle,
    quiet,
    radiated,
    ringing,
)
from tgdsl.sensors.noise.reference import normal_pair
from tgdsl.sensors.upstream import PLACE, SAMPLES
from tgdsl.surfaces.surface import Surface

Strikes = list[tuple[float, float]]  # when each impulse acts after the start of the step [s], and how large it is [N·s]


def reference(
    spec: ContactAudioSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> ReferenceAnswer:
    """Return the samples of one step (sample, row, 1) [m/s], or the energies of its bands (row, band); and the next state.

    Samples come with the planes that a microphone reads.
    """
    loads, step = gathered[Loads], context.dt
    modes = ringing(spec, layout, spec.timestep or step, _no_surface)
    is_paper, below = spec.model == "paper", highest(spec.samples, step)
    is_force, axis, share = spec.model == "force", 1 if spec.of == "link" else 0, _shares(spec, modes, loads)
    if is_force:
        load = (loads.force[..., None] * share).sum(axis=axis)
        struck = load - (load if context.is_first else state["load"].reshape(load.shape))
        after = {"load": load if spec.gains == "contact" else load[:, 0]}
    else:
        last_steady = loads.force if context.is_first else state["steady"]
        pending = state.get("pending", np.zeros_like(last_steady))
        weighted = state.get("weighted", np.zeros_like(share) if is_paper or spec.gains == "contact" else pending[..., None])
        memory = (last_steady, pending, weighted)
        impulse, steady, pending, weighted = reference_impulses(loads.force, memory, share, step, spec.settling, is_paper)
        struck = impulse.sum(axis=axis)
        after = {"steady": steady} | ({} if is_paper else {"pending": pending})
        after |= {"weighted": weighted} if spec.gains == "contact" and not is_paper else {}
    rubbed = (loads.sliding[..., None] * share**2).sum(axis=axis)
    num = len(struck)
    phasors, heard = state["phasors"].copy(), np.zeros((spec.samples, num))
    half = modes.frequency.shape[1]
    amplitude = np.zeros((num, half))
    for row in range(num):
        for m in range(half):
            of = m if spec.gains == "contact" else 0
            drive, strikes = float(struck[row, of]), _noise(spec, context, row, num, float(rubbed[row, of]))
            frequency, decay, gain = (float(table[row, m]) for table in (modes.frequency, modes.decay, modes.gain))
            if not 0 < frequency <= below * (1 + 1e-12):
                phasors[row, [m, half + m]] = 0.0
                continue
            rate, phasor = complex(-decay, 2 * math.pi * frequency), complex(phasors[row, m], phasors[row, half + m])
            if is_force:
                samples, last = _driven(rate, phasor, drive, strikes, spec.samples, step)
            else:
                strikes = [(step / spec.samples if is_paper else 0.0, drive), *strikes]
                samples, last = _ring(rate, phasor, strikes, spec.samples, step, is_paper)
            heard[:, row] += gain * samples
            phasors[row, [m, half + m]] = [part if abs(part) > least() else 0.0 for part in (last.real, last.imag)]
            amplitude[row, m] = gain * abs(complex(phasors[row, m], phasors[row, half + m]))
    after["phasors"] = phasors
    if spec.outputs == "bands":
        return _bands(spec, modes, amplitude), after
    return heard[..., None], after, {SAMPLES: radiated() * heard, PLACE: gathered[Places].T}


def _shares(spec: ContactAudioSpec, modes: Ringing, loads: PairLoads) -> Float[np.ndarray, "body object mode"]:
    """Return the factor on each mode's gain for each load on a body."""
    if spec.gains == "mean":
        return np.ones((*loads.force.shape, 1))
    result = np.zeros((*loads.force.shape, modes.frequency.shape[1]))
    for b, o in np.ndindex(loads.force.shape):
        shapes = modes.shapes[b if spec.of == "link" else o]
        share = shapes.share(loads.center[b, o][None], loads.along[b, o][None])[0]
        result[b, o, : len(share)] = share
    return result


def _no_surface(name: str) -> Surface:
    raise NotImplementedError(f"the reference of contact audio needs listed modes, not modes from the shape of {name}")


def _noise(spec: ContactAudioSpec, context: ReferenceContext, row: int, num_rows: int, rubbed: float) -> Strikes:
    """Return the noise on a row: impulses of variance m_s W Δt/G, each at one of its slots; the paper's at each sample."""
    if spec.scrape == 0:
        return []
    is_paper = spec.model == "paper"
    grains = spec.samples if is_paper else GRAINS
    words = (grains + 1) // 2
    index = np.arange(row * words, (row + 1) * words, dtype=np.uint64)
    normals = np.stack(normal_pair(context.words(index)), axis=-1).ravel()
    size = math.sqrt(spec.scrape * rubbed * context.dt / grains)
    last = int(context.words(np.array([num_rows * words + row], dtype=np.uint64))[0])
    parts = [1.0 if is_paper else (last >> (4 * g) & 15) / SLOTS for g in range(grains)]
    return [((g + part) * context.dt / grains, size * normals[g]) for g, part in enumerate(parts)]


def _driven(
    rate: complex, phasor: complex, rise: float, strikes: Strikes, samples: int, step: float
) -> tuple[Float[np.ndarray, " sample"], complex]:
    """Return the velocity of a mode of gain 1 in a step whose force rises evenly [N], and its phasor at the end."""
    results = []
    for k in range(1, samples + 1):
        time = k * step / samples
        noise = sum(u * np.exp(rate * (time - s)) for s, u in strikes if s <= time + 1e-12 * step)
        results.append(np.exp(rate * time) * phasor + rise / step * np.expm1(rate * time) / rate**2 + noise)
    return np.array([z.real + rate.real / rate.imag * z.imag for z in results]), complex(results[-1])


def _ring(
    rate: complex, phasor: complex, strikes: Strikes, samples: int, step: float, is_paper: bool
) -> tuple[Float[np.ndarray, " sample"], complex]:
    """Return the samples of a mode of gain 1 in a step, and its phasor at the end."""
    if is_paper:
        return _two_pole(rate, phasor, strikes, samples, step)
    times = np.arange(1, samples + 1) * step / samples
    results = [
        (np.exp(rate * t) * phasor).imag + sum((u * np.exp(rate * (t - s))).imag for s, u in strikes if s <= t + 1e-12 * step)
        for t in times
    ]
    return np.array(results), complex(np.exp(rate * step) * phasor + sum(u * np.exp(rate * (step - s)) for s, u in strikes))


def _two_pole(
    rate: complex, phasor: complex, strikes: Strikes, samples: int, step: float
) -> tuple[Float[np.ndarray, " sample"], complex]:
    """Return y[k] = a₁ y[k−1] − a₂ y[k−2] + u[k], and the phasor whose imaginary part has the last two as its last values."""
    pole = np.exp(rate * step / samples)
    first, second = 2 * pole.real, abs(pole) ** 2
    last, previous = phasor.imag, (phasor / pole).imag
    results = []
    for k in range(samples):
        struck = sum(u for time, u in strikes if abs(time - (k + 1) * step / samples) < 1e-9 * step)
        last, previous = first * last - second * previous + struck, last
        results.append(last)
    # y = Im z and y[k−1] = Im(z/p): two equations for Re z, with 1/p = p*/|p|².
    real = (last * pole.real - previous * second) / pole.imag
    return np.array(results), complex(real, last)


def _bands(spec: ContactAudioSpec, modes: Ringing, amplitude: np.ndarray) -> np.ndarray:
    """Return ½ Σ (g |z|)² of the modes in each third octave (row, band) [m²/s²], or its level [dB]."""
    result = np.zeros((len(modes.frequency), len(modes.bands)))
    for place, frequency in np.ndenumerate(modes.frequency):
        for b, number in enumerate(modes.bands):
            if middle(number) * 10**-0.05 <= frequency < middle(number) * 10**0.05:
                result[place[0], b] += 0.5 * amplitude[place] ** 2
    return 10 * np.log10(1 + result / quiet()) if spec.scale == "decibel" else result


def reference_impulses(
    force: Float[np.ndarray, "body object"],
    before: tuple[np.ndarray, np.ndarray, np.ndarray],
    share: Float[np.ndarray, "body object mode"],
    step: float,
    settling: float,
    is_paper: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the impulses of each mode, and F̄, A and A_i after them, of one environment: pair by pair.

    Args:
        force: F [N].
        before: F̄ [N], A [N·s] and A_i of each mode [N·s].
        share: s_i; of one mode, 1, where all have the same.
        step: Δt [s].
        settling: τ [s].
        is_paper: Whether each rise of the force strikes by itself.
    """
    impulse, (steady, pending, weighted) = np.zeros_like(share), (part.copy() for part in before)
    decay = np.exp(-step / settling)
    for place, load in np.ndenumerate(force):
        grown = max(0.0, load - steady[place]) * step
        if is_paper:
            impulse[place], steady[place] = grown * share[place], load
        elif grown <= (1 - decay) * pending[place]:
            impulse[place], weighted[place] = weighted[place], 0.0
            pending[place], steady[place] = 0.0, load
        else:
            weighted[place] = decay * weighted[place] + grown * share[place]
            pending[place], steady[place] = decay * pending[place] + grown, load + decay * (steady[place] - load)
    return impulse, steady, pending, weighted
