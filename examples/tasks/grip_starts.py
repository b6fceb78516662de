"""Finds how the hand of grip.xml holds each object of grip.yaml, and writes that there as keyframes `hold-0`, `hold-1` and on.

    python examples/tasks/grip_starts.py

Thumb against index and middle finger: inverse kinematics put the pads on either side of the object, on a horizontal line; with
the object in oil and without gravity, torques Jᵀ f close the fingers on it, f such that the thumb presses with half of `FORCE`
and each finger with a quarter; their size is adjusted until the contacts' normal forces sum to `FORCE`; then gravity acts on
`MASS`. A keyframe holds where hand and object are after that, and the targets of the drives.
"""

from __future__ import annotations

import copy
import re
from pathlib import Path

import mujoco
import numpy as np
from scipy.optimize import minimize

import tgdsl
from tgdsl.scene.scene import Choice, SceneModels

FOLDER = Path(__file__).parent
OBJECT = "item"
FORCE, MASS = 5.0, 0.1
PADS = {
    "right_hand_thumb_rota_link2": ((0.0, 0.033, 0.0115), (0.0, 0.0, 1.0), 0.5),
    "right_hand_index_rota_link2": ((0.0105, 0.0, 0.028), (1.0, 0.0, 0.0), -0.25),
    "right_hand_mid_link2": ((0.0105, 0.0, 0.028), (1.0, 0.0, 0.0), -0.25),
}
"""Of each fingertip: a point of its pad [m] and its normal there, in the link's frame; its share of the force."""
GUESS = np.array([1.37, 0.5, 0.3, -0.08, 1.17, 0.3, 1.18, 0.3])
"""The thumb's, index and middle finger's joints where inverse kinematics begin [rad]."""
REST = np.array([0.2, 0.1, 0.2, 0.1])
"""Ring and little finger [rad]."""
LEAST_BEND = 0.3
"""Of the last joints: nearer to their ends they could not give way [rad]."""
OIL = np.array([20.0] * 3 + [0.02] * 3)
"""Damping of the object while fingers close [N s/m, N m s/rad]."""
OPENING = 0.12
"""How far fingers are opened before they close [rad]."""


