"""From a table of geoms to the geoms that each environment has."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from tgdsl.geometry.grid import Grid
from tgdsl.geometry.planes import split
from tgdsl.quantities.base import Scene, variant_of
from tgdsl.quantities.geoms.distance import Geoms, RaycastSurface
from tgdsl.quantities.geoms.tables import GeomTable, GridTable, TriangleTable
from tgdsl.quantities.pairs import PairedObject
from tgdsl.tensors.env_ids import may_look


def object_geoms(table: GeomTable[Tensor], target: PairedObject, scene: Scene) -> Geoms:
    """Return an object's geoms as each environment has them: its variant, its size. What none of them has may be left out."""
    variant = variant_of(scene, target)
    size, is_absent = _chosen(table.size, variant), None
    if variant is not None and table.is_absent is not None:
        is_absent = _chosen(table.is_absent, variant) > 0
    if target.is_sized:
        own = scene.tensors["object_size"][:, target.varied, None].to(size.dtype).expand(-1, size.shape[1], -1)
        size = own if is_absent is None else torch.where(is_absent[..., None], size, own)
    geoms = Geoms(
        shapes=table.shapes,
        is_centred=table.is_centred,
        size=size,
        pos=_chosen(table.pos, variant),
        rotation=_chosen(table.rotation, variant),
        is_absent=is_absent,
        variant=variant,
        surfaces=tuple(_surface(own, variant) for own in table.surfaces),
    )
    return geoms if is_absent is None or not may_look(is_absent) else _had_by_some(geoms, is_absent)


def _had_by_some(geoms: Geoms, is_absent: Bool[Tensor, "env geom"]) -> Geoms:
    """Return those geoms that some environment has."""
    own = [g for g, is_missing in enumerate(is_absent.all(dim=0).tolist()) if not is_missing]
    if len(own) == len(geoms.shapes) or not own:
        return geoms
    ids = torch.tensor(own, device=is_absent.device)
    return geoms._replace(
        **{name: tuple(getattr(geoms, name)[g] for g in own) for name in ("shapes", "is_centred", "surfaces")},
        **{name: getattr(geoms, name).index_select(1, ids) for name in ("size", "pos", "rotation", "is_absent")},
    )


def link_geoms(table: GeomTable[Tensor], links: Tensor) -> Geoms:
    """Return the own geoms of some links: each is a case."""
    return Geoms(
        shapes=table.shapes,
        is_centred=table.is_centred,
        size=table.size[links],
        pos=table.pos[links],
        rotation=table.rotation[links],
        is_absent=None if table.is_absent is None else table.is_absent[links] > 0,
        variant=links,
        surfaces=tuple(_surface(own, links) for own in table.surfaces),
    )


def _surface(
    table: GridTable[Tensor] | TriangleTable | RaycastSurface | None, variant: Tensor | None
) -> Grid | RaycastSurface | None:
    if isinstance(table, TriangleTable):
        return table.prepared
    if not isinstance(table, GridTable):
        return table
    if variant is None:
        return Grid(table.values, 0, table.counts, split(table.origin[:, None]), table.cell[:, None])
    origin, cell, num = table.origin[variant], table.cell[variant], table.num[variant]
    return Grid(table.values, table.first[variant][:, None], split(num[:, None]), split(origin[:, None]), cell[:, None])


def _chosen(array: Tensor, variant: Tensor | None) -> Tensor:
    """Return an array with one row per environment, or a single one if it is the same in all."""
    return array if variant is None else array[variant]
