"""More contacts than slots: no force is lost and one warning is given. Not-a-number in a state stays not-a-number in readings."""

import dataclasses
import warnings

import mujoco
import numpy as np
import pytest
import torch
from pressed_pads import LOAD, MODELS, RESTING, compiled, of_kinds, simulated
from warp_cases import warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation

TEN = '<body name="item" pos="0 0 .02"><freejoint/>{}</body>'.format(
    "".join(
        f'<geom type="box" pos="{x} {y} 0" size=".004 .004 .01" mass=".03"/>'
        for x in (-0.02, -0.01, 0, 0.01, 0.02)
        for y in (-0.01, 0.01)
    )
)
"""One body of 0.3 kg made of ten boxes: up to 40 contacts."""
ONE = '<body name="item" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02" mass=".3"/></body>'
TWO = ONE + '<body name="other" pos="0 0 .08"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1"/></body>'
ITEM = {"item": {"body": "item"}}


def settled(touch, which="mujoco", **options):
    sim = simulated(touch, which, substeps=250, **options)
    sim.step()
    return sim, sim.state()


def test_disabled_sensors_are_refused(tmp_path):
    """MuJoCo then fills no sensor, and contacts would silently be missing."""
    touch = compiled(tmp_path, ONE, ITEM, of_kinds(["item"]))
    spec = mujoco.MjSpec.from_file(str(tmp_path / "scene.xml"))
    model = tgdsl.instrument(spec, touch.inputs).compile()
    BatchSimulation(touch, 1, model=model).close()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    with pytest.raises(SimulationError, match="the scene has sensors disabled, and contacts are read of sensors"):
        BatchSimulation(touch, 1, model=model)


