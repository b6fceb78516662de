"""Which links of a hand are fingers.

Shapes: `link` links of `Setup.links`.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Bool

from tgdsl.runtime.simulators.model_ids import element_id


def are_fingers(model: mujoco.MjModel, links: Sequence[str]) -> Bool[np.ndarray, " link"]:
    """Return which links are fingers: a hinge moves them, or a slide that does not move all links, as that of a whole hand."""
    joints = [_joints_above(model, element_id(model, "body", link)) for link in links]
    of_all = set.intersection(*joints) if joints else set()
    slides = {joint for joint in of_all if int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return np.array([bool(joint_ids - slides) for joint_ids in joints], dtype=bool)


def _joints_above(model: mujoco.MjModel, body: int) -> set[int]:
    """Return the hinges and slides that move a body."""
    result: set[int] = set()
    while body:
        first = int(model.body_jntadr[body])
        result |= set(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    return {joint for joint in result if int(model.jnt_type[joint]) in kinds}
