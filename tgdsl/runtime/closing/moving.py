"""Which joints of a scene's hand close it, which are held, and which are left to what couples them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.formats.model import Model
from tgdsl.placement.propose.propose import closing_motion

_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


@dataclass(frozen=True, eq=False)
class Movement:
    """How the hand of a scene moves.

    Shapes: joints and bodies are MuJoCo's indices.

    Attributes:
        model: The scene.
        trees: Topmost bodies of the kinematic trees that carry taxels.
        ends: Open and closed end of each joint that closes the hand and follows no other such, be it by way of others
            [rad, of slides m].
        follows: By joint, those that an equality has follow another: that one, and the polynomial's coefficients.
    """

    model: mujoco.MjModel
    trees: frozenset[int]
    ends: Mapping[int, tuple[float, float]]
    follows: Mapping[int, tuple[int, Float[np.ndarray, " 5"]]]

    @cached_property
    def closing(self) -> tuple[int, ...]:
        """Joints that close the hand, those that follow such included: each after the one that it follows."""
        followers = [joint for joint in self.follows if set(leaders(joint, self.follows)) & self.ends.keys()]
        return (*self.ends, *sorted(followers, key=lambda joint: len(leaders(joint, self.follows))))

    @cached_property
    def hand(self) -> frozenset[int]:
        """Bodies of the smallest subtrees, one of each tree, that hold all that closes; an arm is none of them."""
        result: set[int] = set()
        for tree in {self._root(joint) for joint in self.closing}:
            paths = [self.path(int(self.model.jnt_bodyid[joint])) for joint in self.closing if self._root(joint) == tree]
            common = set.intersection(*map(set, paths))
            above = max(common - {int(self.model.jnt_bodyid[joint]) for joint in self.closing}, default=tree)
            result |= {body for body in range(1, self.model.nbody) if above in self.path(body)}
        return frozenset(result)

    @cached_property
    def num_joints(self) -> int:
        """Number of the hand's hinges and slides, of those that follow another only the ones that close it."""
        wanted = [joint for joint in self.joints if joint in self.ends or joint not in self.follows]
        return sum(self.is_scalar(joint) and int(self.model.jnt_bodyid[joint]) in self.hand for joint in wanted)

    @cached_property
    def joints(self) -> tuple[int, ...]:
        """All joints of the trees."""
        return tuple(joint for joint in range(self.model.njnt) if self._root(joint) in self.trees)

    @cached_property
    def held(self) -> tuple[int, ...]:
        """Joints of the trees that neither close the hand nor follow or lead another that does, nor are in a closed loop."""
        looped = self._looped()
        led = {leader for joint in self.ends for leader in leaders(joint, self.follows)}
        coupled = {*self.ends, *self.follows, *led}
        return tuple(j for j in self.joints if j not in coupled and int(self.model.jnt_bodyid[j]) not in looped)

    @cached_property
    def tips(self) -> tuple[int, ...]:
        """Bodies with geoms below the joints that close, which have no other such below them."""
        below = {int(self.model.jnt_bodyid[joint]) for joint in self.closing}
        moved = {b for b in range(self.model.nbody) if self.model.body_geomnum[b] and below & set(self.path(b))}
        return tuple(sorted(moved - {above for body in moved for above in self.path(body)[1:]}))

    def pose(self, share: float) -> Float[np.ndarray, " qpos"]:
        """Return where the joints are when the hand has closed by a share; all else is at its start."""
        result = self.model.qpos0.copy()
        for joint, (opened, closed) in self.ends.items():
            result[self.model.jnt_qposadr[joint]] = (1.0 - share) * opened + share * closed
        for joint in self.closing[len(self.ends) :]:
            leader, coefficients = self.follows[joint]
            moved = result[self.model.jnt_qposadr[leader]] - self.model.qpos0[self.model.jnt_qposadr[leader]]
            result[self.model.jnt_qposadr[joint]] += np.polynomial.polynomial.polyval(moved, coefficients)
        return result

    def path(self, body: int) -> list[int]:
        """Return a body and all above it but the world, upward."""
        results = []
        while body:
            results.append(body)
            body = int(self.model.body_parentid[body])
        return results

    def is_scalar(self, joint: int) -> bool:
        """Return whether a joint is a hinge or a slide."""
        return int(self.model.jnt_type[joint]) in (_SLIDE, _HINGE)

    def _root(self, joint: int) -> int:
        return int(self.model.body_rootid[self.model.jnt_bodyid[joint]])

    def _looped(self) -> set[int]:
        """Return the bodies between two that an equality holds together, and where their paths upward meet."""
        model, result = self.model, set[int]()
        for i in np.flatnonzero(np.isin(model.eq_type, _LOOPS) & model.eq_active0.astype(bool)):
            ids = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
            if int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE):
                ids = int(model.site_bodyid[ids[0]]), int(model.site_bodyid[ids[1]])
            one, two = (set(self.path(max(body, 0))) for body in ids)
            result |= (one ^ two) if one and two else set()
        return result


def leaders(joint: int, follows: Mapping[int, tuple[int, Float[np.ndarray, " 5"]]]) -> list[int]:
    """Return the joint that one follows, the one that this follows, and so on; `follows` as in `Movement`."""
    results: list[int] = []
    while joint in follows and follows[joint][0] not in results:
        joint = follows[joint][0]
        results.append(joint)
    return results


def movement(scene: Model, bodies: frozenset[str]) -> Movement:
    """Return how the hand of a scene moves whose `bodies` carry sensors; nothing closes if it is not clear how."""
    model = scene.compiled
    trees = frozenset(int(model.body_rootid[model.body(name).id]) for name in bodies) - {0}
    follows = {}
    for i in np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & model.eq_active0.astype(bool)):
        if (leader := int(model.eq_obj2id[i])) >= 0:
            follows[int(model.eq_obj1id[i])] = leader, model.eq_data[i, :5].copy()
    ends = {int(model.joint(name).id): pair for name, pair in closing_motion(scene).items()}
    ends = {joint: pair for joint, pair in ends.items() if int(model.body_rootid[model.jnt_bodyid[joint]]) in trees}
    driven = {joint: pair for joint, pair in ends.items() if not set(leaders(joint, follows)) & ends.keys()}
    return Movement(model, trees, driven, follows)
