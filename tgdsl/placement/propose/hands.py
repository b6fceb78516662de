"""Which link of a robot is a palm, a finger or a fingertip: guessed from its tree of joints, never from its names.

A segment moves as one: a body with all bodies fixed to it, and the free bodies that an equality welds to it. A chain moves
against a segment: a child with all bodies below it, and with the siblings that an equality binds to it in a loop. A hand begins
at the last segment from which two or more chains part. If chains part again within a finger's length (a metacarpal with two
fingers, an arch that carries the fingers while the thumb hangs on the wrist), it begins at the first of these segments. Bodies
before it, such as an arm, and other branches, such as a head, are not part of the hand.

Shapes: bodies and segments are MuJoCo's body indices; a segment's index is its first body's.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tgdsl.formats.model import Model
from tgdsl.surfaces.surface import Surface

TURN = 2.0 * np.pi  # if no hinge turns by more degrees than this, the file most likely gives radians
LEAST = 0.5  # at least one hinge then turns by so many radians
RADIANS_AS_DEGREES = float(np.degrees(1.0))  # factor that corrects radians read as degrees
ASSUMED = np.radians(30.0)
"""Assumed range of a hinge without limits to either side of its start, if no joint with limits closes the hand [rad]."""
_FREE, _HINGE, _SLIDE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "HINGE", "SLIDE"))
_SERVO_BIAS, _FIXED_GAIN = int(mujoco.mjtBias.mjBIAS_AFFINE), int(mujoco.mjtGain.mjGAIN_FIXED)
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def angles_are_misread(model: mujoco.MjModel) -> bool:
    """Return whether no hinge of a robot turns by more than 2π degrees, as if `angle="radian"` were missing in its file."""
    limited = model.jnt_limited.astype(bool)
    spans = np.ptp(model.jnt_range[limited & (model.jnt_type == _HINGE)], axis=1)
    if (limited & (model.jnt_type == _SLIDE)).any() or not len(spans):
        return False
    return bool(RADIANS_AS_DEGREES * spans.max() >= LEAST and spans.max() <= np.radians(TURN) * (1.0 + 1e-9))


def as_meant(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model with corrected joint limits; the same model if its limits are right."""
    servos, is_misread = _servo_limits(model), angles_are_misread(model)
    if not servos and not is_misread:
        return model
    model = copy.copy(model)
    if is_misread:
        for joint in np.flatnonzero(model.jnt_type == _HINGE):
            model.jnt_range[joint] *= RADIANS_AS_DEGREES
            model.qpos0[model.jnt_qposadr[joint]] *= RADIANS_AS_DEGREES
        mujoco.mj_setConst(model, mujoco.MjData(model))  # lengths of tendons at the start
    for joint, (low, high) in servos.items():
        if model.jnt_limited[joint]:
            low, high = max(low, float(model.jnt_range[joint, 0])), min(high, float(model.jnt_range[joint, 1]))
        if low < high:
            model.jnt_limited[joint], model.jnt_range[joint] = 1, (low, high)
    return model


