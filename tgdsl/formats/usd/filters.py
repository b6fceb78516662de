"""Collision filters of a USD stage as pairs of bodies that must not collide: joints, FilteredPairsAPI, CollisionGroup.

Whom a PhysicsFilteredPairsAPI filters is what its schema names, "a body or collision or even articulation" (UsdPhysics'
schema.usda): a collider is that collider; a body is the colliders that it owns, not those of bodies nested below it; the root
of an articulation (PhysicsArticulationRootAPI, "marks the subtree rooted here") is all bodies of the articulation, unless it
is a body itself. The schema says nothing of other prims, so that a filter on or of one is dropped with a warning. Only the
collection of a PhysicsCollisionGroup takes in what is below its members (Usd.CollectionAPI's `expandPrims`).

`newton:selfCollisionEnabled` or `physxArticulation:enabledSelfCollisions` false on an articulation's root keeps all of its
bodies from each other.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

from tgdsl.formats.usd.attributes import SELF_COLLISION, read_attributes
from tgdsl.formats.usd.geoms import Gprim
from tgdsl.formats.usd.joints import Joint
from tgdsl.formats.usd.stage import Prim, Stage

Pair = frozenset[str | None]  # paths of two bodies; None is the world


def exclusions(stage: Stage, joints: Iterable[Joint], geoms: Iterable[Gprim], welded: Iterable[Pair] = ()) -> list[Pair]:
    """Return the pairs of bodies that must not collide, sorted."""
    filters = _Filters(stage, joints, geoms)
    colliders = filters.colliders
    result: set[Pair] = {*welded, *filters.of_joints(), *filters.of_articulations()}
    filtered = filters.of_colliders()
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
    """Filters of a stage, by who says so."""

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
        result = set()
        for joint in self.joints:
            if joint.is_filtering and None not in joint.bodies:
                result.add(frozenset(joint.bodies))
            elif joint.is_filtering and any(target and self._static(target) for target in joint.targets):
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

    def of_colliders(self) -> dict[frozenset[str], Prim]:
        return self._groups() | self._listed_pairs()

    def _listed_pairs(self) -> dict[frozenset[str], Prim]:
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
        result = {body for body in self.colliders if body is not None and (body == root or body.startswith(f"{root}/"))}
        links = [joint.bodies for joint in self.joints if not joint.is_excluded and None not in joint.bodies]
        result |= {body for joint in self.joints if joint.path == root for body in joint.bodies if body is not None}
        while new := {body for pair in links if result & set(pair) for body in pair if body is not None} - result:
            result |= new
        return [body for body in self.colliders if body in result and body is not None]

    def _static(self, path: str) -> bool:
        return any(collider == path or collider.startswith(f"{path}/") for collider in self.colliders.get(None, ()))

    def _groups(self) -> dict[frozenset[str], Prim]:
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
