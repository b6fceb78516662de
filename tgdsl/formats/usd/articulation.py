"""Articulations: a spanning tree of joints from each articulation's root, and the joints that close loops.

Collision filters of a USD stage as pairs of bodies that must not collide: joints, FilteredPairsAPI, CollisionGroup.

A PhysicsFilteredPairsAPI filters the prims that its schema names, "a body or collision or even articulation" (UsdPhysics'
schema.usda). A collider stands for itself. A body stands for its colliders, without the colliders of nested bodies. The root
of an articulation (PhysicsArticulationRootAPI, "marks the subtree rooted here") stands for all its bodies, unless it is a body
itself. The schema does not define other prims: a filter on or to one is dropped with a warning. Only the collection of a
PhysicsCollisionGroup includes prims below its members (Usd.CollectionAPI's `expandPrims`).

`newton:selfCollisionEnabled` or `physxArticulation:enabledSelfCollisions` false on an articulation's root disables collisions
between its bodies.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations

from tgdsl.formats.usd.attributes import SELF_COLLISION, read_attributes
from tgdsl.formats.usd.geoms import Gprim
from tgdsl.formats.usd.joints import Joint
from tgdsl.formats.usd.stage import Prim, Stage, is_within


@dataclass(frozen=True, eq=False)
class TreeNode:
    """A body and its parent in the spanning tree."""

    body: str  # path of the body
    parent: str | None  # path of its parent; None is the world
    joint: Joint | None  # what joins it to its parent, or None if it floats or is kinematic
    stacked: tuple[Joint, ...] = ()  # joints between the same two bodies that add to its motion, in MuJoCo's order

    @property
    def joints(self) -> tuple[Joint, ...]:
        return () if self.joint is None else (self.joint, *self.stacked)

    def is_swapped(self, joint: Joint) -> bool:
        return joint.bodies[0] == self.body


class SpanningTree:
    """A spanning tree of all bodies.

    A kinematic body is a root. Any other group of joined bodies hangs on the world by one of its joints to it; with several, by
    the marked joint or one below the marked prim. Without any, its root is the marked body, or else one that is no joint's
    body 1. A loop is cut at its last joint in stage order without drive and limits, at a prismatic one only if there is no
    other. Joints excluded from articulations enter the tree only where nothing else holds a group. Joints with MjcJointAPI, or
    in an articulation whose joints add mobility, stack: several between the same bodies are degrees of freedom of one.

    Attributes:
        nodes: By body, depth first and siblings in stage order, which is MuJoCo's order.
        loops: Joints outside the tree: they close a loop, or are equality constraints of MuJoCo.
    """

    def __init__(self, stage: Stage, joints: Iterable[Joint]):
        joints = [joint for joint in joints if joint.kind != "free"]
        self._kinematic, self._joints = stage.kinematic, [joint for joint in joints if not joint.constraint]
        self._roots = [str(prim.GetPath()) for prim in stage.prims if stage.has(prim, "PhysicsArticulationRootAPI")]
        self._closing_none: list[Joint] = []
        self.nodes: dict[str, TreeNode] = {}
        waiting = self._groups()
        for group in list(waiting):
            held = [body for body in group if self._kinematic[body]]
            anchors = [joint for joint in self._joints if not joint.is_excluded and _end(joint, None) in group]
            if held or anchors:
                waiting.remove(group)
                anchor = None if held else min(anchors, key=lambda joint: self._rank(joint.path))
                roots = [TreeNode(body, None, None) for body in held] or [TreeNode(_end(anchor, None) or "", None, anchor)]
                self._extend(roots)
        while waiting:
            floating = min(waiting, key=lambda group: not self._root(group)[1])
            group, root = self._attached(waiting) or (floating, TreeNode(self._root(floating)[0], None, None))
            waiting.remove(group)
            self._extend([root])
        self.nodes = {body: self._stacked(self.nodes[body]) for body in self._depth_first(None)}
        used = {id(joint) for node in self.nodes.values() for joint in node.joints}
        constraints = [joint for joint in joints if joint.constraint]
        self.loops = tuple(joint for joint in (*self._joints, *constraints) if id(joint) not in used)

    def children(self, parent: str | None) -> tuple[TreeNode, ...]:
        return tuple(node for node in self.nodes.values() if node.parent == parent)

    def _depth_first(self, parent: str | None) -> list[str]:
        children = [body for body in self._kinematic if self.nodes[body].parent == parent]
        return [body for child in children for body in (child, *self._depth_first(child))]

    def _stacked(self, node: TreeNode) -> TreeNode:
        """Return a node with all joints that stack on its own, from the parent on."""
        base = node.joint
        if base is None or not base.is_stackable:
            return node
        parallel = [joint for joint in self._joints if joint.is_stackable and set(joint.bodies) == set(base.bodies)]
        first, *rest = parallel[::-1] if node.is_swapped(parallel[0]) else parallel
        return replace(node, joint=first, stacked=tuple(rest))

    def _rank(self, path: str) -> int:
        return 0 if path in self._roots else 1 if any(is_within(path, root) for root in self._roots) else 2

    def _groups(self) -> list[list[str]]:
        """Return connected components over articulated joints, in stage order, and keep the joints that close no loop."""
        group_of = {body: [body] for body in self._kinematic}
        # Cut loops at joints that lose least: an equality constraint can neither slide, nor be driven or limited.
        for joint in sorted(self._joints, key=lambda joint: (joint.kind != "slide", joint.drive is None, joint.range is None)):
            first, second = joint.bodies
            if first is not None and second is not None and not joint.is_excluded and group_of[first] is not group_of[second]:
                group_of[first] += group_of[second]
                group_of |= dict.fromkeys(group_of[second], group_of[first])
                self._closing_none.append(joint)
        order = list(self._kinematic)
        return [sorted(group, key=order.index) for group in {id(group): group for group in group_of.values()}.values()]

    def _root(self, group: list[str]) -> tuple[str, bool]:
        """Return the root of a group that is not joined to the world, and whether it has PhysicsArticulationRootAPI."""
        marked = [body for body in group if body in self._roots]
        marked += [j.bodies[0] for j in self._joints if j.path in self._roots and j.bodies[0] in group and j.bodies[0]]
        if marked:
            return marked[0], True
        children = {joint.bodies[1] for joint in self._joints if not joint.is_excluded}
        return min(group, key=lambda body: (body in children, self._rank(body))), False

    def _attached(self, waiting: list[list[str]]) -> tuple[list[str], TreeNode] | None:
        """Return a group that only a joint excluded from articulations joins to a body of the tree: it closes no loop."""
        for group in waiting:
            root, is_marked = self._root(group)
            for joint in self._joints:
                for parent, body in (joint.bodies, joint.bodies[::-1]):
                    is_placed = parent is None or parent in self.nodes
                    if joint.is_excluded and is_placed and body in group and body and (body == root or not is_marked):
                        return group, TreeNode(body, parent, joint)
        return None

    def _extend(self, roots: list[TreeNode]) -> None:
        """Add roots and, breadth first, their descendants."""
        self.nodes |= {root.body: root for root in roots}
        queue = [root.body for root in roots]
        while queue:
            parent = queue.pop(0)
            for joint in (joint for joint in self._joints if joint in self._closing_none):
                body = _end(joint, parent)
                if body is not None and body not in self.nodes:
                    self.nodes[body] = TreeNode(body, parent, joint)
                    queue.append(body)


def _end(joint: Joint | None, other: str | None) -> str | None:
    if joint is None or other not in joint.bodies:
        return None
    return joint.bodies[1] if joint.bodies[0] == other else joint.bodies[0]


def filtered_pairs(tree: SpanningTree) -> tuple[set[frozenset[str | None]], dict[frozenset[str | None], str]]:
    """Return the pairs of bodies that MuJoCo never collides by itself."""
    group: dict[str | None, str | None] = {None: None}
    above: dict[str, str | None] = {}
    for body, node in tree.nodes.items():
        is_welded = node.joint is not None and node.joint.kind == "fixed"
        group[body] = group[node.parent] if is_welded else body
        if node.joint is not None and not is_welded:
            above[body] = group[node.parent]
    welded: set[frozenset[str | None]] = {frozenset((a, b)) for a, b in combinations(tree.nodes, 2) if group[a] == group[b]}
    children = [(body, root) for body in tree.nodes if (root := group[body]) is not None and above.get(root) is not None]
    return welded, {frozenset((a, b)): root for a, root in children for b in tree.nodes if group[b] == above[root]}


Pair = frozenset[str | None]  # paths of two bodies; None is the world


def exclusions(stage: Stage, joints: Iterable[Joint], geoms: Iterable[Gprim], welded: Iterable[Pair] = ()) -> list[Pair]:
    """Return the pairs of bodies that must not collide, sorted."""
    filters = _Filters(stage, joints, geoms)
    colliders = filters.colliders
    result: set[Pair] = {*welded, *filters.of_joints(), *filters.of_articulations()}
    filtered = filters.of_groups() | filters.listed_pairs()
    owners = [owner for owner, paths in colliders.items() if paths]
    for first, second in combinations(owners, 2) if filtered else ():
        pairs = [frozenset((a, b)) for a in colliders[first] for b in colliders[second]]
        hits = [pair for pair in pairs if pair in filtered]
        if len(hits) == len(pairs):
            result.add(frozenset((first, second)))
        elif hits and frozenset((first, second)) not in result:
            for pair in hits:
                stage.drop("collision filters were dropped that hold for some colliders of a body only", filtered[pair])
    return sorted(result, key=lambda pair: sorted(path or "" for path in pair))


class _Filters:
    """Filters of a stage, by their source."""

    def __init__(self, stage: Stage, joints: Iterable[Joint], geoms: Iterable[Gprim]):
        self.stage = stage
        self.joints = [joint for joint in joints if joint.kind != "free"]
        self.colliders: dict[str | None, list[str]] = {body: [] for body in stage.bodies}
        self.prims: dict[str, Prim] = {}
        for geom in geoms:
            if geom.is_collider:
                self.colliders.setdefault(geom.body, []).append(geom.path)
                self.prims[geom.path] = geom.prim

    def of_joints(self) -> set[Pair]:
        """Return pairs of bodies that a joint keeps apart."""
        result, static = set(), self.colliders.get(None, ())
        for joint in self.joints:
            if joint.is_filtering and None not in joint.bodies:
                result.add(frozenset(joint.bodies))
            elif joint.is_filtering and any(is_within(path, target) for target in joint.targets if target for path in static):
                self.stage.drop(
                    "joints do not keep their bodies from colliding with the static prims that they are attached to", joint.prim
                )
        return result

    def of_articulations(self) -> set[Pair]:
        """Return pairs of bodies of articulations without self-collision."""
        result = set()
        for prim in self.stage.prims:
            is_root = self.stage.has(prim, "PhysicsArticulationRootAPI")
            if is_root and read_attributes(self.stage, prim, SELF_COLLISION).get("self") == "false":
                result |= {frozenset(pair) for pair in combinations(self._articulation(str(prim.GetPath())), 2)}
        return result

    def listed_pairs(self) -> dict[frozenset[str], Prim]:
        stage, sources = self.stage, {}
        for prim in stage.prims:
            if not stage.has(prim, "PhysicsFilteredPairsAPI"):
                continue
            here = self._named(prim, prim)
            for target in stage.targets(prim, "physics:filteredPairs"):
                if not stage.usd.GetPrimAtPath(target):
                    raise stage.error(prim, f"physics:filteredPairs names {target}, which does not exist")
                there = self._named(stage.usd.GetPrimAtPath(target), prim)
                sources |= {frozenset((a, b)): prim for a in here for b in there if a != b}
        return sources

    def _named(self, prim: Prim, source: Prim) -> list[str]:
        """Return the colliders that a prim stands for in a filter that a source has."""
        path = str(prim.GetPath())
        if path in self.colliders:
            return self.colliders[path]
        if path in self.prims:
            return [path]
        if self.stage.has(prim, "PhysicsArticulationRootAPI"):
            return [collider for body in self._articulation(path) for collider in self.colliders[body]]
        if not self.stage.has(prim, "PhysicsCollisionAPI"):  # a collider that is disabled collides with nothing anyway
            self.stage.drop(f"collision filters were dropped of no body, collider or articulation, but {path}", source)
        return []

    def _articulation(self, root: str) -> list[str]:
        """Return the bodies of an articulation: those at and below its root, and all that joints connect with them."""
        result = {body for body in self.colliders if body is not None and is_within(body, root)}
        links = [joint.bodies for joint in self.joints if not joint.is_excluded and None not in joint.bodies]
        result |= {body for joint in self.joints if joint.path == root for body in joint.bodies if body is not None}
        while new := {body for pair in links if result & set(pair) for body in pair if body is not None} - result:
            result |= new
        return [body for body in self.colliders if body in result and body is not None]

    def of_groups(self) -> dict[frozenset[str], Prim]:
        physics, sources = self.stage.pxr.UsdPhysics, {}
        groups = [prim for prim in self.stage.prims if prim.IsA(physics.CollisionGroup)]
        table = physics.CollisionGroup.ComputeCollisionGroupTable(self.stage.usd) if groups else None
        members = {str(group.GetPath()): self._members(group) for group in groups}
        for group in groups:
            for other in groups:
                if table is not None and not table.IsCollisionEnabled(group, other):
                    pairs = ((a, b) for a in members[str(group.GetPath())] for b in members[str(other.GetPath())] if a != b)
                    for pair in pairs:
                        sources.setdefault(frozenset(pair), group)
        return sources

    def _members(self, group: Prim) -> list[str]:
        names = [name for name in group.GetPropertyNames() if name.startswith("collection:colliders")]
        groups = (f"physics:{name}" for name in ("filteredGroups", "invertFilteredGroups", "mergeGroup"))
        self.stage.note(group, *names, *groups)
        query = self.stage.pxr.Usd.CollectionAPI(group, "colliders").ComputeMembershipQuery()
        return [path for path, prim in self.prims.items() if query.IsPathIncluded(prim.GetPath())]
