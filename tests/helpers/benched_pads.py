"""A small scene that is quick to bench: a pad with taxels, and a cube, or a mesh, that is pressed onto it."""

from pathlib import Path

SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos="0 0 .0299">
      <joint name="lift" type="slide" axis="0 0 1"/><joint name="turn" type="hinge" axis="1 0 0" damping=".01"/>
      <geom type="ellipsoid" size=".03 .025 .02" mass=".25"/>
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
  layout: {{resolutions: {{low: {{pad: {{method: grid, rows: 4, columns: 4, direction: [0, 0, -1], radius: 4 mm}}}}}}}}
objects: {{cube: {{body: cube{object}}}}}
sensors:
  depth: {{kind: contact_depth, links: pad, feels: [cube]{sensor}}}
  skin: {{kind: elastomer, links: pad, feels: [cube], noise: noisy, history: 3, shear_strength: 0}}
observations:
  policy: [{{type: depth, of: depth}}]
"""


def bench_document(folder: Path, sensor: str = "", object: str = "") -> Path:
    """Write scene and document; what stands in addition in the sensor `depth` and the object begins with a comma."""
    (folder / "scene.xml").write_text(SCENE)
    path = folder / "pad.yaml"
    path.write_text(DOCUMENT.format(sensor=sensor, object=object))
    return path
