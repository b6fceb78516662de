"""The MuJoCo batch against MuJoCo's own functions on one `MjData` that is stepped in parallel, and against Newton."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SHAPES
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.simulate import simulate

TOLERANCE = 1e-12
"""Both sides are float64 and the same solver; what is left is the order of a few sums and products."""
CONTACT_FIELDS = ("contact_found", "contact_pos", "contact_force", "contact_torque", "contact_normal", "contact_netforce")
WEIGHT = 0.25 * 9.81

PAD = """
<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="10"/>
  <worldbody>
    <body name="pad" {mount}><geom name="pad" type="box" size=".05 .05 .01" friction="1"/></body>
    <body name="cube" {place}><freejoint/><geom type="box" size=".02 .02 .02" mass=".25" friction="1"/></body>
  </worldbody>
</mujoco>
"""
ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm" pos=".1 -.2 .3" quat=".8 .2 -.4 .1">
      <joint name="one" axis="0 1 .2"/>
      <geom name="arm" type="capsule" size=".02" fromto="0 0 0 .2 .05 0" contype="2" conaffinity="2"/>
      <body name="pad" pos=".2 .05 .03" euler="20 40 -30">
        <joint name="two" axis="1 0 .3" pos=".01 .02 0"/>
        <geom name="pad" type="{pad}" size=".03 .02 .015" pos=".008 -.01 .02" euler="10 20 30"/>
      </body>
    </body>
    <body name="item" pos=".216 -.231 .525">
      <freejoint/>
      <geom name="item" type="{item}" size=".03 .025 .02" pos="-.01 .02 .005" mass=".1"/>
      <geom type="sphere" size=".01" pos=".1 0 0" mass=".05"/>
    </body>
    <body name="post" pos="0 0 -5"><geom name="post" size=".1"/></body>
  </worldbody>
  <actuator>
    <motor name="one" joint="one" gear=".5"/>
    <motor name="two" joint="two" gear=".2"/>
  </actuator>
  <keyframe>
    <key name="home" qpos="0 0 .216 -.231 .525 1 0 0 0" qvel="3 -2 .1 -.2 .3 4 -5 6"/>
    <key name="far" qpos=".3 -.2 3 0 0 1 0 0 0" ctrl=".1 -.1"/>
  </keyframe>
</mujoco>
"""


def scene(folder, text: str):
    (folder / "scene.xml").write_text(text)
    return folder / "scene.xml"


def module(path, objects=("cube",), links=("pad",), **sensor) -> TactileModule:
    probe = [{"pos": [0, 0, 0.01], "normal": [0, 0, 1]}, {"pos": [0.01, 0, 0.01], "normal": [0, 0, 1]}]
    points = {"method": "points", "points": probe, "radius": 0.005}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(path), "layout": {"resolutions": {"only": dict.fromkeys(links, points)}}},
        "objects": {name: {"body": name} for name in objects},
        "sensors": {"touch": {"kind": "kinematic_taxel", "links": list(links), "feels": list(objects), **sensor}},
    }
    return tgdsl.compile(document)


def wanting(touch: TactileModule, path, fields=CONTACT_FIELDS, slots: int = 4) -> tuple[TactileModule, mujoco.MjModel]:
    """Return the module as if its sensors read the given contact fields too, and a model with the sensors for it."""
    own = tuple(dict.fromkeys((*touch.inputs.fields, *fields)))
    inputs = dataclasses.replace(touch.inputs, fields=own, slots=slots)
    spec = mujoco.MjSpec.from_file(str(path))
    return TactileModule(dataclasses.replace(touch.plan, inputs=inputs)), tgdsl.instrument(spec, inputs).compile()


def arm(folder, pad: str = "box", item: str = "sphere") -> tuple[TactileModule, mujoco.MjModel]:
    path = scene(folder, ARM.format(pad=pad, item=item))
    return wanting(module(path, ("item",), ("pad", "arm"), gate="geometric"), path, ())


def value(state, name: str) -> np.ndarray:
    return getattr(state, name).numpy()


