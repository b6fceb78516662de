"""Modal analysis: from the triangles around a solid, and its material, to its modes.

    f = κ √(E/ρ) / 2πL,   d = (α + β ω²)/2,   g = γ/m

with κ = ω L/c and γ = g m of the shape (`spectrum`), L the longest side of its bounding box, m its mass, and Rayleigh's
damping α [1/s] and β [s] of the material. In mass-normalised modal coordinates q [m·√kg] a force F at x moves the body by

    q̈ + 2d q̇ + ω² q = φ_n(x) F(t),   displacement of the surface along its normal at y: φ_n(y) q

and g is φ_n(x) φ_n(y) with root mean squares over the surface for both: an impulse J at some point of it makes the surface move
with the velocity g J e^(−dt) cos ωt, in the mean. `modes.loudness` says what g is where symmetry makes modes equal.

The body is free and homogeneous: held, filled or glued, it has other modes. Damping by air counts as far as the source of the
material's damping has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError
from tgdsl.fields.materials import Material
from tgdsl.files import cache
from tgdsl.modal import cells
from tgdsl.modal.cells import closed, enclosed, refused
from tgdsl.modal.elasticity import Elements, ShapeGrid, on_grid, vibration
from tgdsl.modal.modes import Modes, ModeShapes, ShapeModes, loudness
from tgdsl.surfaces.surface import Surface

FORMAT = b"tgdsl modes 4"  # version of cached results; change it with any change of the computation
UNKNOWNS = 25_000  # target number of unknowns, which sets the size of cells
MAX_UNKNOWNS = 60_000  # bound on it: a body whose flat walls alone ask for more cells is refused
FINEST = 1 / 48  # smallest cells, over the size of the body
COARSEST = 1 / 3  # largest cells
BULKY = 1.0  # smallest cells, over the volume over the surface: a ball or a cube has six of them from side to side
ROUNDS = 6  # times that the size of the cells is adjusted
SIGHT, GLANCE = 12, 3  # lines of sight through a cell along each axis: for the analysis, and to count cells
SLIVER = 2e-3  # share of a cell that is filled below which it is left out: too few lines of sight pass through the body there
WHOLE = 0.9  # share of the volume that one connected part has at least; smaller parts are left out
DIGITS = 9  # decimals of coordinates, over the size of the body: so that similar bodies are equal


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Modes of a shape by ascending frequency; modes of equal frequency are one."""

    wave_number: Float[np.ndarray, " group"]  # ω L/c with c = √(E/ρ) and the length L of the longest side of the bounding box
    multiplicity: Int[np.ndarray, " group"]  # number of modes that are one
    gain: Float[np.ndarray, " group"]  # gain times the body's mass: see `modes.loudness`
    volume: float  # the body's, over L³
    unknowns: int  # size of the eigenproblem
    axes: Float[np.ndarray, "3 3"]  # the grid's axes, as rows, of the body's
    owner: Int[np.ndarray, " field"]  # the group that each field of the mode shapes belongs to, see `modes.loudness`
    grid: ShapeGrid  # the fields, in the grid's axes, from the middle of the bounding box and over L


def spectrum(
    surface: Surface, poissons_ratio: float, count: int, unknowns: int | None = None, progress: Progress = silent
) -> tuple[Spectrum, float, Float[np.ndarray, " 3"]]:
    """Return the lowest modes of a shape, from the cache if they are there; its size L [m]; and the middle of its box [m].

    The modes of a shape, whatever its size and material: one analysis per shape and Poisson's ratio, kept by content.

    Frequencies of similar bodies are as √(E/ρ)/L, and mode shapes of unit modal mass as 1/√m. So all that follows from the
    shape is computed in units of the body's size L, with E = 1 and ρ = 1, and scaled exactly.

    Shapes: `group` modes of distinct frequency, `field` fields of mode shapes.

    Args:
        surface: Triangles around the body [m].
        poissons_ratio: Less than 1/2.
        count: Most modes of distinct frequency.
        unknowns: Target number of unknowns; default: `UNKNOWNS`.
        progress: Called with a line of text for each long job.

    Raises:
        LowerError: If the surface has no inside, the body falls into parts, or needs more cells than are allowed.
    """
    unknowns = UNKNOWNS if unknowns is None else unknowns
    progress("closing its surface")
    vertices, faces = closed(surface)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size, middle = float((high - low).max()), (low + high) / 2
    vertices = np.round((vertices - middle) / size, DIGITS) + 0.0
    key = cache.digest(FORMAT, [vertices, faces, np.array(poissons_ratio), np.array([count, unknowns])])
    result = cache.cached(
        key, lambda: _computed(vertices, faces, poissons_ratio, count, unknowns, progress), _packed, _unpacked
    )
    return result, size, middle


