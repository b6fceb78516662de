"""The sum over points of `point_anchors` as one Triton kernel, for a GPU in float32 without derivatives.

A program takes one environment and a block of markers, which its lanes hold; points come one after the other. Most of them pull
at nothing: groups of those are passed over, so points that are near on the object should be near in the list. The in-plane
offset Π_n(x − z) is found along two tangents of each marker, scaled so that its square is the exponent of 2.

Shapes: `env` environments, `point` points, `marker` markers of one link.
"""

# What a kernel's types are only Triton's compiler knows.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.library import triton_op, wrap_triton

MAX_BLOCK = 128
"""Largest number of markers of a program, which is one warp."""
GROUP = tl.constexpr(8)
"""Points that are passed over together."""
LOG2_E = tl.constexpr(1.4426950408889634)


@triton_op("tgdsl::point_sum", mutates_args={})
def point_sum(
    pos: Sequence[Tensor], strength: Sequence[Tensor], marker: Sequence[Tensor], normal: Sequence[Tensor], falloff: Tensor
) -> Tensor:
    """Return Σ_p s_p exp(−λ |Π_nj(x_j − z_p)|²), (3, env, marker) [m²].

    Args:
        pos: z_p, three planes (env, point) with rows of one stride [m].
        strength: s_p, likewise [m²].
        marker: x_j, three planes (marker,) [m].
        normal: Unit normals n_j, likewise.
        falloff: λ [1/m²], a scalar.
    """
    return launch(wrap_triton(kernel), pos, strength, marker, normal, falloff)


def launch(
    kernel: Any,
    pos: Sequence[Tensor],
    strength: Sequence[Tensor],
    marker: Sequence[Tensor],
    normal: Sequence[Tensor],
    falloff: Tensor,
) -> Float[Tensor, "3 env marker"]:
    """Run the kernel, plain or wrapped, on the arguments of `point_sum`."""
    num_envs, num_points = pos[0].shape
    (num_markers,) = marker[0].shape
    found = pos[0].new_empty((3, num_envs, num_markers))
    block = min(max(triton.next_power_of_2(num_markers), 32), MAX_BLOCK)
    grid = (num_envs, triton.cdiv(num_markers, block))
    planes = (*pos, *strength, *marker, *normal)
    kernel[grid](*planes, falloff, found, num_points, pos[0].stride(0), num_markers, BLOCK=block, num_warps=1)
    return found


@triton.jit
def kernel(
    z_x, z_y, z_z, s_x, s_y, s_z, x_x, x_y, x_z, n_x, n_y, n_z, falloff, found,
    num_points, stride, num_markers, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sum over all points of one environment for one block of markers."""
    env = tl.program_id(0).to(tl.int64)
    z_x, z_y, z_z = z_x + env * stride, z_y + env * stride, z_z + env * stride
    s_x, s_y, s_z = s_x + env * stride, s_y + env * stride, s_z + env * stride
    marker = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    is_marker = marker < num_markers
    nx, ny = tl.load(n_x + marker, is_marker, 0.0), tl.load(n_y + marker, is_marker, 0.0)
    nz = tl.load(n_z + marker, is_marker, 1.0)
    # Two tangents without a branch that loses digits: Duff et al., "Building an orthonormal basis, revisited", 2017.
    sign = tl.where(nz < 0, -1.0, 1.0)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    scale = tl.sqrt(tl.load(falloff) * LOG2_E)
    ux, uy, uz = scale * (1.0 + sign * nx * nx * a), scale * sign * b, -scale * sign * nx
    vx, vy, vz = scale * b, scale * (sign + ny * ny * a), -scale * ny
    x, y = tl.load(x_x + marker, is_marker, 0.0), tl.load(x_y + marker, is_marker, 0.0)
    z = tl.load(x_z + marker, is_marker, 0.0)
    u, v = ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
    # The points of an environment share a pose: one that is not a number shows in the first, whether it pulls or not.
    rest = 0.0 * (tl.load(z_x) + tl.load(z_y) + tl.load(z_z))
    total_x = tl.zeros((BLOCK,), tl.float32) + rest
    total_y, total_z = total_x, total_x
    for chunk in range(0, num_points, 32 * GROUP):
        point = chunk + tl.arange(0, 32 * GROUP)
        is_point = point < num_points
        pulls = tl.load(s_x + point, is_point, 0.0) != 0.0
        pulls |= tl.load(s_y + point, is_point, 0.0) != 0.0
        pulls |= tl.load(s_z + point, is_point, 0.0) != 0.0
        groups = tl.max(tl.reshape(pulls.to(tl.int32), (32, GROUP)), axis=1)
        pulling = tl.sum(groups << tl.arange(0, 32))
        for group in range(32):
            if (pulling >> group) & 1:
                first = chunk + group * GROUP
                for p in tl.range(first, tl.minimum(first + GROUP, num_points), loop_unroll_factor=4):
                    zx, zy, zz = tl.load(z_x + p), tl.load(z_y + p), tl.load(z_z + p)
                    along_u = u - ux * zx - uy * zy - uz * zz
                    along_v = v - vx * zx - vy * zy - vz * zz
                    fall = tl.exp2(-along_u * along_u - along_v * along_v)
                    total_x += fall * tl.load(s_x + p)
                    total_y += fall * tl.load(s_y + p)
                    total_z += fall * tl.load(s_z + p)
    place = found + env * num_markers + marker
    plane = tl.num_programs(0).to(tl.int64) * num_markers
    tl.store(place, total_x, is_marker)
    tl.store(place + plane, total_y, is_marker)
    tl.store(place + 2 * plane, total_z, is_marker)
