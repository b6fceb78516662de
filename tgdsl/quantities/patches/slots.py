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
from tgdsl.quantities.base import Scene
from tgdsl.quantities.patches.part import PatchesUse


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


def slots_of(use: PatchesUse[Tensor], scene: Scene) -> list[Slot]:
    """Return a body's contacts with an object, of a use in which some may meet.

    What the forces of a pair lack of its whole force is shared out as `contacts` does; the force of a contact without normal is
    not a number.
    """
    state = scene.tensors
    names = ("contact_force", "contact_torque", "contact_normal", "contact_pos")
    fields = [_of_pairs(state[name], use).flatten(3).unbind(-1) for name in names]
    touches = []
    for i in range(0, len(fields[0]), 3):
        force, torque, normal, pos = (planes.vec(field[i : i + 3]) for field in fields)
        is_used = force[0] != 0
        for part in (*force[1:], *torque, *normal):
            is_used = is_used | (part != 0)
        touches.append(Touch(force, torque, normal, pos, is_used))
    forces = _normal_forces(planes.split(_of_pairs(state["contact_netforce"], use)), touches)
    origin = planes.split(state["body_pos"][:, use.bodies, None])
    found = []
    for force, touch in zip(forces, touches, strict=True):
        away = planes.vec(torch.where(touch.is_used, part, 0.0).to(scene.dtype) for part in planes.sub(touch.pos, origin))
        found.append(Slot(force.to(scene.dtype), away, planes.vec(part.to(scene.dtype) for part in touch.normal)))
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


def _of_pairs(field: Tensor, use: PatchesUse[Tensor]) -> Tensor:
    """Return a field (env, pair, *rest) as (env, body, object, *rest), zero where there is no pair."""
    index, num_pairs = use.pairs, field.shape[1]
    if len(use.topology.met) == index.shape[0] * index.shape[1]:
        return field[:, index]
    is_pair = (index < num_pairs).reshape(*index.shape, *[1] * (field.ndim - 2))
    return torch.where(is_pair, field[:, index.clamp(max=num_pairs - 1)], 0.0)
