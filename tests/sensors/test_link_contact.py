"""The solver's readings of each body: contact bit, force, pressing force, their frame and their order."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.warp import WarpSimulation
from tgdsl.sensors.link_contact import LINK_CONTACT
from tgdsl.testing import KindConformance


class TestLinkContact(KindConformance):
    kind = LINK_CONTACT
    test_compiled_equals_eager = None  # `TestLinkContactNormalForce` includes its graph
    is_differentiable = False
    gates = ()

    def test_something_is_felt(self, scene):
        """Every body of the suite's states has a contact, so each reads a force."""
        module, _ = self.build(self.document(scene), torch.float64)
        assert all((module(state)["s"] != 0).all() for state in self.states(module))

    def test_a_broken_pose_is_seen(self, scene):
        """Only the link's pose matters here: without it the force has no direction, and must not read as no contact."""
        module, _ = self.build(self.document(scene), torch.float32)
        state = module.example_state(2)
        state.body_pos[1], state.body_quat[1] = torch.nan, torch.nan
        with pytest.warns(UserWarning, match="poses of bodies are not finite in environments 1"):
            readings = module(state)["s"]
        assert not readings[0].isnan().any()
        assert readings[1].isnan().all()


class TestLinkContactBit(TestLinkContact):
    parameters = {"outputs": ["contact"], "threshold": 2.5}
    test_something_is_felt = KindConformance.test_something_is_felt

    def test_no_distance_is_measured(self, scene):
        """The solver knows the contacts: no geometry reaches the plan, and no velocities are required."""
        plan = self.build(self.document(scene), torch.float32)[0].plan
        assert set(plan.quantities) == {"contacts"} and not any("/geoms/" in name for name in plan.arrays)
        assert plan.inputs.fields == ("body_pos", "body_quat", "contact_netforce")


class TestLinkContactNormalForce(TestLinkContact):
    test_compiled_equals_eager = KindConformance.test_compiled_equals_eager
    parameters = {"outputs": ["contact", "force", "normal_force"], "slots": 5}


class TestLinkContactNormalForceAlone(KindConformance):
    """Where all contacts press, as in the suite's states, the reading is smooth in forces and normals."""

    kind = LINK_CONTACT
    gates = ()
    parameters = {"outputs": ["normal_force"]}
    test_compiled_equals_eager = None  # `TestLinkContactNormalForce` includes its graph

    test_something_is_felt = TestLinkContact.test_something_is_felt
    test_a_broken_pose_is_seen = TestLinkContact.test_a_broken_pose_is_seen


SCENE = """
<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="10"/>
  <worldbody>
    <body name="left" pos="-.2 0 0" euler="0 0 35"><geom type="box" size=".05 .05 .01"/></body>
    <body name="right" pos=".2 0 0"><geom type="box" size=".05 .05 .01"/></body>
    <body name="cube" pos="-.2 0 .0299"><freejoint/><geom type="box" size=".02 .02 .02" mass=".25"/></body>
    <body name="ball" pos="-.17 .03 .0299"><freejoint/><geom type="box" size=".005 .005 .02" mass=".01"/></body>
  </worldbody>
</mujoco>
"""
POINT = {"method": "points", "radius": 0.004, "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1]}] * 2}


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)

    def build(**sensor):
        return tgdsl.compile(
            {
                "tgdsl": 1,
                "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"*": POINT}}}},
                "objects": {"cube": {"body": "cube"}, "ball": {"body": "ball"}},
                "sensors": {"s": {"kind": "link_contact", "links": ["left", "right"], "feels": ["cube", "ball"], **sensor}},
            },
            dtype=torch.float64,
        )

    return build


def resting_readings(touch):
    sim = tgdsl.simulate(touch, 1, substeps=500)
    for _ in range(3):
        sim.step()
    return touch(sim.state())["s"][0].numpy()


