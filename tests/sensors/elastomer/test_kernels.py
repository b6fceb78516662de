"""Closed forms, equilibrium and independent solutions of the elastomer's kernels."""

import numpy as np
import pytest
from held import assert_holds
from oracles import half_space, layer, markers
from oracles.half_space import NORMAL, OBLIQUE, TANGENTIAL

from tgdsl.sensors.elastomer.bonded_layer import Layer, profiles
from tgdsl.sensors.elastomer.half_space import half_space as profiles_of
from tgdsl.sensors.elastomer.kernels import Gaussian

NUS = [0.0, 0.3, 0.48, 0.5]


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("z", [0.0, 0.7e-3, 3e-3])
@pytest.mark.parametrize("load", [NORMAL, TANGENTIAL])
def test_a_point_load_is_johnsons(z, nu, load):
    assert_holds(half_space.point_load(z, nu, load))


def test_shear_falls_off_as_one_over_r():
    found = half_space.far_field()
    assert_holds(found)
    assert found.paper_error > 0.5 * found.magnitude


@pytest.mark.parametrize("load", [NORMAL, TANGENTIAL, OBLIQUE])
@pytest.mark.parametrize("patch", [0.0, 1e-3])
def test_the_half_space_is_in_equilibrium(patch, load):
    assert_holds(half_space.equilibrium(patch, load))


@pytest.mark.parametrize("patch", [0.0, 1e-3])
def test_the_stress_below_carries_the_load(patch):
    assert_holds(half_space.carried_load(patch))


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("z", [0.0, 0.5e-3, 2e-3])
def test_a_patch_is_a_point_load_from_six_radii_on(z, nu):
    assert_holds(half_space.patch_far_off(z, nu))


def test_a_patch_has_the_discs_load_second_moment_and_own_displacement():
    assert_holds(half_space.patch_moment())
    assert_holds(half_space.loaded_disc())
    own = profiles_of(np.zeros(1), 0.0, 1.3e-3, half_space.G, 0.4)
    assert own.spread[0] == own.lift[0] == own.bend[0] == 0.0


@pytest.mark.parametrize("z", [0.0, 0.4e-3])
def test_the_patchs_closed_form_is_its_hankel_integral(z):
    assert_holds(half_space.hankel(z))


def test_the_surface_under_hertzs_pressure_is_the_balls():
    assert_holds(half_space.hertz_surface())


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("kt", [0.3, 1.0, 3.0])
def test_the_layers_response_solves_naviers_equations(nu, kt):
    assert_holds(layer.boundary_value(kt, nu))


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("compare", [layer.surface_response, layer.shear_wave, layer.reciprocity])
def test_the_layers_surface_response_in_closed_form(nu, compare):
    assert_holds(compare(nu))


def test_a_thin_layer_is_a_winkler_foundation():
    assert_holds(layer.thin_compressible())
    assert_holds(layer.thin_incompressible())


@pytest.mark.parametrize("nu", [0.3, 0.5])
@pytest.mark.parametrize("z", [0.0, 1e-3])
def test_a_thick_layer_is_the_half_space(nu, z):
    assert_holds(layer.thick(z, nu))
    assert_holds(layer.thick_order(z, nu))


def test_the_table_is_the_integral():
    assert_holds(layer.table())


def test_a_layer_moves_nothing_at_its_base_and_no_volume_if_incompressible():
    assert_holds(layer.bonded_base())
    assert_holds(layer.no_volume())
    assert profiles(np.linspace(0.0, 0.03, 3001), Layer(2e-3, 0.0, half_space.G, 0.5), 1e-3).normal.min() < 0


@pytest.mark.parametrize("compare", [layer.hertz_force, layer.thin_layer_force])
def test_the_force_of_a_ball(compare):
    assert_holds(compare())


@pytest.mark.parametrize("kernel", markers.SKINS)
def test_twice_the_taxels_change_the_mean_little(kernel):
    """A ball pressed into a pad of 12² and of 17² taxels (half the area each): mean |u| over the pad within 2 %, for each part."""
    assert_holds(markers.resolution(kernel))


def test_the_papers_model_grows_with_the_number_of_taxels():
    assert_holds(markers.paper_grows())


def test_offsets_on_a_curved_fingertip_are_exact_where_one_plane_is_not():
    """Neighbours on a cylinder of 8 mm, up to 70° off the middle, as the marker's own tangent plane sees them: R sin(Δ)."""
    found = markers.curved_offsets()
    assert_holds(found)
    assert (found.paper / found.exact).min() < 0.55
    part = markers.sheet(8, 2 * np.deg2rad(80) * 8e-3, curve=8e-3)
    u = Gaussian(8000.0, 2000.0, 1.0, 1e-3, False).spread(part.pos, part.normal, part.pos)
    assert np.abs(np.einsum("kaji,jk->ji", u, part.normal)).max() < 1e-18


def test_elastic_displacements_between_curved_frames():
    assert_holds(half_space.curved_frames())


def test_volume_and_blend_of_the_gaussian():
    """C = 0: ḡ/ρ̄ ρ, whose in-plane displacement is ḡ at r = ε if normalized peaks are left out, and falls off as 1/r."""
    assert_holds(markers.far_part())
    assert_holds(markers.peak_of_the_kernel())
    assert_holds(markers.normalized_peak())
    assert markers.peak_of_the_kernel().ours[0] == pytest.approx(208.55, rel=1e-4)
