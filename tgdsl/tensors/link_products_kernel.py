"""`link_products` as one Triton kernel for all links.

A program takes one tile, some taxels of one link and one plane, and several blocks of lines. It holds the tile's part of the
link's matrix, unless a link is too large for that, and reads lines while the block before is multiplied. Tiles of the same
lines run side by side: links begin anywhere in a row, so neighbours share the memory's sectors at their edges, which a cache
then joins.

Shapes: as in `link_products`, and `tile` tiles.
"""

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from tgdsl.tensors.torch_internals import add_each

MIN_BLOCK, BLOCK, LINES = 16, 64, 64
"""Fewest numbers along each side of a product of blocks, most outputs of a tile, and lines of a block.

A tile holds its part of a matrix of up to twice as many taxels as it has outputs.
"""
DEPTH = 32
"""Taxels that are multiplied at a time where a matrix is not held: half of a block pads less, and leaves more registers."""
NUM_PROGRAMS, MAX_STEPS = 768, 8
"""Programs that a GPU should have, three for each that an H200 runs at once, and most blocks of lines of a program.

There should be many: programs of small links end early.
"""
COLUMNS = tl.constexpr(5)
"""Of the table of tiles: the link's first row, its number of taxels, where its matrix begins, the tile's first taxel, plane."""