def test_a_resting_weight_is_read_in_the_links_frame(scene):
    """One row per body: 0.25 and 0.01 kg on a body turned about its vertical axis, nothing on the other."""
    touch = scene()
    (output,) = touch.outputs
    assert output.bodies == ("left", "right")
    assert output.channels == ("contact", "force_x", "force_y", "force_z")
    assert output.units == ("1", "N", "N", "N")
    np.testing.assert_allclose(resting_readings(touch), [[1, 0, 0, -0.26 * 9.81], [0, 0, 0, 0]], atol=1e-5)


@pytest.mark.parametrize(("threshold", "expected"), [(0, [1, 0]), (0.09, [1, 0]), (2.5, [1, 0]), (2.6, [0, 0])])
def test_threshold(scene, threshold, expected):
    np.testing.assert_array_equal(resting_readings(scene(outputs=["contact"], threshold=threshold))[:, 0], expected)


def test_only_felt_objects_count(scene):
    np.testing.assert_allclose(resting_readings(scene(outputs=["force"], feels=["ball"]))[0], [0, 0, -0.01 * 9.81], atol=1e-5)


def test_only_the_net_force_is_required(scene):
    touch = scene()
    assert touch.inputs.fields == ("body_pos", "body_quat", "contact_netforce")
    assert touch.inputs.slots == 0


def test_a_force_in_the_world_is_read_in_the_links_frame(scene):
    touch = scene()
    state = touch.example_state(1)
    turn = Rotation.from_rotvec([0.4, -0.3, 1.0])
    state.body_quat[:] = torch.from_numpy(turn.as_quat(scalar_first=True))
    state.contact_netforce[:] = 0
    pairs = [(pair.link, pair.object) for pair in touch.inputs.pairs]
    forces = {("right", "cube"): [1.0, 2, 3], ("right", "ball"): [-0.5, 0, 1]}
    for pair, force in forces.items():
        state.contact_netforce[0, pairs.index(pair)] = torch.tensor(force, dtype=torch.float64)
    expected = turn.inv().apply([0.5, 2, 4])
    np.testing.assert_allclose(touch(state)["s"][0], [[0, 0, 0, 0], [1, *expected]], atol=1e-14)


def world_state(touch, forces, normals):
    """Return a state with the right body touching the cube: a force and a normal per slot; the net force is their sum."""
    state = touch.example_state(1)
    pair = [(pair.link, pair.object) for pair in touch.inputs.pairs].index(("right", "cube"))
    for name in ("contact_force", "contact_torque", "contact_normal", "contact_netforce"):
        getattr(state, name).zero_()
    for slot, (force, normal) in enumerate(zip(forces, normals, strict=True)):
        state.contact_force[0, pair, slot] = torch.tensor(force, dtype=torch.float64)
        state.contact_normal[0, pair, slot] = torch.tensor(normal, dtype=torch.float64)
    state.contact_netforce[0, pair] = state.contact_force[0, pair].sum(dim=0)
    return state, pair


SQUEEZE = ([[3.0, 0.4, 0], [-3.0, 0.4, 0]], [[1.0, 0, 0], [-1.0, 0, 0]])
"""Two walls that press with 3 N each, and friction that carries 0.8 N."""


def test_opposing_normal_forces_add_up(scene):
    """The net force of the walls is their friction; a pulling contact does not press."""
    touch = scene(outputs=["force", "normal_force"])
    assert touch.outputs[0].channels == ("force_x", "force_y", "force_z", "normal_force")
    assert touch.outputs[0].units == ("N",) * 4
    state, _ = world_state(touch, *SQUEEZE)
    reading = touch(state)["s"][0]
    np.testing.assert_allclose(reading[:, 3], [0, 6], atol=1e-14)
    np.testing.assert_allclose(reading[:, :3].norm(dim=1), [0, 0.8], atol=1e-14)
    pulled, _ = world_state(touch, [[3.0, 0, 0], [0, 1.0, 0]], [[1.0, 0, 0], [0, -1.0, 0]])
    np.testing.assert_allclose(touch(pulled)["s"][0, :, 3], [0, 3], atol=1e-14)


