"""Which body hangs on which: a spanning tree of joints from each articulation's root, and the joints that close loops."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from tgdsl.formats.usd.joints import Joint


@dataclass(frozen=True, eq=False)
class Link:
    """A body's place in the tree.

    Attributes:
        body: Path of the body.
        parent: Path of its parent; None is the world.
        joint: What joins it to its parent, or None if it moves freely (or is moved by hand).
    """

    body: str
    parent: str | None
    joint: Joint | None

    @property
    def is_swapped(self) -> bool:
        """Whether the joint's body 0 is the child."""
        return self.joint is not None and self.joint.bodies[0] == self.body


@dataclass(frozen=True, eq=False)
class Tree:
    """A spanning tree of all bodies.

    Attributes:
        links: By body; a parent comes before its children.
        loops: Joints that are not in the tree.
    """

    links: dict[str, Link]
    loops: tuple[Joint, ...]

    def children(self, parent: str | None) -> tuple[Link, ...]:
        """Return the links that hang on a body, or on the world."""
        return tuple(link for link in self.links.values() if link.parent == parent)


class _Planter:
    """Grows the tree, one group of joined bodies after the other."""

    def __init__(self, kinematic: Mapping[str, bool], joints: Iterable[Joint], roots: Iterable[str]):
        self.kinematic = kinematic
        self.joints = [joint for joint in joints if joint.kind != "free"]
        self.roots = list(roots)
        self.links: dict[str, Link] = {}
        self.kept: list[Joint] = []

    def grown(self) -> Tree:
        waiting = self._groups()
        for group in list(waiting):
            held = [body for body in group if self.kinematic[body]]
            anchors = [joint for joint in self.joints if not joint.is_excluded and _end(joint, None) in group]
            if held or anchors:
                waiting.remove(group)
                anchor = None if held else min(anchors, key=lambda joint: self._rank(joint.path))
                seeds = [Link(body, None, None) for body in held] or [Link(_end(anchor, None) or "", None, anchor)]
                self._grow(seeds)
        while waiting:
            group, seed = self._attached(waiting) or self._afloat(waiting)
            waiting.remove(group)
            self._grow([seed])
        used = {id(link.joint) for link in self.links.values()}
        return Tree(self.links, tuple(joint for joint in self.joints if id(joint) not in used))

    def _rank(self, path: str) -> int:
        """Order what could be a root: marked itself, below something marked, neither."""
        return 0 if path in self.roots else 1 if any(path.startswith(f"{root}/") for root in self.roots) else 2

    def _groups(self) -> list[list[str]]:
        """Return bodies that joints of articulations hold together, in stage order, and keep those joints that are no loops."""
        group_of = {body: [body] for body in self.kinematic}
        for joint in sorted(self.joints, key=_dispensable):
            first, second = joint.bodies
            if first is not None and second is not None and not joint.is_excluded and group_of[first] is not group_of[second]:
                group_of[first] += group_of[second]
                group_of |= dict.fromkeys(group_of[second], group_of[first])
                self.kept.append(joint)
        order = list(self.kinematic)
        return [sorted(group, key=order.index) for group in {id(group): group for group in group_of.values()}.values()]

    def _root(self, group: list[str]) -> tuple[str, bool]:
        """Return the root of a group that is not joined to the world, and whether it is marked as such."""
        marked = [body for body in group if body in self.roots]
        marked += [j.bodies[0] for j in self.joints if j.path in self.roots and j.bodies[0] in group and j.bodies[0]]
        if marked:
            return marked[0], True
        children = {joint.bodies[1] for joint in self.joints if not joint.is_excluded}
        return min(group, key=lambda body: (body in children, self._rank(body))), False

    def _attached(self, waiting: list[list[str]]) -> tuple[list[str], Link] | None:
        """Return a group that hangs on what is planted by a joint outside the articulations alone: that is no loop."""
        for group in waiting:
            root, is_marked = self._root(group)
            for joint in self.joints:
                for parent, body in (joint.bodies, joint.bodies[::-1]):
                    is_planted = parent is None or parent in self.links
                    if joint.is_excluded and is_planted and body in group and body and (body == root or not is_marked):
                        return group, Link(body, parent, joint)
        return None

    def _afloat(self, waiting: list[list[str]]) -> tuple[list[str], Link]:
        group = min(waiting, key=lambda group: not self._root(group)[1])
        return group, Link(self._root(group)[0], None, None)

    def _grow(self, seeds: list[Link]) -> None:
        """Add roots, and breadth first all that hangs on them."""
        self.links |= {seed.body: seed for seed in seeds}
        queue = [seed.body for seed in seeds]
        while queue:
            parent = queue.pop(0)
            for joint in (joint for joint in self.joints if joint in self.kept):
                body = _end(joint, parent)
                if body is not None and body not in self.links:
                    self.links[body] = Link(body, parent, joint)
                    queue.append(body)


def _dispensable(joint: Joint) -> tuple[bool, bool, bool]:
    """Order joints by how much is lost where one closes a loop: a constraint can neither slide, nor be driven or limited."""
    return joint.kind != "slide", joint.drive is None, joint.range is None


def _end(joint: Joint | None, other: str | None) -> str | None:
    """Return the body at the other end of a joint, or None if the joint does not touch that end (or it is the world's)."""
    if joint is None or other not in joint.bodies:
        return None
    return joint.bodies[1] if joint.bodies[0] == other else joint.bodies[0]


def spanning_tree(kinematic: Mapping[str, bool], joints: Iterable[Joint], roots: Iterable[str]) -> Tree:
    """Choose the parent of every body.

    A kinematic body is a root. Else a group of joined bodies hangs on the world by one of its joints to it (by the marked
    one, or one below the marked prim, if there are several); without any, its root is the marked body, or else one that is
    nobody's body 1. Of the joints of a loop, one without drive and limits is left out, the last one in stage order, and a
    prismatic one only if there is no other. Joints that are excluded from articulations are only in the tree where nothing
    else holds a group.

    Args:
        kinematic: All bodies by path in stage order, and whether each is kinematic.
        joints: All joints, in stage order.
        roots: Paths of the prims that are marked as roots of articulations.
    """
    return _Planter(kinematic, joints, roots).grown()
