"""Which slots of the state are contacts."""

import pytest
import torch
from pressed_pads import compiled

from tgdsl.module.state import example_state
from tgdsl.quantities.contacts import contacts_of, pair_contacts


@pytest.mark.parametrize("component", range(10))
def test_any_nonzero_force_torque_or_normal_makes_a_contact(component):
    """If all nine components are zero, there is no contact and its position is ignored."""
    components = torch.zeros(10, dtype=torch.float64)
    components[component] = 0.5
    force, torque, normal = components[:9].reshape(3, 1, 1, 1, 3)
    position, zero = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.zeros(1, 1, 3, dtype=torch.float64)
    state = {"contact_force": force, "contact_torque": torque, "contact_normal": normal, "contact_netforce": force[:, :, 0]}
    state |= {"contact_pos": position.expand(1, 1, 1, 3), "body_pos": zero, "body_quat": torch.eye(4)[None, :1].double()}
    contacts = contacts_of(state, torch.tensor([0]), torch.tensor([[0]]), torch.float64)
    is_contact, has_normal = component < 9, 6 <= component < 9
    assert torch.cat(contacts.pos).flatten().tolist() == (position.tolist() if is_contact else [0, 0, 0])
    assert torch.cat(contacts.normal).isnan().all() == (is_contact and not has_normal)
    of_pairs = pair_contacts(state, torch.tensor([[0]]))
    assert of_pairs.is_used.item() == (component in (0, 1, 2, 6, 7, 8))


def test_contacts_are_read_if_any_sensor_needs_them(tmp_path):
    """One sensor reads the net force of one ball, the other the contacts with another: 1 N each."""
    bodies = "".join(f'<body name="{name}"><freejoint/><geom size=".02"/></body>' for name in ("one", "two"))
    sensors = {
        "net": {"kind": "link_contact", "outputs": ["force"], "feels": ["one"]},
        "each": {"kind": "force_taxel", "feels": ["two"]},
    }
    touch = compiled(tmp_path, bodies, {name: {"body": name} for name in ("one", "two")}, sensors)
    state = example_state(touch.inputs, 2, 0, torch.float64, 0.02)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    state.body_quat[:], state.body_pos[:], state.contact_found[:] = torch.eye(4)[0], 0.0, 1
    for name in ("pos", "force", "torque", "normal"):
        getattr(state, f"contact_{name}")[:] = 0.0
    state.contact_pos[..., 2] = 0.01  # on the pad
    state.contact_force[:, :, 0] = state.contact_normal[:, :, 0] = state.contact_netforce[:] = down
    readings = touch(state)
    assert readings["net"][:, 0].tolist() == [[0, 0, -1]] * 2
    assert readings["each"][:, :, 2].sum(dim=1).abs().tolist() == pytest.approx([1, 1], rel=1e-12)
