"""Modes of free bodies from their shape, against closed forms, or Timoshenko's and Kirchhoff's theories.

Wave numbers are κ = ω L/c with c = √(E/ρ) and the longest side L of the bounding box. Quadratic elements are slightly too
stiff: tolerances are errors of the meshes, at most 2 %.
"""

from dataclasses import replace

import numpy as np

from oracles.comparison import Values, field
from oracles.setups.solids import ball, bending, box, breathing, lamb, plate_frequencies, roots, surface_of, timoshenko, torsion
from tgdsl.fields.materials import MATERIALS, Material
from tgdsl.modal import cells
from tgdsl.modal.analysis import SIGHT, SLIVER, analysed, spectrum
from tgdsl.modal.cells import closed
from tgdsl.modal.elasticity import Elements, vibration
from tgdsl.modal.modes import ShapeModes
from tgdsl.surfaces.surface import Surface

oracle = field("sound: modes of bodies", "contact_audio")


@oracle(
    "A slender beam bends, both ends free", "κ = (βL)² √(I/A)/L, cos βL cosh βL = 1", "Bernoulli and Euler", "wave number [1]",
    "mode", at=range(1, 6), rtol=0.01,
)  # fmt: skip
def slender_beam(length: float = 0.5, height: float = 0.0125, width: float = 0.008):
    beta = roots(lambda b: np.cos(b) - 1 / np.cosh(b), 3.5, 12.0)
    exact = np.sort([b**2 * side / np.sqrt(12) / length for b in beta for side in (height, width)])[:5]
    modes, size, _ = spectrum(surface_of(box((length, height, width))), 0.3, 12, 4000)
    is_each = size == length and modes.multiplicity[:5].tolist() == [1] * 5
    return exact, modes.wave_number[:5] if is_each else np.nan


@oracle(
    "A thick beam bends, both ends free", "roots of moment and shear at the ends",
    "Timoshenko, with Cowper's shear coefficient (1966)", "wave number [1]", "mode", at=range(1, 4), rtol=0.01,
)  # fmt: skip
def thick_beam(height: float = 0.125):
    modes, _, _ = spectrum(surface_of(box((1.0, height, height))), 0.3, 8, 4000)
    return timoshenko(1.0, height, height, 0.3, 5.0)[:3], modes.wave_number[modes.multiplicity == 2][:3]


@oracle(
    "Longitudinal waves of a rod", "f = nc/2L, κ = nπ", "wave equation", "wave number, the nearest mode's [1]", "n",
    at=["1", "2"], rtol=0.003,
)  # fmt: skip
def rod():
    modes, _, _ = spectrum(surface_of(box((0.02, 0.8, 0.02))), 0.3, 24, 5000)
    exact = np.pi * np.array([1.0, 2.0])
    return exact, [modes.wave_number[np.abs(modes.wave_number - k).argmin()] for k in exact]


def all_modes(surface: Surface, cell: float, poissons_ratio: float, count: int) -> np.ndarray:
    """Return κ of all modes, audible or not, on cells of a size over L."""
    vertices, faces = closed(surface)
    vertices = vertices / np.ptp(vertices, axis=0).max()
    vertices = vertices @ cells.axes(vertices, faces).T
    x, y, z = (
        cells.lines(cells.planes(vertices, faces, axis), vertices[:, axis].min(), vertices[:, axis].max(), cell)
        for axis in range(3)
    )
    filled, _ = cells.filled(vertices, faces, (x, y, z), SIGHT, SLIVER)
    return vibration(*Elements.of(filled).matrices(poissons_ratio), count).wave_number


@oracle(
    "All modes of a ball, ν = {poissons_ratio:g}", "spheroidal modes, torsion, breathing: no traction on the surface",
    "Lamb 1882", "wave number [1]", "mode", at=range(1, 25), rtol=0.01, each=[0.3, 0.4999], also=[0.0],
)  # fmt: skip
def modes_of_a_ball(poissons_ratio: float):
    shear = 1 / np.sqrt(2 * (1 + poissons_ratio))
    each = [(2 * shear * root, 2 * n + 1) for n in (1, 2, 3, 4, 5) for root in lamb(n, poissons_ratio, 6.0) + torsion(n, 6.0)]
    compression = np.sqrt((1 - poissons_ratio) / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio)))
    each += [(2 * compression * root, 1) for root in breathing(poissons_ratio, 4.0)]
    exact = np.sort(np.concatenate([[wave_number] * times for wave_number, times in each]))[:24]
    return exact, all_modes(surface_of(ball(0.02)), 0.2, poissons_ratio, 24)


