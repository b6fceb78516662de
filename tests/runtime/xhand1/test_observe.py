"""Observations of a hand, against plain NumPy and against the module's observations of the same forces."""

import numpy as np
import pytest
import torch
from xhand1_models import TIPS, document, hand_xml

import tgdsl
from tgdsl.errors import ObservationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import Reading
from tgdsl.runtime.xhand1.observe import HandObserver, finger_of, hand_terms, warn_of_noise
from tgdsl.runtime.xhand1.source import TIME_CONSTANT_S, HandSample, VelocityFilter
from tgdsl.runtime.xhand1.wire.protocol import HandState

AGGREGATES = [
    {"type": "agg_force", "of": "depth"},
    {"type": "none"},
    {"type": "agg_force", "of": "depth", "axes": "xyz", "scale": 3},
]
PLAIN = Calibration.none()


def calibrated(threshold: float | None = None) -> Calibration:
    return Calibration(PLAIN.units, PLAIN.scale, PLAIN.rotation, PLAIN.bias, PLAIN.tare, "", threshold)


def state(total=None, taxel=None) -> HandState:
    return HandState(
        joint_id=np.arange(12, dtype=np.uint8),
        sensor_id=np.zeros(12, np.uint8),
        position=np.zeros(12, np.float32),
        current=np.zeros(12, np.uint16),
        raw_position=np.zeros(12, np.uint16),
        joint_temperature=np.zeros(12, np.uint16),
        joint_error=np.zeros((12, 3), np.uint16),
        reserved=np.zeros((12, 3), np.uint16),
        total_force=np.zeros((5, 3), np.int16) if total is None else total,
        taxel_force=np.zeros((5, 120, 3), np.int16) if taxel is None else taxel,
        taxel_temperature=np.zeros((5, 20), np.uint8),
        total_temperature=np.zeros(5, np.uint8),
    )


def sample(total=None, taxel=None, calibration: Calibration = PLAIN) -> HandSample:
    return HandSample.of(Reading(1, 0.0, 0.1, state(total, taxel)), calibration, VelocityFilter(TIME_CONSTANT_S), 0.0)


