"""The oracle of distances to several geoms, by hand."""

import numpy as np

from tgdsl.quantities.geoms import ReferenceGeom, distance_to

TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""A quarter turn about z."""


def test_the_nearest_geom_counts_and_the_first_of_equals():
    """A ball of 1 cm at the origin, and a rotated box with a wall at x = 3 cm."""
    ball = ReferenceGeom("sphere", np.array([0.01, 0, 0]), np.zeros(3), np.eye(3))
    box = ReferenceGeom("box", np.array([0.01, 0.02, 0.01]), np.array([0.05, 0, 0]), TURNED)
    for x, distance, outward in ((0.015, 0.005, 1), (0.026, 0.004, -1), (0.032, -0.002, -1)):
        measured, gradient = distance_to([ball, box], np.array([x, 0, 0]))
        np.testing.assert_allclose([measured, *gradient], [distance, outward, 0, 0], atol=1e-15)
    for geoms, outward in (([ball, box], 1), ([box, ball], -1)):
        measured, gradient = distance_to(geoms, np.array([0.02, 0, 0]))
        np.testing.assert_allclose([measured, *gradient], [0.01, outward, 0, 0], atol=1e-15)


def test_no_geoms_are_infinitely_far_without_direction():
    distance, outward = distance_to([], np.zeros(3))
    assert distance == np.inf and outward.tolist() == [0, 0, 0]
