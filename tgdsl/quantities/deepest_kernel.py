"""Which geom of all objects each probe is deepest in, on a GPU, in one kernel: one pass over the geoms, primitives only.

It replaces `measure` and `penetration` for objects made of planes, spheres, capsules, cylinders and boxes. The pass
needs distances alone; the gradient is computed at its end, for the winner. A program is one warp. It skips objects, and geoms
with a frame, whose bounding sphere none of its probes can reach.

Shapes: `env` environments, `taxel` probes, `pair` pairs, `object` felt objects, `geom` geoms of all of these, `case` 1, or
`env` if an object differs between environments, `row` columns of a geom.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.geometry.shapes import COLUMNS
from tgdsl.geometry.shapes_kernel import TIE, distance_to, dot, gradient_of, is_any, length, loaded, rotate, rotate_back, select
from tgdsl.quantities.pairs import Pairs

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false


BLOCK = 64  # probes of a program, which is one warp: two for each of its lanes
POS, ROTATION, BOUND, KIND, ROW = (tl.constexpr(column) for column in COLUMNS)


def find(pairs: Pairs, pos: Vec, pair: Tensor, spheres: Tensor, geoms: Tensor, reach: Tensor) -> tuple[Tensor, Vec, Tensor]:
    """Return what `Deepest` holds: `spheres` and `geoms` as `geom_tables` has them, the rest as `search`."""
    depth, normal, winner = _deepest([*pairs.rotation, *pairs.offset], list(pos), pair, reach, pairs.gate, spheres, geoms)
    return depth, planes.vec(normal.unbind()), winner


@triton_op("tgdsl::deepest", mutates_args={})
def _deepest(
    pose: list[Tensor], pos: list[Tensor], pair: Tensor, reach: Tensor, gate: Tensor | None, spheres: Tensor, geoms: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return depth (env, taxel), normal (3, env, taxel) and pair (env, taxel) of `Deepest`."""
    num_envs, (num_objects, num_taxels) = pose[0].shape[0], pair.shape
    depth = pose[0].new_empty((num_envs, num_taxels))
    normal = pose[0].new_empty((3, num_envs, num_taxels))
    winner = torch.empty_like(depth, dtype=torch.int32)
    num_points = num_envs * num_taxels
    tables = [table.contiguous() for table in (reach, spheres, geoms)]
    strides = tables[0].stride()
    wrap_triton(deepest_kernel)[(triton.cdiv(num_points, BLOCK),)](
        depth, normal, winner, *pose, *pos, pair, *tables, pose[0] if gate is None else gate, num_points, num_objects,
        *pose[0].stride(), *(gate if gate is not None else pose[0]).stride(), strides[0],
        strides[1] if reach.ndim == 3 and reach.shape[1] != 1 else 0,
        *(table.stride(0) if table.shape[0] != 1 else 0 for table in tables[1:]),
        NUM_TAXELS=num_taxels, IS_GATED=gate is not None, IS_ONE=geoms.shape[0] == 1, BLOCK=BLOCK, num_warps=1,
    )  # fmt: skip
    return depth, normal, winner


