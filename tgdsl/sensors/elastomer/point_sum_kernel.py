"""The sum over points of `point_anchors` as one Triton kernel, for a GPU in float32 without derivatives.

A program takes one environment and some tiles of markers, each of one link: a thread per marker, a loop over the points. Few
points are in contact. With `count` they come first and the loop ends after them; without it the loop skips groups of points
that all have strength 0, so points that are near on the object should be near among all. The in-plane offset Π_n(x − z) is
taken along two tangents of each marker, scaled so that its square is the exponent of 2.

Shapes: `env` environments, `link` links that may meet an object, `point` points, `marker` markers of all links, `tile`
tiles.
"""

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from tgdsl.geometry.shapes_kernel import LOG2_E

GROUP = tl.constexpr(8)  # points that are passed over together
TILES = 4  # tiles of a program where the number of points that load is given: for most tiles it is 0


@triton_op("tgdsl::point_sum", mutates_args={})
def point_sum(
    pos: list[Tensor],
    strength: list[Tensor],
    count: Tensor | None,
    tiles: Tensor,
    block: int,
    marker: list[Tensor],
    normal: list[Tensor],
    falloff: Tensor,
) -> Tensor:
    """Return Σ_p s_p exp(−λ |Π_nj(x_j − z_p)|²), (3, env, marker) [m²].

    Args:
        pos: z_p, three planes (env, link, point) in each link's frame [m].
        strength: s_p, in the same way [m²]; all six lie in memory alike.
        count: Number of active points of each link, (env, link); they come first. None: inactive ones have strength 0.
        tiles: What `points.point_tiles` returns, (tile, 3); markers of no link read 0.
        block: `points.tile_size`.
        marker: x_j, three planes (marker,) [m].
        normal: Unit normals n_j, in the same way.
        falloff: λ [1/m²].
    """
    num_envs, num_links, num_points = pos[0].shape
    result = pos[0].new_empty((3, num_envs, marker[0].shape[0]))
    of_program = 1 if count is None else TILES
    planes = (*pos, *strength, *(part.contiguous() for part in (*marker, *normal)))
    wrap_triton(point_sum_kernel)[(num_envs, triton.cdiv(tiles.shape[0], of_program))](
        *planes, falloff, result, tiles if count is None else count, tiles,
        tiles.shape[0], num_links, num_points, pos[0].stride(0), pos[0].stride(1), marker[0].shape[0],
        HAS_COUNT=count is not None, TILES=of_program, BLOCK=block, num_warps=1,
    )  # fmt: skip
    return result


