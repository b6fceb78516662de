"""Contact depth: how deep a probe is in which object, which way is out, how that moves; and distances to surfaces.

`depth_search` computes it; this file plans it, gathers it from the state and defines it in float64, one point at a time in the
world frame.

Shapes: `taxel` probes, `object` felt objects, `geom` geoms of an object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import BakeError
from tgdsl.geometry.planes import vec
from tgdsl.geometry.reference import TIE
from tgdsl.geometry.shapes import SHAPES
from tgdsl.quantities.base import Planning, Quantity, Scene, Use, pairs_for
from tgdsl.quantities.depth_search import (
    ContactDepth,
    ObjectDistance,
    Penetration,
    Probes,
    Target,
    is_searchable,
    measure,
    penetration,
    search,
)
from tgdsl.quantities.geoms import Geoms, GeomTable, ReferenceGeom, account_of_geoms, distance_to, geoms_of, object_geoms
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.reference import ReferenceBody, ReferenceScene
from tgdsl.quantities.search_tables import geom_tables
from tgdsl.tensors.env_ids import is_cheap_to_read

Tables = Mapping[str, GeomTable[np.ndarray]]


Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class SearchPart(Generic[Array]):
    """What a GPU's search for the deepest geom is given that is the same at all calls: see `search.Tables`."""

    pair: Array  # index of each probe's pair with each object among all pairs, (object, taxel)
    spheres: Array | None  # bounds of the objects, (1, object, 2); None where they differ between environments
    geoms: Array | None  # their geoms, (1, geom, row); None in the same case


@dataclass(frozen=True, eq=False)
class ProbeQuery(Generic[Array]):
    """Probes whose distances are computed once, however many uses share them."""

    objects: tuple[int, ...]  # the objects that they are measured against: indices into the Plan's
    pos: Array  # where the probes are in their links' bodies' frames [m], (3, taxel)
    pair: Array  # index of each probe's pair with each object among that object's pairs, (object, taxel)


@dataclass(frozen=True, eq=False)
class DepthUse(Generic[Array]):
    """One request: the objects of a query that count, and how."""

    query: int  # number of its query
    objects: tuple[int, ...]  # which of that one's objects
    is_gated: bool  # whether they count only in contact
    wants: tuple[str, ...]  # further results: "distance", "frame", "motion", "normal"
    radius_noise: str  # the sensor whose noise disturbs the radii, if any
    reach: Array  # how far each probe feels each object [m], (object, taxel); −∞ where it does not
    search: SearchPart[Array] | None  # what a search by a kernel is given; None where it is of no use


@dataclass(frozen=True, eq=False)
class ContactDepthPart(Generic[Array]):
    """All of it."""

    geoms: tuple[GeomTable[Array] | None, ...]  # geoms of the Plan's objects; None of one that nothing is measured against
    queries: tuple[ProbeQuery[Array], ...]  # the queries
    uses: tuple[DepthUse[Array], ...]  # the uses


FAR = 1e6  # numbers of poses up to this [m] have distances that are numbers, in float32 too


def _are_closed(scene: Scene) -> bool:
    """Return whether no pair is in contact, and nothing is so far away or no number that a closed gate would not hide it."""
    pairs = scene.pairs
    if pairs is None or pairs.gate is None or not is_cheap_to_read(pairs.gate) or not bool((pairs.gate == -torch.inf).all()):
        return False
    sizes = scene.tensors.get("object_size", pairs.gate[:, :0])
    return bool((torch.stack([*pairs.rotation, *pairs.offset]).abs() < FAR).all() and sizes.isfinite().all())


def _searched(use: DepthUse[Tensor], probes: Probes, targets: list[Target], scene: Scene) -> Penetration | None:
    """Return the answer of a kernel's search; None where it cannot run."""
    if use.search is None:
        return None
    tables = {name: value for name in ("pair", "spheres", "geoms") if (value := getattr(use.search, name)) is not None}
    searched = [targets[o] for o in use.objects]
    return search(pairs_for(scene, use.is_gated), probes, searched, tables, _reach(use, scene), use.wants)


