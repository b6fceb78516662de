"""Noise in documents, and in the resulting plan: profiles, knobs by kind, links, quantities."""

import numpy as np
import pytest
from noise_documents import document, mistakes, planned

from tgdsl.compiler.pipeline import compile_document
from tgdsl.sensors import KINDS

TISSUE = {"gain_low": 0.85, "gain_high": 1.15, "hysteresis_strength": 0.5, "hysteresis_time": 0.05}
DEAD = {"dead_probability": 0.05, "dead_low": 0.0}
NOISY = {
    ("contact", "bool"): {"release_threshold": 2e-4, **DEAD},
    ("contact", "agg_bool"): {"release_threshold": 2e-4, **DEAD},
    ("contact_depth", "depth"): {"white_noise": 2e-4, "quantization": 1e-4, "radius_noise": 3e-4, **DEAD, **TISSUE},
    ("contact_depth", "agg_force"): {"white_noise": 2e-4, "quantization": 1e-4, "radius_noise": 3e-4, **DEAD, **TISSUE},
    ("kinematic_taxel", "force"): {"white_noise": 5e-3, "drift": 1e-4, "quantization": 1e-2, "radius_noise": 3e-4, **DEAD, **TISSUE},
    ("kinematic_taxel", "force_torque"): {"white_noise": 5e-3, "drift": 1e-4, "quantization": 1e-2, "radius_noise": 3e-4, **DEAD, **TISSUE},
    ("proximity", "proximity"): {"white_noise": 1e-2, "drift": 1e-3, "quantization": 1e-2, "radius_noise": 6e-4, **DEAD, **TISSUE},
    ("elastomer", "elastomer"): {"white_noise": 1e-4, "drift": 1e-5, "quantization": 1e-4, "radius_noise": 3e-4, **DEAD, **TISSUE},
}  # fmt: skip
"""The paper's table "Sensor imperfection parameters", by sensor kind and observation type; other knobs are off."""


@pytest.mark.parametrize(("kind", "observation"), NOISY)
def test_noisy_is_the_papers_noisy_condition(tmp_path, kind, observation):
    """The plan holds exactly the table's values, the same for all channels, rows and environments."""
    _, arrays = planned(tmp_path, kind, "noisy", observations=[observation])
    assert {name: value.size for name, value in arrays.items()} == dict.fromkeys(NOISY[kind, observation], 1)
    assert {name: value.item() for name, value in arrays.items()} == NOISY[kind, observation]


BASE = {"read_delay", "jitter", "white_noise", "bias", "drift", "quantization"}
KNOBS_OF = {
    "surface_distance": BASE | {"radius_noise"},
    "contact": BASE | {"radius_noise", "gain", "dead_probability", "dead_range", "hysteresis", "release_threshold"},
    "contact_depth": BASE | {"radius_noise", "gain", "dead_probability", "dead_range", "hysteresis"},
    "kinematic_taxel": BASE | {"radius_noise", "gain", "dead_probability", "dead_range", "hysteresis", "crosstalk"},
    "elastomer": BASE | {"radius_noise", "gain", "dead_probability", "dead_range", "hysteresis"},
    "proximity": BASE | {"radius_noise", "gain", "dead_probability", "dead_range", "hysteresis", "crosstalk"},
    "force_taxel": BASE | {"radius_noise", "gain", "dead_probability", "dead_range", "hysteresis", "crosstalk"},
    "link_contact": BASE,
    "temperature_grid": BASE,
    "contact_audio": set(),
    "actuation_audio": set(),
    "microphone": set(),
}
"""The paper's table "Imperfection knobs available per sensor type", the Schmitt threshold that its values give to `bool`, and
kinds that the paper lacks: `force_taxel` like its taxels of force, `link_contact` and `temperature_grid` with the common
knobs, and `contact_audio`, which reads blocks, with none."""
VALUES = {
    "read_delay": 0.01,
    "jitter": 0.01,
    "white_noise": 1e-3,
    "bias": 1e-3,
    "drift": 1e-3,
    "quantization": 1e-3,
    "radius_noise": 1e-4,
    "gain": [0.9, 1.1],
    "dead_probability": 0.1,
    "dead_range": [0, 1],
    "hysteresis": {"strength": 0.5, "time_constant": 0.05},
    "crosstalk": {"strength": 0.1, "sigma": 0.003},
    "release_threshold": 1e-4,
}
IDLE = {("surface_distance", "radius_noise")}
"""Knobs that the table gives a kind but that do not affect its readings: a warning says so."""


