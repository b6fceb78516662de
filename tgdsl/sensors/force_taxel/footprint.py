"""Footprint: the fraction of each contact's force that each taxel near it carries.

A solver's contact is a point x_c with force f_c and torque τ_c; a sensor has taxels around that point. The weights are

    κ_cj = b_cj max(0, 1 − |x_j − x_c|²/r_f²),   b_cj = −2 n_j · m_c clamped to [0, 1]
    w_cj = (d_j/R_j + 10⁻³) κ_cj²,   λ⁰_cj = w_cj / Σ_j w_cj
    λ_cj ∝ λ⁰_cj exp(β · g_cj),   g_cj = (x_j − x_c) × f̂_c / r_f,   Σ_j λ_cj = 1
    γ_c = t² (3 − 2t),   t = min(1, max_j κ_cj / (3/4))

with d_j depth [m] and R_j radius [m] of the probe, n_j its outward normal, m_c the contact's normal out of the object, r_f the
footprint's radius [m], f̂_c = f_c/|f_c|. b_cj selects taxels on the contact's side of the body: 1 where m_c is within 60° of the
inward normal, 0 from 90° on, as on the back of a finger. γ_c is the captured fraction of the contact's force: 1 up to a
distance r_f/2 from an active taxel with b_cj = 1, 0 from r_f on. Both are continuous.

β [1] is one vector per body. It selects the weights with Σ_c γ_c Σ_j λ_cj (x_j − x_c) × f_c = Σ_c γ_c τ_c of minimum relative
entropy to λ⁰, contacts weighted by γ_c |f_c|: they are never negative, and splitting a contact into two at the same point with
the same direction changes nothing. To first order β is the λ⁰-weighted least-norm correction. It is computed by a fixed number
of Newton steps on the convex dual: with H the mean covariance of g and e the excess moment, both over Σ_c γ_c |f_c| (and e over
r_f),

    s = (H + ε)⁻¹ H (H + ε)⁻¹ e,   β ← β − s / √(1 + s · H s + s · s / 10)

The regularisation ε leaves directions alone in which the weights cannot change the moment, as along a single row of taxels; the
damping bounds the effect of a step on the weights. Where no weights match the moment (the contact is outside the convex hull of
the taxels in its footprint) those on its side carry more and more, and the rest is the residual.

Source: the maximum-entropy shape functions of Arroyo & Ortiz, *Int. J. Numer. Meth. Engng* 65 (2006), which match a first
moment with non-negative weights; the footprint as prior, and the moment of a force instead of a position, are ours.

Shapes: `*body` bodies, such as (env, body) or (env,); `contact` contacts of a body, `taxel` taxels of that body, both in the
frame of the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.contacts import ContactPoints
from tgdsl.sensors.base import Array
from tgdsl.sensors.force_taxel.constants import damping, no_force, unreached, wholly
from tgdsl.tensors.operations import Operation

LEVENBERG = 1e-3
"""Least curvature of the dual ε [1], in footprints squared: taxels that spread less in some direction make no moment there."""
FAR = 1e3  # where inactive taxels are for a kernel that does not know of them [m]: beyond all contacts' reach


class Footprint(NamedTuple):
    """How one body's contacts are shared out."""

    share: Float[Tensor, "*body contact taxel"]  # γ_c λ_cj, fraction of each contact's force on each taxel
    # residual moment of the shares, Σ_c γ_c τ_c − Σ_c Σ_j γ_c λ_cj (x_j − x_c) × f_c, a couple [N·m]; planes (*body,)
    residual: Vec


