"""Actuation audio against its float64 reference, and its spectrum, level and phase in closed form."""

import numpy as np
import pytest
import torch
from oracles import sound as oracles
from oracles.setups.sounds import driven, motor

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.sensors import ACTUATION_AUDIO
from tgdsl.testing import KindConformance
from tgdsl.testing.conformance import SCENE

JOINTS = """
    <body name="arm" pos="0 0 .1"><joint name="elbow" axis="0 1 0" pos=".01 0 .02"/><geom size=".01"/>
      <body name="rail" pos=".1 0 0"><joint name="rail" type="slide" axis="0 0 1"/><geom size=".01"/>
        <body name="free" pos=".1 0 0"><joint name="free" axis="0 0 1"/><geom size=".01"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m1" joint="rail"/><motor name="m2" joint="elbow"/></actuator>"""


class TestActuationAudio(KindConformance):
    """All parts, at a rate where some partials fade out."""

    kind = ACTUATION_AUDIO
    parameters = {"samples": 17, "friction": 1e-4, "hum": 1e-3, "hum_frequency": 70.0, "partials": [1.0, 0.0, 0.4, 0.3, 0.2]}
    gates = ()
    float64_tolerance = 1e-6
    """Normal numbers use Taylor series, accurate to 3e-7."""
    is_differentiable = False
    """Noise differs at each call; see the block without it."""

    @pytest.fixture
    def scene(self, tmp_path_factory):
        """The conformance scene with three joints, two of them actuated."""
        path = tmp_path_factory.getbasetemp() / "conformance_joints.xml"
        path.write_text(SCENE.replace("</worldbody>", JOINTS))
        return path

    def test_something_is_felt(self, scene):
        """Every joint makes a sound."""
        module, _ = self.build(self.document(scene), torch.float64)
        assert module.rows["s"]["joint"].tolist() == ["rail", "elbow"] and module.inputs.joints == ("rail", "elbow")
        assert all((module(state)["s"].abs().amax(dim=1) > 0).all() for state in self.states(module))

    def test_no_contact_gives_the_rest_value(self, scene):
        """Joints at rest without hum are silent, under load too."""
        document = self.document(scene, hum=0.0)
        del document["sensors"]["s"]["hum_frequency"]
        module, _ = self.build(document, torch.float32)
        for state in self.states(module):
            state.joint_vel.zero_()
            assert state.joint_effort.abs().amin() > 0 and (module(state)["s"] == 0).all()

    def test_a_broken_pose_is_seen(self, scene):
        """A NaN in a velocity is heard until the next episode."""
        module, _ = self.build(self.document(scene), torch.float32)
        first, second, third = self.states(module, 2)
        module(first)
        second.joint_vel[1, 0] = torch.nan
        readings = module(second)["s"]
        assert not readings[0].isnan().any() and readings[1, :, 0].isnan().all() and not readings[1, :, 1].isnan().any()
        module.reset([1])
        assert not module(third)["s"].isnan().any()


class TestActuationAudioBlock(TestActuationAudio):
    """Read once per control step, of joints by name, without noise."""

    test_compiled_equals_eager = None  # its graph is part of the one above, step by step
    parameters = {"samples": 8, "substeps": 3, "joints": ["free", "r*"], "friction": 0.0, "hum": 0.0}
    float64_tolerance = 1e-12
    is_differentiable = True

    def test_something_is_felt(self, scene):
        """Rows are in the order of the list."""
        module, _ = self.build(self.document(scene), torch.float64)
        assert module.rows["s"]["joint"].tolist() == ["free", "rail"] and module.inputs.joints == ("rail", "free")
        assert all((module(state)["s"].abs().amax(dim=1) > 0).all() for state in self.states(module))

    def test_no_contact_gives_the_rest_value(self, scene):
        """Joints at rest are silent."""
        module, _ = self.build(self.document(scene), torch.float32)
        for state in self.states(module):
            for part in (state, *state.substeps):
                part.joint_vel.zero_()
            assert (module(state)["s"] == 0).all()

    def test_a_broken_pose_is_seen(self, scene):
        """A NaN in a velocity is heard in the rest of the block."""
        module, _ = self.build(self.document(scene), torch.float32)
        state = module.example_state(1)
        state.substeps[1].joint_vel[0, 1] = torch.nan
        readings = module(state)["s"]
        assert readings[0, 8:, 0].isnan().all() and not readings[0, :8].isnan().any() and not readings[..., 1, :].isnan().any()

    def test_gradients_of_parameters_equal_finite_differences(self, scene):
        """Where no partial fades."""
        case = type("Slow", (type(self),), {"parameters": {**self.parameters, "pitch": 30.0, "partials": [1.0, 0.5]}})()
        KindConformance.test_gradients_of_parameters_equal_finite_differences(case, scene)