def test_the_tables_of_this_test_are_complete():
    assert set(KNOBS_OF) == {kind.name for kind in KINDS}
    assert set().union(*KNOBS_OF.values()) == set(VALUES)


TERMS = {"read_delay": "delay", "jitter": "delay", "dead_probability": "dead", "dead_range": "dead"}


@pytest.mark.parametrize("kind", KNOBS_OF)
def test_a_kind_plans_its_knobs(tmp_path, kind):
    """All of them, and nothing else."""
    noise = {knob: VALUES[knob] for knob in sorted(KNOBS_OF[kind]) if (kind, knob) not in IDLE}
    terms, _ = planned(tmp_path, kind, noise)
    assert set(terms) == {TERMS.get(knob, knob) for knob in noise}


@pytest.mark.parametrize(("kind", "knob"), [(kind, knob) for kind in KNOBS_OF for knob in VALUES if knob not in KNOBS_OF[kind]])
def test_a_knob_that_a_kind_lacks_is_a_mistake(tmp_path, kind, knob):
    assert mistakes(tmp_path, kind, {knob: VALUES[knob]}) == [f'sensors.s.noise.{knob}: "{kind}" has no knob "{knob}"']


@pytest.mark.parametrize(("kind", "knob"), IDLE)
def test_a_knob_without_effect_warns(tmp_path, kind, knob):
    with pytest.warns(UserWarning, match=f'^sensor "s": {knob} changes nothing in what {kind} reads$'):
        assert planned(tmp_path, kind, {knob: VALUES[knob]}) == ((), {})


@pytest.mark.parametrize("noise", ["noisy", {"like": "noisy"}])
@pytest.mark.parametrize("kind", ["surface_distance", "link_contact"])
def test_a_profile_without_knobs_for_a_kind_warns(tmp_path, kind, noise):
    with pytest.warns(UserWarning, match=f'^sensor "s": the profile "noisy" has no knobs for {kind}, so it reads clean$'):
        assert planned(tmp_path, kind, noise) == ((), {})


@pytest.mark.parametrize("knob", ["crosstalk", "release_threshold"])
def test_a_missing_knob_is_named_in_links_and_profiles(tmp_path, knob):
    knobs = {knob: VALUES[knob]}
    message = f'"contact_depth" has no knob "{knob}"'
    assert mistakes(tmp_path, "contact_depth", {"links": {"palm": knobs}}) == [f"sensors.s.noise.links.palm.{knob}: {message}"]
    assert mistakes(tmp_path, "contact_depth", "worn", {"worn": knobs}) == [
        f"sensors.s.noise: {message} (in the profile worn → clean)"
    ]
    assert mistakes(tmp_path, "contact_depth", {"like": "old", "bias": 1}, {"worn": knobs, "old": {"like": "worn"}}) == [
        f"sensors.s.noise: {message} (in the profile old → worn → clean)"
    ]


# links


