"""From shape and material to frequencies [Hz], decays [1/s] and gains [1/kg]; kept modes; errors."""

import dataclasses

import numpy as np
import pytest
from oracles.setups.solids import ball, box, surface_of
from ringing_bodies import hollow, slabs, thin_box

from tgdsl.errors import LowerError
from tgdsl.fields.materials import MATERIALS, Material
from tgdsl.files import cache
from tgdsl.modal import analysis as spectra
from tgdsl.modal.analysis import analysed
from tgdsl.modal.modes import ShapeModes
from tgdsl.surfaces.surface import Surface


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setattr(spectra, "UNKNOWNS", 2500)


def shape_modes(material: Material | str, count: int = 8) -> ShapeModes:
    resolved = MATERIALS[material] if isinstance(material, str) else material
    return ShapeModes.model_construct(material=resolved, count=count)


STEEL = shape_modes("steel")
BAR = (0.2, 0.02, 0.012)


def test_frequencies_scale_exactly():
    """Frequency scales as √(E/ρ)/L, d = (α + β ω²)/2 and g ∝ 1/ρL³, to 1e-6, across sizes and materials of one shape."""
    base = MATERIALS["steel"]
    other = dataclasses.replace(base, youngs_modulus=3e9, density=1100.0, mass_damping=7.0, stiffness_damping=2e-7)
    first = analysed("bar", surface_of(box(BAR)), STEEL, 1e9)
    for scale in (1.0, 0.3, 17.0):
        modes = analysed("bar", surface_of(box((*(scale * side for side in BAR),))), shape_modes(other), 1e9)
        assert modes.decay == pytest.approx((7.0 + 2e-7 * (2 * np.pi * modes.frequency) ** 2) / 2, rel=1e-12)
        assert modes.gain == pytest.approx(first.gain * base.density / 1100.0 / scale**3, rel=1e-6)
        assert modes.shapes.value == pytest.approx(first.shapes.value, abs=1e-5)
        assert modes.shapes.low == pytest.approx(first.shapes.low * scale, abs=1e-9)
        assert modes.shapes.step == pytest.approx(first.shapes.step * scale, abs=1e-9)


