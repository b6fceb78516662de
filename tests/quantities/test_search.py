"""`search` with a kernel agrees with `penetration` of distances; `test_deepest_kernel` tests the kernel itself."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from pressed_pads import compiled
from searches import paired

from tgdsl.geometry.shapes import BOUND, POS, ROTATION
from tgdsl.module.state import example_state
from tgdsl.quantities import contact_depth
from tgdsl.quantities.contact_depth import (
    DEEPEST,
    EVERYWHERE,
    MARGIN,
    Deepest,
    Probes,
    Target,
    deepest,
    geom_tables,
    is_searchable,
    measure,
    penetration,
    search,
)
from tgdsl.quantities.geoms import Geoms
from tgdsl.quantities.pairs import relate
from tgdsl.tensors import operations

NUM_LINKS, NUM_OBJECTS, NUM_ENVS, NUM_TAXELS = 2, 6, 5, 40
WHICH = (0, 1, 2, 4, 5)
"""The objects that the sensors feel."""


def brute_force(pairs, probes, targets, known, reach):
    """Do what the kernel does for centred boxes, by distances."""
    geoms_of_targets = [target.geoms for target in targets]
    spheres, geoms = (known["spheres"], known["geoms"]) if "geoms" in known else geom_tables(geoms_of_targets)
    ends = spheres[0, :, 1].cumsum(0).long()
    boxes = [box(geoms[:, end - 1 : end, :3], 0, pairs.offset[0].shape[1]) for end in ends]
    every = Probes(probes.pos, known["pair"])
    near = measure(pairs, every, boxes)
    felt = penetration(pairs, every, near, reach, ("normal",))
    depths = torch.stack(
        [
            r + pairs.gate[:, geoms_of_targets.pair] - geoms_of_targets.distance
            for r, geoms_of_targets in zip(reach, near, strict=True)
        ]
    )
    deepest = depths.max(dim=0)
    pair = known["pair"].gather(0, deepest.indices)
    return Deepest(felt.depth, felt.normal, torch.where(deepest.values > 0, pair, -1))


@pytest.fixture
def kernel(monkeypatch):
    """Replace the kernel by one that runs everywhere, in float64."""
    monkeypatch.setattr(contact_depth, "DEEPEST", replace(DEEPEST, kernel=brute_force))
    monkeypatch.setattr(operations, "are_kernel_inputs", lambda *_: True)


def box(size, first_pair, num_pairs, name="box"):
    identity = torch.eye(3, dtype=torch.float64).reshape(1, 1, 9)
    geoms = Geoms(("box",), (True,), size, 0 * size, identity, None, None, (None,))
    return Target(paired(name, first_pair, num_pairs), geoms)


@pytest.fixture
def scene():
    """Return two links and six boxes, some within each probe's reach, with the felt pairs and reaches."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    num_bodies = NUM_LINKS + NUM_OBJECTS
    link, target = (
        torch.arange(NUM_LINKS).repeat(NUM_OBJECTS),
        NUM_LINKS + torch.arange(NUM_OBJECTS).repeat_interleave(NUM_LINKS),
    )
    state = (0.05 * random(NUM_ENVS, num_bodies, 3), random(NUM_ENVS, num_bodies, 4))
    motion = (random(NUM_ENVS, num_bodies, 3), random(NUM_ENVS, num_bodies, 3))
    gate = torch.where(random(NUM_ENVS, len(link)) > -1, 0.0, -torch.inf)
    pairs = relate(*state, link, target, torch.float64, *motion, gate)
    owner = torch.arange(NUM_TAXELS) % NUM_LINKS
    probes = Probes((0.03 * random(3, NUM_TAXELS)).unbind(), owner.expand(NUM_OBJECTS, -1))
    boxes = [box(0.01 + 0.02 * random(1, 1, 3).abs(), NUM_LINKS * i, NUM_LINKS, f"{i}") for i in range(NUM_OBJECTS)]
    reach = torch.full((len(WHICH), NUM_TAXELS), 0.03, dtype=torch.float64)
    return pairs, probes, boxes, owner + NUM_LINKS * torch.tensor(WHICH)[:, None], reach


@pytest.mark.parametrize("is_known", [True, False])
def test_motion_is_that_of_the_deepest_object(scene, kernel, is_known):
    pairs, probes, boxes, pair, reach = scene
    wants, felt = ("motion", "normal"), [boxes[i] for i in WHICH]
    kernel_inputs = {"pair": pair} | (
        dict(zip(("spheres", "geoms"), geom_tables([target.geoms for target in felt]), strict=True)) if is_known else {}
    )
    result = search(pairs, probes, felt, kernel_inputs, reach, wants)
    near = measure(pairs, probes, boxes)
    expected = penetration(pairs, probes, [near[i] for i in WHICH], reach, wants)
    assert 0.2 < (expected.depth > 0).double().mean() < 0.9
    torch.testing.assert_close(result.depth, expected.depth)
    for actual, reference in zip(
        (*result.normal, *result.velocity, *result.angular),
        (*expected.normal, *expected.velocity, *expected.angular),
        strict=True,
    ):
        torch.testing.assert_close(actual, reference)


