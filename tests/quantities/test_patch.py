"""Contact patches against NumPy in float64 and by hand, and the fields of the state that they read."""

import contact_patches
import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.quantities.patch import Contacts, Sides, patch

SCENE = """<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".03 .03 .01"/></body>
  <body name="one" pos="0 0 .05"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  <body name="two" pos="0 0 .15"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>"""
OWN, FIXED = {"per_env": 40.0}, 30.0


def area_of(points: np.ndarray, normal: np.ndarray, is_star: bool = False) -> float:
    """Return the area across the normal, by Qhull or by the shoelace formula over points sorted by angle."""
    across = np.linalg.svd(normal[None])[2][1:]
    across[1] *= np.sign(np.cross(*across) @ normal)
    x, y = across @ points.T
    if not is_star:
        return ConvexHull(np.stack([x, y], axis=1)).volume if len(np.unique(points, axis=0)) > 2 else 0.0
    order = np.argsort(np.arctan2(y, x), kind="stable")
    x, y = x[order], y[order]
    return max(0.0, 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))


def brute_force(contacts: Contacts, sides: Sides) -> np.ndarray:
    """Return force, area, centre and normal of each patch in its link's frame, (env, body, object, 8)."""
    force, torque, normal, pos, whole, body_pos, quat = (part.double().numpy() for part in contacts)
    num_envs, num_pairs = force.shape[:2]
    result = np.zeros((num_envs, *sides.pairs.shape, 8))
    for env, b, o in np.ndindex(*result.shape[:3]):
        body, pair = int(sides.bodies[b]), int(sides.pairs[b, o])
        used = [] if pair == num_pairs else np.flatnonzero(np.stack([force, torque, normal])[:, env, pair].any(axis=(0, 2)))
        if not len(used):
            continue
        acting, normals, positions = (field[env, pair, used] for field in (force, normal, pos))
        size = np.linalg.norm(acting, axis=1)
        share = size / size.sum() if size.any() else np.full(len(used), 1 / len(used))
        acting = acting + share[:, None] * (whole[env, pair] - acting.sum(axis=0))
        pressed = np.maximum((acting * normals).sum(axis=1), 0)
        if not pressed.any():
            continue
        centre, mean = pressed @ positions / pressed.sum(), pressed @ normals / pressed.sum()
        mean = mean if np.linalg.norm(mean) > 1e-3 else normals[pressed > 0][0]
        mean /= np.linalg.norm(mean)
        to_link = Rotation.from_quat(quat[env, body], scalar_first=True).inv()
        area = area_of(positions[pressed > 0] - centre, mean, sides.is_star)
        result[env, b, o] = pressed.sum(), area, *to_link.apply(centre - body_pos[env, body]), *to_link.apply(mean)
    return result


@pytest.mark.parametrize("is_star", [False, True], ids=["hull", "star"])
@pytest.mark.parametrize("case", contact_patches.CASES)
def test_patches_of_random_contacts_match_brute_force(case, is_star):
    contacts, sides, dtype = contact_patches.arguments(case, torch.float64)
    sides = sides._replace(is_star=is_star)
    quat = contacts.body_quat / contacts.body_quat.norm(dim=-1, keepdim=True)
    contacts = contacts._replace(body_quat=quat)
    force, area, pos, normal = patch(contacts, sides, dtype)
    expected = brute_force(contacts, sides)
    assert 0.2 < (expected[..., 0] > 0).mean() < 0.95 and (expected[3, ..., 0] > 0).any()
    np.testing.assert_allclose(torch.stack([force, area, *pos, *normal], dim=-1), expected, rtol=1e-9, atol=1e-12)


def patch_of_one_pair(force, normal, pos, whole):
    """Return the patch of contacts between one object and a body in the world's frame."""
    force, normal, pos, whole = (torch.tensor(part, dtype=torch.float64)[None, None] for part in (force, normal, pos, whole))
    none, quat = 0 * whole, torch.tensor([[[1.0, 0.0, 0.0, 0.0]]], dtype=torch.float64)
    contacts = Contacts(force, 0 * force, normal, pos, whole, none, quat)
    return patch(contacts, Sides(torch.tensor([0]), torch.tensor([[0]]), True), torch.float64)