def with_assumed_limits(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model whose hinges without limits turn by `ASSUMED` to either side of their start."""
    model = copy.copy(model)
    hinges = np.flatnonzero((model.jnt_type == _HINGE) & (model.jnt_limited == 0))
    start = model.qpos0[model.jnt_qposadr[hinges]]
    model.jnt_range[hinges] = np.column_stack([start - ASSUMED, start + ASSUMED])
    model.jnt_limited[hinges] = 1
    return model


def _servo_limits(model: mujoco.MjModel) -> dict[int, tuple[float, float]]:
    """Return between which values position servos set hinges and slides [rad, of slides m]."""
    result: dict[int, tuple[float, float]] = {}
    for i in range(model.nu):
        joint, gear, bias = int(model.actuator_trnid[i, 0]), float(model.actuator_gear[i, 0]), model.actuator_biasprm[i]
        is_servo = int(model.actuator_biastype[i]) == _SERVO_BIAS and int(model.actuator_gaintype[i]) == _FIXED_GAIN
        is_servo = is_servo and int(model.actuator_trntype[i]) in _ON_JOINT and bool(model.actuator_ctrllimited[i])
        if is_servo and bias[1] < 0.0 and gear != 0.0 and int(model.jnt_type[joint]) in (_HINGE, _SLIDE):
            # The servo rests where gain · control + bias₀ + bias₁ · gear · position vanishes.
            force = model.actuator_gainprm[i, 0] * model.actuator_ctrlrange[i] + bias[0]
            low, high = sorted((-force / (bias[1] * gear)).tolist())
            result[joint] = low, high
    return result


MAX_FINGER = 0.35  # a longer chain is an arm or a leg, which does not close [m]
MAX_STEM = 1.5  # largest stem of a hand, in lengths of the longest chain beyond it
MIN_TIP = 0.1  # least surface of a fingertip, as a share of the largest body fixed to it
JAW_REACH = 0.5  # a fixed jaw reaches beyond the hinge by this share of the moving jaw's reach or more, when closed
MIN_JAW_TURN, MAX_JAW_TURN = np.radians(19.9), np.radians(200.1)
"""A jaw that turns by less does not grip, and a hinge that turns by more is a wrist; no angles that occur in drawings."""
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """The segments of a robot, and the surface that their bodies carry."""

    model: mujoco.MjModel  # MuJoCo's model, with the limits of its joints as they are meant
    surface: Mapping[int, Surface]  # surface of each body that has one, in the body's frame
    doubt: str = ""  # what speaks against the limits of its joints; empty if nothing does

    @cached_property
    def area(self) -> dict[int, float]:
        """Surface of each body that has one [m²]; at most its convex hull's, as geoms may overlap."""
        return {body: min(float(surface.face_areas.sum()), surface.hull_area) for body, surface in self.surface.items()}

    @cached_property
    def centroid(self) -> dict[int, Float[np.ndarray, " 3"]]:
        """Centre of that surface, in the body's frame [m]."""
        return {
            b: surface.face_areas @ surface.corners.mean(axis=1) / surface.face_areas.sum()
            for b, surface in self.surface.items()
        }

    @cached_property
    def segment(self) -> list[int]:
        return [self.welded.get(s, s) for s in _rigid(self.model)]

    @cached_property
    def welded(self) -> dict[int, int]:
        """Free bodies with an active weld to a robot's link, each with that link's segment."""
        model, segment = self.model, _rigid(self.model)
        carrying = {segment[above] for above in model.body_parentid[segment].tolist()}
        free = set(model.jnt_bodyid[model.jnt_type == _FREE].tolist()) - carrying
        result = {}
        for i in np.flatnonzero((model.eq_type == _LOOPS[1]) & (model.eq_active0 != 0)).tolist():
            one, two = (segment[body] for body in self.bound_bodies(i))
            result |= {a: b for a, b in ((one, two), (two, one)) if a in free and b and b not in free}
        return result

    def carry_welded(self, data: mujoco.MjData) -> None:
        """Move the welded bodies with their links."""
        for body, segment in enumerate(_rigid(self.model) if self.welded else ()):
            if (host := self.welded.get(segment)) is not None:
                then, now = (state.xmat[host].reshape(3, 3) for state in (self.start, data))
                data.xpos[body] = data.xpos[host] + now @ then.T @ (self.start.xpos[body] - self.start.xpos[host])
                data.xmat[body] = (now @ then.T @ self.start.xmat[body].reshape(3, 3)).ravel()

    @cached_property
    def parent(self) -> dict[int, int]:
        above = self.model.body_parentid
        return {s: self.segment[above[s]] if above[s] else 0 for s in sorted(set(self.segment) - {0})}

    @cached_property
    def bodies(self) -> dict[int, list[int]]:
        """The bodies with surface of each segment."""
        result: dict[int, list[int]] = {segment: [] for segment in self.parent}
        for body in sorted(self.surface):
            result[self.segment[body]].append(body)
        return result

    @cached_property
    def carries(self) -> set[int]:
        return {above for segment, bodies in self.bodies.items() if bodies for above in self.path(segment)}

    def path(self, segment: int) -> list[int]:
        """Return a segment and all above it, upward."""
        results = []
        while segment:
            results.append(segment)
            segment = self.parent[segment]
        return results

    def children(self, segment: int) -> list[int]:
        return [child for child, parent in self.parent.items() if parent == segment and child in self.carries]

    def below(self, segment: int) -> list[int]:
        return [s for s in self.parent if s != segment and (not segment or segment in self.path(s))]

    def joints(self, segment: int) -> list[int]:
        first, count = int(self.model.body_jntadr[segment]), int(self.model.body_jntnum[segment])
        return list(range(first, first + count))

    @cached_property
    def loops(self) -> set[tuple[int, int]]:
        """Pairs of segments of one tree that an active equality holds together."""
        result = set()
        for i in np.flatnonzero(np.isin(self.model.eq_type, _LOOPS) & (self.model.eq_active0 != 0)):
            one, two = (self.segment[body] for body in self.bound_bodies(int(i)))
            if one and two and one != two and self.path(one)[-1] == self.path(two)[-1]:
                result.add((one, two))
        return result

    def bound_bodies(self, equality: int) -> tuple[int, int]:
        """Return the bodies that a connect or weld holds together."""
        model = self.model
        ids = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        if int(model.eq_objtype[equality]) == int(mujoco.mjtObj.mjOBJ_SITE):
            return int(model.site_bodyid[ids[0]]), int(model.site_bodyid[ids[1]])
        return ids

    @cached_property
    def start(self) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, data)
        return data

    def centre(self, body: int, data: mujoco.MjData) -> Float[np.ndarray, " 3"]:
        """Return the centre of a body's surface in the world [m]."""
        return data.xpos[body] + data.xmat[body].reshape(3, 3) @ self.centroid[body]

    def within(self, segment: int, body: int) -> list[int]:
        """Return a body of a segment and those above it in the same segment, upward."""
        results = []
        while body and self.segment[body] == segment:
            results.append(body)
            body = int(self.model.body_parentid[body])
        return results

    def middle(self, segment: int, data: mujoco.MjData) -> Float[np.ndarray, " 3"]:
        """Return the centre of the surfaces of a segment's bodies in the world [m]."""
        bodies = self.bodies[segment]
        return np.average([self.centre(body, data) for body in bodies], axis=0, weights=[self.area[body] for body in bodies])

    def points(self, body: int, data: mujoco.MjData) -> Float[np.ndarray, "corner 3"]:
        """Return the corners of a body's surface in the world [m]."""
        surface = self.surface[body]
        return data.xpos[body] + surface.vertices[np.unique(surface.faces)] @ data.xmat[body].reshape(3, 3).T


