"""From the state of a scene to contacts on the bodies that carry a sensor, in each body's frame.

Shapes: `env` environments, `body` bodies that carry the sensor, `contact` contacts of one body: slot after slot of one object
after the other, `all_bodies` bodies of the state, `pair` pairs of the state, `slot` contacts per pair, `object` felt objects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Plane, Vec
from tgdsl.quantities.base import Scene
from tgdsl.quantities.contacts.part import SLOT_FIELDS, ContactsPart
from tgdsl.quantities.contacts.request import ContactPoints
from tgdsl.tensors.on_host import on_host


def gather(part: ContactsPart[Tensor], scene: Scene) -> tuple[ContactPoints, ...]:
    """Return what each use asks for."""
    return tuple(contacts_of(scene.tensors, use.bodies, use.pairs, scene.dtype) for use in part.uses)


def contacts_of(
    state: Mapping[str, Tensor],
    bodies: Int[Tensor, " body"],
    index: Int[Tensor, "body object"],
    dtype: torch.dtype,
) -> ContactPoints:
    """Bring the contacts of a state into the frames of the bodies, in the state's dtype, and then cast them.

    Args:
        state: Fields of `SceneState`: body_pos, body_quat, contact_netforce and, unless the slots are not wanted, contact_pos,
            contact_force, contact_torque and contact_normal.
        bodies: The bodies, among those of the state.
        index: Pair of each body and object; their number where there is none.
        dtype: Dtype of the result.
    """
    quat = state["body_quat"].index_select(1, bodies)
    whole = _of_pairs(state["contact_netforce"], index)
    *rotation, x, y, z = on_host(_in_frame, quat, whole.sum(dim=2))
    net = x, y, z
    if not all(name in state for name in SLOT_FIELDS):  # some of them may be there for another quantity
        none = net[0].new_zeros((*net[0].shape, 0), dtype=dtype)
        own = [(none, none, none)] * 4
    else:
        each = planes.rot(part[..., None] for part in rotation)
        names = ("contact_force", "contact_torque", "contact_normal", "contact_pos")
        force, torque, normal, pos = (planes.split(_of_pairs(state[name], index)) for name in names)
        is_used = _is_any((*force, *torque, *normal))
        force, normal = _completed(planes.split(whole), force, is_used), _told(normal, is_used)
        force, torque, normal, pos = (planes.vec(part.flatten(2) for part in vector) for vector in (force, torque, normal, pos))
        origin = planes.split(state["body_pos"][:, bodies, None])
        away = planes.vec(torch.where(is_used.flatten(2), part, 0.0) for part in planes.sub(pos, origin))
        own = [planes.rotate_back(each, vector) for vector in (away, force, torque, normal)]
    pos, force, torque, normal, net = (planes.vec(part.to(dtype) for part in vector) for vector in (*own, net))
    return ContactPoints(pos, force, torque, normal, net)


def _in_frame(quat: Plane, vector: Plane) -> list[Plane]:
    """Return the planes of the rotations of bodies, (env, body), and of vectors of the world in their frames."""
    rotation = planes.rotation(quat)
    return [*rotation, *planes.rotate_back(rotation, planes.split(vector))]


class PairContacts(NamedTuple):
    """The contacts of each body and object, in world axes; planes (env, body, object, slot).

    Attributes:
        pos: Contact points [m].
        force: Force on the body at each [N], what the slots lack of each pair's whole force shared out.
        normal: Unit normal out of the object; not-a-number where the state has none beside a force.
        is_used: Which slots are contacts.
    """

    pos: Vec
    force: Vec
    normal: Vec
    is_used: Bool[Tensor, "env body object slot"]


def pair_contacts(state: Mapping[str, Tensor], index: Int[Tensor, "body object"]) -> PairContacts:
    """Return the contacts of bodies and objects where they are, without torques.

    Args:
        state: Fields of `SceneState`: contact_netforce, contact_pos, contact_force and contact_normal.
        index: Pair of each body and object; their number where there is none.
    """
    names = ("contact_pos", "contact_force", "contact_normal")
    pos, force, normal = (planes.split(_of_pairs(state[name], index)) for name in names)
    is_used = _is_any((*force, *normal))
    whole = planes.split(_of_pairs(state["contact_netforce"], index))
    return PairContacts(pos, _completed(whole, force, is_used), _told(normal, is_used), is_used)


def _is_any(parts: Sequence[Tensor]) -> Bool[Tensor, "env body object slot"]:
    """Return where any of some numbers is not zero; not-a-number is none."""
    found = parts[0] != 0
    for part in parts[1:]:
        found = found | (part != 0)
    return found


def _told(normal: Vec, is_used: Bool[Tensor, "env body object slot"]) -> Vec:
    """Return normals, not-a-number where a contact has none."""
    is_missing = is_used & (planes.dot(normal, normal) == 0)
    return planes.vec(torch.where(is_missing, torch.nan, part) for part in normal)


def _completed(whole: Vec, force: Vec, is_used: Bool[Tensor, "env body object slot"]) -> Vec:
    """Return the contacts' forces with what they lack of each pair's whole force, (env, body, object) [N], shared out."""
    lacking = planes.vec(total - part.sum(dim=-1) for total, part in zip(whole, force, strict=True))
    size = planes.safe_sqrt(planes.dot(force, force))
    total = size.sum(dim=-1, keepdim=True)
    is_loaded, used = total > 0, is_used.to(size.dtype)
    weight = torch.where(is_loaded, size, used) / torch.where(is_loaded, total, used.sum(dim=-1, keepdim=True).clamp(min=1.0))
    return planes.vec(part + weight * rest[..., None] for part, rest in zip(force, lacking, strict=True))


def _of_pairs(field: Tensor, index: Int[Tensor, "body object"]) -> Tensor:
    """Return a field (env, pair, *rest) as (env, body, object, *rest), zero where there is no pair."""
    padding = field.new_zeros((field.shape[0], 1, *field.shape[2:]))
    return torch.cat([field, padding], dim=1).index_select(1, index.flatten()).unflatten(1, index.shape)
