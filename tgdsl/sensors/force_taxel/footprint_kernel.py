"""`footprint` as one Triton kernel, for a GPU in float32 without gradients.

A program handles one body in a block of environments. Its threads hold contacts and loop over the taxels: sums over taxels
need no communication between threads. The first pass writes the weights w, which no step changes, into memory that stays in the
GPU's caches. Each further pass accumulates the moments of the lever arms; the mean and covariance of g follow from those, as g
is linear in the arm. The last pass puts w exp(β · g) in the place of w. Groups of contacts that are all empty are skipped.

Covariances are differences of moments, and float32 would suffer cancellation where few taxels are in the footprint, all of them
on one side of the contact. So moments are about q_c, the nearest point to the contact in the bounding box of the body's taxels.

Shapes: `env` environments, `body` bodies, `contact` contacts of a body, `taxel` taxels of all bodies, one body after the other.
"""

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false

from __future__ import annotations

from collections.abc import Sequence

import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from tgdsl.geometry.planes_kernel import LOG2_E, add3, add6, cross, scale3, scale6, solve, times
from tgdsl.geometry.shapes_kernel import dot
from tgdsl.sensors.force_taxel.constants import damping, no_force, wholly

ENVS = 8
"""Environments of a program, which is one warp: a lane for each of their contacts of a group."""
GROUP = 4
"""Contacts of a body that are looked at together; `_each` counts on four."""
TILE = 4
"""Taxels whose forces are written together."""
FEW_STEPS = 12
"""Steps up to which no exponent β · g can overflow float32, as each makes β longer by √10 at most."""
UNROLL = tl.constexpr(4)
"""Taxels of a pass that are worked on at a time."""
LIMIT = tl.constexpr(64.0)
"""More than any exponent of 2 in `FEW_STEPS` steps, which is √10 · 12 / ln 2."""
NO_FORCE = tl.constexpr(no_force())
DAMPING = tl.constexpr(damping())
WHOLLY = tl.constexpr(wholly())


