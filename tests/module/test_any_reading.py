"""Observations of any reading and channel, the table of terms, and invalid readings."""

import numpy as np
import pytest
import torch
from joint_scenes import ALL, joint_document, joint_module

import tgdsl
from tgdsl.errors import ObservationError, SpecError

FORCE = {"kind": "force_taxel", "links": "*", "feels": ["item"]}
CHANNELS = ("distance_item", "nearest_item_x", "nearest_item_y", "nearest_item_z")


def features(reading: torch.Tensor, channels: list[int]) -> np.ndarray:
    """Return the expected features, one by one: oldest call first, then by channel, then by row."""
    steps = reading.unbind(1) if reading.ndim == 4 else [reading]
    return np.array(
        [[float(s[e, row, c]) for s in steps for c in channels for row in range(s.shape[1])] for e in range(len(reading))]
    )


def test_a_term_observes_all_channels_of_any_reading(tmp_path):
    """A distance, a pressure and a value per body, which have no term type of their own."""
    terms = [{"type": "reading", "of": name} for name in ("dist", "force", "force/missed")]
    touch = joint_module(tmp_path, {"policy": terms}, force={**FORCE, "outputs": ["pressure"]})
    readings = touch(touch.example_state(3))
    expected = [features(readings[name], list(range(readings[name].shape[2]))) for name in ("dist", "force", "force/missed")]
    policy = touch.observe(readings)["policy"].numpy()
    np.testing.assert_array_equal(policy, np.concatenate(expected, axis=1))
    assert policy.shape[1] == 4 * 4 + 4 * 1 + readings["force/missed"][0].numel()


@pytest.mark.parametrize(
    ("channels", "expected"),
    [
        (["distance_item"], [0]),
        (["nearest_*"], [1, 2, 3]),
        (["nearest_item_z", "distance_*", "nearest_*"], [3, 0, 1, 2]),
        (["*"], [0, 1, 2, 3]),
        (["nearest_item_[xz]"], [1, 3]),
    ],
)
def test_channels_are_chosen_by_name_or_wildcard(tmp_path, channels, expected):
    touch = joint_module(tmp_path, {"policy": [{"type": "reading", "of": "dist", "channels": channels}]})
    assert touch.outputs[0].channels == CHANNELS
    readings = touch(touch.example_state(2))
    np.testing.assert_array_equal(touch.observe(readings)["policy"].numpy(), features(readings["dist"], expected))


def test_channels_of_stacked_calls_are_chosen(tmp_path):
    dist = {"kind": "surface_distance", "links": "*", "feels": ["item"], "nearest": True, "history": 3}
    touch = joint_module(tmp_path, {"policy": [{"type": "reading", "of": "near", "channels": ["nearest_item_y"]}]}, near=dist)
    for seed in range(4):
        readings = touch(touch.example_state(2, seed=seed))
    groups = touch.observe(readings)
    np.testing.assert_array_equal(groups["policy"].numpy(), features(readings["near"], [2]))
    assert touch.observations["policy"][0].size == groups["policy"].shape[1] == 3 * 4
    (term,) = touch.observations["policy"]
    assert repr(touch.observations).splitlines()[2].split() == ["policy", term.name, term.type, "0:12"]


@pytest.mark.parametrize(
    ("term", "where", "message"),
    [
        ({"of": "dist", "channels": ["distence_item"]}, "channels", 'no channel of "dist" matches "distence_item"; did you mean "distance_item"?'),
        ({"of": "dist", "channels": ["distance_item", "x*"]}, "channels", 'no channel of "dist" matches "x*"; known channels: distance_item,'),
        ({"of": "dist/missed"}, "of", 'there is no reading "dist/missed"'),
        ({"of": "dits"}, "of", 'unknown sensor "dits"; did you mean "dist"?'),
        ({"of": "joint_pos"}, "of", 'unknown sensor "joint_pos"; no sensor makes it: {type: joint_pos} observes it'),
    ],
)  # fmt: skip
def test_mistakes_have_their_place_in_the_document(tmp_path, term, where, message):
    document = joint_document(tmp_path, {"policy": [{"type": "none"}, {"type": "reading", **term}]})
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(document)
    assert f"observations.policy[1].{where}" in str(caught.value)
    assert message in str(caught.value)


