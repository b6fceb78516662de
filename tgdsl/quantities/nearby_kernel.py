"""Moments from a field on a GPU, in one kernel: each probe's place in the object's frame, the lookup, the way back.

It is what `moment_sums.felt_moments` computes for an object with a field and without planes. The four numbers of a node are one
load of 16 bytes. Nothing is loaded for a probe that is inactive or outside the lattice: it reads zero.

Shapes: `env` environments, `taxel` probes, `pair` pairs of the object, `node` nodes of all its fields, `*point` broadcasts with
(env, taxel).
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.pairs import Pairs

# Only Triton's compiler knows the types in a kernel.
# pyright: reportGeneralTypeIssues=false


BLOCK = 128  # probes of a program, which has four warps: so each thread loads whole nodes, and none is sent to another one


def felt_moments(pairs: Pairs, own: slice, pos: Vec, source: Any, field: Any) -> tuple[Tensor, ...]:
    """Return S0 and the parts of S1 of a `MomentSource` with a field, in the frames of the probes' links."""
    lattice = torch.stack(torch.broadcast_tensors(*field.origin, field.cell), dim=-1)
    counts = (field.first, *field.num)
    numbers, table = [part for part in counts if isinstance(part, int)], None
    if len(numbers) < 4:
        parts = (torch.as_tensor(part, device=lattice.device) for part in counts)
        numbers, table = [0] * 4, torch.stack(torch.broadcast_tensors(*parts), dim=-1).int()
    pose = [part[:, own] for part in (*pairs.rotation, *pairs.offset)]
    return _felt_moments(
        pose, list(pos), source.pair, source.radius, source.shift, field.values, lattice, table, numbers
    ).unbind()


@triton_op("tgdsl::felt_moments", mutates_args={})
def _felt_moments(
    pose: list[Tensor],
    pos: list[Tensor],
    pair: Tensor,
    radius: Tensor,
    shift: Tensor | None,
    values: Tensor,
    lattice: Tensor,
    table: Tensor | None,
    numbers: list[int],
) -> Tensor:
    """Return S0 and S1, (4, env, taxel) [m³, m⁴], in the frame of each probe's link."""
    num_envs, num_taxels = pose[0].shape[0], pair.shape[0]
    moments = pose[0].new_empty((4, num_envs, num_taxels))
    num_points = num_envs * num_taxels
    wrap_triton(nearby_kernel)[(triton.cdiv(num_points, BLOCK),)](
        moments, *pose, *pos, pair, radius.contiguous(), radius if shift is None else shift.contiguous(),
        values, lattice, lattice if table is None else table, num_points, *numbers, *pose[0].stride(),
        num_taxels if radius.ndim == 2 and radius.shape[0] > 1 else 0,
        *_steps(lattice), *((0, 0) if table is None else _steps(table)),
        NUM_TAXELS=num_taxels, NUM_CHANNELS=values.shape[1], IS_SHIFTED=shift is not None, IS_ONE=table is None, BLOCK=BLOCK,
    )  # fmt: skip
    return moments


def _steps(rows: Tensor) -> tuple[int, int]:
    *_, num_envs, num_taxels, width = (1, 1, *rows.shape)
    return num_taxels * width if num_envs > 1 else 0, width if num_taxels > 1 else 0


@triton.jit
def _along(place, num):
    inner = tl.clamp(place, 0.0, tl.cast(num - 1, tl.float32), propagate_nan=tl.PropagateNan.ALL)
    lower = tl.minimum(tl.floor(inner), tl.cast(num - 2, tl.float32))
    return lower.to(tl.int32), inner - lower, (inner > 0) & (inner < num - 1)


