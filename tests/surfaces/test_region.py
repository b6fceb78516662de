"""Every sample lies in its region, whatever the method."""

import numpy as np
import pytest
from oracles.setups.solids import ball, box, surface_of
from surfaces import HERE, error_of, placement

from tgdsl.placement.sample.sample import sample
from tgdsl.surfaces.region import _rim

REGIONS = [
    ({"facing": [0, 0, 2], "within": "30 deg"}, lambda pos, normal: normal[:, 2] >= np.cos(np.radians(30)) - 1e-9),
    (
        {"box": {"min": [-0.002, -1, -1], "max": [0.005, 1, 1]}},
        lambda pos, normal: (pos[:, 0] + 0.002) * (0.005 - pos[:, 0]) >= -1e-9,
    ),
    (
        {"sphere": {"center": [0, 0.01, 0], "radius": 0.006}},
        lambda pos, normal: np.linalg.norm(pos - [0, 0.01, 0], axis=1) <= 0.006 + 2e-7,
    ),
    ({"geoms": ["no", "mesh0"]}, lambda pos, normal: pos[:, 0] < 0.012),
    ({"geoms": {"include": ["g*"], "exclude": ["*1"]}}, lambda pos, normal: pos[:, 0] < 0.012),
]


@pytest.mark.parametrize(
    "keys",
    [{"method": "poisson", "count": 150}, {"method": "grid", "rows": 9, "columns": 11, "direction": [0, -1, -1]}],
)
@pytest.mark.parametrize("parts", [*[[i] for i in range(len(REGIONS))], [1, 2, 3], [0, 1]], ids=str)
def test_samples_lie_in_all_regions(keys, parts):
    surface = surface_of(ball(0.01), ball(0.01, (0.03, 0, 0)))
    regions = [REGIONS[i][0] for i in parts]
    samples = sample(surface, placement(**keys, region=regions if len(parts) > 1 else regions[0]), HERE)
    assert len(samples.pos)
    for i in parts:
        assert REGIONS[i][1](samples.pos, samples.normal).all()
    if parts in ([3], [4]) and keys["method"] == "poisson":
        np.testing.assert_allclose(samples.area.sum(), ball(0.01).area, rtol=1e-9)


def test_unknown_and_excluded_geoms_are_named():
    surface = surface_of(box((1, 1, 1)), box((1, 1, 1)))
    assert str(error_of(surface, placement("poisson", count=3, region={"geoms": "mesh7"}))) == (
        'no geom or mesh of this link matches "mesh7"; did you mean "mesh1"?'
    )
    nothing = {"geoms": {"include": ["g0"], "exclude": ["*0"]}}
    assert str(error_of(surface, placement("poisson", count=3, region=nothing))) == (
        "`exclude` leaves none of the geoms that `include` takes; exclude less"
    )


def test_the_rim_of_a_sphere_is_where_edges_cross_it():
    """Of a right triangle, the legs cross the unit sphere about their corner; the hypotenuse is √2 away."""
    triangle = np.array([[[0.0, 0, 0], [2, 0, 0], [0, 2, 0]]])
    rim = _rim(triangle, np.zeros(3), 1.0)[0]
    found = rim[np.isfinite(rim).all(axis=1)]
    np.testing.assert_allclose(found[np.argsort(found[:, 0])], [[0, 1, 0], [1, 0, 0]], atol=1e-12)