def footprint(
    pos: Vec,
    is_active: Bool[Tensor, "*padding taxel"],
    depth: Float[Tensor, "*body taxel"],
    inward: Vec,
    point: Vec,
    force: Vec,
    torque: Vec,
    normal: Vec,
    radius: Float[Tensor, "*padding"],
    levenberg: Float[Tensor, " iteration"],
) -> Footprint:
    """Return the shares of contacts of bodies, and the residual moment; derivatives are finite everywhere.

    Args:
        pos: Taxel positions [m], planes (taxel,) or (body, taxel).
        is_active: Which taxels can carry.
        depth: Depth of each probe over its radius [1].
        inward: −2 n of each taxel, planes shaped as `pos` [1].
        point: Contact points [m], planes (*body, contact).
        force: Forces on the body [N].
        torque: Torques on the body at the contact points [N·m].
        normal: Unit normals out of the objects.
        radius: Radius of a footprint r_f [m], one for all or (body,).
        levenberg: Least curvature of each step towards the moment [1]; of length 0 it leaves λ⁰.
    """
    arm = planes.vec((to[..., None, :] - at[..., None]) / radius[..., None, None] for to, at in zip(pos, point, strict=True))
    apart = torch.where(is_active[..., None, :], planes.dot(arm, arm), 4.0)
    each, of = planes.vec(part[..., None] for part in normal), planes.vec(part[..., None, :] for part in inward)
    pull = (1 - apart).clamp(min=0) * planes.dot(each, of).clamp(0, 1)
    weight = (depth[..., None, :] + unreached()) * pull**2
    near = (pull.amax(dim=-1) / wholly()).clamp(max=1)
    captured = near * near * (3 - 2 * near)
    strength = torch.sqrt(planes.dot(force, force) + no_force() ** 2)
    lever = planes.cross(arm, planes.vec((part / strength)[..., None] for part in force))
    load = captured * strength
    total = load.sum(dim=-1) + no_force()
    moment = planes.vec((captured * part).sum(dim=-1) / (radius * total) for part in torque)
    share = _tilted(weight, lever, _tilt(weight, lever, load / total[..., None], moment, levenberg))
    left = planes.vec(
        (captured * part).sum(dim=-1) - radius * (load * (share * g).sum(dim=-1)).sum(dim=-1)
        for part, g in zip(torque, lever, strict=True)
    )
    return Footprint(captured[..., None] * share, left)


@dataclass(frozen=True, eq=False)
class Bodies(Generic[Array]):
    """Which taxels each body has: they stand one body after the other."""

    taxel: Array  # taxels of each body (body, padded); a body with fewer than another repeats its first
    inverse_radius: Array  # 1/R of each (body, padded) [1/m], 0 for inactive and repeated ones
    row: Array  # index of each taxel in these, flattened (taxel,)
    first: Array  # first taxel of each body, and the number of all (body + 1,)
    box: Array  # least and largest coordinates of each body's active taxels (body, 6) [m]
    # position of each taxel [m], of inactive ones beyond all contacts' reach, and −2 times its outward normal (taxel, 6)
    place: Array
    padded: Array  # position and −2 times the normal of each of `taxel` (6, body, padded)


def box(pos: Float[np.ndarray, "taxel 3"]) -> Float[np.ndarray, " 6"]:
    """Return the least and the largest coordinates of taxels [m], 0 of none."""
    return np.concatenate([pos.min(axis=0), pos.max(axis=0)]) if len(pos) else np.zeros(6)


def place(
    pos: Float[np.ndarray, "taxel 3"], normal: Float[np.ndarray, "taxel 3"], is_active: Bool[np.ndarray, " taxel"]
) -> Float[np.ndarray, "taxel 6"]:
    """Return the positions of taxels [m], `FAR` away if they cannot carry, and −2 n."""
    return np.concatenate([np.where(is_active[:, None], pos, FAR), -2.0 * normal], axis=1)


class Shared(NamedTuple):
    """What contacts' forces become."""

    force: Float[Tensor, "env 3 taxel"]  # force on each taxel, Σ_c γ_c λ_cj f_c [N]
    missed: Float[Tensor, "env 3 body"]  # each body's net force less their sum over its taxels [N]
    residual: Float[Tensor, "env 3 body"]  # residual moment [N·m]


