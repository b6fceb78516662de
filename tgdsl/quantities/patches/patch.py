"""The patch between each body and each object, from the solver's contacts.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` objects, `slot` contacts of a body and an object.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.patches.polygon import patch_area
from tgdsl.quantities.patches.request import cancelled
from tgdsl.quantities.patches.slots import Contacts, Sides, slots_of
from tgdsl.tensors.operations import Operation

MOST_SLOTS = 8
"""Contacts of a pair that the kernel takes: it compares each with each."""


class Patch(NamedTuple):
    """Planes (env, body, object) as `ContactPatch` has them: force [N], area [m²], pos [m], normal in the link's frame."""

    force: Tensor
    area: Tensor
    pos: Vec
    normal: Vec


def patch(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> Patch:
    """Return the patches, of bodies and objects of which some may meet.

    Args:
        contacts: What the solver says.
        sides: Which of it makes a patch.
        dtype: Dtype of what is returned.
    """
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
    """Return the sum of vectors, each times its share."""
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
    """Return a direction; zero where there is none."""
    squared = planes.dot(vector, vector)
    inverse = torch.where(squared > 0, torch.rsqrt(torch.where(squared > 0, squared, 1.0)), 0.0)
    return planes.scale(inverse, vector)


def _by_kernel(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> Patch:
    """Do the same by the kernel."""
    from tgdsl.quantities.patches.patch_kernel import contact_patch

    force, area, x, y, z, normal_x, normal_y, normal_z = contact_patch(list(contacts), sides.pairs, sides.bodies).unbind()
    return Patch(force, area, (x, y, z), (normal_x, normal_y, normal_z))


def _inputs(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> list[Tensor]:
    return list(contacts)


def is_small(contacts: Contacts, sides: Sides, dtype: torch.dtype) -> bool:
    """Return whether the kernel does this: few contacts per pair, float32, and the area of the hull."""
    return contacts.force.shape[2] <= MOST_SLOTS and dtype == torch.float32 and not sides.is_star


CONTACT_PATCH = Operation("contact_patch", patch, _by_kernel, _inputs, is_small)
