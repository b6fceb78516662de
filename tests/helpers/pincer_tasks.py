"""The screwdriver's task with a hand of two jaws on slides and a rod of two variants: compiled and grasped in no time."""

from pathlib import Path

from tgdsl.rl.env import TouchEnv

GAIN = 200.0
"""Of the jaws' servos [N/m]."""
LENGTH = 0.04
"""From the rod's middle to its tip [m]."""
WIDTHS = (0.01, 0.014)
"""Half of each variant's width between the jaws [m]."""
ROBOT = f"""<mujoco model="pincer">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="palm">
      <geom name="palm" type="box" size="0.01 0.01 0.01" pos="0 0 -0.2"/>
      <body name="left" pos="-0.05 0 0.1">
        <joint name="left" type="slide" axis="1 0 0" range="0 0.05" damping="8" armature="0.02"/>
        <geom name="left" type="box" size="0.005 0.03 0.025" mass="0.02"/>
      </body>
      <body name="right" pos="0.05 0 0.1">
        <joint name="right" type="slide" axis="-1 0 0" range="0 0.05" damping="8" armature="0.02"/>
        <geom name="right" type="box" size="0.005 0.03 0.025" mass="0.02"/>
      </body>
      <body name="spare" pos="0 0.2 0.1">
        <joint name="spare" axis="0 1 0" range="-1 1" damping="0.01" armature="1e-4"/>
        <geom name="spare" type="box" size="0.005 0.005 0.005" mass="0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="left" joint="left" kp="{GAIN}" inheritrange="1" forcerange="-10 10"/>
    <position name="right" joint="right" kp="{GAIN}" inheritrange="1" forcerange="-10 10"/>
    <position name="spare" joint="spare" kp="1" kv="0.05" inheritrange="1" forcerange="-0.3 0.3"/>
  </actuator>
</mujoco>
"""
SCENE = """<mujoco model="scene">
  <compiler angle="radian" autolimits="true"/>
  <option integrator="implicitfast" cone="elliptic" impratio="10" gravity="{gravity}"/>
  <asset><model name="pincer" file="pincer.xml"/></asset>
  <worldbody>
    <attach model="pincer" body="palm" prefix=""/>
    <body name="rod" pos="0 0 0.1">
      {joint}
      <site name="tip" pos="0 0 -0.04"/>
      <geom name="rod" type="box" size="0.01 0.01 0.04" mass="0.05" friction="{friction} 0.005 0.0001" priority="1"/>
    </body>
  </worldbody>
  <keyframe>
    <key name="open" qpos="0.01 0.01 0.2  {rest}" ctrl="0.01 0.01 0.2"/>
    <key name="closed" ctrl="0.05 0.05 0.2"/>
  </keyframe>
</mujoco>
"""
FREE = ('<freejoint name="rod"/>', "0 0 0.1 1 0 0 0")
POINTS = (
    "{method: points, points: [{pos: [%g, 0, 0], normal: [%g, 0, 0], radius: 4 mm}, "
    "{pos: [%g, 0, 0.01], normal: [%g, 0, 0], radius: 4 mm}]}"
)
SENSORS = f"""tgdsl: 1
robot:
  model: pincer.xml
  layout:
    groups: {{hand: [left, right], tips: [right]}}
    resolutions:
      low:
        left: {POINTS % (0.005, 1, 0.005, 1)}
        right: {POINTS % (-0.005, -1, -0.005, -1)}
scene: {{model: scene.xml}}
objects:
  rod:
    body: rod
    variants:
      - {{type: box, size: [{WIDTHS[0]}, {WIDTHS[0]}, 0.04], density: 1000}}
      - {{type: box, size: [{WIDTHS[1]}, {WIDTHS[1]}, 0.04], density: 600}}
sensors:
  contact: {{kind: contact, links: hand, feels: [rod]}}
  depth: {{kind: contact_depth, links: hand, feels: [rod]}}
  touch: {{kind: kinematic_taxel, links: hand, feels: [rod]}}
  load: {{kind: force_taxel, links: hand, feels: [rod]}}
  felt: {{kind: link_contact, links: hand, feels: [rod], outputs: [force]}}
  gap: {{kind: surface_distance, links: hand, feels: [rod], max_range: 1 m}}
"""
TASK = """tgdsl: 1
task: screwdriver
document: sensors.yaml
object: rod
joints: [left, right]
keyframe: open
touch: none
{grasps}
"""
GRASPS = "grasps: {num: 6, squeeze: [0.005, 0.012], spread: 0.004, yaw: [0, 0.1], max_tilt: 0.2, push: 0.2 N}"


def write_pincer(
    folder: Path,
    more: str = "",
    grasps: str = GRASPS,
    gravity: str = "0 0 -9.81",
    friction: float = 1.0,
    joint: tuple[str, str] = FREE,
) -> Path:
    """Write robot, scene, sensors and task into a folder, and return the task's document."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pincer.xml").write_text(ROBOT)
    (folder / "scene.xml").write_text(SCENE.format(gravity=gravity, friction=friction, joint=joint[0], rest=joint[1]))
    (folder / "sensors.yaml").write_text(SENSORS)
    (folder / "task.yaml").write_text(TASK.format(grasps=grasps) + more)
    return folder / "task.yaml"


def pincer_env(folder: Path, num_envs: int = 4, *, overrides=None, seed=0, simulator=None, **written) -> TouchEnv:
    """Return environments of the task; `written` as for `write_pincer`."""
    document = write_pincer(folder, **written)
    return TouchEnv(document, num_envs, overrides=overrides, seed=seed, simulator=simulator, threads=1)
