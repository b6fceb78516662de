"""Documents and artefacts for adapters, without a simulator."""

import mujoco
import pytest
import scene_of_adapters

import tgdsl
from tgdsl.adapters import module_of
from tgdsl.errors import SimulationError

SCENE = """
<mujoco><worldbody>
  <body name="palm"><geom type="box" size=".05 .05 .01"/><body name="pad" pos="0 0 .08"><joint/><geom type="box" size=".03 .02 .015"/></body></body>
  <body name="cube" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>
"""


def test_an_artefact_takes_no_scene(tmp_path):
    path = tmp_path / "touch.safetensors"
    tgdsl.save(tgdsl.compile(scene_of_adapters.document(tmp_path, SCENE)), path)
    assert module_of(path, "mjlab").outputs
    with pytest.raises(SimulationError, match=r"touch\.safetensors: an artefact .*`scene_fn`"):
        module_of(path, "mjlab", mujoco.MjSpec.from_string(SCENE))