def rows(value) -> list[float]:
    """Return a knob's value on the three links: two taxels each, in the order of the robot's bodies."""
    each = np.broadcast_to(value, (1, 6))[0].reshape(3, 2)
    assert (each[:, 0] == each[:, 1]).all()
    return each[:, 0].tolist()


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        ({"palm": 2}, [1, 1, 2]),
        ({"tips": 2}, [2, 2, 1]),
        ({"?_tip": 2}, [2, 2, 1]),
        ({"*": 2}, [2, 2, 2]),
        ({"tips": 2, "a_tip": 3}, [3, 2, 1]),
        ({"a_tip": 3, "tips": 2}, [2, 2, 1]),
        ({"*": 2, "*_tip": 3, "b_tip": 0}, [3, 0, 2]),
    ],
)
def test_links_override_knobs(tmp_path, links, expected):
    """By name, group and wildcard; the last match counts."""
    noise = {"white_noise": 1, "links": {pattern: {"white_noise": value} for pattern, value in links.items()}}
    assert rows(planned(tmp_path, "contact_depth", noise)[1]["white_noise"]) == expected
    profiles = {"own": noise}
    assert rows(planned(tmp_path, "contact_depth", "own", profiles)[1]["white_noise"]) == expected
    assert rows(planned(tmp_path, "contact_depth", {"like": "own"}, profiles)[1]["white_noise"]) == expected


def test_links_keep_the_other_knobs_and_can_switch_one_off(tmp_path):
    noise = {"like": "noisy", "links": {"palm": {"white_noise": 1, "hysteresis": None, "gain": [1, 1]}, "a_tip": {"bias": 2}}}
    terms, arrays = planned(tmp_path, "contact_depth", noise)
    assert terms == ("radius_noise", "gain", "hysteresis", "bias", "white_noise", "quantization", "dead")
    assert rows(arrays["white_noise"]) == [2e-4, 2e-4, 1]
    assert rows(arrays["hysteresis_strength"]) == [0.5, 0.5, 0]
    assert rows(arrays["gain_low"]) == [0.85, 0.85, 1] and rows(arrays["gain_high"]) == [1.15, 1.15, 1]
    assert rows(arrays["bias"]) == [2, 0, 0]
    assert arrays["dead_probability"].item() == 0.05


def test_links_of_a_sensor_that_reads_bodies(tmp_path):
    noise = {"bias": 1, "links": {"b_tip": {"bias": 2}}}
    (bias,) = planned(tmp_path, "link_contact", noise)[1].values()
    np.testing.assert_array_equal(np.broadcast_to(bias, (1, 3)), [[1, 2, 1]])


def test_links_in_line_override_those_in_a_profile(tmp_path):
    noise = {"like": "own", "links": {"*_tip": {"bias": 3}}}
    arrays = planned(tmp_path, "contact_depth", noise, {"own": {"links": {"a_tip": {"bias": 1}, "palm": {"bias": 2}}}})[1]
    assert rows(arrays["bias"]) == [3, 3, 2]


def test_unknown_links_are_mistakes(tmp_path):
    for noise, profiles, place in (
        ({"links": {"a_tipp": {"bias": 1}}}, None, "sensors.s.noise.links.a_tipp: no link matches"),
        ("own", {"own": {"links": {"a_tipp": {"bias": 1}}}}, 'sensors.s.noise: in the profile "own": no link matches'),
    ):
        (message,) = mistakes(tmp_path, "contact_depth", noise, profiles)
        assert message.startswith(place) and '"a_tipp"' in message


def test_links_without_the_sensor_are_a_mistake(tmp_path):
    """In line only: a profile may be shared by sensors on other links, and ignores such links."""
    links = {"links": {"palm": {"bias": 1}}}
    (message,) = mistakes(tmp_path, "contact_depth", links, links=["tips"])
    assert message.startswith("sensors.s.noise.links.palm: no link matches")


def test_a_profile_ignores_links_without_the_sensor(tmp_path):
    spec = document(tmp_path, "contact_depth", "own", {"own": {"bias": 1, "links": {"palm": {"bias": 2}}}}, links="tips")
    spec["sensors"]["t"] = {**spec["sensors"]["s"], "links": "palm"}
    plan = compile_document(spec).plan
    assert [plan.arrays[f"sensors/{name}/noise/bias"].tolist() for name in ("s", "t")] == [[[1.0]], [[2.0]]]


# quantities


