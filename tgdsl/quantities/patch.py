"""The patch between each body and each object, from the solver's contacts, slot by slot as planes: each number is read once.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` objects, `pair` pairs of the state, `slot` contacts of
a body and an object.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.tensors.operations import Operation


# A function, not a float of the module: under dynamic shapes torch.compile makes that an input of the graph.
def cancelled() -> float:
    """Return the length of the mean of unit normals below which it has no direction."""
    return 1e-3


class Contacts(NamedTuple):
    """What the solver says of contacts, and where bodies are: fields of `SceneState`."""

    force: Tensor  # of each contact (env, pair, slot, 3) [N]
    torque: Tensor  # the same [N·m]
    normal: Tensor  # the same
    pos: Tensor  # the same [m]
    whole: Tensor  # force of all contacts of a pair (env, pair, 3) [N]
    body_pos: Tensor  # origins of bodies (env, body, 3) [m]
    body_quat: Tensor  # their orientations (env, body, 4)


class Sides(NamedTuple):
    """Which contacts make a patch."""

    bodies: Tensor  # indices of the sensor's bodies (body,)
    pairs: Tensor  # the pair of each body's contacts with each object (body, object); the number of pairs for none
    are_all: bool  # whether each body may meet each object
    is_star: bool = False  # whether the area is the paper's polygon: see `patch_area`


class Slot(NamedTuple):
    """One contact of each body and object, planes (env, body, object); zero where there is none."""

    force: Tensor  # normal force, at least 0 [N]
    pos: Vec  # where it is from the body's origin, along the world's axes [m]
    normal: Vec  # out of the object, along the world's axes


class Touch(NamedTuple):
    """The same as the state has it, planes: force [N], normal, position in the world [m]; whether it is one."""

    force: Vec
    normal: Vec
    pos: Vec
    is_used: Tensor


def slots_of(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> list[Slot]:
    """Return each body's contacts with each object, where they may meet.

    What the forces of a pair lack of its whole force is shared out as `contacts` does; the force of a contact without normal is
    not a number.
    """
    fields = [_of_pairs(field, sides).flatten(3).unbind(-1) for field in contacts[:4]]
    touches = []
    for i in range(0, len(fields[0]), 3):
        force, torque, normal, pos = (planes.vec(field[i : i + 3]) for field in fields)
        is_used = force[0] != 0
        for part in (*force[1:], *torque, *normal):
            is_used = is_used | (part != 0)
        touches.append(Touch(force, normal, pos, is_used))
    forces = _normal_forces(planes.split(_of_pairs(contacts.whole, sides)), touches)
    origin = planes.split(contacts.body_pos[:, sides.bodies, None])
    results = []
    for force, touch in zip(forces, touches, strict=True):
        away = planes.vec(torch.where(touch.is_used, part, 0.0).to(dtype) for part in planes.sub(touch.pos, origin))
        results.append(Slot(force.to(dtype), away, planes.vec(part.to(dtype) for part in touch.normal)))
    return results


def _normal_forces(whole: Vec, touches: list[Touch]) -> list[Tensor]:
    """Return each contact's normal force, with the pair's remaining force shared out [N]."""
    lacking = whole
    for touch in touches:
        lacking = planes.sub(lacking, touch.force)
    sizes = [planes.safe_sqrt(planes.dot(touch.force, touch.force)) for touch in touches]
    used = [touch.is_used.to(size.dtype) for touch, size in zip(touches, sizes, strict=True)]
    total, count = sum(sizes[1:], start=sizes[0]), sum(used[1:], start=used[0])
    is_loaded = total > 0
    inverse = 1.0 / torch.where(is_loaded, total, count.clamp(min=1.0))
    results = []
    for touch, size, one in zip(touches, sizes, used, strict=True):
        weight = torch.where(is_loaded, size, one) * inverse
        force = planes.dot(planes.add(touch.force, planes.scale(weight, lacking)), touch.normal).clamp(min=0)
        is_missing = touch.is_used & (planes.dot(touch.normal, touch.normal) == 0)
        results.append(torch.where(is_missing, torch.nan, force))
    return results


def _of_pairs(field: Tensor, sides: Sides) -> Tensor:
    """Return a field (env, pair, *rest) as (env, body, object, *rest), zero where there is no pair."""
    index, num_pairs = sides.pairs, field.shape[1]
    if sides.are_all:
        return field[:, index]
    is_pair = (index < num_pairs).reshape(*index.shape, *[1] * (field.ndim - 2))
    return torch.where(is_pair, field[:, index.clamp(max=num_pairs - 1)], 0.0)


MOST_SWAPPED = 8  # points up to which they are sorted by swapping neighbours, which compiles to one kernel
Point = tuple[Tensor, Tensor, Tensor]  # angle, as a number that grows with it, and two coordinates [m]


def patch_area(away: Sequence[Vec], normal: Vec, is_used: Sequence[Tensor], is_star: bool) -> Float[Tensor, "env body object"]:
    """Return the area of the convex hull of points, projected along a normal [m²].

    The points are sorted by angle about the origin, from the one that is farthest along an axis. Of all closed polygons through
    that point which skip any of the others, the hull is the largest: with A_k twice the area swept on the way to point k,

        A_k = max over j < k of A_j + x_j y_k − y_j x_k,    area = ½ max over k of A_k + x_k y_0 − y_k x_0.

    The points that count are about a centre within their hull [m]. With `is_star` it is the paper's polygon through all points
    in the order of their angles, which is smaller wherever a point lies inside the hull.
    """
    if len(away) < 3:
        return torch.zeros_like(normal[0])
    one, other = _tangents(normal)
    flat = [
        (torch.where(used, planes.dot(point, one), 0.0), torch.where(used, planes.dot(point, other), 0.0))
        for point, used in zip(away, is_used, strict=True)
    ]
    points = _sorted(_with_angles(flat, is_used))
    (_, x0, y0), *rest = points
    swept = [torch.zeros_like(x0)]
    for k, (_, x, y) in enumerate(rest, start=1):
        earlier = range(k - 1, k) if is_star else range(k)
        swept.append(reduce(torch.maximum, [swept[j] + points[j][1] * y - points[j][2] * x for j in earlier]))
    closed = [total + x * y0 - y * x0 for total, (_, x, y) in zip(swept, points, strict=True)]
    return 0.5 * (closed[-1] if is_star else reduce(torch.maximum, closed)).clamp(min=0)


def _with_angles(flat: Sequence[tuple[Tensor, Tensor]], is_used: Sequence[Tensor]) -> list[Point]:
    """Return points with their angles around the point of largest x; unused points come last, at its position."""
    start_x, start_y = torch.full_like(flat[0][0], -torch.inf), torch.zeros_like(flat[0][0])
    for (x, y), used in zip(flat, is_used, strict=True):
        is_farther = used & (x > start_x)
        start_x, start_y = torch.where(is_farther, x, start_x), torch.where(is_farther, y, start_y)
    start_x = torch.where(start_x == -torch.inf, 0.0, start_x)
    start = _angle(start_x.detach(), start_y.detach())
    points = []
    for (x, y), used in zip(flat, is_used, strict=True):
        angle = _angle(x.detach(), y.detach()) - start
        angle = torch.where((x == start_x) & (y == start_y), -1.0, torch.where(angle < 0, angle + 4.0, angle))
        points.append((torch.where(used, angle, 8.0), torch.where(used, x, start_x), torch.where(used, y, start_y)))
    return points


def _sorted(points: list[Point]) -> list[Point]:
    """Return the points by angle; equal ones stay in order."""
    if len(points) > MOST_SWAPPED:
        angle, x, y = (torch.stack(part, dim=-1) for part in zip(*points, strict=True))
        angle, order = torch.sort(angle, dim=-1, stable=True)
        parts = (angle, x.gather(-1, order), y.gather(-1, order))
        return list(zip(*(part.unbind(-1) for part in parts), strict=True))
    points = list(points)
    for end in range(len(points) - 1, 0, -1):
        for i in range(end):
            low, high = points[i], points[i + 1]
            is_wrong = high[0] < low[0]
            points[i] = planes.where(is_wrong, high, low)
            points[i + 1] = planes.where(is_wrong, low, high)
    return points


def _angle(x: Tensor, y: Tensor) -> Tensor:
    size = x.abs() + y.abs()
    along = x / torch.where(size > 0, size, 1.0)
    return torch.where(y >= 0, 1.0 - along, 3.0 + along)


def _tangents(normal: Vec) -> tuple[Vec, Vec]:
    """Return two directions across a normal (Duff et al., JCGT 6(1), 2017)."""
    nx, ny, nz = normal
    sign = torch.where(nz >= 0, 1.0, -1.0)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return (1.0 + sign * nx * nx * a, sign * b, -sign * nx), (b, sign + ny * ny * a, -ny)


MOST_SLOTS = 8  # contacts of a pair that the kernel takes: it compares each with each


class Patch(NamedTuple):
    """Planes (env, body, object) as `ContactPatch` has them: force [N], area [m²], pos [m], normal in the link's frame."""

    force: Tensor
    area: Tensor
    pos: Vec
    normal: Vec


