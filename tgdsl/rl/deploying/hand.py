"""A source as a single environment, with the observations and joint targets of a `TouchEnv`.

Shapes: `env` one environment, `actuator` actuators of the scene, `joint` joints that the policy moves, `feature` numbers of a
group.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.console.progress import Progress
from tgdsl.errors import LowerError, TgdslError, listed
from tgdsl.rl import groups
from tgdsl.rl.actuation import Actuation, Actuators, DriveSpec
from tgdsl.rl.draws import Draws
from tgdsl.rl.env import Observations, Step, StepInfo, TouchEnv
from tgdsl.rl.load import LoadedTask, load_task
from tgdsl.rl.playing.policy import (
    ACTOR_GROUPS,
    Policy,
    PolicyError,
    PolicyFile,
    changes_around,
    changes_since,
    check_card,
    check_learned,
    read_policy,
)
from tgdsl.rl.sensors import GROUP, PolicyTouch, TaskSensors, compile_sensors
from tgdsl.rl.spec import ProprioSpec
from tgdsl.rl.start import moved_actuators, moved_joints
from tgdsl.rl.task import HandNow
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.stepped_scene import SteppedScene
from tgdsl.scene.scene import SceneModels

JOINT_POS, JOINT_VEL = "joint_pos", "joint_vel"
"""The module's groups for proprioception: all actuated joints, in the order of the actuators."""
EMULATED = "agg_force"  # touch of an emulated hand's fingertips, whatever a policy computes from it
CARD_KEYS = ("sensors", "touch", "placement", "resolution", "noise", "temporal", "joint_vel")
"""Keys of a task's document that the policy's card overrides."""
EVERYONE = torch.ones(1, dtype=torch.bool)
APPROACH_S = 2.0  # time in which a hand that may move approaches the start keyframe [s]


class DeployError(TgdslError):
    """A policy that cannot act on a source."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A policy with all that a connection needs."""

    saved: PolicyFile
    loaded: LoadedTask  # the task's document, with the policy's touch and goal
    sensors: TaskSensors  # its module: the sensors of policy and task, and the joints
    policy_touch: PolicyTouch | None  # the policy's touch; None without touch
    groups: Mapping[str, int]  # groups of observations that it takes, in its order, with their sizes
    goal: tuple[float, ...] | None  # the user's goal; None: the goal of the scene's task
    model: mujoco.MjModel
    moved: Actuators  # the joints that the policy moves
    changes: Sequence[str]  # changes of the task since the policy was learned, a line each

    @property
    def control_step(self) -> float:
        """Duration of a control step [s]."""
        physics = self.loaded.spec.physics
        return physics.timestep * physics.substeps

    def policy(self) -> Policy:
        """Return the policy, to act in one environment; raise `PolicyError` if it does not take its groups."""
        return Policy(self.saved, self.groups, 1, len(self.moved.names))


