"""Where a model's joints stand in `qpos` and `qvel`, by name."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from tgdsl.errors import SimulationError, did_you_mean


@dataclass(frozen=True)
class Joint:
    """Where one joint stands.

    Attributes:
        qpos: Its part of `qpos`: of a free joint 7 numbers, position [m] and quaternion w, x, y, z; of a ball 4, else 1.
        qvel: Its part of `qvel`: of a free joint 6 numbers, velocity [m/s] in the world and angular velocity [rad/s] in the
            body's frame; of a ball 3, else 1.
    """

    qpos: slice
    qvel: slice


class Joints(dict[str, Joint]):
    """Joints by name, in the model's order. One without a name goes by its body's, if the body has no other."""

    def __init__(self, model: mujoco.MjModel):
        """Look up where the joints of a model stand."""
        super().__init__()
        named = {model.joint(i).name for i in range(model.njnt)}
        for i in range(model.njnt):
            name, body = model.joint(i).name, model.body(model.jnt_bodyid[i])
            if not name and int(body.jntnum[0]) == 1 and body.name not in named:
                name = body.name
            if name:
                qpos, qvel = int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])
                num_qpos, num_qvel = _SIZES[int(model.jnt_type[i])]
                self[name] = Joint(slice(qpos, qpos + num_qpos), slice(qvel, qvel + num_qvel))

    def __missing__(self, name: str) -> Joint:
        raise SimulationError(f'the scene has no joint "{name}"; {did_you_mean(name, self, "joints")}')


_SIZES = {
    int(mujoco.mjtJoint.mjJNT_FREE): (7, 6),
    int(mujoco.mjtJoint.mjJNT_BALL): (4, 3),
    int(mujoco.mjtJoint.mjJNT_SLIDE): (1, 1),
    int(mujoco.mjtJoint.mjJNT_HINGE): (1, 1),
}
"""Numbers in `qpos` and `qvel` by type of joint."""
