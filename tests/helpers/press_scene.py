"""A ball that an actuator presses on a pad of 4 × 4 taxels."""

SCENE = """
<mujoco model="press"><option timestep="0.002"/><worldbody>
<body name="pad" pos="0 0 0.05"><geom name="pad" type="box" size=".03 .03 .005" density="800"/></body>
<body name="ball" pos=".01 0 .0749"><joint name="lift" type="slide" axis="0 0 1" damping="2"/>
<geom name="ball" type="sphere" size=".02" mass="0.2"/></body>
</worldbody><actuator><position name="lift" joint="lift" kp="400" ctrlrange="-0.02 0.02"/></actuator>
<keyframe><key name="up" qpos="0.01" ctrl="0.01"/></keyframe></mujoco>
"""
DOCUMENT = """
tgdsl: 1
robot:
  model: press.xml
  layout:
    resolutions: {low: {pad: {method: grid, rows: 4, columns: 4, direction: [0, 0, -1], radius: 6 mm}}}
    groups: {all: [pad]}
resolution: low
objects: {ball: {body: ball}}
sensors:
  touch: {kind: kinematic_taxel, links: all, feels: [ball]}
  near: {kind: proximity, links: all, feels: [ball]}
"""
WITHOUT_PROXIMITY = DOCUMENT.split("  near:")[0]
"""For objects with variants, whose quadrature takes seconds to compile."""
