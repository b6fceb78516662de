"""From requests for contact depths to their part of the Plan: meshes baked, queries shared, tables numbered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from tgdsl.errors import BakeError
from tgdsl.quantities.base import Planning, Use
from tgdsl.quantities.contact_depth.part import ContactDepthPart, DepthUse, ProbeQuery, SearchPart
from tgdsl.quantities.contact_depth.request import ContactDepth
from tgdsl.quantities.contact_depth.search import is_searchable
from tgdsl.quantities.contact_depth.search_tables import geom_tables
from tgdsl.quantities.geoms.baking import geom_distance, geom_table
from tgdsl.quantities.geoms.distance import Geoms
from tgdsl.quantities.geoms.tables import GeomTable

Part = ContactDepthPart[np.ndarray]
Tables = Mapping[str, GeomTable[np.ndarray]]


def plan(planning: Planning, uses: Sequence[Use]) -> Part:
    """Return the part of the Plan; an object whose mesh no grid within its budget suits is a mistake."""
    tables = {}
    for name in planning.sensed:
        table = _table(planning, name, uses)
        if table is not None:
            tables[name] = table
    queries: dict[int, list[Use]] = {}
    for use in uses:
        queries.setdefault(id(use.pos), []).append(use)
    parts, made = [], {}
    for number, own in enumerate(queries.values()):
        query, found = _query(planning, number, own, tables)
        parts.append(query)
        made |= {id(use): part for use, part in zip(own, found, strict=True)}
    return ContactDepthPart(
        geoms=tuple(tables.get(target.name) for target in planning.objects),
        queries=tuple(parts),
        uses=tuple(made[id(use)] for use in uses),
    )


def _request(use: Use) -> ContactDepth:
    assert isinstance(use.request, ContactDepth)
    return use.request


def _is_measuring(planning: Planning, use: Use) -> bool:
    return use.request.wants_distance(planning.layout.radius[use.taxels])


def _table(planning: Planning, name: str, uses: Sequence[Use]) -> GeomTable[np.ndarray] | None:
    """Return the geoms of an object with their distances; None if nobody measures them, or a mesh cannot be baked."""
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
    """Return the query of uses at the same probes, and what is made of it."""
    known = [target.name for target in planning.objects]
    measuring = [use for use in uses if _is_measuring(planning, use)]
    names = dict.fromkeys(name for use in measuring for name in use.request.objects if name in known)
    felt, taxels = list(names), uses[0].taxels
    pair = planning.pair_table(felt, taxels)
    query = ProbeQuery(tuple(known.index(name) for name in felt), uses[0].pos, pair)
    bodies, found = planning.bodies_of(taxels), []
    for use in uses:
        request = _request(use)
        chosen = [name for name in request.objects if name in known] if use in measuring else []
        allowed = {(p.link, p.object) for p in planning.allowed(request)}
        can_meet = np.array([[(body, name) in allowed for body in bodies] for name in chosen], dtype=bool)
        reach = np.where(can_meet.reshape(len(chosen), len(bodies)), request.reach(planning.layout.radius[taxels]), -np.inf)
        objects = tuple(felt.index(name) for name in chosen)
        search = _search(planning, chosen, request.wants, pair[list(objects)], tables)
        found.append(DepthUse(number, objects, request.is_gated, request.wants, use.radius_noise, reach, search))
    return query, found


def _search(
    planning: Planning, names: Sequence[str], wants: Sequence[str], pair: np.ndarray, tables: Tables
) -> SearchPart[np.ndarray] | None:
    """Return what a search by a kernel is given; None where it cannot answer."""
    if any(name not in tables for name in names):
        return None  # which has been reported
    own = [tables[name] for name in names]
    if not is_searchable([shape for table in own for shape in table.shapes], wants):
        return None
    targets = [target for name in names for target in planning.objects if target.name == name]
    first = np.array([target.first_pair for target in targets])
    pairs = (pair + first[:, None]).astype(np.int32)
    if any(target.num_variants > 1 or target.is_sized for target in targets):
        return SearchPart(pairs, None, None)
    spheres, geoms = geom_tables([_geoms(table) for table in own])
    return SearchPart(pairs, spheres.numpy(), geoms.numpy())


def _geoms(table: GeomTable[np.ndarray]) -> Geoms:
    """Return primitives that are the same in all environments as tensors."""
    size, pos, rotation = (torch.from_numpy(np.asarray(part)) for part in (table.size, table.pos, table.rotation))
    return Geoms(table.shapes, table.is_centred, size, pos, rotation, None, None, (None,) * len(table.shapes))
