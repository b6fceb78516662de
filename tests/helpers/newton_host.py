"""A hand and a cube in Newton, stepped as its own examples do, for tests of adapters."""

from collections.abc import Callable
from typing import Any

import mujoco
import newton
import numpy as np
import torch

import tgdsl
from tgdsl.adapters.newton import SensorTactile

PAD = '<geom type="box" size=".03 .02 .015" pos="0 0 .02" mass=".1"/>'
PALM = '<geom type="box" size=".05 .05 .01" friction="1"/>'
CUBE = '<geom type="box" size=".02 .02 .02" pos="0 0 .001" mass=".25" friction="1"/>'
SCENE = f"""
<mujoco model="hand"><option timestep=".002"/><worldbody>
  <body name="palm" euler="4 0 0">{PALM}
    <body name="pad" pos="0 0 .08"><joint name="bend" axis="0 1 0" damping=".01"/>{PAD}</body>
  </body>
  <body name="cube" pos="0 -.002 .0289" euler="4 0 0"><freejoint/>{CUBE}</body>
</worldbody></mujoco>
"""
FREE = f"""
<mujoco><option timestep=".002"/><worldbody>
  <body name="palm"><freejoint/>{PALM}</body><body name="pad"><freejoint/>{PAD}</body><body name="cube"><freejoint/>{CUBE}</body>
</worldbody></mujoco>
"""
"""The same bodies without joints: MuJoCo is put where Newton's bodies are, whatever its solver."""
SOLVERS: dict[str, Callable[[Any], Any]] = {
    "mujoco": lambda model: newton.solvers.SolverMuJoCo(model),
    "mujoco with Newton's contacts": lambda model: newton.solvers.SolverMuJoCo(model, use_mujoco_contacts=False),
    "mujoco on the CPU": lambda model: newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True),
    "xpbd": lambda model: newton.solvers.SolverXPBD(model, iterations=10),
}
WORLDS = 2


def document(folder, **sensors) -> dict:
    (folder / "scene.xml").write_text(SCENE)
    probes = [{"pos": [x, y, 0.01], "normal": [0, 0, 1]} for x in (-0.01, 0.01) for y in (-0.01, 0.01)]
    points = {"method": "points", "points": probes, "radius": 0.005}
    skin = {"kind": "kinematic_taxel", "links": ["palm", "pad"], "feels": ["cube"], "normal_stiffness": 500}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"only": {"palm": points, "pad": points}}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"skin": skin, **sensors},
        "observations": {"policy": [{"type": "force", "of": "skin"}]},
    }


LOAD = {"kind": "link_contact", "links": ["palm"], "feels": ["cube"], "outputs": ["force"]}
DEPTH = {"kind": "contact_depth", "links": ["palm"], "feels": ["cube"]}


class Host:
    """Newton as its own examples step it: some worlds of a scene, with a plane that all share."""

    def __init__(self, solver: str = "mujoco", worlds: int = WORLDS):
        robot, builder = newton.ModelBuilder(), newton.ModelBuilder()
        for each in (robot, builder):
            newton.solvers.SolverMuJoCo.register_custom_attributes(each)
        robot.add_mjcf(SCENE)
        builder.add_ground_plane(height=-1.0)
        if solver == "mujoco on the CPU":
            worlds = 1
        builder.replicate(robot, worlds)
        self.model = builder.finalize(device="cpu")
        self.solver = SOLVERS[solver](self.model)
        own = self.solver.get_max_contact_count() if "mujoco" in solver else 0
        self.pipeline = newton.CollisionPipeline(self.model, rigid_contact_max=max(own, 200), soft_contact_max=0)
        self.contacts = self.pipeline.contacts()
        self.observables = self.solver.observables(kinds={"contact_f"}, contacts=self.contacts)
        self.collides = solver not in ("mujoco", "mujoco on the CPU")
        self.state, self.next, self.control = self.model.state(), self.model.state(), self.model.control()
        newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.state)

    def push(self) -> None:
        """Move joints and cubes, differently in each world."""
        speed = self.state.joint_qd.numpy()
        speed += np.random.default_rng(0).normal(size=speed.shape, scale=0.05)
        speed.reshape(self.model.world_count, -1)[:, 0] = 3.0
        self.state.joint_qd.assign(speed)
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def step(self, num: int = 1) -> None:
        for _ in range(num):
            if self.collides:
                self.pipeline.collide(self.state, self.contacts)
            self.state.clear_forces()
            self.solver.step(self.state, self.next, self.control, self.contacts, 0.002, observables=self.observables)
            self.state, self.next = self.next, self.state

    def read(self, sensor: SensorTactile, **kwargs) -> dict[str, torch.Tensor]:
        return sensor.update(self.state, self.contacts, observables=self.observables, **kwargs)

    def plain(self, touch) -> tgdsl.SceneState:
        """Return the state that plain MuJoCo finds where the bodies are."""
        model, datas = mujoco.MjModel.from_xml_string(FREE), []
        names = [label.rpartition("/")[2] for label in self.model.body_label]
        for world in range(self.model.world_count):
            data = mujoco.MjData(model)
            for i in np.flatnonzero(self.model.body_world.numpy() == world):
                pose, twist = (values.numpy()[i].astype(np.float64) for values in (self.state.body_q, self.state.body_qd))
                body = model.body(names[i])
                quat, inverse, turned, spin = pose[[6, 3, 4, 5]], np.zeros(4), np.zeros(3), np.zeros(3)
                mujoco.mju_negQuat(inverse, quat)
                mujoco.mju_rotVecQuat(turned, self.model.body_com.numpy()[i].astype(np.float64), quat)
                mujoco.mju_rotVecQuat(spin, twist[3:], inverse)
                joint = model.joint(int(body.jntadr[0]))
                data.qpos[joint.qposadr[0] :][:7] = [*pose[:3], *quat]
                data.qvel[joint.dofadr[0] :][:6] = [*(twist[:3] - np.cross(twist[3:], turned)), *spin]
            mujoco.mj_forward(model, data)
            datas.append(data)
        return tgdsl.read_mujoco(touch, model, datas)
