"""`patch` as one Triton kernel, for a GPU in float32 without derivatives.

A program takes a block of pairs of a body and an object, with all contacts of each. Their hull needs no sorting: each is
compared with each.

Shapes of blocks: `P` pairs of a body and an object, environment by environment; `S` slots, a power of two.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from tgdsl.geometry.shapes_kernel import dot

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportOperatorIssue=false


BLOCK = 16  # pairs of a program
WARPS = 1  # warps of a program


@triton_op("tgdsl::contact_patch", mutates_args={})
def contact_patch(contacts: list[Tensor], pairs: Tensor, bodies: Tensor, cancelled: float) -> Tensor:
    """Return force, area, centre and normal in the link's frame, (8, env, body, object).

    `contacts` are the fields of `Contacts`; the mean of unit normals has no direction below a length of `cancelled`.
    """
    fields = [part.contiguous() for part in contacts]
    num_envs, num_pairs, num_slots = fields[0].shape[:3]
    num_bodies, num_objects = pairs.shape
    result = fields[0].new_empty((8, num_envs, num_bodies, num_objects))
    num = num_envs * num_bodies * num_objects
    wrap_triton(patch_kernel)[(triton.cdiv(num, BLOCK),)](
        result, *fields, pairs.contiguous(), bodies, num, num_pairs, fields[5].shape[1], cancelled,
        BODIES=num_bodies, OBJECTS=num_objects, SLOTS=num_slots, SLOT=1 << (num_slots - 1).bit_length(),
        BLOCK=BLOCK, num_warps=WARPS,
    )  # fmt: skip
    return result


@triton.jit
def patch_kernel(
    found, force, torque, normal, pos, whole, body_pos, body_quat, pairs, bodies, num, num_pairs, num_bodies, cancelled,
    BODIES: tl.constexpr, OBJECTS: tl.constexpr, SLOTS: tl.constexpr, SLOT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Make the patches of a block."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    slot = tl.arange(0, SLOT)
    is_at = at < num
    env, side = at // (BODIES * OBJECTS), at % (BODIES * OBJECTS)
    pair = tl.load(pairs + side, is_at, num_pairs)
    body = env * num_bodies + tl.load(bodies + side // OBJECTS, is_at, 0)
    is_pair = is_at & (pair < num_pairs)
    of_pair = env * num_pairs + pair
    of_slot = (of_pair[:, None] * SLOTS + slot[None, :]) * 3
    is_slot = is_pair[:, None] & (slot < SLOTS)[None, :]
    # Contacts.
    push, turn = _vector(force, of_slot, is_slot), _vector(torque, of_slot, is_slot)
    out, place = _vector(normal, of_slot, is_slot), _vector(pos, of_slot, is_slot)
    is_used = _is_any(push) | _is_any(turn) | _is_any(out)
    all_of = _vector(whole, 3 * of_pair, is_pair)
    load = _normal_force(push, out, all_of, is_used)
    origin = _vector(body_pos, 3 * body, is_at)
    away = (
        tl.where(is_used, place[0] - origin[0][:, None], 0.0),
        tl.where(is_used, place[1] - origin[1][:, None], 0.0),
        tl.where(is_used, place[2] - origin[2][:, None], 0.0),
    )
    # The patch, along the world's axes.
    total = tl.sum(load, axis=1)
    share = load / tl.where(total > 0, total, 1.0)[:, None]
    centre = _sum(share, away)
    mean = _sum(share, out)
    counts = load > 0
    first = tl.min(tl.where(counts, slot[None, :], SLOTS - 1), axis=1)
    of_first = _sum(tl.where(slot[None, :] == first[:, None], 1.0, 0.0), out)
    is_none = (dot(mean, mean) < cancelled * cancelled) & (total > 0)
    mean = (
        tl.where(is_none, of_first[0], mean[0]),
        tl.where(is_none, of_first[1], mean[1]),
        tl.where(is_none, of_first[2], mean[2]),
    )
    squared = dot(mean, mean)
    inverse = tl.where(squared > 0, 1.0 / tl.sqrt(tl.where(squared > 0, squared, 1.0)), 0.0)
    # NaN stays NaN.
    inverse = tl.where(squared == squared, inverse, squared)
    axis = (mean[0] * inverse, mean[1] * inverse, mean[2] * inverse)
    area = _hull(away, centre, axis, counts, slot, SLOTS)
    # In the link's frame.
    w, x = tl.load(body_quat + 4 * body, is_at, 1.0), _at(body_quat, 4 * body + 1, is_at)
    y, z = _at(body_quat, 4 * body + 2, is_at), _at(body_quat, 4 * body + 3, is_at)
    local, own_axis = _turned_back(w, x, y, z, centre), _turned_back(w, x, y, z, axis)
    tl.store(found + at, total, is_at)
    tl.store(found + num + at, area, is_at)
    tl.store(found + 2 * num + at, local[0], is_at)
    tl.store(found + 3 * num + at, local[1], is_at)
    tl.store(found + 4 * num + at, local[2], is_at)
    tl.store(found + 5 * num + at, own_axis[0], is_at)
    tl.store(found + 6 * num + at, own_axis[1], is_at)
    tl.store(found + 7 * num + at, own_axis[2], is_at)


@triton.jit
def _at(plane, at, is_there):
    return tl.load(plane + at, is_there, 0.0)


@triton.jit
def _vector(field, at, is_there):
    return _at(field, at, is_there), _at(field, at + 1, is_there), _at(field, at + 2, is_there)


@triton.jit
def _is_any(vector):
    return (vector[0] != 0) | (vector[1] != 0) | (vector[2] != 0)


@triton.jit
def _sum(weight, vectors):
    x, y, z = tl.sum(weight * vectors[0], axis=1), tl.sum(weight * vectors[1], axis=1), tl.sum(weight * vectors[2], axis=1)
    return x, y, z


@triton.jit
def _normal_force(push, out, whole, is_used):
    """Return normal forces, at least 0, with each pair's remaining force shared out (P, S) [N]."""
    x, y, z = (
        whole[0] - tl.sum(push[0], axis=1),
        whole[1] - tl.sum(push[1], axis=1),
        whole[2] - tl.sum(push[2], axis=1),
    )
    size = tl.sqrt(dot(push, push))
    used = is_used.to(tl.float32)
    total, count = tl.sum(size, axis=1), tl.sum(used, axis=1)
    is_loaded = total > 0
    inverse = 1.0 / tl.where(is_loaded, total, tl.maximum(count, 1.0))
    weight = tl.where(is_loaded[:, None], size, used) * inverse[:, None]
    pushed = push[0] + weight * x[:, None], push[1] + weight * y[:, None], push[2] + weight * z[:, None]
    load = dot(pushed, out)
    load = tl.where(load < 0, 0.0, load)
    return tl.where(is_used & (dot(out, out) == 0), float("nan"), load)


