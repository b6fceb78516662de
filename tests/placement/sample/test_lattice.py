"""Lattices of lines hit each point of a surface once, however it is triangulated."""

import numpy as np
import pytest
from oracles.setups.solids import ball, box
from scipy import stats
from scipy.spatial.transform import Rotation
from surfaces import plate

from tgdsl.placement.sample import lattice

TOLERANCE = 1e-15  # metres: rounding of centimetres in float64


@pytest.mark.parametrize("cuts", [1, 3])
def test_points_are_the_same_however_a_box_is_cut_into_triangles(cuts):
    first, second = (lattice.hits(np.array(box((0.02, 0.03, 0.05), cuts=c).triangles), 1e-3, 5) for c in (0, cuts))
    np.testing.assert_allclose(second.pos, first.pos, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(second.area, first.area, rtol=1e-12)


def test_the_order_of_faces_makes_no_difference():
    corners = np.array(ball(0.01).triangles)
    order = np.random.default_rng(0).permutation(len(corners))
    first, second = lattice.hits(corners, 5e-4, 0), lattice.hits(corners[order], 5e-4, 0)
    np.testing.assert_array_equal(second.pos, first.pos)
    np.testing.assert_array_equal(order[second.piece], first.piece)


def test_each_square_of_a_face_across_an_axis_has_one_point():
    corners = np.array(box((0.08, 0.08, 0.02)).triangles)  # 64 by 64 squares of 1.25 mm
    result = lattice.hits(corners, 0.00125, 0)
    on_top = result.pos[result.pos[:, 2] == 0.01]
    square, counts = np.unique(np.floor(on_top[:, :2] / 0.00125), axis=0, return_counts=True)
    assert len(square) == 64 * 64
    assert (counts == 1).all()
    np.testing.assert_array_equal(result.area, 0.00125**2)
    for offset in (on_top[:, :2] / 0.00125 % 1).T:
        assert stats.kstest(offset, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("turn", [(0, 0, 0), (0.5, 0.9, 0), (0.3, 0, 0.7), (0, 0.37, 0), (1.1, 0.6, 0.2)])
def test_points_represent_the_area_of_a_rotated_plate(turn):
    rotation = Rotation.from_euler("xyz", turn).as_matrix()
    corners = np.array(plate(np.array([0, 0, 1.0]), size=0.1).triangles) @ rotation.T
    result = lattice.hits(corners, 1e-3, 1)
    np.testing.assert_allclose(
        result.area.sum(), 0.01, rtol=0.02
    )  # about 10,000 points; squares at the border are partly outside
    slope = np.abs(rotation[:, 2])
    np.testing.assert_allclose(len(result.pos), slope[slope >= lattice.STEEP].sum() * 1e4, rtol=0.03)


def test_hits_on_a_sliver_lie_inside_it():
    corners = np.array([[[0, 0, 0], [1, 1, 0], [1, 1 + 1e-3, 0]]])
    result = lattice.hits(corners, 1e-3, 0)
    x, y = result.pos[:, 0], result.pos[:, 1]
    assert ((y >= x) & (y <= x * (1 + 1e-3)) & (x <= 1)).all()
    np.testing.assert_allclose(result.area.sum(), 5e-4, rtol=0.2)


def test_seeds_and_axes_draw_different_lines():
    corners = np.array(box((0.02, 0.02, 0.02)).triangles)
    positions = {seed: lattice.hits(corners, 1e-3, seed).pos for seed in (0, 1, 2**64 - 1, 10**30)}
    assert len({pos.tobytes() for pos in positions.values()}) == 4
    sides = [np.sort(np.delete(positions[0][positions[0][:, axis] == 0.01], axis, axis=1), axis=0) for axis in range(3)]
    assert not np.array_equal(sides[0], sides[1])
    assert not np.array_equal(sides[1], sides[2])


def test_pitches_are_a_fixed_series():
    assert lattice.pitch_below(1.0) == 1.0
    assert lattice.pitch_below(0.999) == 2 ** (-1 / 4)
    assert lattice.pitch_below(1e-3) == lattice.pitch_below(1e-3 * (1 + 1e-7))
