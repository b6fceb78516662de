"""Loads against their float64 definition and by hand: normal force, sliding and where they act."""

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
    """Return the loads of a module's first use, and the definition's for each environment."""
    (use,) = touch.plan.quantities["loads"].uses
    use = dataclasses.replace(use, center=center)
    arrays = ("bodies", "objects", "pairs")
    of_tensors = dataclasses.replace(use, **{name: torch.from_numpy(np.array(getattr(use, name))) for name in arrays})
    tensors = {name: getattr(state, name) for name in SHAPES if getattr(state, name) is not None}
    (result,) = LOADS.gather(LoadsPart((of_tensors,)), Scene(tensors, touch.plan.objects, None, {}, torch.float64))
    inputs, layout = touch.inputs, touch.plan.layout_of(touch.plan.sensors[0])
    assert isinstance(layout, Layout)
    defined = []
    for env in range(len(tensors["body_pos"])):
        fields = {name: value[env].double().numpy() for name, value in tensors.items()}
        scene = ReferenceScene(layout, slice(0, 2), touch.plan.objects, inputs.bodies, inputs.pairs, fields, np.zeros(3))
        defined.append(LOADS.reference(LoadsPart((use,)), 0, scene))
    return result, defined


@pytest.mark.parametrize("center", ["link", "object"])
def test_random_contacts_match_the_definition(touch, center):
    result, defined = loads(touch, touch.example_state(5, seed=3), center)
    for name in ("force", "sliding"):
        expected = np.stack([getattr(reference, name) for reference in defined])
        assert expected.all()
        np.testing.assert_allclose(getattr(result, name), expected, rtol=1e-12)
    expected = np.stack([reference.center for reference in defined])
    np.testing.assert_allclose(torch.stack(result.center, dim=-1), expected, rtol=0, atol=1e-13)
    expected = np.stack([reference.along for reference in defined])
    np.testing.assert_allclose(torch.stack(result.along, dim=-1), expected, rtol=0, atol=1e-13)


def test_one_contact_by_hand(touch):
    """5 N sliding at 0.2 m/s: 5 N and 1 W on one plate, nothing on the other."""
    result, _ = loads(touch, pressed(touch, [5.0], 0.2))
    np.testing.assert_allclose(result.force, [[[5.0], [0.0]]], rtol=1e-13)
    np.testing.assert_allclose(result.sliding, [[[1.0], [0.0]]], rtol=1e-13)
    assert result.center is None and result.along is None


def test_a_rolling_ball_does_not_slide(touch):
    """Its centre moves at ω r, and its surface rests at the contact."""
    state = pressed(touch, [5.0], 0.2)
    pair = [contact.link for contact in touch.inputs.pairs].index("plate")
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


def test_forces_beyond_the_slots_count_too(touch):
    """A net force of 8 N with one slot of 5 N reads 8 N."""
    state = pressed(touch, [5.0], 0.2)
    state.contact_netforce *= 8 / 5
    result, _ = loads(touch, state)
    assert float(result.force[0, 0, 0]) == pytest.approx(8.0)


def test_the_center_is_in_the_links_frame(touch):
    """Contacts of 1 and 3 N act three quarters of the way to the second, in the rotated plate's frame."""
    state = pressed(touch, [1.0])
    pair, link = [contact.link for contact in touch.inputs.pairs].index("plate"), touch.inputs.bodies.index("plate")
    for name, value in (("contact_normal", 1.0), ("contact_force", 3.0)):
        getattr(state, name)[0, pair, 1] = value * getattr(state, name)[0, pair, 0]
    state.contact_netforce[0, pair] = state.contact_force[0, pair].sum(dim=0)
    turn = Rotation.from_quat(state.body_quat[0, link].numpy(), scalar_first=True)
    positions = np.array([[0.01, 0.02, 0.03], [-0.01, 0.0, 0.01]])
    state.contact_pos[0, pair, :2] = torch.from_numpy(turn.apply(positions)) + state.body_pos[0, link]
    result, _ = loads(touch, state, "link")
    np.testing.assert_allclose(
        [float(part[0, 0, 0]) for part in result.center], 0.25 * positions[0] + 0.75 * positions[1], atol=1e-14
    )
    assert [float(part[0, 1, 0]) for part in result.center] == [0, 0, 0]
    normal = turn.inv().apply(state.contact_normal[0, pair, 0].numpy())
    np.testing.assert_allclose([float(part[0, 0, 0]) for part in result.along], normal, atol=1e-14)
    assert [float(part[0, 1, 0]) for part in result.along] == [0, 0, 0]
