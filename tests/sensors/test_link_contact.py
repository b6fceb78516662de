"""What the solver says of each body: the bit, the force, their frame and their order."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.sensors.link_contact import LINK_CONTACT
from tgdsl.testing import KindConformance


class TestLinkContact(KindConformance):
    kind = LINK_CONTACT
    is_differentiable = False
    gates = ()

    def test_something_is_felt(self, scene):
        """Every body of the suite's states has some contact, so every one reads a force."""
        module, _ = self.build(self.document(scene), torch.float64)
        assert all((module(state)["s"] != 0).all() for state in self.states(module))

    def test_a_broken_pose_is_seen(self, scene):
        """The link's own pose is all that counts here: its force has no direction, and no contact is not what it reads."""
        module, _ = self.build(self.document(scene), torch.float32)
        state = module.example_state(2)
        state.body_pos[1], state.body_quat[1] = torch.nan, torch.nan
        readings = module(state)["s"]
        assert not readings[0].isnan().any()
        assert readings[1].isnan().all()


class TestLinkContactBit(TestLinkContact):
    parameters = {"outputs": ["contact"], "threshold": 2.5}
    test_compiled_equals_eager = None  # its graph is part of one that is compiled beside it

    test_something_is_felt = KindConformance.test_something_is_felt

    def test_no_distance_is_measured(self, scene):
        """The solver knows already: no geometry reaches the plan, and velocities are not asked for."""
        plan = self.build(self.document(scene), torch.float32)[0].plan
        assert set(plan.quantities) == {"contacts"} and not any("/geoms/" in name for name in plan.arrays)
        assert plan.inputs.fields == ("body_pos", "body_quat", "contact_netforce")


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


def resting(touch):
    sim = tgdsl.simulate(touch, 1, substeps=500)
    for _ in range(3):
        sim.step()
    return touch(sim.state())["s"][0].numpy()


def test_the_weight_of_what_rests_there_in_the_links_frame(scene):
    """0.25 and 0.01 kg on the one body, which is turned about its vertical axis, and nothing on the other: one row each."""
    touch = scene()
    (output,) = touch.outputs
    assert output.bodies == ("left", "right")
    assert output.channels == ("contact", "force_x", "force_y", "force_z")
    assert output.units == ("1", "N", "N", "N")
    np.testing.assert_allclose(resting(touch), [[1, 0, 0, -0.26 * 9.81], [0, 0, 0, 0]], atol=1e-5)


@pytest.mark.parametrize(("threshold", "expected"), [(0, [1, 0]), (0.09, [1, 0]), (2.5, [1, 0]), (2.6, [0, 0])])
def test_threshold(scene, threshold, expected):
    np.testing.assert_array_equal(resting(scene(outputs=["contact"], threshold=threshold))[:, 0], expected)


def test_only_what_it_feels_counts(scene):
    np.testing.assert_allclose(resting(scene(outputs=["force"], feels=["ball"]))[0], [0, 0, -0.01 * 9.81], atol=1e-5)


def test_the_net_force_is_all_that_is_read(scene):
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
