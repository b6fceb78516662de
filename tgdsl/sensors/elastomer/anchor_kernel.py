"""Anchors of points on links that are grids, as one Triton kernel: `point_anchors.advance` on a GPU.

A program takes one link of an environment. In chunks of points it finds candidates, which have an anchor or may be in the
skin by the distance at the next node of the link's grid, and compacts their indices: most points are none. Then one thread
per candidate finds its depth (`depth_kernel`) and advances its anchor in place. Active points, those with a shear load, are
compacted in their order, and counted.

Shapes: `env` environments, `link` links that may meet the object, `point` its points, `all` the points of all objects.
"""

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.shapes_kernel import dot, select
from tgdsl.quantities.depth_kernel import cells, is_felt, is_within, measured, nearest, outside, placed, posed, surface

LANES, CHUNK = 32, 512  # threads of a program, which is one warp, and most points of a chunk
REGISTERS = 72
"""Registers per thread, where a compiler would take 110 to 150: the kernel waits for memory, so occupancy decides."""
MOST = 2**24  # points of an object are fewer: their indices are stored as float32
TINY = tl.constexpr(planes.tiny())


@torch.library.custom_op("tgdsl::advance_anchors", mutates_args={"state"})
def advance_anchors(
    pose: list[Tensor],
    gate: Tensor | None,
    pair: Tensor,
    points: Tensor,
    frames: Tensor,
    counts: Tensor,
    values: Tensor,
    is_cubic: bool,
    stick_slip: list[Tensor],
    state: list[Tensor],
    first: int,
) -> tuple[Tensor, Tensor]:
    """Advance anchors in place, and return z_p [m] and (z_p − e_p) h_p [m²] of active points, and their number.

    The result is (6, env, link, point) and (env, link); active points of a link come first, in their order, and the numbers
    after them mean nothing. It is not a `triton_op`, because addresses that depend on loaded values would make a compiler
    conclude that all arguments may change.

    Args:
        pose: Rotation from each pair's link into the object's frame, row by row, and the link's origin there [m]: nine planes
            (env, pair) that lie in memory alike, and three.
        gate: Negative where a pair's gate is closed, (env, pair).
        pair: Index of each link's pair.
        points: Places in the object's frame [m], (3, case, point).
        frames: Place and rotation of each link's geom, and origin and spacing of its grid's nodes [m], (link, 16).
        counts: Index of each grid's first node, and the number of its nodes along each axis, (link, 4).
        values: `Grid.values`.
        is_cubic: Whether it is interpolated by cubes.
        stick_slip: Standoff, enter, exit, and slip if there is friction: see `anchors.StickSlip`.
        state: The planes (env, all) that `point_anchors.PLANES` names, changed in place.
        first: Where the object's points begin in them, link after link.
    """
    result, num_active = _empty(pose, pair, points)
    _, num_envs, num_links, num_points = result.shape
    assert num_points < MOST
    points, gates = points.contiguous(), pose[0] if gate is None else gate
    standoff, enter, exit, *slip = stick_slip
    anchor_kernel[(num_envs * num_links,)](
        result, num_active, *state, standoff, enter, exit, slip[0] if slip else standoff, *pose, gates, pair, points,
        frames.contiguous(), counts.contiguous(), values, first, state[0].stride(0),
        num_links, num_points, *pose[0].stride(), *pose[9].stride(), *gates.stride(), points.stride(0),
        points.stride(1) if points.shape[1] != 1 else 0,
        SLIDES=len(slip) > 0, IS_GATED=gate is not None, IS_CUBIC=is_cubic, LANES=LANES,
        CHUNK=min(max(triton.next_power_of_2(num_points), LANES), CHUNK), num_warps=1, maxnreg=REGISTERS,
    )  # fmt: skip
    return result, num_active


@advance_anchors.register_fake
def _(pose: list[Tensor], gate: Tensor | None, pair: Tensor, points: Tensor, *_rest: Any) -> tuple[Tensor, Tensor]:
    return _empty(pose, pair, points)


