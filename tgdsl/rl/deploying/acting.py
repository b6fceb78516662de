"""A policy that acts on a hand: observations as `TouchEnv` has them in, joint targets by its arithmetic out.

Shapes: `actuator` actuators of the scene, `joint` joints that the policy moves, `feature` numbers of a group,
`number` of a connection's.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.rl import groups
from tgdsl.rl.actuation import Actuation, DriveSpec
from tgdsl.rl.deploying.prepared import JOINT_POS, JOINT_VEL, Prepared, refuse_policy
from tgdsl.rl.draws import Draws
from tgdsl.rl.sensed import GROUP
from tgdsl.rl.task import HandNow

EVERYONE = torch.ones(1, dtype=torch.bool)


class HandActor:
    """A policy that acts on one hand.

    Targets are those of an `Actuation` whose drives are ideal: what a real drive does with them is the hand's affair.

    Attributes:
        action: What the policy has asked for last, from −1 to 1; zero at the start of an episode.
        steps: Control steps since then.
    """

    def __init__(self, prepared: Prepared, is_exact: bool):
        """Begin with all targets at zero; call `begin`.

        Args:
            prepared: The policy.
            is_exact: Whether velocities that are observed are a simulation's, and not measured as a hand does.
        """
        self._prepared, self._policy = prepared, prepared.policy()
        model, spec = prepared.model, prepared.loaded.spec
        sizes = {"qpos": model.nq, "qvel": model.nv, "ctrl": model.nu, "qfrc_applied": model.nv}
        self._arrays = {name: torch.zeros((1, size), dtype=torch.float64) for name, size in sizes.items()}
        self._actuation = Actuation(prepared.moved, self._arrays, spec.action, DriveSpec(), Draws(0, 1))
        self._rows = torch.tensor([prepared.joints.index(name) for name in prepared.moved.names])
        self.action = torch.zeros((1, len(self._rows)), dtype=torch.float64)
        self.steps = 0
        self._measures = is_exact and spec.joint_vel == "measured"
        self._speeds: groups.MeasuredVelocity | None = None

    @property
    def control(self) -> Float[Tensor, "env actuator"]:
        """Set-points of all actuators [rad]: a copy."""
        return self._arrays["ctrl"].clone()

    @property
    def target(self) -> Float[Tensor, "env joint"]:
        """Those of the joints that the policy moves [rad]: a copy."""
        return self._actuation.target.clone()

    def begin(self, control: Float[Tensor, " actuator"]) -> None:
        """Begin an episode.

        Args:
            control: Set-points that hold now, by actuator [rad].
        """
        self._arrays["ctrl"].copy_(control)
        self._actuation.place(EVERYONE, at_controls=True)
        self.action.zero_()
        self.steps = 0
        self._speeds = None
        self._policy.begin(EVERYONE)

    def hold(self, joint_pos: Float[Tensor, "env joint"]) -> Float[Tensor, " actuator"]:
        """Return set-points that hold all joints where they are, within their ranges [rad]."""
        model, ids = self._prepared.model, self._prepared.actuator_id
        held = np.zeros(model.nu)
        held[ids] = joint_pos[0].double().numpy()
        joints = [model.joint(name).id for name in self._prepared.joints]
        low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf]).T
        held[ids] = held[ids].clip(low, high)
        return torch.from_numpy(held)

    def observe(
        self, observed: Mapping[str, Float[Tensor, "env number"]], goal: Float[Tensor, "env goal"]
    ) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the policy's groups of observations: once per control step.

        Args:
            observed: What a connection has observed.
            goal: What is asked for.
        """
        prepared, spec = self._prepared, self._prepared.loaded.spec
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
            goal=goal,
        )
        result = {"proprio": groups.proprio(now)} | prepared.loaded.task.observe_hand(spec, now)
        if prepared.felt is not None:
            source = prepared.sensed.groups[prepared.felt.group]
            result[GROUP] = observed[source.observation].cpu()
        return {name: result[name].float() for name in prepared.groups}

    def act(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env actuator"]:
        """Return the set-points of all actuators for what is observed [rad]; joints that the policy does not move are held.

        Raises:
            PolicyError: If an action is not finite.
        """
        action = self._policy(obs).to(self.action)
        if not bool(action.isfinite().all()):
            problem = f"at control step {self.steps} this policy returns {action[0].tolist()}, expected finite actions"
            raise refuse_policy(self._prepared.saved.file, problem)
        self._actuation.command(action)
        self.action = action.clamp(-1.0, 1.0)
        self.steps += 1
        return self.control