def _reach(use: DepthUse[Tensor], scene: Scene) -> Tensor:
    """Return how far each probe feels each object [m]: (object, taxel), or (object, env, taxel) with noise."""
    if not use.radius_noise:
        return use.reach
    radius, shift = use.reach[:, None], scene.radius_shifts[use.radius_noise]
    return torch.where(radius > -torch.inf, torch.clamp(radius + shift, min=0), -torch.inf)


@dataclass(frozen=True, eq=False)
class ReferencePenetration:
    """What a sensor's probes feel, in their links' frames: the fields of `Penetration`, one row per taxel.

    `distance` [m] and its gradient `outward` have one column per object, as in `distances`; so have `rotation` and `offset`,
    as in `frames`.
    """

    depth: Float[np.ndarray, " taxel"]
    normal: Float[np.ndarray, "taxel 3"]
    velocity: Float[np.ndarray, "taxel 3"]
    angular: Float[np.ndarray, "taxel 3"]
    distance: Float[np.ndarray, "taxel object"]
    outward: Float[np.ndarray, "taxel object 3"]
    rotation: Float[np.ndarray, "taxel object 3 3"]
    offset: Float[np.ndarray, "taxel object 3"]


def _reference_penetration(
    link: ReferenceBody,
    pos: Float[np.ndarray, "taxel 3"],
    radius: Float[np.ndarray, " taxel"],
    objects: Sequence[tuple[ReferenceBody, Sequence[ReferenceGeom]] | None],
) -> ReferencePenetration:
    """Query the probes of one link against the objects that it may feel; None stands for one that it may not.

    The paper's: q = p_L + R_L x, d = max(0, max_g (R − φ_g(q))), m = ∇φ at the deepest geom, v = R_Lᵀ (v_C(q) − v_L(q)).
    """
    normal, velocity, angular = np.zeros((3, len(pos), 3))
    distance, outward = np.full((len(pos), len(objects)), np.inf), np.zeros((len(pos), len(objects), 3))
    rotations, offsets = np.zeros((len(pos), len(objects), 3, 3)), np.zeros((len(pos), len(objects), 3))
    felt = ReferencePenetration(np.zeros(len(pos)), normal, velocity, angular, distance, outward, rotations, offsets)
    into_link = link.rotation.T
    for j, x in enumerate(pos):
        q = link.pos + link.rotation @ x
        for k, target in enumerate(objects):
            if target is None or radius[j] == -np.inf:
                continue
            body, geoms = target
            felt.rotation[j, k] = body.rotation.T @ link.rotation
            felt.offset[j, k] = body.rotation.T @ (link.pos - body.pos)
            felt.distance[j, k], gradient = distance_to(geoms, body.rotation.T @ (q - body.pos))
            felt.outward[j, k] = into_link @ body.rotation @ gradient
            depth, deepest = radius[j] - felt.distance[j, k], felt.depth[j]
            felt.depth[j] = max(depth, deepest)
            if depth > (deepest + TIE if deepest > 0 else 0.0):
                felt.normal[j] = felt.outward[j, k]
                felt.velocity[j] = into_link @ (body.velocity_at(q) - link.velocity_at(q))
                felt.angular[j] = into_link @ (body.angvel - link.angvel)
    return felt


def _shown(part: ContactDepthPart[np.ndarray], o: int, objects: Sequence[PairedObject]) -> str:
    """Return an object's name and geoms."""
    table, target = part.geoms[o], objects[o]
    if table is None:
        return target.name
    variants = [f"{target.num_variants} variants"] if target.num_variants > 1 else []
    size = ["its size given per environment"] if target.is_sized else []
    return f"{target.name} ({', '.join([*table.shapes, *variants, *size])})"


