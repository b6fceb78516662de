"""From the state of a scene to loads: in world axes and the state's dtype, as what is found has no direction.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` felt objects, `slot` contacts of a pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Scene
from tgdsl.quantities.contacts.gathering import PairContacts, pair_contacts
from tgdsl.quantities.loads.part import LoadsPart, LoadsUse
from tgdsl.quantities.loads.request import PairLoads


def gather(part: LoadsPart[Tensor], scene: Scene) -> tuple[PairLoads, ...]:
    """Return what each use asks for."""
    return tuple(_loads(use, scene.tensors, scene.dtype) for use in part.uses)


def _loads(use: LoadsUse[Tensor], state: Mapping[str, Tensor], dtype: torch.dtype) -> PairLoads:
    found = pair_contacts(state, use.pairs)
    pressed = planes.dot(found.force, found.normal).clamp(min=0.0)
    apart = planes.sub(_velocity(state, use.objects, found, _of_object), _velocity(state, use.bodies, found, _of_link))
    across = planes.sub(apart, planes.scale(planes.dot(apart, found.normal), found.normal))
    speed = planes.safe_sqrt(planes.dot(across, across))
    force, sliding = pressed.sum(dim=-1), (pressed * speed).sum(dim=-1)
    center = along = None
    if use.center:
        bodies, spread = (use.bodies, _of_link) if use.center == "link" else (use.objects, _of_object)
        sign = 1.0 if use.center == "link" else -1.0
        center, normal = _middle(state, bodies, found, pressed, spread)
        center, along = (planes.vec(part.to(dtype) for part in own) for own in (center, planes.vec(sign * n for n in normal)))
    return PairLoads(force.to(dtype), sliding.to(dtype), center, along)


def _of_link(plane: Tensor) -> Tensor:
    """Return a plane (env, body) as it broadcasts with (env, body, object, slot)."""
    return plane[:, :, None, None]


def _of_object(plane: Tensor) -> Tensor:
    """Return a plane (env, object) as it broadcasts with (env, body, object, slot)."""
    return plane[:, None, :, None]


def _velocity(
    state: Mapping[str, Tensor], bodies: Int[Tensor, " own"], found: PairContacts, spread: Callable[[Tensor], Tensor]
) -> Vec:
    """Return the velocity of the bodies' material at each contact [m/s], (env, body, object, slot)."""
    names = ("body_pos", "body_linvel", "body_angvel")
    pos, linvel, angvel = (planes.vec(map(spread, planes.split(state[name].index_select(1, bodies)))) for name in names)
    return planes.add(linvel, planes.cross(angvel, _away(found, pos)))


def _middle(
    state: Mapping[str, Tensor],
    bodies: Int[Tensor, " own"],
    found: PairContacts,
    pressed: Tensor,
    spread: Callable[[Tensor], Tensor],
) -> tuple[Vec, Vec]:
    """Return centre [m] and mean normal of each pair's contacts, weighted by their forces, in the frames of some bodies."""
    total = pressed.sum(dim=-1, keepdim=True)
    share = pressed / torch.where(total > 0, total, 1.0)
    away = _away(found, planes.vec(map(spread, planes.split(state["body_pos"][:, bodies]))))
    rotation = planes.rot(map(spread, planes.rotation(state["body_quat"][:, bodies])))
    center, mean = (
        planes.vec((share * part).sum(dim=-1) for part in planes.rotate_back(rotation, own)) for own in (away, found.normal)
    )
    return center, mean


def _away(found: PairContacts, pos: Vec) -> Vec:
    """Return from a point to each contact [m]; zero where there is none."""
    return planes.vec(torch.where(found.is_used, part, 0.0) for part in planes.sub(found.pos, pos))