@oracle(
    "A thin square plate bends, all edges free", "ωa²√(ρh/D)",
    "Kirchhoff, by Ritz's method; Leissa 1973: 13.49, 19.79, 24.43, 35.02 by a shorter series", "frequency [1]", "mode",
    at=range(1, 6), rtol=0.01,
)  # fmt: skip
def square_plate():
    modes, _, _ = spectrum(surface_of(box((0.2, 0.2, 0.004))), 0.3, 6, 6000)
    return plate_frequencies(0.3)[:5], (np.repeat(modes.wave_number, modes.multiplicity) * np.sqrt(12 * (1 - 0.09)) / 0.02)[:5]


def made_of(material: Material, num_modes: int = 8) -> ShapeModes:
    """Return the fields of a document for modes of a material."""
    return ShapeModes.model_construct(material=material, count=num_modes)


SCALES = (1.0, 0.3, 17.0)


@oracle(
    "Frequencies scale by stiffness, density and size", "f ∝ √(E/ρ)/L", "similar bodies", "frequency [Hz]", "mode", rtol=1e-6,
    at=range(1, 9), series=[f"{scale:g} times as long" for scale in SCALES], also=[((0.2, 0.02, 0.012),)], slow=[()],
)  # fmt: skip
def scaled(sides: tuple[float, ...] = (0.06, 0.05, 0.04)):
    steel = MATERIALS["steel"]
    other = replace(steel, youngs_modulus=3e9, density=1100.0, mass_damping=7.0, stiffness_damping=2e-7)
    speed = np.sqrt(3e9 / 1100.0 / (steel.youngs_modulus / steel.density))
    base, *ours = (
        analysed("block", surface_of(box((*(scale * side for side in sides),))), made_of(material, 8), 1e9).frequency
        for material, scale in ((steel, 1.0), *((other, scale) for scale in SCALES))
    )
    return [base * speed / scale for scale in SCALES], ours


UP = np.array([0.0, 0.0, 1.0])


@oracle(
    "Blows along a beam that bends, mode {mode}",
    "φ = cos βx / cos ½βL + cosh βx / cosh ½βL, odd: sin and sinh; over that of an end", "Bernoulli and Euler",
    "gain at the contact, over that at an end [1]", "place from the middle over the length [1]", atol=0.01, each=[0, 1],
)  # fmt: skip
def struck_along_a_beam(number: int, length: float = 0.4, height: float = 0.006, width: float = 0.01):
    node = max(roots(lambda at: bending(at, number), 0.1, 0.49))
    x = np.sort([*np.linspace(-0.5, 0.5, 21), node])
    exact = bending(x, number) / 2
    shapes = analysed("beam", surface_of(box((length, width, height))), made_of(MATERIALS["steel"], 4), 1e9).shapes
    share = shapes.share(np.stack([length * x, 0 * x, 0 * x + height / 2], axis=1), np.tile(UP, (len(x), 1)))
    ours = share[:, int(np.argmax(np.abs(share.T @ exact)))]
    return Values(exact, ours / ours[-1], at=x, words={"mode": number + 1})


@oracle(
    "A blow at the centre of a square plate", "φ(0, 0) = 0",
    "symmetry: displacements as xy, x² − y² and a pair, odd in x or y, are zero there",
    "gain at the contact, over the mean [1]", at=["xy", "x² − y²", "the pair"], atol=5e-3, slow=True,
)  # fmt: skip
def struck_at_the_centre(side: float = 0.2, thickness: float = 0.004):
    shapes = analysed("plate", surface_of(box((side, side, thickness))), made_of(MATERIALS["steel"], 6), 1e9).shapes
    return 0.0, np.abs(shapes.share(np.array([[0.0, 0.0, thickness / 2]]), UP[None])[0])[[0, 1, 3]]
