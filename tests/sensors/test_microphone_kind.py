"""The microphone against its float64 reference, by the suite of all kinds."""

import pytest
import torch
from oracles.setups.listening import TONE

from tgdsl.module.accuracy.states import only
from tgdsl.sensors import MICROPHONE
from tgdsl.testing import KindConformance


class TestMicrophone(KindConformance):
    """On a body, with sound slow enough to travel for several steps: bodies stand centimetres apart."""

    kind = MICROPHONE
    num_envs = 12  # float32 errors are relative to the loudest one
    test_compiled_equals_eager = None  # `TestMicrophoneBlock` includes its graph
    parameters = {"body": "palm", "pos": [0.01, 0.0, 0.02], "speed": 9.0, "reach": 0.6, "nearest": 0.02, "falloff": 1.3}
    others = {"tone": (TONE, {"links": ["palm", "tip"], "frequency": 150.0, "samples": 20})}
    gates = ()
    num_steps = 6

    def test_something_is_felt(self, scene):
        """It is silent until sound arrives, and then is not."""
        module, _ = self.build(self.document(scene), torch.float64)
        heard = [module(state)["s"].abs().amax(dim=(1, 2, 3)) for state in self.states(module)]
        assert (heard[0] == 0).all() and (heard[-1] > 0.1).all()

    def test_no_contact_gives_the_rest_value(self, scene):
        """Silent sources make no sound."""
        others = {"tone": (TONE, {**self.others["tone"][1], "amplitude": 0.0})}
        case = type("Silent", (type(self),), {"others": others})()
        module, _ = case.build(case.document(scene), torch.float32)
        assert all((module(state)["s"] == 0).all() for state in self.states(module))

    def test_a_broken_pose_is_seen(self, scene):
        """A NaN in a pose gives NaN in its environment until the next episode."""
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
    """One reading per control step: the blocks of its physics steps come together."""

    test_compiled_equals_eager = KindConformance.test_compiled_equals_eager
    others = {"tone": (TONE, {"links": ["palm", "tip"], "frequency": 150.0, "samples": 12, "substeps": 3})}
    parameters = {**TestMicrophone.parameters, "speed": 15.0, "reach": 0.6}

    def test_something_is_felt(self, scene):
        module, _ = self.build(self.document(scene), torch.float64)
        heard = [module(state)["s"].abs().amax(dim=(1, 2, 3)) for state in self.states(module)]
        assert (heard[-1] > 0.1).all()


class TestMicrophoneInTheWorld(TestMicrophone):
    """At a point of the world: a turned scene reads differently."""

    parameters = {"pos": [0.01, 0.0, 0.02], "speed": 9.0, "reach": 0.6, "falloff": 2.0, "levels": {"tone": 0.3}}

    @pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9)])
    @pytest.mark.parametrize("distance", [0.0])
    def test_rigid_motion_changes_nothing(self, scene, dtype, tolerance, distance):
        """A scene moved together with the microphone reads the same."""
        module, _ = self.build(self.document(scene), dtype)
        shift = torch.tensor([3.0, -2.0, 1.0], dtype=dtype)
        there, _ = self.build(self.document(scene, pos=[3.01, -2.0, 1.02]), dtype)
        for state in self.states(module):
            readings = module(state)["s"]
            elsewhere = only(state, slice(None))
            elsewhere.body_pos = state.body_pos + shift
            torch.testing.assert_close(there(elsewhere)["s"], readings, rtol=0, atol=tolerance)
