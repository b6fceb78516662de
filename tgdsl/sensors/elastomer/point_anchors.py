"""Anchors on points of the objects, as in the paper: where each point was when it sank into the skin, and how far it came.

A point p of an object, z_p its place in the link's frame and φ the signed distance to the link's own surface, takes the anchor
e_p = z_p when it is deeper than `enter` in the skin, and is released when it is farther than `exit` above it, or its gate
closes. With h_p = max(0, s − φ(z_p)) its depth [m], s the skin's height, and m_p = ∇φ(z_p), it moves the markers j by

    u_j = s_s Π_nj Σ_p w_p (z_p − e_p) h_p exp(−λ_s |Π_nj(x_j − z_p)|²)                     [m]

w_p the area that it stands for over the reference area, 1 under `model: paper`. With a friction cap t_p = Π_mp(z_p − e_p) is at
most |t_p| = `slip` h_p: beyond it the point slides, and its anchor is dragged along by as much.

Shapes: planes (env, link, point) of one object; in the state all objects one after the other, flat; `taxel` markers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.points import LINK_POINTS, LinkPoints, ObjectPoints, ReferencePoints, are_grids, tile_size
from tgdsl.sensors.elastomer.anchors import StickSlip, capped
from tgdsl.tensors.fusion import materialised
from tgdsl.tensors.operations import Operation, needs_autograd
from tgdsl.tensors.torch_internals import expect_size, is_exporting

Row = tuple[Float[Tensor, "6 row slot"], Int[Tensor, " row"]]
LARGEST_BLOCK = 16  # largest number of points of a block, which divides the number of points
OVERHEAD = 24  # fixed cost of a row, in slots
WORTHWHILE = 0.75  # largest cost over the dense sum's at which points are compacted
MIN_ACTIVE = 2  # rows of a link at least: torch.compile treats sizes 0 and 1 apart
EXPECTED = (1000, 100)
"""Numbers of rows and slots for Inductor's estimates: without any it does not fuse the exponential and the sums."""


def are_compacted(pos: Vec, strength: Vec) -> bool:
    """Return whether `active_points` can take these and saves time: on a CPU, for several environments, without derivatives.

    An exported program cannot have its operation.
    """
    is_here = pos[0].device.type == "cpu" and not is_exporting()
    return is_here and pos[0].shape[0] != 1 and not needs_autograd(*pos, *strength)


def active_points(pos: Vec, strength: Vec) -> Iterator[Row]:
    """Yield the active points of each link: places [m] and strengths [m²] in rows, and the environment of each row.

    Args:
        pos: z_p, planes (env, link, point) in each link's frame [m].
        strength: s_p, in the same way [m²]. Points of strength 0 may be left out, unless their place is not finite.

    Yields:
        An empty slot has the strength 0.
    """
    is_active = (strength[0] != 0) | (strength[1] != 0) | (strength[2] != 0) | ~torch.isfinite(pos[0] + pos[1] + pos[2])
    blocks = is_active.unflatten(2, (-1, block_size(is_active.shape[2]))).any(dim=3)
    return zip(*compacted([*pos, *strength], blocks), strict=True)


def block_size(num_points: int) -> int:
    """Return the number of points of each block."""
    return max(size for size in range(1, LARGEST_BLOCK + 1) if num_points % size == 0)


