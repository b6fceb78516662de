"""The kind as a whole: the conformance suite, cases by hand, gradients, and refused fields."""

import numpy as np
import pytest
import torch
from oracles import markers
from oracles.markers import BALL, ELASTIC, PROBES, pressed
from oracles.setups.scenes import module, state

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.sensors.elastomer import ELASTOMER
from tgdsl.testing import SCENE, KindConformance, assert_agrees


class TestElastomer(KindConformance):
    kind = ELASTOMER
    parameters = {"standoff": 0.003, "friction": 0.6}
    gates = ("geometric",)


class TestElastomerWithoutAStandoff(KindConformance):
    kind = ELASTOMER
    parameters = {"friction": 0.6}
    test_compiled_equals_eager = None  # its graph equals the one above; other kinds cover the gate


class TestElastomerAsInThePaper(KindConformance):
    kind = ELASTOMER
    parameters = {"standoff": 0.003, "model": "paper", "normalize": "peak", "compressibility": 0.4, "anchors": "taxels"}
    gates = ("geometric",)
    test_compiled_equals_eager = None  # part of another compiled graph


class TestHalfSpace(KindConformance):
    kind = ELASTOMER
    parameters = {"standoff": 0.003, **ELASTIC, "friction": 0.8, "marker_depth": 0.0005}
    gates = ("geometric",)


class BondedLayer(KindConformance):
    kind = ELASTOMER
    parameters = {"standoff": 0.003, **ELASTIC, "kernel": "bonded_layer", "thickness": 0.004}
    num_envs = 3


class Unsheared(KindConformance):
    kind = ELASTOMER
    parameters = {"standoff": 0.003, **ELASTIC, "shear_strength": 0}
    num_envs = 4


@pytest.mark.parametrize(("suite", "tolerance"), [(BondedLayer(), 1e-5), (Unsheared(), 1e-12)])
def test_other_kernels_equal_their_reference(tmp_path, suite, tolerance):
    """The layer's table against the integrals, and pressure without shear, which keeps no state."""
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    touch, reference = suite.build(suite.document(scene), torch.float64)
    assert touch.has_state == isinstance(suite, BondedLayer)
    for inputs in suite.states(touch):
        assert_agrees(touch(inputs)["s"], reference, inputs, tolerance)


def test_shear_matters_in_the_suites_states(tmp_path):
    """In the suite's states anchors persist from one to the next, and they move markers."""
    suite = TestElastomer()
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    touch, _ = suite.build(suite.document(scene), torch.float64)
    still, _ = suite.build(suite.document(scene, friction=0), torch.float64)
    differences = [float((touch(s)["s"] - still(s)["s"]).abs().max() / still(s)["s"].abs().max()) for s in suite.states(touch)]
    assert differences[0] == 0 and max(differences) > 1e-2


def test_the_paper_as_printed_moves_markers_farther():
    comparison = markers.dilation()
    assert comparison.paper_error > 10 * abs(comparison.exact[3])


def test_shear_starts_with_the_motion_and_a_load_draws_markers_near():
    assert pressed()[0, 0] == 0
    elastic = markers.elastic_skin().ours
    assert elastic[2] < 0 and pressed(**ELASTIC)[1, 0] < 0


def test_a_standoff_acts_above_the_taxels():
    u = pressed(depth=-1e-3, standoff="1.5 mm", shear_strength=0)
    np.testing.assert_allclose(u[0, 2], markers.WEIGHT * 100 * 5e-4**1.2, rtol=1e-12)


@pytest.mark.parametrize("gate", [None, "geometric"])
def test_a_standoff_acts_before_the_simulator_has_a_contact(tmp_path, gate):
    """A descending ball: the bulge follows its depth from first touch, whatever contacts the simulator has."""
    touch = module(tmp_path, PROBES[:1], BALL, kind="elastomer", gate=gate, standoff="1.5 mm", shear_strength=0)
    assert touch.inputs.fields == ("body_pos", "body_quat")


def test_without_a_standoff_the_gate_is_still_the_pairs(tmp_path):
    touch = module(tmp_path, PROBES, BALL, kind="elastomer", gate=None)
    assert "contact_found" in touch.inputs.fields


