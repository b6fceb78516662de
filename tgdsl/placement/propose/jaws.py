"""Grippers of one jaw that turns against a fixed one: the link that carries it, and goes on beside it beyond its hinge."""

from __future__ import annotations

import mujoco
import numpy as np

from tgdsl.placement.propose.hands import MAX_FINGER, Hand, KinematicTree

BESIDE = 0.5
"""A fixed jaw reaches beyond the hinge by this share of the moving jaw's reach or more, when closed."""
MIN_BEND, MAX_BEND = np.radians(19.9), np.radians(200.1)
"""A jaw that turns by less does not grip, and what turns by more is a wrist; no angles that people draw."""
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


def with_jaws(tree: KinematicTree, hand: Hand) -> list[Hand]:
    """Return the grippers of one jaw in a hand of one chain, or whose chains are arms; if there are none, the hand."""
    if len(hand.chains) > 1 and hand.length <= MAX_FINGER:
        return [hand]
    results = [gripper for chain in hand.chains for s in chain if (gripper := gripper_of(tree, s)) is not None]
    return [gripper for gripper in results if gripper.length <= MAX_FINGER] or [hand]


def gripper_of(tree: KinematicTree, segment: int) -> Hand | None:
    """Return the gripper of which a segment is the moving jaw; None if it is none.

    A jaw is the only child of its parent, carries nothing, and turns on one hinge. It is closed at the end of the hinge's range
    at which its parent's surface goes on farther in the direction in which it points, which is away from where the parent
    is carried: a forearm that folds onto its upper arm points to there.
    """
    parent, joints, model = tree.parent[segment], tree.joints(segment), tree.model
    if not parent or len(joints) != 1 or tree.children(segment) or len(tree.children(parent)) != 1 or not tree.bodies[parent]:
        return None
    joint = joints[0]
    is_hinge = int(model.jnt_type[joint]) == _HINGE and bool(model.jnt_limited[joint])
    if not is_hinge or not MIN_BEND <= np.ptp(model.jnt_range[joint]) <= MAX_BEND:
        return None
    ends = [_ahead(tree, joint, parent, float(value)) for value in model.jnt_range[joint]]
    own = tree.bodies[segment]
    reach = [max(end[body] for body in own) if end else 0.0 for end in ends]
    share = [max(end[b] for b in tree.bodies[parent]) / r if r > 0 else 0.0 for end, r in zip(ends, reach, strict=True)]
    closed = int(share[1] > share[0])
    if share[closed] < BESIDE:
        return None
    fixed = [body for body in tree.bodies[parent] if ends[closed][body] >= BESIDE * reach[closed]]
    jaw = max(fixed, key=lambda body: (ends[closed][body], -body))
    return Hand(parent, fixed, None, [[segment]], own, own, reach[closed], jaw, 1.0 if closed else -1.0)


def _ahead(tree: KinematicTree, joint: int, parent: int, value: float) -> dict[int, float]:
    """Return how far bodies of a jaw and of its parent reach beyond the hinge in the jaw's direction [m].

    Nothing, if this direction is toward where the parent is carried.
    """
    data, segment = mujoco.MjData(tree.model), tree.segment[int(tree.model.jnt_bodyid[joint])]
    data.qpos[:] = tree.model.qpos0
    data.qpos[tree.model.jnt_qposadr[joint]] = value
    mujoco.mj_kinematics(tree.model, data)
    own, anchor, axis = tree.bodies[segment], data.xanchor[joint], data.xaxis[joint]
    along = tree.middle(segment, data) - anchor
    along = along - (along @ axis) * axis
    above = tree.joints(parent)
    carried_at = data.xanchor[above[0]] if above else data.xpos[parent]
    if np.linalg.norm(along) < 1e-6 or along @ (anchor - carried_at) <= 0:
        return {}
    along /= np.linalg.norm(along)
    return {b: float(((tree.points(b, data) - anchor) @ along).max()) for b in (*own, *tree.bodies[parent])}
