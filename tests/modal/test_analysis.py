"""From shape and material to frequencies, decays and gains in Hz, 1/s and 1/kg; what is kept; what cannot be analysed."""

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


def made_of(material: Material | str, count: int = 8) -> ShapeModes:
    own = MATERIALS[material] if isinstance(material, str) else material
    return ShapeModes.model_construct(material=own, count=count)


STEEL = made_of("steel")
BAR = (0.2, 0.02, 0.012)


def test_frequencies_scale_exactly():
    """Frequencies are as √(E/ρ)/L, d by (α + β ω²)/2 and g ∝ 1/ρL³, to 1e-6: of one shape, at other sizes and of other stuff."""
    base = MATERIALS["steel"]
    other = dataclasses.replace(base, youngs_modulus=3e9, density=1100.0, mass_damping=7.0, stiffness_damping=2e-7)
    first = analysed("bar", surface_of(box(BAR)), STEEL, 1e9)
    for scale in (1.0, 0.3, 17.0):
        found = analysed("bar", surface_of(box((*(scale * side for side in BAR),))), made_of(other), 1e9)
        assert found.decay == pytest.approx((7.0 + 2e-7 * (2 * np.pi * found.frequency) ** 2) / 2, rel=1e-12)
        assert found.gain == pytest.approx(first.gain * base.density / 1100.0 / scale**3, rel=1e-6)
        assert found.shapes.value == pytest.approx(first.shapes.value, abs=1e-5)
        assert found.shapes.low == pytest.approx(first.shapes.low * scale, abs=1e-9)
        assert found.shapes.step == pytest.approx(first.shapes.step * scale, abs=1e-9)


