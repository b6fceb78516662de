"""`tgdsl layout freeze`: the written layout gives the sampled taxels to the last bit."""

from pathlib import Path

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.compiler.pipeline import all_layouts, compile_document, placed
from tgdsl.files.write import atomic_write_all
from tgdsl.layout.layout import Layout
from tgdsl.placement.freeze import frozen_files
from tgdsl.schema.load import load_layout

REPOSITORY = Path(__file__).parents[2]
EXAMPLES = [REPOSITORY / "examples" / f"{name}.yaml" for name in ("pyramid", "xhand1_palm")]
"""Examples with the two layouts."""
ARRAYS = ("link_id", "pos", "normal", "tangent", "radius", "area", "cell")
HAND = """
<mujoco>
  <worldbody>
    <body name="pad"><geom name="a" type="box" size=".03 .03 .01"/><geom name="b" type="sphere" size=".01" pos="0 0 .03"/></body>
    <body name="ball [1], 'it'"><freejoint/><geom type="sphere" size=".02" contype="0" conaffinity="0"/></body>
    <body name="cube" pos="0 0 .06"><freejoint/><geom type="box" size=".01 .01 .01"/></body>
  </worldbody>
</mujoco>
"""
LAYOUT = """tgdsl: 1
groups:
  "all, of it": [pad, "ball*"]
  some: {include: ["all, of it"], exclude: [pad]}
resolutions:
  low/1:
    pad: {method: grid, rows: 3, columns: 4, count: 9, direction: [1, 2, -3], radius: 3 mm, rows_reversed: true}
    "ball*": {method: poisson, count: 17, radius: 2 mm, seed: 4}
  low.1:
    "[ab]": {method: poisson, spacing: 9 mm, radius: 0}
    "ball*": {method: points, points: [{pos: [0, 0, 0.02], normal: [1, 1, 7], tangent: [1, 0, 1]}], radius: 1 mm}
"""


def assert_same_bits(one: Layout, other: Layout) -> None:
    assert other.links == one.links
    assert other.groups == one.groups
    for name in ARRAYS:
        assert getattr(other, name).tobytes() == getattr(one, name).tobytes(), name
        assert getattr(other, name).dtype == getattr(one, name).dtype


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_taxels_of_examples_keep_their_bits(example, tmp_path):
    spec, sampled = all_layouts(example, {})
    atomic_write_all(frozen_files(spec, sampled, tmp_path / "frozen.yaml", example.name))
    assert set(sampled) == set(spec.resolutions)
    _, frozen = all_layouts(example, {"robot.layout": str(tmp_path / "frozen.yaml")})
    for name, layout in sampled.items():
        assert_same_bits(layout, frozen[name])


def test_odd_names_grids_samples_and_points_keep_their_bits(tmp_path, here):
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "layout.yaml").write_text(LAYOUT)
    code, output, error = here(tmp_path, "layout", "freeze", "hand.xml", "-o", "new/my frozen.yaml")
    assert code == 0, error
    files = ["my frozen.low_1.csv", "my frozen.low_1_2.csv", "my frozen.yaml"]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == files
    assert output.splitlines()[:2] == ["low/1: 26 taxels", output.splitlines()[1]]
    documents = [{"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": str(tmp_path / layout_name)}}
                 for layout_name in ("layout.yaml", "new/my frozen.yaml")]  # fmt: skip
    first, second = (placed(document).layouts for document in documents)
    assert list(first) == list(second) == ["low/1", "low.1"]
    for name in first:
        assert_same_bits(first[name], second[name])
    assert load_layout(tmp_path / "new" / "my frozen.yaml").spec.groups == load_layout(tmp_path / "layout.yaml").spec.groups
    assert (first["low/1"].cell >= 0).sum() == 18
    np.testing.assert_allclose(first["low.1"].tangent[-1], np.array([42, -9, 42 - 5 * 6.6]) / 50, atol=1)  # across (1, 1, 7)


@pytest.mark.filterwarnings("ignore::tgdsl.errors.UnfeltWarning")
def test_a_module_reads_the_same_to_the_last_bit(tmp_path, here):
    """Every array of the plan and readings of random states, for samples and a grid."""
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "layout.yaml").write_text(LAYOUT)
    assert here(tmp_path, "layout", "freeze", "hand.xml", "--resolutions", "low/1")[0] == 0
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "hand.xml"), "layout": str(tmp_path / "layout.yaml")},
        "objects": {"cube": {"body": "cube"}},
        "resolution": "low/1",
        "sensors": {"touch": {"kind": "kinematic_taxel", "links": "all, of it", "feels": ["cube"]}},
    }
    modules = [tgdsl.compile(document, overrides={"robot.layout": str(tmp_path / layout_name)})
               for layout_name in ("layout.yaml", "layout_frozen.yaml")]  # fmt: skip
    one, other = (module.plan.arrays for module in modules)
    assert one.keys() == other.keys()
    assert all(one[name].tobytes() == other[name].tobytes() for name in one)
    state = modules[0].example_state(64, spread=0.01)
    readings = [module(state)["touch"] for module in modules]
    assert readings[0].any()
    assert torch.equal(*readings)
    with pytest.raises(tgdsl.SpecError, match="unknown resolution"):
        compile_document(document, {"robot.layout": str(tmp_path / "layout_frozen.yaml"), "resolution": "low.1"})


def test_nothing_is_replaced_unless_forced(tmp_path, here):
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "layout.yaml").write_text(LAYOUT)
    (tmp_path / "layout_frozen.low_1.csv").write_text("mine")
    code, _, error = here(tmp_path, "layout", "freeze", "hand.xml")
    assert code == 2
    assert "layout_frozen.low_1.csv: this file is there already; give --force to replace it" in error
    assert not (tmp_path / "layout_frozen.yaml").exists()
    assert (tmp_path / "layout_frozen.low_1.csv").read_text() == "mine"
    assert here(tmp_path, "layout", "freeze", "hand.xml", "--force")[0] == 0
    code, _, error = here(tmp_path, "layout", "freeze", "hand.xml")
    assert "layout_frozen.yaml: this file is there already" in error


def test_wrong_arguments_are_refused(tmp_path, here):
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "layout.yaml").write_text(LAYOUT)
    code, _, error = here(tmp_path, "layout", "freeze", "hand.xml", "--resolutions", "low")
    assert (code, error) == (2, 'tgdsl: the layout has no resolution "low"; did you mean "low/1"?\n')
    code, _, error = here(tmp_path, "layout", "freeze")
    assert code == 2
    assert "tgdsl layout freeze" in error
    code, _, error = here(tmp_path, "layout", "new")
    assert "tgdsl layout new" in error
    (tmp_path / "layout.yaml").write_text(LAYOUT.replace("pad:", "pat:"))
    code, _, error = here(tmp_path, "layout", "freeze", "hand.xml")
    assert 'layout.yaml:7:5: resolutions.low/1.pat: no body, geom or mesh matches "pat"; did you mean "pad"?' in error


def test_a_document_without_a_layout_is_refused(tmp_path, here):
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "doc.yaml").write_text("""
tgdsl: 1
robot: {model: hand.xml}
objects: {cube: {body: cube}}
sensors: {solver: {kind: link_contact, links: "*", feels: [cube]}}
""")
    code, _, error = here(tmp_path, "layout", "freeze", "doc.yaml")
    assert code == 2
    assert 'doc.yaml:3:1: robot: missing key "layout"; only a layout has taxels to write down' in error