def shared_forces(
    bodies: Bodies[Tensor],
    depth: Float[Tensor, "env taxel"],
    contacts: ContactPoints,
    radius: Float[Tensor, " body"],
    levenberg: Float[Tensor, " iteration"],
) -> Shared:
    """Share out the contacts of all bodies.

    Args:
        bodies: Which taxels each body has.
        depth: Depth of each probe [m].
        contacts: Contacts on each body.
        radius: Radius of a footprint r_f [m].
        levenberg: Least curvature of each step towards the moment [1]; of length 0 it leaves λ⁰.
    """
    taxel, inverse_radius = bodies.taxel, bodies.inverse_radius
    # Of torch's operations on a CPU `index` and `exp` wake other threads for a few thousand numbers, these do not.
    depths = depth.index_select(1, taxel.flatten()).unflatten(1, taxel.shape)
    share, residual = footprint(
        planes.vec(bodies.padded[:3]),
        inverse_radius > 0,
        depths * inverse_radius,
        planes.vec(bodies.padded[3:]),
        contacts.pos,
        contacts.force,
        contacts.torque,
        contacts.normal,
        radius,
        levenberg,
    )
    padded = [(share * part[..., None]).sum(dim=2) for part in contacts.force]
    result = torch.stack([part.flatten(1).index_select(1, bodies.row) for part in padded], dim=1)
    missed = torch.stack(contacts.net, dim=1) - torch.stack([part.sum(dim=2) for part in padded], dim=1)
    return Shared(result, missed, torch.stack(residual, dim=1))


def _shared_by_kernel(
    bodies: Bodies[Tensor], depth: Tensor, contacts: ContactPoints, radius: Tensor, levenberg: Tensor
) -> Shared:
    from tgdsl.sensors.force_taxel import footprint_kernel

    inverse_radius = bodies.inverse_radius.flatten()[bodies.row]
    weight = torch.log2(depth * inverse_radius + unreached())
    args = radius, levenberg, bodies.first, bodies.box
    shared, sums = footprint_kernel.shared_forces(bodies.place, weight, *contacts, *args)
    return Shared(shared, sums[:, :3], sums[:, 3:])


def _inputs(bodies: Bodies[Tensor], depth: Tensor, contacts: ContactPoints, radius: Tensor, levenberg: Tensor) -> list[Tensor]:
    return [depth, *(part for vector in contacts for part in vector)]


SHARED_FORCES = Operation("shared_forces", shared_forces, _shared_by_kernel, _inputs)


def _tilted(weight: Tensor, lever: Vec, tilt: Vec) -> Tensor:
    """Return shares ∝ weight · exp(β · g), which sum to 1, or are all zero where all weights are."""
    exponent = torch.where(weight > 0, planes.dot(planes.vec(part[..., None, None] for part in tilt), lever), 0.0)
    weight = weight * torch.exp2(planes.log2_e() * (exponent - exponent.detach().amax(dim=-1, keepdim=True)))
    total = weight.sum(dim=-1, keepdim=True)
    return weight / torch.where(total == 0, 1.0, total)


def _tilt(weight: Tensor, lever: Vec, load: Tensor, wanted: Vec, levenberg: Tensor) -> Vec:
    """Return β [1], planes (*body,)."""
    zero = torch.zeros_like(wanted[0])
    tilt: Vec = (zero, zero, zero)
    for least in levenberg.unbind():
        share = _tilted(weight, lever, tilt)
        mean = planes.vec((share * g).sum(dim=-1) for g in lever)
        off = planes.vec(g - m[..., None] for g, m in zip(lever, mean, strict=True))
        excess = planes.vec((load * m).sum(dim=-1) - w for m, w in zip(mean, wanted, strict=True))
        spread = [(load * (share * off[i] * off[k]).sum(dim=-1)).sum(dim=-1) for i, k in _UPPER]
        halfway = _solve(spread, least, excess)
        step = _solve(spread, least, _times(spread, halfway))
        size = planes.dot(step, _times(spread, step)) + damping() * planes.dot(step, step)
        tilt = planes.sub(tilt, planes.scale(torch.rsqrt(1 + size), step))
    return tilt


_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _times(matrix: list[Tensor], right: Vec) -> Vec:
    xx, xy, xz, yy, yz, zz = matrix
    return planes.dot((xx, xy, xz), right), planes.dot((xy, yy, yz), right), planes.dot((xz, yz, zz), right)