def prepare(
    task: str | PathLike[str] | Mapping[str, Any],
    policy: Path,
    *,
    groups: Sequence[str] = (),
    goal: Sequence[float] = (),
    overrides: Mapping[str, Any] | None = None,
    device: str = "cpu",
    is_emulated: bool = False,
    progress: Progress | None = None,
) -> Prepared:
    """Read a task's document and a policy, and compile the module of the policy's touch.

    The policy's card sets type, placement, resolution and noise of its touch; the document's `touch`, `placement`, `resolution`
    and `noise` apply to a policy without a card. An emulated hand also computes the fingertips' touch. For the other arguments
    see `Deployment`.
    """
    loaded, saved = load_task(task, overrides), read_policy(policy)
    card, changes = saved.card, list[str]()
    if card is not None:
        check_learned(card, policy, loaded.spec)
        from_card = {name: card["spec"][name] for name in CARD_KEYS if name in card["spec"]}
        from_card["proprio"] = ProprioSpec.model_validate(card["spec"].get("proprio", {}))
        loaded = replace(loaded, spec=loaded.spec.model_copy(update=from_card))
        changes += changes_since(card, loaded.spec)
    of_hand = loaded.task.hand_groups
    known_groups = ("proprio", *([GROUP] if loaded.spec.touch != "none" else []), *of_hand)
    names = tuple(groups) or tuple(card["groups"] if card else [name for name in ACTOR_GROUPS if name in known_groups])
    if unknown := [name for name in names if name not in (*known_groups, GROUP)]:
        problem = f'this policy sees {listed(unknown)} of the task "{loaded.spec.task}", which only a scene knows'
        hint = f"on a hand there are {listed(['proprio', GROUP, *of_hand])}"
        raise DeployError(f"{policy}: {problem}; {hint}; teach a student that sees no more: tgdsl distill")
    if goal:
        loaded = _with_goal(loaded, tuple(goal))
    spec = loaded.spec
    touch = PolicyTouch(spec.touch, spec.placement, spec.noise) if GROUP in names and spec.touch != "none" else None
    if touch is not None and spec.temporal == "stack":
        problem = f"this policy feels at each of {spec.physics.substeps} physics steps of a control step (temporal: stack)"
        raise DeployError(f"{policy}: {problem}, and a hand feels once; teach one with temporal: last")
    touches = [] if touch is None else [touch]
    if is_emulated and touch is not None and touch.is_per_link and touch.type != EMULATED:
        touches.append(touch._replace(type=EMULATED))
    also = {name: [{"type": name}] for name in (JOINT_POS, JOINT_VEL)}
    sensors = compile_sensors(loaded, device, progress, touches=touches, also=also)
    moved, model = moved_joints(loaded, sensors), SceneModels(sensors.touch.plan.scene).model({})
    if card is not None:
        check_card(saved, moved, sensors.touch)
        changes += changes_around(card, loaded, model)
    actuators = moved_actuators(loaded, model, moved)
    sizes = {name: int(card["groups"][name]) if card and name in card["groups"] else len(goal) for name in names}
    if "proprio" in sizes:
        sizes["proprio"] = 3 * len(moved)
    if touch is not None:
        observation = sensors.groups[touch.group].observation
        sizes[GROUP] = sum(term.num_features for term in sensors.touch.plan.observations if term.group == observation)
    result = Prepared(saved, loaded, sensors, touch, sizes, tuple(goal) or None, model, actuators, changes)
    result.policy()
    return result


def _with_goal(loaded: LoadedTask, goal: tuple[float, ...]) -> LoadedTask:
    """Return the document with a user's goal."""
    units = loaded.task.goal_units
    if len(goal) != len(units):
        expected = f"expected {len(units)} [{', '.join(units)}]" if units else "and nothing can be asked for"
        raise DeployError(f'goal: found {len(goal)} numbers, but of the task "{loaded.spec.task}" {expected}')
    try:
        return replace(loaded, spec=loaded.task.asked_for(loaded.spec, goal))
    except LowerError as error:
        raise DeployError(f"goal: {error} (`{error.field}` of the task's document)") from error


def empty_step(score: float = math.nan) -> Step:
    """Return a step of one environment without observations, reward or end."""
    false, count, zero = torch.zeros(1, dtype=torch.bool), torch.zeros(1, dtype=torch.int64), torch.zeros(1)
    return Step({}, zero, false, false, StepInfo(false, {}, {}, zero + score, zero, count, {}, false))