@dataclass(frozen=True, eq=False)
class Hand:
    """Palm, fingers and tips found in a kinematic tree."""

    base: int  # segment from which the chains part; 0 if that is the world
    mounts: list[int]  # the base's bodies that have surface, without bodies before the one from which the chains part
    palm: int | None  # the largest mount, preferably one that carries all chains; None without a mount or with one chain
    chains: list[list[int]]  # segments of each chain
    tips: list[int]  # bodies at the ends of the chains
    fingers: list[int]  # all bodies that move against the base, tips included
    length: float  # length of the longest chain [m]
    jaw: int | None = None  # for a gripper with one moving jaw, the body of the base on which it closes
    closes: float = 0.0  # the end of its range, ±1, toward which the moving jaw closes; 0 for other hands


def kinematic_tree(robot: Model, surface: Mapping[str, Surface]) -> KinematicTree:
    model = as_meant(robot.compiled)
    return KinematicTree(model, {int(model.body(name).id): mesh for name, mesh in surface.items()})


def _rigid(model: mujoco.MjModel) -> list[int]:
    return [w or r for w, r in zip(model.body_weldid.tolist(), model.body_rootid.tolist(), strict=True)]


def free_standing(tree: KinematicTree) -> list[int]:
    roots = [segment for segment, parent in tree.parent.items() if not parent]
    single = {root for root in roots if root not in tree.parent.values() and not _is_driven(tree, root)}
    return [] if single >= tree.carries else [body for segment in sorted(single) for body in tree.bodies[segment]]