class Holding:
    """A hand that closes on one object of a width between thumb and fingers [m]."""

    def __init__(self, model: mujoco.MjModel, width: float):
        """Find the pose in which pads touch the object, where that is, and the torques that press."""
        self.model, self.state, self.body = model, mujoco.MjData(model), int(model.body(OBJECT).id)
        low, high = model.jnt_range[: len(GUESS)].T.copy()
        low[[2, 5, 7]] = LEAST_BEND
        solution = minimize(self._misfit, GUESS, args=(width,), bounds=list(zip(low, high, strict=True)))
        self.pose = np.concatenate([solution.x, REST])
        middle, axis = self._line(solution.x)
        yaw = np.arctan2(axis[1], axis[0])
        self.place = np.array([*middle, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        stiffness = model.actuator_gainprm[:, 0]
        self.pull, self.weight = self._torques(axis) / stiffness, self.state.qfrc_bias[: model.nu] / stiffness

    def hold(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `qpos` and the drives' targets [rad] once the object is held against gravity."""
        model, state, scale, targets = self.model, self.state, 1.0, np.zeros(self.model.nu)
        opened = self.pose.copy()
        opened[[1, 4, 6]] -= OPENING
        state.qpos[:] = [*opened, *self.place]
        for i in range(round(5.0 / model.opt.timestep)):
            time = i * model.opt.timestep
            share = float(np.clip(2.0 * (time - 3.0), 0.0, 1.0))
            model.opt.gravity[2] = -9.81 * share
            model.dof_damping[model.nu :] = OIL * (1.0 - share)
            goal = self.pose + scale * FORCE * self.pull + share * self.weight
            targets = opened + (goal - opened) * min(1.0, time)
            if 1.0 < time < 4.5 and i % 50 == 0:
                scale *= np.clip(FORCE / max(self.force(), 0.1), 0.95, 1.05)
            state.ctrl[:] = targets
            mujoco.mj_step(model, state)
        return state.qpos.copy(), targets

    def force(self) -> float:
        """Return the sum of the normal forces on the object [N]."""
        total, wrench = 0.0, np.zeros(6)
        for i in range(self.state.ncon):
            if self.body in self.model.geom_bodyid[self.state.contact[i].geom]:
                mujoco.mj_contactForce(self.model, self.state, i, wrench)
                total += wrench[0]
        return total

    def _pads(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points and normals of the pads in the world, (pad, 3)."""
        state = self.state
        state.qpos[: self.model.nu] = [*joints, *REST]
        mujoco.mj_kinematics(self.model, state)
        pads = []
        for name, (pos, normal, _) in PADS.items():
            rotation = state.body(name).xmat.reshape(3, 3)
            pads.append((state.body(name).xpos + rotation @ pos, rotation @ normal))
        points, normals = zip(*pads, strict=True)
        return np.array(points), np.array(normals)

    def _line(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the middle between the thumb's pad and the fingers', and the vector from the one to the others."""
        points, _ = self._pads(joints)
        fingers = points[1:].mean(axis=0)
        return 0.5 * (points[0] + fingers), fingers - points[0]

    def _misfit(self, joints: np.ndarray, width: float) -> float:
        """Return how far pads are from the object's sides, from facing one another, and from one height."""
        normals = self._pads(joints)[1]
        _, line = self._line(joints)
        axis = line / np.linalg.norm(line)
        distance = 1e4 * (np.linalg.norm(line) - width) ** 2
        facing = np.sum((normals[0] - axis) ** 2) + 0.5 * np.sum((normals[1:] + axis) ** 2)
        height = 4.0 * axis[2] ** 2 + 3e3 * line[2] ** 2
        return distance + facing + height + 0.05 * np.sum((joints[[2, 5, 7]] - 0.5) ** 2)

    def _torques(self, line: np.ndarray) -> np.ndarray:
        """Return the joint torques that press with 1 N in all, per newton [N·m/N]."""
        model, state = self.model, self.state
        points, _ = self._pads(self.pose[: len(GUESS)])
        state.qpos[model.nu :] = self.place
        mujoco.mj_forward(model, state)
        torques, jacobian = np.zeros(model.nv), np.zeros((3, model.nv))
        for (name, (*_, share)), point in zip(PADS.items(), points, strict=True):
            mujoco.mj_jac(model, state, jacobian, None, point, int(model.body(name).id))
            torques += jacobian.T @ (share * line / np.linalg.norm(line))
        return torques[: model.nu]


def scene_of(scenes: SceneModels, variant: int) -> mujoco.MjModel:
    """Return the scene with a variant of the object, of `MASS`."""
    model = copy.copy(scenes.model({OBJECT: Choice(variant)}))
    body = model.body(OBJECT)
    model.body_inertia[body.id] *= MASS / body.mass[0]
    model.body_mass[body.id] = MASS
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def width_of(scenes: SceneModels, variant: int) -> float:
    """Return the width of a variant between thumb and fingers: of a box along its x, of a cylinder its diameter [m]."""
    [size] = [geom.size for geom in scenes.objects[OBJECT].variants[variant] if geom is not None]
    return 2.0 * size[0]


def numbers(values: np.ndarray) -> str:
    """Return numbers as MuJoCo's XML has them."""
    return " ".join(f"{value:.5g}" for value in np.round(values, 5) + 0.0)


def main() -> None:
    """Write the keyframes into grip.xml."""
    touch = tgdsl.compile(FOLDER / "grip.yaml", sensors=["felt"])
    scenes = SceneModels(touch.plan.scene, {"timestep": 0.005})
    keys = []
    for i in range(len(scenes.objects[OBJECT].variants)):
        model = scene_of(scenes, i)
        holding = Holding(model, width_of(scenes, i))
        qpos, targets = holding.hold()
        print(f"hold-{i}: {holding.force():.2f} N, object at {np.round(qpos[model.nu :], 3)}")
        hand, item = numbers(qpos[: model.nu]), numbers(qpos[model.nu :])
        indent = " " * 9
        keys.append(f'    <key name="hold-{i}" qpos="{hand}\n{indent}{item}"\n{indent}ctrl="{numbers(targets)}"/>\n')
    file = FOLDER / "grip.xml"
    text = re.sub(r"\n+ *<!-- Keyframes.*</keyframe>\n", "\n", file.read_text(), flags=re.DOTALL)
    about = (
        f"\n  <!-- Keyframes of grip_starts.py: each variant of grip.yaml, of {1000 * MASS:g} g, held with {FORCE:g} N. -->\n"
    )
    file.write_text(text.replace("</mujoco>", f"{about}  <keyframe>\n{''.join(keys)}  </keyframe>\n</mujoco>"))


if __name__ == "__main__":
    main()
