"""A hand and a cube in Newton, stepped as its own examples do, for tests of adapters."""

from collections.abc import Callable
from typing import Any

import mujoco
import newton
import numpy as np
import torch
from scene_of_adapters import FREE, SCENE

import tgdsl
from tgdsl.adapters.newton import SensorTactile

SOLVERS: dict[str, Callable[[Any], Any]] = {
    "mujoco": lambda model: newton.solvers.SolverMuJoCo(model),
    "mujoco with Newton's contacts": lambda model: newton.solvers.SolverMuJoCo(model, use_mujoco_contacts=False),
    "mujoco on the CPU": lambda model: newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True),
    "xpbd": lambda model: newton.solvers.SolverXPBD(model, iterations=10),
}
WORLDS = 2


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
