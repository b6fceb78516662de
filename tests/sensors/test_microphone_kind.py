"""The microphone against its float64 reference, by the suite that all kinds pass."""

import pytest
import torch
from oracles.setups.listening import TONE

from tgdsl.module.accuracy.states import only
from tgdsl.sensors import MICROPHONE
from tgdsl.testing import KindConformance


class TestMicrophone(KindConformance):
    """On a body, with sound so slow that it is on its way for several steps: bodies stand centimetres apart."""

    kind = MICROPHONE
    num_envs = 12  # errors of float32 are over the loudest of them
    test_compiled_equals_eager = None  # its graph is part of that of blocks, below
    parameters = {"body": "palm", "pos": [0.01, 0.0, 0.02], "speed": 9.0, "reach": 0.6, "nearest": 0.02, "falloff": 1.3}
    others = {"tone": (TONE, {"links": ["palm", "tip"], "frequency": 150.0, "samples": 20})}
    gates = ()
    num_steps = 6

    def test_something_is_felt(self, scene):
        """Nothing is heard before sound has arrived, and something then."""
        module, _ = self.build(self.document(scene), torch.float64)
        heard = [module(state)["s"].abs().amax(dim=(1, 2, 3)) for state in self.states(module)]
        assert (heard[0] == 0).all() and (heard[-1] > 0.1).all()

    def test_no_contact_gives_the_rest_value(self, scene):
        """Of sources that make none there is no sound."""
        others = {"tone": (TONE, {**self.others["tone"][1], "amplitude": 0.0})}
        case = type("Silent", (type(self),), {"others": others})()
        module, _ = case.build(case.document(scene), torch.float32)
        assert all((module(state)["s"] == 0).all() for state in self.states(module))

    def test_a_broken_pose_is_seen(self, scene):
        """Not-a-number in a pose is heard as such, where it is, until the next episode."""
        module, _ = self.build(self.document(scene), torch.float32)
        first, second, third, *_ = self.states(module, 3)
        module(first)
        second.body_pos[1, module.inputs.bodies.index("tip")] = torch.nan
        with pytest.warns(UserWarning, match="poses of bodies are not finite in environments 1"):
            readings = module(second)["s"]
        assert readings[1].isnan().any() and not readings[[0, 2]].isnan().any()
        module.reset([1])
        assert not module(third)["s"].isnan().any()


class TestMicrophoneBlock(TestMicrophone):
    """Read once per control step: blocks of its physics steps come together."""

    test_compiled_equals_eager = KindConformance.test_compiled_equals_eager
    others = {"tone": (TONE, {"links": ["palm", "tip"], "frequency": 150.0, "samples": 12, "substeps": 3})}
    parameters = {**TestMicrophone.parameters, "speed": 15.0, "reach": 0.6}

    def test_something_is_felt(self, scene):
        """Something is heard."""
        module, _ = self.build(self.document(scene), torch.float64)
        heard = [module(state)["s"].abs().amax(dim=(1, 2, 3)) for state in self.states(module)]
        assert (heard[-1] > 0.1).all()


class TestMicrophoneInTheWorld(TestMicrophone):
    """At a point of the world; a turned scene then is another one."""

    parameters = {"pos": [0.01, 0.0, 0.02], "speed": 9.0, "reach": 0.6, "falloff": 2.0, "levels": {"tone": 0.3}}

    @pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9)])
    @pytest.mark.parametrize("distance", [0.0])
    def test_rigid_motion_changes_nothing(self, scene, dtype, tolerance, distance):
        """A scene that is moved with the microphone reads the same."""
        module, _ = self.build(self.document(scene), dtype)
        shift = torch.tensor([3.0, -2.0, 1.0], dtype=dtype)
        there, _ = self.build(self.document(scene, pos=[3.01, -2.0, 1.02]), dtype)
        for state in self.states(module):
            readings = module(state)["s"]
            elsewhere = only(state, slice(None))
            elsewhere.body_pos = state.body_pos + shift
            torch.testing.assert_close(there(elsewhere)["s"], readings, rtol=0, atol=tolerance)