def test_lifting_ends_the_shear(tmp_path):
    touch = module(tmp_path, PROBES, BALL, kind="elastomer")
    for x, z in ((0.0, 0.0095), (2e-4, 0.0095), (2e-4, 0.0102)):
        touch(state(touch, pos=[x, 0, z]))
    lifted = touch(state(touch, pos=[2e-4, 0, 0.0095]))["s"]
    fresh = module(tmp_path, PROBES, BALL, kind="elastomer")
    torch.testing.assert_close(lifted, fresh(state(fresh, pos=[2e-4, 0, 0.0095]))["s"], rtol=0, atol=0)


def test_an_elastic_skin_has_no_traction_without_pressure(tmp_path):
    """Out of contact, within the band that keeps anchors, there is no traction; back in contact, the old anchor acts."""
    touch = module(tmp_path, PROBES, BALL, kind="elastomer", **ELASTIC)
    initial, above, after = (touch(state(touch, pos=[x, 0, z]))["s"] for x, z in ((0, 0.0095), (2e-4, 0.01005), (2e-4, 0.0095)))
    assert not above.any()
    assert initial[0, 0, 0] == 0 and after[0, 0, 0] > 1e-6


def test_without_shear_there_is_neither_state_nor_frame(tmp_path):
    touch = module(tmp_path, PROBES, BALL, kind="elastomer", shear_strength=0)
    assert not touch.has_state and touch.plan.quantities["contact_depth"].uses[0].wants == ()
    assert touch.outputs[0].channels == ("displacement_x", "displacement_y", "displacement_z")
    assert not any(name.startswith("drag") for name in touch.plan.sensors[0].constants)


GRID = [(x, y, 0.0) for x in np.linspace(-3e-3, 3e-3, 4) for y in np.linspace(-3e-3, 3e-3, 4)]


def read_once(scene, touch, memory):
    return touch.core({"body_pos": scene.body_pos, "body_quat": scene.body_quat}, memory)[0]["s"]


@pytest.mark.parametrize("sensor", [{}, {"friction": 0.3}, ELASTIC, {**ELASTIC, "friction": 0.3}])
def test_gradients_by_pose_with_held_anchors(tmp_path, sensor):
    """Gradients of the second call, while taxels stick or some slide, against central differences."""
    touch = module(tmp_path, GRID, BALL, kind="elastomer", **sensor)
    first, second = state(touch, pos=[0, 0, 0.0085]), state(touch, pos=[3e-4, 1e-4, 0.0084], quat=[1, 0.02, 0.01, 0.03])
    touch(first)
    memory = {name: value.clone() for name, value in touch.memory.named_buffers()}
    assert second.body_pos is not None and second.body_quat is not None
    leaves = [second.body_pos.clone().requires_grad_(), second.body_quat.clone().requires_grad_()]

    def read(pos, quat):
        return touch.core({"body_pos": pos, "body_quat": quat}, memory)[0]["s"] / scale

    scale = float(read_once(second, touch, memory).abs().max())
    assert torch.autograd.gradcheck(read, leaves, eps=1e-8, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("field", "constant", "value", "sensor"),
    [
        ("depth_exponent", "depth_exponent", 1.2, {}),
        ("dilation_strength", "dilation_strength", 100.0, {}),
        ("shear_strength", "shear_strength", 100.0, {}),
        ("friction", "slip", 0.3, {}),
        ("friction", "slip", 0.3, ELASTIC),
        ("normal_stiffness", ("normal_stiffness", "shear_stiffness"), 1e8, {**ELASTIC, "friction": 0.3}),
    ],
)
def test_gradients_by_parameter(tmp_path, field, constant, value, sensor):
    """Derivatives by the constants equal those by the document's field, from central differences of documents."""
    sensor = {**sensor, field: value}

    def read(touch):
        touch(state(touch, pos=[0, 0, 0.0085]))
        return touch(state(touch, pos=[3e-4, 1e-4, 0.0084]))["s"]

    step = 1e-5 * value
    high, low = (read(module(tmp_path, GRID, BALL, kind="elastomer", **{**sensor, field: value + d})) for d in (step, -step))
    expected = (high - low) / (2 * step)
    touch = module(tmp_path, GRID, BALL, kind="elastomer", **sensor)
    factor = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    for name in [constant] if isinstance(constant, str) else constant:
        key = f"sensors/s/{name}"
        ratio = float(touch.plan.arrays[key]) / value
        touch.constants._buffers[key] = ratio * value * factor
    direction = torch.randn(expected.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (derivative,) = torch.autograd.grad((read(touch) * direction).sum(), [factor])
    assert float(derivative) / value == pytest.approx(float((expected * direction).sum()), rel=1e-6)


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.2])
@pytest.mark.parametrize("height", [0.0, 1e-9, 1e-4, 5.0])
def test_gradients_are_finite_at_first_touch(tmp_path, exponent, height):
    """At zero depth, just above, and far away: no NaN, for α < 1 too."""
    touch = module(tmp_path, PROBES, BALL, kind="elastomer", depth_exponent=exponent, friction=0.5, dtype=torch.float32)
    for down in (0.0, 1e-7):
        inputs = state(touch, pos=[0, 0, 0.01 + height - down])
        assert inputs.body_pos is not None
        inputs.body_pos.requires_grad_()
        (gradient,) = torch.autograd.grad(touch(inputs)["s"].sum(), [inputs.body_pos])
        assert torch.isfinite(gradient).all()