def test_the_definition_equals_the_deepest_of_all_distances(scene):
    pairs, probes, boxes, pair, reach = scene
    arguments = pairs, probes, [boxes[i] for i in WHICH], {"pair": pair}, reach
    result, expected = deepest(*arguments), brute_force(*arguments)
    assert torch.equal(result.pair, expected.pair) and (result.pair >= 0).any() and (result.pair < 0).any()
    for part, reference in zip((result.depth, *result.normal), (expected.depth, *expected.normal), strict=True):
        torch.testing.assert_close(part, reference)


@pytest.mark.parametrize("num_geoms", [(2, 4), (3, 3)], ids=["unlike", "alike"])
def test_bounding_spheres_of_geoms_are_mujocos(num_geoms):
    """One object lacks geoms in some environments; the other is the same in all."""
    shapes, generator = ("box", "capsule", "cylinder", "sphere", "plane", "box"), np.random.default_rng(0)
    size, pos = generator.uniform(0.01, 0.03, (6, 3)), generator.normal(size=(6, 3))
    model = mujoco.MjSpec()
    for shape, own, at in zip(shapes, size, pos, strict=True):
        model.worldbody.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"), size=own, pos=at)
    radius = np.where(np.array(shapes) == "plane", EVERYWHERE, model.compile().geom_rbound)
    first, is_absent = num_geoms[0], np.zeros((3, 6), bool)
    is_absent[1, 0] = is_absent[2, :first] = True
    objects = []
    for own, absent in ((slice(first), torch.from_numpy(is_absent[:, :first])), (slice(first, 6), None)):
        rotation = np.tile(np.eye(3).ravel(), (6, 1))
        parts = (torch.from_numpy(part[own])[None] for part in (size, pos, rotation))
        num = len(shapes[own])
        objects.append(Geoms(shapes[own], (False,) * num, *parts, absent, None, (None,) * num))
    spheres, geoms = (table.numpy() for table in geom_tables(objects))
    of_geoms, about_bodies = (np.where(is_absent, -np.inf, reach) for reach in (radius, radius + np.linalg.norm(pos, axis=1)))
    of_objects = np.stack([own.max(axis=1) for own in np.split(about_bodies, [first], axis=1)], axis=1)
    for radii, exact in ((geoms[..., BOUND], of_geoms), (spheres[..., 0], of_objects)):
        np.testing.assert_allclose(radii, exact, rtol=1e-12, atol=2 * MARGIN)
        assert (radii >= exact).all()
    assert (spheres[..., 1] == num_geoms).all() and (geoms[..., POS:ROTATION] == pos).all()


def test_a_cpu_has_no_kernel(scene):
    pairs, probes, boxes, pair, reach = scene
    assert search(pairs, probes, [boxes[i] for i in WHICH], {"pair": pair}, reach, ("normal",)) is None


def test_searches_without_a_kernel_are_left_to_torch():
    many = ["box"] * contact_depth.THRESHOLD
    assert is_searchable(many, {"normal", "motion"}) and is_searchable(many, ())
    assert not is_searchable(many, {"normal", "distance"})
    assert not is_searchable(many[1:], {"normal"})
    assert not is_searchable([*many, "ellipsoid"], {"normal"})


def test_a_module_passes_the_tables_of_its_plan_to_the_kernel(tmp_path, kernel, monkeypatch):
    """Six boxes around a pad: the kernel reads precomputed tables and agrees with distances."""
    bodies = "".join(f'<body name="b{i}"><freejoint/><geom type="box" size=".02 .01 .0{i + 1}"/></body>' for i in range(6))
    names = [f"b{i}" for i in range(6)]
    sensors = {"depth": {"kind": "contact_depth", "feels": names}}
    touch = compiled(tmp_path, bodies, {name: {"body": name} for name in names}, sensors)
    state = example_state(touch.inputs, 3, 0, torch.float64, 0.02)
    tables = []

    def spied(pairs, probes, targets, known, reach):
        tables.append(set(known))
        return brute_force(pairs, probes, targets, known, reach)

    monkeypatch.setattr(contact_depth, "DEEPEST", replace(DEEPEST, kernel=spied))
    depth = touch(state)["depth"]
    assert tables == [{"pair", "spheres", "geoms"}]
    monkeypatch.undo()
    expected = touch(state)["depth"]
    assert len(tables) == 1 and (expected > 0).any() and (expected == 0).any()
    torch.testing.assert_close(depth, expected, rtol=0, atol=1e-12)