@pytest.fixture
def build(tmp_path):
    def compiled(dtype="float64", **fields):
        return motor(tmp_path, dtype, **fields)

    return compiled


def test_partials_have_their_frequencies_and_levels():
    """At 8 rad/s and 100 Hz per rad/s: peaks of ℓ a_h at 800, 1600 and 2400 Hz."""
    comparison = oracles.partials()
    assert comparison.at == ("800 Hz", "1600 Hz", "2400 Hz")


def test_reversals_and_load_steps_do_not_click(build):
    """Samples differ no more between steps than within them."""
    touch = build(load=0.1, power=0.1, partials=[1.0, 0.5])
    velocities = 3.0 * np.cos(2 * np.pi * 5 * np.arange(300) * 1e-3)
    efforts = np.where(np.arange(300) < 150, 0.1, 2.0)
    samples = driven(touch, velocities, efforts)[0]
    steps = np.abs(np.diff(samples)).reshape(-1)
    between, within = steps[19::20], np.delete(steps, np.s_[19::20])
    assert between.max() <= 1.05 * within.max() and within.max() > 0


def test_noise_depends_only_on_seed_and_environment(build):
    """A seed repeats its samples, another one gives others; an environment has its samples in every batch."""
    velocities = np.full(3, 3.0)
    first = driven(build(friction=1e-3), velocities, 0.0, num_envs=3)
    np.testing.assert_array_equal(driven(build(friction=1e-3), velocities, 0.0, num_envs=3), first)
    assert (driven(build(friction=1e-3).seed(5), velocities, 0.0, num_envs=3) != first).all()
    np.testing.assert_array_equal(driven(build(friction=1e-3).seed(0, first_env=2), velocities, 0.0), first[2:])


def test_single_precision_keeps_the_phase(build):
    """After 1,250 turns of the phase, at a varying speed, samples are off by less than 1e-3 of the amplitude."""
    velocities = 5.0 + 2.0 * np.sin(np.arange(1000) * 0.01)
    samples = [
        driven(build(dtype, load=1.0, partials=[1.0], pitch=250.0), velocities, 1.0)[0][-200:]
        for dtype in ("float64", "float32")
    ]
    np.testing.assert_allclose(samples[1], samples[0], atol=1e-3)


def test_a_simulation_reads_the_joints_of_the_same_instant(build):
    """MuJoCo's velocity and actuator force, at each physics step of a control step."""
    touch = build(load=0.1, substeps=2, partials=[1.0], samples=10)
    sim = tgdsl.simulate(touch, 1, substeps=2)
    single = build(load=0.1, partials=[1.0], samples=10)
    other = tgdsl.simulate(single, 1, substeps=2)
    control = torch.tensor([0.2])
    for _ in range(20):
        sim.step(control)
        block = touch(sim.state())["motors"]
        each = torch.cat([single(state)["motors"] for state in other.substates(control)], dim=1)
        torch.testing.assert_close(block, each, rtol=0, atol=1e-12)
    assert block.abs().max() > 1e-4


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"joints": ["elbov"], "load": 1.0},
            r'sensors\.motors\.joints\[0\]: no joint of the robot matches "elbov"; did you mean "elbow"',
        ),
        ({"load": 0.0}, r"`load`, `power`, `friction` and `hum` are all 0"),
        ({"load": 1.0, "links": "arm"}, r"sensors\.motors\.links: unknown key"),
    ],
)
def test_mistakes_name_their_place(build, fields, message):
    with pytest.raises(SpecError, match=message):
        build(**fields)


def test_a_robot_without_actuators_is_a_mistake(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    sensors = {"motors": {"kind": "actuation_audio"}}
    with pytest.raises(SpecError, match=r"sensors\.motors: the robot has no actuated joints"):
        tgdsl.compile({"tgdsl": 1, "robot": {"model": str(tmp_path / "scene.xml")}, "sensors": sensors})