@triton.jit
def _hull(away, centre, axis, counts, slot, SLOTS: tl.constexpr):
    """Return the area of the hull of the slots that count (P) [m²]: see `patch_area`."""
    nx, ny, nz = axis
    sign = tl.where(nz >= 0, 1.0, -1.0)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    one = ((1.0 + sign * nx * nx * a)[:, None], (sign * b)[:, None], (-sign * nx)[:, None])
    other = (b[:, None], (sign + ny * ny * a)[:, None], (-ny)[:, None])
    flat = (away[0] - centre[0][:, None], away[1] - centre[1][:, None], away[2] - centre[2][:, None])
    x, y = tl.where(counts, dot(flat, one), 0.0), tl.where(counts, dot(flat, other), 0.0)
    far = tl.max(tl.where(counts, x, float("-inf")), axis=1)[:, None]
    number = slot[None, :]
    first = tl.min(tl.where(counts & (x == far), number, SLOTS), axis=1)[:, None]
    is_first = number == first
    x0, y0 = tl.sum(tl.where(is_first, x, 0.0), axis=1)[:, None], tl.sum(tl.where(is_first, y, 0.0), axis=1)[:, None]
    angle = _angle(x, y) - _angle(x0, y0)
    angle = tl.where(is_first, -1.0, tl.where(angle < 0, angle + 4.0, angle))
    is_after = (angle[:, None, :] > angle[:, :, None]) & counts[:, None, :] & counts[:, :, None]
    crossed = tl.where(is_after, x[:, :, None] * y[:, None, :] - y[:, :, None] * x[:, None, :], float("-inf"))
    # Twice the area swept on the way to each slot: each round allows for one more corner.
    swept = tl.where(is_first, 0.0, float("-inf"))
    for _ in tl.static_range(SLOTS - 1):
        swept = tl.maximum(swept, tl.max(swept[:, :, None] + crossed, axis=1))
    area = 0.5 * tl.max(tl.where(counts, swept + x * y0 - y * x0, 0.0), axis=1)
    return tl.where(area < 0, 0.0, area)


@triton.jit
def _angle(x, y):
    size = tl.abs(x) + tl.abs(y)
    along = x / tl.where(size > 0, size, 1.0)
    return tl.where(y >= 0, 1.0 - along, 3.0 + along)


@triton.jit
def _turned_back(w, x, y, z, vector):
    """Return Rᵀ a for the rotation of a quaternion, which need not have unit length."""
    two = 2.0 / (w * w + x * x + y * y + z * z)
    tw, tx, ty = two * w, two * x, two * y
    xx, yy, zz = tx * x, ty * y, two * z * z
    xy, xz, yz = tx * y, tx * z, ty * z
    wx, wy, wz = tw * x, tw * y, tw * z
    return (
        (1.0 - yy - zz) * vector[0] + (xy + wz) * vector[1] + (xz - wy) * vector[2],
        (xy - wz) * vector[0] + (1.0 - xx - zz) * vector[1] + (yz + wx) * vector[2],
        (xz + wy) * vector[0] + (yz - wx) * vector[1] + (1.0 - xx - yy) * vector[2],
    )