def stepped(model: mujoco.MjModel, keyframe: str | None, controls, substeps: int) -> mujoco.MjData:
    """Return one environment's data just before the last substep, all of it evaluated there."""
    data = mujoco.MjData(model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(model, data, model.key(keyframe).id)
    total = len(controls) * substeps
    for i in range(total):
        data.ctrl[:] = controls[i // substeps]
        if i == total - 1:
            mujoco.mj_forward(model, data)
        else:
            mujoco.mj_step(model, data)
    return data


# poses and velocities


@pytest.mark.parametrize("substeps", [1, 5])
def test_poses_and_velocities_are_those_of_mujocos_functions(tmp_path, substeps):
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
        if name != "arm":  # the centre of mass is elsewhere and moves otherwise, or this would test nothing
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
        found = getattr(state, name)
        assert found.dtype == torch.float64
        assert found.shape == (3, *(sizes.get(part, part) for part in SHAPES[name])), name
    assert state.dt is None
    assert touch(state)["touch"].shape == (3, 2, 6)


# contacts


@pytest.mark.parametrize(
    ("pad", "item"), [("box", "sphere"), ("sphere", "box"), ("capsule", "box"), ("box", "box"), ("sphere", "sphere")]
)
def test_contacts_are_those_of_mujocos_functions(tmp_path, pad, item):
    """MuJoCo orders the geoms of a contact by type: link and object come in either order, and the force must not care."""
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
    kept = expected[:4]
    for i, name in enumerate(("contact_pos", "contact_force", "contact_torque", "contact_normal")):
        found = value(state, name)[0, 0]
        order = [int(np.abs(value(state, "contact_pos")[0, 0] - row[0]).sum(axis=1).argmin()) for row in kept]
        assert sorted(order) == list(range(len(kept)))
        np.testing.assert_allclose(found[order], [row[i] for row in kept], atol=1e-9)
        assert not found[len(kept) :].any()  # empty slots are zero
    if len(expected) <= 4:
        np.testing.assert_allclose(value(state, "contact_netforce")[0, 0], sum(row[1] for row in expected), atol=1e-9)
    # It pushes the link away from the object.
    assert all(row[1] @ row[3] > 0 for row in expected)


def test_pose_and_contact_are_of_one_instant(tmp_path):
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
def test_a_resting_cube_weighs_what_it_weighs(tmp_path, angle):
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
    # The moment of the contacts about the centre of the cube vanishes: nothing turns.
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


def test_the_net_force_knows_what_the_slots_do_not(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .03'"))
    touch, model = wanting(module(path), path, slots=1)
    sim = BatchSimulation(touch, 1, model=model, substeps=500)
    sim.step()
    assert value(sim.state(), "contact_found")[0, 0] >= 3
    np.testing.assert_allclose(value(sim.state(), "contact_netforce")[0, 0, 2], -WEIGHT, atol=1e-4)
    assert abs(value(sim.state(), "contact_force")[0, 0, 0, 2]) < 0.6 * WEIGHT


# stepping and resetting


def test_many_environments_are_as_many_single_ones(tmp_path):
    path = scene(tmp_path, ARM.format(pad="box", item="box"))
    touch, model = wanting(module(path, ("item",)), path)
    controls = np.random.default_rng(1).normal(size=(6, 5, model.nu))
    many = BatchSimulation(touch, 5, model=model, substeps=3, keyframe="home")
    for control in controls:
        many.step(control)
    state = many.state()
    for env in range(5):
        one = BatchSimulation(touch, 1, model=model, substeps=3, keyframe="home", threads=1)
        for control in controls:
            one.step(control[env])
        for name in touch.inputs.fields:
            np.testing.assert_array_equal(value(state, name)[env], value(one.state(), name)[0], err_msg=name)


@pytest.mark.parametrize(
    "ids", [[1, 3], torch.tensor([1, 3]), np.array([1, 3]), [False, True, False, True], torch.tensor([0, 1, 0, 1]).bool()]
)
def test_reset_starts_the_named_environments_and_no_others(tmp_path, ids):
    path = scene(tmp_path, ARM.format(pad="box", item="sphere"))
    touch, model = wanting(module(path, ("item",)), path)
    sim = BatchSimulation(touch, 4, model=model, keyframe="home")
    start = sim.state()
    for _ in range(10):
        sim.step(np.array([0.2, -0.3]))
    before, qpos = sim.state(), sim.batch.qpos.copy()
    sim.reset(ids)
    after = sim.state()
    for name in touch.inputs.fields:
        np.testing.assert_array_equal(value(after, name)[[0, 2]], value(before, name)[[0, 2]], err_msg=name)
        np.testing.assert_array_equal(value(after, name)[[1, 3]], value(start, name)[[1, 3]], err_msg=name)
    np.testing.assert_array_equal(sim.batch.qpos[[0, 2]], qpos[[0, 2]])
    np.testing.assert_array_equal(sim.batch.ctrl[[1, 3]], 0)
    sim.step()  # and the reset ones go on as new ones do
    fresh = BatchSimulation(touch, 1, model=model, keyframe="home")
    fresh.step()
    np.testing.assert_array_equal(sim.batch.qpos[1], fresh.batch.qpos[0])


@pytest.mark.parametrize("ids", [[3, 1], torch.tensor([3, 1, 3]), np.array([3, 1])])
def test_environments_are_reset_in_any_order(tmp_path, ids):
    touch, _ = arm(tmp_path)
    sims = [BatchSimulation(touch, 4, keyframe="home") for _ in range(2)]
    for sim, chosen in zip(sims, (ids, [1, 3]), strict=True):
        for _ in range(3):
            sim.step(np.array([0.2, -0.3]))
        sim.reset(chosen)
    for name in ("qpos", "qvel", "ctrl", "time"):
        np.testing.assert_array_equal(getattr(sims[0].batch, name), getattr(sims[1].batch, name), err_msg=name)


@pytest.mark.parametrize("ids", [[], torch.zeros(0, dtype=torch.long), np.zeros(3, dtype=bool)])
def test_reset_of_none_does_nothing(tmp_path, ids):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, keyframe="home")
    sim.step()
    before = sim.batch.qpos.copy()
    sim.reset(ids)
    np.testing.assert_array_equal(sim.batch.qpos, before)


@pytest.mark.parametrize("ids", [[3], [-1], [True, False], np.array([0.5])])
def test_reset_of_what_is_not_there(tmp_path, ids):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, keyframe="home")
    with pytest.raises(SimulationError, match=r"^env_ids: found .*, expected indices from 0 to 2, or a mask of 3$"):
        sim.reset(ids)


def test_reset_reaches_the_module(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .0295'"))
    touch = module(path, kind="contact", threshold=1e-3, release_threshold=5e-4)
    sim = simulate(touch, 3)
    assert touch(sim.state())["touch"].all()
    sim.reset([1])
    bits = touch.memory.get_buffer("touch:bit")
    assert bits[:, 0].tolist() == [1, 0, 1]
    sim.reset()
    assert not bits.any()


def test_keyframes(tmp_path):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 2, keyframe="far")
    np.testing.assert_array_equal(sim.batch.qpos[1], sim.model.key("far").qpos)
    np.testing.assert_array_equal(sim.batch.ctrl, [[0.1, -0.1]] * 2)
    np.testing.assert_allclose(value(sim.state(), "body_pos")[:, touch.inputs.bodies.index("item")], [[3, 0, 0]] * 2)
    own = BatchSimulation(touch, 1)
    np.testing.assert_array_equal(own.batch.qpos[0], own.model.qpos0)
    with pytest.raises(SimulationError) as caught:
        simulate(touch, 1, keyframe="hme")
    assert str(caught.value) == 'the scene has no keyframe "hme"; did you mean "home"?'


def test_controls(tmp_path):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, substeps=2, keyframe="home")
    assert sim.control_step == pytest.approx(0.004)
    sim.step(np.array([0.1, 0.2]))
    np.testing.assert_array_equal(sim.batch.ctrl, [[0.1, 0.2]] * 3)
    sim.step(torch.arange(6, dtype=torch.float32, requires_grad=True).reshape(3, 2))
    np.testing.assert_array_equal(sim.batch.ctrl, [[0, 1], [2, 3], [4, 5]])
    sim.step()
    np.testing.assert_array_equal(sim.batch.ctrl, [[0, 1], [2, 3], [4, 5]])
    np.testing.assert_allclose(sim.batch.time, 3 * 0.004)