class _ContactDepth(Quantity):
    name, request, part = "contact_depth", ContactDepth, ContactDepthPart

    def plan(self, planning: Planning, uses: Sequence[Use]) -> ContactDepthPart[np.ndarray]:
        """Return the part of the Plan; an object whose mesh no grid within its budget suits is a mistake."""
        tables = {}
        for name in planning.sensed:
            table = _table(planning, name, uses)
            if table is not None:
                tables[name] = table
        queries: dict[int, list[Use]] = {}
        for use in uses:
            queries.setdefault(id(use.pos), []).append(use)
        parts, part_of = [], {}
        for number, group in enumerate(queries.values()):
            query, use_parts = _query(planning, number, group, tables)
            parts.append(query)
            part_of |= {id(use): part for use, part in zip(group, use_parts, strict=True)}
        return ContactDepthPart(
            geoms=tuple(tables.get(target.name) for target in planning.objects),
            queries=tuple(parts),
            uses=tuple(part_of[id(use)] for use in uses),
        )

    def gather(self, part: ContactDepthPart[Tensor], scene: Scene) -> tuple[Penetration, ...]:
        targets = {
            i: Target(target, object_geoms(geoms, target, scene))
            for i, (target, geoms) in enumerate(zip(scene.objects, part.geoms, strict=True))
            if geoms is not None
        }
        measured: dict[int, tuple[ObjectDistance, ...]] = {}
        result, are_closed = [], _are_closed(scene)
        for use in part.uses:
            query = part.queries[use.query]
            probes, felt = Probes(vec(query.pos.unbind()), query.pair), [targets[o] for o in query.objects]
            if are_closed and use.is_gated and not {"distance", "frame"} & {*use.wants}:  # as right after a reset
                result.append(penetration(pairs_for(scene, True), probes, (), use.reach[:0], use.wants))
                continue
            answer = _searched(use, probes, felt, scene)
            if answer is None:
                if use.query not in measured:
                    measured[use.query] = measure(pairs_for(scene, True), probes, felt)
                near = [measured[use.query][o] for o in use.objects]
                answer = penetration(pairs_for(scene, use.is_gated), probes, near, _reach(use, scene), use.wants)
            result.append(answer)
        return tuple(result)

    def reference(self, part: ContactDepthPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferencePenetration:
        use_part, layout = part.uses[use], scene.layout
        radius = use_part.reach[:, scene.rows].max(axis=0, initial=-np.inf)
        results = []
        for i, link in enumerate(layout.links):
            objects: list[tuple[ReferenceBody, list[ReferenceGeom]] | None] = []
            for o in (part.queries[use_part.query].objects[o] for o in use_part.objects):
                target, table = scene.objects[o], part.geoms[o]
                assert table is not None
                is_felt = target.body != link.body and (scene.is_touching(link.body, target.name) or not use_part.is_gated)
                geoms = geoms_of(table, scene.variant(target), scene.size(target))
                objects.append((scene.object_body(target), geoms) if is_felt else None)
            at = layout.link_id == i
            results.append(_reference_penetration(scene.body(link.body), layout.pos[at], radius[at], objects))
        names = ReferencePenetration.__dataclass_fields__
        return ReferencePenetration(**{name: np.concatenate([getattr(one, name) for one in results]) for name in names})

    def fields(self, part: ContactDepthPart) -> set[str]:
        is_moving = any("motion" in use.wants for use in part.uses)
        is_gated = any(use.is_gated for use in part.uses)
        return {*(["body_linvel", "body_angvel"] if is_moving else []), *(["contact_found"] if is_gated else [])}

    def is_light(self, part: ContactDepthPart) -> bool:
        shapes = {shape for table in part.geoms if table is not None for shape in table.shapes}
        return shapes <= SHAPES.keys() and all(set(use.wants) <= {"distance"} for use in part.uses)

    def explain(self, part: ContactDepthPart[np.ndarray], use: int, objects: Sequence[PairedObject]) -> list[str]:
        use_part = part.uses[use]
        query = part.queries[use_part.query]
        gate = "where MuJoCo has the pair in contact" if use_part.is_gated else "wherever a probe reaches"
        extra = " with " + " and ".join(use_part.wants) if use_part.wants else ""
        felt = [_shown(part, query.objects[o], objects) for o in use_part.objects]
        return [
            f"depth of {query.pos.shape[1]} probes (query {use_part.query}){extra} in {', '.join(felt) or 'nothing'}, {gate}"
        ]

    def account(self, part: ContactDepthPart[np.ndarray], objects: Sequence[PairedObject]) -> dict[str, list[str]]:
        lines = []
        for target, table in zip(objects, part.geoms, strict=True):
            if table is not None:
                name, count = target.name, target.num_variants
                lines += account_of_geoms(table, [f"{name}, variant {i}" if count > 1 else name for i in range(count)])
        return {"meshes": lines} if lines else {}


CONTACT_DEPTH = _ContactDepth()


def _request(use: Use) -> ContactDepth:
    assert isinstance(use.request, ContactDepth)
    return use.request


def _is_measuring(planning: Planning, use: Use) -> bool:
    return use.request.wants_distance(planning.layout.radius[use.taxels])


def _table(planning: Planning, name: str, uses: Sequence[Use]) -> GeomTable[np.ndarray] | None:
    """Return the geoms of an object with their distances; None if nobody measures them, or a mesh cannot be baked."""
    from tgdsl.quantities.bake import geom_distance, geom_table  # compilers alone bake meshes

    sensed, margins = planning.sensed[name], []
    for use in uses:
        if name in use.request.objects and _is_measuring(planning, use):
            request = _request(use)
            reach = float(request.reach(planning.layout.radius[use.taxels]).max())
            margins.append(max(reach, request.range) + use.largest_shift)
    if not margins:
        return None
    cases, count = [], len(sensed.variants)
    try:
        for i, geoms in enumerate(sensed.variants):
            which = f" ({i + 1} of {count} variants)" if count > 1 else ""
            planning.progress(f"object {name}: distances{which}")
            cases.append([geom_distance(geom, sensed.distance, max(margins), f"object {name}") for geom in geoms])
    except BakeError as error:
        planning.report(("objects", name), str(error), "")
        return None
    return geom_table(cases)


def _query(
    planning: Planning, number: int, uses: Sequence[Use], tables: Tables
) -> tuple[ProbeQuery[np.ndarray], list[DepthUse[np.ndarray]]]:
    """Return the query of uses at the same probes, and the uses' parts."""
    object_names = [target.name for target in planning.objects]
    measuring = [use for use in uses if _is_measuring(planning, use)]
    names = dict.fromkeys(name for use in measuring for name in use.request.objects if name in object_names)
    felt, taxels = list(names), uses[0].taxels
    pair = planning.pair_table(felt, taxels)
    query = ProbeQuery(tuple(object_names.index(name) for name in felt), uses[0].pos, pair)
    bodies, result = planning.bodies_of(taxels), []
    for use in uses:
        request = _request(use)
        use_objects = [name for name in request.objects if name in object_names] if use in measuring else []
        allowed = {(p.link, p.object) for p in planning.allowed(request)}
        can_meet = np.array([[(body, name) in allowed for body in bodies] for name in use_objects], dtype=bool)
        reach = np.where(
            can_meet.reshape(len(use_objects), len(bodies)), request.reach(planning.layout.radius[taxels]), -np.inf
        )
        objects = tuple(felt.index(name) for name in use_objects)
        search = _search(planning, use_objects, request.wants, pair[list(objects)], tables)
        result.append(DepthUse(number, objects, request.is_gated, request.wants, use.radius_noise, reach, search))
    return query, result


def _search(
    planning: Planning, names: Sequence[str], wants: Sequence[str], pair: np.ndarray, tables: Tables
) -> SearchPart[np.ndarray] | None:
    """Return what a search by a kernel is given; None where it cannot answer."""
    if any(name not in tables for name in names):
        return None  # which has been reported
    geom_parts = [tables[name] for name in names]
    if not is_searchable([shape for table in geom_parts for shape in table.shapes], wants):
        return None
    targets = [target for name in names for target in planning.objects if target.name == name]
    first = np.array([target.first_pair for target in targets])
    pairs = (pair + first[:, None]).astype(np.int32)
    if any(target.num_variants > 1 or target.is_sized for target in targets):
        return SearchPart(pairs, None, None)
    spheres, geoms = geom_tables([_geoms(table) for table in geom_parts])
    return SearchPart(pairs, spheres.numpy(), geoms.numpy())


def _geoms(table: GeomTable[np.ndarray]) -> Geoms:
    size, pos, rotation = (torch.from_numpy(np.asarray(part)) for part in (table.size, table.pos, table.rotation))
    return Geoms(table.shapes, table.is_centred, size, pos, rotation, None, None, (None,) * len(table.shapes))
