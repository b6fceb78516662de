"""`footprint` as one Triton kernel, for a GPU in float32 without gradients.

A program handles one body in a block of environments. Its threads hold contacts and loop over the taxels: sums over taxels
need no communication between threads. A pass over the taxels accumulates the moments of the lever arms x_j − x_c; the mean and
covariance of g follow from those, as g is linear in the arm. Groups of contacts that are all empty are skipped.

Covariances are differences of moments, and float32 would suffer cancellation where few taxels are in the footprint, all of them
on one side of the contact. So for contacts outside the bounding box of the body's taxels, moments are about the nearest point
of that box.

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

from tgdsl.geometry.shapes_kernel import LOG2_E, add3, add6, cross, dot, scale3, scale6, solve, times
from tgdsl.sensors.force_taxel.constants import damping, no_force, wholly

ENVS = 8  # environments of a program, which is one warp: a lane for each of their contacts of a group
GROUP = 4  # contacts of a body that are looked at together; `_each` counts on four
TILE = 4  # taxels whose forces are written together
FEW_STEPS = 12  # steps up to which no exponent β · g can overflow float32, as each makes β longer by √10 at most
UNROLL = tl.constexpr(4)  # taxels of a pass that are worked on at a time
BESIDE = tl.constexpr(0.25)
"""Distance of a contact from the box of the taxels from which on moments are about that box [footprints]."""
LIMIT = tl.constexpr(64.0)  # more than any exponent of 2 in `FEW_STEPS` steps, which is √10 · 12 / ln 2
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
    net: Sequence[Tensor],
    radius: Tensor,
    levenberg: Tensor,
    first: Tensor,
    box: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the force on each taxel, (env, 3, taxel) [N], and two vectors of each body, (env, 6, body).

    These are what its taxels' forces leave of the net force [N] and of the moment [N·m].

    Args:
        pos: Taxel positions in their body's frame [m], inactive ones far away, and −2 times their normals: (taxel, 6).
        weight: Logarithm to base 2 of the depth of each probe over its radius, and `unreached()`, (env, taxel) [1].
        point: Contact points, three planes (env, body, contact) [m].
        force: Forces on the body [N].
        torque: Torques on the body at the contact points [N·m].
        normal: Unit normals out of the objects.
        net: Net forces on the bodies, three planes (env, body) [N].
        radius: Radius of a footprint, (body,) [m].
        levenberg: Least curvature of each step towards the moment [1].
        first: First taxel of each body, and the number of all: (body + 1,).
        box: Least and largest coordinates of each body's active taxels, (body, 6) [m].
    """
    num_envs, num_bodies, num_contacts = point[0].shape
    num_taxels = weight.shape[1]
    shared = weight.new_empty((num_envs, 3, num_taxels))
    sums = weight.new_empty((num_envs, 6, num_bodies))
    planes = [plane.contiguous() for plane in (pos, weight, *point, *force, *torque, *normal, *net)]
    wrap_triton(footprint_kernel)[(triton.cdiv(num_envs, ENVS), num_bodies)](
        *planes, radius, levenberg, first, box, shared, sums, num_envs, num_bodies, num_contacts, num_taxels,
        STEPS=levenberg.shape[0], FEW=FEW_STEPS, ENVS=ENVS, GROUP=GROUP, TILE=TILE,
        ONE_GROUP=num_contacts <= GROUP, num_warps=1,
    )  # fmt: skip
    return shared, sums