def test_one_analysis_per_shape_and_poissons_ratio(monkeypatch, tmp_path):
    """Three materials of one ratio share an analysis; another ratio takes its own; the cache returns equal results."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    computed = []
    own = spectra._computed
    monkeypatch.setattr(spectra, "_computed", lambda *given: computed.append(given[2]) or own(*given))
    base = MATERIALS["steel"]
    for youngs_modulus in (1e9, 7e10, 2e11):
        analysed("bar", surface_of(box(BAR)), made_of(dataclasses.replace(base, youngs_modulus=youngs_modulus)), 1e9)
    assert len(computed) == 1
    analysed("bar", surface_of(box((0.4, 0.04, 0.024))), STEEL, 1e9)
    assert len(computed) == 1, "a similar bar"
    analysed("bar", surface_of(box(BAR)), made_of("wood"), 1e9)
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
    """Bending across one side: φ² is 1/m in the mean, along the normal of two of its four sides; and 4/m at its ends.

    So g is the share s of these two sides over m, and a point of them is struck φ √(m/s) as much as the mean, to one side of the
    bar as hard as to the other from the other side.
    """
    length, height, width = 0.4, 0.01, 0.006
    mass = MATERIALS["steel"].density * length * height * width
    found = analysed("bar", surface_of(box((length, height, width))), STEEL, 1e9)
    sides = 2 * length * np.array([height, width]) / (2 * length * (height + width) + 2 * height * width)
    assert found.gain[:2] == pytest.approx(sides / mass, rel=0.01), "first the thin way, whose wide sides move"
    beta, x = 4.73004 / length, np.tile(np.linspace(-0.5, 0.5, 33) * length, 2)
    side = np.repeat([1.0, -1.0], 33)
    shape = np.cos(beta * x) / np.cos(2.36502) + np.cosh(beta * x) / np.cosh(2.36502)
    wanted = shape / np.sqrt(sides[0]) * side
    outward = np.outer(side, [0.0, 0.0, 1.0])
    got = found.shapes.share(np.stack([x, 0 * x, side * width / 2], axis=1), outward)[:, 0]
    assert got * np.sign(got @ wanted) == pytest.approx(wanted, abs=0.04)
    assert np.abs(wanted).max() > 2.0


def test_gains_of_modes_that_symmetry_makes_equal():
    """A square bar bends all ways at one frequency: as one mode, with √2 times the gain of each way."""
    length, side = 0.4, 0.01
    mass = MATERIALS["steel"].density * length * side**2
    found = analysed("bar", surface_of(box((length, side, side))), STEEL, 1e9)
    share = length / (2 * length + side)
    assert found.gain[:2] == pytest.approx(np.full(2, np.sqrt(2) * share / mass), rel=0.01)
    assert (np.diff(found.frequency) > 0).all()


def test_a_box_of_slabs_is_a_box_with_a_cavity():
    """Geoms that touch are one solid: the same modes, frequency by frequency, and gain by gain."""
    one = analysed("box", surface_of(thin_box(0.1, 0.02)), STEEL, 1e9)
    other = analysed("box", surface_of(*slabs(0.1, 0.02)), STEEL, 1e9)
    assert other.frequency == pytest.approx(one.frequency, rel=1e-6)
    assert other.gain == pytest.approx(one.gain, rel=1e-5)


def test_only_modes_that_are_wanted_and_ring():
    """Those up to a frequency, but at least the lowest; and none that creeps back."""
    every = analysed("bar", surface_of(box(BAR)), STEEL, 1e9)
    assert len(every.frequency) == 8
    assert (
        analysed("bar", surface_of(box(BAR)), STEEL, float(every.frequency[3])).frequency.tolist()
        == every.frequency[:4].tolist()
    )
    assert analysed("bar", surface_of(box(BAR)), STEEL, 1.0).frequency.tolist() == every.frequency[:1].tolist()
    thick = dataclasses.replace(MATERIALS["steel"], stiffness_damping=2 / (2 * np.pi * every.frequency[2] * 1.01))
    assert len(analysed("bar", surface_of(box(BAR)), made_of(thick), 1e9).frequency) == 3


def test_small_parts_are_left_out_and_large_ones_are_an_error():
    crumb = surface_of(box(BAR), box((0.005, 0.005, 0.005), at=(0.0, 0.05, 0.0)))
    alone = analysed("bar", surface_of(box(BAR)), STEEL, 1e9)
    assert analysed("bar", crumb, STEEL, 1e9).frequency[:2] == pytest.approx(alone.frequency[:2], rel=0.01)
    with pytest.raises(LowerError, match=r'modes of "two": it is 2 parts that do not touch, of 50.0%, 50.0% of its volume'):
        analysed("two", surface_of(box(BAR), box(BAR, at=(0.0, 0.1, 0.0))), STEEL, 1e9)


def with_damping(**changes: float | None) -> ShapeModes:
    return made_of(dataclasses.replace(MATERIALS["steel"], **changes))


@pytest.mark.parametrize(
    ("given", "surface", "message"),
    [
        (
            made_of("water"),
            box(BAR),
            r'modes of "cup": water has no Young\'s modulus and no Poisson\'s ratio and no damping; give ',
        ),
        (with_damping(mass_damping=None), box(BAR), r"like steel|steel has no damping; give mass_damping, or list its modes"),
        (with_damping(poissons_ratio=0.5), box(BAR), r"Poisson's ratio of steel is 0.5, expected at most 0.4999"),
        (with_damping(mass_damping=1e9), box(BAR), r'none of the modes of "cup" rings: steel damps the lowest one, at \d+'),
    ],
    ids=["liquid", "undamped", "incompressible", "creeps"],
)
def test_materials_that_do_not_do(given, surface, message):
    with pytest.raises(LowerError, match=message) as caught:
        analysed("cup", surface_of(surface), given, 1e9)
    assert caught.value.field == "modes"


def test_a_mesh_that_is_open_is_an_error_that_names_the_body():
    mesh = box(BAR)
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    with pytest.raises(LowerError, match=r'modes of "cup": geom "g0" is open'):
        analysed("cup", surface_of(mesh), STEEL, 1e9)


@pytest.mark.slow
def test_thin_walled_boxes_ring(monkeypatch):
    """10 cm, walls of 2 mm, with four fifths of the default's unknowns: at least four modes below 0.45 of 16 kHz, within 2 % of finer ones.

    The lowest is that of elements of half the size, with 95,000 unknowns: κ 0.15844 at Poisson's ratio 0.3.
    """
    monkeypatch.setattr(spectra, "UNKNOWNS", 20_000)
    found = analysed("box", surface_of(thin_box(0.1, 0.002)), made_of("wood", 6), 0.45 * 16_000)
    assert len(found.frequency) >= 4
    own = MATERIALS["wood"]
    wave_number = 2 * np.pi * found.frequency[0] * 0.1 / np.sqrt(own.youngs_modulus / own.density)
    assert wave_number == pytest.approx(0.15844 * np.sqrt(0.91 / (1 - own.poissons_ratio**2)), rel=0.02)


def test_a_hollow_ball_across_its_cells():
    """Thin walls that follow no plane: the lowest modes of a shell of t/a = 0.04, degree 2, by membrane theory (Baker 1961).

    Its frequencies Ω = ωa√(ρ/E) are the lower roots of Ω⁴(1 − ν²)² − Ω²(1 − ν²)(1 + 3ν + λ) + (1 − ν²)(λ − 2) = 0 with λ = n(n + 1).
    """
    ratio, degree = 0.3, 2
    turn, last = 1 + 3 * ratio + degree * (degree + 1), (1 - ratio**2) * (degree * (degree + 1) - 2)
    square = (turn - np.sqrt(turn**2 - 4 * last)) / (2 * (1 - ratio**2))
    found, _, _ = spectra.spectrum(surface_of(hollow(ball(0.05, subdivisions=3), ball(0.048, subdivisions=3))), ratio, 2, 4000)
    assert found.wave_number[0] * 0.049 / 0.1 == pytest.approx(np.sqrt(square), rel=0.02)
    assert found.multiplicity[0] == 5


def test_the_surface_of_nothing():
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), ())
    with pytest.raises(LowerError, match=r'modes of "cup": there are no triangles'):
        analysed("cup", nothing, STEEL, 1e9)