def test_amplitudes_by_quantity(tmp_path):
    noise = {
        "white_noise": {"force": 5e-3, "torque": 1e-4},
        "drift": {"torque": 1e-5},
        "bias": {"force": [1, 2]},
        "dead_probability": 0.1,
        "dead_range": [{"force": -1}, {"force": 1, "torque": 0.1}],
        "quantization": 1e-2,
    }
    arrays = planned(tmp_path, "kinematic_taxel", noise)[1]
    np.testing.assert_array_equal(arrays["white_noise"], np.array([[5e-3] * 3 + [1e-4] * 3]).T)
    np.testing.assert_array_equal(arrays["drift"], np.array([[0.0] * 3 + [1e-5] * 3]).T)
    np.testing.assert_array_equal(arrays["bias"][..., 0], [[1, 1, 1, 0, 0, 0], [2, 2, 2, 0, 0, 0]])
    np.testing.assert_array_equal(arrays["dead_low"], np.array([[-1.0] * 3 + [0.0] * 3]).T)
    np.testing.assert_array_equal(arrays["dead_high"], np.array([[1.0] * 3 + [0.1] * 3]).T)
    assert arrays["quantization"].tolist() == [[1e-2]]


@pytest.mark.parametrize(
    ("kind", "quantities"),
    [
        ("contact", ["depth"]),
        ("contact_depth", ["depth"]),
        ("kinematic_taxel", ["force", "torque"]),
        ("elastomer", ["displacement"]),
        ("link_contact", ["force"]),
        ("surface_distance", ["distance_item"]),
        ("force_taxel", ["force"]),
    ],
)
def test_the_quantities_of_each_kind(tmp_path, kind, quantities):
    amplitudes = ("bias", "white_noise", "drift", "quantization")
    arrays = planned(tmp_path, kind, {knob: dict.fromkeys(quantities, 0.5) for knob in amplitudes})[1]
    assert {name: value.tolist() for name, value in arrays.items()} == {knob: [[0.5]] for knob in amplitudes}
    (message,) = mistakes(tmp_path, kind, {"drift": {"temperature": 1}})
    assert message == 'sensors.s.noise: "drift" names "temperature", which this sensor does not read'


def test_a_quantity_that_outputs_omit_is_a_mistake(tmp_path):
    (message,) = mistakes(tmp_path, "kinematic_taxel", {"bias": {"torque": 1}}, outputs=["force"])
    assert message == 'sensors.s.noise: "bias" names "torque", which this sensor does not read'


# profiles


def test_profiles_build_on_profiles(tmp_path):
    profiles = {
        "worn": {"like": "noisy", "bias": 1e-3, "gain": [0.5, 1]},
        "old": {"like": "worn", "gain": [0.4, 1], "links": {"palm": {"bias": 2e-3}}},
    }
    _, arrays = planned(tmp_path, "contact_depth", {"like": "old", "hysteresis": None, "read_delay": "5 ms"}, profiles)
    assert rows(arrays["bias"]) == [1e-3, 1e-3, 2e-3]
    assert arrays["gain_low"].item() == 0.4 and arrays["gain_high"].item() == 1
    assert arrays["read_delay"].item() == 5e-3 and "hysteresis_strength" not in arrays
    rest = {name: NOISY["contact_depth", "depth"][name] for name in ("white_noise", "quantization", "radius_noise", *DEAD)}
    assert {name: arrays[name].item() for name in rest} == rest


def test_a_profile_like_noisy_depends_on_the_kind(tmp_path):
    """In a profile `like: noisy` means the `noisy` of the sensor that uses it."""
    for kind, expected in (("contact_depth", 2e-4), ("elastomer", 1e-4), ("proximity", 1e-2)):
        arrays = planned(tmp_path, kind, "mine", {"mine": {"like": "noisy", "bias": 1}})[1]
        assert arrays["white_noise"].item() == expected and arrays["bias"].item() == 1


def test_a_document_may_define_noisy(tmp_path):
    assert planned(tmp_path, "contact_depth", "noisy", {"noisy": {"bias": 1}})[1] == {"bias": np.array([[1.0]])}
    assert planned(tmp_path, "contact_depth", {"like": "noisy", "drift": 2}, {"noisy": {"bias": 1}})[0] == ("bias", "drift")