def compiled(tmp_path, terms, xml=None, dtype=torch.float32, side="right", **sensors) -> TactileModule:
    return tgdsl.compile(document(tmp_path, {"policy": terms}, xml, side, **sensors), dtype=dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("side", ["right", "left"])
def test_aggregates_have_the_modules_order(tmp_path, dtype, side):
    """The robot's bodies, and so the features, are in another order than the hand's fingers."""
    tips = ("pinky_link2", "thumb_rota_link2", "ring_link2", "index_rota_link2", "mid_link2")
    fingers = [4, 0, 3, 1, 2]
    terms = [*AGGREGATES, {"type": "agg_bool", "of": "contact"}]
    touch = compiled(tmp_path, terms, hand_xml(side, tips=tips), dtype, side)
    total = np.random.default_rng(0).integers(-120, 120, (5, 3)).astype(np.int16)
    total[:, 2] = abs(total[:, 2])
    threshold = float(np.median(np.linalg.norm(total, axis=1))) + 0.5
    features = HandObserver(touch, calibrated(threshold), 0.02).observe(sample(total))["policy"]
    by_link = total[fingers].astype(np.float64)
    expected = [by_link[:, axis] for axis in (2, 1, 0)] + [by_link[:, axis] for axis in (0, 1, 2)]
    expected.append(np.linalg.norm(by_link, axis=1) > threshold)
    np.testing.assert_array_equal(features[0].numpy(), np.concatenate(expected))
    expected_features = touch.observe(touch(touch.example_state(1)))["policy"]
    assert (features.shape, features.dtype, features.device) == (
        expected_features.shape,
        expected_features.dtype,
        expected_features.device,
    )


def test_aggregates_of_the_same_forces_match_the_modules(tmp_path):
    """Depths give the module's forces; a hand with these forces on its fingertips has equal observations."""
    touch = compiled(tmp_path, AGGREGATES[:2], dtype=torch.float64)
    readings = touch(touch.example_state(1))
    readings["depth"] = torch.rand(readings["depth"].shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    normals = touch.taxels["depth"]["normal"]
    per_link = np.einsum("lj,ljk->lk", readings["depth"].numpy().reshape(5, -1), np.asarray(normals).reshape(5, -1, 3))
    exact = Calibration("N", np.full((5, 3), 1e4), PLAIN.rotation, 1e4 * per_link, PLAIN.tare)
    groups = HandObserver(touch, exact, 0.02).observe(sample(calibration=exact))
    np.testing.assert_allclose(groups["policy"].numpy(), touch.observe(readings)["policy"].numpy(), rtol=1e-6)


def test_groups_match_the_document(tmp_path):
    groups = {"policy": AGGREGATES[:1], "blind": [{"type": "none"}], "critic": [{"type": "taxel_saturated"}, *AGGREGATES[2:]]}
    touch = tgdsl.compile(document(tmp_path, groups))
    observations = HandObserver(touch, PLAIN, 0.02).observe(sample())
    assert {name: tuple(part.shape) for name, part in observations.items()} == {
        "policy": (1, 15),
        "blind": (1, 0),
        "critic": (1, 615),
    }
    assert list(observations) == list(groups)


def test_taxels_are_ordered_by_axis_then_by_finger(tmp_path):
    touch = compiled(tmp_path, [{"type": "taxel_counts"}, {"type": "taxel_saturated"}])
    taxel = np.random.default_rng(0).integers(-100, 100, (5, 120, 3)).astype(np.int16)
    taxel[:, :, 2] = abs(taxel[:, :, 2])
    taxel[1, 7, 0], taxel[3, 119, 1], taxel[4, 0, 2] = 127, -128, 255
    features = HandObserver(touch, PLAIN, 0.02).observe(sample(taxel=taxel))["policy"][0]
    assert features.dtype == torch.float32
    counts = [taxel[finger, i, axis] for axis in range(3) for finger in range(5) for i in range(120)]
    np.testing.assert_array_equal(features[:1800].numpy(), counts)
    assert torch.nonzero(features[1800:]).flatten().tolist() == [1 * 120 + 7, 3 * 120 + 119, 4 * 120]


@pytest.mark.parametrize(
    "fields",
    [
        {"history": 3},
        {"history": {"length": 2, "reduce": "last"}},
        {"rate": "20 Hz"},
        {"rate": "30 Hz", "history": 2},
        {"rate": "1 kHz"},
    ],
)
@pytest.mark.filterwarnings("ignore:.*it takes a sample at every call")
def test_rate_and_history_match_the_module(tmp_path, fields):
    """The hand feels at each step what a module without rate and history reads; a reset separates two episodes."""
    plain = compiled(tmp_path, AGGREGATES[:1])
    touch = compiled(tmp_path, AGGREGATES[:1], depth=fields)
    step = 0.02
    observer = HandObserver(touch, PLAIN, step)
    for seed in range(14):
        if seed == 8:
            touch.reset()
            observer.reset()
        scene = touch.example_state(1, seed=seed, spread=0.005)
        scene.dt = step
        by_axis = plain.observe(plain(scene))["policy"].reshape(3, 5)
        force = by_axis.T.flip(1).double().numpy()
        exact = Calibration("N", PLAIN.scale, PLAIN.rotation, force, PLAIN.tare)
        features = observer.observe(sample(calibration=exact))["policy"]
        torch.testing.assert_close(features, touch.observe(touch(scene))["policy"], rtol=1e-6, atol=0)
    assert force.any()


def test_all_unavailable_terms_are_listed_in_one_error(tmp_path):
    terms = [
        {"type": "none"},
        {"type": "depth", "of": "depth"},
        {"type": "agg_force", "of": "depth"},
        {"type": "agg_bool", "of": "contact"},
        {"type": "agg_force", "of": "median"},
    ]
    median = {"kind": "contact_depth", "links": "*", "feels": ["plate"], "history": {"length": 3, "reduce": "median"}}
    touch = compiled(tmp_path, terms, median=median)
    with pytest.raises(ObservationError) as caught:
        hand_terms(touch.plan, None)
    first, *problems, last = str(caught.value).split("\n")
    assert first == "an XHand1 cannot give these observations:"
    assert problems == [
        "  policy[1] depth of depth: it has no such reading of links and taxels as the robot file has them",
        "  policy[3] agg_bool of contact: its calibration has no `contact_threshold`, the force above which a fingertip is in contact",
        "  policy[4] agg_force of median: `history` with `reduce: median` is not done; expected stack or last",
    ]
    assert last.startswith("it can give: none, agg_force and agg_bool of sensors whose links are fingertips, one per finger")
    assert last.endswith("taxel_counts, taxel_saturated")
    assert all(f"*_hand_{tip}" in last for tip in TIPS)


def test_other_links_have_no_sensor(tmp_path):
    whole = document(tmp_path, {"policy": AGGREGATES[:1]})
    tip = whole["robot"]["layout"]["resolutions"]["r"]["right_hand_mid_link2"]
    whole["robot"]["layout"]["resolutions"]["r"]["mid_joint2_body"] = tip
    with pytest.raises(
        ObservationError, match=r'policy\[0\] agg_force of depth: "depth" is on mid_joint2_body, where it has no'
    ):
        hand_terms(tgdsl.compile(whole).plan, None)


@pytest.mark.parametrize(
    ("body", "finger"),
    [
        ("right_hand_thumb_rota_link2", 0),
        ("left_hand_index_rota_link2", 1),
        ("robot/right_hand_mid_link2", 2),
        ("left_hand_ring_link2", 3),
        ("right_hand_pinky_link2", 4),
        ("right_hand_pinky_link1", None),
        ("right_hand_link", None),
        ("mid_link2", None),
    ],
)
def test_fingertips_by_body(body, finger):
    assert finger_of(body) == finger


def test_a_warning_says_that_noise_does_not_apply(tmp_path):
    warn_of_noise(compiled(tmp_path, AGGREGATES[:1]).plan)
    noisy = compiled(tmp_path, AGGREGATES[:1], depth={"noise": "noisy"})
    with pytest.warns(UserWarning, match="the noise of depth is simulated: it is not added to a hand's values"):
        warn_of_noise(noisy.plan)


@pytest.mark.parametrize("type_", ["taxel_counts", "taxel_saturated"])
def test_a_simulation_cannot_give_a_hands_taxels(tmp_path, type_):
    touch = compiled(tmp_path, [{"type": "none"}, {"type": type_}])
    message = rf'observation policy\[1\] is "{type_}", which only a real XHand1 has, and no simulation'
    with pytest.raises(ObservationError, match=message):
        touch.observe(touch(touch.example_state(1)))
    with pytest.raises(ObservationError, match=message):
        tgdsl.connect(touch)
    with pytest.raises(ObservationError, match=rf"policy\[1\] {type_}: the emulator cannot give it"):
        tgdsl.connect(touch, "emulator")


def test_the_plan_counts_the_features_of_taxel_terms(tmp_path):
    touch = compiled(tmp_path, [{"type": "taxel_counts"}, {"type": "taxel_saturated"}, *AGGREGATES])
    assert [term.num_features for term in touch.plan.observations] == [1800, 600, 15, 0, 15]
    assert [term.axes for term in touch.plan.observations] == ["", "", "zyx", "", "xyz"]