def test_bad_controls_step_nothing(tmp_path):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, keyframe="home")
    before = sim.batch.qpos.copy()
    for control in (np.zeros(3), np.zeros((2, 2)), np.zeros((3, 1)), np.zeros((1, 3, 2)), 1.0):
        with pytest.raises(SimulationError) as caught:
            sim.step(np.asarray(control))
        assert str(caught.value) == f"control has shape {np.shape(control)}, expected (3, 2) or (2,)"
    with pytest.raises(SimulationError, match=r"^control is not finite in environments 0, 2$"):
        sim.step(torch.tensor([[0.0, torch.nan], [1, 1], [torch.inf, 0]]))
    with pytest.raises(SimulationError, match=r"^control is not finite in environments 0$"):
        sim.step(np.array([np.nan, 0.0]))
    np.testing.assert_array_equal(sim.batch.qpos, before)
    assert not sim.batch.ctrl.any()


def test_a_diverging_environment_is_reported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log into the current folder
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, keyframe="home")
    sim.batch.qvel[1, 0] = np.nan
    with pytest.raises(SimulationError) as caught:
        sim.step()
    assert str(caught.value) == "environments 1 diverged, and MuJoCo has started them anew; reset them to go on"
    sim.reset([1])
    sim.step()
    np.testing.assert_allclose(sim.batch.time, [0.004, 0.002, 0.004])
    assert np.isfinite(sim.batch.qpos).all()


