"""The contacts of each body and object, slot by slot as planes: each number of the state is read once.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` objects, `pair` pairs of the state, `slot` contacts
per pair.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec


class Contacts(NamedTuple):
    """What the solver says of contacts, and where bodies are: fields of `SceneState`.

    Attributes:
        force: Of each contact (env, pair, slot, 3) [N].
        torque: Likewise [N·m].
        normal: Likewise.
        pos: Likewise [m].
        whole: Force of all contacts of a pair (env, pair, 3) [N].
        body_pos: Origins of bodies (env, body, 3) [m].
        body_quat: Their orientations (env, body, 4).
    """

    force: Tensor
    torque: Tensor
    normal: Tensor
    pos: Tensor
    whole: Tensor
    body_pos: Tensor
    body_quat: Tensor


class Sides(NamedTuple):
    """Which contacts make a patch.

    Attributes:
        bodies: Indices of the sensor's bodies (body,).
        pairs: Of which pair each body's contacts with each object are (body, object); the number of pairs for none.
        are_all: Whether each body may meet each object.
        is_star: Whether a patch's area is that of the paper's polygon: see `patch_area`.
    """

    bodies: Tensor
    pairs: Tensor
    are_all: bool
    is_star: bool = False


class Slot(NamedTuple):
    """One contact of each body and object, planes (env, body, object); zero where there is none.

    Attributes:
        force: Normal force, at least 0 [N].
        pos: Where it is from the body's origin, along the world's axes [m].
        normal: Out of the object, along the world's axes.
    """

    force: Tensor
    pos: Vec
    normal: Vec


class Touch(NamedTuple):
    """The same as the state has it, planes: force [N], torque [N·m], normal, position in the world [m]; whether it is one."""

    force: Vec
    torque: Vec
    normal: Vec
    pos: Vec
    is_used: Tensor


def slots_of(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> list[Slot]:
    """Return each body's contacts with each object, of which some may meet.

    What the forces of a pair lack of its whole force is shared out as `contacts` does; the force of a contact without normal is
    not a number.

    Args:
        contacts: What there is.
        sides: Which of it counts.
        dtype: Dtype of what is returned; sums are those of the contacts' dtype.
    """
    fields = [_of_pairs(field, sides).flatten(3).unbind(-1) for field in contacts[:4]]
    touches = []
    for i in range(0, len(fields[0]), 3):
        force, torque, normal, pos = (planes.vec(field[i : i + 3]) for field in fields)
        is_used = force[0] != 0
        for part in (*force[1:], *torque, *normal):
            is_used = is_used | (part != 0)
        touches.append(Touch(force, torque, normal, pos, is_used))
    forces = _normal_forces(planes.split(_of_pairs(contacts.whole, sides)), touches)
    origin = planes.split(contacts.body_pos[:, sides.bodies, None])
    found = []
    for force, touch in zip(forces, touches, strict=True):
        away = planes.vec(torch.where(touch.is_used, part, 0.0).to(dtype) for part in planes.sub(touch.pos, origin))
        found.append(Slot(force.to(dtype), away, planes.vec(part.to(dtype) for part in touch.normal)))
    return found


def _normal_forces(whole: Vec, touches: list[Touch]) -> list[Tensor]:
    """Return each contact's normal force with what the pair's forces lack of the whole one [N]."""
    lacking = whole
    for touch in touches:
        lacking = planes.sub(lacking, touch.force)
    sizes = [planes.safe_sqrt(planes.dot(touch.force, touch.force)) for touch in touches]
    used = [touch.is_used.to(size.dtype) for touch, size in zip(touches, sizes, strict=True)]
    total, count = sum(sizes[1:], start=sizes[0]), sum(used[1:], start=used[0])
    is_loaded = total > 0
    inverse = 1.0 / torch.where(is_loaded, total, count.clamp(min=1.0))
    found = []
    for touch, size, one in zip(touches, sizes, used, strict=True):
        weight = torch.where(is_loaded, size, one) * inverse
        force = planes.dot(planes.add(touch.force, planes.scale(weight, lacking)), touch.normal).clamp(min=0)
        is_missing = touch.is_used & (planes.dot(touch.normal, touch.normal) == 0)
        found.append(torch.where(is_missing, torch.nan, force))
    return found


def _of_pairs(field: Tensor, sides: Sides) -> Tensor:
    """Return a field (env, pair, *rest) as (env, body, object, *rest), zero where there is no pair."""
    index, num_pairs = sides.pairs, field.shape[1]
    if sides.are_all:
        return field[:, index]
    is_pair = (index < num_pairs).reshape(*index.shape, *[1] * (field.ndim - 2))
    return torch.where(is_pair, field[:, index.clamp(max=num_pairs - 1)], 0.0)
