"""The sum over points of `point_anchors` as one Triton kernel, for a GPU in float32 without derivatives.

A program takes one environment and a tile of markers of one link, which its lanes hold; points come one after the other. Most
of them pull at nothing: groups of those are passed over, so points that are near on the object should be near among all. The
in-plane offset Π_n(x − z) is found along two tangents of each marker, scaled so that its square is the exponent of 2.

Shapes: `env` environments, `link` links that may meet an object, `point` points, `word` groups of 32 of them, `marker` markers
of all links, `tile` tiles.
"""

# What a kernel's types are only Triton's compiler knows.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from typing import Any

import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.library import triton_op, wrap_triton

GROUP = tl.constexpr(8)
"""Points that are passed over together."""
LOG2_E = tl.constexpr(1.4426950408889634)


@triton_op("tgdsl::point_sum", mutates_args={})
def point_sum(
    pos: list[Tensor],
    strength: list[Tensor],
    pulling: Tensor | None,
    tiles: Tensor,
    block: int,
    marker: list[Tensor],
    normal: list[Tensor],
    falloff: Tensor,
) -> Tensor:
    """Return Σ_p s_p exp(−λ |Π_nj(x_j − z_p)|²), (3, env, marker) [m²]; see `launch`."""
    return launch(wrap_triton(point_sum_kernel), pos, strength, pulling, tiles, block, marker, normal, falloff)


def launch(
    run: Any,
    pos: list[Float[Tensor, "env link point"]],
    strength: list[Float[Tensor, "env link point"]],
    pulling: Int[Tensor, "env link word"] | None,
    tiles: Int[Tensor, "tile 3"],
    block: int,
    marker: list[Float[Tensor, " marker"]],
    normal: list[Float[Tensor, " marker"]],
    falloff: Float[Tensor, ""],
) -> Float[Tensor, "3 env marker"]:
    """Run the kernel, plain or wrapped.

    Args:
        run: The kernel.
        pos: z_p, three planes in each link's frame [m].
        strength: s_p, likewise [m²]; all six lie in memory alike.
        pulling: A bit for each point that pulls; the others' numbers mean nothing. None: it shows in the strengths.
        tiles: What `points.point_tiles` returns; markers of no link read 0.
        block: `points.tile_size`.
        marker: x_j, three planes [m].
        normal: Unit normals n_j, likewise.
        falloff: λ [1/m²].
    """
    num_envs, num_links, num_points = pos[0].shape
    found = pos[0].new_empty((3, num_envs, marker[0].shape[0]))
    grid = (num_envs, tiles.shape[0])
    planes = (*pos, *strength, *(part.contiguous() for part in (*marker, *normal)))
    run[grid](
        *planes, falloff, found, tiles if pulling is None else pulling, tiles,
        num_links, num_points, pos[0].stride(0), pos[0].stride(1), marker[0].shape[0],
        IS_TOLD=pulling is not None, BLOCK=block, num_warps=1,
    )  # fmt: skip
    return found


