"""Points that take hold of links and let go, as one Triton kernel where the links are grids: `point_anchors.advance` on a GPU.

A program takes one link of an environment and looks at many points at once, which of them hold on, or may be in the skin as far
as the next node of the link's grid tells: most do neither. Those that do are written down side by side, and taken a word after
the other, each lane a point: how deep they are (`skin_kernel`), and new anchors in the place of the old ones. What pulls is
written side by side too, in the order of the points, and how many do.

Shapes: `env` environments, `link` links that may meet the object, `point` its points, `all` the points of all objects.
"""

# What a kernel's types are only Triton's compiler knows.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.shapes_kernel import chosen, dot
from tgdsl.quantities.points.skin_kernel import cells, is_felt, is_within, measured, nearest, outside, placed, posed, surface

WORD, MANY = 32, 512
"""Points that are taken together, by a program of one warp, and most that are looked at at once."""
REGISTERS = 72
"""Of a lane, though a compiler would take 110 to 150: what a program waits for is memory, so many have to run at once."""
MOST = 2**24
"""Points of an object are fewer: their numbers are written down in float32."""
TINY = tl.constexpr(planes.tiny())


@torch.library.custom_op("tgdsl::grip", mutates_args={"state"})
def grip(
    pose: list[Tensor],
    gate: Tensor | None,
    pair: Tensor,
    points: Tensor,
    frames: Tensor,
    counts: Tensor,
    values: Tensor,
    is_cubic: bool,
    law: list[Tensor],
    state: list[Tensor],
    first: int,
) -> tuple[Tensor, Tensor]:
    """Advance anchors in place, and return what pulls; see `launch`.

    It is no `triton_op`: places that depend on what was read would make a compiler conclude that all arguments may change.
    """
    return launch(grip_kernel, pose, gate, pair, points, frames, counts, values, is_cubic, law, state, first)


@grip.register_fake
def _(pose: list[Tensor], gate: Tensor | None, pair: Tensor, points: Tensor, *_rest: Any) -> tuple[Tensor, Tensor]:
    return _empty(pose, pair, points)


def launch(
    run: Any,
    pose: list[Float[Tensor, "env pair"]],
    gate: Float[Tensor, "env pair"] | None,
    pair: Int[Tensor, " link"],
    points: Float[Tensor, "3 case point"],
    frames: Float[Tensor, "link 16"],
    counts: Int[Tensor, "link 4"],
    values: Float[Tensor, " node"],
    is_cubic: bool,
    law: list[Float[Tensor, ""]],
    state: list[Float[Tensor, "env all"]],
    first: int,
) -> tuple[Float[Tensor, "6 env link point"], Int[Tensor, "env link"]]:
    """Run the kernel and return z_p [m] and (z_p − e_p) h_p [m²] of points that pull, and how many do.

    Those of a link come first, in their order; the numbers after them mean nothing.

    Args:
        run: The kernel.
        pose: As for `skin_kernel.launch`, as the next six.
        gate: Negative where a pair may not be felt.
        pair: Index of each link's pair.
        points: Places in the object's frame [m].
        frames: Place and rotation of each link's geom, and origin and spacing of its grid's nodes [m].
        counts: Index of each grid's first node, and the number of its nodes along each axis.
        values: `Grid.values`.
        is_cubic: Whether it is interpolated by cubes.
        law: Reach, enter, exit, and slip if there is friction: see `anchors.Law`.
        state: The planes that `point_anchors.PLANES` names, changed in place.
        first: Where the object's points begin in them, link after link.
    """
    found, num_pulling = _empty(pose, pair, points)
    _, num_envs, num_links, num_points = found.shape
    assert num_points < MOST
    points, gates = points.contiguous(), pose[0] if gate is None else gate
    reach, enter, exit, *slip = law
    run[(num_envs * num_links,)](
        found, num_pulling, *state, reach, enter, exit, slip[0] if slip else reach, *pose, gates, pair, points,
        frames.contiguous(), counts.contiguous(), values, first, state[0].stride(0),
        num_links, num_points, *pose[0].stride(), *gates.stride(), points.stride(0),
        points.stride(1) if points.shape[1] != 1 else 0,
        SLIDES=len(slip) > 0, IS_GATED=gate is not None, IS_CUBIC=is_cubic, WORD=WORD,
        MANY=min(max(triton.next_power_of_2(num_points), WORD), MANY), num_warps=1, maxnreg=REGISTERS,
    )  # fmt: skip
    return found, num_pulling