def loose_parts(tree: KinematicTree) -> list[int]:
    """Return the bodies that mark a place in the air: all bodies fixed to them are farther away than twice their size."""
    result = []
    for segment, bodies in tree.bodies.items():
        if len(bodies) < 2:
            continue
        placed = [tree.points(body, tree.start) @ tree.start.xmat[segment].reshape(3, 3) for body in bodies]
        boxes = [(points.min(axis=0), points.max(axis=0)) for points in placed]
        largest = max(tree.area[body] for body in bodies)
        for body, (low, high) in zip(bodies, boxes, strict=True):
            gaps = [np.linalg.norm(np.maximum(np.maximum(a - high, low - b), 0.0)) for a, b in boxes if a is not low]
            if tree.area[body] < largest and min(gaps) > 2.0 * np.linalg.norm(high - low):
                result.append(body)
    return result


def _is_driven(tree: KinematicTree, segment: int) -> bool:
    kinds = [int(tree.model.jnt_type[joint]) for joint in tree.joints(segment)]
    return 0 < len(kinds) < 3 and _FREE not in kinds


def hands(tree: KinematicTree) -> list[Hand]:
    """Return the candidates for hands; trees that a hinge or slide joins to the world make up one."""
    left_out = set(free_standing(tree))
    roots = [s for s in tree.children(0) if not left_out.issuperset(tree.bodies[s]) or tree.children(s)]
    bases = {root: _bases(tree, [root, *tree.below(root)]) for root in roots}
    straight = [root for root in roots if _is_driven(tree, root) and not bases[root]]
    results = [_hand(tree, base) for root in roots if root not in straight for base in bases[root] or [root]]
    if straight:
        results.append(_hand(tree, 0, [s for root in straight for s in (root, *tree.below(root))]))
    return [gripper for hand in results for gripper in _with_jaws(tree, hand)]


def _with_jaws(tree: KinematicTree, hand: Hand) -> list[Hand]:
    """Return the grippers with one jaw in a hand that has one chain or arms for chains; the hand if there are none."""
    if len(hand.chains) > 1 and hand.length <= MAX_FINGER:
        return [hand]
    results = [gripper for chain in hand.chains for s in chain if (gripper := _gripper_of(tree, s)) is not None]
    return [gripper for gripper in results if gripper.length <= MAX_FINGER] or [hand]


def _gripper_of(tree: KinematicTree, segment: int) -> Hand | None:
    """Return the gripper whose moving jaw is a segment; None if it is no jaw."""
    parent, joints, model = tree.parent[segment], tree.joints(segment), tree.model
    if not parent or len(joints) != 1 or tree.children(segment) or len(tree.children(parent)) != 1 or not tree.bodies[parent]:
        return None
    joint = joints[0]
    is_hinge = int(model.jnt_type[joint]) == _HINGE and bool(model.jnt_limited[joint])
    if not is_hinge or not MIN_JAW_TURN <= np.ptp(model.jnt_range[joint]) <= MAX_JAW_TURN:
        return None
    ends = [_ahead(tree, joint, parent, float(value)) for value in model.jnt_range[joint]]
    bodies = tree.bodies[segment]
    reach = [max(end[body] for body in bodies) if end else 0.0 for end in ends]
    share = [max(end[b] for b in tree.bodies[parent]) / r if r > 0 else 0.0 for end, r in zip(ends, reach, strict=True)]
    closed = int(share[1] > share[0])
    if share[closed] < JAW_REACH:
        return None
    fixed = [body for body in tree.bodies[parent] if ends[closed][body] >= JAW_REACH * reach[closed]]
    jaw = max(fixed, key=lambda body: (ends[closed][body], -body))
    return Hand(parent, fixed, None, [[segment]], bodies, bodies, reach[closed], jaw, 1.0 if closed else -1.0)


