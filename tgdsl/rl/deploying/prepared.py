"""A policy and its task's document, seen to fit each other and a hand, before anything is connected.

Shapes: `actuator` actuators of the scene.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Int

from tgdsl.console.progress import Progress
from tgdsl.errors import LowerError, SimulationError, TgdslError, listed
from tgdsl.module.module import TactileModule
from tgdsl.rl.actuation import Actuators
from tgdsl.rl.load import LoadedTask, load_task
from tgdsl.rl.playing.policy import (
    ACTOR_GROUPS,
    Policy,
    PolicyError,
    PolicyFile,
    changes_since,
    check_card,
    check_learned,
    read_policy,
)
from tgdsl.rl.playing.provenance import changes_around
from tgdsl.rl.sensed import GROUP, PER_LINK, Felt, Sensed, compile_sensed
from tgdsl.rl.start import moved_joints
from tgdsl.scene.scene import SceneModels

JOINT_POS, JOINT_VEL = "joint_pos", "joint_vel"
"""Groups of the module that proprioception is made of: all actuated joints, in the order of the actuators."""
EMULATED = "agg_force"
"""What an emulated hand's fingertips feel, whatever a policy makes of it."""


_OF_CARDS = ("touch", "placement", "resolution", "noise", "joint_vel")
"""What of a task's document is as it was where the policy was learned."""


class DeployError(TgdslError):
    """A policy that cannot act on a source."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A policy with all that is needed to connect it.

    Attributes:
        saved: The policy's file.
        loaded: The task's document, with what the policy feels and is asked for.
        sensed: Its module: what the policy feels and the task looks at, and the joints.
        felt: What the policy feels; None: nothing.
        groups: Groups of observations that it takes, in its order, with their sizes.
        goal: What a user asks for; None: what the scene's task does.
        model: The scene.
        joints: The actuated joints, in the order of the module's groups `joint_pos` and `joint_vel`.
        actuator_id: Actuator of each.
        moved: The joints that the policy moves.
        changes: What of the task was otherwise when the policy was learned, a line each.
    """

    saved: PolicyFile
    loaded: LoadedTask
    sensed: Sensed
    felt: Felt | None
    groups: Mapping[str, int]
    goal: tuple[float, ...] | None
    model: mujoco.MjModel
    joints: tuple[str, ...]
    actuator_id: Int[np.ndarray, " joint"]
    moved: Actuators
    changes: Sequence[str]

    @property
    def control_step(self) -> float:
        """Duration of a control step [s]."""
        physics = self.loaded.spec.physics
        return physics.timestep * physics.substeps

    def policy(self) -> Policy:
        """Return the policy, to act in one environment.

        Raises:
            PolicyError: If it does not take its groups, or moves other joints.
        """
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
    """Read a task's document and a policy, and compile the module with which the policy feels.

    What it feels, where, how densely and with what noise stand in its card; the document's `touch`, `placement`, `resolution`
    and `noise` count for a policy without one.

    Args:
        task: The task's document.
        policy: The policy's file.
        groups: Groups of observations that it takes, in its order; default: as its card says, or `proprio`, `tactile_sensors`
            and `goal`, of those that there are.
        goal: What it is asked for, in the task's units; default: the task's own.
        overrides: Values of the document to set first by dotted path.
        device: Where the module computes.
        is_emulated: Whether an emulated hand has to feel what the fingertips would.
        progress: Called with a line of text for each long job.

    Raises:
        SpecError: All mistakes of the documents, at their places.
        PolicyError: If the policy cannot be read, or was learned in another task, with other actions, joints or taxels.
        DeployError: If it sees what no hand can know, or is asked for what it cannot be.
    """
    loaded = load_task(task, overrides)
    saved = read_policy(policy)
    card = saved.card
    changes: Sequence[str] = ()
    if card is not None:
        check_learned(card, policy, loaded.spec)
        from_card = {name: card["spec"][name] for name in _OF_CARDS if name in card["spec"]}
        loaded = _with(loaded, from_card)
        changes = changes_since(card, loaded.spec)
    names = tuple(groups) or tuple(card["groups"] if card else _default_groups(loaded))
    _refuse_unknowable(policy, loaded, names)
    loaded, goal_numbers = _asked(loaded, goal)
    spec = loaded.spec
    felt = Felt(spec.touch, spec.placement, spec.noise) if GROUP in names and spec.touch != "none" else None
    feels = [] if felt is None else [felt]
    if is_emulated and felt is not None and felt.type in PER_LINK and felt.type != EMULATED:
        feels.append(felt._replace(type=EMULATED))
    also = {name: [{"type": name}] for name in (JOINT_POS, JOINT_VEL)}
    sensed = compile_sensed(loaded, device, progress, feels=feels, also=also)
    moved, model = moved_joints(loaded, sensed), SceneModels(sensed.touch.plan.scene).model({})
    if card is not None:
        check_card(saved, moved, _alone(loaded, sensed, feels))
        changes = [*changes, *changes_around(card, loaded, model)]
    joints = sensed.touch.inputs.joints
    try:
        actuators = Actuators.of(model, moved)
    except SimulationError as error:
        raise loaded.error(("joints",), str(error)) from error
    sizes = {name: _size(name, card, sensed, felt, len(moved), goal_numbers) for name in names}
    actuator_id = _actuators(model, joints)
    result = Prepared(saved, loaded, sensed, felt, sizes, goal_numbers, model, joints, actuator_id, actuators, changes)
    result.policy()
    return result


