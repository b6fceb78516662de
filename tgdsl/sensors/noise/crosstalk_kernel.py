"""The products of `filters.crosstalk`, of all links in one Triton kernel, for a GPU in float32 without derivatives.

A program takes one tile, some outputs of one link, and several blocks of lines. It holds the tile's part of the link's operator
and reads the signal while the block before is multiplied. Tiles of the same lines run side by side: links begin anywhere in a
row, so neighbours share the memory's sectors at their edges, which a cache then joins.

Shapes: `line` environments and channels, `row` the taxels of all links, `to` and `from` those of one link, `tile` tiles.
"""

# What a kernel's types are only Triton's compiler knows.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.library import triton_op, wrap_triton

MIN_BLOCK, BLOCK, LINES = 16, 64, 64
"""Fewest numbers along each side of a product of blocks, most outputs of a tile, and lines of a block."""
LARGEST = 2 * BLOCK
"""Most taxels of a link: a program holds a tile's part of the operator for all its lines, in registers and shared memory."""
NUM_PROGRAMS, MAX_STEPS = 768, 8
"""Programs that a GPU should have, three for each that an H200 runs at once, and most blocks of lines of a program.

There should be many: those of small links end early.
"""
COLUMNS = tl.constexpr(4)
"""Of the table of tiles: the link's first row, its number of taxels, where its operator begins, and the tile's first output."""


@triton_op("tgdsl::spread", mutates_args={})
def spread(signal: Tensor, operators: Sequence[Tensor]) -> Tensor:
    """Return each link's slice of all lines, multiplied by its operator, (line, row).

    Args:
        signal: What there is before, (line, row), contiguous.
        operators: W (to, from) of each link, in the order of their rows, which together are all.
    """
    return launch(wrap_triton(kernel), signal, operators)


def launch(kernel: Any, signal: Float[Tensor, "line row"], operators: Sequence[Float[Tensor, "to from"]]) -> Tensor:
    """Run the kernel, plain or wrapped, on the arguments of `spread`."""
    assert signal.is_contiguous()
    num_lines, num_rows = signal.shape
    found = torch.empty_like(signal)
    largest = max(len(operator) for operator in operators)
    assert largest <= LARGEST
    block, rest = _padded(min(largest, BLOCK)), _padded(largest - BLOCK) if largest > BLOCK else 0
    operators_flat, tiles = _joined(operators, block)
    num_tiles, num_blocks = len(tiles) // COLUMNS.value, triton.cdiv(num_lines, LINES)
    steps = min(max(num_blocks * num_tiles // NUM_PROGRAMS, 1), MAX_STEPS)
    if signal.numel() > 0:
        kernel[(num_tiles * triton.cdiv(num_blocks, steps),)](
            signal, operators_flat, tiles, found, num_lines, num_rows, num_tiles, steps,
            LINES=LINES, SIZE=block, REST=rest, num_warps=4, num_stages=2 if rest == BLOCK else 3,
        )  # fmt: skip
    return found


def _padded(size: int) -> int:
    """Return along how many numbers a product of blocks goes."""
    return max(triton.next_power_of_2(size), MIN_BLOCK)


def _tiles(sizes: Sequence[int], tile: int) -> list[int]:
    """Return the table of tiles, row by row."""
    found, row, place = [], 0, 0
    for size in sizes:
        found += [number for first in range(0, size, tile) for number in (row, size, place, first)]
        row, place = row + size, place + size * size
    return found


@torch.library.custom_op("tgdsl::joined", mutates_args=(), schema="(Tensor[] operators, int tile) -> (Tensor, Tensor)")
def _joined(operators: Sequence[Tensor], tile: int) -> tuple[Tensor, Tensor]:
    """Return all operators one after the other, and the table of tiles.

    A compiler would make a kernel of each part. These are three in all, and no copy from the host, which a CUDA graph could
    not hold.
    """
    numbers = _tiles([len(operator) for operator in operators], tile)
    tiles = operators[0].new_zeros(len(numbers), dtype=torch.int32)
    torch.ops.aten._foreach_add_.ScalarList(list(tiles.unbind()), numbers)
    return torch.cat([operator.flatten() for operator in operators]), tiles


@_joined.register_fake
def _(operators: Sequence[Tensor], tile: int) -> tuple[Tensor, Tensor]:
    sizes = [len(operator) for operator in operators]
    like = operators[0]
    return like.new_empty(sum(n * n for n in sizes)), like.new_empty(len(_tiles(sizes, tile)), dtype=torch.int32)


@triton.jit
def kernel(
    signal, operators, tiles, found, num_lines, num_rows, num_tiles, steps,
    LINES: tl.constexpr, SIZE: tl.constexpr, REST: tl.constexpr,
):  # fmt: skip
    """Multiply `steps` blocks of lines by one tile of a link's operator, in one or two parts."""
    tiles += tl.program_id(0) % num_tiles * COLUMNS
    row, size, place, first = tl.load(tiles), tl.load(tiles + 1), tl.load(tiles + 2), tl.load(tiles + 3)
    first_line = tl.cast(tl.program_id(0) // num_tiles, tl.int64) * (LINES * steps)
    num_left = tl.minimum(num_lines - first_line, LINES * steps).to(tl.int32)
    signal += first_line * num_rows + row
    found += first_line * num_rows + row

    to, link_from, rest_from = first + tl.arange(0, SIZE), tl.arange(0, SIZE), SIZE + tl.arange(0, REST if REST else SIZE)
    is_to = (to < size)[None, :]
    is_from, is_rest = link_from < size, rest_from < size
    operators += place + (to * size)[None, :]
    # Padding is zero on both sides of a product: what is not a number in a link stays in it.
    operator = tl.load(operators + link_from[:, None], is_to & is_from[:, None], 0.0)
    if REST:
        rest = tl.load(operators + rest_from[:, None], is_to & is_rest[:, None], 0.0)
    for start in range(0, num_left, LINES):
        line = start + tl.arange(0, LINES)
        # Beyond the last line the last is read again, so that reading needs no mask of lines.
        own = (tl.minimum(line, num_left - 1) * num_rows)[:, None]
        part = tl.load((signal + link_from)[None, :] + own, is_from[None, :], 0.0)
        total = tl.dot(part, operator, input_precision="tf32x3")
        if REST:
            part = tl.load((signal + rest_from)[None, :] + own, is_rest[None, :], 0.0)
            total = tl.dot(part, rest, total, input_precision="tf32x3")
        tl.store((found + to)[None, :] + (line * num_rows)[:, None], total, is_to & (line < num_left)[:, None])
