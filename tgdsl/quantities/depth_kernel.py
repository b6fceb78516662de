"""Points of an object in the links' frames, and how deep in the links' own surfaces, on a GPU, in one kernel.

It is what `points.link_points` finds of one geom of the links, where that is a grid. A program takes a link of an environment
and all points, a block after the other. Nothing is looked up where the gate is closed or a whole block is outside the grid.
Outside the distance reads +∞ and its gradient 0: grids hold all distances that those who ask for points want to know.

Shapes: `env` environments, `pair` pairs, `link` links that may meet the object, `point` its points, `case` 1, or `env` if the
object differs between environments, `node` nodes of all grids.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.library import triton_op, wrap_triton

from tgdsl.geometry.grid import Grid
from tgdsl.geometry.planes import Vec, vec
from tgdsl.geometry.shapes_kernel import TIE, direction, is_any, loaded, rotate, rotate_back, select
from tgdsl.quantities.geoms import Geoms
from tgdsl.quantities.pairs import Pairs

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportAssignmentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false


BLOCK = 32  # points that are looked up together, by a program of one warp; two for each lane do not fit into its registers
GEOM, ORIGIN, CELL, FRAME = tl.constexpr(3), tl.constexpr(12), tl.constexpr(15), tl.constexpr(16)
"""Columns of the frames' table, which begins with the geom's place, and their number."""


def meet(
    pairs: Pairs, pair: Int[Tensor, " link"], points: Vec, links: Geoms, g: int
) -> tuple[Vec, Float[Tensor, "env link point"], Vec]:
    """Return the points' places in the links' frames [m], signed distances to their `g`-th geoms [m], and unit gradients.

    Where the gate is closed the distance is +∞. `points` are planes (case, 1, point) in the object's frame [m].
    """
    frames, counts, values = grid_tables(links, g)
    where, is_cubic = torch.stack(points)[:, :, 0], links.shapes[g] == "tricubic"
    outputs = _meet([*pairs.rotation, *pairs.offset], pairs.gate, pair, where, frames, counts, values, is_cubic)
    x, y, z, distance, *gradient = outputs.unbind()
    return (x, y, z), distance, vec(gradient)


def grid_tables(links: Geoms, g: int) -> tuple[Float[Tensor, "link 16"], Int[Tensor, "link 4"], Float[Tensor, " node"]]:
    """Return the tables of one geom of the links, `frames`, `counts` and `values`, see `_meet`."""
    grid = links.surfaces[g]
    assert isinstance(grid, Grid)
    frames = torch.cat([links.pos[:, g], links.rotation[:, g], torch.stack([*grid.origin, grid.cell], dim=-1)[:, 0]], dim=1)
    counts = torch.cat([part.reshape(-1, 1) for part in (grid.first, *grid.num)], dim=1)  # type: ignore[union-attr]
    return frames, counts, grid.values


@triton_op("tgdsl::meet", mutates_args={})
def _meet(
    pose: list[Tensor],
    gate: Tensor | None,
    pair: Tensor,
    points: Tensor,
    frames: Tensor,
    counts: Tensor,
    values: Tensor,
    is_cubic: bool,
) -> Tensor:
    """Return places, distance and gradient, (7, env, link, point)."""
    num_envs, num_links, num_points = pose[0].shape[0], pair.shape[0], points.shape[2]
    result = pose[0].new_empty((7, num_envs, num_links, num_points))
    points, gates = points.contiguous(), pose[0] if gate is None else gate
    wrap_triton(depth_kernel)[(num_envs * num_links,)](
        result, *pose, gates, pair, points, frames.contiguous(), counts.contiguous(), values,
        num_links, num_points, *pose[0].stride(), *pose[9].stride(), *gates.stride(), points.stride(0),
        points.stride(1) if points.shape[1] != 1 else 0,
        IS_GATED=gate is not None, IS_CUBIC=is_cubic, BLOCK=BLOCK, num_warps=1,
    )  # fmt: skip
    return result


@triton.jit
def depth_kernel(
    result, xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz, gates, pairs, points, frames, counts, values,
    num_links, num_points, turn_env, turn_pair, offset_env, offset_pair, gate_env, gate_pair, point_axis, point_env,
    IS_GATED: tl.constexpr, IS_CUBIC: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write what all points are to one link of one environment."""
    env, link = (tl.program_id(0) // num_links).to(tl.int64), tl.program_id(0) % num_links
    pair = tl.load(pairs + link)
    planes = xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz
    pose = posed(planes, env * turn_env + pair * turn_pair, env * offset_env + pair * offset_pair)
    is_open = is_felt(gates, env * gate_env + pair * gate_pair, IS_GATED)
    grid = surface(frames, counts, values, link)
    points += env * point_env
    plane = (tl.num_programs(0).to(tl.int64)) * num_points
    result += tl.program_id(0).to(tl.int64) * num_points
    for start in range(0, num_points, BLOCK):
        point = start + tl.arange(0, BLOCK)
        is_point = point < num_points
        here = placed(pose, points, point_axis, point, is_point)
        tl.store(result + point, here[0], is_point)
        tl.store(result + plane + point, here[1], is_point)
        tl.store(result + 2 * plane + point, here[2], is_point)
        distance, gradient = outside(here)
        if is_open:
            distance, gradient = measured(grid, here, is_point, IS_CUBIC)
        tl.store(result + 3 * plane + point, distance, is_point)
        tl.store(result + 4 * plane + point, gradient[0], is_point)
        tl.store(result + 5 * plane + point, gradient[1], is_point)
        tl.store(result + 6 * plane + point, gradient[2], is_point)


@triton.jit
def posed(planes, turn, offset):
    """Return the pose of a pair: `planes` are where twelve numbers begin, `turn` and `offset` its place in them."""
    return (
        tl.load(planes[0] + turn), tl.load(planes[1] + turn), tl.load(planes[2] + turn),
        tl.load(planes[3] + turn), tl.load(planes[4] + turn), tl.load(planes[5] + turn),
        tl.load(planes[6] + turn), tl.load(planes[7] + turn), tl.load(planes[8] + turn),
        tl.load(planes[9] + offset), tl.load(planes[10] + offset), tl.load(planes[11] + offset),
    )  # fmt: skip


@triton.jit
def is_felt(gates, at, IS_GATED: tl.constexpr):
    """Return whether a pair counts; one whose gate is NaN does."""
    is_open = tl.full((), 1, tl.int1)
    if IS_GATED:
        is_open = (tl.load(gates + at) < 0) == 0
    return is_open


@triton.jit
def surface(frames, counts, values, link):
    """Return a link's surface: its geom's place and rotation, the grid's origin, spacing, numbers of nodes, and nodes."""
    frame, count = frames + link * FRAME, counts + link * 4
    place = tl.load(frame), tl.load(frame + 1), tl.load(frame + 2)
    origin = tl.load(frame + ORIGIN), tl.load(frame + ORIGIN + 1), tl.load(frame + ORIGIN + 2)
    num = tl.load(count + 1).to(tl.int32), tl.load(count + 2).to(tl.int32), tl.load(count + 3).to(tl.int32)
    return place, loaded(frame + GEOM), origin, tl.load(frame + CELL), num, values + tl.load(count).to(tl.int64)


@triton.jit
def placed(pose, points, point_axis, point, is_point):
    """Return where a block of an object's points is in the link's frame [m]."""
    turn = (pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6], pose[7], pose[8])
    x = tl.load(points + point, is_point, 0.0) - pose[9]
    y = tl.load(points + point_axis + point, is_point, 0.0) - pose[10]
    z = tl.load(points + 2 * point_axis + point, is_point, 0.0) - pose[11]
    return rotate_back(turn, (x, y, z))


