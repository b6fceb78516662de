"""Points that take hold of links and let go, as one Triton kernel where the links are grids: `point_anchors.advance` on a GPU.

A program takes some links of an environment. It looks which of them may be felt, or are held on to: most are neither, and that
is all. On the others, one after the other, it looks at many points at once, which of them hold on, or may be in the skin as far
as the next node of the link's grid tells: most do neither. Words of 32 that have such points come one after the other: how deep
they are (`skin_kernel`), and new anchors in the place of the old ones, where there are any. What a point pulls with is written
only if it pulls, and a bit for each point that says so.

Shapes: `env` environments, `link` links that may meet the object, `point` its points, `word` groups of 32 of them, `all` the
points of all objects.
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
from torch.library import triton_op, wrap_triton

from tgdsl.geometry.shapes_kernel import chosen, dot, is_any
from tgdsl.geometry.skin_kernel import cells, is_felt, is_within, measured, nearest, outside, placed, posed, surface

WORD = 32
"""Points that are taken together, by a program of one warp, and whose bits are one number."""
LINKS = 4
"""Links of a program: at most of them there is nothing to do but to see that."""
MANY = 256
"""Most points that are looked at at once, for which there are registers."""
TINY = tl.constexpr(1e-24)
"""As `planes.tiny()`, of which a kernel can see constants alone."""


@triton_op("tgdsl::grip", mutates_args={"state"})
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
    """Advance anchors in place, and return what pulls; see `launch`."""
    return launch(wrap_triton(grip_kernel), pose, gate, pair, points, frames, counts, values, is_cubic, law, state, first)


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
) -> tuple[Float[Tensor, "6 env link point"], Int[Tensor, "env link word"]]:
    """Run the kernel, plain or wrapped, and return z_p [m] and (z_p − e_p) h_p [m²] of points that pull, and a bit for these.

    Numbers of points that do not pull mean nothing.

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
    num_envs, num_links, num_points = pose[0].shape[0], pair.shape[0], points.shape[2]
    found = pose[0].new_empty((6, num_envs, num_links, num_points))
    pulling = pose[0].new_empty((num_envs, num_links, triton.cdiv(num_points, WORD)), dtype=torch.int32)
    points, gates = points.contiguous(), pose[0] if gate is None else gate
    reach, enter, exit, *slip = law
    num_groups = triton.cdiv(num_links, LINKS)
    run[(num_envs * num_groups,)](
        found, pulling, *state, reach, enter, exit, slip[0] if slip else reach, *pose, gates, pair, points,
        frames.contiguous(), counts.contiguous(), values, first, state[0].stride(0),
        num_envs, num_links, num_groups, num_points, *pose[0].stride(), *gates.stride(), points.stride(0),
        points.stride(1) if points.shape[1] != 1 else 0,
        SLIDES=len(slip) > 0, IS_GATED=gate is not None, IS_CUBIC=is_cubic, LINKS=LINKS, WORD=WORD,
        MANY=min(max(triton.next_power_of_2(num_points), WORD), MANY), num_warps=1,
    )  # fmt: skip
    return found, pulling


