"""Tasks whose object lies freely: where it starts, when it is dropped, and what is observed of its goal.

It starts upright where the keyframe has it, moved and turned at random.

Shapes: `env` environments, `nq` as in MuJoCo's model.
"""

from __future__ import annotations

from typing import Annotated, Literal

import mujoco
import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.errors import SimulationError
from tgdsl.rl import rotations
from tgdsl.rl.draws import within
from tgdsl.rl.features import GoalPart
from tgdsl.rl.spec import PlacedRandomSpec, TaskSpec
from tgdsl.rl.task import Setup
from tgdsl.runtime.simulators.model_ids import element_id


class PlacedTaskSpec(TaskSpec):
    """A task whose object is put down freely, and has an orientation as its goal."""

    randomise: PlacedRandomSpec = PlacedRandomSpec()
    """What is random."""
    goal: Annotated[tuple[GoalPart, ...], Field(min_length=1)] = ("orientation", "angle")
    """What the group `goal` has, in order: six numbers of the goal's `orientation`; the same of the `difference`, the turn from
    the object to the goal in world axes; the `angle` of that turn [rad]."""
    drop_measure: Literal["distance", "below"] = "distance"
    """What `drop_distance` bounds: how far the object is from where it started, or how far below."""

    def drop_extent(self, offset: Float[Tensor, "env 3"]) -> Float[Tensor, " env"]:
        """Return what `drop_distance` bounds, of an object's position less that at its start [m]."""
        return vector_norm(offset, dim=1) if self.drop_measure == "distance" else -offset[:, 2]


def object_qpos(setup: Setup) -> slice:
    """Return where the task's object's position and quaternion stand in `qpos`: see `free_qpos`."""
    return free_qpos(setup.model, setup.object)


def free_qpos(model: mujoco.MjModel, name: str) -> slice:
    """Return where a free body's position and quaternion stand in `qpos`.

    Raises:
        SimulationError: If there is no such body, or it does not move freely.
    """
    body = model.body(element_id(model, "body", name))
    if int(body.dofnum[0]) != 6 or int(body.jntnum[0]) != 1:
        raise SimulationError(f'the object\'s body "{name}" has no free joint, by which it could be put elsewhere')
    first = int(model.jnt_qposadr[int(body.jntadr[0])])
    return slice(first, first + 7)


def placed(
    setup: Setup, spec: PlacedRandomSpec, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]
) -> tuple[Float[Tensor, "env nq"], Float[Tensor, "env 3"], Float[Tensor, "env 4"]]:
    """Return `qpos` with the object at its start, and its position [m] and quaternion there, in the world.

    Objects of other heights than the first variant, which the keyframe has, stand where that one stands.

    Args:
        setup: The setup of the environments.
        spec: What is random.
        chosen: The environments; rows of the others mean nothing.
        episode: How often each environment was reset.
    """
    own, draws, dtype = object_qpos(setup), setup.draws, setup.dtype
    qpos = setup.qpos.repeat(setup.num_envs, 1)
    shares = draws.shares({"placement": 2, "yaw": 1}, episode, chosen)
    xy, yaw = (within(shares[name], *bounds).to(dtype) for name, bounds in (("placement", spec.xy), ("yaw", spec.yaw)))
    up = torch.eye(3, dtype=dtype, device=setup.device)[2].expand(setup.num_envs, 3)
    rise = setup.half_height - setup.first_half_height
    pos = qpos[:, own.start : own.start + 3] + torch.cat([xy, rise[:, None]], dim=1)
    quat = rotations.product(rotations.about(up, yaw[:, 0]), qpos[:, own.start + 3 : own.stop])
    qpos[:, own] = torch.cat([pos, quat], dim=1)
    return qpos, pos, quat