@triton.jit
def outside(here):
    """Return distance and gradient outside the grid."""
    none = tl.zeros_like(here[0])
    return none + float("inf"), (none, none, none)


@triton.jit
def cells(grid, here):
    """Return where a block of points in the link's frame is along the axes of the grid, in its cells."""
    place, turn, low, cell, _, _ = grid
    local = rotate_back(turn, (here[0] - place[0], here[1] - place[1], here[2] - place[2]))
    return (local[0] - low[0]) / cell, (local[1] - low[1]) / cell, (local[2] - low[2]) / cell


@triton.jit
def is_within(grid, at):
    """Return whether places in cells are inside the grid; NaN counts as inside."""
    num = grid[4]
    return (_is_beyond(at[0], num[0]) | _is_beyond(at[1], num[1]) | _is_beyond(at[2], num[2])) == 0


@triton.jit
def measured(grid, here, is_point, IS_CUBIC: tl.constexpr):
    """Return signed distances of a block of points to a link's surface [m], and unit gradients, in the link's frame."""
    _, turn, _, cell, num, nodes = grid
    distance, gradient = outside(here)
    at = cells(grid, here)
    is_in = is_within(grid, at) & is_point
    if is_any(is_in):
        value, slope = _interpolated(nodes, at, num, TIE / cell, is_in, IS_CUBIC)
        distance = tl.where(is_in, value, distance)
        slope = select(value != value, gradient, (slope[0] / cell, slope[1] / cell, slope[2] / cell))
        gradient = select(is_in, rotate(turn, direction(slope[0], slope[1], slope[2])), gradient)
    return distance, gradient


