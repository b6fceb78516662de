"""Modes of free bodies from their shape, against closed forms, or Timoshenko's and Kirchhoff's theories.

Wave numbers are κ = ω L/c with c = √(E/ρ) and the longest side L of the bounding box. Quadratic elements give a little too
much: tolerances are what the meshes leave, at most 2 %.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.solids import (
    ball,
    bending,
    box,
    breathing,
    lamb,
    plate_frequencies,
    roots,
    surface_of,
    timoshenko,
    torsion,
)
from tgdsl.fields.materials import MATERIALS, Material
from tgdsl.modal import cells, grid
from tgdsl.modal.analysis import analysed
from tgdsl.modal.closed import closed
from tgdsl.modal.elasticity import Elements
from tgdsl.modal.spec import ShapeModes
from tgdsl.modal.spectrum import SIGHT, SLIVER, spectrum
from tgdsl.modal.vibration import vibration
from tgdsl.surfaces.surface import Surface

KINDS = ("contact_audio",)


def slender_beam(length: float = 0.5, height: float = 0.0125, width: float = 0.008) -> Comparison:
    """Return how a slender beam bends; its sides differ, so that each way of bending is a mode of its own."""
    beta = roots(lambda b: np.cos(b) - 1 / np.cosh(b), 3.5, 12.0)
    exact = np.sort([b**2 * side / np.sqrt(12) / length for b in beta for side in (height, width)])[:5]
    found, size, _ = spectrum(surface_of(box(length, height, width)), 0.3, 12, 4000)
    is_each = size == length and found.multiplicity[:5].tolist() == [1] * 5
    return Comparison(
        "A slender beam bends, both ends free",
        "Bernoulli and Euler",
        "κ = (βL)² √(I/A)/L, cos βL cosh βL = 1",
        KINDS,
        "wave number",
        "1",
        cases(range(1, 6), "mode"),
        exact,
        found.wave_number[:5] if is_each else np.full(5, np.nan),
        rtol=0.01,
    )


def thick_beam(height: float = 0.125) -> Comparison:
    """Return how a square beam of L/h = 8 bends, where Bernoulli's third frequency is 20 % too high."""
    found, _, _ = spectrum(surface_of(box(1.0, height, height)), 0.3, 8, 4000)
    return Comparison(
        "A thick beam bends, both ends free",
        "Timoshenko, with Cowper's shear coefficient (1966)",
        "roots of moment and shear at the ends",
        KINDS,
        "wave number",
        "1",
        cases(range(1, 4), "mode"),
        array(timoshenko(1.0, height, height, 0.3, 5.0)[:3]),
        found.wave_number[found.multiplicity == 2][:3],
        rtol=0.01,
    )


def rod() -> Comparison:
    """Return longitudinal waves of a rod; its ends are heard, and its sides a little, by Poisson's ratio."""
    found, _, _ = spectrum(surface_of(box(0.02, 0.8, 0.02)), 0.3, 24, 5000)
    exact = np.pi * np.array([1.0, 2.0])
    return Comparison(
        "Longitudinal waves of a rod",
        "wave equation",
        "f = nc/2L, κ = nπ",
        KINDS,
        "wave number, the nearest mode's",
        "1",
        cases([1, 2], "n"),
        exact,
        array([found.wave_number[np.abs(found.wave_number - own).argmin()] for own in exact]),
        rtol=0.003,
    )


def all_modes(surface: Surface, cell: float, poissons_ratio: float, count: int) -> np.ndarray:
    """Return κ of all modes, those that are not heard too, on cells of a size over L."""
    vertices, faces = closed(surface)
    vertices = vertices / np.ptp(vertices, axis=0).max()
    vertices = vertices @ grid.axes(vertices, faces).T
    x, y, z = (
        grid.lines(grid.planes(vertices, faces, axis), vertices[:, axis].min(), vertices[:, axis].max(), cell)
        for axis in range(3)
    )
    filled, _ = cells.filled(vertices, faces, (x, y, z), SIGHT, SLIVER)
    return vibration(*Elements.of(filled).matrices(poissons_ratio), count).wave_number


def modes_of_a_ball(poissons_ratio: float) -> Comparison:
    """Return all 24 modes of a ball from the lowest on, no more and no fewer: 2n + 1 of each of degree n."""
    shear = 1 / np.sqrt(2 * (1 + poissons_ratio))
    each = [(2 * shear * root, 2 * n + 1) for n in (1, 2, 3, 4, 5) for root in lamb(n, poissons_ratio, 6.0) + torsion(n, 6.0)]
    compression = np.sqrt((1 - poissons_ratio) / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio)))
    each += [(2 * compression * root, 1) for root in breathing(poissons_ratio, 4.0)]
    exact = np.sort(np.concatenate([[wave_number] * times for wave_number, times in each]))[:24]
    return Comparison(
        f"All modes of a ball, ν = {poissons_ratio:g}",
        "Lamb 1882",
        "spheroidal modes, torsion, breathing: no traction on the surface",
        KINDS,
        "wave number",
        "1",
        cases(range(1, 25), "mode"),
        exact,
        all_modes(surface_of(ball(0.02)), 0.2, poissons_ratio, 24),
        rtol=0.01,
    )