MM = 1e-3
RECTANGLE = [[0, 0], [20, 0], [20, 10], [0, 10]]
SHAPES = {
    "rectangle with a point inside": ([*RECTANGLE, [15, 4]], 200.0),
    "rectangle with points on its sides": ([*RECTANGLE, [10, 0], [20, 5]], 200.0),
    "L": ([[0, 0], [20, 0], [20, 5], [5, 5], [5, 20], [0, 20]], 287.5),
    "two points on one ray": ([[0, 0], [10, 0], [5, 8], [5, 2]], 40.0),
    "line": ([[0, 0], [1, 1], [2, 2], [5, 5]], 0.0),
    "ten points": ([*RECTANGLE, [1, 1], [19, 1], [10, 9], [10, 5], [3, 7], [18, 8]], 200.0),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_patch_has_the_area_of_its_points_hull(shape):
    """For any order of points and any centre of load."""
    points, area = SHAPES[shape]
    rng = np.random.default_rng(0)
    for _ in range(20):
        flat = rng.permutation(MM * np.array(points, dtype=float))
        force = rng.uniform(0.1, 2.0, (len(flat), 1)) * np.array([0.0, 0.0, 1.0])
        pos = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
        result = patch_of_one_pair(force, np.tile([0.0, 0.0, 1.0], (len(flat), 1)), pos, force.sum(axis=0))
        assert result.area.item() == pytest.approx(1e-6 * area, rel=1e-12, abs=1e-18)


def test_contacts_without_forces_share_the_net_force_equally():
    """Contacts at 1, 2 and 6 mm with a net force of 6 N read 6 N at 3 mm."""
    pos = [[0.001, 0, 0], [0.002, 0, 0], [0.006, 0, 0]]
    result = patch_of_one_pair(np.zeros((3, 3)), [[0.0, 0.0, 1.0]] * 3, pos, [0.0, 0.0, 6.0])
    assert result.force.item() == pytest.approx(6.0, rel=1e-14)
    assert result.pos[0].item() == pytest.approx(0.003, rel=1e-14)


def test_a_pinch_has_the_normal_of_its_first_pressing_contact():
    """The first contact pulls, so it does not count."""
    x, z = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    normals, forces = np.array([z, -x, x]), np.array([-z, -2 * x, 2 * x])
    result = patch_of_one_pair(forces, normals, np.zeros((3, 3)), forces.sum(axis=0))
    assert result.force.item() == 4.0 and [part.item() for part in result.normal] == [-1, 0, 0]


@pytest.mark.parametrize("feels", [[["one", "two"]], [["one"], ["two"]]], ids=["one sensor", "two sensors"])
@pytest.mark.parametrize(("one", "two"), [(OWN, FIXED), (FIXED, OWN), (FIXED, FIXED)], ids=["the first", "the second", "none"])
def test_temperatures_are_read_if_any_object_has_its_own(tmp_path, one, two, feels):
    (tmp_path / "scene.xml").write_text(SCENE)
    objects = {name: {"body": name, "material": "steel", "temperature": of} for name, of in (("one", one), ("two", two))}
    heat = {"kind": "temperature_grid", "links": "pad", "cells": [1, 1, 1], "material": "steel"}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml")},
        "objects": objects,
        "sensors": {f"heat{i}": {**heat, "feels": names} for i, names in enumerate(feels)},
    }
    touch = tgdsl.compile(document)
    state = touch.example_state(2)
    assert ("object_temperature" in touch.inputs.fields) == (OWN in (one, two))
    if OWN in (one, two):
        state.object_temperature[:] = torch.tensor([[35.0], [45.0]])
    readings = touch(state)
    temperatures = torch.cat([readings[f"heat{i}/objects"][:, :, 0] for i in range(len(feels))], dim=1)
    expected = [[temperature if of == OWN else FIXED for of in (one, two)] for temperature in (35.0, 45.0)]
    np.testing.assert_allclose(temperatures, expected)
