"""From a Plan's arrays to what an answer's moments are found from, for the environments of one call."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from tgdsl.geometry.grid import Count
from tgdsl.geometry.planes import rot, split, vec
from tgdsl.plan.plan import Plan, PlannedMoments
from tgdsl.quantities.moments.moments import MomentField, PointCloud
from tgdsl.quantities.moments.nearby import MomentSource, Plane
from tgdsl.tensors.buffers import Constants


def moment_sources(
    plan: Plan,
    constants: Constants,
    path: str,
    planned: PlannedMoments,
    tensors: Mapping[str, Tensor],
    shift: Tensor | None = None,
) -> list[MomentSource]:
    """Return the objects whose moments an answer has.

    Args:
        plan: The plan.
        constants: Its arrays.
        path: Of the answer's moments among them.
        planned: Which moments.
        tensors: The state.
        shift: Disturbance of the probes' radii (env, taxel) [m].
    """
    found = []
    for k, o in enumerate(planned.objects):
        target, radii = plan.objects[o], planned.radii[k]
        variant = None
        if target.num_variants > 1:
            variant = tensors["variant"][:, plan.inputs.objects.index(target.name)].long()
        pair, reach, radius_id = (constants[f"{path}/{name}"][k] for name in ("pair", "reach", "radius_id"))
        table = f"objects/{target.name}/moments/{planned.request}"
        rotations, places = constants[f"{table}/plane_rotation"], constants[f"{table}/plane_pos"]
        area = constants[f"{table}/area"]
        found.append(
            MomentSource(
                name=target.name,
                first_pair=target.first_pair,
                num_pairs=target.num_pairs,
                pair=pair,
                radius=reach if shift is None else torch.where(reach > 0, torch.clamp(reach + shift, min=0), 0.0),
                shift=None if shift is None else torch.maximum(shift, -reach),
                surface=_surface(constants, table, planned, variant, radius_id, len(radii)),
                planes=tuple(Plane(rot(own.unbind()), vec(at.unbind())) for own, at in zip(rotations, places, strict=True)),
                area=(area if variant is None else area[variant])[:, None],
            )
        )
    return found


def _surface(
    constants: Constants, table: str, planned: PlannedMoments, variant: Tensor | None, radius_id: Tensor, num_radii: int
) -> MomentField | PointCloud | None:
    """Return the table that each probe asks: one for all, or by variant (env, 1), by radius (taxel,), or by both."""
    if f"{table}/first" not in constants:
        return None
    which = None if variant is None else variant[:, None]
    if planned.backend == "field" and num_radii > 1:
        which = radius_id if which is None else num_radii * which + radius_id
    first, num, origin, cell = (constants[f"{table}/{name}"] for name in ("first", "num", "origin", "cell"))
    start: Count = 0
    if which is None:
        counts: tuple[Count, Count, Count] = constants.counts(f"{table}/num")
        place, side = split(origin[0]), cell[0]
    else:
        start, counts, place, side = first[which], split(num[which]), split(origin[which]), cell[which]
    if planned.backend == "field":
        return MomentField(constants[f"{table}/values"], start, counts, place, side, planned.is_smooth)
    weight, lists = constants[f"{table}/weight"], constants[f"{table}/lists"]
    points = vec(constants[f"{table}/points"].unbind())
    return PointCloud(points, weight[0] if which is None else weight[which], lists, start, counts, place, side)
