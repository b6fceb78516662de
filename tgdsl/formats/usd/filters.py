"""Collision filtering of a USD stage (joints, FilteredPairsAPI, CollisionGroup) as pairs of bodies that must not collide."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations

from tgdsl.formats.usd.geoms import Gprim
from tgdsl.formats.usd.joints import Joint
from tgdsl.formats.usd.stage import Prim, Stage

Pair = frozenset[str | None]
"""Paths of two bodies; None is the world."""


def exclusions(stage: Stage, joints: Iterable[Joint], geoms: Iterable[Gprim]) -> list[Pair]:
    """Return the pairs of bodies that must not collide, sorted.

    MuJoCo tells bodies apart, not their colliders: what only holds for some colliders of a body is dropped, with a warning.

    Args:
        stage: The stage.
        joints: All joints.
        geoms: All geoms.
    """
    colliders: dict[str | None, list[str]] = {}
    prims: dict[str, Prim] = {}
    for geom in geoms:
        if geom.is_collider:
            colliders.setdefault(geom.body, []).append(geom.path)
            prims[geom.path] = geom.prim
    found: set[Pair] = set()
    for joint in joints:
        if joint.is_filtering and None not in joint.bodies:
            found.add(frozenset(joint.bodies))
        elif joint.is_filtering and any(target and _below(colliders.get(None, ()), target) for target in joint.targets):
            stage.drop(
                "joints do not keep their bodies from colliding with the static prims that they are attached to", joint.prim
            )
    filtered, sources = _filtered_colliders(stage, prims)
    for first, second in combinations(colliders, 2) if filtered else ():
        pairs = [frozenset((a, b)) for a in colliders[first] for b in colliders[second]]
        hits = [pair for pair in pairs if pair in filtered]
        if len(hits) == len(pairs):
            found.add(frozenset((first, second)))
        elif hits and frozenset((first, second)) not in found:
            for pair in hits:
                stage.drop("collision filters were dropped that hold for some colliders of a body only", sources[pair])
    return sorted(found, key=lambda pair: sorted(path or "" for path in pair))


def _filtered_colliders(stage: Stage, prims: Mapping[str, Prim]) -> tuple[set[frozenset[str]], dict[frozenset[str], Prim]]:
    """Return pairs of colliders that must not collide, and the prim that says so."""
    physics = stage.pxr.UsdPhysics
    sources: dict[frozenset[str], Prim] = {}
    for prim in stage.prims:
        if not prim.HasAPI(physics.FilteredPairsAPI):
            continue
        here = _below(prims, str(prim.GetPath()))
        for target in physics.FilteredPairsAPI(prim).GetFilteredPairsRel().GetForwardedTargets():
            if not stage.usd.GetPrimAtPath(target):
                raise stage.error(prim, f"physics:filteredPairs names {target}, which does not exist")
            there = _below(prims, str(target))
            sources |= {frozenset((a, b)): prim for a in here for b in there if a != b}
    groups = [prim for prim in stage.prims if prim.IsA(physics.CollisionGroup)]
    if groups:
        table = physics.CollisionGroup.ComputeCollisionGroupTable(stage.usd)
        members = {str(group.GetPath()): _members(stage, group, prims) for group in groups}
        for group in groups:
            for other in groups:
                if not table.IsCollisionEnabled(group, other):
                    pairs = ((a, b) for a in members[str(group.GetPath())] for b in members[str(other.GetPath())] if a != b)
                    for pair in pairs:
                        sources.setdefault(frozenset(pair), group)
    return set(sources), sources


def _below(prims: Iterable[str], path: str) -> list[str]:
    return [own for own in prims if own == path or own.startswith(f"{path}/")]


def _members(stage: Stage, group: Prim, prims: Mapping[str, Prim]) -> list[str]:
    collection = stage.pxr.Usd.CollectionAPI(group, "colliders")
    query = collection.ComputeMembershipQuery()
    return [path for path, prim in prims.items() if query.IsPathIncluded(prim.GetPath())]
