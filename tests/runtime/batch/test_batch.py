"""The MuJoCo batch against MuJoCo's functions on a single `MjData` that takes the same steps, and against Newton."""

import mujoco
import numpy as np
import pytest
import torch
from batch_cases import ARM, CONTACT_FIELDS, PAD, TOLERANCE, WEIGHT, arm, module, scene, stepped, value, wanting
from scipy.spatial.transform import Rotation

from tgdsl.module.state import SHAPES
from tgdsl.runtime.batch.simulation import BatchSimulation

# poses and velocities


@pytest.mark.parametrize("substeps", [1, 5])
def test_poses_and_velocities_match_mujocos_functions(tmp_path, substeps):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 2, substeps=substeps, keyframe="home")
    controls = np.random.default_rng(0).normal(size=(7, sim.model.nu))
    for control in controls:
        sim.step(control)
    state, data = sim.state(), stepped(sim.model, "home", controls, substeps)
    assert sorted(touch.inputs.bodies) == ["arm", "item", "pad"]
    for i, name in enumerate(touch.inputs.bodies):
        body = sim.model.body(name).id
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(sim.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        np.testing.assert_allclose(value(state, "body_pos")[0, i], data.xpos[body], atol=TOLERANCE)
        np.testing.assert_allclose(value(state, "body_quat")[0, i], data.xquat[body], atol=TOLERANCE)
        np.testing.assert_allclose(value(state, "body_angvel")[0, i], velocity[:3], atol=1e-11)
        np.testing.assert_allclose(value(state, "body_linvel")[0, i], velocity[3:], atol=1e-11)
        if name != "arm":  # the centre of mass must move differently, or this would test nothing
            mujoco.mj_objectVelocity(sim.model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
            assert np.abs(velocity[3:] - value(state, "body_linvel")[0, i]).max() > 1e-3


def test_velocity_is_the_derivative_of_position(tmp_path):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 1, keyframe="home")
    for _ in range(20):
        sim.step()
    states = []
    for _ in range(3):
        states.append(sim.state())
        sim.step()
    before, now, after = (value(state, "body_pos") for state in states)
    assert np.abs(after - now).max() > 1e-3
    # MuJoCo moves positions with the velocity at the end of a step: over two steps, the mean of the velocities at their ends.
    mean = (value(states[1], "body_linvel") + value(states[2], "body_linvel")) / 2
    np.testing.assert_allclose((after - before) / (2 * sim.control_step), mean, atol=5e-3)


def test_state_dtypes_and_fields(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .03'"))
    touch, model = wanting(module(path), path)
    state = BatchSimulation(touch, 3, model=model).state()
    sizes = {"body": 2, "pair": 1, "slot": 4}
    for name in touch.inputs.fields:
        array = getattr(state, name)
        assert array.dtype == torch.float64
        assert array.shape == (3, *(sizes.get(part, part) for part in SHAPES[name])), name
    assert state.dt is None
    assert touch(state)["touch"].shape == (3, 2, 6)


# contacts


@pytest.mark.parametrize(
    ("pad", "item"), [("box", "sphere"), ("sphere", "box"), ("capsule", "box"), ("box", "box"), ("sphere", "sphere")]
)
def test_contacts_match_mujocos_functions(tmp_path, pad, item):
    """MuJoCo orders the geoms of a contact by type: link and object come in either order, with the same force."""
    path = scene(tmp_path, ARM.format(pad=pad, item=item))
    touch, model = wanting(module(path, ("item",)), path)
    sim = BatchSimulation(touch, 1, model=model, substeps=3, keyframe="home")
    controls = np.full((1, model.nu), 0.3)
    sim.step(controls[0])
    state, data = sim.state(), stepped(model, "home", controls, 3)
    link, target = model.body("pad").id, model.body("item").id
    expected = []
    for index, contact in enumerate(data.contact):
        bodies = [int(model.geom_bodyid[g]) for g in (contact.geom1, contact.geom2)]
        if set(bodies) == {link, target}:
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, wrench)  # on geom 2, in the contact's frame
            frame, sign = contact.frame.reshape(3, 3), 1 if bodies[1] == link else -1
            expected.append([contact.pos, sign * wrench[:3] @ frame, sign * wrench[3:] @ frame, sign * frame[0]])
    assert expected
    assert min(np.linalg.norm(force) for _, force, _, _ in expected) > 0.01
    assert value(state, "contact_found")[0, 0] == len(expected)
    in_slots = expected[:4]
    for i, name in enumerate(("contact_pos", "contact_force", "contact_torque", "contact_normal")):
        array = value(state, name)[0, 0]
        order = [int(np.abs(value(state, "contact_pos")[0, 0] - row[0]).sum(axis=1).argmin()) for row in in_slots]
        assert sorted(order) == list(range(len(in_slots)))
        np.testing.assert_allclose(array[order], [row[i] for row in in_slots], atol=1e-9)
        assert not array[len(in_slots) :].any()  # empty slots are zero
    if len(expected) <= 4:
        np.testing.assert_allclose(value(state, "contact_netforce")[0, 0], sum(row[1] for row in expected), atol=1e-9)
    # The force pushes the link away from the object.
    assert all(row[1] @ row[3] > 0 for row in expected)


def test_poses_and_contacts_share_one_instant(tmp_path):
    path = scene(tmp_path, ARM.format(pad="box", item="sphere"))
    touch, model = wanting(module(path, ("item",)), path)
    sim = BatchSimulation(touch, 1, model=model, substeps=4, keyframe="home")
    sim.step(np.array([0.3, 0.3]))
    state = sim.state()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[:] = 0.3
    for _ in range(3):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    i, item = touch.inputs.bodies.index("item"), model.body("item").id
    np.testing.assert_allclose(value(state, "body_pos")[0, i], data.xpos[item], atol=TOLERANCE)
    np.testing.assert_allclose(value(state, "contact_pos")[0, 0, 0], data.contact[0].pos, atol=TOLERANCE)
    moved = np.abs(sim.batch.qpos[0, 2:5] - data.xpos[item]).max()
    assert moved > 1e-4  # `qpos` is one substep further, and neither pose nor contact is


@pytest.mark.parametrize("angle", [0.0, 20.0], ids=["level", "tilted"])
def test_a_resting_cube_presses_with_its_weight(tmp_path, angle):
    place = Rotation.from_euler("y", angle, degrees=True)
    pos = place.apply([0, 0, 0.03])
    text = PAD.format(mount=f"euler='0 {angle} 0'", place=f"pos='{pos[0]} 0 {pos[2]}' euler='0 {angle} 0'")
    path = scene(tmp_path, text)
    touch, model = wanting(module(path), path)
    sim = BatchSimulation(touch, 1, model=model, substeps=500)
    for _ in range(4):
        sim.step()
    state = sim.state()
    np.testing.assert_allclose(
        value(state, "contact_netforce")[0, 0], [0, 0, -WEIGHT], atol=1e-5
    )  # the object's weight, on the link
    np.testing.assert_allclose(value(state, "contact_force")[0, 0].sum(axis=0), [0, 0, -WEIGHT], atol=1e-5)
    normal = place.apply([0, 0, -1])  # out of the cube, into the pad
    for row in value(state, "contact_normal")[0, 0]:
        np.testing.assert_allclose(row, normal, atol=1e-3)
    shear = value(state, "contact_netforce")[0, 0] - value(state, "contact_netforce")[0, 0] @ normal * normal
    np.testing.assert_allclose(np.linalg.norm(shear), WEIGHT * np.sin(np.radians(angle)), atol=1e-3)
    # The contacts' moment about the cube's centre vanishes.
    arms = value(state, "contact_pos")[0, 0] - value(state, "body_pos")[0, touch.inputs.bodies.index("cube")]
    moment = (np.cross(arms, value(state, "contact_force")[0, 0]) + value(state, "contact_torque")[0, 0]).sum(axis=0)
    np.testing.assert_allclose(moment, 0, atol=1e-6)


def test_no_contact_reads_zero(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 1'"))
    touch, model = wanting(module(path), path)
    sim = BatchSimulation(touch, 2, model=model)
    sim.step()
    for name in CONTACT_FIELDS:
        assert not getattr(sim.state(), name).any(), name


def test_the_net_force_includes_contacts_without_a_slot(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .03'"))
    touch, model = wanting(module(path), path, slots=1)
    sim = BatchSimulation(touch, 1, model=model, substeps=500)
    sim.step()
    assert value(sim.state(), "contact_found")[0, 0] >= 3
    np.testing.assert_allclose(value(sim.state(), "contact_netforce")[0, 0, 2], -WEIGHT, atol=1e-4)
    assert abs(value(sim.state(), "contact_force")[0, 0, 0, 2]) < 0.6 * WEIGHT