REFUSED = [
    ({"youngs_modulus": 1e5}, "`youngs_modulus` is not used by the kernel gaussian"),
    ({"marker_depth": 1e-3}, "`marker_depth` is not used by the kernel gaussian"),
    ({**ELASTIC, "dilation_falloff": 1}, "`dilation_falloff` is not used by the kernel half_space"),
    ({**ELASTIC, "thickness": 1e-3}, "`thickness` is not used by the kernel half_space"),
    ({**ELASTIC, "model": "paper"}, "`model` is not used by the kernel half_space"),
    ({**ELASTIC, "kernel": "bonded_layer"}, "`thickness` is missing, the kernel bonded_layer needs it"),
    ({"kernel": "half_space", "normal_stiffness": 1}, "`youngs_modulus` is missing, the kernel half_space needs it"),
    ({**ELASTIC, "shear_strength": 5}, "`shear_strength` can only be 0"),
    ({"shear_strength": 0, "friction": 1}, "`friction` is not used without shear"),
    ({"model": "paper", "reference_area": 1e-6}, "`reference_area` is not used by `model: paper`"),
    (
        {**ELASTIC, "kernel": "bonded_layer", "thickness": 1e-3, "marker_depth": 2e-3},
        "`marker_depth` 0.002 m is below the layer",
    ),
    ({"boundary": {}}, "`thickness` is missing, a clamped `boundary` needs it"),
    ({"boundary": {}, "thickness": 1e-3, "operator": "fft"}, "`operator: fft` cannot hold a clamped `boundary`"),
    ({"operator": "dense", "tolerance": 1e-3}, "`tolerance` is not used by `operator: dense`"),
    ({"standoff": 1e-3, "gate": "contact_pair"}, "`gate: contact_pair` would hide what `standoff` feels"),
    ({"poissons_ratio": 0.51}, "0.51 is out of range, expected at most 0.5"),
    ({"compressibility": 1.5}, "1.5 is out of range, expected at most 1"),
    ({"tolerance": 1}, "1 is out of range, expected more than 0 and less than 1"),
]


@pytest.mark.parametrize(("fields", "message"), REFUSED)
def test_unused_and_missing_fields_are_refused(tmp_path, fields, message):
    with pytest.raises(SpecError) as caught:
        module(tmp_path, PROBES, BALL, kind="elastomer", **fields)
    assert message in str(caught.value) and "sensors.s" in str(caught.value)


def test_one_half_is_an_ordinary_poissons_ratio(tmp_path):
    """ν → 1/2 is smooth, for the half-space and the layer."""
    for fields in ({}, {"kernel": "bonded_layer", "thickness": 3e-3}):
        near, at = (pressed((1e-4, 0), **{**ELASTIC, **fields, "poissons_ratio": nu}) for nu in (0.5 - 1e-6, 0.5))
        np.testing.assert_allclose(near, at, rtol=0, atol=1e-4 * np.abs(at).max())


def test_the_elastomer_is_a_known_kind():
    assert ELASTOMER in tgdsl.sensors.KINDS and ELASTOMER.name == "elastomer"