def _with(loaded: LoadedTask, values: Mapping[str, Any]) -> LoadedTask:
    return dataclasses.replace(loaded, spec=loaded.spec.model_copy(update=dict(values)))


def _default_groups(loaded: LoadedTask) -> list[str]:
    there = {"proprio", *loaded.task.hand_groups, *([GROUP] if loaded.spec.touch != "none" else [])}
    return [name for name in ACTOR_GROUPS if name in there]


def _refuse_unknowable(policy: Path, loaded: LoadedTask, names: Sequence[str]) -> None:
    """Refuse groups that no hand can know.

    Raises:
        DeployError: If there are some; all are named.
    """
    group_names = ("proprio", GROUP, *loaded.task.hand_groups)
    unknown = [name for name in names if name not in group_names]
    if unknown:
        problem = f'this policy sees {listed(unknown)} of the task "{loaded.spec.task}", which only a scene knows'
        hint = f"on a hand there are {listed(group_names)}; teach a student that sees no more: tgdsl distill"
        raise DeployError(f"{policy}: {problem}; {hint}")


def _asked(loaded: LoadedTask, goal: Sequence[float]) -> tuple[LoadedTask, tuple[float, ...] | None]:
    """Return the document in which a user's goal is asked for, and the goal.

    Raises:
        DeployError: If it cannot be asked for.
    """
    units = loaded.task.goal_units
    if not goal:
        return loaded, None
    if len(goal) != len(units):
        expected = f"expected {len(units)} [{', '.join(units)}]" if units else "and nothing can be asked for"
        raise DeployError(f'goal: found {len(goal)} numbers, but of the task "{loaded.spec.task}" {expected}')
    try:
        spec = loaded.task.asked_for(loaded.spec, tuple(goal))
    except LowerError as error:
        raise DeployError(f"goal: {error} (`{error.field}` of the task's document)") from error
    return dataclasses.replace(loaded, spec=spec), tuple(goal)


def _alone(loaded: LoadedTask, sensed: Sensed, feels: Sequence[Felt]) -> TactileModule:
    return sensed.touch if len(feels) < 2 else compile_sensed(loaded, "cpu", feels=feels[:1]).touch


def _size(
    name: str, card: Mapping[str, Any] | None, sensed: Sensed, felt: Felt | None, num: int, asked: tuple[float, ...] | None
) -> int:
    """Return how many numbers a group has: as the card says, else by what it is of."""
    if name == GROUP and felt is not None:
        source = sensed.groups[felt.group]
        terms = sensed.touch.plan.observations
        return sum(term.num_features for term in terms if term.group == source.observation)
    if name == "proprio":
        return 3 * num
    return int(card["groups"][name]) if card else len(asked or ())


def _actuators(model: mujoco.MjModel, joints: Sequence[str]) -> Int[np.ndarray, " joint"]:
    """Return the actuator of each joint."""
    targets = [
        model.joint(int(joint)).name if kind == mujoco.mjtTrn.mjTRN_JOINT else ""
        for kind, joint in zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)
    ]
    return np.array([targets.index(name) for name in joints], dtype=np.int64)


def refuse_policy(file: Path, what: str) -> PolicyError:
    """Return the error of a policy that does something that no drive can follow."""
    return PolicyError(f"{file}: {what}")
