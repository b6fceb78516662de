"""Compare the readings of a hand that closes on a ball with MuJoCo's functions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.layout.layout import Layout
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation

_STATE = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "mocap_pos", "mocap_quat", "eq_active")
"""The state that MuJoCo evaluates."""


@dataclass
class Checked:
    """The largest errors over some states, and the contacts of the state with the largest forces.

    Attributes:
        depth: Error of a taxel's depth [m].
        force: Error of a body's force [N].
        links: Bodies in contact with the ball.
        taxels: Taxels with depth.
        newtons: Sum of the magnitudes of the bodies' forces [N].
    """

    depth: float = 0.0
    force: float = 0.0
    links: int = 0
    taxels: int = 0
    newtons: float = 0.0


class Oracle:
    """Depths and forces of a hand's contacts with a ball, by MuJoCo."""

    def __init__(self, model: mujoco.MjModel, layout: Layout, ball: str):
        """Build a model of two spheres: a taxel and the ball.

        Args:
            model: The scene.
            layout: The taxels.
            ball: Name of the ball's body, which has one geom.
        """
        self.model, self.data, self.layout = model, mujoco.MjData(model), layout
        self.ball = int(model.body_geomadr[model.body(ball).id])
        self.body = np.array([model.body(link.body).id for link in layout.links])[layout.link_id]
        self.bodies = [int(model.body(name).id) for name in layout.bodies]
        spec = mujoco.MjSpec()
        for name, radius in (("taxel", 1.0), ("ball", float(model.geom_size[self.ball, 0]))):
            sphere = spec.worldbody.add_body(name=name, mocap=True)
            sphere.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0])
        self._pair = spec.compile()
        self._pair_data = mujoco.MjData(self._pair)

    def evaluate(self, sim: BatchSimulation) -> None:
        """Copy the state of a simulation's only environment, and evaluate it."""
        for name in _STATE:
            getattr(self.data, name)[...] = np.asarray(getattr(sim.batch, name))[0].reshape(getattr(self.data, name).shape)
        mujoco.mj_forward(self.model, self.data)

    def forces(self) -> dict[int, Float[np.ndarray, " 3"]]:
        """Return the force on each body that the ball touches, in the body's frame [N]."""
        result: dict[int, np.ndarray] = {}
        for i, contact in enumerate(self.data.contact):
            if self.ball not in contact.geom or contact.efc_address < 0:
                continue
            wrench = np.zeros(6)
            mujoco.mj_contactForce(self.model, self.data, i, wrench)
            on_second = contact.frame.reshape(3, 3).T @ wrench[:3]  # on geom 2, by geom 1
            is_second = int(contact.geom[0]) == self.ball
            body = int(self.model.geom_bodyid[contact.geom[1 if is_second else 0]])
            force = self.data.xmat[body].reshape(3, 3).T @ (on_second if is_second else -on_second)
            result[body] = result.get(body, np.zeros(3)) + force
        return result

    def depths(self, touched: Mapping[int, object]) -> Float[np.ndarray, " taxel"]:
        """Return the penetration of each taxel's sphere and the ball, on bodies in contact with it [m]."""
        result = np.zeros(self.layout.num_taxels)
        self._pair_data.mocap_pos[1] = self.data.geom_xpos[self.ball]
        for i in np.flatnonzero(np.isin(self.body, list(touched))):
            body = self.body[i]
            pos = self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ self.layout.pos[i]
            self._pair_data.mocap_pos[0] = pos
            self._pair.geom_size[0, 0] = self._pair.geom_rbound[0] = self.layout.radius[i]
            mujoco.mj_kinematics(self._pair, self._pair_data)
            result[i] = max(0.0, -mujoco.mj_geomDistance(self._pair, self._pair_data, 0, 1, 10.0, None))
        return result


def check(touch: TactileModule, sim: BatchSimulation, control: Float[np.ndarray, "step actuator"], instants: int) -> Checked:
    """Step a scene through controls, and compare readings with MuJoCo's values in some states.

    Args:
        touch: A float64 module with the sensors `depth`, `force` and `solver` on the same links, and the object `ball`.
        sim: Its simulation, with one environment.
        control: Control of the actuators at each step.
        instants: Number of states, of which the last follows the last control.
    """
    layout = touch.plan.layout_of(next(sensor for sensor in touch.plan.sensors if sensor.name == "depth"))
    oracle, result = Oracle(sim.model, layout, "ball"), Checked()
    compared = set(np.linspace(0, len(control) - 1, instants).round().astype(int).tolist())
    for i, row in enumerate(control):
        sim.step(row)
        if i in compared:
            oracle.evaluate(sim)
            sim.forward()
            _compare(oracle, touch(sim.state()), result)
    return result


def _compare(oracle: Oracle, readings: Mapping[str, Tensor], result: Checked) -> None:
    values = {name: value[0].double().numpy() for name, value in readings.items()}
    forces = oracle.forces()
    depth = oracle.depths(forces)
    result.depth = max(result.depth, float(np.abs(values["depth"][:, 0] - depth).max()))
    newtons = 0.0
    for row, body in enumerate(oracle.bodies):
        expected = forces.get(body, np.zeros(3))
        shared = values["force"][oracle.body == body].sum(axis=0) + values["force/missed"][row]
        errors = np.abs(np.stack([shared, values["solver"][row, 1:]]) - expected)
        result.force, newtons = max(result.force, float(errors.max())), newtons + float(np.linalg.norm(expected))
    if newtons >= result.newtons:
        result.links, result.taxels, result.newtons = len(forces.keys() & set(oracle.bodies)), int((depth > 0).sum()), newtons