@triton.jit
def grip_kernel(
    found, pulling, anchor_x, anchor_y, anchor_z, held, reach, enter, exit, slip,
    xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz, gates, pairs, points, frames, counts, values, first, state_env,
    num_envs, num_links, num_groups, num_points, pose_env, pose_pair, gate_env, gate_pair, point_axis, point_env,
    SLIDES: tl.constexpr, IS_GATED: tl.constexpr, IS_CUBIC: tl.constexpr, LINKS: tl.constexpr, WORD: tl.constexpr,
    MANY: tl.constexpr,
):  # fmt: skip
    """Advance all points on some links of one environment; see `launch`."""
    env, first_link = (tl.program_id(0) // num_groups).to(tl.int64), tl.program_id(0) % num_groups * LINKS
    own = env * state_env + first
    state = (anchor_x + own, anchor_y + own, anchor_z + own, held + own)
    held += own
    points += env * point_env
    num_words = tl.cdiv(num_points, WORD)
    plane = (tl.zeros((), tl.int64) + num_envs) * num_links * num_points
    found += env * num_links * num_points
    pulling += env * num_links * num_words
    poses = (xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz)

    links = first_link + tl.arange(0, LINKS)
    are_links = links < num_links
    own_pairs = tl.load(pairs + links, are_links, 0)
    # A pose that is not a number comes out, whatever the gate says.
    are_busy = (_lost(posed(poses, env * pose_env + own_pairs * pose_pair)) != 0) | is_felt(
        gates, env * gate_env + own_pairs * gate_pair, IS_GATED
    )
    many = tl.arange(0, MANY)
    for start in range(0, num_points, MANY):
        at = held + links[:, None] * num_points + start + many[None, :]
        holds = tl.load(at, are_links[:, None] & (start + many < num_points)[None, :], 0.0) > 0
        are_busy |= tl.max(holds.to(tl.int32), axis=1) != 0
    are_busy &= are_links
    for start in range(0, num_words, WORD):
        word = start + tl.arange(0, WORD)
        is_idle = ((are_busy == 0) & are_links)[:, None] & (word < num_words)[None, :]
        tl.store(pulling + links[:, None] * num_words + word[None, :], tl.zeros((LINKS, WORD), tl.int32), is_idle)
    busy = tl.sum(are_busy.to(tl.int32) << tl.arange(0, LINKS), axis=0)

    law = (tl.load(reach), tl.load(enter), tl.load(exit), tl.load(slip))
    for i in range(LINKS):
        if (busy >> i) & 1:
            link = first_link + i
            row, words = link * num_points, pulling + link * num_words
            pair = tl.load(pairs + link)
            pose = posed(poses, env * pose_env + pair * pose_pair)
            is_open = is_felt(gates, env * gate_env + pair * gate_pair, IS_GATED)
            lost = _lost(pose)
            is_lost = lost != 0
            skin = surface(frames, counts, values, link)
            for start in range(0, num_points, MANY):
                are_points = start + many < num_points
                wants = tl.load(held + row + start + many, are_points, 0.0) > 0
                if is_open:
                    at = cells(skin, placed(pose, points, point_axis, start + many, are_points))
                    is_in = is_within(skin, at) & are_points
                    wants |= ((nearest(skin, at, is_in) - skin[3] > law[0]) == 0) & is_in
                have_any = tl.max(tl.reshape(wants.to(tl.int32), (MANY // WORD, WORD)), axis=1)
                have_any = tl.where(is_lost, tl.full((MANY // WORD,), 1, tl.int32), have_any)
                w = tl.arange(0, MANY // WORD)
                is_none = (have_any == 0) & (start + w * WORD < num_points)
                tl.store(words + start // WORD + w, tl.zeros_like(have_any), is_none)
                bits = tl.sum(have_any << w, axis=0)
                for word in range(tl.minimum(MANY // WORD, tl.cdiv(num_points - start, WORD))):
                    if (bits >> word) & 1:
                        point = start + word * WORD + tl.arange(0, WORD)
                        is_point = point < num_points
                        here = placed(pose, points, point_axis, point, is_point)
                        distance, gradient = outside(here)
                        if is_open:
                            distance, gradient = measured(skin, here, is_point, IS_CUBIC)
                        pulls = _advanced(
                            row + point, is_point, here, distance, gradient, lost, law, state, found, plane, SLIDES, WORD
                        )
                        tl.store(words + start // WORD + word, pulls)


@triton.jit
def _advanced(
    point, is_point, here, distance, gradient, lost, law, state, found, plane, SLIDES: tl.constexpr, WORD: tl.constexpr
):
    """Advance the anchors of a word of points, and return a bit for each that pulls; `point` counts those of all links."""
    reach, enter, exit, slip = law
    anchor_x, anchor_y, anchor_z, held = state
    bits = tl.full((), 0, tl.int32)
    held_before = tl.load(held + point, is_point, 0.0) > 0
    # What is not a number is no less than anything.
    if is_any(held_before | (((reach - distance <= enter) == 0) & is_point)) | (lost != 0):
        anchor = (
            tl.load(anchor_x + point, held_before, 0.0), tl.load(anchor_y + point, held_before, 0.0),
            tl.load(anchor_z + point, held_before, 0.0),
        )  # fmt: skip
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
        pull = (depth * moved[0], depth * moved[1], depth * moved[2])
        pulls = ((pull[0] + lost != 0) | (pull[1] != 0) | (pull[2] != 0)) & is_point
        place = found + point
        tl.store(place, here[0], pulls)
        tl.store(place + plane, here[1], pulls)
        tl.store(place + 2 * plane, here[2], pulls)
        tl.store(place + 3 * plane, pull[0], pulls)
        tl.store(place + 4 * plane, pull[1], pulls)
        tl.store(place + 5 * plane, pull[2], pulls)
        bits = tl.sum(pulls.to(tl.int32) << tl.arange(0, WORD), axis=0)
    return bits


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
