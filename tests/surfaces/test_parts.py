"""Parts that touch only along edges: each stays whole and closed, whichever face comes first in the file."""

import numpy as np
import pytest
import trimesh
from oracles.setups.solids import ball, box, surface_of

from tgdsl.surfaces.meshlab import outer_shell
from tgdsl.surfaces.outer import outward
from tgdsl.surfaces.surface import winding_number

PLACES = [(x, y, z) for x in range(3) for y in range(3) for z in range(3)]


@pytest.mark.parametrize("first", [0, 1, 5, 77, 100])
@pytest.mark.parametrize("odd", [0, 1])
def test_checkerboard_cubes_stay_whole(first, odd):
    """13 or 14 cubes of 1 m³ share edges but no faces; the surface winds around their centres, not around gaps."""
    is_cube = [sum(place) % 2 == odd for place in PLACES]
    mesh = trimesh.util.concatenate(
        [box((1, 1, 1), place) for place, is_filled in zip(PLACES, is_cube, strict=True) if is_filled]
    )
    mesh.merge_vertices()
    faces = np.roll(np.asarray(mesh.faces), -first, axis=0)
    result = outward(np.asarray(mesh.vertices), faces, faces)
    assert result.is_orientable and not len(result.caps)
    cubes = trimesh.Trimesh(result.vertices, result.faces, process=False).split(only_watertight=False)
    assert sorted(cube.volume for cube in cubes) == pytest.approx([1.0] * sum(is_cube))
    winding = winding_number(result.vertices, result.faces, np.array(PLACES, float))
    np.testing.assert_allclose(winding, np.array(is_cube, float), atol=1e-9)


@pytest.mark.parametrize(("hole", "is_solid"), [(0.12, True), (0.15, False), (0.5, False)])
def test_a_sphere_with_a_small_hole_is_solid(hole, is_solid):
    """The squared border is π (hole / radius)² of the area: 4.5, 7 and 79 %. Only parts inside a solid are dropped."""
    polar = np.linspace(np.arcsin(hole), np.pi, 40)
    profile = 0.01 * np.stack([np.sin(polar), np.cos(polar)], axis=1)
    mesh = trimesh.creation.revolve(profile, sections=64)
    shell = outer_shell(surface_of(mesh, ball(0.002, subdivisions=1)))
    assert shell.is_solid.tolist() == ([True] if is_solid else [False, True])


def test_repeated_faces_count_once():
    cube = box([0.02, 0.03, 0.04])
    repeated = trimesh.Trimesh(cube.vertices, np.concatenate([cube.faces, cube.faces[:3]]), process=False)
    shell = outer_shell(surface_of(repeated))
    assert len(shell.surface.faces) == 12 and shell.is_solid.all()