def test_a_force_without_a_normal_gives_nan(scene):
    """As in `quantities.contacts`: the normal force needs the missing normal and is NaN; the net force is read."""
    touch = scene(outputs=["force", "normal_force"])
    state, pair = world_state(touch, *SQUEEZE)
    state.contact_normal[0, pair, 0] = 0
    reading = touch(state)["s"][0]
    assert reading[1, 3].isnan() and not reading[0].isnan().any() and not reading[1, :3].isnan().any()


def test_force_beyond_the_slots_is_shared_out(scene):
    """A flat face carries 5 N and its one slot shows 2 N: all normals are equal, so 5 N are read."""
    touch = scene(outputs=["normal_force"], slots=1)
    assert touch.inputs.slots == 1
    state, pair = world_state(touch, [[0, 0, 2.0]], [[0, 0, 1.0]])
    state.contact_netforce[0, pair, 2] = 5
    with pytest.warns(UserWarning, match="more than `slots: 1`"):
        np.testing.assert_allclose(touch(state)["s"][0, :, 0], [0, 5], atol=1e-14)


def test_slots_apply_only_to_the_normal_force(scene):
    with pytest.raises(SpecError, match="`slots` is used by the output `normal_force` alone, expected it to be left out"):
        scene(slots=4)


def test_noise_acts_on_the_normal_force(scene):
    """A quantiser of 3.5 N rounds 6.1 N to 7 N and the net force of 0.9 N to zero: each channel is a separate signal."""
    touch = scene(outputs=["force", "normal_force"], noise={"quantization": 3.5})
    state, _ = world_state(touch, [[3.0, 0.4, 0], [-3.0, 0.4, 0], [0, 0.1, 0]], [[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    np.testing.assert_allclose(touch(state)["s"][0], [[0, 0, 0, 0], [0, 0, 0, 7]], atol=1e-13)


GROOVE = """
<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="10" integrator="implicitfast"/>
  <worldbody>
    <body name="left" pos="-.2 0 0" euler="0 10 0"><geom type="box" size=".05 .05 .01" friction="1"/></body>
    <body name="right" pos=".2 0 0">
      <geom type="box" size=".05 .05 .01" pos="-.05 0 0" euler="0 45 0" condim="1" solref=".01 1"/>
      <geom type="box" size=".05 .05 .01" pos=".05 0 0" euler="0 -45 0" condim="1" solref=".01 1"/>
    </body>
    <body name="cube" pos="-.1947 0 .0295" euler="0 10 0">
      <freejoint/><geom type="box" size=".02 .02 .02" mass=".25" friction="1"/>
    </body>
    <body name="ball" pos=".2 0 .0025"><freejoint/><geom type="sphere" size=".03" mass=".1" condim="1"/></body>
  </worldbody>
</mujoco>
"""
"""A cube held by friction on a slope of 10°, and a ball that slides in a groove of 90°."""


def on_warp(touch):
    return WarpSimulation(touch, 2, device="cpu", substeps=500)


def on_mujoco(touch):
    return BatchSimulation(touch, 2, substeps=500)


@pytest.mark.parametrize("simulator", [on_mujoco, pytest.param(on_warp, marks=pytest.mark.slow)])
def test_the_normal_force_of_a_slope_and_of_a_groove(tmp_path, simulator):
    """The slope carries m g cos θ of the cube's weight; each wall of the groove carries m g / (2 cos 45°) of the ball's."""
    (tmp_path / "scene.xml").write_text(GROOVE)
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml")},
        "objects": {"cube": {"body": "cube"}, "ball": {"body": "ball"}},
        "sensors": {
            "s": {
                "kind": "link_contact",
                "links": ["left", "right"],
                "feels": ["cube", "ball"],
                "outputs": ["force", "normal_force"],
            }
        },
    }
    touch = tgdsl.compile(document, dtype=torch.float64)
    sim = simulator(touch)
    for _ in range(3):
        sim.step()
    reading = touch(sim.state())["s"].numpy()
    weight, slope = np.array([0.25, 0.1]) * 9.81, np.radians(10)
    expected = [weight[0] * np.cos(slope), weight[1] * np.sqrt(2)]
    np.testing.assert_allclose(reading[:, :, 3], [expected] * 2, rtol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(reading[:, :, :3], axis=2), [weight] * 2, rtol=2e-3)
