"""The solver's contacts on the bodies that carry a sensor, each in its body's frame.

Shapes: `env` environments, `body` bodies that carry the sensor, `contact` contacts of one body: slot after slot of one object
after the other, `all_bodies` bodies of the state, `pair` pairs of the state, `slot` contacts per pair, `object` felt objects.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Plane, Vec
from tgdsl.quantities.base import Planning, Quantity, Request, Scene, Use
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.reference import ReferenceScene
from tgdsl.tensors.on_host import on_host


class ContactPoints(NamedTuple):
    """Contacts on each body, in its frame; planes (env, body, contact), but `net` (env, body). Unused slots are all zero.

    Contacts beyond the slots have no place of their own. What a pair's slots lack of its whole force, r = f_net − Σ_c f_c, acts
    at the centre of the contacts shown, weighted by their forces: each takes r |f_c| / Σ_c |f_c| on itself, or equal shares
    where none has a force. The forces then sum to the whole; the moment of r about that centre is not known, nor are torques
    beyond the slots. Where no contact is shown there is nowhere to act, and `net` alone has r.
    """

    pos: Vec  # contact points [m]
    force: Vec  # force on the body at each [N]
    torque: Vec  # torque on the body at each [N·m]
    normal: Vec  # unit normal out of the object at each; NaN where the state has a force without one
    net: Vec  # whole force on the body from the objects felt [N], contacts beyond the slots included


@dataclass(frozen=True, eq=False)
class Contacts(Request[ContactPoints]):
    """Asks for the solver's contacts."""

    slots: int = 0  # contacts per body and object that are wanted; 0: the net force alone
    wants_contacts: ClassVar[bool] = True

    @property
    def num_slots(self) -> int:
        """Contacts per body and object that are read."""
        return self.slots

    def key(self) -> tuple[Any, ...]:
        """Return what two requests at the same taxels have in common if they are one: the objects."""
        return type(self), self.objects

    def merged(self, other: Request) -> Contacts:
        """Return a request for as many slots as both want."""
        assert isinstance(other, Contacts)
        return dataclasses.replace(self, slots=max(self.slots, other.slots))


Array = TypeVar("Array")

SLOT_FIELDS = ("contact_pos", "contact_force", "contact_torque", "contact_normal")
"""Fields of the state that are read contact by contact."""


@dataclass(frozen=True, eq=False)
class ContactsUse(Generic[Array]):
    """One request."""

    bodies: Array  # indices of the sensors' bodies in the state, (body,)
    pairs: Array  # whose contacts: indices into `inputs.pairs`, or their number for none, (body, object)


@dataclass(frozen=True, eq=False)
class ContactsPart(Generic[Array]):
    """All of it."""

    slots: int  # contacts per pair that are read; 0: the net force alone
    uses: tuple[ContactsUse[Array], ...]  # the uses


def _use(planning: Planning, use: Use) -> ContactsUse[np.ndarray]:
    objects = [name for name in use.request.objects if planning.object_id(name) is not None]
    counted = [name for name in objects if not is_counted(planning, name, use.request.objects)]
    return ContactsUse(planning.body_ids(use.bodies), planning.contact_table(use.bodies, counted))


def is_counted(planning: Planning, name: str, felt: Sequence[str]) -> bool:
    """Return whether another object already counts the contacts with this one.

    Several objects may stand for one body, whose force counts once. Of two with the same contacts the first one counts.
    """
    touched, index = planning.sensed[name].touched, list(felt).index(name)
    all_touched = [planning.sensed[other].touched for other in felt]
    return any(touched < other or (touched == other and i < index) for i, other in enumerate(all_touched) if touched)


def contacts_of(
    state: Mapping[str, Tensor],
    bodies: Int[Tensor, " body"],
    index: Int[Tensor, "body object"],
    dtype: torch.dtype,
) -> ContactPoints:
    """Bring the contacts of a state into the frames of the bodies, in the state's dtype, and then cast them."""
    quat = state["body_quat"].index_select(1, bodies)
    whole = _of_pairs(state["contact_netforce"], index)
    *rotation, x, y, z = on_host(_in_frame, quat, whole.sum(dim=2))
    net = x, y, z
    if not all(name in state for name in SLOT_FIELDS):  # some of them may be there for another quantity
        none = net[0].new_zeros((*net[0].shape, 0), dtype=dtype)
        vectors = [(none, none, none)] * 4
    else:
        contacts = pair_contacts(state, index, has_torque=True)
        assert contacts.torque is not None
        fields = (contacts.pos, contacts.force, contacts.torque, contacts.normal)
        pos, force, torque, normal = (planes.vec(part.flatten(2) for part in vector) for vector in fields)
        origin = planes.split(state["body_pos"][:, bodies, None])
        away = planes.vec(torch.where(contacts.is_used.flatten(2), part, 0.0) for part in planes.sub(pos, origin))
        each = planes.rot(part[..., None] for part in rotation)
        vectors = [planes.rotate_back(each, vector) for vector in (away, force, torque, normal)]
    pos, force, torque, normal, net = (planes.vec(part.to(dtype) for part in vector) for vector in (*vectors, net))
    return ContactPoints(pos, force, torque, normal, net)


def _in_frame(quat: Plane, vector: Plane) -> list[Plane]:
    rotation = planes.rotation(quat)
    return [*rotation, *planes.rotate_back(rotation, planes.split(vector))]


class PairContacts(NamedTuple):
    """The contacts of each body and object, in world axes; planes (env, body, object, slot)."""

    pos: Vec  # contact points [m]
    force: Vec  # force on the body at each [N], what the slots lack of each pair's whole force shared out
    torque: Vec | None  # torque on the body at each [N·m]; None if it was not asked for
    normal: Vec  # unit normal out of the object; NaN where the state has a force without one
    is_used: Bool[Tensor, "env body object slot"]  # which slots are contacts


