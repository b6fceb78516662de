"""A policy and its task's document, seen to fit each other and a hand, before anything is connected."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import mujoco

from tgdsl.console.progress import Progress
from tgdsl.errors import LowerError, SimulationError, TgdslError, listed
from tgdsl.rl.actuation import Actuators
from tgdsl.rl.load import LoadedTask, load_task
from tgdsl.rl.playing.policy import (
    ACTOR_GROUPS,
    Policy,
    PolicyFile,
    changes_since,
    check_card,
    check_learned,
    read_policy,
)
from tgdsl.rl.playing.provenance import changes_around
from tgdsl.rl.sensed import GROUP, PER_LINK, Felt, Sensed, compile_sensed
from tgdsl.rl.spec import ProprioSpec
from tgdsl.rl.start import moved_joints
from tgdsl.scene.scene import SceneModels

JOINT_POS, JOINT_VEL = "joint_pos", "joint_vel"
"""Groups of the module that proprioception is made of: all actuated joints, in the order of the actuators."""
EMULATED = "agg_force"
"""What an emulated hand's fingertips feel, whatever a policy makes of it."""


_OF_CARDS = ("sensors", "touch", "placement", "resolution", "noise", "temporal", "joint_vel")
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
    moved: Actuators
    changes: Sequence[str]

    @property
    def joints(self) -> tuple[str, ...]:
        """The actuated joints, in the order of the module's groups `joint_pos` and `joint_vel`."""
        return self.sensed.touch.inputs.joints

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
    loaded, saved = load_task(task, overrides), read_policy(policy)
    card, changes = saved.card, list[str]()
    if card is not None:
        check_learned(card, policy, loaded.spec)
        from_card = {name: card["spec"][name] for name in _OF_CARDS if name in card["spec"]}
        from_card["proprio"] = ProprioSpec.model_validate(card["spec"].get("proprio", {}))
        loaded = dataclasses.replace(loaded, spec=loaded.spec.model_copy(update=from_card))
        changes += changes_since(card, loaded.spec)
    known = ("proprio", *([GROUP] if loaded.spec.touch != "none" else []), *loaded.task.hand_groups)
    names = tuple(groups) or tuple(card["groups"] if card else [name for name in ACTOR_GROUPS if name in known])
    if unknown := [name for name in names if name not in (*known, GROUP)]:
        problem = f'this policy sees {listed(unknown)} of the task "{loaded.spec.task}", which only a scene knows'
        hint = f"on a hand there are {listed(['proprio', GROUP, *loaded.task.hand_groups])}"
        raise DeployError(f"{policy}: {problem}; {hint}; teach a student that sees no more: tgdsl distill")
    loaded, asked = _asked(loaded, goal)
    spec = loaded.spec
    felt = Felt(spec.touch, spec.placement, spec.noise) if GROUP in names and spec.touch != "none" else None
    if felt is not None and spec.temporal == "stack":
        problem = f"this policy feels at each of {spec.physics.substeps} physics steps of a control step (temporal: stack)"
        raise DeployError(f"{policy}: {problem}, and a hand feels once; teach one with temporal: last")
    feels = [] if felt is None else [felt]
    if is_emulated and felt is not None and felt.type in PER_LINK and felt.type != EMULATED:
        feels.append(felt._replace(type=EMULATED))
    also = {name: [{"type": name}] for name in (JOINT_POS, JOINT_VEL)}
    sensed = compile_sensed(loaded, device, progress, feels=feels, also=also)
    moved, model = moved_joints(loaded, sensed), SceneModels(sensed.touch.plan.scene).model({})
    if card is not None:
        check_card(saved, moved, sensed.touch)
        changes += changes_around(card, loaded, model)
    try:
        actuators = Actuators.of(model, moved)
    except SimulationError as error:
        raise loaded.error(("joints",), str(error)) from error
    sizes = {name: int(card["groups"][name]) if card and name in card["groups"] else len(asked or ()) for name in names}
    sizes |= {"proprio": 3 * len(moved)} if "proprio" in sizes else {}
    if felt is not None:
        observation = sensed.groups[felt.group].observation
        sizes[GROUP] = sum(term.num_features for term in sensed.touch.plan.observations if term.group == observation)
    result = Prepared(saved, loaded, sensed, felt, sizes, asked, model, actuators, changes)
    result.policy()
    return result


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