@torch.library.custom_op(
    "tgdsl::compacted", mutates_args=(), schema="(Tensor[] planes, Tensor is_active) -> (Tensor[], Tensor[])"
)
def compacted(planes: list[Tensor], is_active: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Return places and strengths in active blocks, and the environments of rows, link by link; see `active_points`."""
    num_envs, num_links, num_points = planes[0].shape
    size = num_points // max(is_active.shape[2], 1)
    count = is_active.transpose(0, 1).sum(dim=2)
    length = _row_length(count, is_active.shape[2], size)
    if length is None:
        every = torch.arange(num_envs)
        return [torch.stack([plane[:, link] for plane in planes]) for link in range(num_links)], [
            every.clone() for _ in range(num_links)
        ]
    blocks = [plane.reshape(-1, size) for plane in planes]
    num_rows = (count + (length - 1)) // length
    sizes = num_rows.sum(dim=1).tolist()
    env = torch.repeat_interleave(torch.arange(num_envs).repeat(num_links), num_rows.reshape(-1)).split(sizes)
    index = _index(is_active, count, num_rows, length).split([length * num for num in sizes])
    rows, envs = [], []
    for block_ids, of_env in zip(index, env, strict=True):
        lacking = max(MIN_ACTIVE - len(of_env), 0)
        row = planes[0].new_zeros((6, length * (len(of_env) + lacking), size))
        at = block_ids.clamp(min=0)
        for of_plane, to in zip(blocks, row, strict=True):
            torch.index_select(of_plane, 0, at, out=to[: len(block_ids)])
        row[3:, : len(block_ids)].masked_fill_((block_ids < 0)[:, None], 0)
        rows.append(row.view(6, -1, length * size))
        envs.append(torch.cat([of_env, of_env.new_zeros(lacking)]))
    return rows, envs


@compacted.register_fake
def _(planes: list[Tensor], is_active: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    context = torch.library.get_ctx()
    slots = expect_size(context.new_dynamic_size(min=1), EXPECTED[1])
    nums = [expect_size(context.new_dynamic_size(min=MIN_ACTIVE), EXPECTED[0]) for _ in range(is_active.shape[1])]
    rows = [planes[0].new_empty((6, num, slots)) for num in nums]
    return rows, [planes[0].new_empty((num,), dtype=torch.int64) for num in nums]


def _row_length(count: Int[Tensor, "link env"], num_blocks: int, size: int) -> int | None:
    """Return the number of blocks of a row that costs least, or None if to sum over all points costs little more."""
    frequency = torch.bincount(count.reshape(-1), minlength=2)
    most = len(frequency) - 1
    lengths = torch.tensor([*(1 << k for k in range(most.bit_length()) if 1 << k < most), most])
    num_rows = (torch.arange(most + 1) + (lengths[:, None] - 1)) // lengths[:, None]
    cost, best = ((num_rows * frequency).sum(dim=1) * (size * lengths + OVERHEAD)).min(dim=0)
    return None if cost > WORTHWHILE * count.numel() * (size * num_blocks + OVERHEAD) else int(lengths[best])


def _index(
    is_active: Bool[Tensor, "env link block"], count: Int[Tensor, "link env"], num_rows: Int[Tensor, "link env"], length: int
) -> Int[Tensor, " place"]:
    """Return the block at each place of the rows, counted through (env, link, block), link after link; −1: none."""
    num_envs, num_links, num_blocks = is_active.shape
    active = is_active.transpose(0, 1).reshape(-1).nonzero()[:, 0]
    pair = torch.arange(num_links * num_envs).view(num_links, num_envs)
    there = torch.arange(num_envs) * num_links + torch.arange(num_links)[:, None]
    count, num_rows = count.reshape(-1), num_rows.reshape(-1)
    place = length * (num_rows.cumsum(0) - num_rows) - (count.cumsum(0) - count)
    index = torch.full((int(num_rows.sum()) * length,), -1)
    index[torch.arange(len(active)) + torch.repeat_interleave(place, count)] = active + torch.repeat_interleave(
        num_blocks * (there - pair).reshape(-1), count
    )
    return index


PLANES = ("anchor_x", "anchor_y", "anchor_z", "held")  # state: e_p in the link's frame [m], and 1 where the point has an anchor
BLOCK = 64  # points that are summed at once where nothing fuses the sum, so that memory stays bounded


class Markers(NamedTuple):
    """Markers of all links."""

    pos: Vec  # positions [m], planes (taxel,)
    normal: Vec  # normals, in the same way
    falloff: Tensor  # λ_s [1/m²]
    reference_area: Tensor | None  # A_ref [m²], or None: points count once
    flat: frozenset[int] = frozenset()  # first taxels of the links whose markers have one normal


class ShearLoad(NamedTuple):
    """Shear loads of the points of one object, planes (env, link, point) in each link's frame."""

    taxels: tuple[tuple[int, int], ...]  # first of each link's taxels, and one beyond the last
    tiles: Int[Tensor, "tile 3"]  # what `points.point_tiles` returns of them
    area: Tensor  # surface of the object that each stands for [m²], (case, 1)
    pos: Vec  # z_p [m]
    strength: Vec  # (z_p − e_p) h_p [m²]
    # number of active points of each link, (env, link), which then come first; None: inactive ones have strength 0
    num_active: Tensor | None = None


def shear_loads(
    objects: Sequence[ObjectPoints], stick_slip: StickSlip, state: Mapping[str, Tensor]
) -> tuple[list[ShearLoad], dict[str, Tensor]]:
    """Return the shear loads of each object's points, and the new anchors: none if a kernel has written them in place."""
    return advance([LINK_POINTS(points) for points in objects], stick_slip, state)


def _shear_loads_by_kernel(
    objects: Sequence[ObjectPoints], stick_slip: StickSlip, state: Mapping[str, Tensor]
) -> tuple[list[ShearLoad], dict[str, Tensor]]:
    from tgdsl.quantities.depth_kernel import grid_tables
    from tgdsl.sensors.elastomer.anchor_kernel import advance_anchors

    loads, first = [], 0
    numbers = [part for part in stick_slip if isinstance(part, Tensor)]
    for pairs, source in objects:
        places, tables = torch.stack(source.points)[:, :, 0], grid_tables(source.links, 0)
        is_cubic, pose = source.links.shapes[0] == "tricubic", [*pairs.rotation, *pairs.offset]
        planes_of = [state[name] for name in PLANES]
        active, count = advance_anchors(pose, pairs.gate, source.pair, places, *tables, is_cubic, numbers, planes_of, first)
        x, y, z, *strength = active.unbind()
        loads.append(ShearLoad(source.taxels, source.tiles, source.area, (x, y, z), planes.vec(strength), count))
        first += source.pair.shape[0] * places.shape[2]
    return loads, {}


def _anchor_inputs(objects: Sequence[ObjectPoints], stick_slip: StickSlip, state: Mapping[str, Tensor]) -> list[Tensor]:
    return [tensor for source in objects for tensor in LINK_POINTS.inputs(source)]


def _have_one_grid(objects: Sequence[ObjectPoints], stick_slip: StickSlip, state: Mapping[str, Tensor]) -> bool:
    return all(len(points.source.links.shapes) == 1 and are_grids(points) for points in objects)


SHEAR_LOADS = Operation("advance_anchors", shear_loads, _shear_loads_by_kernel, _anchor_inputs, _have_one_grid)


def advance(
    of_objects: Sequence[LinkPoints], stick_slip: StickSlip, state: Mapping[str, Tensor]
) -> tuple[list[ShearLoad], dict[str, Tensor]]:
    """Return the shear loads of each object's points, and the new anchors."""
    loads, after, start = [], {name: [] for name in PLANES}, 0
    for points in of_objects:
        # Flat as the state is: a compiler then reads and writes that in one loop.
        distance = points.distance.flatten(1)
        pos, gradient = (planes.vec(part.flatten(1) for part in vector) for vector in (points.pos, points.gradient))
        end = start + distance.shape[1]
        x, y, z, held = (state[name][:, start:end] for name in PLANES)
        anchor, start = (x, y, z), end
        is_held = (held > 0) & ~(distance > stick_slip.standoff + stick_slip.exit)
        depth = torch.relu(stick_slip.standoff - distance)
        zero = torch.zeros_like(depth)
        moved = planes.where(is_held, planes.sub(pos, anchor), (zero, zero, zero))
        if stick_slip.slip is not None:
            stretch = planes.sub(moved, planes.scale(planes.dot(moved, gradient), gradient))
            within_cap, slides = capped(stretch, stick_slip.slip * depth)
            slid = planes.sub(stretch, within_cap)
            moved, anchor = planes.sub(moved, slid), planes.where(slides, planes.add(anchor, slid), anchor)
        is_taken = ~is_held & (stick_slip.standoff - distance > stick_slip.enter)
        taken = planes.where(is_held, anchor, planes.where(is_taken, pos, (zero, zero, zero)))
        shape = points.distance.shape[1:]
        strength = planes.vec(materialised(part).unflatten(1, shape) for part in planes.scale(depth, moved))
        loads.append(ShearLoad(points.taxels, points.tiles, points.area, points.pos, strength))
        for name, plane in zip(PLANES, (*taken, (is_held | is_taken).to(zero.dtype)), strict=True):
            after[name].append(plane)
    return loads, {name: torch.cat(parts, dim=1) if parts else state[name] for name, parts in after.items()}


def drag(loads: Sequence[ShearLoad], markers: Markers, num_envs: int) -> Vec:
    """Return u_j / s_s of all markers [m²], planes (env, taxel)."""
    zero = markers.pos[0].new_zeros((num_envs, markers.pos[0].shape[0]))
    total = (zero, zero, zero)
    for load in loads:
        on_link = POINT_SUM(load, markers)
        if markers.reference_area is not None:
            on_link = planes.scale(load.area / markers.reference_area, on_link)
        total = planes.add(total, on_link)
    return planes.sub(total, planes.scale(planes.dot(total, markers.normal), markers.normal))


def point_sum(load: ShearLoad, markers: Markers) -> Vec:
    """Return Σ_p (z_p − e_p) h_p exp(−λ_s |Π_nj(x_j − z_p)|²) [m²] of the points of one object."""
    num_taxels = markers.pos[0].shape[0]
    zero = markers.pos[0].new_zeros((load.pos[0].shape[0], num_taxels))
    total = (zero, zero, zero)
    rows = active_points(load.pos, load.strength) if are_compacted(load.pos, load.strength) else None
    for link, (first, last) in enumerate(load.taxels):
        pos = planes.vec(part[first:last] for part in markers.pos)
        normal = planes.vec(part[first : first + 1 if first in markers.flat else last] for part in markers.normal)
        if rows is None:
            z, strength = (planes.vec(part[:, link] for part in vector) for vector in (load.pos, load.strength))
            on_link = _summed_on_link(z, strength, pos, normal, markers.falloff)
        else:
            points, env = next(rows)
            on_link = _summed_on_link(planes.vec(points[:3]), planes.vec(points[3:]), pos, normal, markers.falloff)
            on_link = planes.vec(zero[:, first:last].index_add(0, env, part) for part in on_link)
        around = (first, num_taxels - last)
        total = planes.add(total, planes.vec(torch.nn.functional.pad(part, around) for part in on_link))
    return total


def _point_sum_by_kernel(load: ShearLoad, markers: Markers) -> Vec:
    from tgdsl.sensors.elastomer import point_sum_kernel

    where = list(load.pos), list(load.strength), load.num_active, load.tiles, tile_size(load.taxels)
    result = point_sum_kernel.point_sum(*where, list(markers.pos), list(markers.normal), markers.falloff)
    return planes.vec(result.unbind())


def _point_sum_inputs(load: ShearLoad, markers: Markers) -> list[Tensor]:
    return [*load.pos, *load.strength, markers.falloff]


POINT_SUM = Operation("point_sum", point_sum, _point_sum_by_kernel, _point_sum_inputs)


def _summed_on_link(pos: Vec, strength: Vec, marker: Vec, normal: Vec, falloff: Tensor) -> Vec:
    """Return the sum for one link's markers, of planes (env, point) or (row, slot)."""
    if torch.compiler.is_compiling():  # a compiler fuses kernel and sum into one loop, whatever the length
        return _summed_at_once(pos, strength, marker, normal, falloff)
    blocks = zip(*(part.split(BLOCK, dim=1) for part in (*pos, *strength)), strict=True)
    sums = [_summed_at_once(planes.vec(b[:3]), planes.vec(b[3:]), marker, normal, falloff) for b in blocks]
    return planes.vec(torch.stack(parts).sum(dim=0) for parts in zip(*sums, strict=True))


def _summed_at_once(pos: Vec, strength: Vec, marker: Vec, normal: Vec, falloff: Tensor) -> Vec:
    """Return the sum for one link's markers, of one block of points."""
    # Offsets are along two tangents of each marker, scaled so that their squares are the exponent of 2. Markers that share a
    # normal share the tangents, and terms of points alone are computed once per point.
    scale = torch.sqrt(falloff / math.log(2.0))
    z, strengths = (planes.vec(part[:, None] for part in vector) for vector in (pos, strength))
    offset_u, offset_v = (
        materialised(planes.dot(tangent, marker))[:, None]
        - _along(planes.vec(materialised(part)[:, None] for part in tangent), z)
        for tangent in (planes.scale(scale, tangent) for tangent in _tangents(normal))
    )
    fall = torch.exp2(-offset_u * offset_u - offset_v * offset_v)
    return planes.vec((fall * part).sum(dim=-1) for part in strengths)


def _along(tangent: Vec, point: Vec) -> Tensor:
    result = planes.dot(tangent, point)
    return materialised(result) if tangent[0].shape[0] == 1 else result


def _tangents(normal: Vec) -> tuple[Vec, Vec]:
    """Return two unit vectors across unit normals and each other."""
    x, y, z = normal  # no branch that loses digits: Duff et al., "Building an orthonormal basis, revisited", 2017
    sign = torch.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def reference_drag(
    of_objects: Sequence[ReferencePoints],
    pos: Float[np.ndarray, "taxel 3"],
    normal: Float[np.ndarray, "taxel 3"],
    stick_slip: StickSlip,
    falloff: float,
    reference_area: float | None,
    state: Mapping[str, np.ndarray],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return u_j / s_s (taxel, 3) [m²] and the new anchors of one environment, point by point."""
    result, row = np.zeros((len(pos), 3)), 0
    after = {name: np.zeros_like(state[name]) for name in PLANES}
    for points in of_objects:
        weight = 1.0 if reference_area is None else points.area / reference_area
        for z, phi, m in zip(points.pos, points.distance, points.gradient, strict=True):
            e, holds = np.array([state[name][row] for name in PLANES[:3]]), state["held"][row] > 0
            h = max(0.0, stick_slip.standoff - phi)
            if holds and phi <= stick_slip.standoff + stick_slip.exit:
                t = (z - e) - ((z - e) @ m) * m
                length = float(np.linalg.norm(t))
                if stick_slip.slip is not None and length > stick_slip.slip * h and length**2 > planes.tiny():
                    e = e + t * (1.0 - stick_slip.slip * h / length)
                for j in points.taxels:
                    r, s = (v - (v @ normal[j]) * normal[j] for v in (pos[j] - z, z - e))
                    result[j] += weight * h * s * np.exp(-falloff * (r @ r))
            else:
                holds = stick_slip.standoff - phi > stick_slip.enter
                e = z if holds else np.zeros(3)
            for name, value in zip(PLANES, (*e, float(holds)), strict=True):
                after[name][row] = value
            row += 1
    return result, after
