"""Compaction of the active points, those with a shear load, for the sum over points of `point_anchors` on a CPU.

Of an object's points few are in contact at a time, and those that are near each other stand near in the list. An operator
copies the blocks of points that hold an active one into rows of one length, each of one environment, which has as many rows
as it takes; the sum over rows is left to torch's operations, so that Inductor fuses it. The length is chosen at each call:
how many rows and slots there are is known at run time only.

Shapes: `env` environments, `link` links that may meet an object, `point` points of it, `block` blocks of these, `row` rows of
one link, `slot` points of one row.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.geometry.planes import Vec
from tgdsl.tensors.operations import needs_autograd
from tgdsl.tensors.torch_internals import expect_size

Row = tuple[Float[Tensor, "6 row slot"], Int[Tensor, " row"]]
LARGEST_BLOCK = 16
"""Points of a block at most; a number that divides that of the points."""
OVERHEAD = 24
"""Cost of a row beside that of its slots, in slots."""
WORTHWHILE = 0.75
"""Largest share of the dense sum's cost at which compaction pays."""
FEWEST = 2
"""Rows of a link at least: torch.compile treats sizes 0 and 1 apart."""
EXPECTED = (1000, 100)
"""Numbers of rows and slots for Inductor's estimates: without any it does not fuse the exponential and the sums."""


def are_compacted(pos: Vec, strength: Vec) -> bool:
    """Return whether `active_points` can take these and saves time: on a CPU, for several environments, without derivatives."""
    return pos[0].device.type == "cpu" and pos[0].shape[0] != 1 and not needs_autograd(*pos, *strength)


def active_points(pos: Vec, strength: Vec) -> Iterator[Row]:
    """Yield the active points of each link: places [m] and strengths [m²] in rows, and the environment of each row.

    Args:
        pos: z_p, planes (env, link, point) in each link's frame [m].
        strength: s_p, likewise [m²]. Points of strength 0 may be left out, unless their place is not finite.

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
    for own, of_env in zip(index, env, strict=True):
        lacking = max(FEWEST - len(of_env), 0)
        row = planes[0].new_zeros((6, length * (len(of_env) + lacking), size))
        at = own.clamp(min=0)
        for of_plane, to in zip(blocks, row, strict=True):
            torch.index_select(of_plane, 0, at, out=to[: len(own)])
        row[3:, : len(own)].masked_fill_((own < 0)[:, None], 0)
        rows.append(row.view(6, -1, length * size))
        envs.append(torch.cat([of_env, of_env.new_zeros(lacking)]))
    return rows, envs


@compacted.register_fake
def _(planes: list[Tensor], is_active: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    context = torch.library.get_ctx()
    slots = expect_size(context.new_dynamic_size(min=1), EXPECTED[1])
    nums = [expect_size(context.new_dynamic_size(min=FEWEST), EXPECTED[0]) for _ in range(is_active.shape[1])]
    rows = [planes[0].new_empty((6, num, slots)) for num in nums]
    return rows, [planes[0].new_empty((num,), dtype=torch.int64) for num in nums]


def _row_length(count: Int[Tensor, "link env"], num_blocks: int, size: int) -> int | None:
    """Return the number of blocks of a row that costs least, or None if to sum over all points costs little more.

    Args:
        count: Number of active blocks.
        num_blocks: How many there are.
        size: Points of each.
    """
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
    found = is_active.transpose(0, 1).reshape(-1).nonzero()[:, 0]
    pair = torch.arange(num_links * num_envs).view(num_links, num_envs)
    there = torch.arange(num_envs) * num_links + torch.arange(num_links)[:, None]
    count, num_rows = count.reshape(-1), num_rows.reshape(-1)
    place = length * (num_rows.cumsum(0) - num_rows) - (count.cumsum(0) - count)
    index = torch.full((int(num_rows.sum()) * length,), -1)
    index[torch.arange(len(found)) + torch.repeat_interleave(place, count)] = found + torch.repeat_interleave(
        num_blocks * (there - pair).reshape(-1), count
    )
    return index
