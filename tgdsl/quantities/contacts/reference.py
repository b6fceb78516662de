"""Contacts in float64, pair by pair and slot by slot: the oracle of `gathering`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tgdsl.quantities.contacts.part import SLOT_FIELDS, ContactsPart
from tgdsl.quantities.reference import ReferenceScene

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class ReferenceContacts:
    """The solver's contacts, each in the frame of its body: `request.ContactPoints` as a list.

    Attributes:
        body: Which body each is on.
        pos: Contact points [m].
        force: Force on the body [N].
        torque: Torque on the body [N·m].
        normal: Unit normal out of the object.
        net: Whole force on each body [N].
    """

    body: Int[Array, " contact"]
    pos: Float[Array, "contact 3"]
    force: Float[Array, "contact 3"]
    torque: Float[Array, "contact 3"]
    normal: Float[Array, "contact 3"]
    net: Float[Array, "body 3"]


def reference(part: ContactsPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferenceContacts:
    """Return the contacts of a sensor's bodies with the objects of a use."""
    table, num_pairs = part.uses[use].pairs, len(scene.contact_pairs)
    rows: list[tuple[int, list[np.ndarray]]] = []
    net = np.zeros((len(scene.layout.bodies), 3))
    for b, name in enumerate(scene.layout.bodies):
        body = scene.body(name)
        for p in (p for p in table[b].tolist() if p < num_pairs):
            whole = scene.fields["contact_netforce"][p]
            net[b] += body.rotation.T @ whole
            slots = zip(*(scene.fields[name][p] for name in SLOT_FIELDS), strict=True) if SLOT_FIELDS[0] in scene.fields else ()
            used = [list(row) for row in slots if np.any(row[1:])]
            for pos, *vectors in completed(used, whole):
                rows.append((b, [body.rotation.T @ vector for vector in (pos - body.pos, *vectors)]))
    pos, force, torque, normal = np.array([row for _, row in rows]).reshape(len(rows), 4, 3).transpose(1, 0, 2)
    return ReferenceContacts(np.array([b for b, _ in rows], dtype=np.int64), pos, force, torque, normal, net)


def completed(contacts: list[list[np.ndarray]], whole: np.ndarray) -> list[list[np.ndarray]]:
    """Return a pair's contacts (place, force, torque, normal), what they lack of its whole force added by shares of force."""
    sizes = [float(np.linalg.norm(force)) for _, force, _, _ in contacts]
    sizes = sizes if sum(sizes) > 0 else [1.0] * len(contacts)
    lacking = whole - sum((force for _, force, _, _ in contacts), np.zeros(3))
    return [
        [pos, force + size / sum(sizes) * lacking, torque, normal]
        for size, (pos, force, torque, normal) in zip(sizes, contacts, strict=True)
    ]
