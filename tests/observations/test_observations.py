from typing import Literal

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SpecError, TgdslError
from tgdsl.observations import observations
from tgdsl.observations.observations import AggBoolObservation, CopObservation, OfReading, PerLink, register
from tgdsl.schema.document import json_schema

SCENE = """
<mujoco><worldbody>
  <body name="a"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="b"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="item"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""
NORMALS = {"a": [[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, 1]], "b": [[0, 0, 1], [0.6, 0, 0.8]]}


TERMS = {
    "taxels": [{"type": "force", "of": "touch"}, {"type": "depth", "of": "depth"}],
    "all": [{"type": "force_torque", "of": "touch"}],
    "links": [{"type": "agg_force", "of": "depth"}, {"type": "agg_bool", "of": "contact"}],
    "plain": [{"type": "agg_force", "of": "depth", "axes": "xyz", "scale": 2}, {"type": "bool", "of": "contact"}],
    "any": [{"type": "agg_bool", "of": "contact", "more_than": 0}],
}


def observation_document(folder, terms):
    (folder / "scene.xml").write_text(SCENE)
    layout = {
        link: {
            "method": "points",
            "radius": 0.004,
            "points": [{"pos": [0.004 * i, 0, 0.01], "normal": n} for i, n in enumerate(rows)],
        }
        for link, rows in NORMALS.items()
    }
    kinds = {"touch": "kinematic_taxel", "depth": "contact_depth", "contact": "contact"}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": layout}}},
        "objects": {"item": {"body": "item"}},
        "sensors": {name: {"kind": kind, "links": "*", "feels": ["item"]} for name, kind in kinds.items()},
        "observations": terms,
    }


@pytest.fixture
def touch(tmp_path):
    return tgdsl.compile(observation_document(tmp_path, TERMS), dtype=torch.float64)


@pytest.fixture
def readings():
    rng = np.random.default_rng(0)
    return {
        "touch": torch.tensor(rng.normal(size=(3, 6, 6))),
        "depth": torch.tensor(rng.uniform(0, 0.004, (3, 6, 1))),
        "contact": torch.tensor([[1, 1, 1, 0, 1, 1], [1, 1, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1]], dtype=torch.float64)[..., None],
    }


def test_taxels_are_flattened_channel_major(touch, readings):
    groups = touch.observe(readings)
    force = readings["touch"][:, :, :3].numpy()
    expected = np.concatenate([*(force[:, :, axis] for axis in range(3)), readings["depth"][:, :, 0].numpy()], axis=1)
    np.testing.assert_array_equal(groups["taxels"].numpy(), expected)
    both = readings["touch"].numpy()
    np.testing.assert_array_equal(groups["all"].numpy(), np.concatenate([both[:, :, c] for c in range(6)], axis=1))


def test_agg_force_is_the_papers_formula(touch, readings):
    """10⁴ P_ZYX Σ d n, per link, channel-major: z of every link, then y, then x."""
    depth = readings["depth"].numpy()[:, :, 0]
    per_link = np.stack(
        [np.einsum("ej,jk->ek", depth[:, :4], NORMALS["a"]), np.einsum("ej,jk->ek", depth[:, 4:], NORMALS["b"])], axis=1
    )
    groups = touch.observe(readings)
    expected = 1e4 * per_link[:, :, ::-1].transpose(0, 2, 1).reshape(3, 6)
    np.testing.assert_allclose(groups["links"][:, :6].numpy(), expected, rtol=1e-12)
    np.testing.assert_allclose(groups["plain"][:, :6].numpy(), 2 * per_link.transpose(0, 2, 1).reshape(3, 6), rtol=1e-12)


def test_the_centre_of_pressure_is_where_normal_forces_balance(tmp_path):
    """Taxels lie at 0, 4, 8, 12 mm along x of `a`: 1 N and 3 N along −z on the first and the last balance at 9 mm.

    Shear and pull do not move it; a link without pressure reads 0; NaNs propagate.
    """
    terms = {"policy": [{"type": "cop", "of": "touch"}], "firm": [{"type": "cop", "of": "touch", "threshold": "5 N"}]}
    touch = tgdsl.compile(observation_document(tmp_path, terms), dtype=torch.float64)
    force = torch.zeros(3, 6, 6, dtype=torch.float64)
    force[0, 0, :3], force[0, 3, :3] = torch.tensor([0.5, 0, -1.0]), torch.tensor([0, 0, -3.0])
    force[0, 5, :3] = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)  # pulls on the second taxel of b
    force[1, 1, :3] = torch.tensor([0, -7.0, 0])  # on the second taxel of a, whose normal is y
    force[2, 0, 2] = torch.nan
    groups = touch.observe({"touch": force})
    policy = groups["policy"].unflatten(1, (6, 2))
    a, b = policy[:2].unbind(2)
    expected = [[0.5, 0, -4, 0.009, 0, 0.01], [0, -7, 0, 0.004, 0, 0.01]]
    torch.testing.assert_close(a, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-15)
    torch.testing.assert_close(b[0], torch.tensor([0.6, 0, 0.8, 0, 0, 0], dtype=torch.float64), rtol=0, atol=0)
    assert not b[1].any() and policy[2, 2:, 0].isnan().all()
    firm = groups["firm"].unflatten(1, (6, 2))
    assert not firm[0, 3:].any() and torch.equal(firm[1], policy[1]), "4 N are within the threshold, 7 N beyond"


def test_agg_bool_counts_more_than_two(touch, readings):
    groups = touch.observe(readings)
    np.testing.assert_array_equal(groups["links"][:, 6:].numpy(), [[1, 0], [0, 0], [0, 0]])
    np.testing.assert_array_equal(groups["any"].numpy(), [[1, 1], [1, 0], [0, 1]])
    np.testing.assert_array_equal(groups["plain"][:, 6:].numpy(), readings["contact"][:, :, 0].numpy())
    assert AggBoolObservation(type="agg_bool", of="contact").features == (("contact of more than 2 taxels", "1", "", 1.0),)


def test_centres_of_pressure_are_metres_and_newtons():
    names = [*(f"force_{axis}" for axis in "xyz"), *(f"centre of pressure, {axis}" for axis in "xyz")]
    units = [*3 * ["N"], *3 * ["m"]]
    features = tuple((name, unit, "link", 1.0) for name, unit in zip(names, units, strict=True))
    assert CopObservation(type="cop", of="touch").features == features


def test_a_hands_own_taxels_are_120_on_each_of_five_fingers(tmp_path):
    """Three components of each, and one bit."""
    terms = {"raw": [{"type": "taxel_counts"}, {"type": "taxel_saturated"}]}
    counts, saturated = tgdsl.compile(observation_document(tmp_path, terms)).observations["raw"]
    assert (counts.slice.stop, saturated.slice.stop) == (1800, 1800 + 600)


def test_counts_propagate_nan(touch, readings):
    readings["contact"][0, 0] = torch.nan
    assert touch.observe(readings)["links"][0, 6].isnan()


def test_the_plan_states_the_number_of_features(touch, readings):
    groups = touch.observe(readings)
    planned: dict[str, int] = {}
    for term in touch.plan.observations:
        planned[term.group] = planned.get(term.group, 0) + term.num_features
    assert {group: part.shape[1] for group, part in groups.items()} == planned
    real = touch.observe(touch(touch.example_state(2)))
    assert {group: tuple(part.shape) for group, part in real.items()} == {group: (2, n) for group, n in planned.items()}


def test_the_none_type_adds_nothing(tmp_path, touch, readings):
    document = observation_document(
        tmp_path, {"blind": [{"type": "none"}], "both": [{"type": "none"}, {"type": "depth", "of": "depth"}]}
    )
    groups = tgdsl.compile(document, dtype=torch.float64).observe(readings)
    assert groups["blind"].shape == (3, 0)
    torch.testing.assert_close(groups["both"], touch.observe(readings)["taxels"][:, 18:], rtol=0, atol=0)


def test_a_reading_with_the_wrong_rows_is_a_mistake(tmp_path):
    with pytest.raises(
        SpecError, match='"link_bool" needs contact of each body, which "contact" does not read; it reads contact of each taxel'
    ):
        tgdsl.compile(observation_document(tmp_path, {"policy": [{"type": "link_bool", "of": "contact"}]}))
    with pytest.raises(SpecError, match=r'"elastomer" needs displacement_x, .* of each taxel, which "touch" does not read'):
        tgdsl.compile(observation_document(tmp_path, {"policy": [{"type": "elastomer", "of": "touch"}]}))


@pytest.mark.slow  # compiled, which types that are checked at each call do not allow
def test_types_of_forces_links_and_joints_compile_to_one_graph(tmp_path, readings, deepest):
    more = {"cop": [{"type": "cop", "of": "touch"}], "own": [{"type": "deepest", "of": "depth"}]}
    touch = tgdsl.compile(observation_document(tmp_path, {**TERMS, **more}), dtype=torch.float64)
    traced = torch.compile(touch.observe, backend="eager", fullgraph=True)(readings)
    torch.testing.assert_close(traced, touch.observe(readings), rtol=0, atol=0)


class DeepestObservation(PerLink):
    """Largest depth on each link [m], of a `contact_depth` sensor."""

    type: Literal["deepest"]
    """Largest depth on each link [m]."""
    needs = ("depth",)

    @property
    def features(self):
        return (("largest depth", "m", "", 1.0),)

    @staticmethod
    def observe(reading, channels, constants):
        return (reading[:, :, channels[0], None] * constants["operator"]).amax(dim=1)


@pytest.fixture
def deepest(monkeypatch):
    monkeypatch.setattr(observations.TYPES, "registered", ())
    register(DeepestObservation)


def test_documents_modules_and_artefacts_accept_a_registered_type(tmp_path, deepest, monkeypatch):
    touch = tgdsl.compile(observation_document(tmp_path, {"policy": [{"type": "deepest", "of": "depth"}]}), dtype=torch.float64)
    readings = touch(touch.example_state(3))
    depth = readings["depth"][:, :, 0]
    assert torch.equal(touch.observe(readings)["policy"], torch.stack([depth[:, :4].amax(1), depth[:, 4:].amax(1)], dim=1))
    tgdsl.save(touch, tmp_path / "touch.safetensors")
    loaded = tgdsl.load(tmp_path / "touch.safetensors", dtype="float64")
    assert torch.equal(loaded.observe(readings)["policy"], touch.observe(readings)["policy"])
    assert "DeepestObservation" in json_schema()["$defs"]
    monkeypatch.undo()
    with pytest.raises(TgdslError, match='the observation type "deepest" is not known; install its package'):
        tgdsl.load(tmp_path / "touch.safetensors")


def test_names_of_types_are_unique(deepest):
    class Other(OfReading):
        type: Literal["deepest"]

    with pytest.raises(TgdslError, match='two observation types are called "deepest": one of `register`, one of `register`'):
        register(Other)
    with pytest.raises(TgdslError, match='OfReading has no field `type: Literal\\["its_name"\\]`'):
        register(OfReading)
