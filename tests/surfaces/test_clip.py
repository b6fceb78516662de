"""Surfaces clipped to a region: area, position and orientation of the rest."""

import numpy as np
import pytest
from oracles.setups.solids import ball, box, surface_of
from pydantic import TypeAdapter

from tgdsl.errors import SampleError
from tgdsl.fields.regions import Region
from tgdsl.surfaces.region import clip

READ = TypeAdapter(Region).validate_python
UP = {"facing": [0, 0, 1], "within": "10 deg"}


def bounds(low, high):
    return {"box": {"min": low, "max": high}}


def test_a_rectangle_is_cut_out_of_a_face():
    clipped = clip(surface_of(box((0.04, 0.03, 0.02))), READ([UP, bounds([-0.01, -0.005, 0], [0.015, 1, 1])]))
    np.testing.assert_allclose(clipped.face_areas.sum(), 0.025 * 0.02, rtol=1e-9)
    np.testing.assert_allclose(clipped.face_normals, np.broadcast_to([0, 0, 1.0], (len(clipped.faces), 3)), atol=1e-12)
    np.testing.assert_allclose(
        [clipped.vertices.min(axis=0), clipped.vertices.max(axis=0)], [[-0.01, -0.005, 0.01], [0.015, 0.015, 0.01]]
    )


def test_halves_add_up_whatever_the_triangles():
    whole = surface_of(ball(0.01))
    parts = [
        clip(whole, READ(bounds(low, high))) for low, high in (([-1, -1, -1], [0.003, 1, 1]), ([0.003, -1, -1], [1, 1, 1]))
    ]
    np.testing.assert_allclose(sum(part.face_areas.sum() for part in parts), whole.face_areas.sum(), rtol=1e-9)
    for part in parts:
        assert (part.face_normals @ np.array([0, 0, 1.0]) * part.corners.mean(axis=1)[:, 2] >= -1e-9).all()  # outward still


def test_geoms_keep_their_names():
    clipped = clip(surface_of(ball(0.01), ball(0.01, (0.03, 0, 0))), READ({"geoms": "g1"}))
    assert {clipped.geoms[i][0] for i in clipped.face_geom} == {"g1"}


@pytest.mark.parametrize(
    ("region", "message"),
    [
        ({"sphere": {"center": [0, 0, 0], "radius": 0.01}}, "a sphere does not cut faces straight; use facing, box or geoms"),
        (bounds([1, 1, 1], [2, 2, 2]), "the region holds nothing of the link's surface; widen it"),
        ({"geoms": "g2"}, 'no geom or mesh of this link matches "g2"'),
    ],
)
def test_regions_that_cannot_be_cut_are_refused(region, message):
    with pytest.raises(SampleError, match=message):
        clip(surface_of(box((0.04, 0.03, 0.02))), READ(region))
