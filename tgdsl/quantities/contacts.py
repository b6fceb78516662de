"""The solver's contacts on the bodies that carry a sensor: each in its body's frame, or as loads of bodies and objects.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` felt objects, `slot` contacts of a body and an object,
`contact` contacts of one body: slot after slot of one object after the other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Plane, Vec
from tgdsl.quantities.base import Planning, Quantity, Request, Scene, Use
from tgdsl.quantities.reference import ReferenceScene

DEFAULT_SLOTS = 8  # default of `slots` of sensors that read contacts one by one
DEFAULT_PATCH_SLOTS = 4  # the same of sensors that need the loads of pairs, or their patches of contact


class ContactPoints(NamedTuple):
    """Contacts on each body, in its frame; planes (env, body, contact), but `net` (env, body). Unused slots are all zero.

    Contacts beyond the slots have no slot. A pair's remaining force, r = f_net − Σ_c f_c, acts at the force-weighted centre of
    the contacts in slots: each gets r |f_c| / Σ_c |f_c| in addition, or an equal share where none has a force. The forces then
    sum to the net force; the moment of r about that centre is unknown, as are torques beyond the slots. A pair without a
    contact in its slots has r in `net` alone.
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

    def key(self) -> tuple[Any, ...]:
        return type(self), self.objects

    def merged(self, other: Contacts) -> Contacts:
        return dataclasses.replace(self, slots=max(self.slots, other.slots))


Array = TypeVar("Array")
SLOT_FIELDS = ("contact_pos", "contact_force", "contact_torque", "contact_normal")  # fields that are read contact by contact


@dataclass(frozen=True, eq=False)
class ContactsUse(Generic[Array]):
    """One request."""

    bodies: Array  # indices of the sensors' bodies in the state, (body,)
    pairs: Array  # whose contacts: indices into `inputs.pairs`, or their number for none, (body, object)


@dataclass(frozen=True, eq=False)
class ContactsPart(Generic[Array]):
    """All of it."""

    slots: int  # contacts per pair that are read; 0: the net force alone
    uses: tuple[ContactsUse[Array], ...]


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
    *rotation, x, y, z = _in_frame(quat, whole.sum(dim=2))
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
    force: Vec  # force on the body at each [N], with each pair's remaining force shared out
    torque: Vec | None  # torque on the body at each [N·m]; None if it was not asked for
    normal: Vec  # unit normal out of the object; NaN where the state has a force without one
    is_used: Bool[Tensor, "env body object slot"]  # which slots are contacts


def pair_contacts(state: Mapping[str, Tensor], index: Int[Tensor, "body object"], has_torque: bool = False) -> PairContacts:
    """Return the contacts of bodies and objects where they are; without torques one that has nothing else is none."""
    names = ("contact_pos", "contact_force", "contact_normal", *(["contact_torque"] if has_torque else []))
    pos, force, normal, *rest = (planes.split(_of_pairs(state[name], index)) for name in names)
    torque = rest[0] if rest else None
    is_used = force[0] != 0
    for part in (*force[1:], *(torque or ()), *normal):
        is_used = is_used | (part != 0)
    whole = planes.split(_of_pairs(state["contact_netforce"], index))
    is_missing = is_used & (planes.dot(normal, normal) == 0)
    normal = planes.vec(torch.where(is_missing, torch.nan, part) for part in normal)
    return PairContacts(pos, _completed(whole, force, is_used), torque, normal, is_used)


def _completed(whole: Vec, force: Vec, is_used: Bool[Tensor, "env body object slot"]) -> Vec:
    """Return the contacts' forces [N], with the rest of each pair's net force (env, body, object) shared out."""
    lacking = planes.vec(total - part.sum(dim=-1) for total, part in zip(whole, force, strict=True))
    size = planes.safe_sqrt(planes.dot(force, force))
    total = size.sum(dim=-1, keepdim=True)
    is_loaded, used = total > 0, is_used.to(size.dtype)
    weight = torch.where(is_loaded, size, used) / torch.where(is_loaded, total, used.sum(dim=-1, keepdim=True).clamp(min=1.0))
    return planes.vec(part + weight * rest[..., None] for part, rest in zip(force, lacking, strict=True))


def _of_pairs(field: Tensor, index: Int[Tensor, "body object"]) -> Tensor:
    num_pairs = field.shape[1]
    if num_pairs == 0:
        return field.new_zeros((field.shape[0], *index.shape, *field.shape[2:]))
    is_pair = (index < num_pairs).reshape(*index.shape, *[1] * (field.ndim - 2))
    rows = field.index_select(1, index.clamp(max=num_pairs - 1).flatten()).unflatten(1, index.shape)
    return torch.where(is_pair, rows, 0.0)


@dataclass(frozen=True, eq=False)
class ReferenceContacts:
    """The solver's contacts, each in the frame of its body: `ContactPoints` as a list."""

    body: Int[np.ndarray, " contact"]  # which body each is on
    pos: Float[np.ndarray, "contact 3"]  # contact points [m]
    force: Float[np.ndarray, "contact 3"]  # force on the body [N]
    torque: Float[np.ndarray, "contact 3"]  # torque on the body [N·m]
    normal: Float[np.ndarray, "contact 3"]  # unit normal out of the object
    net: Float[np.ndarray, "body 3"]  # whole force on each body [N]


