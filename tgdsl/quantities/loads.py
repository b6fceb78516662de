"""Loads: how hard each body is pressed by each object, and how fast they slide on one another.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` felt objects.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Planning, Quantity, Request, Scene, Use
from tgdsl.quantities.contacts import PairContacts, is_counted, pair_contacts, reference_contacts
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.reference import ReferenceScene


class PairLoads(NamedTuple):
    """What each body and object do to one another; planes (env, body, object), zero where they do not touch.

    The reference's are arrays (body, object, …), its centre and mean normal always there.

        F = Σ_c max(0, f_c · n_c),   W = Σ_c max(0, f_c · n_c) |v_c − (v_c · n_c) n_c|

    with the force f_c on the body and the unit normal n_c out of the object at each contact c, and the velocity v_c of the
    object's material there relative to the body's. What contacts beyond the slots carry is shared out over those shown, as
    `quantities.contacts` has it.
    """

    force: Any  # sum of the contacts' normal forces, F [N]
    sliding: Any  # normal force times sliding speed, W [W]; times a coefficient of friction it is the power of friction
    # centre of the contacts weighted by F, in the frame of the body or object that was asked for [m]; zero where they do not
    # touch. None if it was not asked for.
    center: Any
    # mean of the contacts' normals weighted by F, in that frame, into this body or object; zero where they do not touch. None
    # if the centre was not asked for.
    along: Any = None


@dataclass(frozen=True, eq=False)
class Loads(Request[PairLoads]):
    """Asks how hard each body is pressed by each object, and how fast they slide on one another."""

    slots: int = 4  # contacts per body and object that are read
    # whose loads they are to be summed up for: geoms that two objects share load a link once, but both objects
    of: Literal["link", "object"] = "link"
    # whether the centre and the mean normal of the contacts are wanted, in the frame of what they are of
    has_center: bool = False
    wants_contacts: ClassVar[bool] = True

    @property
    def num_slots(self) -> int:
        """Contacts per body and object that are read."""
        return self.slots

    def key(self) -> tuple[Any, ...]:
        """Return what two requests at the same links have in common if they are one: the objects, and whose loads they are."""
        return type(self), self.objects, self.of

    def merged(self, other: Request) -> Loads:
        """Return a request for as many slots as both want, and for the centre if either wants it."""
        assert isinstance(other, Loads)
        return dataclasses.replace(self, slots=max(self.slots, other.slots), has_center=self.has_center or other.has_center)


Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class LoadsUse(Generic[Array]):
    """One request."""

    bodies: Array  # indices of the sensors' bodies in the state, (body,)
    objects: Array  # indices of the objects' bodies in the state, (object,)
    pairs: Array  # whose contacts: indices into `inputs.pairs`, or their number for none, (body, object)
    center: Literal["", "link", "object"]  # the frame of the centre of contacts; empty: no centre is computed


@dataclass(frozen=True, eq=False)
class LoadsPart(Generic[Array]):
    """All of it: the uses."""

    uses: tuple[LoadsUse[Array], ...]


def _use(planning: Planning, use: Use) -> LoadsUse[np.ndarray]:
    request = use.request
    assert isinstance(request, Loads)
    names = request.objects
    counted = [] if request.of == "object" else [name for name in names if is_counted(planning, name, names)]
    return LoadsUse(
        bodies=planning.body_ids(use.bodies),
        objects=planning.body_ids([planning.sensed[name].body for name in names]),
        pairs=planning.contact_table(use.bodies, names, missing=counted),
        center=request.of if request.has_center else "",
    )


def _loads(use: LoadsUse[Tensor], state: Mapping[str, Tensor], dtype: torch.dtype) -> PairLoads:
    contacts = pair_contacts(state, use.pairs)
    pressed = planes.dot(contacts.force, contacts.normal).clamp(min=0.0)
    apart = planes.sub(_velocity(state, use.objects, contacts, _of_object), _velocity(state, use.bodies, contacts, _of_link))
    across = planes.sub(apart, planes.scale(planes.dot(apart, contacts.normal), contacts.normal))
    speed = planes.safe_sqrt(planes.dot(across, across))
    force, sliding = pressed.sum(dim=-1), (pressed * speed).sum(dim=-1)
    center = along = None
    if use.center:
        bodies, spread = (use.bodies, _of_link) if use.center == "link" else (use.objects, _of_object)
        sign = 1.0 if use.center == "link" else -1.0
        center, normal = _middle(state, bodies, contacts, pressed, spread)
        center, along = (
            planes.vec(part.to(dtype) for part in vector) for vector in (center, planes.vec(sign * n for n in normal))
        )
    return PairLoads(force.to(dtype), sliding.to(dtype), center, along)


def _of_link(plane: Tensor) -> Tensor:
    return plane[:, :, None, None]


def _of_object(plane: Tensor) -> Tensor:
    return plane[:, None, :, None]


def _velocity(
    state: Mapping[str, Tensor], bodies: Int[Tensor, " own"], found: PairContacts, spread: Callable[[Tensor], Tensor]
) -> Vec:
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
        planes.vec((share * part).sum(dim=-1) for part in planes.rotate_back(rotation, vector))
        for vector in (away, found.normal)
    )
    return center, mean


def _away(found: PairContacts, pos: Vec) -> Vec:
    return planes.vec(torch.where(found.is_used, part, 0.0) for part in planes.sub(found.pos, pos))


class _Loads(Quantity):
    name, request, part = "loads", Loads, LoadsPart
    has_rows = True

    def plan(self, planning: Planning, uses: Sequence[Use]) -> LoadsPart[np.ndarray]:
        return LoadsPart(tuple(_use(planning, use) for use in uses))

    def gather(self, part: LoadsPart[Tensor], scene: Scene) -> tuple[PairLoads, ...]:
        return tuple(_loads(use, scene.tensors, scene.dtype) for use in part.uses)

    def reference(self, part: LoadsPart[np.ndarray], use: int, scene: ReferenceScene) -> PairLoads:
        use_part = part.uses[use]
        force, sliding, center, along = (np.zeros((*use_part.pairs.shape, *rest)) for rest in ((), (), (3,), (3,)))
        for (b, o), pair in np.ndenumerate(use_part.pairs):
            if pair == len(scene.contact_pairs):
                continue
            link, target = scene.body(scene.bodies[use_part.bodies[b]]), scene.body(scene.bodies[use_part.objects[o]])
            ringing, sign = (target, -1.0) if use_part.center == "object" else (link, 1.0)
            for pos, on_link, _, normal in reference_contacts(scene, pair):
                pressed = max(0.0, float(on_link @ normal))
                apart = target.velocity_at(pos) - link.velocity_at(pos)
                force[b, o] += pressed
                sliding[b, o] += pressed * float(np.linalg.norm(apart - (apart @ normal) * normal))
                center[b, o] += pressed * (ringing.rotation.T @ (pos - ringing.pos))
                along[b, o] += pressed * sign * (ringing.rotation.T @ normal)
            center[b, o] /= force[b, o] or 1.0
            along[b, o] /= force[b, o] or 1.0
        return PairLoads(force, sliding, center, along)

    def fields(self, part: LoadsPart) -> set[str]:
        slots = {"contact_pos", "contact_force", "contact_normal"}
        return {"body_linvel", "body_angvel", *slots, "contact_found", "contact_netforce"}

    def num_rows(self, part: LoadsPart, use: int) -> int:
        return part.uses[use].pairs.size

    def explain(self, part: LoadsPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
        return ["normal force and sliding speed of the solver's contacts"]


LOADS = _Loads()
