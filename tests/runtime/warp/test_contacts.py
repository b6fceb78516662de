"""Contacts read from MuJoCo Warp, against MuJoCo's contact sensors in float64 on the same float32 states.

Forces come from two solvers: tolerances are those for sliding contacts, see `warp_cases`.
"""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from warp_cases import CONTACTS, MOVING_FORCE, TOLERANCE, assert_agree, module, warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.plan.inputs import contact_sensor_names
from tgdsl.quantities.pairs import Pair
from tgdsl.runtime.warp import WarpSimulation
from tgdsl.runtime.warp.stream import libraries

STACK = """
<mujoco>
  <option timestep="0.002" cone="{cone}" integrator="implicitfast"/>
  <default><geom friction=".8 .02 .01" condim="{condim}"/></default>
  <worldbody>
    <body name="table"><geom type="box" size=".1 .1 .01"/></body>
    <body name="cube" pos="0 0 .0298"><freejoint/><geom type="box" size=".02 .02 .02" mass=".25"/></body>
    <body name="lid" pos=".003 .002 .0596"><freejoint/><geom type="box" size=".015 .012 .01" mass=".1"/></body>
    <body name="tip" pos=".0348 .002 .035"><freejoint/><geom size=".015" mass=".05" adhesion="2"/></body>
    <body name="pebble" pos="-.05 0 .0148"><freejoint/><geom size=".005" mass=".01"/></body>
  </worldbody>
</mujoco>
"""
"""In contacts of table and tip with the cube, the link's geom is first; with the lid, the object's geom is first."""
PAIRS = (Pair("table", "again"), Pair("cube", "hat"), Pair("table", "cube"), Pair("lid", "cube"), Pair("tip", "cube"))
"""The first two pairs alias bodies of others; lid and cube are each the other's link; the pebble is in no pair."""
BODIES = {"cube": "cube", "again": "cube", "hat": "lid"}
FIRST_IS_LINK = {("table", "cube"): True, ("lid", "cube"): False, ("tip", "cube"): True, ("cube", "hat"): False}


def stacked_module(folder, cone="elliptic", condim=3, fields=CONTACTS, slots=6, pairs=PAIRS) -> TactileModule:
    """Return a module that wants contacts of some pairs."""
    touch = module(folder, STACK.format(cone=cone, condim=condim), links=("table", "lid", "tip"))
    assert set(touch.inputs.pairs) < set(PAIRS)
    inputs = dataclasses.replace(touch.inputs, fields=fields, pairs=pairs, bodies_of=BODIES, slots=slots)
    return TactileModule(dataclasses.replace(touch.plan, inputs=inputs))


def instrumented(folder, touch, **changes) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    return tgdsl.instrument(spec, dataclasses.replace(touch.inputs, **changes)).compile()


def moving_simulation(touch, num_envs, **keys) -> WarpSimulation:
    """Return environments whose bodies are slightly turned and pushed, differently in each."""
    sim = warp(touch, num_envs, **keys)
    sim.warp_model.opt.tolerance.fill_(1e-8)  # MuJoCo's own
    rng = np.random.default_rng(0)
    speeds = rng.normal(size=sim.arrays["qvel"].shape) * np.tile([0.1, 0.1, 0.05, 1, 1, 2], 4)
    sim.arrays["qvel"].copy_(torch.from_numpy(speeds))
    for body in range(4):
        half = torch.from_numpy(rng.uniform(-0.05, 0.05, size=num_envs))
        sim.arrays["qpos"][:, 7 * body + 3], sim.arrays["qpos"][:, 7 * body + 6] = half.cos(), half.sin()
    return sim


def forward_data(model, sim) -> list[mujoco.MjData]:
    """Return MuJoCo's data for each environment's current state."""
    datas = []
    for env in range(sim.num_envs):
        data = mujoco.MjData(model)
        for name in ("qpos", "qvel", "qacc_warmstart"):
            getattr(data, name)[:] = sim.arrays[name][env].numpy()
        mujoco.mj_forward(model, data)
        datas.append(data)
    return datas


def sensor_contacts(model, sim) -> SceneState:
    """Return the contacts that MuJoCo's sensors find in the environments' current states."""
    slots, nets = [], []
    for data in forward_data(model, sim):
        slots.append(np.stack([data.sensor(contact_sensor_names(pair)[0]).data.reshape(-1, 16) for pair in PAIRS]))
        nets.append(np.stack([data.sensor(contact_sensor_names(pair)[1]).data[1:4] for pair in PAIRS]))
    rows = np.stack(slots)
    normal, tangent = rows[..., 10:13], rows[..., 13:16]
    axes = np.stack([normal, tangent, np.cross(normal, tangent)], axis=-2)
    values = {
        "contact_found": rows[:, :, 0, 0],
        "contact_pos": rows[..., 7:10],
        "contact_normal": normal,
        "contact_force": np.einsum("...i,...ij->...j", rows[..., 1:4], axes),
        "contact_torque": np.einsum("...i,...ij->...j", rows[..., 4:7], axes),
        "contact_netforce": np.stack(nets),
    }
    return SceneState(**{name: torch.from_numpy(value) for name, value in values.items()})


