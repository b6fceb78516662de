"""A task that is compiled in no time: two plates on hinges beside a ball, and its documents as files."""

from pathlib import Path

import mujoco
import torch

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.task import Start
from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate

RADIUS = 0.03
START = (0.0, 0.0, RADIUS)
RANDOM = """randomise:
  friction: [0.5, 1.5]
  mass: [0, 100 g]
  xy: [-5 mm, 5 mm]
  yaw: [-0.3, 0.3]
  drive: {gain: [0.9, 1.1], bias: [-0.01, 0.01], backlash: [0, 0.01], torque_noise: 0.1, delay: [0, 2]}
  push: {x: [-0.2 N, 0.2 N], interval: [0.05 s, 0.2 s]}
"""
NOISY = "noise: noisy\ntouch: depth\n"
ROBOT = """<mujoco model="tiny">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="palm">
      <geom name="palm" type="box" size="0.1 0.1 0.01" pos="0 0 -0.01" friction="0.2 0.005 0.0001"/>
      <body name="left" pos="-0.06 0 0.03">
        <joint name="left" axis="0 1 0" range="-0.8 0.8" damping="0.01" armature="1e-4"/>
        <geom name="left" type="box" size="0.005 0.03 0.025" mass="0.02"/>
      </body>
      <body name="right" pos="0.06 0 0.03">
        <joint name="right" axis="0 1 0" range="-0.8 0.8" damping="0.01" armature="1e-4"/>
        <geom name="right" type="box" size="0.005 0.03 0.025" mass="0.02"/>
      </body>
      <body name="spare" pos="0 0.2 0.03">
        <joint name="spare" axis="0 1 0" range="-1 1" damping="0.01" armature="1e-4"/>
        <geom name="spare" type="box" size="0.005 0.005 0.005" mass="0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="left" joint="left" kp="1" kv="0.05" ctrlrange="-0.8 0.8" forcerange="-0.3 0.3"/>
    <position name="right" joint="right" kp="1" kv="0.05" ctrlrange="-0.8 0.8" forcerange="-0.3 0.3"/>
    <position name="spare" joint="spare" kp="1" kv="0.05" ctrlrange="-1 1" forcerange="-0.3 0.3"/>
  </actuator>
</mujoco>
"""
SCENE = """<mujoco model="scene">
  <compiler angle="radian" autolimits="true"/>
  <option integrator="implicitfast" cone="elliptic" gravity="{gravity}"/>
  <asset><model name="tiny" file="tiny.xml"/></asset>
  <worldbody>
    <attach model="tiny" body="palm" prefix=""/>
    <body name="ball" pos="0 0 0.03">
      <freejoint name="ball"/>
      <geom name="ball" type="sphere" size="0.03" mass="0.1" friction="0.8 0.005 0.0001" priority="1"/>
    </body>
  </worldbody>
  <keyframe><key name="home" qpos="0.1 -0.1 0.2  0 0 0.03 1 0 0 0" ctrl="0.1 -0.1 0.2"/></keyframe>
</mujoco>
"""
POINTS = "{method: points, points: [{pos: [%g, 0, 0], normal: [%g, 0, 0], radius: 4 mm}, {pos: [%g, 0.01, 0.01], normal: [%g, 0, 0], radius: 4 mm}]}"
SENSORS = f"""tgdsl: 1
robot:
  model: tiny.xml
  layout:
    groups: {{hand: [left, right], tips: [right]}}
    resolutions:
      low:
        left: {POINTS % (0.005, 1, 0.005, 1)}
        right: {POINTS % (-0.005, -1, -0.005, -1)}
scene: {{model: scene.xml}}
objects: {{ball: {{body: ball}}}}
sensors:
  contact: {{kind: contact, links: hand, feels: [ball]}}
  depth: {{kind: contact_depth, links: hand, feels: [ball]}}
  touch: {{kind: kinematic_taxel, links: hand, feels: [ball]}}
  load: {{kind: force_taxel, links: hand, feels: [ball]}}
  near: {{kind: proximity, links: hand, feels: [ball], backend: points, points: 200}}
  skin: {{kind: elastomer, links: hand, feels: [ball], anchors: points, points: 40}}
  felt: {{kind: link_contact, links: hand, feels: [ball], outputs: [force]}}
  gap: {{kind: surface_distance, links: hand, feels: [ball], max_range: 1 m}}
"""
TASK = """tgdsl: 1
task: {task}
document: sensors.yaml
object: ball
joints: [left, right]
keyframe: home
"""


def write_task(folder: Path, task: str = "in_palm_rotate", gravity: str = "0 0 -9.81", more: str = "") -> Path:
    """Write robot, scene, sensors and task into a folder, and return the task's document."""
    (folder / "tiny.xml").write_text(ROBOT)
    (folder / "scene.xml").write_text(SCENE.format(gravity=gravity))
    (folder / "sensors.yaml").write_text(SENSORS)
    (folder / "task.yaml").write_text(TASK.format(task=task) + ("" if "episode:" in more else "episode: 1 s\n") + more)
    return folder / "task.yaml"


def tiny_env(
    folder: Path, num_envs: int = 4, task: str = "in_palm_rotate", gravity: str = "0 0 -9.81", more: str = "", **options
):
    """Return environments of the tiny task."""
    options = {"threads": 1, **options}
    return TouchEnv(write_task(folder, task, gravity, more), num_envs, **options)


def tiny_envs(folder: Path):
    """Yield a function that makes environments of the tiny task, each in a folder of its own; then close them."""
    made = []

    def make(*args, **options):
        own = folder / str(len(made))
        own.mkdir()
        made.append(tiny_env(own, *args, **options))
        return made[-1]

    yield make
    for env in made:
        env.close()


def actions(env, num, seed=0):
    """Return random actions of some control steps."""
    generator = torch.Generator().manual_seed(seed)
    return [2 * torch.rand((env.num_envs, env.num_actions), generator=generator) - 1 for _ in range(num)]


def same(one, other, rows=slice(None)):
    """Whether two groups of observations are the same to the last bit."""
    return one.keys() == other.keys() and all(torch.equal(one[name][rows], other[name][rows]) for name in one)


class Coasting(InPalmRotate):
    """The ball flies off at a speed of its own in each environment, without gravity: where it is follows from the time."""

    def speed(self):
        """Return the speed of each environment's ball along y [m/s]."""
        return 0.01 * torch.arange(1.0, self.setup.num_envs + 1, dtype=self.setup.dtype, device=self.setup.device)

    def reset(self, chosen, episode):
        """Start it above the palm, 10 cm further in each episode."""
        start = super().reset(chosen, episode)
        qpos = torch.as_tensor(start.values["qpos"]).clone()
        qpos[:, 5] += 0.2 + 0.1 * episode
        qvel = torch.zeros((self.setup.num_envs, self.setup.model.nv), dtype=self.setup.dtype, device=self.setup.device)
        qvel[:, 4] = self.speed()
        self.begin(chosen, start_pos=qpos[:, 3:6])
        return Start({"qpos": qpos, "qvel": qvel})


def taxel_world(env: TouchEnv, body: str, pos: tuple[float, float, float], qpos) -> torch.Tensor:
    """Return where a point of a body is in the world at some joint positions [m], as MuJoCo computes it."""
    state = mujoco.MjData(env.sim.model)
    state.qpos[:] = qpos
    mujoco.mj_kinematics(env.sim.model, state)
    own = env.sim.model.body(body).id
    return torch.from_numpy(state.xpos[own] + state.xmat[own].reshape(3, 3) @ pos)