def _solve(matrix: list[Tensor], least: Tensor, right: Vec) -> Vec:
    """Return (A + ε)⁻¹ b by LDLᵀ: planes, A symmetric positive semi-definite, its upper triangle row by row."""
    xx, xy, xz, yy, yz, zz = matrix
    first = xx + least
    by_x, bz_x = xy / first, xz / first
    second = torch.maximum(yy + least - by_x * xy, least / 2)  # exactly, it is at least ε; rounding can bring it below
    cross = yz - by_x * xz
    bz_y = cross / second
    third = torch.maximum(zz + least - bz_x * xz - bz_y * cross, least / 2)
    y = right[1] - by_x * right[0]
    z = (right[2] - bz_x * right[0] - bz_y * y) / third
    y = y / second - bz_y * z
    return right[0] / first - by_x * y - bz_x * z, y, z


def reference(
    pos: Float[np.ndarray, "taxel 3"],
    is_active: Bool[np.ndarray, " taxel"],
    depth: Float[np.ndarray, " taxel"],
    outward: Float[np.ndarray, "taxel 3"],
    point: Float[np.ndarray, "contact 3"],
    force: Float[np.ndarray, "contact 3"],
    torque: Float[np.ndarray, "contact 3"],
    normal: Float[np.ndarray, "contact 3"],
    radius: float,
    levenberg: Sequence[float],
) -> tuple[Float[np.ndarray, "contact taxel"], Float[np.ndarray, " 3"]]:
    """Return what `footprint` does, for one environment: shares γ_c λ_cj, and the moment that is left [N·m].

    `outward` are the taxels' normals n, `normal` the contacts'.
    """
    num = len(point)
    weight, captured = np.zeros((num, len(pos))), np.zeros(num)
    strength = np.sqrt(np.sum(force**2, axis=1) + no_force() ** 2)
    for c in range(num):
        apart = np.where(is_active, np.sum((pos - point[c]) ** 2, axis=1) / radius**2, 4.0)
        pull = np.maximum(0.0, 1.0 - apart) * np.clip(-2.0 * outward @ normal[c], 0.0, 1.0)
        weight[c] = (depth + unreached()) * pull**2
        t = min(1.0, pull.max() / wholly())
        captured[c] = t**2 * (3.0 - 2.0 * t)
    lever = [np.cross(pos - point[c], force[c] / strength[c]) / radius for c in range(num)]
    load = captured * strength
    total = load.sum() + no_force()
    beta = reference_beta(weight, lever, load / total, captured @ torque / (radius * total), levenberg)
    shares = np.array([captured[c] * reference_tilt(weight[c], lever[c] @ beta) for c in range(num)]).reshape(num, len(pos))
    carried = np.zeros(3)
    for c in range(num):
        for x, part in zip(pos, shares[c], strict=True):
            carried += part * np.cross(x - point[c], force[c]) if part else 0.0
    return shares, captured @ torque - carried


def reference_beta(
    weight: Float[np.ndarray, "contact taxel"],
    lever: Sequence[Float[np.ndarray, "taxel 3"]],
    load: Float[np.ndarray, " contact"],
    wanted: Float[np.ndarray, " 3"],
    levenberg: Sequence[float],
) -> Float[np.ndarray, " 3"]:
    """Return β [1] after the given steps."""
    beta = np.zeros(3)
    for least in levenberg:
        excess, spread = -wanted, np.zeros((3, 3))
        for c, part in enumerate(load):
            share = reference_tilt(weight[c], lever[c] @ beta)
            mean = share @ lever[c]
            excess = excess + part * mean
            spread += part * (share * (lever[c] - mean).T) @ (lever[c] - mean)
        curvature = spread + least * np.eye(3)
        step = np.linalg.solve(curvature, spread @ np.linalg.solve(curvature, excess))
        beta -= step / np.sqrt(1.0 + step @ spread @ step + damping() * step @ step)
    return beta


def reference_tilt(weight: Float[np.ndarray, " taxel"], exponent: Float[np.ndarray, " taxel"]) -> Float[np.ndarray, " taxel"]:
    """Return shares ∝ weight · exp(exponent) of the taxels that have any weight."""
    share, has_weight = np.zeros(len(weight)), weight > 0
    if has_weight.any():
        share[has_weight] = weight[has_weight] * np.exp(exponent[has_weight] - exponent[has_weight].max())
        share /= share.sum()
    return share