@triton_op("tgdsl::link_products", mutates_args={})
def link_products(lines: Tensor, matrices: Sequence[Tensor]) -> Tensor:
    """Return Σ_from line[from] matrix[from] of each link, (plane, line, row).

    Args:
        lines: The values that are multiplied, (line, row), contiguous.
        matrices: (from, plane, to) of each link, in the order of their rows, which together are all.
    """
    assert lines.is_contiguous()
    num_lines, num_rows = lines.shape
    num_planes = matrices[0].shape[1]
    result = lines.new_empty((num_planes, num_lines, num_rows))
    largest = max(len(matrix) for matrix in matrices)
    block, is_held = _block([len(matrix) for matrix in matrices]), largest <= 2 * BLOCK
    rest = _padded(largest - block) if is_held and largest > block else 0
    flat, tiles = _joined(matrices, block)
    num_tiles, num_blocks = len(tiles) // COLUMNS.value, triton.cdiv(num_lines, LINES)
    steps = 1 if not is_held else min(max(num_blocks * num_tiles // NUM_PROGRAMS, 1), MAX_STEPS)
    stages = (2 if rest == BLOCK else 3) if is_held else 1  # more do not fit
    if lines.numel() > 0:
        wrap_triton(link_products_kernel)[(num_tiles * triton.cdiv(num_blocks, steps),)](
            lines, flat, tiles, result, num_lines, num_rows, num_planes, num_tiles, steps,
            LINES=LINES, SIZE=block, REST=rest, DEPTH=DEPTH, IS_HELD=is_held, num_warps=4, num_stages=stages,
        )  # fmt: skip
    return result


def _padded(size: int) -> int:
    return max(triton.next_power_of_2(size), MIN_BLOCK)  # pyright: ignore[reportReturnType]


def _block(sizes: Sequence[int]) -> int:
    """Return how many outputs a tile has: half of the most if that pads less, as with a link of 35 taxels among some of 20."""
    largest, half = max(sizes), BLOCK // 2
    if largest <= half or largest > BLOCK:
        return _padded(min(largest, BLOCK))
    work = sum(triton.cdiv(size, half) for size in sizes) * half * (half + _padded(largest - half))
    return half if work < len(sizes) * BLOCK * BLOCK else BLOCK


def _tiles(sizes: Sequence[int], num_planes: int, tile: int) -> list[int]:
    """Return the table of tiles, row by row."""
    result, row, place = [], 0, 0
    for size in sizes:
        for plane in range(num_planes):
            for first in range(0, size, tile):
                result += [row, size, place + plane * size, first, plane]
        row, place = row + size, place + size * num_planes * size
    return result


@torch.library.custom_op("tgdsl::joined", mutates_args=(), schema="(Tensor[] matrices, int tile) -> (Tensor, Tensor)")
def _joined(matrices: Sequence[Tensor], tile: int) -> tuple[Tensor, Tensor]:
    """Return all matrices one after the other, and the table of tiles."""
    numbers = _tiles([len(matrix) for matrix in matrices], matrices[0].shape[1], tile)
    tiles = matrices[0].new_zeros(len(numbers), dtype=torch.int32)
    add_each(tiles.unbind(), numbers)
    return torch.cat([matrix.flatten() for matrix in matrices]), tiles


@_joined.register_fake
def _(matrices: Sequence[Tensor], tile: int) -> tuple[Tensor, Tensor]:
    sizes, num_planes, like = [len(matrix) for matrix in matrices], matrices[0].shape[1], matrices[0]
    numbers = _tiles(sizes, num_planes, tile)
    return like.new_empty(sum(matrix.numel() for matrix in matrices)), like.new_empty(len(numbers), dtype=torch.int32)


@triton.jit
def link_products_kernel(
    lines, matrices, tiles, result, num_lines, num_rows, num_planes, num_tiles, steps,
    LINES: tl.constexpr, SIZE: tl.constexpr, REST: tl.constexpr, DEPTH: tl.constexpr, IS_HELD: tl.constexpr,
):  # fmt: skip
    """Multiply `steps` blocks of lines by one tile of a link's matrix."""
    tiles += tl.program_id(0) % num_tiles * COLUMNS
    row, size, place, first = tl.load(tiles), tl.load(tiles + 1), tl.load(tiles + 2), tl.load(tiles + 3)
    plane = tl.load(tiles + 4).to(tl.int64)
    first_line = tl.cast(tl.program_id(0) // num_tiles, tl.int64) * (LINES * steps)
    num_left = tl.minimum(num_lines - first_line, LINES * steps).to(tl.int32)
    lines += first_line * num_rows + row
    result += (plane * num_lines + first_line) * num_rows + row

    to, link_from, rest_from = first + tl.arange(0, SIZE), tl.arange(0, SIZE), SIZE + tl.arange(0, REST if REST else SIZE)
    is_to = (to < size)[None, :]
    is_from, is_rest = link_from < size, rest_from < size
    matrices += place + to[None, :]
    # Padding is zero on both sides of a product, so NaN in one link does not reach another.
    if IS_HELD:
        matrix = tl.load(matrices + (link_from * num_planes * size)[:, None], is_to & is_from[:, None], 0.0)
        if REST:
            rest = tl.load(matrices + (rest_from * num_planes * size)[:, None], is_to & is_rest[:, None], 0.0)
    for start in range(0, num_left, LINES):
        line = start + tl.arange(0, LINES)
        # Rows beyond the last line load the last line again: the load needs no mask of lines.
        offset = (tl.minimum(line, num_left - 1) * num_rows)[:, None]
        if IS_HELD:
            part = tl.load((lines + link_from)[None, :] + offset, is_from[None, :], 0.0)
            total = tl.dot(part, matrix, input_precision="tf32x3")
            if REST:
                part = tl.load((lines + rest_from)[None, :] + offset, is_rest[None, :], 0.0)
                total = tl.dot(part, rest, total, input_precision="tf32x3")
        else:
            total = tl.zeros((LINES, SIZE), tl.float32)
            for low in range(0, size, DEPTH):
                those = low + tl.arange(0, DEPTH)
                part = tl.load((lines + those)[None, :] + offset, (those < size)[None, :], 0.0)
                block = tl.load(matrices + (those * num_planes * size)[:, None], is_to & (those < size)[:, None], 0.0)
                total = tl.dot(part, block, total, input_precision="tf32x3")
        tl.store((result + to)[None, :] + (line * num_rows)[:, None], total, is_to & (line < num_left)[:, None])
