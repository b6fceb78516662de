"""The conformance suite for samples and bands, links and objects, and the paper's response."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tgdsl.compiler.lowered import Surfaces
from tgdsl.modal import analysis
from tgdsl.modal.modes import Modes, ModeShapes
from tgdsl.sensors.contact_audio import reference as definition
from tgdsl.sensors.contact_audio.kind import CONTACT_AUDIO
from tgdsl.surfaces.surface import Surface
from tgdsl.testing import SCENE, KindConformance, assert_agrees

MODES = [
    {"frequency": 310.0, "decay": 12.0, "gain": 2.0},
    {"frequency": 845.0, "decay": 40.0, "gain": -1.0},
    {"frequency": 1520.0, "decay": 90.0, "gain": 0.5},
]
COMMON = {"modes": MODES, "timestep": 0.002, "samples": 8, "scrape": 0.05}


class TestSamples(KindConformance):
    kind = CONTACT_AUDIO
    test_taxel_permutation_commutes = None  # it reads no taxels
    test_compiled_equals_eager = None  # `TestSubsteps` includes its graph
    parameters = COMMON
    gates = ()
    num_steps = 4
    is_differentiable = False
    float64_tolerance = 1e-6  # the cosines of normal numbers are series

    def test_something_is_felt(self, scene):
        """Every body of the suite's states is scraped; none is silent."""
        module, _ = self.build(self.document(scene), torch.float64)
        assert all((module(state)["s"] != 0).any(dim=1).all() for state in self.states(module))

    def test_no_contact_gives_the_rest_value(self, scene):
        """Without contact it is silent from the start."""
        module, _ = self.build(self.document(scene), torch.float32)
        state = module.example_state(4)
        for name in ("contact_found", "contact_pos", "contact_force", "contact_normal", "contact_netforce"):
            for part in (state, *state.substeps):
                setattr(part, name, torch.zeros_like(getattr(part, name)))
        for _ in range(3):
            assert (module(state)["s"] == 0).all()

    def test_a_broken_pose_is_seen(self, scene):
        """Invalid forces or velocities give NaN."""
        for name in ("contact_force", *(["body_linvel"] if self.parameters["scrape"] else [])):
            module, _ = self.build(self.document(scene), torch.float32)
            state = module.example_state(2)
            getattr(state, name)[1] = torch.nan
            readings = module(state)["s"]
            assert not readings[0].isnan().any()
            assert readings[1].isnan().any()


class TestWithoutNoise(TestSamples):
    parameters = {**COMMON, "scrape": 0.0}
    float64_tolerance = KindConformance.float64_tolerance

    def test_something_is_felt(self, scene):
        """The first load is steady; later additions strike once they stop growing."""
        module, _ = self.build(self.document(scene), torch.float64)
        readings = [module(state)["s"] for state in self.states(module)]
        assert (readings[0] == 0).all()
        assert 0.3 < (readings[-1] != 0).any(dim=1).double().mean() <= 1


class TestOfObjects(TestSamples):
    parameters = {**COMMON, "of": "object", "bodies": {"floor": [{"frequency": 1000.0, "decay": 5.0}]}}


class TestBands(TestSamples):
    parameters = {**COMMON, "outputs": "bands"}

    def test_something_is_felt(self, scene):
        """310, 845 and 1520 Hz lie in the third octaves of 316, 794 and 1585 Hz; those between are empty."""
        module, _ = self.build(self.document(scene), torch.float64)
        assert module.outputs[0].channels == tuple(f"band_{f}" for f in (316, 398, 501, 631, 794, 1000, 1259, 1585))
        for state in self.states(module):
            assert ((module(state)["s"] > 0).all(dim=(0, 1, 2)).tolist()) == [True, *[False] * 3, True, *[False] * 2, True]


class TestLevels(TestSamples):
    parameters = {**COMMON, "outputs": "bands", "scale": "decibel"}
    test_something_is_felt = TestBands.test_something_is_felt


class TestSubsteps(TestSamples):
    test_compiled_equals_eager = KindConformance.test_compiled_equals_eager
    parameters = {**COMMON, "substeps": 3}
    num_steps = 2


class TestForce(TestSamples):
    parameters = {**COMMON, "model": "force"}


class TestForceOfObjects(TestSamples):
    parameters = {**COMMON, "model": "force", "of": "object", "scrape": 0.0, "substeps": 2}
    float64_tolerance = KindConformance.float64_tolerance
    test_something_is_felt = None


class TestForceBands(TestSamples):
    parameters = {**COMMON, "model": "force", "outputs": "bands"}
    test_something_is_felt = TestBands.test_something_is_felt


class TestPaper(TestSamples):
    parameters = {**COMMON, "model": "paper"}


@pytest.mark.parametrize("other", [1e-3, 3.1e-3])
def test_another_time_step_matches_the_reference(tmp_path, other):
    """Matrices are rebuilt when the call rate departs from the compiled one, and when it returns."""
    (tmp_path / "scene.xml").write_text(SCENE)
    suite = TestWithoutNoise()
    module, reference = suite.build(suite.document(tmp_path / "scene.xml"), torch.float64)
    for i, (step, seed) in enumerate([(0.002, 0), (other, 1), (other, 2), (0.002, 3)]):
        state = module.example_state(3, seed=seed)
        state.dt = step
        if i == 1:
            with pytest.warns(UserWarning, match=rf"compiled for 1 steps of 0.002 s per call.* counts steps of {other:g} s"):
                readings = module(state)["s"]
        else:
            readings = module(state)["s"]
        assert_agrees(readings, reference, state, 1e-12)


NOTHING = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), ())


def shaped(name, surface, given, below, progress):
    """Modes of no particular body: on a turned grid of 3 × 2 × 4 nodes; the second mode has two fields."""
    rng = np.random.default_rng(len(name))
    axes = Rotation.random(random_state=len(name)).as_matrix()
    low, step, num = np.array([-0.05, -0.04, -0.06]), np.array([0.05, 0.09, 0.04]), np.array([3, 2, 4])
    value = rng.standard_normal((24, 3, 4)).astype(np.float32)
    shapes = ModeShapes(axes, low, step, num, value, np.array([0, 1, 1, 2]), np.full(4, 0.01))
    return Modes(*(np.array([mode[key] for mode in MODES]) for key in ("frequency", "decay", "gain")), shapes=shapes)


class TestAtContacts(TestSamples):
    test_compiled_equals_eager = KindConformance.test_compiled_equals_eager
    parameters = {**COMMON, "modes": "steel", "gains": "contact"}

    @pytest.fixture(autouse=True)
    def own_shapes(self, monkeypatch):
        monkeypatch.setattr(analysis, "analysed", shaped)
        monkeypatch.setattr(definition, "_no_surface", lambda name: NOTHING)
        monkeypatch.setattr(Surfaces, "of_object", lambda own, name: NOTHING)  # the suite's floor has none


class TestForceAtContacts(TestAtContacts):
    parameters = {**TestAtContacts.parameters, "model": "force"}
    test_compiled_equals_eager = None


class TestOfObjectsAtContacts(TestAtContacts):
    parameters = {**TestAtContacts.parameters, "of": "object", "substeps": 2}
    test_compiled_equals_eager = None


class TestPaperAtContacts(TestAtContacts):
    parameters = {**TestAtContacts.parameters, "model": "paper", "samples": 8}
    test_compiled_equals_eager = None