@triton.jit
def point_sum_kernel(
    z_x, z_y, z_z, s_x, s_y, s_z, x_x, x_y, x_z, n_x, n_y, n_z, falloff, found, told, tiles,
    num_links, num_points, stride_env, stride_link, num_markers, IS_TOLD: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sum over the points of one environment for one tile of markers."""
    env, tile = tl.program_id(0).to(tl.int64), tiles + 3 * tl.program_id(1)
    link, first, last = tl.load(tile), tl.load(tile + 1), tl.load(tile + 2)
    marker = first + tl.arange(0, BLOCK)
    is_marker = marker < last
    at = env * stride_env + tl.maximum(link, 0) * stride_link
    z_x, z_y, z_z, s_x, s_y, s_z = z_x + at, z_y + at, z_z + at, s_x + at, s_y + at, s_z + at
    num_points = tl.where(link < 0, 0, num_points)
    num_words = tl.cdiv(num_points, 32)  # none of no link
    told += (env * num_links + link) * num_words
    has_any = num_points > 0
    if IS_TOLD:
        most = tl.zeros((32,), tl.int32)
        for chunk in range(0, num_words, 32):
            word = chunk + tl.arange(0, 32)
            most |= tl.load(told + word, word < num_words, 0)
        has_any = tl.max((most != 0).to(tl.int32), axis=0) != 0
    none = tl.zeros((BLOCK,), tl.float32)
    total = (none, none, none)
    if has_any:
        nx, ny = tl.load(n_x + marker, is_marker, 0.0), tl.load(n_y + marker, is_marker, 0.0)
        nz = tl.load(n_z + marker, is_marker, 1.0)
        # Two tangents without a branch that loses digits: Duff et al., "Building an orthonormal basis, revisited", 2017.
        sign = tl.where(nz < 0, -1.0, 1.0)
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        scale = tl.sqrt(tl.load(falloff) * LOG2_E)
        u = (scale * (1.0 + sign * nx * nx * a), scale * sign * b, -scale * sign * nx)
        v = (scale * b, scale * (sign + ny * ny * a), -scale * ny)
        x, y = tl.load(x_x + marker, is_marker, 0.0), tl.load(x_y + marker, is_marker, 0.0)
        z = tl.load(x_z + marker, is_marker, 0.0)
        middle = (u[0] * x + u[1] * y + u[2] * z, v[0] * x + v[1] * y + v[2] * z)
        if IS_TOLD:
            for chunk in range(0, num_words, 32):
                word = chunk + tl.arange(0, 32)
                words = tl.load(told + word, word < num_words, 0)
                busy = tl.sum((words != 0).to(tl.int32) << tl.arange(0, 32), axis=0)
                for w in range(tl.minimum(32, num_words - chunk)):
                    if (busy >> w) & 1:
                        bits = tl.load(told + chunk + w)
                        for group in range(4):
                            if (bits >> (8 * group)) & 255:
                                for bit in range(8 * group, 8 * group + 8):
                                    if (bits >> bit) & 1:
                                        p = 32 * (chunk + w) + bit
                                        pos, strength = (z_x + p, z_y + p, z_z + p), (s_x + p, s_y + p, s_z + p)
                                        total = _added(total, middle, u, v, pos, strength)
        else:
            # The points of an environment share a pose: one that is not a number shows in the first, whether it pulls or not.
            rest = tl.load(z_x) + tl.load(z_y) + tl.load(z_z)
            total = (none + 0.0 * rest, none + 0.0 * rest, none + 0.0 * rest)
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
                        start = chunk + group * GROUP
                        for p in tl.range(start, tl.minimum(start + GROUP, num_points), loop_unroll_factor=4):
                            total = _added(total, middle, u, v, (z_x + p, z_y + p, z_z + p), (s_x + p, s_y + p, s_z + p))
    place = found + env * num_markers + marker
    plane = tl.num_programs(0).to(tl.int64) * num_markers
    tl.store(place, total[0], is_marker)
    tl.store(place + plane, total[1], is_marker)
    tl.store(place + 2 * plane, total[2], is_marker)


@triton.jit
def _added(total, middle, u, v, pos, strength):
    """Return the sum with one point more, which is in memory there; `u` and `v` are the markers' scaled tangents."""
    x, y, z = tl.load(pos[0]), tl.load(pos[1]), tl.load(pos[2])
    along_u = middle[0] - u[0] * x - u[1] * y - u[2] * z
    along_v = middle[1] - v[0] * x - v[1] * y - v[2] * z
    fall = tl.exp2(-along_u * along_u - along_v * along_v)
    return (
        total[0] + fall * tl.load(strength[0]), total[1] + fall * tl.load(strength[1]),
        total[2] + fall * tl.load(strength[2]),
    )  # fmt: skip
