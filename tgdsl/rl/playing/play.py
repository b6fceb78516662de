"""Environments stepped by whoever acts, and what each step was.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of a group, `nq` as in MuJoCo's model.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.rl.env import Step, TouchEnv
from tgdsl.rl.playing.actor import Actor


@dataclass(frozen=True, eq=False)
class Played:
    """One control step.

    Attributes:
        index: Its number, from 0.
        obs: Observations that the action was chosen from, by group.
        poses: MuJoCo's `qpos`, and `mocap_pos` and `mocap_quat` where there are such bodies, (env, …), at the start of this
            step; observations are of one physics step before, but for the first of an episode.
        action: The action.
        step: What came of it.
    """

    index: int
    obs: dict[str, Float[Tensor, "env feature"]]
    poses: dict[str, Float[Tensor, "env ..."]]
    action: Float[Tensor, "env joint"]
    step: Step


def steps_of(env: TouchEnv, seconds: float | None) -> int:
    """Return how many control steps a duration has, at least one; default: an episode's.

    Raises:
        SimulationError: If it is not positive.
    """
    if seconds is None:
        return env.max_steps
    if not 0 < seconds < float("inf"):
        raise SimulationError(f"played for {seconds:g} s: expected more than 0 s")
    return max(1, round(seconds / env.control_step))


def poses_of(env: TouchEnv) -> dict[str, Float[Tensor, "env ..."]]:
    """Return where everything is now, by MuJoCo's names, as `Played.poses`: live tensors."""
    moved = ("qpos", "mocap_pos", "mocap_quat") if env.sim.model.nmocap else ("qpos",)
    return {name: env.sim.arrays[name] for name in moved}


def play(env: TouchEnv, actor: Actor, num_steps: int, seed: int = 0) -> Iterator[Played]:
    """Begin a new episode in all environments, and yield each control step.

    Args:
        env: The environments.
        actor: Who acts.
        num_steps: Number of control steps.
        seed: What all that is random in the environments follows from.
    """
    obs = env.reset(seed)
    for index in range(num_steps):
        poses = {name: value.clone() for name, value in poses_of(env).items()}
        action = actor(obs)
        step = env.step(action)
        yield Played(index, obs, poses, action, step)
        actor.begin(step.info.ended)
        obs = step.obs