def pair_contacts(state: Mapping[str, Tensor], index: Int[Tensor, "body object"], has_torque: bool = False) -> PairContacts:
    """Return the contacts of bodies and objects where they are; without torques one that has nothing else is none."""
    names = ("contact_pos", "contact_force", "contact_normal", *(["contact_torque"] if has_torque else []))
    pos, force, normal, *rest = (planes.split(_of_pairs(state[name], index)) for name in names)
    torque = rest[0] if rest else None
    is_used = _is_any((*force, *(torque or ()), *normal))
    whole = planes.split(_of_pairs(state["contact_netforce"], index))
    is_missing = is_used & (planes.dot(normal, normal) == 0)
    normal = planes.vec(torch.where(is_missing, torch.nan, part) for part in normal)
    return PairContacts(pos, _completed(whole, force, is_used), torque, normal, is_used)


def _is_any(parts: Sequence[Tensor]) -> Bool[Tensor, "env body object slot"]:
    """Return where any of some numbers is not zero; not-a-number is none."""
    result = parts[0] != 0
    for part in parts[1:]:
        result = result | (part != 0)
    return result


def _completed(whole: Vec, force: Vec, is_used: Bool[Tensor, "env body object slot"]) -> Vec:
    """Return the contacts' forces with what they lack of each pair's whole force, (env, body, object) [N], shared out."""
    lacking = planes.vec(total - part.sum(dim=-1) for total, part in zip(whole, force, strict=True))
    size = planes.safe_sqrt(planes.dot(force, force))
    total = size.sum(dim=-1, keepdim=True)
    is_loaded, used = total > 0, is_used.to(size.dtype)
    weight = torch.where(is_loaded, size, used) / torch.where(is_loaded, total, used.sum(dim=-1, keepdim=True).clamp(min=1.0))
    return planes.vec(part + weight * rest[..., None] for part, rest in zip(force, lacking, strict=True))


def _of_pairs(field: Tensor, index: Int[Tensor, "body object"]) -> Tensor:
    padding = field.new_zeros((field.shape[0], 1, *field.shape[2:]))
    return torch.cat([field, padding], dim=1).index_select(1, index.flatten()).unflatten(1, index.shape)


@dataclass(frozen=True, eq=False)
class ReferenceContacts:
    """The solver's contacts, each in the frame of its body: `request.ContactPoints` as a list."""

    body: Int[np.ndarray, " contact"]  # which body each is on
    pos: Float[np.ndarray, "contact 3"]  # contact points [m]
    force: Float[np.ndarray, "contact 3"]  # force on the body [N]
    torque: Float[np.ndarray, "contact 3"]  # torque on the body [N·m]
    normal: Float[np.ndarray, "contact 3"]  # unit normal out of the object
    net: Float[np.ndarray, "body 3"]  # whole force on each body [N]


def reference_contacts(scene: ReferenceScene, pair: int | np.integer) -> list[list[np.ndarray]]:
    """Return a pair's contacts (place, force, torque, normal), what they lack of its whole force added by shares of force."""
    if "contact_force" not in scene.fields:
        return []
    whole = scene.fields["contact_netforce"][pair]
    none = np.zeros_like(scene.fields["contact_force"][pair])
    slots = zip(*(scene.fields[name][pair] if name in scene.fields else none for name in SLOT_FIELDS), strict=True)
    contacts = [row for row in slots if np.any(row[1:])]
    sizes = [float(np.linalg.norm(force)) for _, force, _, _ in contacts]
    sizes = sizes if sum(sizes) > 0 else [1.0] * len(contacts)
    lacking = whole - sum((force for _, force, _, _ in contacts), np.zeros(3))
    return [
        [pos, force + size / sum(sizes) * lacking, torque, normal]
        for size, (pos, force, torque, normal) in zip(sizes, contacts, strict=True)
    ]


class _Contacts(Quantity):
    name, request, part = "contacts", Contacts, ContactsPart

    def plan(self, planning: Planning, uses: Sequence[Use]) -> ContactsPart[np.ndarray]:
        slots = max((use.request.slots for use in uses if isinstance(use.request, Contacts)), default=0)
        return ContactsPart(slots, tuple(_use(planning, use) for use in uses))

    def gather(self, part: ContactsPart[Tensor], scene: Scene) -> tuple[ContactPoints, ...]:
        return tuple(contacts_of(scene.tensors, use.bodies, use.pairs, scene.dtype) for use in part.uses)

    def reference(self, part: ContactsPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferenceContacts:
        table, num_pairs = part.uses[use].pairs, len(scene.contact_pairs)
        rows: list[tuple[int, list[np.ndarray]]] = []
        net = np.zeros((len(scene.layout.bodies), 3))
        for b, name in enumerate(scene.layout.bodies):
            body = scene.body(name)
            for p in (p for p in table[b].tolist() if p < num_pairs):
                net[b] += body.rotation.T @ scene.fields["contact_netforce"][p]
                for pos, *vectors in reference_contacts(scene, p):
                    rows.append((b, [body.rotation.T @ vector for vector in (pos - body.pos, *vectors)]))
        pos, force, torque, normal = np.array([row for _, row in rows]).reshape(len(rows), 4, 3).transpose(1, 0, 2)
        return ReferenceContacts(np.array([b for b, _ in rows], dtype=np.int64), pos, force, torque, normal, net)

    def fields(self, part: ContactsPart) -> set[str]:
        return {"contact_netforce", *(["contact_found", *SLOT_FIELDS] if part.slots else [])}

    def is_light(self, part: ContactsPart) -> bool:
        return True

    def explain(self, part: ContactsPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
        return ["the solver's contacts"]


CONTACTS = _Contacts()
