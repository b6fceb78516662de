"""The memory layout of poses of gathered points is the same for every gate."""

import pytest
import torch

import tgdsl
from tgdsl.module.sensing import scene_of
from tgdsl.quantities.points import POINTS

SCENE = """<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".03 .03 .01"/></body>
  <body name="tip" pos=".2 0 0"><freejoint/><geom type="sphere" size=".01"/></body>
  <body name="item" pos="0 0 .05"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("gate", ["contact_pair", "geometric"])
def test_planes_of_a_rotation_and_of_an_offset_have_the_same_strides(tmp_path, gate):
    """A kernel steps through all nine and all three planes by the strides of the first."""
    (tmp_path / "scene.xml").write_text(SCENE)
    points = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"pad": points, "tip": points}}}},
        "objects": {"item": {"body": "item"}},
        "sensors": {
            "s": {"kind": "elastomer", "links": "*", "feels": ["item"], "anchors": "points", "points": 20, "gate": gate}
        },
    }
    touch = tgdsl.compile(document)
    state = touch.example_state(5)
    tensors = {name: getattr(state, name) for name in touch.inputs.fields if name != "dt"}
    scene = scene_of(touch.plan, touch.constants.tree, tensors, {}, {}, torch.float32)
    ((points_of_object,),) = [item.values() for item in POINTS.gather(touch.constants.tree["quantities"]["points"], scene)]
    strides = [{part.stride() for part in parts} for parts in (points_of_object.pairs.rotation, points_of_object.pairs.offset)]
    assert [len(item) for item in strides] == [1, 1] and (points_of_object.pairs.gate is not None) == (gate == "contact_pair")