@triton.jit
def deepest_kernel(
    depth_out, normal_out, pair_out, xx, xy, xz, yx, yy, yz, zx, zy, zz, ox, oy, oz, x_in, y_in, z_in,
    pairs, reach, spheres, geoms, gates, num_points, num_objects, pose_env, pose_pair, gate_env, gate_pair,
    reach_object, reach_env, sphere_env, geom_env,
    NUM_TAXELS: tl.constexpr, IS_GATED: tl.constexpr, IS_ONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Find what `BLOCK` probes are deepest in, counted through all environments."""
    start = tl.program_id(0).to(tl.int64) * BLOCK
    is_probe = start + tl.arange(0, BLOCK) < num_points
    # Environments after the program's first are counted from it, in 32 bits. Lanes beyond the last probe work on that one.
    first_env = start // NUM_TAXELS
    place = tl.minimum(start + tl.arange(0, BLOCK), num_points - 1) - first_env * NUM_TAXELS
    env, taxel = place.to(tl.int32) // NUM_TAXELS, place.to(tl.int32) % NUM_TAXELS
    base = first_env * pose_env
    xx, xy, xz, yx, yy, yz = xx + base, xy + base, xz + base, yx + base, yy + base, yz + base
    zx, zy, zz, ox, oy, oz = zx + base, zy + base, zz + base, ox + base, oy + base, oz + base
    turns = (xx, xy, xz, yx, yy, yz, zx, zy, zz)
    pose = env * pose_env
    gates = gates + first_env * gate_env
    radii = reach + first_env * reach_env + (env * reach_env + taxel)
    own_pair = pairs + taxel
    bounds, sizes = spheres, geoms
    if not IS_ONE:
        bounds += first_env * sphere_env + env * sphere_env
        sizes += first_env * geom_env + env * geom_env

    x, y, z = tl.load(x_in + taxel), tl.load(y_in + taxel), tl.load(z_in + taxel)
    arm = tl.max(length(x, y, z), axis=0)
    depth = tl.zeros((BLOCK,), tl.float32)
    winner = tl.full((BLOCK,), -1, tl.int32)
    met = tl.full((BLOCK,), -1, tl.int32)
    first = tl.full((), 0, tl.int32)
    next_pair = tl.load(own_pair)
    next_radius, next_shift, next_strange = _begun(
        next_pair, radii, gates, env * gate_env, gate_pair, (ox, oy, oz, xy), pose, pose_pair, IS_GATED
    )
    for k in range(num_objects):
        last = first + tl.load(spheres + 1).to(tl.int32)
        pair, radius, shift, strange = next_pair, next_radius, next_shift, next_strange
        at = pose + pair * pose_pair
        # Prefetch the next object to hide the load's latency; the last iteration loads the last object again.
        is_more = k + 1 < num_objects
        own_pair += tl.where(is_more, NUM_TAXELS, 0)
        radii += tl.where(is_more, reach_object, 0)
        next_pair = tl.load(own_pair)
        next_radius, next_shift, next_strange = _begun(
            next_pair, radii, gates, env * gate_env, gate_pair, (ox, oy, oz, xy), pose, pose_pair, IS_GATED
        )
        if _is_any_within(dot(shift, shift) + strange, tl.load(bounds) + arm + radius):
            px, py, pz = rotate(_pose(turns, at), (x, y, z))
            px, py, pz = px + shift[0], py + shift[1], pz + shift[2]
            least = tl.full((BLOCK,), float("inf"), tl.float32)
            nearest = winner
            row, kinds = sizes + first * ROW, geoms + first * ROW + KIND
            for g in range(first, last):
                kind = tl.load(kinds)
                bound = tl.load(row + BOUND)
                point = (px, py, pz)
                is_met = tl.full((), 1, tl.int1)
                if kind < 0:
                    point = _from(point, row + POS)
                    is_met = _is_any_within(dot(point, point), bound + radius)
                    if is_met:
                        point = rotate_back(loaded(row + ROTATION), point)
                if is_met:
                    distance = tl.where(bound < 0, float("inf"), distance_to(tl.abs(kind), row, point))
                    nearest = tl.where(distance < least - TIE, g, nearest)
                    least = tl.minimum(least, distance, propagate_nan=tl.PropagateNan.ALL)
                row += ROW
                kinds += ROW
            reached = radius - least
            is_deeper = reached > tl.where(depth > 0, depth + TIE, 0.0)
            winner = tl.where(is_deeper, nearest, winner)
            met = tl.where(is_deeper, pair, met)
            depth = tl.maximum(depth, reached, propagate_nan=tl.PropagateNan.ALL)
        first = last
        spheres += 2
        bounds += 2

    out = start + tl.arange(0, BLOCK)
    tl.store(depth_out + out, depth, is_probe)
    tl.store(pair_out + out, met, is_probe)
    normal = (tl.zeros_like(depth), tl.zeros_like(depth), tl.zeros_like(depth))
    if is_any(met >= 0):
        at = pose + tl.maximum(met, 0) * pose_pair
        rotation = _pose(turns, at)
        px, py, pz = rotate(rotation, (x, y, z))
        point = (px + tl.load(ox + at), py + tl.load(oy + at), pz + tl.load(oz + at))
        row = tl.maximum(winner, 0) * ROW
        kind = tl.load(geoms + row + KIND)
        turn = loaded(sizes + row + ROTATION)
        local = select(kind < 0, rotate_back(turn, _from(point, sizes + row + POS)), point)
        outward = gradient_of(tl.abs(kind), sizes + row, local)
        outward = select(kind < 0, rotate(turn, outward), outward)
        normal = select(met >= 0, rotate_back(rotation, outward), normal)
    plane = tl.cast(num_points, tl.int64)
    tl.store(normal_out + out, normal[0], is_probe)
    tl.store(normal_out + plane + out, normal[1], is_probe)
    tl.store(normal_out + 2 * plane + out, normal[2], is_probe)


@triton.jit
def _begun(pair, radii, gates, gate_row, gate_pair, pose, row, pose_pair, IS_GATED: tl.constexpr):
    """Return the radii, the link's origin in the object's frame, and 0 where the pose is finite."""
    at = row + pair * pose_pair
    radius = tl.load(radii)
    if IS_GATED:
        radius += tl.load(gates + (gate_row + pair * gate_pair))
    return radius, (tl.load(pose[0] + at), tl.load(pose[1] + at), tl.load(pose[2] + at)), 0.0 * tl.load(pose[3] + at)


@triton.jit
def _is_any_within(squared, limit):
    return is_any((squared > limit * tl.abs(limit)) == 0)


@triton.jit
def _from(point, at):
    return point[0] - tl.load(at), point[1] - tl.load(at + 1), point[2] - tl.load(at + 2)


@triton.jit
def _pose(turns, at):
    """Return a rotation whose parts are in nine planes."""
    x = (tl.load(turns[0] + at), tl.load(turns[1] + at), tl.load(turns[2] + at))
    y = (tl.load(turns[3] + at), tl.load(turns[4] + at), tl.load(turns[5] + at))
    z = (tl.load(turns[6] + at), tl.load(turns[7] + at), tl.load(turns[8] + at))
    return x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]