def square_plate() -> Comparison:
    """Return how a free square plate of a/h = 50 bends."""
    found, _, _ = spectrum(surface_of(box(0.2, 0.2, 0.004)), 0.3, 6, 6000)
    return Comparison(
        "A thin square plate bends, all edges free",
        "Kirchhoff, by Ritz's method; Leissa 1973: 13.49, 19.79, 24.43, 35.02 by a shorter series",
        "ωa²√(ρh/D)",
        KINDS,
        "frequency",
        "1",
        cases(range(1, 6), "mode"),
        plate_frequencies(0.3)[:5],
        (np.repeat(found.wave_number, found.multiplicity) * np.sqrt(12 * (1 - 0.09)) / 0.02)[:5],
        rtol=0.01,
    )


def made_of(material: Material, num_modes: int = 8) -> ShapeModes:
    """Return what a document says of modes of a material."""
    return ShapeModes.model_construct(material=material, count=num_modes)


def scaled(sides: tuple[float, ...] = (0.06, 0.05, 0.04), num_modes: int = 8) -> Comparison:
    """Return the modes of a block at other sizes and of other stuff, by those of one size of steel."""
    steel = MATERIALS["steel"]
    other = replace(steel, youngs_modulus=3e9, density=1100.0, mass_damping=7.0, stiffness_damping=2e-7)
    assert steel.youngs_modulus is not None
    speed, scales = np.sqrt(3e9 / 1100.0 / (steel.youngs_modulus / steel.density)), (1.0, 0.3, 17.0)
    base, *found = (
        analysed("block", surface_of(box(*(scale * side for side in sides))), made_of(own, num_modes), 1e9)
        for own, scale in ((steel, 1.0), *((other, scale) for scale in scales))
    )
    return Comparison(
        "Frequencies scale by stiffness, density and size",
        "similar bodies",
        "f ∝ √(E/ρ)/L",
        KINDS,
        "frequency",
        "Hz",
        cases(range(1, num_modes + 1), "mode"),
        np.array([base.frequency * speed / scale for scale in scales]),
        np.array([own.frequency for own in found]),
        rtol=1e-6,
        series=tuple(f"{scale:g} times as long" for scale in scales),
    )


UP = np.array([0.0, 0.0, 1.0])


def struck_along_a_beam(number: int, length: float = 0.4, height: float = 0.006, width: float = 0.01) -> Comparison:
    """Return how strongly a way of bending is excited by blows along a beam: not at its nodes, most at its ends."""
    node = max(roots(lambda at: bending(at, number), 0.1, 0.49))
    x = np.sort([*np.linspace(-0.5, 0.5, 21), node])
    exact = bending(x, number) / 2
    found = analysed("beam", surface_of(box(length, width, height)), made_of(MATERIALS["steel"], 4), 1e9)
    assert found.shapes is not None
    share = found.shapes.share(np.stack([length * x, 0 * x, 0 * x + height / 2], axis=1), np.tile(UP, (len(x), 1)))
    own = share[:, int(np.argmax(np.abs(share.T @ exact)))]
    return Comparison(
        f"Blows along a beam that bends, mode {number + 1}",
        "Bernoulli and Euler",
        "φ = cos βx / cos ½βL + cosh βx / cosh ½βL, odd: sin and sinh; over that of an end",
        KINDS,
        "gain at the contact, over that at an end",
        "1",
        along("place from the middle over the length", "1", x),
        exact,
        own / own[-1],
        atol=0.01,
    )


def struck_at_the_centre(side: float = 0.2, thickness: float = 0.004) -> Comparison:
    """Return how strongly the first modes of a free square plate are excited at its centre, where all but one have a node."""
    found = analysed("plate", surface_of(box(side, side, thickness)), made_of(MATERIALS["steel"], 6), 1e9)
    assert found.shapes is not None
    share = np.abs(found.shapes.share(np.array([[0.0, 0.0, thickness / 2]]), UP[None])[0])
    return Comparison(
        "A blow at the centre of a square plate",
        "symmetry: displacements as xy, x² − y² and a pair, odd in x or y, are zero there",
        "φ(0, 0) = 0",
        KINDS,
        "gain at the contact, over the mean",
        "1",
        cases(["xy", "x² − y²", "the pair"]),
        np.zeros(3),
        share[[0, 1, 3]],
        atol=5e-3,
    )


ORACLES: tuple[Oracle, ...] = (
    slender_beam,
    thick_beam,
    rod,
    *(partial(modes_of_a_ball, poissons_ratio) for poissons_ratio in (0.3, 0.4999)),
    square_plate,
    scaled,
    *(partial(struck_along_a_beam, number) for number in (0, 1)),
    struck_at_the_centre,
)
