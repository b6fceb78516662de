"""The search for the geom that each probe is deepest in: the tables that the kernel reads, and what it returns.

Shapes: `env` environments, `taxel` probes, `object` felt objects, `geom` geoms of all of these, `case` 1, or `env` if an object
differs between environments, `row` columns of a geom.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.geometry.shapes import KINDS
from tgdsl.quantities.geoms import Geoms

SHAPES = ("", "plane", "sphere", "capsule", "cylinder", "box")
"""The shapes that the kernel knows; to it a sphere is a capsule without a length."""


SPHERE = SHAPES.index("sphere")


EVERYWHERE = 3e38  # bound of a plane [m]: finite, but not its square, so that no place is beyond it, and −∞ added to it is −∞


MARGIN = 10 * planes.tie()
"""By how much farther than its reach a geom is passed over [m]: beyond all that counts as equal, in float32."""


POS, ROTATION, BOUND, KIND, ROW = 3, 6, 15, 16, 17  # columns of `Tables.geoms`, which begins with the size, and their number


class Tables(NamedTuple):
    """The objects of a search."""

    pair: Int[Tensor, "object taxel"]  # index of each probe's pair with each object among all pairs
    # radius of a sphere about each object's origin that holds it [m], −∞ if it is absent, and how many geoms it has
    spheres: Float[Tensor, "case object 2"]
    # each geom's size, place and rotation in its body's frame, row by row, the radius of a sphere about its own origin that
    # holds it [m], and its kind, which is negative if it has a frame
    geoms: Float[Tensor, "case geom row"]


class Deepest(NamedTuple):
    """What each probe is deepest in, the first among equals."""

    depth: Float[Tensor, "env taxel"]  # penetration depth max(0, radius − distance) [m]; not-a-number where a pose is
    normal: Vec  # unit normal out of the object, in the link's frame, planes (env, taxel); zero where nothing is reached
    pair: Int[Tensor, "env taxel"]  # index of the winner's pair among all pairs; −1 where nothing is reached


def geom_tables(objects: Sequence[Geoms]) -> tuple[Tensor, Tensor]:
    """Return the tables of objects and of their geoms, `Tables.spheres` and `Tables.geoms`.

    They take few operations: each is a kernel of a microsecond where objects differ between environments.
    """
    parts = [part for target in objects for part in (target.size, target.pos, target.rotation, target.is_absent)]
    num_cases = next((part.shape[0] for part in parts if part is not None and part.shape[0] != 1), 1)
    counts = [len(target.shapes) for target in objects]
    each = [geom for target in objects for geom in zip(target.shapes, target.is_centred, strict=True)]
    shape = _filled(objects[0].size, [float(SHAPES.index(shape)) for shape, _ in each])
    is_centred = _filled(objects[0].size, [float(is_centred) for _, is_centred in each]) > 0
    kinds = [KINDS.index("capsule" if shape == "sphere" else shape) for shape, _ in each]
    kind = _filled(objects[0].size, [float(kind) for kind in kinds])
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
    kind = torch.where(is_centred, kind, -kind).expand(num_cases, -1)
    geoms = torch.cat([torch.stack([x, y, z], dim=-1), pos, rotation, bound[..., None], kind[..., None]], dim=-1)
    held = torch.where(is_centred, bound, bound + planes.safe_sqrt(planes.dot(planes.split(pos), planes.split(pos))))
    if len(set(counts)) == 1:
        held = held.unflatten(1, (len(objects), counts[0])).amax(dim=2)
    else:
        held = torch.stack([part.amax(dim=1) for part in held.split(counts, dim=1)], dim=1)
    return torch.stack([held, _filled(held, [float(count) for count in counts]).expand(num_cases, -1)], dim=-1), geoms


def _filled(like: Tensor, values: Sequence[float]) -> Float[Tensor, "1 value"]:
    runs = [(value, len(list(run))) for value, run in groupby(values)]
    return torch.cat([like.new_full((1, count), value) for value, count in runs], dim=1)


@torch.library.custom_op("tgdsl::side_by_side", mutates_args=(), schema="(Tensor[] parts) -> Tensor")
def _side_by_side(parts: list[Tensor]) -> Tensor:
    return torch.cat(parts, dim=1)


@_side_by_side.register_fake
def _(parts: list[Tensor]) -> Tensor:
    return torch.cat(parts, dim=1)