def _ahead(tree: KinematicTree, joint: int, parent: int, value: float) -> dict[int, float]:
    """Return the reach of a jaw's and its parent's bodies beyond the hinge in the jaw's direction [m]."""
    data, segment = mujoco.MjData(tree.model), tree.segment[int(tree.model.jnt_bodyid[joint])]
    data.qpos[:] = tree.model.qpos0
    data.qpos[tree.model.jnt_qposadr[joint]] = value
    mujoco.mj_kinematics(tree.model, data)
    bodies, hinge, axis = tree.bodies[segment], data.xanchor[joint], data.xaxis[joint]
    along = tree.middle(segment, data) - hinge
    along = along - (along @ axis) * axis
    above = tree.joints(parent)
    carried_at = data.xanchor[above[0]] if above else data.xpos[parent]
    if np.linalg.norm(along) < 1e-6 or along @ (hinge - carried_at) <= 0:
        return {}
    along /= np.linalg.norm(along)
    return {b: float(((tree.points(b, data) - hinge) @ along).max()) for b in (*bodies, *tree.bodies[parent])}


def _bases(tree: KinematicTree, segments: Sequence[int]) -> list[int]:
    """Return the segments at which hands begin, the deepest first."""
    parting = [s for s in segments if len(_chains(tree, tree.below(s))) > 1]
    parting = parting or [s for s in segments if len(tree.children(s)) > 1][:1]  # a rod that moves all fingers binds them
    results: list[int] = []
    for s in sorted(parting, key=lambda s: len(tree.path(s)), reverse=True):
        below = [base for base in results if s in tree.path(base)]
        if all(_parts_within(tree, s, base) for base in below):
            results = [s, *(base for base in results if base not in below)]
    return results


def _parts_within(tree: KinematicTree, base: int, other: int) -> bool:
    """Return whether chains part at another segment within a hand that begins at a base."""
    stem = tree.path(other)[: tree.path(other).index(base)]
    starts = [anchor(tree, child) for child in tree.children(other)]
    points = [*(anchor(tree, s) for s in reversed(stem)), np.mean(starts, axis=0)]
    longest = max(length_of(tree, child) for child in tree.children(other))
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) <= MAX_STEM * longest


def length_of(tree: KinematicTree, segment: int) -> float:
    """Return the length from a segment's joint to the far end of the bodies that it carries [m]."""
    distances = [float(np.linalg.norm(tree.centre(b, tree.start) - anchor(tree, segment))) for b in tree.bodies[segment]]
    reach = [distance + 0.5 * tree.area[b] ** 0.5 for distance, b in zip(distances, tree.bodies[segment], strict=True)]
    for child in tree.children(segment):
        stem = float(np.linalg.norm(anchor(tree, child) - anchor(tree, segment)))
        reach.append(stem + length_of(tree, child))
    return max(reach, default=0.0)


def anchor(tree: KinematicTree, segment: int) -> Float[np.ndarray, " 3"]:
    """Return where a segment moves against its parent, in the world [m]."""
    joints = tree.joints(segment)
    return tree.start.xanchor[joints[0]] if joints else tree.start.xpos[segment]