@triton.jit
def _is_beyond(place, num):
    return (place < 0) | (place > num - 1)


@triton.jit
def nearest(grid, at, is_in):
    """Return the distance at the node next to places in cells [m]: theirs is less than a cell below it."""
    num, nodes = grid[4], grid[5]
    x, y, z = _rounded(at[0], num[0]), _rounded(at[1], num[1]), _rounded(at[2], num[2])
    return tl.load(nodes + ((x * num[1] + y) * num[2] + z), is_in, float("inf"))


@triton.jit
def _rounded(place, num):
    return tl.minimum(tl.maximum((place + 0.5).to(tl.int32), 0), num - 1)


@triton.jit
def _interpolated(nodes, place, num, slack, is_wanted, IS_CUBIC: tl.constexpr):
    """Return the distance at places within one grid [m], and its slope along the axes [m per cell]; as `grid` has them."""
    NUM: tl.constexpr = 4 if IS_CUBIC else 2
    x, y, z = _lower(place[0], num[0], slack), _lower(place[1], num[1], slack), _lower(place[2], num[2], slack)
    t_x, t_y, t_z = (place[0] - x)[:, None], (place[1] - y)[:, None], (place[2] - z)[:, None]
    x, y, z, is_wanted = x[:, None], y[:, None], z[:, None], is_wanted[:, None]
    k = tl.arange(0, NUM)[None, :]
    column = tl.minimum(tl.maximum(z + k - 1, 0), num[2] - 1) if IS_CUBIC else z + k
    total = tl.zeros_like(t_z + k)
    total_x, total_y = total, total
    for i in tl.static_range(NUM):
        w_x, d_x = _weight(t_x, i, IS_CUBIC)
        sheet, sheet_y = tl.zeros_like(total), tl.zeros_like(total)
        rows = _node(x, i, num[0], IS_CUBIC) * num[1]
        for j in tl.static_range(NUM):
            w_y, d_y = _weight(t_y, j, IS_CUBIC)
            row = (rows + _node(y, j, num[1], IS_CUBIC)) * num[2]
            value = tl.load(nodes + (row + column), is_wanted, 0.0)
            sheet += w_y * value
            sheet_y += d_y * value
        total += w_x * sheet
        total_x += d_x * sheet
        total_y += w_x * sheet_y
    w_z, d_z = _weight(t_z, 0, IS_CUBIC)
    for i in tl.static_range(1, NUM):
        weight, slope = _weight(t_z, i, IS_CUBIC)
        w_z, d_z = tl.where(k == i, weight, w_z), tl.where(k == i, slope, d_z)
    slope = (tl.sum(w_z * total_x, axis=1), tl.sum(w_z * total_y, axis=1), tl.sum(d_z * total, axis=1))
    return tl.sum(w_z * total, axis=1), slope


@triton.jit
def _lower(place, num, slack):
    return tl.minimum(tl.maximum(tl.floor(place + slack).to(tl.int32), 0), num - 2)


@triton.jit
def _node(lower, k: tl.constexpr, num, IS_CUBIC: tl.constexpr):
    return tl.minimum(tl.maximum(lower + (k - 1), 0), num - 1) if IS_CUBIC else lower + k


@triton.jit
def _weight(t, k: tl.constexpr, IS_CUBIC: tl.constexpr):
    """Return the weight of the k-th node along an axis, and its derivative; as `grid` has them."""
    if not IS_CUBIC:
        one = tl.full(t.shape, 1.0, tl.float32)
        weight, slope = (1 - t, -one) if k == 0 else (t, one)
    elif k == 0:
        weight, slope = 0.5 * t * (t * (2 - t) - 1), 0.5 * (t * (4 - 3 * t) - 1)
    elif k == 1:
        weight, slope = 0.5 * (t * t * (3 * t - 5) + 2), 0.5 * t * (9 * t - 10)
    elif k == 2:
        weight, slope = 0.5 * t * (t * (4 - 3 * t) + 1), 0.5 * (t * (8 - 9 * t) + 1)
    else:
        weight, slope = 0.5 * t * t * (t - 1), 0.5 * t * (3 * t - 2)
    return weight, slope