def test_squeezing_contacts_beyond_the_slots_are_warned_of(tmp_path):
    """Their net force is zero, so contacts without a slot leave no trace in it."""
    touch = compiled(tmp_path, ONE, ITEM, of_kinds(["item"]))
    _, state = settled(touch)
    squeezed = dataclasses.replace(
        state,
        contact_found=torch.full_like(state.contact_found, touch.inputs.slots + 3.0),
        contact_netforce=state.contact_force.sum(dim=2),
    )
    with pytest.warns(UserWarning, match=r"are more than `slots: 8`.*`slots: 11` would do"):
        touch(squeezed)


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_more_contacts_than_slots_carry_the_whole_load(tmp_path, which):
    """Ten boxes, 8 slots: the sum is m g, balanced taxels carry it, and the warning says how many slots would do."""
    touch = compiled(tmp_path, TEN, ITEM, of_kinds(["item"]))
    sim, state = settled(touch, which)
    with pytest.warns(UserWarning, match=r"contacts of pad – item are more than `slots: 8`.*`slots: (\d+)` would do") as caught:
        readings = touch(state)
    num_contacts = int(state.contact_found.max())
    assert num_contacts > 24 and f"`slots: {num_contacts}` would do" in str(caught[0].message)
    shown_force = float(state.contact_force[0, 0, :, 2].sum())
    assert shown_force > -0.5 * LOAD
    net = state.contact_netforce[0, 0].to(readings["shared"].dtype)
    assert float(net[2]) == pytest.approx(-LOAD, rel=RESTING)
    torch.testing.assert_close(readings["shared"][0].sum(dim=0), net, rtol=1e-5, atol=1e-5 * LOAD)
    torch.testing.assert_close(readings["shared/missed"][0, 0], torch.zeros_like(net), rtol=0, atol=1e-5 * LOAD)
    depth = compiled(tmp_path, TEN, ITEM, {"plain": {"kind": "kinematic_taxel", "outputs": ["force"], "feels": ["item"]}})
    unbalanced = depth.to(touch.dtype)(state)["plain"]
    factor = readings["balanced"].norm() / unbalanced.norm()
    torch.testing.assert_close(readings["balanced"], unbalanced * factor, rtol=1e-4, atol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        touch(state)
        sim.step()
        touch(sim.state())
    enough = compiled(
        tmp_path, TEN, ITEM, of_kinds(["item"]) | {"shared": {"kind": "force_taxel", "feels": ["item"], "slots": num_contacts}}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        enough_readings = enough(settled(enough, which)[1])
    torch.testing.assert_close(enough_readings["balanced"].norm() / unbalanced.norm(), factor, rtol=1e-3, atol=0)


def pad_state(touch, pos, force, net, found=True):
    """Return a state with a body 1 mm deep in the pad and the given contacts [m], [N]."""
    fields = {
        name: torch.zeros(1, 1, touch.inputs.slots, 3, dtype=torch.float64) for name in ("pos", "force", "torque", "normal")
    }
    for slot, (contact_pos, contact_force) in enumerate(zip(pos, force, strict=True)):
        fields["pos"][0, 0, slot], fields["force"][0, 0, slot] = torch.tensor(contact_pos), torch.tensor(contact_force)
        fields["normal"][0, 0, slot, 2] = -1
    rows = [[0.0, 0, 0.029] if body == "item" else [0.0, 0, 0] for body in touch.inputs.bodies]
    num_bodies = len(rows)
    return tgdsl.SceneState(
        body_pos=torch.tensor([rows], dtype=torch.float64),
        body_quat=torch.tensor([[[1.0, 0, 0, 0]] * num_bodies], dtype=torch.float64),
        body_linvel=torch.zeros(1, num_bodies, 3, dtype=torch.float64),
        body_angvel=torch.zeros(1, num_bodies, 3, dtype=torch.float64),
        contact_found=torch.tensor([[found]]),
        contact_netforce=torch.tensor([[net]], dtype=torch.float64),
        **{f"contact_{name}": value for name, value in fields.items()},
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:contacts of pad")
@pytest.mark.parametrize("which", ["double", "single"])
def test_force_without_slots_acts_at_the_centre_of_the_shown_contacts(tmp_path, which):
    """Two contacts of 1 N and 3 N show 4 of 10 N: the rest acts at (3 x₂ + x₁) / 4, about the pad's origin, to 1e-5."""
    sensors = {"shared": {"kind": "force_taxel", "feels": ["item"], "slots": 2}}
    touch = compiled(tmp_path, ONE, ITEM, sensors, dtype=torch.float64 if which == "double" else torch.float32)
    pos, force = [[-0.01, 0.004, 0.01], [0.012, -0.008, 0.01]], [[0.0, 0, -1], [0.5, 0, -3]]
    net = [0.5, 1.0, -10.0]
    readings = touch(pad_state(touch, pos, force, net))
    taxels = readings["shared"][0].double()
    np.testing.assert_allclose(taxels.sum(dim=0), net, atol=1e-5 * 10)
    assert readings["shared/missed"].abs().max() < 1e-5 * 10
    positions = np.array(touch.taxels["shared"]["pos"].tolist())
    weight = np.linalg.norm(force, axis=1)
    centre = weight @ np.array(pos) / weight.sum()
    missing = np.array(net) - np.sum(force, axis=0)
    expected = np.cross(pos, force).sum(axis=0) + np.cross(centre, missing)
    moment = np.cross(positions, taxels.detach().numpy()).sum(axis=0) + readings["shared/residual"][0, 0].double().numpy()
    np.testing.assert_allclose(moment, expected, atol=1e-6)


@pytest.mark.filterwarnings("ignore:contacts of pad")
def test_contacts_without_force_share_the_net_force_equally(tmp_path):
    """A state with contact positions but no contact forces: 2 N act at their middle. Without positions, they are missed."""
    touch = compiled(tmp_path, ONE, ITEM, {"shared": {"kind": "force_taxel", "feels": ["item"], "slots": 2}})
    pos = [[-0.015, 0.015, 0.01], [0.015, 0.015, 0.01]]
    taxels = touch(pad_state(touch, pos, np.zeros((2, 3)).tolist(), [0.0, 0, -2]))["shared"][0]
    np.testing.assert_allclose(taxels.sum(dim=0), [0, 0, -2], atol=1e-12)
    is_left = torch.tensor(touch.taxels["shared"]["pos"][:, 0] < 0)
    assert float(taxels[is_left, 2].sum()) == pytest.approx(-1, rel=1e-9)
    readings = touch(pad_state(touch, [], [], [0.0, 0, -2]))
    assert not readings["shared"].any()
    np.testing.assert_array_equal(readings["shared/missed"][0, 0], [0, 0, -2])


@pytest.mark.parametrize(("found", "advice"), [(True, "more slots"), (1.0, "more slots"), (11.0, "slots: 11")])
def test_states_of_users_are_checked_for_missing_slots(tmp_path, found, advice):
    """A user's state with too little force in its slots is warned of; if it counts more contacts, the warning has the number."""
    touch = compiled(tmp_path, ONE, ITEM, {"shared": {"kind": "force_taxel", "feels": ["item"], "slots": 1}})
    netforce = [0.0, 0, -1.0001] if found == 11.0 else [0.0, 0, -2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        touch(pad_state(touch, [[0.0, 0, 0.01]], [[0.0, 0, -1]], [0.0, 0, -1.0001], min(found, 1.0)))
    with pytest.warns(UserWarning, match=f"pad – item are more than `slots: 1`.*`{advice}` would do"):
        touch(pad_state(touch, [[0.0, 0, 0.01]], [[0.0, 0, -1]], netforce, found))


def test_zero_environments_give_empty_readings_without_a_warning(tmp_path):
    touch = compiled(tmp_path, ONE, ITEM, of_kinds(["item"]))
    assert all(len(reading) == 0 for reading in touch(touch.example_state(0)).values())


def test_each_pair_is_warned_of_once(tmp_path):
    """Two pairs, the second later: two warnings, then none."""
    objects = {"item": {"body": "item"}, "other": {"body": "other"}}
    touch = compiled(tmp_path, TWO, objects, {"shared": {"kind": "force_taxel", "feels": ["item", "other"], "slots": 1}})
    state = touch.example_state(3)
    netforce = state.contact_netforce.clone()
    for name in ("item", "other"):
        pair = [pair.object for pair in touch.inputs.pairs].index(name)
        netforce[1, pair] += 1.0
        with pytest.warns(UserWarning, match=f"contacts of pad – {name} are more") as caught:
            touch(dataclasses.replace(state, contact_netforce=netforce))
        assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        touch(dataclasses.replace(state, contact_netforce=2 * netforce))


def test_step_and_read_warns_too(tmp_path):
    touch = compiled(tmp_path, TEN, ITEM, {"shared": {"kind": "force_taxel", "feels": ["item"]}}, dtype=torch.float32)
    sim = warp(touch, 1, substeps=20)
    with pytest.warns(UserWarning, match="contacts of pad – item are more than `slots: 8`"):
        sim.step_and_read()


# Not-a-number


KINDS = {
    **of_kinds(["item"]),
    "depth": {"kind": "contact_depth", "feels": ["item"]},
    "bit": {"kind": "contact", "feels": ["item"]},
    "skin": {"kind": "elastomer", "feels": ["item"]},
    "points": {"kind": "elastomer", "feels": ["item"], "anchors": "points"},
    "open": {"kind": "contact_depth", "feels": ["item"], "gate": "geometric"},
}
READ = {
    "contact_found": {"shared", "balanced", "depth", "bit", "skin", "points"},
    "contact_netforce": {"link", "shared", "balanced"},
    "contact_force": {"shared", "balanced"},
    "contact_torque": {"shared"},
    "contact_pos": {"shared"},
    "contact_normal": {"shared", "balanced"},
}
"""Which sensors depend on which field."""


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    """A module with sensors of all kinds, and a state of three environments with a body at rest on the pad."""
    touch = compiled(tmp_path_factory.mktemp("three"), ONE, ITEM, KINDS)
    state = settled(touch, num_envs=3)[1]
    np.testing.assert_allclose(-state.contact_netforce[:, 0, 2], LOAD, rtol=RESTING)
    return touch, state


@pytest.mark.parametrize("name", READ)
def test_not_a_number_in_a_state_gives_not_a_number_in_readings(three, name):
    """One environment's first contact is not-a-number: only readings there that depend on it change."""
    touch, state = three
    touch.reset()
    before = {key: value.clone() for key, value in touch(state).items()}
    assert all(before[key].any() for key in KINDS)
    touch.reset()
    field = getattr(state, name).clone()
    field[(1, 0, 0, 2)[: field.ndim]] = torch.nan
    after = touch(dataclasses.replace(state, **{name: field}))
    for key in KINDS:
        torch.testing.assert_close(after[key][[0, 2]], before[key][[0, 2]], rtol=0, atol=0)
        if key in READ[name]:
            assert after[key][1].isnan().any(), key
            is_active = before[key][1].abs().sum(dim=-1) > 0
            assert after[key][1][is_active].isnan().any(dim=-1).all(), key
        else:
            torch.testing.assert_close(after[key][1], before[key][1], rtol=0, atol=0)


def test_a_force_without_a_normal_is_not_hidden(three):
    """Readings that need the normal are not-a-number there; all others are unchanged."""
    touch, state = three
    touch.reset()
    before = {key: value.clone() for key, value in touch(state).items()}
    touch.reset()
    normal = state.contact_normal.clone()
    normal[1] = 0
    after = touch(dataclasses.replace(state, contact_normal=normal))
    for key in KINDS:
        torch.testing.assert_close(after[key][[0, 2]], before[key][[0, 2]], rtol=0, atol=0)
        if key in READ["contact_normal"]:
            assert after[key][1].isnan().any(), key
        else:
            torch.testing.assert_close(after[key][1], before[key][1], rtol=0, atol=0)


def test_the_position_of_an_unused_slot_is_ignored(three):
    """A slot is unused where force, torque and normal are zero."""
    touch, state = three
    touch.reset()
    before = touch(state)["shared"].clone()
    is_used = state.contact_normal.any(dim=-1, keepdim=True)
    assert not is_used.all()
    for position in (1e9, torch.nan):
        touch.reset()
        after = touch(dataclasses.replace(state, contact_pos=torch.where(is_used, state.contact_pos, position)))
        torch.testing.assert_close(after["shared"], before, rtol=0, atol=0)
