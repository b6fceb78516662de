"""Which link of a robot is a palm, a finger or a fingertip: guessed from its tree of joints, never from its names.

A segment is what moves as one: a body with all that is fixed to it. A palm is the segment nearest to its tree's root from
which two or more chains with surface branch off; what moves against it is its fingers; a tip is the end of a chain, or, of
a loop closed by an equality, the link farthest from the palm.

Shapes: bodies and segments are MuJoCo's body indices; a segment's is that of its first body.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tgdsl.formats.model import Model

_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """The segments of a robot, and the surface that their bodies carry.

    Attributes:
        model: MuJoCo's model.
        area: Surface of each body that has one [m²].
        centroid: Centre of that surface, in the body's frame [m].
    """

    model: mujoco.MjModel
    area: Mapping[int, float]
    centroid: Mapping[int, Float[np.ndarray, " 3"]]

    @cached_property
    def segment(self) -> list[int]:
        """The segment of each body; what is fixed to the world belongs to the topmost body that it is fixed to."""
        model = self.model
        weld, root = model.body_weldid.tolist(), model.body_rootid.tolist()
        return [w or r for w, r in zip(weld, root, strict=True)]

    @cached_property
    def parent(self) -> dict[int, int]:
        """The parent of each segment; 0 for the first of a tree. In depth-first order."""
        above = self.model.body_parentid
        return {s: self.segment[above[s]] if above[s] else 0 for s in sorted(set(self.segment) - {0})}

    @cached_property
    def bodies(self) -> dict[int, list[int]]:
        """The bodies with surface of each segment."""
        found: dict[int, list[int]] = {segment: [] for segment in self.parent}
        for body in sorted(self.area):
            found[self.segment[body]].append(body)
        return found

    @cached_property
    def carries(self) -> set[int]:
        """The segments that have surface, or whose descendants have."""
        return {above for segment, own in self.bodies.items() if own for above in self.path(segment)}

    def path(self, segment: int) -> list[int]:
        """Return a segment and all above it, upward."""
        found = []
        while segment:
            found.append(segment)
            segment = self.parent[segment]
        return found

    def children(self, segment: int) -> list[int]:
        """Return the children of a segment that have surface."""
        return [child for child, parent in self.parent.items() if parent == segment and child in self.carries]

    def joints(self, segment: int) -> list[int]:
        """Return the joints that move a segment against its parent."""
        first, count = int(self.model.body_jntadr[segment]), int(self.model.body_jntnum[segment])
        return list(range(first, first + count))

    @cached_property
    def loops(self) -> set[tuple[int, int]]:
        """Pairs of segments of one tree that an equality holds together."""
        found = set()
        for i in np.flatnonzero(np.isin(self.model.eq_type, _LOOPS)):
            ids = int(self.model.eq_obj1id[i]), int(self.model.eq_obj2id[i])
            if int(self.model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE):
                ids = tuple(int(self.model.site_bodyid[site]) for site in ids)
            one, two = (self.segment[body] for body in ids)
            if one and two and one != two and self.path(one)[-1] == self.path(two)[-1]:
                found.add((one, two))
        return found


@dataclass(frozen=True, eq=False)
class Hand:
    """Palm, fingers and tips found in a kinematic tree.

    Attributes:
        base: Segment from which the fingers branch off; 0 if that is the world.
        palm: The largest body of it, or None if it has no surface.
        tips: Bodies at the ends of the fingers.
        fingers: All bodies that move against the base, tips included.
        looped: Segments in chains that are closed to loops.
        others: The rest, such as a wrist.
    """

    base: int
    palm: int | None
    tips: list[int]
    fingers: list[int]
    looped: set[int]
    others: list[int] = field(default_factory=list)


def kinematic_tree(robot: Model, area: Mapping[str, float], centroid: Mapping[str, Float[np.ndarray, " 3"]]) -> KinematicTree:
    """Return the tree of a robot.

    Args:
        robot: The robot.
        area: Surface of each body that has one, by name [m²].
        centroid: Centre of that surface in the body's frame, by name [m].
    """
    ids = {name: int(robot.compiled.body(name).id) for name in area}
    return KinematicTree(robot.compiled, {ids[n]: area[n] for n in area}, {ids[n]: centroid[n] for n in area})


def free_standing(tree: KinematicTree) -> list[int]:
    """Return the bodies with surface that are scenery if others are not: single segments, fixed or floating."""
    roots = [segment for segment, parent in tree.parent.items() if not parent]
    single = {root for root in roots if root not in tree.parent.values() and not _is_driven(tree, root)}
    return [] if single >= tree.carries else [body for segment in sorted(single) for body in tree.bodies[segment]]


def _is_driven(tree: KinematicTree, segment: int) -> bool:
    """Return whether a segment has one or two hinges and slides: none stands still, more let it go anywhere."""
    kinds = [int(tree.model.jnt_type[joint]) for joint in tree.joints(segment)]
    return 0 < len(kinds) < 3 and int(mujoco.mjtJoint.mjJNT_FREE) not in kinds


def hands(tree: KinematicTree) -> list[Hand]:
    """Return the hand found in each kinematic tree; trees that a hinge or slide joins to the world make up one hand."""
    left_out = set(free_standing(tree))
    roots = [s for s in tree.children(0) if not left_out.issuperset(tree.bodies[s]) or tree.children(s)]
    straight = [root for root in roots if _is_driven(tree, root) and len(_branchings(tree, root)) == 0]
    found = [_hand(tree, root, [s for s in tree.parent if root in tree.path(s)]) for root in roots if root not in straight]
    if straight:
        found.append(_hand(tree, 0, [s for s in tree.parent if _root(tree, s) in straight]))
    return found


def _root(tree: KinematicTree, segment: int) -> int:
    return tree.path(segment)[-1]


def _branchings(tree: KinematicTree, root: int) -> list[int]:
    return [s for s in tree.parent if root in tree.path(s) and len(tree.children(s)) > 1]


def _hand(tree: KinematicTree, root: int, segments: list[int]) -> Hand:
    branchings = _branchings(tree, root) if root else []
    base = min(branchings, key=lambda s: (len(tree.path(s)), -_area(tree, s)), default=root)
    beyond = [s for s in segments if s != base and (not base or base in tree.path(s))]
    own = tree.bodies[base] if base in branchings else []
    palm = max(own, key=lambda body: (tree.area[body], -body), default=None)
    ends, looped = _ends(tree, base, palm, beyond)
    fingers = [body for s in beyond for body in tree.bodies[s]]
    tips = [body for s in ends for body in _last(tree, s)]
    known = {palm, *fingers}
    others = [body for s in segments for body in tree.bodies[s] if body not in known]
    return Hand(base, palm, sorted(tips), sorted(fingers), looped, sorted(others))


def _area(tree: KinematicTree, segment: int) -> float:
    return sum(tree.area[body] for body in tree.bodies[segment])


def _last(tree: KinematicTree, segment: int) -> list[int]:
    """Return the bodies with surface of a segment that have no other such below them."""
    own = tree.bodies[segment]
    above = set()
    for body in own:
        while (body := int(tree.model.body_parentid[body])) and tree.segment[body] == segment:
            above.add(body)
    return [body for body in own if body not in above]


def _ends(tree: KinematicTree, base: int, palm: int | None, beyond: list[int]) -> tuple[list[int], set[int]]:
    """Return the last segments of all chains, and the segments of chains that are closed to loops."""
    leaves = [s for s in beyond if tree.bodies[s] and not tree.children(s)]
    bound = {s for pair in tree.loops for s in pair}
    place = {s: i for i, s in enumerate(beyond)}
    pairs = [(place[s], place[tree.parent[s]]) for s in beyond if tree.parent[s] in place]
    pairs += [(place[a], place[b]) for a, b in tree.loops if a in place and b in place]
    edges = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    shape = (len(beyond), len(beyond))
    _, chain = connected_components(coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape), directed=False)
    looped = {s for s in beyond if any(chain[place[b]] == chain[place[s]] for b in bound & place.keys())}
    data = mujoco.MjData(tree.model)
    mujoco.mj_kinematics(tree.model, data)
    middle = _world(tree, data, palm) if palm is not None else data.xpos[base]
    ends = []
    for number in range(chain.max(initial=-1) + 1):
        own = [s for s in leaves if chain[place[s]] == number]
        free = [s for s in own if s not in bound]
        far = {s: max(float(np.linalg.norm(_world(tree, data, body) - middle)) for body in tree.bodies[s]) for s in own}
        ends += free or [s for s in own if far[s] > max(far.values()) - 1e-6]
    return sorted(ends), looped


def _world(tree: KinematicTree, data: mujoco.MjData, body: int) -> Float[np.ndarray, " 3"]:
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ tree.centroid[body]
