"""Grippers of one jaw that turns against a fixed one: the link that carries it, and goes on beside it beyond its hinge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.placement.propose.hands import MAX_FINGER, Hand, KinematicTree

BESIDE = 0.5
"""A fixed jaw reaches beyond the hinge by this share of the moving jaw's reach or more, when closed."""
MIN_BEND = np.radians(20.0)
"""A jaw that turns by less does not grip."""
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


@dataclass(frozen=True, eq=False)
class Jaw:
    """A link that closes on the one that carries it.

    Attributes:
        reach: How far it goes beyond its hinge [m].
        fixed: Bodies of the link that carries it which go on beside it, the farthest first.
    """

    reach: float
    fixed: tuple[int, ...]


def with_jaws(tree: KinematicTree, hand: Hand) -> list[Hand]:
    """Return the grippers of one jaw at the ends of a hand's chains, if these are arms or there is one chain; or else the hand."""
    if len(hand.chains) > 1 and hand.length <= MAX_FINGER:
        return [hand]
    own = [s for chain in hand.chains for s in chain]
    found = [_gripper(tree, s, jaw) for s in own if (jaw := jaw_of(tree, s)) is not None]
    return [gripper for gripper in found if gripper.length <= MAX_FINGER] or [hand]


def jaw_of(tree: KinematicTree, segment: int) -> Jaw | None:
    """Return a segment as a jaw; None if it is none.

    It is the only child of its parent, carries nothing, and turns on one hinge. Closed, which is at the end of the hinge's range
    at which it is nearer to its parent's middle, it points away from where its parent is carried, and the parent's surface
    goes on in this direction. A forearm that folds onto its upper arm points to where that is carried.
    """
    parent, joints = tree.parent[segment], tree.joints(segment)
    if not parent or len(joints) != 1 or tree.children(segment) or len(tree.children(parent)) != 1:
        return None
    joint, model = joints[0], tree.model
    is_hinge = int(model.jnt_type[joint]) == _HINGE and bool(model.jnt_limited[joint])
    if not is_hinge or np.ptp(model.jnt_range[joint]) < MIN_BEND or not tree.bodies[segment] or not tree.bodies[parent]:
        return None
    poses = [_posed(tree, joint, float(end)) for end in model.jnt_range[joint]]
    middle = _middle(tree, tree.bodies[parent], poses[0])
    closed = min(poses, key=lambda data: float(np.linalg.norm(_middle(tree, tree.bodies[segment], data) - middle)))
    anchor, axis = closed.xanchor[joint], closed.xaxis[joint]
    along = _middle(tree, tree.bodies[segment], closed) - anchor
    along = along - (along @ axis) * axis
    if np.linalg.norm(along) < 1e-6 or along @ (anchor - _carried_at(tree, parent, closed)) <= 0:
        return None
    along /= np.linalg.norm(along)
    ahead = {b: float(((tree.points(b, closed) - anchor) @ along).max()) for b in (*tree.bodies[segment], *tree.bodies[parent])}
    reach = max(ahead[b] for b in tree.bodies[segment])
    fixed = sorted((b for b in tree.bodies[parent] if ahead[b] >= BESIDE * reach), key=lambda b: (-ahead[b], b))
    return Jaw(reach, tuple(fixed)) if fixed else None


def _gripper(tree: KinematicTree, segment: int, jaw: Jaw) -> Hand:
    own = tree.bodies[segment]
    return Hand(tree.parent[segment], sorted(jaw.fixed), None, [[segment]], own, own, jaw.reach, jaw.fixed[0])


def _posed(tree: KinematicTree, joint: int, value: float) -> mujoco.MjData:
    data = mujoco.MjData(tree.model)
    data.qpos[tree.model.jnt_qposadr[joint]] = value
    mujoco.mj_kinematics(tree.model, data)
    return data


def _middle(tree: KinematicTree, bodies: Sequence[int], data: mujoco.MjData) -> Float[np.ndarray, " 3"]:
    return np.average([tree.centre(b, data) for b in bodies], axis=0, weights=[tree.area[b] for b in bodies])


def _carried_at(tree: KinematicTree, segment: int, data: mujoco.MjData) -> Float[np.ndarray, " 3"]:
    joints = tree.joints(segment)
    return data.xanchor[joints[0]] if joints else data.xpos[segment]
