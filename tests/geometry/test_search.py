"""That `search` makes of a kernel's answer what `feel` makes of distances; the kernel itself is tested beside it."""

import sys
from types import ModuleType
from typing import NamedTuple

import pytest
import torch

from tgdsl.geometry import query
from tgdsl.geometry.contacts import Contacts
from tgdsl.geometry.query import FeltObject, Probes, feel, measure, relate, search

NUM_LINKS, NUM_OBJECTS, NUM_ENVS, NUM_TAXELS = 2, 6, 5, 40


@pytest.fixture
def kernel(monkeypatch):
    """A kernel that runs everywhere and answers anything but "distance"."""
    stub = ModuleType("deepest_kernel")
    stub.deepest, stub.is_searchable = brute_force, lambda objects, needs: "distance" not in needs and "contacts" not in needs
    monkeypatch.setitem(sys.modules, "tgdsl.geometry.deepest_kernel", stub)
    monkeypatch.setattr(query, "takes_kernel", lambda *_: True)


@pytest.fixture
def scene():
    """Two links and six boxes, some of which each probe reaches."""
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
    identity = torch.eye(3, dtype=torch.float64).reshape(1, 1, 9)
    boxes = [
        FeltObject(f"{i}", NUM_LINKS * i, NUM_LINKS, ("box",), (True,), 0.01 + 0.02 * random(1, 1, 3).abs(), 0 * identity[..., :3],
                   identity, None, None, (None,))
        for i in range(NUM_OBJECTS)
    ]  # fmt: skip
    reach = torch.full((NUM_OBJECTS, NUM_TAXELS), 0.03, dtype=torch.float64)
    return pairs, probes, boxes, reach


class Deepest(NamedTuple):
    depth: torch.Tensor
    normal: tuple
    pair: torch.Tensor


def brute_force(pairs, probes, which, objects, reach):
    """Return what the kernel does, from the distances."""
    near = measure(pairs, probes, objects)
    felt = feel(pairs, probes, [near[i] for i in which], reach, ("normal",))
    depths = [reach[k] + pairs.gate[:, near[i].pairs][:, near[i].pair] - near[i].distance for k, i in enumerate(which)]
    deepest = torch.stack(depths).max(dim=0)
    first = torch.tensor([objects[i].first_pair for i in which])[deepest.indices]
    pair = torch.where(deepest.values > 0, first + probes.pair[0], -1).int()
    return Deepest(felt.depth, felt.normal, pair)


def test_motion_is_that_of_the_object_found(scene, kernel):
    pairs, probes, boxes, reach = scene
    which, needs = (0, 1, 2, 4, 5), ("motion", "normal", "contacts")
    none = torch.zeros(NUM_ENVS, NUM_LINKS, 0, dtype=torch.float64)
    contacts = Contacts(*[(none, none, none)] * 4, (none[..., 0:1].sum(-1),) * 3)
    found = search(pairs, probes, which, boxes, reach[:5], needs, contacts)
    near = measure(pairs, probes, boxes)
    expected = feel(pairs, probes, [near[i] for i in which], reach[:5], needs, contacts)
    assert 0.2 < (expected.depth > 0).double().mean() < 0.9
    torch.testing.assert_close(found.depth, expected.depth)
    for part, other in zip(
        (*found.normal, *found.velocity, *found.angular), (*expected.normal, *expected.velocity, *expected.angular), strict=True
    ):
        torch.testing.assert_close(part, other)
    assert found.contacts is contacts


def test_a_cpu_has_no_kernel_for_it(scene):
    pairs, probes, boxes, reach = scene
    assert search(pairs, probes, range(NUM_OBJECTS), boxes, reach, ("normal",)) is None


def test_what_the_kernel_cannot_answer_is_left_to_torch(scene, kernel):
    pairs, probes, boxes, reach = scene
    assert search(pairs, probes, range(NUM_OBJECTS), boxes, reach, ("distance",)) is None