def test_one_analysis_per_shape_and_poissons_ratio(monkeypatch, tmp_path):
    """Three materials of one ratio share an analysis; another ratio gets its own; the cache returns equal results."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    computed = []
    original = spectra._computed
    monkeypatch.setattr(spectra, "_computed", lambda *arguments: computed.append(arguments[2]) or original(*arguments))
    base = MATERIALS["steel"]
    for youngs_modulus in (1e9, 7e10, 2e11):
        analysed("bar", surface_of(box(BAR)), shape_modes(dataclasses.replace(base, youngs_modulus=youngs_modulus)), 1e9)
    assert len(computed) == 1
    analysed("bar", surface_of(box((0.4, 0.04, 0.024))), STEEL, 1e9)
    assert len(computed) == 1, "a similar bar"
    analysed("bar", surface_of(box(BAR)), shape_modes("wood"), 1e9)
    assert computed == [base.poissons_ratio, MATERIALS["wood"].poissons_ratio]
    assert len(cache.entries()) == 2
    fresh = analysed("bar", surface_of(box(BAR)), STEEL, 1e9)
    cache.evict(-1)
    again = analysed("bar", surface_of(box(BAR)), STEEL, 1e9)
    for name in ("frequency", "decay", "gain"):
        assert getattr(fresh, name).tobytes() == getattr(again, name).tobytes()
    for name in ("low", "step", "num", "value", "owner", "error"):
        assert getattr(fresh.shapes, name).tobytes() == getattr(again.shapes, name).tobytes()


def test_gains_of_a_slender_bar():
    """Bending across one side: φ² averages 1/m along the normal of two of the four sides, and is 4/m at the ends.

    So g is the share s of these two sides over m. A point on them is struck φ √(m/s) times as hard as the mean,
    with opposite signs on opposite sides.
    """
    length, height, width = 0.4, 0.01, 0.006
    mass = MATERIALS["steel"].density * length * height * width
    modes = analysed("bar", surface_of(box((length, height, width))), STEEL, 1e9)
    sides = 2 * length * np.array([height, width]) / (2 * length * (height + width) + 2 * height * width)
    assert modes.gain[:2] == pytest.approx(sides / mass, rel=0.01), "first the thin way, whose wide sides move"
    beta, x = 4.73004 / length, np.tile(np.linspace(-0.5, 0.5, 33) * length, 2)
    side = np.repeat([1.0, -1.0], 33)
    shape = np.cos(beta * x) / np.cos(2.36502) + np.cosh(beta * x) / np.cosh(2.36502)
    expected = shape / np.sqrt(sides[0]) * side
    outward = np.outer(side, [0.0, 0.0, 1.0])
    shares = modes.shapes.share(np.stack([x, 0 * x, side * width / 2], axis=1), outward)[:, 0]
    assert shares * np.sign(shares @ expected) == pytest.approx(expected, abs=0.04)
    assert np.abs(expected).max() > 2.0


def test_equal_modes_by_symmetry_merge_their_gains():
    """A square bar bends all ways at one frequency: one mode, with √2 times the gain of each way."""
    length, side = 0.4, 0.01
    mass = MATERIALS["steel"].density * length * side**2
    modes = analysed("bar", surface_of(box((length, side, side))), STEEL, 1e9)
    share = length / (2 * length + side)
    assert modes.gain[:2] == pytest.approx(np.full(2, np.sqrt(2) * share / mass), rel=0.01)
    assert (np.diff(modes.frequency) > 0).all()


def test_a_box_of_slabs_is_a_box_with_a_cavity():
    """Touching geoms are one solid: the modes agree in frequency and gain."""
    one = analysed("box", surface_of(thin_box(0.1, 0.02)), STEEL, 1e9)
    other = analysed("box", surface_of(*slabs(0.1, 0.02)), STEEL, 1e9)
    assert other.frequency == pytest.approx(one.frequency, rel=1e-6)
    assert other.gain == pytest.approx(one.gain, rel=1e-5)


def test_only_requested_modes_that_ring_are_kept():
    """Modes up to a frequency, but at least the lowest; overdamped modes are dropped."""
    every = analysed("bar", surface_of(box(BAR)), STEEL, 1e9)
    assert len(every.frequency) == 8
    assert (
        analysed("bar", surface_of(box(BAR)), STEEL, float(every.frequency[3])).frequency.tolist()
        == every.frequency[:4].tolist()
    )
    assert analysed("bar", surface_of(box(BAR)), STEEL, 1.0).frequency.tolist() == every.frequency[:1].tolist()
    thick = dataclasses.replace(MATERIALS["steel"], stiffness_damping=2 / (2 * np.pi * every.frequency[2] * 1.01))
    assert len(analysed("bar", surface_of(box(BAR)), shape_modes(thick), 1e9).frequency) == 3


def test_small_parts_are_dropped_and_large_ones_are_an_error():
    crumb = surface_of(box(BAR), box((0.005, 0.005, 0.005), at=(0.0, 0.05, 0.0)))
    alone = analysed("bar", surface_of(box(BAR)), STEEL, 1e9)
    assert analysed("bar", crumb, STEEL, 1e9).frequency[:2] == pytest.approx(alone.frequency[:2], rel=0.01)
    with pytest.raises(LowerError, match=r'modes of "two": it is 2 parts that do not touch, of 50.0%, 50.0% of its volume'):
        analysed("two", surface_of(box(BAR), box(BAR, at=(0.0, 0.1, 0.0))), STEEL, 1e9)


def steel_with(**changes: float | None) -> ShapeModes:
    return shape_modes(dataclasses.replace(MATERIALS["steel"], **changes))


@pytest.mark.parametrize(
    ("given", "surface", "message"),
    [
        (
            shape_modes("water"),
            box(BAR),
            r'modes of "cup": water has no Young\'s modulus and no Poisson\'s ratio and no damping; give ',
        ),
        (steel_with(mass_damping=None), box(BAR), r"like steel|steel has no damping; give mass_damping, or list its modes"),
        (steel_with(poissons_ratio=0.5), box(BAR), r"Poisson's ratio of steel is 0.5, expected at most 0.4999"),
        (steel_with(mass_damping=1e9), box(BAR), r'none of the modes of "cup" rings: steel damps the lowest one, at \d+'),
    ],
    ids=["liquid", "undamped", "incompressible", "creeps"],
)
def test_unsuitable_materials_are_errors(given, surface, message):
    with pytest.raises(LowerError, match=message) as caught:
        analysed("cup", surface_of(surface), given, 1e9)
    assert caught.value.field == "modes"


def test_an_open_mesh_is_an_error_that_names_the_body():
    mesh = box(BAR)
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    with pytest.raises(LowerError, match=r'modes of "cup": geom "g0" is open'):
        analysed("cup", surface_of(mesh), STEEL, 1e9)


@pytest.mark.slow
def test_thin_walled_boxes_ring(monkeypatch):
    """10 cm, walls of 2 mm, four fifths of the default unknowns: at least four modes below 0.45 of 16 kHz, within 2 % of finer meshes.

    The expected lowest one is from elements of half the size, with 95,000 unknowns: κ 0.15844 at Poisson's ratio 0.3.
    """
    monkeypatch.setattr(spectra, "UNKNOWNS", 20_000)
    modes = analysed("box", surface_of(thin_box(0.1, 0.002)), shape_modes("wood", 6), 0.45 * 16_000)
    assert len(modes.frequency) >= 4
    wood = MATERIALS["wood"]
    wave_number = 2 * np.pi * modes.frequency[0] * 0.1 / np.sqrt(wood.youngs_modulus / wood.density)
    assert wave_number == pytest.approx(0.15844 * np.sqrt(0.91 / (1 - wood.poissons_ratio**2)), rel=0.02)


def test_a_hollow_ball_across_its_cells():
    """Curved thin walls: the lowest modes of a shell of t/a = 0.04, degree 2, by membrane theory (Baker 1961).

    Its frequencies Ω = ωa√(ρ/E) are the lower roots of Ω⁴(1 − ν²)² − Ω²(1 − ν²)(1 + 3ν + λ) + (1 − ν²)(λ − 2) = 0 with λ = n(n + 1).
    """
    ratio, degree = 0.3, 2
    turn, last = 1 + 3 * ratio + degree * (degree + 1), (1 - ratio**2) * (degree * (degree + 1) - 2)
    square = (turn - np.sqrt(turn**2 - 4 * last)) / (2 * (1 - ratio**2))
    modes, _, _ = spectra.spectrum(surface_of(hollow(ball(0.05, subdivisions=3), ball(0.048, subdivisions=3))), ratio, 2, 4000)
    assert modes.wave_number[0] * 0.049 / 0.1 == pytest.approx(np.sqrt(square), rel=0.02)
    assert modes.multiplicity[0] == 5


def test_an_empty_surface_is_an_error():
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), ())
    with pytest.raises(LowerError, match=r'modes of "cup": there are no triangles'):
        analysed("cup", nothing, STEEL, 1e9)