@triton.jit
def footprint_kernel(
    pos, weight, point_x, point_y, point_z, force_x, force_y, force_z, torque_x, torque_y, torque_z,
    normal_x, normal_y, normal_z, net_x, net_y, net_z, radius, levenberg, first, box, shared, sums,
    num_envs, num_bodies, num_contacts, num_taxels,
    STEPS: tl.constexpr, FEW: tl.constexpr, ENVS: tl.constexpr, GROUP: tl.constexpr, TILE: tl.constexpr,
    ONE_GROUP: tl.constexpr,
):  # fmt: skip
    """Find β of one body in a block of environments, and share out its contacts."""
    body = tl.program_id(1)
    env = tl.program_id(0) * ENVS + tl.arange(0, ENVS).to(tl.int64)
    is_env = env < num_envs
    row = env * num_bodies + body
    first_taxel = tl.load(first + body)
    num_here = tl.load(first + body + 1) - first_taxel
    pos += 6 * first_taxel
    weights = weight + first_taxel + tl.where(is_env, env, 0) * num_taxels
    planes = (point_x, point_y, point_z, force_x, force_y, force_z, torque_x, torque_y, torque_z)
    normals = (normal_x, normal_y, normal_z)
    inverse = 1.0 / tl.load(radius + body)
    box += 6 * body
    IS_LONG: tl.constexpr = STEPS > FEW

    zero = tl.zeros((ENVS,), tl.float32)
    tilt = (zero, zero, zero)
    if ONE_GROUP:  # not read again in each step
        contacts = _contacts(planes, normals, row, is_env, 0, num_contacts, box, inverse, GROUP)
    for step in range(STEPS):
        total = zero + NO_FORCE
        excess = (zero, zero, zero)
        spread = (zero, zero, zero, zero, zero, zero)
        for start in range(0, num_contacts, GROUP):
            if not ONE_GROUP:
                contacts = _contacts(planes, normals, row, is_env, start, num_contacts, box, inverse, GROUP)
            point, force, torque, normal, strength, way, away, is_any = contacts
            if is_any:
                slope = _slope(way, tilt, inverse)
                captured, norm, top, mean, covariance = _moments(
                    pos, weights, num_here, point, normal, slope, inverse, away, IS_LONG
                )
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
        if not ONE_GROUP:
            contacts = _contacts(planes, normals, row, is_env, start, num_contacts, box, inverse, GROUP)
        point, force, torque, normal, strength, way, away, is_any = contacts
        if is_any | (start == 0):
            slope = _slope(way, tilt, inverse)
            captured, norm, top, mean, covariance = _moments(
                pos, weights, num_here, point, normal, slope, inverse, away, IS_LONG
            )
            unmet = add3(unmet, _unmet(captured, mean, force, torque))
            each = scale3(tl.where(norm == 0, 0.0, captured / norm), force)
            carried = add3(carried, _summed(scale3(norm, each)))
            x, y, z = _each3(point)
            nx, ny, nz = _each3(normal)
            u, v, w = _each3(slope)
            fx, fy, fz = _each3(each)
            tops = _each(top)
            for taxel in range(0, num_here, TILE):
                taxels = taxel + tl.arange(0, TILE)
                is_taxel = is_env[:, None] & (taxels < num_here)[None, :]
                place, inward = _tile(pos + 6 * taxels, taxels < num_here), _tile(pos + 6 * taxels + 3, taxels < num_here)
                pull = _load(weights[:, None] + taxels[None, :], is_taxel)
                p0 = _pulled(
                    place, inward, pull, (x[0], y[0], z[0]), (nx[0], ny[0], nz[0]), (u[0], v[0], w[0]), tops[0], inverse
                )
                p1 = _pulled(
                    place, inward, pull, (x[1], y[1], z[1]), (nx[1], ny[1], nz[1]), (u[1], v[1], w[1]), tops[1], inverse
                )
                p2 = _pulled(
                    place, inward, pull, (x[2], y[2], z[2]), (nx[2], ny[2], nz[2]), (u[2], v[2], w[2]), tops[2], inverse
                )
                p3 = _pulled(
                    place, inward, pull, (x[3], y[3], z[3]), (nx[3], ny[3], nz[3]), (u[3], v[3], w[3]), tops[3], inverse
                )
                out = shared + first_taxel + env[:, None] * (3 * num_taxels) + taxels[None, :]
                _accumulate(out, _weighted(p0, p1, p2, p3, fx), is_taxel, start)
                _accumulate(out + num_taxels, _weighted(p0, p1, p2, p3, fy), is_taxel, start)
                _accumulate(out + 2 * num_taxels, _weighted(p0, p1, p2, p3, fz), is_taxel, start)
            tl.debug_barrier()
    out = sums + 6 * env * num_bodies + body
    tl.store(out, _load(net_x + row, is_env) - carried[0], is_env)
    tl.store(out + num_bodies, _load(net_y + row, is_env) - carried[1], is_env)
    tl.store(out + 2 * num_bodies, _load(net_z + row, is_env) - carried[2], is_env)
    tl.store(out + 3 * num_bodies, -unmet[0], is_env)
    tl.store(out + 4 * num_bodies, -unmet[1], is_env)
    tl.store(out + 5 * num_bodies, -unmet[2], is_env)