@triton_op("tgdsl::shared_forces", mutates_args={})
def shared_forces(
    pos: Tensor,
    weight: Tensor,
    point: Sequence[Tensor],
    force: Sequence[Tensor],
    torque: Sequence[Tensor],
    normal: Sequence[Tensor],
    radius: Tensor,
    levenberg: Tensor,
    first: Tensor,
    box: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the force on each taxel, (env, 3, taxel) [N], and two vectors of each body, (env, 6, body).

    These are the sum of its taxels' forces [N], and what they leave of the moment [N·m].

    Args:
        pos: Taxel positions in their body's frame [m], inactive ones far away, and −2 times their normals: (taxel, 6).
        weight: Depth of each probe over its radius, plus `unreached()`, (env, taxel) [1].
        point: Contact points, three planes (env, body, contact) [m].
        force: Forces on the body [N].
        torque: Torques on the body at the contact points [N·m].
        normal: Unit normals out of the objects.
        radius: Radius of a footprint, (body,) [m].
        levenberg: Least curvature of each step towards the moment [1].
        first: First taxel of each body, and the number of all: (body + 1,).
        box: Least and largest coordinates of each body's active taxels, (body, 6) [m].
    """
    num_envs, num_bodies, num_contacts = point[0].shape
    num_taxels = weight.shape[1]
    shared = weight.new_empty((num_envs, 3, num_taxels))
    sums = weight.new_empty((num_envs, 6, num_bodies))
    planes = [plane.contiguous() for plane in (pos, weight, *point, *force, *torque, *normal)]
    num_blocks = triton.cdiv(num_envs, ENVS)
    scratch = weight.new_empty((num_blocks, triton.cdiv(num_contacts, GROUP), num_taxels + num_bodies, ENVS * GROUP))
    wrap_triton(footprint_kernel)[(num_blocks, num_bodies)](
        *planes, radius, levenberg, first, box, scratch, shared, sums, num_envs, num_bodies, num_contacts, num_taxels,
        STEPS=levenberg.shape[0], FEW=FEW_STEPS, ENVS=ENVS, GROUP=GROUP, TILE=TILE, num_warps=1,
    )  # fmt: skip
    return shared, sums


@triton.jit
def footprint_kernel(
    pos, weight, point_x, point_y, point_z, force_x, force_y, force_z, torque_x, torque_y, torque_z,
    normal_x, normal_y, normal_z, radius, levenberg, first, box, scratch, shared, sums,
    num_envs, num_bodies, num_contacts, num_taxels,
    STEPS: tl.constexpr, FEW: tl.constexpr, ENVS: tl.constexpr, GROUP: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    """Find β of one body in a block of environments, and share out its contacts."""
    block, body = tl.program_id(0).to(tl.int64), tl.program_id(1)
    env = block * ENVS + tl.arange(0, ENVS)
    is_env = env < num_envs
    row = env * num_bodies + body
    first_taxel = tl.load(first + body)
    num_here = tl.load(first + body + 1) - first_taxel
    pos += 6 * first_taxel
    weight += first_taxel + tl.where(is_env, env, 0) * num_taxels
    planes = (point_x, point_y, point_z, force_x, force_y, force_z, torque_x, torque_y, torque_z)
    normals = (normal_x, normal_y, normal_z)
    inverse = 1.0 / tl.load(radius + body)
    box += 6 * body
    IS_LONG: tl.constexpr = STEPS > FEW
    LANES: tl.constexpr = ENVS * GROUP
    per_group = LANES * (num_taxels + num_bodies)
    scratch += block * tl.cdiv(num_contacts, GROUP) * per_group + LANES * (first_taxel + body)
    lane = tl.arange(0, ENVS)[:, None] * GROUP + tl.arange(0, GROUP)[None, :]

    for start in range(0, num_contacts, GROUP):
        point, force, torque, is_any = _contacts(planes, row, is_env, start, num_contacts, GROUP)
        if is_any:
            normal = _three(normals, row, is_env, start, num_contacts, GROUP)
            _weigh(pos, weight, num_here, point, normal, inverse, scratch + start // GROUP * per_group + lane, LANES)

    zero = tl.zeros((ENVS,), tl.float32)
    tilt = (zero, zero, zero)
    for step in range(STEPS):
        total = zero + NO_FORCE
        excess = (zero, zero, zero)
        spread = (zero, zero, zero, zero, zero, zero)
        for start in range(0, num_contacts, GROUP):
            point, force, torque, is_any = _contacts(planes, row, is_env, start, num_contacts, GROUP)
            if is_any:
                strength, way = _direction(force)
                slope = _slope(way, tilt, inverse)
                kept = scratch + start // GROUP * per_group + lane
                captured, norm, mean, covariance = _moments(pos, num_here, box, point, slope, kept, LANES, IS_LONG, False)
                load = captured * strength
                total += tl.sum(load, axis=1)
                excess = add3(excess, _unmet(captured, mean, force, torque))
                spread = add6(spread, _of_levers(load * inverse * inverse, covariance, way))
        least = tl.load(levenberg + step)
        spread = scale6(1.0 / total, spread)
        s = solve(spread, least, scale3(inverse / total, excess))
        s = solve(spread, least, times(spread, s))
        size = dot(s, times(spread, s)) + DAMPING * dot(s, s)
        tilt = add3(tilt, scale3(-tl.rsqrt(1.0 + size), s))

    carried, unmet = (zero, zero, zero), (zero, zero, zero)
    for start in range(0, tl.maximum(num_contacts, 1), GROUP):
        point, force, torque, is_any = _contacts(planes, row, is_env, start, num_contacts, GROUP)
        if is_any:
            _, way = _direction(force)
            slope = _slope(way, tilt, inverse)
            kept = scratch + start // GROUP * per_group
            captured, norm, mean, _ = _moments(pos, num_here, box, point, slope, kept + lane, LANES, IS_LONG, True)
            unmet = add3(unmet, _unmet(captured, mean, force, torque))
            each = scale3(tl.where(norm == 0, 0.0, captured / norm), force)
            carried = add3(carried, _summed(scale3(norm, each)))
            fx, fy, fz = _each(each[0]), _each(each[1]), _each(each[2])
            tl.debug_barrier()
            for taxel in range(0, num_here, TILE):
                taxels = taxel + tl.arange(0, TILE)
                is_taxel = is_env[:, None] & (taxels < num_here)[None, :]
                parts = kept + taxels[None, :, None] * LANES + (tl.arange(0, ENVS) * GROUP)[:, None, None]
                parts = _each(_load(parts + tl.arange(0, GROUP)[None, None, :], is_taxel[:, :, None]))
                out = shared + first_taxel + env[:, None] * (3 * num_taxels) + taxels[None, :]
                _accumulate(out, _weighted(parts, fx), is_taxel, start)
                _accumulate(out + num_taxels, _weighted(parts, fy), is_taxel, start)
                _accumulate(out + 2 * num_taxels, _weighted(parts, fz), is_taxel, start)
            tl.debug_barrier()
        elif start == 0:
            normal = _three(normals, row, is_env, start, num_contacts, GROUP)
            nothing = tl.sum(0.0 * (normal[0] + normal[1] + normal[2]), axis=1)  # or not a number
            for taxel in range(0, num_here, TILE):
                taxels = taxel + tl.arange(0, TILE)
                is_taxel = is_env[:, None] & (taxels < num_here)[None, :]
                nothing += tl.sum(0.0 * _load(weight[:, None] + taxels[None, :], is_taxel), axis=1)
            carried, unmet = (nothing, nothing, nothing), (nothing, nothing, nothing)
            for taxel in range(0, num_here, TILE):
                taxels = taxel + tl.arange(0, TILE)
                is_taxel = is_env[:, None] & (taxels < num_here)[None, :]
                out = shared + first_taxel + env[:, None] * (3 * num_taxels) + taxels[None, :]
                value = tl.broadcast_to(nothing[:, None], (ENVS, TILE))
                tl.store(out, value, is_taxel)
                tl.store(out + num_taxels, value, is_taxel)
                tl.store(out + 2 * num_taxels, value, is_taxel)
    out = sums + 6 * env * num_bodies + body
    tl.store(out, carried[0], is_env)
    tl.store(out + num_bodies, carried[1], is_env)
    tl.store(out + 2 * num_bodies, carried[2], is_env)
    tl.store(out + 3 * num_bodies, -unmet[0], is_env)
    tl.store(out + 4 * num_bodies, -unmet[1], is_env)
    tl.store(out + 5 * num_bodies, -unmet[2], is_env)


@triton.jit
def _contacts(planes, row, is_env, start, num_contacts, GROUP: tl.constexpr):
    """Return points, forces and torques of a group of contacts, (env, contact), and whether there is any."""
    point = _three((planes[0], planes[1], planes[2]), row, is_env, start, num_contacts, GROUP)
    force = _three((planes[3], planes[4], planes[5]), row, is_env, start, num_contacts, GROUP)
    torque = _three((planes[6], planes[7], planes[8]), row, is_env, start, num_contacts, GROUP)
    acts = (force[0] != 0) | (force[1] != 0) | (force[2] != 0) | (torque[0] != 0) | (torque[1] != 0) | (torque[2] != 0)
    is_strange = (point[0] != point[0]) | (point[1] != point[1]) | (point[2] != point[2])
    is_any = tl.max(tl.max((acts | is_strange).to(tl.int32), axis=1), axis=0) != 0
    return point, force, torque, is_any


@triton.jit
def _three(planes, row, is_env, start, num_contacts, GROUP: tl.constexpr):
    """Return vectors of a group of contacts, (env, contact)."""
    contact = start + tl.arange(0, GROUP)
    at = row[:, None] * num_contacts + contact[None, :]
    is_contact = is_env[:, None] & (contact < num_contacts)[None, :]
    return _load(planes[0] + at, is_contact), _load(planes[1] + at, is_contact), _load(planes[2] + at, is_contact)


@triton.jit
def _load(at, is_there):
    """Return the values under a mask, else 0."""
    return tl.load(at, is_there, 0.0)


@triton.jit
def _taxel(pos, taxel):
    """Return position and −2 times the normal of a taxel, read two numbers at a time: the same for all threads."""
    at = pos.to(tl.pointer_type(tl.int64)) + 3 * taxel
    x, y = _halves(tl.load(at))
    z, nx = _halves(tl.load(at + 1))
    ny, nz = _halves(tl.load(at + 2))
    return (x, y, z), (nx, ny, nz)


@triton.jit
def _halves(pair):
    """Return the two floats of 64 bits."""
    return pair.to(tl.int32).to(tl.float32, bitcast=True), (pair >> 32).to(tl.int32).to(tl.float32, bitcast=True)


@triton.jit
def _direction(force):
    """Return the strength of forces, and their direction, which fades to zero with them."""
    strength = tl.sqrt(dot(force, force) + NO_FORCE * NO_FORCE)
    return strength, scale3(1.0 / strength, force)


@triton.jit
def _slope(way, tilt, inverse):
    """Return a of β · g = a · (x_j − x_c) / ln 2, (env, contact) [1/m]: it is f̂ × β / r_f."""
    x, y, z = tilt[0][:, None], tilt[1][:, None], tilt[2][:, None]
    scale = inverse * LOG2_E
    a = cross(way, (x, y, z))
    return scale * a[0], scale * a[1], scale * a[2]


@triton.jit
def _arm(place, point):
    """Return x_j − x_c [m]."""
    return place[0] - point[0], place[1] - point[1], place[2] - point[2]


@triton.jit
def _weigh(pos, weight, num_here, point, normal, inverse, kept, LANES: tl.constexpr):
    """Write w of contacts and taxels, (env, contact) at each taxel; then γ."""
    nearest = tl.zeros_like(point[0])
    for taxel in tl.range(0, num_here, loop_unroll_factor=UNROLL):
        place, inward = _taxel(pos, taxel)
        arm = _arm(place, point)
        near = 1.0 - inverse * inverse * dot(arm, arm)
        near = tl.minimum(near, near * dot(inward, normal), propagate_nan=tl.PropagateNan.ALL)  # keeps the sign
        near = tl.maximum(near, 0.0, propagate_nan=tl.PropagateNan.ALL)
        nearest = tl.maximum(nearest, near, propagate_nan=tl.PropagateNan.ALL)
        tl.store(kept + taxel * LANES, near * near * tl.load(weight + taxel)[:, None])
    near = tl.minimum(nearest / WHOLLY, 1.0, propagate_nan=tl.PropagateNan.ALL)
    tl.store(kept + num_here * LANES, near * near * (3.0 - 2.0 * near))


@triton.jit
def _moments(pos, num_here, box, point, slope, kept, LANES: tl.constexpr, IS_LONG: tl.constexpr, IS_LAST: tl.constexpr):
    """Return γ, the shares' sum, and mean [m] and covariance [m²] of the arms: (env, contact).

    The last time, w exp(β · g) is put in the place of w.
    """
    x = tl.clamp(point[0], tl.load(box), tl.load(box + 3))
    y = tl.clamp(point[1], tl.load(box + 1), tl.load(box + 4))
    z = tl.clamp(point[2], tl.load(box + 2), tl.load(box + 5))
    nearest = (x, y, z)
    away = _arm(nearest, point)
    zero = tl.zeros_like(point[0])
    base = dot(slope, away)
    if IS_LONG:
        base -= _highest(pos, num_here, nearest, slope, base, kept, LANES)
    total = zero
    x, y, z, xx, xy, xz, yy, yz, zz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for taxel in tl.range(0, num_here, loop_unroll_factor=UNROLL):
        arm = _arm(_taxel(pos, taxel)[0], nearest)
        exponent = base + slope[0] * arm[0] + slope[1] * arm[1] + slope[2] * arm[2]
        exponent = tl.minimum(exponent, LIMIT, propagate_nan=tl.PropagateNan.ALL)  # larger exponents are out of reach
        part = tl.load(kept + taxel * LANES) * tl.exp2(exponent)
        if IS_LAST:
            tl.store(kept + taxel * LANES, part)
        px, py, pz = part * arm[0], part * arm[1], part * arm[2]
        total += part
        x, y, z = x + px, y + py, z + pz
        xx, xy, xz = xx + px * arm[0], xy + px * arm[1], xz + px * arm[2]
        yy, yz, zz = yy + py * arm[1], yz + py * arm[2], zz + pz * arm[2]
    norm = tl.where(total == 0, 0.0, 1.0 / total)
    x, y, z = norm * x, norm * y, norm * z
    spread = (
        norm * xx - x * x, norm * xy - x * y, norm * xz - x * z,
        norm * yy - y * y, norm * yz - y * z, norm * zz - z * z,
    )  # fmt: skip
    return tl.load(kept + num_here * LANES), total, add3((x, y, z), away), spread


@triton.jit
def _each(a):
    """Return the four contacts' values, each (env, …), of (env, …, contact)."""
    even, odd = tl.split(tl.reshape(a, a.shape[:-1] + [2, 2]))
    a0, a2 = tl.split(even)
    a1, a3 = tl.split(odd)
    return a0, a1, a2, a3


@triton.jit
def _weighted(parts, force):
    """Return Σ_c part_c f_c, (env, taxel), of four parts (env, taxel) and four forces (env,)."""
    x = parts[0] * force[0][:, None] + parts[1] * force[1][:, None]
    return x + parts[2] * force[2][:, None] + parts[3] * force[3][:, None]


@triton.jit
def _highest(pos, num_here, nearest, slope, base, kept, LANES: tl.constexpr):
    """Return the largest exponent of 2 among the taxels with a weight, (env, contact)."""
    top = tl.full(nearest[0].shape, float("-inf"), tl.float32)
    for taxel in range(num_here):
        exponent = base + dot(slope, _arm(_taxel(pos, taxel)[0], nearest))
        top = tl.maximum(top, tl.where(tl.load(kept + taxel * LANES) > 0.0, exponent, float("-inf")))
    return tl.where(top == float("-inf"), 0.0, top)


@triton.jit
def _summed(a):
    """Return the sum over contacts of (env, contact) planes."""
    return tl.sum(a[0], axis=1), tl.sum(a[1], axis=1), tl.sum(a[2], axis=1)


@triton.jit
def _unmet(captured, mean, force, torque):
    """Return Σ_c γ_c (Σ_j λ_cj (x_j − x_c) × f_c − τ_c), (env,) [N·m]."""
    x, y, z = cross(mean, force)
    return _summed(scale3(captured, (x - torque[0], y - torque[1], z - torque[2])))


@triton.jit
def _of_levers(load, spread, way):
    """Return Σ_c load_c [f̂]ₓ C [f̂]ₓᵀ, (env,): the covariance of x × f̂ from the covariance of x."""
    xx, xy, xz, yy, yz, zz = spread
    x, y, z = way
    # Row by row the columns of A = C [f̂]ₓᵀ: covariances of x and x × f̂.
    ax = (xy * z - xz * y, xz * x - xx * z, xx * y - xy * x)
    ay = (yy * z - yz * y, yz * x - xy * z, xy * y - yy * x)
    az = (yz * z - zz * y, zz * x - xz * z, xz * y - yz * x)
    return (
        tl.sum(load * (ay[0] * z - az[0] * y), axis=1),
        tl.sum(load * (ay[1] * z - az[1] * y), axis=1),
        tl.sum(load * (ay[2] * z - az[2] * y), axis=1),
        tl.sum(load * (az[1] * x - ax[1] * z), axis=1),
        tl.sum(load * (az[2] * x - ax[2] * z), axis=1),
        tl.sum(load * (ax[2] * y - ay[2] * x), axis=1),
    )


@triton.jit
def _accumulate(out, value, is_there, start):
    """Store the part of the first contacts, and add further parts."""
    tl.store(out, value + tl.load(out, is_there & (start > 0), 0.0), is_there)
