"""Modal analysis: from the triangles around a solid, and its material, to its modes.

    f = κ √(E/ρ) / 2πL,   d = (α + β ω²)/2,   g = γ/m

with κ = ω L/c and γ = g m of the shape (`spectrum.py`), L the longest side of its bounding box, m its mass, and Rayleigh's
damping α [1/s] and β [s] of the material. In mass-normalised modal coordinates q [m·√kg] a force F at x moves the body by

    q̈ + 2d q̇ + ω² q = φ_n(x) F(t),   displacement of the surface along its normal at y: φ_n(y) q

and g is φ_n(x) φ_n(y) with root mean squares over the surface for both: an impulse J at some point of it makes the surface move
with the velocity g J e^(−dt) cos ωt, in the mean. `loudness.py` says what g is where symmetry makes modes equal.

The body is free and homogeneous: held, filled or glued, it has other modes. Damping by air counts as far as the source of the
material's damping has it.
"""

from __future__ import annotations

import numpy as np

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError
from tgdsl.fields.materials import Material
from tgdsl.modal.modes import Modes, ModeShapes
from tgdsl.modal.spec import ShapeModes
from tgdsl.modal.spectrum import Spectrum, spectrum
from tgdsl.surfaces.surface import Surface

WANTED = {
    "youngs_modulus": "Young's modulus",
    "poissons_ratio": "Poisson's ratio",
    "mass_damping": "damping",
    "stiffness_damping": "damping",
}
"""Properties of a material that modal analysis needs, with its density."""
MAX_POISSON = 0.4999
"""Largest Poisson's ratio: elements lock in nearly incompressible solids."""


def analysed(name: str, surface: Surface, given: ShapeModes, below: float, progress: Progress = silent) -> Modes:
    """Return the modes of a solid that ring, up to a frequency; at least the lowest one.

    Args:
        name: What the body is called in messages.
        surface: Its surface, in its frame; of several geoms, all of theirs.
        given: What the document says of its modes.
        below: Frequency beyond which no mode is wanted [Hz].
        progress: Called with a line of text for each long job.

    Raises:
        LowerError: If the surface encloses no solid that can be analysed, the material is not known well enough, or none of its
            modes rings.
    """
    material = given.material
    youngs_modulus, poissons_ratio, mass_damping, stiffness_damping = _properties(name, material)
    try:
        shape, size, middle = spectrum(
            surface, poissons_ratio, given.count, progress=lambda text: progress(f"modes of {name}: {text}")
        )
    except LowerError as error:
        raise LowerError(f'modes of "{name}": {error.what}', field="modes", hint=error.hint) from error
    omega = shape.wave_number * np.sqrt(youngs_modulus / material.density) / size
    decay = (mass_damping + stiffness_damping * omega**2) / 2
    rings = decay < omega
    if not rings.any():
        problem = (
            f'none of the modes of "{name}" rings: {material.name} damps the lowest one, at {omega[0] / (2 * np.pi):.4g} Hz'
        )
        raise LowerError(problem, field="modes", hint="give another material, or list its modes")
    is_used = rings & (omega <= 2 * np.pi * below * (1 + 1e-12))
    if not is_used.any():
        is_used = np.arange(len(omega)) == int(np.argmax(rings))
    mass = material.density * shape.volume * size**3
    return Modes(
        frequency=omega[is_used] / (2 * np.pi),
        decay=decay[is_used],
        gain=shape.gain[is_used] / mass,
        shapes=_shapes(shape, size, middle).of(is_used),
    )


def _shapes(shape: Spectrum, size: float, middle: np.ndarray) -> ModeShapes:
    low = shape.grid.low * size + shape.axes @ middle
    return ModeShapes(shape.axes, low, shape.grid.step * size, shape.grid.num, shape.grid.value, shape.owner, shape.grid.error)


def _properties(name: str, material: Material) -> tuple[float, float, float, float]:
    """Return stiffness, Poisson's ratio and damping of a material."""
    values = [getattr(material, field) for field in WANTED]
    if missing := [quantity for quantity, value in zip(WANTED.values(), values, strict=True) if value is None]:
        listing = " and no ".join(dict.fromkeys(missing))
        hint = (
            f"give {', '.join(field for field, value in zip(WANTED, values, strict=True) if value is None)}, or list its modes"
        )
        raise LowerError(f'modes of "{name}": {material.name} has no {listing}', field="modes", hint=hint)
    if values[1] > MAX_POISSON:
        problem = f'modes of "{name}": Poisson\'s ratio of {material.name} is {values[1]:g}, expected at most {MAX_POISSON:g}'
        raise LowerError(problem, field="modes", hint="this method has no modes of incompressible solids")
    return values[0], values[1], values[2], values[3]