def patch(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> Patch:
    """Return the patches of bodies and objects that may meet."""
    slots = slots_of(contacts, sides, dtype)
    force = [slot.force for slot in slots]
    total = sum(force[1:], start=force[0])
    inverse = 1.0 / torch.where(total > 0, total, 1.0)
    share = [part * inverse for part in force]
    centre = _mean(share, [slot.pos for slot in slots])
    normal = _direction(force, share, [slot.normal for slot in slots])
    area = patch_area([planes.sub(slot.pos, centre) for slot in slots], normal, [part > 0 for part in force], sides.is_star)
    turn = planes.rotation(contacts.body_quat[:, sides.bodies])
    turn = planes.rot(part.to(dtype)[..., None] for part in turn)
    return Patch(total, area, planes.rotate_back(turn, centre), planes.rotate_back(turn, normal))


def _mean(share: Sequence[Tensor], of: Sequence[Vec]) -> Vec:
    parts = [planes.scale(weight, vector) for weight, vector in zip(share, of, strict=True)]
    return reduce(planes.add, parts)


def _direction(force: Sequence[Tensor], share: Sequence[Tensor], normals: Sequence[Vec]) -> Vec:
    """Return the direction of the mean of normals, or of the first that counts where they cancel."""
    mean, first = _mean(share, normals), normals[-1]
    for weight, normal in zip(reversed(force[:-1]), reversed(normals[:-1]), strict=True):
        first = planes.where(weight > 0, normal, first)
    is_none = (planes.dot(mean, mean) < cancelled() ** 2) & (sum(force[1:], start=force[0]) > 0)
    return _unit(planes.where(is_none, first, mean))


def _unit(vector: Vec) -> Vec:
    squared = planes.dot(vector, vector)
    inverse = torch.where(squared > 0, torch.rsqrt(torch.where(squared > 0, squared, 1.0)), 0.0)
    return planes.scale(inverse, vector)


def _by_kernel(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> Patch:
    from tgdsl.quantities.patch_kernel import contact_patch

    force, area, x, y, z, normal_x, normal_y, normal_z = contact_patch(
        list(contacts), sides.pairs, sides.bodies, cancelled()
    ).unbind()
    return Patch(force, area, (x, y, z), (normal_x, normal_y, normal_z))


def _inputs(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> list[Tensor]:
    return list(contacts)


def is_small(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> bool:
    """Return whether the kernel does this: few contacts per pair, float32, and the area of the hull."""
    return contacts.force.shape[2] <= MOST_SLOTS and dtype == torch.float32 and not sides.is_star


CONTACT_PATCH = Operation("contact_patch", patch, _by_kernel, _inputs, is_small)