# what a scene lacks


def test_a_model_of_your_own_needs_the_contact_sensors(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .03'"))
    touch = module(path)
    with pytest.raises(SimulationError) as caught:
        BatchSimulation(touch, 1, model=mujoco.MjModel.from_xml_path(str(path)))
    assert str(caught.value) == (
        'the scene has no contact sensor "tgdsl/contact/pad/cube", which the module wants; '
        "add them with tgdsl.instrument(spec, touch.inputs) before compiling"
    )


def test_a_model_of_your_own_needs_the_bodies(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .03'"))
    touch = module(path)
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body name='cub'/></worldbody></mujoco>")
    with pytest.raises(SimulationError) as caught:
        BatchSimulation(touch, 1, model=other)
    assert str(caught.value) == 'the scene has no body "cube"; did you mean "cub"?'


@pytest.mark.parametrize("keys", [{"num_envs": 0}, {"num_envs": 1, "substeps": 0}])
def test_nothing_to_step(tmp_path, keys):
    touch, _ = arm(tmp_path)
    with pytest.raises(SimulationError, match=r"expected at least 1 of each"):
        simulate(touch, **keys)


def test_rk4_is_refused_because_its_poses_and_contacts_are_of_two_instants(tmp_path):
    text = PAD.format(mount="", place="pos='0 0 .03'").replace("<option ", "<option integrator='RK4' ")
    touch = module(scene(tmp_path, text))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    data.qvel[0] = 1
    mujoco.mj_step(model, data)
    assert data.body("cube").xpos[0] > 1e-3  # not where the contacts were found: there is the oracle
    with pytest.raises(SimulationError, match=r"^with the integrator RK4 MuJoCo's poses and contacts are of two instants"):
        simulate(touch, 1)


def test_bodies_that_a_scene_lacks_are_called_bodies(tmp_path):
    touch, _ = arm(tmp_path)
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body name='zzz'/></worldbody></mujoco>")
    with pytest.raises(SimulationError, match=r'^the scene has no body "arm"; known bodies: world, zzz$'):
        BatchSimulation(touch, 1, model=other)