# the same as MuJoCo's sensors


@pytest.mark.parametrize("condim", [1, 3, 6])
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_contacts_match_mujocos_sensors(tmp_path, cone, condim):
    touch = stacked_module(tmp_path, cone, condim)
    model, sim = instrumented(tmp_path, touch), moving_simulation(touch, 8)
    expected = sensor_contacts(model, sim)
    sim.step()
    state = sim.state()
    assert_agree(state, expected, CONTACTS, MOVING_FORCE)
    assert all(getattr(state, name).dtype == torch.float32 and getattr(state, name).is_contiguous() for name in CONTACTS)
    assert (expected.contact_found > 0).all() and expected.contact_found.max() >= 4
    assert bool(expected.contact_torque.abs().max() > 1e-4) == (condim == 6)
    data = forward_data(model, sim)[0]
    bodies = {tuple(model.body(model.geom_bodyid[geom]).name for geom in geoms) for geoms in data.contact.geom}
    for (link, target), is_first in FIRST_IS_LINK.items():
        assert ((link, BODIES[target]) if is_first else (BODIES[target], link)) in bodies or (link, target) == ("cube", "hat")
    assert ("table", "pebble") in bodies or ("pebble", "table") in bodies


def test_contacts_beyond_the_slots_are_counted_and_weighed(tmp_path):
    """The contacts in slots are complete and distinct."""
    touch = stacked_module(tmp_path, slots=2)
    model, sim = instrumented(tmp_path, touch, slots=8), moving_simulation(touch, 4)
    expected = sensor_contacts(model, sim)
    sim.step()
    state = sim.state()
    assert_agree(state, expected, ("contact_found", "contact_netforce"), MOVING_FORCE)
    assert state.contact_pos.shape == (4, 5, 2, 3) and expected.contact_found.max() == 4
    distances = torch.cdist(state.contact_pos.double(), expected.contact_pos)
    assert distances.amin(dim=-1)[expected.contact_found >= 2].max() < 1e-6
    nearest = distances.argmin(dim=-1)
    assert (nearest[..., 0] != nearest[..., 1])[expected.contact_found >= 2].all()
    for name, tolerance in {"contact_force": MOVING_FORCE, "contact_normal": TOLERANCE}.items():
        values = getattr(expected, name)
        nearest_value = torch.gather(values, 2, nearest[..., None].expand(4, 5, 2, 3))
        is_kept = torch.arange(2) < expected.contact_found[..., None]
        error = (getattr(state, name) - nearest_value).abs().amax(dim=-1)[is_kept]
        assert error.max() <= tolerance * values.abs().max(), name
        assert not getattr(state, name)[~is_kept].any(), name


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_forces_match_mujoco_warps_contact_force(tmp_path, cone):
    touch = stacked_module(tmp_path, cone, condim=6)
    sim = moving_simulation(touch, 3)
    sim.step()
    state, (wp, mjw), contacts = sim.state(), libraries(), sim.warp_data.contact
    num = int(sim.arrays["nacon"][0])
    wrench = wp.zeros(num, dtype=wp.spatial_vector, device="cpu")
    mjw.contact_force(sim.warp_model, sim.warp_data, wp.array(np.arange(num), dtype=int, device="cpu"), True, wrench)
    arrays = {name: torch.zeros_like(getattr(state, name)) for name in ("contact_force", "contact_torque")}
    counts = torch.zeros(3, len(PAIRS), dtype=torch.int64)
    for env, geoms, force in zip(contacts.worldid.numpy()[:num], contacts.geom.numpy()[:num], wrench.numpy(), strict=True):
        names = [sim.model.body(sim.model.geom_bodyid[geom]).name for geom in geoms]
        for i, pair in enumerate(PAIRS):
            bodies = [BODIES[pair.object], pair.link]
            if sorted(bodies) == sorted(names):
                sign = 1 if names == bodies else -1
                arrays["contact_force"][env, i, counts[env, i]] = sign * torch.from_numpy(force[:3])
                arrays["contact_torque"][env, i, counts[env, i]] = sign * torch.from_numpy(force[3:])
                counts[env, i] += 1
    assert counts.min() > 0 and arrays["contact_torque"].any()
    assert torch.equal(state.contact_found, counts.float())
    for name, expected in arrays.items():
        torch.testing.assert_close(getattr(state, name), expected, rtol=0, atol=1e-6, msg=name)
    torch.testing.assert_close(state.contact_netforce, arrays["contact_force"].sum(dim=2), rtol=0, atol=1e-5)


