"""The search for the geom that each probe is deepest in, by a GPU's kernel: what that is given, and what is made of its answer.

Shapes: `env` environments, `taxel` probes, `pair` pairs, `object` felt objects, `geom` geoms of all of these, `case` 1, or
`env` if an object differs between environments, `row` columns of a geom.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.quantities.contact_depth.query import Probes
from tgdsl.quantities.contact_depth.request import Penetration
from tgdsl.quantities.geoms.distance import Geoms
from tgdsl.quantities.pairs import Pairs
from tgdsl.tensors.fusion import takes_kernel

THRESHOLD = 5
"""Geoms from which on the kernel is used: with four boxes Inductor's code is as fast, 1.6 million probes in 0.08 ms."""
SHAPES = ("", "plane", "sphere", "capsule", "cylinder", "box")
"""The shapes that the kernel knows. For it a sphere is a capsule without a length, and what comes after it moves up by one."""
SPHERE = SHAPES.index("sphere")
EVERYWHERE = 3e38
"""Bound of a plane [m]: finite, but not its square, so that no place is beyond it, and −∞ added to it is −∞."""
MARGIN = 1e-6
"""By how much farther than its reach a geom is passed over [m]: ten times `planes.tie()`, and the rounding of float32."""


class Tables(NamedTuple):
    """The objects that are felt.

    Attributes:
        pair: Index of each probe's pair with each object among all pairs.
        spheres: Radius of a sphere about each object's origin that holds it [m], −∞ if it is absent, and how many geoms it has.
        geoms: Each geom's size, place and rotation in its body's frame, row by row, the radius of a sphere about its own origin
            that holds it [m], and its kind, which is negative if it has a frame of its own.
    """

    pair: Int[Tensor, "object taxel"]
    spheres: Float[Tensor, "case object 2"]
    geoms: Float[Tensor, "case geom row"]


def is_searchable(shapes: Collection[str], wants: Collection[str]) -> bool:
    """Return whether the kernel can answer: enough geoms, all of shapes that it knows, and nothing but normal and motion."""
    is_known = all(shape in SHAPES for shape in shapes) and all(want in ("normal", "motion") for want in wants)
    return is_known and len(shapes) >= THRESHOLD


def search(
    pairs: Pairs,
    probes: Probes,
    objects: Sequence[Geoms],
    known: Mapping[str, Tensor],
    reach: Float[Tensor, "object *env taxel"],
    wants: Collection[str],
) -> Penetration | None:
    """Return what `query.penetration` would, found by one kernel; None where that cannot run.

    Args:
        pairs: Relative poses of all pairs of the plan.
        probes: The probes.
        objects: The objects that are felt, the first of equals first; they are searchable.
        known: Their tables by name, as `Tables` has them: `pair`, and the others where they are the same at all calls.
        reach: As `query.penetration` has it.
        wants: As `query.penetration` has them.
    """
    motion = () if pairs.motion is None else (*pairs.motion.linear, *pairs.motion.angular)
    geoms = [part for target in objects for part in (target.size, target.pos, target.rotation)]
    if not takes_kernel(*pairs.offset, *pairs.rotation, *motion, *probes.pos, reach, *geoms):
        return None
    from tgdsl.quantities.contact_depth.deepest_kernel import deepest

    spheres, geoms = (known["spheres"], known["geoms"]) if "geoms" in known else geom_tables(objects)
    found = deepest(pairs, probes.pos, Tables(known["pair"], spheres, geoms), reach)
    velocity = angular = None
    if "motion" in wants and pairs.motion is not None:
        own, is_met = found.pair.clamp(min=0).long(), found.pair >= 0
        x, y, z, u, v, w = (torch.where(is_met, part.gather(1, own), 0.0) for part in motion)
        velocity, angular = planes.add((x, y, z), planes.cross((u, v, w), probes.pos)), (u, v, w)
    normal = found.normal if "normal" in wants else None
    return Penetration(probes.pos, found.depth, normal, velocity, angular, {}, {})


def geom_tables(objects: Sequence[Geoms]) -> tuple[Tensor, Tensor]:
    """Return the tables of objects and of their geoms, `Tables.spheres` and `Tables.geoms`.

    They are made of few operations, as each is a kernel of a microsecond where objects differ between environments.
    """
    parts = [part for target in objects for part in (target.size, target.pos, target.rotation, target.is_absent)]
    num_cases = next((part.shape[0] for part in parts if part is not None and part.shape[0] != 1), 1)
    counts = [len(target.shapes) for target in objects]
    each = [geom for target in objects for geom in zip(target.shapes, target.is_centred, strict=True)]
    shape = _filled(objects[0].size, [float(SHAPES.index(shape)) for shape, _ in each])
    is_centred = _filled(objects[0].size, [float(is_centred) for _, is_centred in each]) > 0
    size, pos, rotation = (
        _side_by_side([getattr(target, name).expand(num_cases, -1, -1) for target in objects])
        for name in ("size", "pos", "rotation")
    )
    x, y, z = planes.split(size)
    y = torch.where(shape == SPHERE, 0.0, y)
    squared = x * x + y * y + torch.where(shape == SHAPES.index("box"), z * z, 0.0)
    bound = torch.where(shape <= SHAPES.index("capsule"), x + y, planes.safe_sqrt(squared))
    bound = torch.where(shape == SHAPES.index("plane"), EVERYWHERE, bound + MARGIN)
    if any(target.is_absent is not None for target in objects):
        masks = [target.size[..., 0] < -1 if target.is_absent is None else target.is_absent for target in objects]
        bound = torch.where(_side_by_side([mask.expand(num_cases, -1) for mask in masks]), -torch.inf, bound)
    kind = torch.where(shape > SPHERE, shape - 1, shape)  # a sphere is a capsule without a length
    kind = torch.where(is_centred, kind, -kind).expand(num_cases, -1)
    geoms = torch.cat([torch.stack([x, y, z], dim=-1), pos, rotation, bound[..., None], kind[..., None]], dim=-1)
    held = torch.where(is_centred, bound, bound + planes.safe_sqrt(planes.dot(planes.split(pos), planes.split(pos))))
    if len(set(counts)) == 1:
        held = held.unflatten(1, (len(objects), counts[0])).amax(dim=2)
    else:
        held = torch.stack([own.amax(dim=1) for own in held.split(counts, dim=1)], dim=1)
    return torch.stack([held, _filled(held, [float(count) for count in counts]).expand(num_cases, -1)], dim=-1), geoms


def _filled(like: Tensor, values: Sequence[float]) -> Float[Tensor, "1 value"]:
    """Return numbers as a tensor, without a copy from the host."""
    runs = [(value, len(list(run))) for value, run in groupby(values)]
    return torch.cat([like.new_full((1, count), value) for value, count in runs], dim=1)


@torch.library.custom_op("tgdsl::side_by_side", mutates_args=(), schema="(Tensor[] parts) -> Tensor")
def _side_by_side(parts: list[Tensor]) -> Tensor:
    """Return torch.cat(parts, dim=1), by one kernel: a compiler would make one of each part."""
    return torch.cat(parts, dim=1)


@_side_by_side.register_fake
def _(parts: list[Tensor]) -> Tensor:
    return torch.cat(parts, dim=1)