def _empty(pose: list[Tensor], pair: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    num_envs, num_links, num_points = pose[0].shape[0], pair.shape[0], points.shape[2]
    result = pose[0].new_empty((6, num_envs, num_links, num_points))
    return result, pose[0].new_empty((num_envs, num_links), dtype=torch.int32)


@triton.jit
def anchor_kernel(
    result, num_active, anchor_x, anchor_y, anchor_z, held, standoff, enter, exit, slip,
    xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz, gates, pairs, points, frames, counts, values, first, state_env,
    num_links, num_points, turn_env, turn_pair, offset_env, offset_pair, gate_env, gate_pair, point_axis, point_env,
    SLIDES: tl.constexpr, IS_GATED: tl.constexpr, IS_CUBIC: tl.constexpr, LANES: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Advance all points on one link of one environment; see `launch`."""
    row = tl.program_id(0).to(tl.int64)
    env, link = row // num_links, tl.program_id(0) % num_links
    first_state = env * state_env + first + link * num_points
    state = (anchor_x + first_state, anchor_y + first_state, anchor_z + first_state, held + first_state)
    points += env * point_env
    result += row * num_points
    plane = tl.num_programs(0).to(tl.int64) * num_points
    pair = tl.load(pairs + link)
    planes = xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz
    pose = posed(planes, env * turn_env + pair * turn_pair, env * offset_env + pair * offset_pair)
    is_open = is_felt(gates, env * gate_env + pair * gate_pair, IS_GATED)
    lost = _lost(pose)

    num_written = tl.full((), 0, tl.int32)
    for start in range(0, num_points, CHUNK):
        point = start + tl.arange(0, CHUNK)
        is_point = point < num_points
        # A pose with a NaN makes all points NaN, whatever the gate says.
        candidates = ((tl.load(state[3] + point, is_point, 0.0) + lost <= 0) == 0) & is_point
        if is_open:
            skin = surface(frames, counts, values, link)
            at = cells(skin, placed(pose, points, point_axis, point, is_point))
            is_in = is_within(skin, at) & is_point
            candidates |= ((nearest(skin, at, is_in) - skin[3] > tl.load(standoff)) == 0) & is_in
        num_candidates = tl.sum(candidates.to(tl.int32), axis=0)
        if num_candidates > 0:
            skin = surface(frames, counts, values, link)
            stick_slip = (tl.load(standoff), tl.load(enter), tl.load(exit), tl.load(slip))
            # The compacted indices occupy the output's memory: never more is written than has been read of them.
            compacted = result + start
            tl.store(compacted + _rank(candidates), point.to(tl.float32), candidates)
            tl.debug_barrier()
            for low in range(0, num_candidates, LANES):
                place = low + tl.arange(0, LANES)
                is_candidate = place < num_candidates
                chosen_points = tl.load(compacted + place, is_candidate, 0.0).to(tl.int32)
                here = placed(pose, points, point_axis, chosen_points, is_candidate)
                distance, gradient = outside(here)
                if is_open:
                    distance, gradient = measured(skin, here, is_candidate, IS_CUBIC)
                strength = _advanced(chosen_points, is_candidate, here, distance, gradient, stick_slip, state, SLIDES)
                is_active = ((strength[0] + lost != 0) | (strength[1] != 0) | (strength[2] != 0)) & is_candidate
                to = result + (num_written + _rank(is_active))
                tl.store(to, here[0], is_active)
                tl.store(to + plane, here[1], is_active)
                tl.store(to + 2 * plane, here[2], is_active)
                tl.store(to + 3 * plane, strength[0], is_active)
                tl.store(to + 4 * plane, strength[1], is_active)
                tl.store(to + 5 * plane, strength[2], is_active)
                num_written += tl.sum(is_active.to(tl.int32), axis=0)
    tl.store(num_active + row, num_written)


@triton.jit
def _rank(are):
    return tl.cumsum(are.to(tl.int32), axis=0) - are.to(tl.int32)


@triton.jit
def _advanced(point, is_point, here, distance, gradient, stick_slip, state, SLIDES: tl.constexpr):
    """Advance the anchors of some points of a link, and return their shear loads (z_p − e_p) h_p [m²]."""
    standoff, enter, exit, slip = stick_slip
    anchor_x, anchor_y, anchor_z, held = state
    held_before = tl.load(held + point, is_point, 0.0) > 0
    anchor = (
        tl.load(anchor_x + point, held_before, 0.0), tl.load(anchor_y + point, held_before, 0.0),
        tl.load(anchor_z + point, held_before, 0.0),
    )  # fmt: skip
    # Written so that NaN keeps its anchor.
    is_held = held_before & ((distance > standoff + exit) == 0)
    depth = tl.maximum(standoff - distance, 0.0, propagate_nan=tl.PropagateNan.ALL)
    none = tl.zeros_like(depth)
    way = (here[0] - anchor[0], here[1] - anchor[1], here[2] - anchor[2])
    moved = select(is_held, way, (none, none, none))
    if SLIDES:
        moved, anchor = _slid(moved, anchor, gradient, slip * depth)
    is_taken = (is_held == 0) & (standoff - distance > enter) & is_point
    new_anchor = select(is_held, anchor, select(is_taken, here, (none, none, none)))
    is_changed = held_before | is_taken
    tl.store(anchor_x + point, new_anchor[0], is_changed)
    tl.store(anchor_y + point, new_anchor[1], is_changed)
    tl.store(anchor_z + point, new_anchor[2], is_changed)
    tl.store(held + point, (is_held | is_taken).to(tl.float32), is_changed)
    return depth * moved[0], depth * moved[1], depth * moved[2]


@triton.jit
def _lost(pose):
    turn = pose[0] + pose[1] + pose[2] + pose[3] + pose[4] + pose[5] + pose[6] + pose[7] + pose[8]
    return 0.0 * (turn + pose[9] + pose[10] + pose[11])


@triton.jit
def _slid(moved, anchor, normal, limit):
    """Return the way and the anchor after sliding: the way along the surface is no longer than the limit."""
    across = dot(moved, normal)
    x, y, z = moved[0] - across * normal[0], moved[1] - across * normal[1], moved[2] - across * normal[2]
    square = x * x + y * y + z * z
    slides = square > tl.maximum(limit * limit, TINY, propagate_nan=tl.PropagateNan.ALL)
    rest = 1.0 - limit / tl.sqrt(tl.where(slides, square, 1.0))
    slid = (rest * x, rest * y, rest * z)
    moved = select(slides, (moved[0] - slid[0], moved[1] - slid[1], moved[2] - slid[2]), moved)
    return moved, select(slides, (anchor[0] + slid[0], anchor[1] + slid[1], anchor[2] + slid[2]), anchor)