def reference_contacts(scene: ReferenceScene, pair: int | np.integer) -> list[list[np.ndarray]]:
    """Return a pair's contacts (position, force, torque, normal); the rest of its net force is shared out by force."""
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
    shown = "the solver's contacts"

    def plan(self, planning: Planning, uses: Sequence[Use]) -> ContactsPart[np.ndarray]:
        parts = []
        for use in uses:
            felt = use.request.objects
            names = [n for n in felt if planning.object_id(n) is not None and not is_counted(planning, n, felt)]
            parts.append(ContactsUse(planning.body_ids(use.bodies), planning.contact_table(use.bodies, names)))
        return ContactsPart(max((use.request.slots for use in uses), default=0), tuple(parts))

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


CONTACTS = _Contacts()


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
    # centre of the contacts weighted by F, in the frame of the body or object that was asked for [m], and mean of their normals
    # weighted by F, in that frame, into this body or object; zero where they do not touch. None if they were not asked for.
    center: Any
    along: Any = None


@dataclass(frozen=True, eq=False)
class Loads(Request[PairLoads]):
    """Asks how hard each body is pressed by each object, and how fast they slide on one another."""

    slots: int = DEFAULT_PATCH_SLOTS  # contacts per body and object that are read
    # whose loads they are to be summed up for: geoms that two objects share load a link once, but both objects
    of: Literal["link", "object"] = "link"
    # whether to return the contacts' centre and mean normal, in the frame of the link or object
    has_center: bool = False
    wants_contacts: ClassVar[bool] = True

    def key(self) -> tuple[Any, ...]:
        return type(self), self.objects, self.of

    def merged(self, other: Loads) -> Loads:
        return dataclasses.replace(self, slots=max(self.slots, other.slots), has_center=self.has_center or other.has_center)


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


def _loads(use: LoadsUse[Tensor], state: Mapping[str, Tensor], dtype: torch.dtype) -> PairLoads:
    contacts = pair_contacts(state, use.pairs)
    pressed = planes.dot(contacts.force, contacts.normal).clamp(min=0.0)

    def spread(parts: Sequence[Tensor], side: str) -> list[Tensor]:
        return [part[:, :, None, None] if side == "link" else part[:, None, :, None] for part in parts]

    def of(name: str, side: str) -> Vec:
        bodies = use.bodies if side == "link" else use.objects
        return planes.vec(spread(planes.split(state[name].index_select(1, bodies)), side))

    def away(side: str) -> Vec:  # from the body's origin to each contact [m]
        return planes.vec(torch.where(contacts.is_used, part, 0.0) for part in planes.sub(contacts.pos, of("body_pos", side)))

    def velocity(side: str) -> Vec:  # of the body's material at each contact [m/s]
        return planes.add(of("body_linvel", side), planes.cross(of("body_angvel", side), away(side)))

    apart = planes.sub(velocity("object"), velocity("link"))
    across = planes.sub(apart, planes.scale(planes.dot(apart, contacts.normal), contacts.normal))
    speed = planes.safe_sqrt(planes.dot(across, across))
    force, sliding = pressed.sum(dim=-1), (pressed * speed).sum(dim=-1)
    if not use.center:
        return PairLoads(force.to(dtype), sliding.to(dtype), None)
    share = pressed / torch.where(force > 0, force, 1.0)[..., None]
    quat = state["body_quat"][:, use.bodies if use.center == "link" else use.objects]
    rotation = planes.rot(spread(planes.rotation(quat), use.center))
    center, normal = (
        [(share * part).sum(dim=-1) for part in planes.rotate_back(rotation, vector)]
        for vector in (away(use.center), contacts.normal)
    )
    sign = 1.0 if use.center == "link" else -1.0
    center, along = planes.vec(c.to(dtype) for c in center), planes.vec((sign * n).to(dtype) for n in normal)
    return PairLoads(force.to(dtype), sliding.to(dtype), center, along)


class _Loads(Quantity):
    name, request, part = "loads", Loads, LoadsPart
    reads = (
        "body_linvel",
        "body_angvel",
        "contact_pos",
        "contact_force",
        "contact_normal",
        "contact_found",
        "contact_netforce",
    )
    shown = "normal force and sliding speed of the solver's contacts"
    has_rows = True

    def plan_use(self, planning: Planning, use: Use) -> LoadsUse[np.ndarray]:
        names, of = use.request.objects, use.request.of
        counted = [] if of == "object" else [name for name in names if is_counted(planning, name, names)]
        objects = planning.body_ids([planning.sensed[name].body for name in names])
        table = planning.contact_table(use.bodies, names, missing=counted)
        return LoadsUse(planning.body_ids(use.bodies), objects, table, of if use.request.has_center else "")

    def gather_use(self, part: LoadsUse[Tensor], scene: Scene) -> PairLoads:
        return _loads(part, scene.tensors, scene.dtype)

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

    def num_rows(self, part: LoadsPart, use: int) -> int:
        return part.uses[use].pairs.size


LOADS = _Loads()