@triton.jit
def nearby_kernel(
    moments_ptr, xx_ptr, xy_ptr, xz_ptr, yx_ptr, yy_ptr, yz_ptr, zx_ptr, zy_ptr, zz_ptr,
    offset_x_ptr, offset_y_ptr, offset_z_ptr, x_ptr, y_ptr, z_ptr,
    pair_ptr, radius_ptr, shift_ptr, values_ptr, lattice_ptr, table_ptr,
    num_points, first, num_x, num_y, num_z, pose_env_step, pose_pair_step, radius_env_step,
    lattice_env_step, lattice_taxel_step, table_env_step, table_taxel_step,
    NUM_TAXELS: tl.constexpr, NUM_CHANNELS: tl.constexpr, IS_SHIFTED: tl.constexpr, IS_ONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the moments of `BLOCK` probes, counted through all environments."""
    start = tl.program_id(0).to(tl.int64) * BLOCK
    is_probe = start + tl.arange(0, BLOCK) < num_points
    # Environments after the program's first are counted from it, in 32 bits.
    first_env = start // NUM_TAXELS
    offset = (start - first_env * NUM_TAXELS).to(tl.int32) + tl.arange(0, BLOCK)
    env, taxel = offset // NUM_TAXELS, offset % NUM_TAXELS

    pair = tl.load(pair_ptr + taxel).to(tl.int32)
    pose = first_env * pose_env_step + (env * pose_env_step + pair * pose_pair_step)
    xx = tl.load(xx_ptr + pose, is_probe)
    xy = tl.load(xy_ptr + pose, is_probe)
    xz = tl.load(xz_ptr + pose, is_probe)
    yx = tl.load(yx_ptr + pose, is_probe)
    yy = tl.load(yy_ptr + pose, is_probe)
    yz = tl.load(yz_ptr + pose, is_probe)
    zx = tl.load(zx_ptr + pose, is_probe)
    zy = tl.load(zy_ptr + pose, is_probe)
    zz = tl.load(zz_ptr + pose, is_probe)
    x, y, z = tl.load(x_ptr + taxel), tl.load(y_ptr + taxel), tl.load(z_ptr + taxel)
    point_x = xx * x + xy * y + xz * z + tl.load(offset_x_ptr + pose, is_probe)
    point_y = yx * x + yy * y + yz * z + tl.load(offset_y_ptr + pose, is_probe)
    point_z = zx * x + zy * y + zz * z + tl.load(offset_z_ptr + pose, is_probe)

    if not IS_ONE:
        table = table_ptr + first_env * table_env_step + (env * table_env_step + taxel * table_taxel_step)
        first = tl.load(table, is_probe)
        num_x = tl.load(table + 1, is_probe)
        num_y = tl.load(table + 2, is_probe)
        num_z = tl.load(table + 3, is_probe)
    lattice = lattice_ptr + first_env * lattice_env_step + (env * lattice_env_step + taxel * lattice_taxel_step)
    cell = tl.load(lattice + 3, is_probe)
    cell_x, along_x, is_in_x = _along((point_x - tl.load(lattice, is_probe)) / cell, num_x)
    cell_y, along_y, is_in_y = _along((point_y - tl.load(lattice + 1, is_probe)) / cell, num_y)
    cell_z, along_z, is_in_z = _along((point_z - tl.load(lattice + 2, is_probe)) / cell, num_z)

    radius = tl.load(radius_ptr + first_env * radius_env_step + (env * radius_env_step + taxel), is_probe, 0.0)
    is_near = is_in_x & is_in_y & is_in_z & (radius > 0)
    channel = tl.arange(0, 4)
    node = first + (cell_x * num_y + cell_y) * num_z + cell_z
    total = tl.zeros((BLOCK, 4), tl.float32)
    if IS_SHIFTED:
        shift = tl.load(shift_ptr + start + tl.arange(0, BLOCK), is_probe)
    for corner in tl.static_range(8):
        weight_x = along_x if corner // 4 else 1 - along_x
        weight_y = along_y if corner // 2 % 2 else 1 - along_y
        weight_z = along_z if corner % 2 else 1 - along_z
        step = (corner // 4 * num_y + corner // 2 % 2) * num_z + corner % 2
        row = values_ptr + ((node + step) * NUM_CHANNELS)[:, None] + channel[None, :]
        value = tl.load(row, is_near[:, None], 0.0)
        if IS_SHIFTED:
            value += shift[:, None] * tl.load(row + 4, is_near[:, None], 0.0)
        total += (weight_x * weight_y * weight_z)[:, None] * value

    even, odd = tl.split(tl.reshape(total, (BLOCK, 2, 2)))
    mass, first_y = tl.split(even)
    first_x, first_z = tl.split(odd)
    if IS_SHIFTED:  # to first order S0 becomes negative near the edge of the sensing ball
        mass = tl.maximum(mass, 0.0, propagate_nan=tl.PropagateNan.ALL)
    mass = tl.where(radius > 0, mass, 0.0)
    first_x = tl.where(radius > 0, first_x, 0.0)
    first_y = tl.where(radius > 0, first_y, 0.0)
    first_z = tl.where(radius > 0, first_z, 0.0)
    moments = moments_ptr + start + tl.arange(0, BLOCK)
    plane = tl.cast(num_points, tl.int64)
    tl.store(moments, mass, is_probe)
    tl.store(moments + plane, xx * first_x + yx * first_y + zx * first_z, is_probe)
    tl.store(moments + 2 * plane, xy * first_x + yy * first_y + zy * first_z, is_probe)
    tl.store(moments + 3 * plane, xz * first_x + yz * first_y + zz * first_z, is_probe)
