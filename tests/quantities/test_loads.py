"""Loads against their float64 definition and by hand: normal force, sliding, and where they act."""

import dataclasses

import numpy as np
import pytest
import torch
from oracles.setups.sounds import plate, pressed
from scipy.spatial.transform import Rotation

from tgdsl.layout.layout import Layout
from tgdsl.module.state import SHAPES
from tgdsl.quantities.base import Scene
from tgdsl.quantities.contacts import LOADS, LoadsPart
from tgdsl.quantities.reference import ReferenceScene


@pytest.fixture
def touch(tmp_path):
    return plate(tmp_path, links=["plate", "other"])


def loads(touch, state, center=""):
    """Return the loads of a module's first use, and those of the definition for each environment."""
    (use,) = touch.plan.quantities["loads"].uses
    use = dataclasses.replace(use, center=center)
    arrays = ("bodies", "objects", "pairs")
    of_tensors = dataclasses.replace(use, **{name: torch.from_numpy(np.array(getattr(use, name))) for name in arrays})
    tensors = {name: getattr(state, name) for name in SHAPES if getattr(state, name) is not None}
    (found,) = LOADS.gather(LoadsPart((of_tensors,)), Scene(tensors, touch.plan.objects, None, {}, torch.float64))
    inputs, layout = touch.inputs, touch.plan.layout_of(touch.plan.sensors[0])
    assert isinstance(layout, Layout)
    defined = []
    for env in range(len(tensors["body_pos"])):
        fields = {name: value[env].double().numpy() for name, value in tensors.items()}
        scene = ReferenceScene(layout, slice(0, 2), touch.plan.objects, inputs.bodies, inputs.pairs, fields, np.zeros(3))
        defined.append(LOADS.reference(LoadsPart((use,)), 0, scene))
    return found, defined


@pytest.mark.parametrize("center", ["link", "object"])
def test_random_contacts_are_the_definitions(touch, center):
    found, defined = loads(touch, touch.example_state(5, seed=3), center)
    for name in ("force", "sliding"):
        expected = np.stack([getattr(own, name) for own in defined])
        assert expected.all()
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-12)
    expected = np.stack([own.center for own in defined])
    np.testing.assert_allclose(torch.stack(found.center, dim=-1), expected, rtol=0, atol=1e-13)
    expected = np.stack([own.along for own in defined])
    np.testing.assert_allclose(torch.stack(found.along, dim=-1), expected, rtol=0, atol=1e-13)


def test_by_hand(touch):
    """5 N with a friction of 1.5 N, sliding at 0.2 m/s: 5 N and 1 W on the one plate, nothing on the other."""
    found, _ = loads(touch, pressed(touch, [5.0], 0.2))
    np.testing.assert_allclose(found.force, [[[5.0], [0.0]]], rtol=1e-13)
    np.testing.assert_allclose(found.sliding, [[[1.0], [0.0]]], rtol=1e-13)
    assert found.center is None and found.along is None


def test_a_ball_that_rolls_does_not_slide(touch):
    """Its centre goes at ω r, and its material rests where it touches."""
    state = pressed(touch, [5.0], 0.2)
    pair = [own.link for own in touch.inputs.pairs].index("plate")
    ball, link = (touch.inputs.bodies.index(name) for name in ("ball", "plate"))
    normal = state.contact_normal[0, pair, 0]
    state.body_angvel[:, link] = 0.0
    state.body_linvel[:, ball] -= state.body_linvel[:, link]
    state.body_linvel[:, link] = 0.0
    along = state.body_linvel[0, ball] - (state.body_linvel[0, ball] @ normal) * normal
    state.contact_pos[0, pair, 0] = state.body_pos[0, ball] + 0.01 * normal
    state.body_angvel[0, ball] = -torch.linalg.cross(normal, along) / 0.01
    rolling, _ = loads(touch, state)
    state.body_angvel[0, ball] *= -1
    skidding, _ = loads(touch, state)
    assert float(rolling.sliding[0, 0, 0]) == pytest.approx(0.0, abs=1e-13)
    assert float(skidding.sliding[0, 0, 0]) == pytest.approx(2 * 5.0 * 0.2)


def test_what_slots_lack_presses_too(touch):
    """A net force of 8 N where one contact shows 5 N: 8 N."""
    state = pressed(touch, [5.0], 0.2)
    state.contact_netforce *= 8 / 5
    found, _ = loads(touch, state)
    assert float(found.force[0, 0, 0]) == pytest.approx(8.0)


def test_the_center_is_in_the_frame_of_what_rings(touch):
    """Of two contacts of 1 and 3 N, three quarters on the way to the second, as the turned plate sees it."""
    state = pressed(touch, [1.0])
    pair, link = [own.link for own in touch.inputs.pairs].index("plate"), touch.inputs.bodies.index("plate")
    for name, value in (("contact_normal", 1.0), ("contact_force", 3.0)):
        getattr(state, name)[0, pair, 1] = value * getattr(state, name)[0, pair, 0]
    state.contact_netforce[0, pair] = state.contact_force[0, pair].sum(dim=0)
    turn = Rotation.from_quat(state.body_quat[0, link].numpy(), scalar_first=True)
    places = np.array([[0.01, 0.02, 0.03], [-0.01, 0.0, 0.01]])
    state.contact_pos[0, pair, :2] = torch.from_numpy(turn.apply(places)) + state.body_pos[0, link]
    found, _ = loads(touch, state, "link")
    np.testing.assert_allclose([float(part[0, 0, 0]) for part in found.center], 0.25 * places[0] + 0.75 * places[1], atol=1e-14)
    assert [float(part[0, 1, 0]) for part in found.center] == [0, 0, 0]
    normal = turn.inv().apply(state.contact_normal[0, pair, 0].numpy())
    np.testing.assert_allclose([float(part[0, 0, 0]) for part in found.along], normal, atol=1e-14)
    assert [float(part[0, 1, 0]) for part in found.along] == [0, 0, 0]