def _hand(tree: KinematicTree, base: int, segments: Sequence[int] | None = None) -> Hand:
    beyond = tree.below(base) if segments is None else list(segments)
    mounts = _mounts(tree, base) if base else []
    chains = _chains(tree, beyond)
    if len(tree.children(base)) > 1 or not base:
        above = [tree.within(base, int(tree.model.body_parentid[child])) for child in tree.children(base) if base]
        common = [body for body in mounts if all(body in path for path in above)]
        palm = max(common or mounts, key=lambda body: (tree.area[body], -body), default=None)
    else:
        palm = None
    middle = tree.centre(palm, tree.start) if palm is not None else tree.start.xpos[base]
    ends = [s for chain in chains for s in _ends(tree, base, chain, middle)]
    fingers = sorted(body for s in beyond for body in tree.bodies[s])
    tips = sorted(body for s in ends for body in _last(tree, s))
    first = [s for s in beyond if tree.parent[s] not in beyond]
    return Hand(base, mounts, palm, chains, tips, fingers, max((length_of(tree, s) for s in first), default=0.0))


def _mounts(tree: KinematicTree, base: int) -> list[int]:
    """Return the bodies of a segment with surface, without the ones before the body that carries its chains."""
    above = [tree.within(base, int(tree.model.body_parentid[child])) for child in tree.children(base)]
    if len(above) < 2:
        return tree.bodies[base]
    common = [body for body in above[0] if all(body in path for path in above)]
    for body in common:  # upward, to the first with surface
        if bodies := [b for b in tree.bodies[base] if body in tree.within(base, b)]:
            return bodies
    return []


def _last(tree: KinematicTree, segment: int) -> list[int]:
    """Return the bodies of a segment that have no other below them; small parts of it, such as markers, do not count."""
    largest = max(tree.area[body] for body in tree.bodies[segment])
    bodies = [body for body in tree.bodies[segment] if tree.area[body] >= MIN_TIP * largest]
    above = {over for body in bodies for over in tree.within(segment, body)[1:]}
    return [body for body in bodies if body not in above]


def _chains(tree: KinematicTree, beyond: Sequence[int]) -> list[list[int]]:
    """Return the segments of each chain that has surface."""
    place = {s: i for i, s in enumerate(beyond)}
    pairs = [(place[s], place[tree.parent[s]]) for s in beyond if tree.parent[s] in place]
    pairs += [(place[a], place[b]) for a, b in tree.loops if a in place and b in place]
    edges = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    shape = (len(beyond), len(beyond))
    count, chain = connected_components(coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape), directed=False)
    results = [[s for s in beyond if chain[place[s]] == number] for number in range(count)]
    return [segments for segments in results if tree.carries.intersection(segments)]


def _ends(tree: KinematicTree, base: int, chain: Sequence[int], middle: Float[np.ndarray, " 3"]) -> list[int]:
    """Return the last segments of a chain: none next to them is more joints from the base; of those in loops the farthest."""
    steps = _steps(tree, base, chain)
    carrying = [s for s in chain if tree.bodies[s]]
    last = [s for s in carrying if not any(steps[other] > steps[s] for other in _joined(tree, s) if other in steps)]
    bound = {s for pair in tree.loops for s in pair}
    far = {s: max(float(np.linalg.norm(tree.centre(b, tree.start) - middle)) for b in tree.bodies[s]) for s in last}
    return [s for s in last if s not in bound] or [s for s in last if far[s] > max(far.values()) - 1e-6]


def _joined(tree: KinematicTree, segment: int) -> list[int]:
    across = [pair[1 - pair.index(segment)] for pair in tree.loops if segment in pair]
    return [tree.parent[segment], *tree.children(segment), *across]


def _steps(tree: KinematicTree, base: int, chain: Sequence[int]) -> dict[int, int]:
    """Return the least number of joints between the base and each segment of a chain."""
    of_base = [s for s in chain if tree.parent[s] not in chain or (s, base) in tree.loops or (base, s) in tree.loops]
    steps, front = dict.fromkeys(of_base, 1), of_base
    while front:
        beyond = [other for s in front for other in _joined(tree, s) if other in chain and other not in steps]
        steps |= dict.fromkeys(beyond, steps[front[0]] + 1)
        front = list(dict.fromkeys(beyond))
    return steps
