"""Points of objects by pairs: which links have state, the gate of each pair, and refused documents."""

import pytest
import torch
from oracles.setups.scenes import state

import tgdsl
from tgdsl.compiler.pipeline import compile_document
from tgdsl.errors import SpecError
from tgdsl.module.module import TactileModule
from tgdsl.schema.load import load
from tgdsl.sensors.elastomer import ElastomerSpec
from tgdsl.sensors.elastomer.point_anchors import PLANES

PAIRS = """
<mujoco><worldbody>
  <body name="a" pos="0 0 .1"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="b"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="item"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  <body name="floor"><geom type="plane" size="1 1 .1"/></body>
</worldbody><contact><exclude body1="b" body2="item"/></contact></mujoco>
"""


def document_of_two_links(folder, **sensor):
    (folder / "scene.xml").write_text(PAIRS)
    taxel = {"method": "points", "radius": 0.004, "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1]}]}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": {"a": taxel, "b": taxel}}}},
        "objects": {"item": {"body": "item"}, "floor": {"body": "floor"}},
        "sensors": {"s": {"kind": "elastomer", "links": "*", "feels": ["item"], "anchors": "points", "points": 50, **sensor}},
    }


def test_only_pairs_that_can_meet_have_state(tmp_path):
    """Link b and the item never collide: with the gate they have no points. `explain` states their memory."""
    touch = tgdsl.compile(document_of_two_links(tmp_path))
    assert {name: memory.shape for name, memory in touch.plan.sensors[0].state.items()} == dict.fromkeys(PLANES, (50,))
    text = touch.explain()
    assert "remembers anchor_x, anchor_y, anchor_z, held (800 bytes per environment)" in text
    assert "50 points of item against a" in text
    both = compile_document(document_of_two_links(tmp_path, gate="geometric")).plan
    assert both.sensors[0].state["held"].shape == (100,)
    unsheared = document_of_two_links(tmp_path, gate="geometric", shear_strength=0)
    del unsheared["sensors"]["s"]["anchors"], unsheared["sensors"]["s"]["points"]
    still = compile_document(unsheared).plan
    assert not still.sensors[0].state and "points" not in still.quantities


def test_the_gate_is_the_pairs(tmp_path):
    """Points sink in only while the simulator has the pair in contact, and let go otherwise."""
    touch = tgdsl.compile(document_of_two_links(tmp_path, dilation_strength=0), dtype=torch.float64)
    assert [(pair.link, pair.object) for pair in touch.inputs.pairs] == [("a", "item")]
    inputs = state(touch, pos=[0, 0, 0.0295])
    for is_in_contact, shift, reads in ((0, 0.0, False), (1, 1e-4, False), (1, 3e-4, True), (0, 4e-4, False), (1, 5e-4, False)):
        inputs = state(touch, pos=[shift, 0, 0.0295])
        inputs.contact_found = torch.full((1, 1), float(is_in_contact))
        readings = touch(inputs)["s"][0]
        assert bool(readings[0].any()) == reads and not readings[1].any()
        assert bool(touch.memory.get_buffer("s:held").any()) == bool(is_in_contact)


REFUSED = [
    ({"feels": ["item", "floor"]}, {}, 'sensors.s.feels[1]: body "floor" has a plane', "anchors: taxels"),
    ({}, {"size": "per_env"}, 'sensors.s.feels[0]: the size of body "item" is given per environment', "anchors: taxels"),
    (
        {"kernel": "half_space", "youngs_modulus": 1e5, "normal_stiffness": 1e8, "points": None},
        {},
        "`anchors: points`",
        "taxels",
    ),
    ({"anchors": "taxels"}, {}, "`points` is not used by `anchors: taxels`", ""),
    ({"shear_strength": 0, "points": None}, {}, "`anchors` is not used without shear", ""),
    ({"shear_strength": 0, "anchors": None}, {}, "`points` is not used without shear", ""),
    ({"points": 0}, {}, "sensors.s.points: found 0: input should be greater than or equal to 1", ""),
]


@pytest.mark.parametrize(("fields", "target", "message", "hint"), REFUSED)
def test_mistakes_name_their_place(tmp_path, fields, target, message, hint):
    document = document_of_two_links(tmp_path)
    document["objects"]["item"] |= target
    sensor = {**document["sensors"]["s"], **fields}
    document["sensors"]["s"] = {name: value for name, value in sensor.items() if value is not None}
    with pytest.raises(SpecError) as caught:
        compile_document(document)
    assert message in str(caught.value) and hint in str(caught.value)


@pytest.mark.parametrize("readout", ["measured", "clean", "both"])
def test_a_mistake_is_named_once_whatever_the_readout(tmp_path, readout):
    """A sensor with both readouts and radius noise is computed twice, but has one place in the document."""
    document = document_of_two_links(tmp_path, readout=readout, noise={"radius_noise": 0.1}, feels=["item", "floor"])
    with pytest.raises(SpecError) as caught:
        compile_document(document)
    assert [problem.path for problem in caught.value.problems] == ["sensors.s.feels[1]"]


def test_the_papers_model_anchors_points(tmp_path):
    document = document_of_two_links(tmp_path, model="paper")
    del document["sensors"]["s"]["anchors"]
    spec = load(document).spec.sensors["s"]
    assert isinstance(spec, ElastomerSpec) and spec.anchored == "points"
    assert TactileModule(compile_document(document).plan).plan.sensors[0].state["held"].shape == (50,)