# wanted fields and resets


@pytest.mark.parametrize(
    ("fields", "found"),
    [
        (("body_pos", "body_quat"), set()),
        (("contact_found",), {"contact_found"}),
        (("contact_netforce",), {"contact_netforce"}),
        (("contact_torque", "contact_pos"), {"contact_torque", "contact_pos", "contact_found"}),
    ],
)
def test_only_wanted_fields_are_computed(tmp_path, fields, found):
    sims = [moving_simulation(stacked_module(tmp_path, condim=6, fields=wanted), 2) for wanted in (fields, CONTACTS)]
    for sim in sims:
        sim.step()
    state, expected = (sim.state() for sim in sims)
    assert sims[0]._pairs.arrays.keys() == found
    for name in CONTACTS:
        assert (getattr(state, name) is None) == (name not in fields)
        if name in fields:
            assert torch.equal(getattr(state, name), getattr(expected, name)), name


@pytest.mark.parametrize("pairs", [PAIRS, PAIRS[1:]])
def test_states_do_not_change_when_the_simulation_goes_on(tmp_path, pairs):
    """Reset environments read as at the start, the others as before."""
    sim = moving_simulation(stacked_module(tmp_path, condim=6, pairs=pairs), 3)
    states = [sim.state()]
    for _ in range(2):  # after one step, contacts are still at the instant of the start
        sim.step()
    states.append(sim.state())
    copies = [{name: getattr(state, name).clone() for name in CONTACTS} for state in states]
    start = warp(stacked_module(tmp_path, condim=6, pairs=pairs), 3).state()
    sim.reset(torch.tensor([False, True, False]))
    after = sim.state()
    for name in CONTACTS:
        assert not torch.equal(copies[0][name], copies[1][name]) or name == "contact_found"
        assert torch.equal(getattr(after, name)[[0, 2]], copies[1][name][[0, 2]]), name
        torch.testing.assert_close(getattr(after, name)[1], getattr(start, name)[1], rtol=1e-4, atol=1e-6, msg=name)
    sim.step()
    for state, values in zip(states, copies, strict=True):
        assert all(torch.equal(getattr(state, name), value) for name, value in values.items())


# the model's own sensors

OWN = """
  {custom}
  <sensor>
    <contact name="load" body1="table" data="found force torque" reduce="netforce"/>
    <contact name="depth" body1="table" body2="cube" data="found dist" reduce="mindist"/>
  </sensor>
</mujoco>
"""


def model_with_sensors(folder, touch, custom="") -> mujoco.MjModel:
    (folder / "scene.xml").write_text((folder / "scene.xml").read_text().replace("</mujoco>", OWN.format(custom=custom)))
    return instrumented(folder, touch)


def test_the_models_own_contact_sensors_are_evaluated(tmp_path):
    """The part of `sensordata` for tgdsl's sensors stays zero."""
    touch = stacked_module(tmp_path)
    model = model_with_sensors(tmp_path, touch)
    sim = moving_simulation(touch, 3, model=model)
    data = forward_data(model, sim)
    assert {int(model.sensor(name).needstage[0]) for name in ("load", "depth")} == {1, 3}  # stages of positions and of forces
    sim.step()
    is_own = np.zeros(model.nsensordata, dtype=bool)
    for name in ("load", "depth"):
        sensor = model.sensor(name)
        part = slice(int(sensor.adr[0]), int(sensor.adr[0] + sensor.dim[0]))
        is_own[part] = True
        expected = np.stack([single.sensordata[part] for single in data])
        assert expected.all()
        values = sim.arrays["sensordata"][:, part].numpy()
        np.testing.assert_allclose(values, expected, rtol=0, atol=MOVING_FORCE * np.abs(expected).max())
    assert not sim.arrays["sensordata"].numpy()[:, ~is_own].any()


def test_too_many_contacts_for_the_models_own_sensor_are_an_error(tmp_path):
    touch = stacked_module(tmp_path)
    model = model_with_sensors(tmp_path, touch, '<custom><numeric name="contact_sensor_maxmatch" data="2"/></custom>')
    with pytest.raises(SimulationError) as caught:
        warp(touch, 2, model=model).step()
    assert str(caught.value) == (
        "MuJoCo Warp: contacts that a contact sensor of the model's own should report are left out in environments 0, 1: it "
        'matches more than 2; raise it with <custom><numeric name="contact_sensor_maxmatch" data="…"/></custom> in the scene'
    )