def _computed(
    vertices: np.ndarray, faces: np.ndarray, poissons_ratio: float, count: int, unknowns: int, progress: Progress
) -> Spectrum:
    turned = cells.axes(vertices, faces)
    placed = vertices @ turned.T
    progress(f"a grid of cells for {unknowns} unknowns")
    lines = _lines(placed, faces, unknowns)
    filled, crossings = cells.filled(placed, faces, lines, SIGHT, SLIVER)
    elements, crossings = _whole(Elements.of(filled), crossings)
    progress(f"stiffness and mass of {len(elements.nodes)} cells")
    stiffness, mass = elements.matrices(poissons_ratio)
    progress(f"eigenproblem of {3 * len(elements.pos)} unknowns")
    # A few more than asked for: some are one, and the last group may lack some of its modes.
    result = vibration(stiffness, mass, count + 8)
    progress("mode shapes on a grid")
    displacement = elements.displacement(crossings.cell, crossings.pos, result.shape)
    normal = np.einsum("xim,xi->xm", displacement, crossings.normal)
    volume = float(elements.filled.volume.sum())
    heard = loudness(result.wave_number, normal, crossings.area, volume)
    first = slice(None, count)
    in_count = heard.owner < count
    return Spectrum(
        wave_number=_rounded(heard.wave_number[first]),
        multiplicity=heard.multiplicity[first],
        gain=_rounded(heard.gain[first]),
        volume=volume,
        unknowns=3 * len(elements.pos),
        axes=turned,
        owner=heard.owner[in_count],
        grid=on_grid(elements, crossings, lines, result.shape @ heard.mixture[:, in_count]),
    )


def _rounded(values: np.ndarray) -> np.ndarray:
    # To nine digits, so that the order in which a machine adds up does not show.
    return np.array([float(f"{value:.9g}") for value in values.tolist()])


def _lines(vertices: np.ndarray, faces: np.ndarray, wanted: int) -> cells.Lines:
    """Return a grid that gives about as many unknowns as wanted, or the finest one."""
    flat = [cells.planes(vertices, faces, axis) for axis in range(3)]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size, area = float((high - low).max()), float(np.asarray(igl.doublearea(vertices, faces)).sum()) / 2
    finest = max(FINEST * size, BULKY * abs(enclosed(vertices, faces)) / area)

    def at(cell: float) -> tuple[cells.Lines, int]:
        x, y, z = (cells.lines(flat[axis], low[axis], high[axis], cell) for axis in range(3))
        filled, _ = cells.filled(vertices, faces, (x, y, z), GLANCE, SLIVER)
        return (x, y, z), 3 * len(Elements.of(filled).pos)

    cell, best = size / 8, None
    for _ in range(ROUNDS):
        result, unknowns = at(cell)
        if unknowns <= wanted and (best is None or unknowns > best[1]):
            best = result, unknowns
        at_end = (unknowns > wanted and cell >= COARSEST * size) or (unknowns <= wanted and cell <= finest)
        if at_end or 0.8 * wanted <= unknowns <= wanted:
            break
        cell = float(np.clip(cell * (unknowns / (0.9 * wanted)) ** 0.4, finest, COARSEST * size))
    if best is None and unknowns > MAX_UNKNOWNS:
        walls = " × ".join(str(len(line) - 1) for line in result)
        raise refused(
            f"its flat walls ask for a grid of {walls} cells and {unknowns} unknowns, {MAX_UNKNOWNS} are allowed",
            "leave out small details",
        )
    return result if best is None else best[0]


def _whole(elements: Elements, crossings: cells.Crossings) -> tuple[Elements, cells.Crossings]:
    """Return the largest connected part of a body."""
    part = elements.part
    if not part.any():
        return elements, crossings
    volume = np.bincount(part, elements.filled.volume)
    if volume[0] < WHOLE * volume.sum():
        shares = ", ".join(f"{share:.1%}" for share in volume[:4] / volume.sum())
        raise refused(f"it is {len(volume)} parts that do not touch, of {shares} of its volume", "join its geoms")
    is_largest = part == 0
    row = np.cumsum(is_largest) - 1
    everything = elements.filled
    filled = cells.Filled(*(getattr(everything, name)[is_largest] for name in ("index", "low", "size", "weight")))
    on = is_largest[crossings.cell]
    one = cells.Crossings(row[crossings.cell[on]], crossings.pos[on], crossings.normal[on], crossings.area[on])
    return Elements.of(filled), one


def _packed(result: Spectrum) -> Mapping[str, np.ndarray]:
    arrays = {name: np.asarray(getattr(result, name)) for name in Spectrum.__dataclass_fields__ if name != "grid"}
    return arrays | {f"grid_{name}": getattr(result.grid, name) for name in ShapeGrid.__dataclass_fields__}


def _unpacked(arrays: Mapping[str, np.ndarray]) -> Spectrum:
    result = {name: arrays[name] for name in Spectrum.__dataclass_fields__ if name != "grid"}
    on_nodes = ShapeGrid(**{name: arrays[f"grid_{name}"] for name in ShapeGrid.__dataclass_fields__})
    return Spectrum(**{**result, "volume": float(result["volume"]), "unknowns": int(result["unknowns"])}, grid=on_nodes)


WANTED = {
    "youngs_modulus": "Young's modulus",
    "poissons_ratio": "Poisson's ratio",
    "mass_damping": "damping",
    "stiffness_damping": "damping",
}
"""Properties of a material that modal analysis needs, with its density."""
MAX_POISSON = 0.4999  # largest Poisson's ratio: elements lock in nearly incompressible solids


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
