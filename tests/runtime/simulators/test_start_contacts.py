"""Resets without collision detection, on both simulators: kinematic poses, no forces, other environments unchanged."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from warp_cases import SCENE, module, wanting_contacts, warp

from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.simulators.state_values import FIELDS

BOTH = pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])
DEEP = np.array([0, 0, 0.0295, 1, 0, 0, 0, 0.4, -0.1])
"""The cube penetrates the table by half a millimetre, and the arm is elsewhere."""


def tensors(state) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in vars(state).items() if isinstance(value, torch.Tensor)}


def stepped_simulation(simulator, tmp_path, num_envs=4, **options):
    touch, model = wanting_contacts(tmp_path)
    sim = simulator(touch, num_envs, model=model, keyframe="home", **options)
    sim.reset(qvel=np.zeros(8))
    for _ in range(5):
        sim.step(np.array([0.2, -0.3]))
    return touch, sim


@BOTH
@pytest.mark.parametrize("substeps", [1, 3])
def test_reset_without_contacts_has_mujocos_kinematics_and_no_forces(tmp_path, simulator, substeps):
    touch, sim = stepped_simulation(simulator, tmp_path, substeps=substeps)
    before = tensors(sim.state())
    qvel = np.linspace(-0.4, 0.3, sim.model.nv)
    mask = torch.tensor([False, True, False, True])
    sim.reset(mask, contacts="none", qpos=DEEP, qvel=qvel)
    after, data = tensors(sim.state()), mujoco.MjData(sim.model)
    data.qpos[:], data.qvel[:] = DEEP, qvel
    mujoco.mj_forward(sim.model, data)
    assert data.ncon == 4  # collision detection would find contacts
    for i, name in enumerate(touch.inputs.bodies):
        body, velocity = sim.model.body(name).id, np.zeros(6)
        mujoco.mj_objectVelocity(sim.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        for env in (1, 3):
            np.testing.assert_allclose(after["body_pos"][env, i], data.xpos[body], atol=1e-7)
            np.testing.assert_allclose(after["body_quat"][env, i], data.xquat[body], atol=1e-6)
            np.testing.assert_allclose(after["body_angvel"][env, i], velocity[:3], atol=1e-6)
            np.testing.assert_allclose(after["body_linvel"][env, i], velocity[3:], atol=1e-6)
    assert any(before[name].any() for name in FIELDS if name in before)
    for name, value in after.items():
        assert torch.equal(value[[0, 2]], before[name][[0, 2]]), name
        if name in FIELDS:
            assert not value[[1, 3]].any(), name


@BOTH
@pytest.mark.parametrize("which", [[1], [3, 0], [0, 1, 2]], ids=["one", "few", "most"])
@pytest.mark.parametrize("stored", ["none", "stored", "evaluate"])
def test_reading_some_environments_matches_the_module_on_the_whole_state(tmp_path, simulator, which, stored):
    """After a reset, with and without stored contacts: `sim.read(mask)` is bit-identical to `touch(sim.state(), mask)`."""
    touch, sim = stepped_simulation(simulator, tmp_path)
    force = torch.arange(12.0, dtype=torch.float64).view(4, 1, 3).expand(-1, len(touch.inputs.pairs), -1)
    values = {"contact_found": torch.ones((4, len(touch.inputs.pairs))), "contact_netforce": force}
    slots = torch.zeros((4, len(touch.inputs.pairs), touch.inputs.slots, 3), dtype=torch.float64)
    slots[:, :, 0] = force  # the slots show the whole force
    contacts = values | {"contact_force": slots} if stored == "stored" else stored
    touch.memory.keeps_last = True
    with torch.no_grad():
        sim.read()
        mask = torch.zeros(4, dtype=torch.bool)
        mask[which] = True
        sim.reset(mask, contacts=contacts, qpos=DEEP)
        copied = copy.deepcopy(touch)
        expected = copied(sim.state(), mask)
        readings = sim.read(mask)
        by_index = sim.read(which)  # by indices, and a second time
    for name, reading in expected.items():
        assert torch.equal(readings[name], reading) and torch.equal(by_index[name], reading), name
    assert any(reading[mask].any() for reading in readings.values()) == (stored != "none")


@BOTH
def test_the_next_step_does_not_depend_on_evaluated_contacts(tmp_path, simulator):
    results = []
    for contacts in ("none", "evaluate"):
        _, sim = stepped_simulation(simulator, tmp_path)
        sim.reset([2], contacts=contacts, qpos=DEEP)
        sim.step(np.array([0.1, 0.1]))
        results.append((sim.qpos.clone(), sim.qvel.clone(), tensors(sim.state())))
    (qpos, qvel, state), (qpos_evaluated, qvel_evaluated, state_evaluated) = results
    assert torch.equal(qpos, qpos_evaluated) and torch.equal(qvel, qvel_evaluated)
    assert state["contact_found"][2].any()
    for name, value in state.items():
        assert torch.equal(value, state_evaluated[name]), name


@BOTH
def test_stored_contacts_are_restored(tmp_path, simulator):
    _, sim = stepped_simulation(simulator, tmp_path)
    sim.reset([0], qpos=DEEP)
    stored = tensors(sim.state())
    start = {name: stored[name][0] for name in FIELDS if name in stored}
    assert start["contact_netforce"].any()
    before = tensors(sim.state())
    sim.reset([1, 3], contacts=start, qpos=DEEP)
    sim.reset(torch.tensor([False, False, True, False]), contacts="none", qpos=DEEP)
    after = tensors(sim.state())
    for name, value in after.items():
        assert torch.equal(value[0], before[name][0]), name
        if name in FIELDS:
            assert torch.equal(value[1], start[name]) and torch.equal(value[3], start[name]), name
            assert not value[2].any(), name
    sim.forward([1])  # evaluating finds the same contacts
    np.testing.assert_allclose(sim.state().contact_netforce[1], start["contact_netforce"], rtol=1e-5, atol=1e-6)


@BOTH
def test_invalid_contacts_are_named(tmp_path, simulator):
    _, sim = stepped_simulation(simulator, tmp_path)
    before = tensors(sim.state())
    with pytest.raises(
        SimulationError, match='contacts: this module wants no "contact_netfroce"; did you mean "contact_netforce"'
    ):
        sim.reset([0], contacts={"contact_netfroce": torch.zeros(3)})
    with pytest.raises(SimulationError, match=r"contacts: contact_found has shape \(7,\), expected \(4, \d+\) or \(\d+,\)"):
        sim.reset([0], contacts={"contact_found": torch.zeros(7)})
    with pytest.raises(SimulationError, match='contacts is "evalute"; did you mean "evaluate"'):
        sim.reset([0], contacts="evalute")
    with pytest.raises(SimulationError, match='contacts is "all"; known choices: evaluate, none'):
        sim.reset([0], contacts="all")
    for name, value in tensors(sim.state()).items():
        assert torch.equal(value, before[name]), name


@BOTH
def test_reading_some_environments_keeps_the_rows_of_the_others(tmp_path, simulator):
    touch = module(tmp_path, noise={"white_noise": 1e-3})
    sim = simulator(touch, 3, keyframe="home")
    sim.step(np.zeros(2))
    first = sim.read()["touch"].clone()
    sim.reset([1], contacts="none", qpos=np.array([0, 0, 1.0, 1, 0, 0, 0, 0, 0]))
    second = sim.read(torch.tensor([False, True, False]))["touch"].clone()
    assert torch.equal(second[[0, 2]], first[[0, 2]]) and not torch.equal(second[1], first[1])


# Drives


@BOTH
@pytest.mark.parametrize("substeps", [1, 4])
def test_a_drive_is_called_before_each_physics_step(tmp_path, simulator, substeps):
    touch = module(
        tmp_path,
        SCENE.replace(
            'type="box" size=".05 .05 .01" friction="1"', 'type="box" size=".05 .05 .01" contype="0" conaffinity="0"'
        ),
    )
    driven, plain = (
        simulator(touch, 2, keyframe="home", substeps=substeps),
        mujoco.MjData(mujoco.MjModel.from_xml_string(SCENE)),
    )
    torques, model = [], driven.model

    def drive() -> None:
        """Damp the arm's first joint in proportion to its current speed."""
        torque = -0.02 * driven.qvel[:, 6]
        driven._arrays["qfrc_applied"][:, 6] = torque
        torques.append(float(torque[0]))

    driven.drive = drive
    mujoco.mj_resetDataKeyframe(model, plain := mujoco.MjData(model), model.key("home").id)
    for _ in range(3):
        driven.step(np.array([0.1, -0.1]))
        for _ in range(substeps):
            plain.qfrc_applied[6] = -0.02 * plain.qvel[6]
            plain.ctrl[:] = [0.1, -0.1]
            mujoco.mj_step(model, plain)
    assert len(torques) == 3 * substeps and len(set(torques)) == len(torques)
    np.testing.assert_allclose(driven.qvel[0], plain.qvel, rtol=1e-4, atol=1e-5)
    driven.drive = None
    driven.step()
    assert len(torques) == 3 * substeps