@triton.jit
def _contacts(planes, normals, row, is_env, start, num_contacts, box, inverse, GROUP: tl.constexpr):
    """Return a group of contacts, (env, contact): points, forces, torques, normals, `_direction`, `_away`, whether any acts."""
    contact = start + tl.arange(0, GROUP)
    at = row[:, None] * num_contacts + contact[None, :]
    is_contact = is_env[:, None] & (contact < num_contacts)[None, :]
    px, py, pz = _load(planes[0] + at, is_contact), _load(planes[1] + at, is_contact), _load(planes[2] + at, is_contact)
    fx, fy, fz = _load(planes[3] + at, is_contact), _load(planes[4] + at, is_contact), _load(planes[5] + at, is_contact)
    tx, ty, tz = _load(planes[6] + at, is_contact), _load(planes[7] + at, is_contact), _load(planes[8] + at, is_contact)
    acts = (fx != 0) | (fy != 0) | (fz != 0) | (tx != 0) | (ty != 0) | (tz != 0)
    is_strange = (px != px) | (py != py) | (pz != pz)
    is_any = tl.max(tl.max((acts | is_strange).to(tl.int32), axis=1), axis=0) != 0
    normal = _load(normals[0] + at, is_contact), _load(normals[1] + at, is_contact), _load(normals[2] + at, is_contact)
    strength, way = _direction((fx, fy, fz))
    away = _away(box, (px, py, pz), (fx, fy, fz), inverse)
    return (px, py, pz), (fx, fy, fz), (tx, ty, tz), normal, strength, way, away, is_any


@triton.jit
def _load(at, is_there):
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
    return pair.to(tl.int32).to(tl.float32, bitcast=True), (pair >> 32).to(tl.int32).to(tl.float32, bitcast=True)


@triton.jit
def _tile(at, is_there):
    return _load(at, is_there)[None, :], _load(at + 1, is_there)[None, :], _load(at + 2, is_there)[None, :]


@triton.jit
def _direction(force):
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
    return place[0] - point[0], place[1] - point[1], place[2] - point[2]


@triton.jit
def _pull(arm, facing, weight, slope, top, inverse):
    """Return κ, and w exp(β · g) / 2ᵗᵒᵖ of contacts and taxels; `facing` is −2 n · m, `weight` a logarithm."""
    near = 1.0 - inverse * inverse * dot(arm, arm)
    near = tl.minimum(near, near * facing, propagate_nan=tl.PropagateNan.ALL)  # keeps the sign
    near = tl.maximum(near, 0.0, propagate_nan=tl.PropagateNan.ALL)
    exponent = weight + slope[0] * arm[0] + slope[1] * arm[1] + slope[2] * arm[2] - top
    exponent = tl.minimum(exponent, LIMIT, propagate_nan=tl.PropagateNan.ALL)  # larger exponents are out of reach
    return near, near * near * tl.exp2(exponent)


@triton.jit
def _away(box, point, force, inverse):
    """Return the way from contacts to the box of the taxels, (env, contact) [m], 0 where they are in it or have no force."""
    x = tl.clamp(point[0], tl.load(box), tl.load(box + 3)) - point[0]
    y = tl.clamp(point[1], tl.load(box + 1), tl.load(box + 4)) - point[1]
    z = tl.clamp(point[2], tl.load(box + 2), tl.load(box + 5)) - point[2]
    acts = (force[0] != 0) | (force[1] != 0) | (force[2] != 0)
    is_beside = acts & (inverse * inverse * (x * x + y * y + z * z) > BESIDE * BESIDE)
    return tl.where(is_beside, x, 0.0), tl.where(is_beside, y, 0.0), tl.where(is_beside, z, 0.0)


