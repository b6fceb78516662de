"""Warnings about meshes that differ from what the sensors feel."""

import warnings

import numpy as np
import pytest
import trimesh
from oracles.setups.solids import box, surface_of

from tgdsl.quantities.bake import geom_distance
from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.sensed import DistanceOptions

GEOM = Geom(0, "", "cup", "item", "mesh", np.ones(3), np.zeros(3), np.eye(3), True)
RAYCAST = DistanceOptions(query="raycast")


def test_an_open_mesh_is_baked_with_a_warning(monkeypatch, tmp_path):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    cup, coarse = box((0.02, 0.02, 0.02)), DistanceOptions(tolerance=2e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        geom_distance(SurfaceGeom(GEOM, surface_of(cup)), coarse, 0.004, "object item")
    cup.update_faces(cup.face_normals[:, 2] < 0.5)
    with pytest.warns(
        UserWarning, match='^object item: geom "cup" is not closed; its winding number decides which points are inside$'
    ):
        geom_distance(SurfaceGeom(GEOM, surface_of(cup)), coarse, 0.004, "object item")


def test_a_hull_farther_from_its_mesh_than_probes_reach_warns():
    """Two cubes of 1 cm, 2 cm apart: in the middle their hull is 1 cm from both."""
    cubes = [box((0.01, 0.01, 0.01), (x, 0, 0)) for x in (-0.015, 0.015)]
    hull = trimesh.util.concatenate(cubes).convex_hull
    felt = SurfaceGeom(GEOM, surface_of(hull), surface_of(*cubes))
    with pytest.warns(
        UserWarning, match=r'^object item: MuJoCo collides the convex hull of geom "cup", up to (9\.9|10\.0) mm off'
    ):
        distance = geom_distance(felt, RAYCAST, 0.0095, "object item")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        geom_distance(felt, RAYCAST, 0.0101, "object item")
    assert distance.shape == "raycast" and distance.arrays["max_distance"] == 2 * 0.0095
