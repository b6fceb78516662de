"""The solver's contacts on the bodies that carry a sensor, in each body's frame.

Shapes: `env` environments, `body` bodies that carry the sensor, `contact` contacts of one body: slot after slot of one object
after the other, `all_bodies` bodies of the state, `pair` pairs of the state, `slot` contacts per pair, `object` felt objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec


class Contacts(NamedTuple):
    """Contacts on each body, in its frame; planes (env, body, contact), but `net` (env, body). Unused slots are all zero.

    Attributes:
        pos: Contact points [m].
        force: Force on the body at each [N].
        torque: Torque on the body at each [N·m].
        normal: Unit normal out of the object at each.
        net: Whole force on the body from the objects felt [N], contacts beyond the slots included.
    """

    pos: Vec
    force: Vec
    torque: Vec
    normal: Vec
    net: Vec


def contacts(
    state: Mapping[str, Tensor],
    bodies: Int[Tensor, " body"],
    index: Int[Tensor, "body object"],
    dtype: torch.dtype,
) -> Contacts:
    """Bring the contacts of a state into the frames of the bodies, in the state's dtype, and then cast them.

    Args:
        state: Fields of `SceneState`: body_pos, body_quat, contact_netforce and, unless the slots are not wanted, contact_pos,
            contact_force, contact_torque and contact_normal.
        bodies: The bodies, among those of the state.
        index: Pair of each body and object; their number where there is none.
        dtype: Dtype of the result.
    """
    rotation = planes.rotation(state["body_quat"][:, bodies])
    net = _of_pairs(state["contact_netforce"], index).sum(dim=2)
    net = planes.rotate_back(rotation, planes.split(net))
    if "contact_force" not in state:
        none = net[0].new_zeros((*net[0].shape, 0))
        own = [(none, none, none)] * 4
    else:
        each = planes.rot(part[..., None] for part in rotation)
        names = ("contact_force", "contact_torque", "contact_normal", "contact_pos")
        force, torque, normal, pos = (planes.split(_of_pairs(state[name], index).flatten(2, 3)) for name in names)
        origin = planes.split(state["body_pos"][:, bodies, None])
        is_used = planes.dot(normal, normal) > 0
        away = planes.vec(torch.where(is_used, part, 0.0) for part in planes.sub(pos, origin))
        own = [planes.rotate_back(each, vector) for vector in (away, force, torque, normal)]
    pos, force, torque, normal, net = (planes.vec(part.to(dtype) for part in vector) for vector in (*own, net))
    return Contacts(pos, force, torque, normal, net)


def _of_pairs(field: Tensor, index: Int[Tensor, "body object"]) -> Tensor:
    """Return a field (env, pair, *rest) as (env, body, object, *rest), zero where there is no pair."""
    padding = field.new_zeros((field.shape[0], 1, *field.shape[2:]))
    return torch.cat([field, padding], dim=1)[:, index]