class TaskScene(SteppedScene):
    """One environment of a task: its objects, pushes and drives are simulated, and the task computes rewards and ends.

    A finished episode stands still until it is reset. `goal` is the task's present goal, `last_step` the result at the instant
    of the readings.
    """

    def __init__(self, env: TouchEnv):
        """Take a single environment at the start of an episode; it is closed with the scene."""
        self._env = env
        super().__init__(env.touch, env.sim)
        self.max_steps = env.max_steps
        self._note_start()

    @property
    def start(self) -> Float[Tensor, " actuator"]:
        """Set-points at the start of an episode, with later changes by `put` [rad]: a copy."""
        return self._setpoints[0].cpu().clone()

    def put(self, actuators: Int[np.ndarray, " n"], setpoints: Float[np.ndarray, " n"]) -> None:
        self._setpoints[0, torch.from_numpy(actuators)] = torch.from_numpy(setpoints).to(self._setpoints)

    def advance(self) -> dict[str, Tensor]:
        if self.last_step.info.ended:
            return self.readings
        self.last_step = self._env.follow(self._setpoints)
        self.goal = self._env.task.asked().cpu().clone()
        return self.read()

    def begin(self) -> dict[str, Tensor]:
        self._env.reset()
        self._note_start()
        return self.read()

    def read(self) -> dict[str, Tensor]:
        return dict(self._env.now.readings)

    def close(self) -> None:
        self._env.close()

    def _note_start(self) -> None:
        env = self._env
        self._setpoints = env.sim.ctrl.clone()
        self._setpoints[:, torch.from_numpy(env.task.setup.actuators.actuator)] = env.actuation.target
        self.goal, self.last_step = env.task.asked().cpu().clone(), empty_step(float(env.task.score()))


class Hand:
    """One episode on a source.

    An `Actuation` with ideal drives computes the targets; the hand's real drives follow them.

    `age_s` is the age of the last observations' sample, None where nothing runs in real time, `inference_s` the time from
    there to the set-points, `seconds` the duration of the last control step [s].
    """

    def __init__(self, prepared: Prepared, connection: Connection, scene: TaskScene | None, is_exact: bool):
        """Begin with all targets at zero; `is_exact`: the source's velocities are exact, from a simulation."""
        self._prepared, self._connection, self._scene = prepared, connection, scene
        model, spec = prepared.model, prepared.loaded.spec
        sizes = {"qpos": model.nq, "qvel": model.nv, "ctrl": model.nu, "qfrc_applied": model.nv}
        self._arrays = {name: torch.zeros((1, size), dtype=torch.float64) for name, size in sizes.items()}
        self._actuation = Actuation(prepared.moved, self._arrays, spec.action, DriveSpec(), Draws(0, 1))
        self._joints = prepared.sensors.touch.inputs.joints  # as the groups `joint_pos` and `joint_vel` have them
        self._rows = torch.tensor([self._joints.index(name) for name in prepared.moved.names])
        self._goal = torch.tensor([prepared.goal or ()], dtype=torch.float64)
        self._measures = is_exact and spec.joint_vel == "measured"
        self._speeds: groups.MeasuredVelocity | None = None
        self._began = 0.0
        self.action = torch.zeros((1, len(self._rows)), dtype=torch.float64)  # last action, from −1 to 1
        self.steps = 0
        self.age_s: float | None = None
        self.inference_s = self.seconds = 0.0

    @property
    def target(self) -> Float[Tensor, "env joint"]:
        """Set-points of the joints that the policy moves [rad]: a copy."""
        return self._actuation.target.clone()

    def begin(self, start: Float[np.ndarray, " actuator"] | None, moves: bool) -> None:
        """Begin at the scene's start; without a scene, at set-points [rad] after an approach, or at the present positions."""
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
        if prepared.policy_touch is not None:
            result[GROUP] = observed[prepared.sensors.groups[prepared.policy_touch.group].observation].cpu()
        return {name: result[name].float() for name in prepared.groups}

    def step(self, action: Float[Tensor, "env joint"]) -> Step:
        """Make one control step; joints that the policy does not move are held. Without a scene the score is NaN."""
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
        return empty_step() if self._scene is None else self._scene.last_step

    def _holding(self, joint_pos: Float[Tensor, "env joint"]) -> Float[Tensor, " actuator"]:
        """Return set-points that hold all joints where they are, within their ranges [rad]."""
        model = self._prepared.model
        joints = [model.joint(name).id for name in self._joints]
        is_of_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        ids = [np.flatnonzero(is_of_joint & (model.actuator_trnid[:, 0] == joint))[0] for joint in joints]
        control = np.zeros(model.nu)
        low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf]).T
        control[ids] = joint_pos[0].double().numpy().clip(low, high)
        return torch.from_numpy(control)
