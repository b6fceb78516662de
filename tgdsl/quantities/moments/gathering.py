"""From the state of a scene to moments."""

from __future__ import annotations

import torch
from torch import Tensor

from tgdsl.geometry.grid import Count
from tgdsl.geometry.planes import rot, split, vec
from tgdsl.quantities.base import Scene, pairs_for, variant_of
from tgdsl.quantities.moments.moments import MomentField, PointCloud
from tgdsl.quantities.moments.nearby import MomentSource, Plane, surface_moments
from tgdsl.quantities.moments.part import FieldTable, MomentsPart, MomentTable, MomentUse
from tgdsl.quantities.moments.request import SurfaceMoments


def gather(part: MomentsPart[Tensor], scene: Scene) -> tuple[SurfaceMoments, ...]:
    """Return what each use asks for."""
    found = []
    for use in part.uses:
        sources = [_source(part.tables[i], use, k, scene) for k, i in enumerate(use.tables)]
        pairs = pairs_for(scene, is_gated=False)
        found.append(surface_moments(pairs if use.motion else pairs._replace(motion=None), vec(use.pos.unbind()), sources))
    return tuple(found)


def _source(table: MomentTable[Tensor], use: MomentUse[Tensor], k: int, scene: Scene) -> MomentSource:
    """Return an object of a use, and what its moments are found from."""
    target = scene.objects[table.object]
    shift = scene.radius_shifts[use.radius_noise] if use.radius_noise else None
    variant, reach = variant_of(scene, target), use.reach[k]
    return MomentSource(
        target=target,
        pair=use.pair[k],
        radius=reach if shift is None else torch.where(reach > 0, torch.clamp(reach + shift, min=0), 0.0),
        shift=None if shift is None else torch.maximum(shift, -reach),
        surface=_surface(table, variant, use.radius_id[k]),
        planes=tuple(
            Plane(rot(own.unbind()), vec(at.unbind())) for own, at in zip(table.plane_rotation, table.plane_pos, strict=True)
        ),
        area=(table.area if variant is None else table.area[variant])[:, None],
    )


def _surface(table: MomentTable[Tensor], variant: Tensor | None, radius_id: Tensor) -> MomentField | PointCloud | None:
    """Return the table that each probe asks: one for all, or by variant (env, 1), by radius (taxel,), or by both."""
    own, num_radii = table.surface, len(table.radii)
    if own is None:
        return None
    which = None if variant is None else variant[:, None]
    if isinstance(own, FieldTable) and num_radii > 1:
        which = radius_id if which is None else num_radii * which + radius_id
    start: Count = 0
    if which is None:
        counts: tuple[Count, Count, Count] = own.counts
        place, side = split(own.origin[0]), own.cell[0]
    else:
        start, counts, place, side = own.first[which], split(own.num[which]), split(own.origin[which]), own.cell[which]
    if isinstance(own, FieldTable):
        return MomentField(own.values, start, counts, place, side, own.is_smooth)
    weight = own.weight[0] if which is None else own.weight[which]
    return PointCloud(vec(own.points.unbind()), weight, own.lists, start, counts, place, side)