def test_the_table_of_terms_matches_the_observations(tmp_path):
    """Each term's slice equals a group with only that term, including stacked calls."""
    near = {"kind": "surface_distance", "links": "*", "feels": ["item"], "nearest": True, "history": 2}
    terms = [
        {"type": "none"},
        {"type": "joint_pos"},
        {"type": "reading", "of": "near", "channels": ["nearest_*"]},
        {"type": "reading", "of": "dist"},
        {"type": "last_action", "joints": ["lift"]},
        {"type": "reading", "of": "near", "channels": ["distance_item"]},
    ]
    groups = {"policy": terms} | {f"only{i}": [term] for i, term in enumerate(terms)}
    touch = joint_module(tmp_path, groups, near=near)
    for seed in range(3):
        readings = touch(touch.example_state(2, seed=seed))
    observations, table = touch.observe(readings), touch.observations
    assert table.keys() == observations.keys()
    for i, term in enumerate(table["policy"]):
        assert term.type == terms[i]["type"]
        assert (observations["policy"][:, term.slice] == observations[f"only{i}"]).all()
        assert term.size == observations[f"only{i}"].shape[1] == term.slice.stop - term.slice.start
    assert sum(term.size for term in table["policy"]) == observations["policy"].shape[1]
    assert [term.name for term in table["policy"]] == ["none", "joint_pos", "near[2]", "dist", "last_action", "near[5]"]
    assert [term.name for term in table["only2"]] == ["near"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {}, r'^observation policy\[0\] \(reading\) wants the reading "dist"; found none$'),
        (lambda r: {"x": r["dist"]}, r'^observation policy\[0\] \(reading\) wants the reading "dist"; found x$'),
        (lambda r: {"dist": r["dist"]}, r'policy\[1\] \(joint_pos\) wants the reading "joint_pos"; found dist$'),
        (lambda r: {**r, "dist": r["dist"][:, :3]}, r'"dist" has shape \(2, 3, 4\), expected \(env, 4, 4\)$'),
        (lambda r: {**r, "joint_pos": r["joint_pos"][..., 0]}, r'"joint_pos" has shape \(2, 3\), expected \(env, 3, 1\)$'),
        (lambda r: {**r, "dist": r["dist"].numpy()}, r'"dist" is a ndarray, expected a torch tensor$'),
        (lambda r: {**r, "joint_pos": r["joint_pos"][:1]}, r'^reading "joint_pos" is of 1 environments, "dist" of 2$'),
    ],
)  # fmt: skip
def test_readings_that_do_not_fit_are_named(tmp_path, change, message):
    touch = joint_module(tmp_path, {"policy": [{"type": "reading", "of": "dist"}, {"type": "joint_pos"}]})
    with pytest.raises(ObservationError, match=message):
        touch.observe(change(touch(touch.example_state(2))))


def test_readings_are_needed_for_the_number_of_environments(tmp_path):
    touch = joint_module(tmp_path, {"policy": [{"type": "none"}]})
    with pytest.raises(ObservationError, match="there are no readings, so nothing says how many environments there are"):
        touch.observe({})
    with pytest.raises(ObservationError, match=r'this module has no reading "dits"; did you mean "dist"'):
        touch.observe({"dits": torch.zeros(2, 4, 4)})
    assert touch.observe(touch(touch.example_state(2)))["policy"].shape == (2, 0)


def test_a_reading_term_equals_the_older_force_term(tmp_path):
    terms = {"new": [{"type": "reading", "of": "force"}], "old": [{"type": "force", "of": "force"}]}
    touch = joint_module(tmp_path, terms, force=FORCE)
    groups = touch.observe(touch(touch.example_state(4)))
    assert (groups["new"] == groups["old"]).all()


def test_observe_compiles_to_one_graph(tmp_path):
    terms = [
        {"type": "reading", "of": "dist", "channels": ["nearest_item_z", "distance_item"]},
        {"type": "joint_pos", "joints": ["curl"]},
        *ALL,
    ]
    touch = joint_module(tmp_path, {"policy": terms})
    readings = touch(touch.example_state(3))
    traced = torch.compile(touch.observe, backend="eager", fullgraph=True)
    assert (traced(readings)["policy"] == touch.observe(readings)["policy"]).all()