def _empty(pose: list[Tensor], pair: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return memory for what the kernel finds."""
    num_envs, num_links, num_points = pose[0].shape[0], pair.shape[0], points.shape[2]
    found = pose[0].new_empty((6, num_envs, num_links, num_points))
    return found, pose[0].new_empty((num_envs, num_links), dtype=torch.int32)


@triton.jit
def grip_kernel(
    found, num_pulling, anchor_x, anchor_y, anchor_z, held, reach, enter, exit, slip,
    xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz, gates, pairs, points, frames, counts, values, first, state_env,
    num_links, num_points, pose_env, pose_pair, gate_env, gate_pair, point_axis, point_env,
    SLIDES: tl.constexpr, IS_GATED: tl.constexpr, IS_CUBIC: tl.constexpr, WORD: tl.constexpr, MANY: tl.constexpr,
):  # fmt: skip
    """Advance all points on one link of one environment; see `launch`."""
    row = tl.program_id(0).to(tl.int64)
    env, link = row // num_links, tl.program_id(0) % num_links
    own = env * state_env + first + link * num_points
    state = (anchor_x + own, anchor_y + own, anchor_z + own, held + own)
    points += env * point_env
    found += row * num_points
    plane = tl.num_programs(0).to(tl.int64) * num_points
    pair = tl.load(pairs + link)
    pose = posed((xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz), env * pose_env + pair * pose_pair)
    is_open = is_felt(gates, env * gate_env + pair * gate_pair, IS_GATED)
    lost = _lost(pose)

    num_found = tl.full((), 0, tl.int32)
    for start in range(0, num_points, MANY):
        point = start + tl.arange(0, MANY)
        is_point = point < num_points
        # A pose that is not a number comes out of all points, whatever the gate says.
        wants = ((tl.load(state[3] + point, is_point, 0.0) + lost <= 0) == 0) & is_point
        if is_open:
            skin = surface(frames, counts, values, link)
            at = cells(skin, placed(pose, points, point_axis, point, is_point))
            is_in = is_within(skin, at) & is_point
            wants |= ((nearest(skin, at, is_in) - skin[3] > tl.load(reach)) == 0) & is_in
        num_wanted = tl.sum(wants.to(tl.int32), axis=0)
        if num_wanted > 0:
            skin = surface(frames, counts, values, link)
            law = (tl.load(reach), tl.load(enter), tl.load(exit), tl.load(slip))
            # The list stands where what pulls will: never more of that than was read of the list.
            listed = found + start
            tl.store(listed + _place(wants), point.to(tl.float32), wants)
            tl.debug_barrier()
            for low in range(0, num_wanted, WORD):
                place = low + tl.arange(0, WORD)
                is_wanted = place < num_wanted
                chosen_points = tl.load(listed + place, is_wanted, 0.0).to(tl.int32)
                here = placed(pose, points, point_axis, chosen_points, is_wanted)
                distance, gradient = outside(here)
                if is_open:
                    distance, gradient = measured(skin, here, is_wanted, IS_CUBIC)
                pull = _advanced(chosen_points, is_wanted, here, distance, gradient, law, state, SLIDES)
                pulls = ((pull[0] + lost != 0) | (pull[1] != 0) | (pull[2] != 0)) & is_wanted
                to = found + (num_found + _place(pulls))
                tl.store(to, here[0], pulls)
                tl.store(to + plane, here[1], pulls)
                tl.store(to + 2 * plane, here[2], pulls)
                tl.store(to + 3 * plane, pull[0], pulls)
                tl.store(to + 4 * plane, pull[1], pulls)
                tl.store(to + 5 * plane, pull[2], pulls)
                num_found += tl.sum(pulls.to(tl.int32), axis=0)
    tl.store(num_pulling + row, num_found)


@triton.jit
def _place(are):
    """Return how many of a block there are before each."""
    return tl.cumsum(are.to(tl.int32), axis=0) - are.to(tl.int32)


@triton.jit
def _advanced(point, is_point, here, distance, gradient, law, state, SLIDES: tl.constexpr):
    """Advance the anchors of some points of a link, and return what they pull with."""
    reach, enter, exit, slip = law
    anchor_x, anchor_y, anchor_z, held = state
    held_before = tl.load(held + point, is_point, 0.0) > 0
    anchor = (
        tl.load(anchor_x + point, held_before, 0.0), tl.load(anchor_y + point, held_before, 0.0),
        tl.load(anchor_z + point, held_before, 0.0),
    )  # fmt: skip
    # What is not a number is no less than anything.
    is_held = held_before & ((distance > reach + exit) == 0)
    depth = tl.maximum(reach - distance, 0.0, propagate_nan=tl.PropagateNan.ALL)
    none = tl.zeros_like(depth)
    way = (here[0] - anchor[0], here[1] - anchor[1], here[2] - anchor[2])
    moved = chosen(is_held, way, (none, none, none))
    if SLIDES:
        moved, anchor = _slid(moved, anchor, gradient, slip * depth)
    is_taken = (is_held == 0) & (reach - distance > enter) & is_point
    kept = chosen(is_held, anchor, chosen(is_taken, here, (none, none, none)))
    is_changed = held_before | is_taken
    tl.store(anchor_x + point, kept[0], is_changed)
    tl.store(anchor_y + point, kept[1], is_changed)
    tl.store(anchor_z + point, kept[2], is_changed)
    tl.store(held + point, (is_held | is_taken).to(tl.float32), is_changed)
    return depth * moved[0], depth * moved[1], depth * moved[2]


@triton.jit
def _lost(pose):
    """Return 0, or what is not a number if a pose is not one."""
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
    moved = chosen(slides, (moved[0] - slid[0], moved[1] - slid[1], moved[2] - slid[2]), moved)
    return moved, chosen(slides, (anchor[0] + slid[0], anchor[1] + slid[1], anchor[2] + slid[2]), anchor)