@triton.jit
def _moments(pos, weights, num_here, point, normal, slope, inverse, away, IS_LONG: tl.constexpr):
    """Return γ, the shares' sum and its exponent, and mean [m] and covariance [m²] of the arms: (env, contact)."""
    zero = tl.zeros_like(point[0])
    top = zero
    if IS_LONG:
        top += _highest(pos, num_here, point, normal, slope, inverse)
    nearest, total = zero, zero
    x, y, z, xx, xy, xz, yy, yz, zz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for taxel in tl.range(0, num_here, loop_unroll_factor=UNROLL):
        place, inward = _taxel(pos, taxel)
        arm, facing = _arm(place, point), dot(inward, normal)
        weight = tl.load(weights + taxel)[:, None]
        near, part = _pull(arm, facing, weight, slope, top, inverse)
        nearest = tl.maximum(nearest, near, propagate_nan=tl.PropagateNan.ALL)
        arm = _arm(arm, away)
        px, py, pz = part * arm[0], part * arm[1], part * arm[2]
        total += part
        x, y, z = x + px, y + py, z + pz
        xx, xy, xz = xx + px * arm[0], xy + px * arm[1], xz + px * arm[2]
        yy, yz, zz = yy + py * arm[1], yz + py * arm[2], zz + pz * arm[2]
    near = tl.minimum(nearest / WHOLLY, 1.0, propagate_nan=tl.PropagateNan.ALL)
    captured = near * near * (3.0 - 2.0 * near)
    norm = tl.where(total == 0, 0.0, 1.0 / total)
    x, y, z = norm * x, norm * y, norm * z
    spread = (
        norm * xx - x * x, norm * xy - x * y, norm * xz - x * z,
        norm * yy - y * y, norm * yz - y * z, norm * zz - z * z,
    )  # fmt: skip
    mean = x + away[0], y + away[1], z + away[2]
    return captured, total, top, mean, spread


@triton.jit
def _pulled(place, inward, weight, point, normal, slope, top, inverse):
    """Return what one contact of each environment pulls at a tile of taxels with, (env, taxel)."""
    arm = _arm(place, (point[0][:, None], point[1][:, None], point[2][:, None]))
    facing = dot(inward, (normal[0][:, None], normal[1][:, None], normal[2][:, None]))
    slope = (slope[0][:, None], slope[1][:, None], slope[2][:, None])
    _near, part = _pull(arm, facing, weight, slope, top[:, None], inverse)
    return part


@triton.jit
def _each(a):
    """Return the four contacts' values, each (env, …), of (env, …, contact)."""
    even, odd = tl.split(tl.reshape(a, a.shape[:-1] + [2, 2]))
    a0, a2 = tl.split(even)
    a1, a3 = tl.split(odd)
    return a0, a1, a2, a3


@triton.jit
def _each3(a):
    return _each(a[0]), _each(a[1]), _each(a[2])


@triton.jit
def _weighted(p0, p1, p2, p3, force):
    return p0 * force[0][:, None] + p1 * force[1][:, None] + p2 * force[2][:, None] + p3 * force[3][:, None]


@triton.jit
def _highest(pos, num_here, point, normal, slope, inverse):
    """Return the largest exponent of 2 among the taxels in reach on the contact's side, (env, contact)."""
    top = tl.full(point[0].shape, float("-inf"), tl.float32)
    for taxel in range(num_here):
        place, inward = _taxel(pos, taxel)
        arm, facing = _arm(place, point), dot(inward, normal)
        is_reached = (inverse * inverse * dot(arm, arm) < 1.0) & (facing > 0.0)
        top = tl.maximum(top, tl.where(is_reached, dot(slope, arm), float("-inf")))
    return tl.where(top == float("-inf"), 0.0, top)


@triton.jit
def _summed(a):
    return tl.sum(a[0], axis=1), tl.sum(a[1], axis=1), tl.sum(a[2], axis=1)


@triton.jit
def _unmet(captured, mean, force, torque):
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
    tl.store(out, value + tl.load(out, is_there & (start > 0), 0.0), is_there)
