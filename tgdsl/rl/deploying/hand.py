"""A source as an environment of one: observations as `TouchEnv` has them, joint targets by its arithmetic.

Shapes: `env` one environment, `actuator` actuators of the scene, `joint` joints that the policy moves, `feature` numbers of a
group.
"""

from __future__ import annotations

import time

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.rl import groups
from tgdsl.rl.actuation import Actuation, DriveSpec
from tgdsl.rl.deploying.prepared import JOINT_POS, JOINT_VEL, Prepared
from tgdsl.rl.deploying.scene import TaskScene, first_step
from tgdsl.rl.draws import Draws
from tgdsl.rl.episodes import Observations, Step
from tgdsl.rl.playing.policy import PolicyError
from tgdsl.rl.sensed import GROUP
from tgdsl.rl.task import HandNow
from tgdsl.runtime.connection import Connection

EVERYONE = torch.ones(1, dtype=torch.bool)
APPROACH_S = 2.0
"""Time in which a hand that may move goes to the keyframe from which it shall act [s]."""


class Hand:
    """One episode on a source.

    Targets are those of an `Actuation` whose drives are ideal: what a real drive does with them is the hand's affair.

    Attributes:
        action: The last action, from −1 to 1; zero at the start.
        steps: Control steps so far.
        age_s: How old the sample was of which the last observations were made [s]; None where nothing runs in real time.
        inference_s: Time from then until the set-points were there [s].
        seconds: Time that the last control step took [s].
    """

    def __init__(self, prepared: Prepared, connection: Connection, scene: TaskScene | None, is_exact: bool):
        """Begin with all targets at zero; call `begin`.

        Args:
            prepared: The policy.
            connection: The source.
            scene: The task's scene, if the source has one.
            is_exact: Whether velocities that are observed are a simulation's, and not measured as a hand does.
        """
        self._prepared, self._connection, self._scene = prepared, connection, scene
        model, spec = prepared.model, prepared.loaded.spec
        sizes = {"qpos": model.nq, "qvel": model.nv, "ctrl": model.nu, "qfrc_applied": model.nv}
        self._arrays = {name: torch.zeros((1, size), dtype=torch.float64) for name, size in sizes.items()}
        self._actuation = Actuation(prepared.moved, self._arrays, spec.action, DriveSpec(), Draws(0, 1))
        self._rows = torch.tensor([prepared.joints.index(name) for name in prepared.moved.names])
        self._goal = torch.tensor([prepared.goal or ()], dtype=torch.float64)
        self._measures = is_exact and spec.joint_vel == "measured"
        self._speeds: groups.MeasuredVelocity | None = None
        self._began = 0.0
        self.action = torch.zeros((1, len(self._rows)), dtype=torch.float64)
        self.steps = 0
        self.age_s: float | None = None
        self.inference_s = self.seconds = 0.0

    @property
    def target(self) -> Float[Tensor, "env joint"]:
        """Set-points of the joints that the policy moves [rad]: a copy."""
        return self._actuation.target.clone()

    def begin(self, start: Float[np.ndarray, " actuator"] | None, moves: bool) -> None:
        """Begin where the scene or the hand is.

        Args:
            start: Set-points to begin with without a scene [rad]; None: those that hold the joints where they are.
            moves: Whether the hand goes there first.
        """
        if self._scene is not None:
            control = self._scene.start
        elif start is None:
            control = self._holding(self._connection.observe()[JOINT_POS])
        else:
            control = torch.from_numpy(start.copy())
            for _ in range(round(APPROACH_S / self._connection.control_step) if moves else 0):
                self._connection.step(control[None])
        self._arrays["ctrl"].copy_(control)
        self._actuation.place(EVERYONE, at_controls=True)

    def observe(self) -> Observations:
        """Return the policy's groups of observations: once per control step."""
        self._began = time.monotonic()
        self.age_s = self._connection.age_s
        prepared, spec = self._prepared, self._prepared.loaded.spec
        observed = self._connection.observe()
        joint_pos, joint_vel = (observed[name][:, self._rows].cpu().double() for name in (JOINT_POS, JOINT_VEL))
        if self._measures:
            if self._speeds is None:
                self._speeds = groups.MeasuredVelocity(joint_pos, prepared.control_step)
            else:
                self._speeds.update(joint_pos)
            joint_vel = self._speeds.value
        now = HandNow(
            joint_pos=joint_pos,
            joint_vel=joint_vel,
            target=self._actuation.target,
            action=self.action,
            steps=self.steps,
            control_step=prepared.control_step,
            goal=self._goal if self._scene is None else self._scene.goal,
        )
        result = {"proprio": groups.proprio(now, spec.proprio.vel_scale)} | prepared.loaded.task.observe_hand(spec, now)
        if prepared.felt is not None:
            source = prepared.sensed.groups[prepared.felt.group]
            result[GROUP] = observed[source.observation].cpu()
        return {name: result[name].float() for name in prepared.groups}

    def step(self, action: Float[Tensor, "env joint"]) -> Step:
        """Make one control step; joints that the policy does not move are held. Without a scene its score is not a number.

        Raises:
            PolicyError: If an action is not finite.
        """
        action = action.to(self.action)
        if not bool(action.isfinite().all()):
            problem = f"at control step {self.steps} this policy returns {action[0].tolist()}, expected finite actions"
            raise PolicyError(f"{self._prepared.saved.file}: {problem}")
        self._actuation.command(action)
        self.action = action.clamp(-1.0, 1.0)
        self.steps += 1
        self.inference_s = time.monotonic() - self._began
        self._connection.step(self._arrays["ctrl"].clone())
        self.seconds = time.monotonic() - self._began
        return first_step() if self._scene is None else self._scene.last_step

    def _holding(self, joint_pos: Float[Tensor, "env joint"]) -> Float[Tensor, " actuator"]:
        """Return set-points that hold all joints where they are, within their ranges [rad]."""
        model = self._prepared.model
        joints = [model.joint(name).id for name in self._prepared.joints]
        is_of_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        ids = [np.flatnonzero(is_of_joint & (model.actuator_trnid[:, 0] == joint))[0] for joint in joints]
        held = np.zeros(model.nu)
        low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf]).T
        held[ids] = joint_pos[0].double().numpy().clip(low, high)
        return torch.from_numpy(held)
