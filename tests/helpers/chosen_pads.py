"""A pad and a faceted stone that is pressed onto it, in documents whose sensors have an `accuracy`."""

from pathlib import Path

import numpy as np

SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <asset><mesh name="stone" vertex="{vertices}"/></asset>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="stone" pos="0 0 .0305">
      <joint name="lift" type="slide" axis="0 0 1"/><joint name="turn" type="hinge" axis="1 0 0" damping=".01"/>
      <geom type="mesh" mesh="stone" mass=".25"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="lift" ctrlrange="-10 10" ctrllimited="true"/><motor joint="turn" ctrlrange="-.1 .1" ctrllimited="true"/>
  </actuator>
  <keyframe><key name="rest" ctrl="0 0"/><key name="squeeze" ctrl="-5 .05"/></keyframe>
</mujoco>
"""
DOCUMENT = """tgdsl: 1
robot:
  model: scene.xml
  layout: {{resolutions: {{low: {{pad: {{method: grid, rows: 6, columns: 6, direction: [0, 0, -1], radius: 4 mm}}}}}}}}
objects:
  stone: {{body: stone{object}}}
sensors:
{sensors}"""


def stone_vertices() -> np.ndarray:
    """Return 60 points on an ellipsoid (60, 3) [m], whose hull has facets of some 6 mm."""
    points = np.random.default_rng(5).normal(size=(60, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [0.03, 0.025, 0.02]


def chosen_document(folder: Path, *sensors: str, object: str = "") -> Path:
    """Write scene and document.

    Args:
        folder: Where.
        sensors: Name and mapping of each sensor, `depth: {kind: contact_depth, accuracy: 1 %}`; links and objects are added.
        object: What stands in addition in the object, beginning with a comma.
    """
    vertices = " ".join(f"{value:.6f}" for value in stone_vertices().ravel())
    (folder / "scene.xml").write_text(SCENE.format(vertices=vertices))
    lines = [f"  {sensor.rstrip()[:-1]}, links: pad, feels: [stone]}}\n" for sensor in sensors]
    path = folder / "pad.yaml"
    path.write_text(DOCUMENT.format(object=object, sensors="".join(lines)))
    return path