@triton.jit
def point_sum_kernel(
    z_x, z_y, z_z, s_x, s_y, s_z, x_x, x_y, x_z, n_x, n_y, n_z, falloff, result, count, tiles,
    num_tiles, num_links, num_points, stride_env, stride_link, num_markers,
    HAS_COUNT: tl.constexpr, TILES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sum over the points of one environment for some tiles of markers."""
    env, first_tile = tl.program_id(0).to(tl.int64), tl.program_id(1) * TILES
    tile_ids = first_tile + tl.arange(0, TILES)
    links = tl.load(tiles + 3 * tile_ids, tile_ids < num_tiles, -1)
    count += env * num_links
    are_links = links >= 0
    num_active = tl.where(are_links, num_points, 0)
    if HAS_COUNT:
        num_active = tl.load(count + links, are_links, 0)
    busy = tl.sum((num_active > 0).to(tl.int32) << tl.arange(0, TILES), axis=0)
    plane = tl.num_programs(0).to(tl.int64) * num_markers
    result += env * num_markers
    for i in range(tl.minimum(TILES, num_tiles - first_tile)):
        tile = tiles + 3 * (first_tile + i)
        link, first, last = tl.load(tile), tl.load(tile + 1), tl.load(tile + 2)
        marker = first + tl.arange(0, BLOCK)
        is_marker = marker < last
        none = tl.zeros((BLOCK,), tl.float32)
        total = (none, none, none)
        if (busy >> i) & 1:
            frame = _frame((x_x, x_y, x_z), (n_x, n_y, n_z), marker, is_marker, tl.load(falloff))
            at = env * stride_env + link * stride_link
            pos, strength = (z_x + at, z_y + at, z_z + at), (s_x + at, s_y + at, s_z + at)
            if HAS_COUNT:
                for p in tl.range(0, tl.load(count + link), loop_unroll_factor=4):
                    total = _added(total, frame, pos, strength, p)
            else:
                total = _sum_of_all(total, frame, pos, strength, num_points)
        place = result + marker
        tl.store(place, total[0], is_marker)
        tl.store(place + plane, total[1], is_marker)
        tl.store(place + 2 * plane, total[2], is_marker)


@triton.jit
def _frame(pos, normal, marker, is_marker, falloff):
    """Return where markers are along two tangents of their tile_ids, and these tangents, scaled by √(λ log₂ e)."""
    nx, ny = tl.load(normal[0] + marker, is_marker, 0.0), tl.load(normal[1] + marker, is_marker, 0.0)
    nz = tl.load(normal[2] + marker, is_marker, 1.0)
    # Two tangents without a branch that loses digits: Duff et al., "Building an orthonormal basis, revisited", 2017.
    sign = tl.where(nz < 0, -1.0, 1.0)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    scale = tl.sqrt(falloff * LOG2_E)
    u = (scale * (1.0 + sign * nx * nx * a), scale * sign * b, -scale * sign * nx)
    v = (scale * b, scale * (sign + ny * ny * a), -scale * ny)
    x, y = tl.load(pos[0] + marker, is_marker, 0.0), tl.load(pos[1] + marker, is_marker, 0.0)
    z = tl.load(pos[2] + marker, is_marker, 0.0)
    return u[0] * x + u[1] * y + u[2] * z, v[0] * x + v[1] * y + v[2] * z, u, v


@triton.jit
def _sum_of_all(total, frame, pos, strength, num_points):
    """Return the sum over all points; inactive groups are skipped."""
    # The points of an environment share a pose: one that is not a number shows in the first, whether it is active or not.
    rest = 0.0 * (tl.load(pos[0]) + tl.load(pos[1]) + tl.load(pos[2]))
    total = (total[0] + rest, total[1] + rest, total[2] + rest)
    for start in range(0, num_points, 32 * GROUP):
        point = start + tl.arange(0, 32 * GROUP)
        is_point = point < num_points
        is_active = tl.load(strength[0] + point, is_point, 0.0) != 0.0
        is_active |= tl.load(strength[1] + point, is_point, 0.0) != 0.0
        is_active |= tl.load(strength[2] + point, is_point, 0.0) != 0.0
        groups = tl.max(tl.reshape(is_active.to(tl.int32), (32, GROUP)), axis=1)
        active_groups = tl.sum(groups << tl.arange(0, 32))
        for group in range(32):
            if (active_groups >> group) & 1:
                first = start + group * GROUP
                for p in tl.range(first, tl.minimum(first + GROUP, num_points), loop_unroll_factor=4):
                    total = _added(total, frame, pos, strength, p)
    return total


@triton.jit
def _added(total, frame, pos, strength, p):
    """Return the sum with one point more."""
    x, y, z = tl.load(pos[0] + p), tl.load(pos[1] + p), tl.load(pos[2] + p)
    at_u, at_v, u, v = frame
    along_u = at_u - u[0] * x - u[1] * y - u[2] * z
    along_v = at_v - v[0] * x - v[1] * y - v[2] * z
    fall = tl.exp2(-along_u * along_u - along_v * along_v)
    return (
        total[0] + fall * tl.load(strength[0] + p), total[1] + fall * tl.load(strength[1] + p),
        total[2] + fall * tl.load(strength[2] + p),
    )  # fmt: skip
