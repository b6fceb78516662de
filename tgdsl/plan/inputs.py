"""The fields of a scene that a module reads, and their order."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

from tgdsl.console.tables import listing, spelled
from tgdsl.errors import StateError, did_you_mean
from tgdsl.quantities.pairs import Pair


@dataclass(frozen=True)
class ContactPart:
    """Geoms whose contacts count: all geoms of a body, of a body and all bodies below it, or one geom."""

    kind: Literal["body", "subtree", "geom"]
    name: str


class Touching(NamedTuple):
    """A part of an object and a part of a link: contacts between their geoms are the pair's."""

    object: ContactPart
    link: ContactPart


@dataclass(frozen=True)
class Inputs:
    """The fields of a scene that a module reads, and their order.

    Attributes:
        fields: Fields of `SceneState` that are read.
        bodies: Bodies whose poses (and velocities) are read.
        pairs: Pairs whose contacts are read.
        bodies_of: Body of each object named in `pairs`.
        slots: Contacts per pair of the slotted contact fields; 0 if none is read.
        objects: Objects that differ between environments, in the order of the fields `variant` and `object_size`.
        num_variants: Number of variants of each of these objects; 1 if only its size differs.
        heated: Objects with a temperature, in the order of the fields `object_temperature` and `object_material`.
        num_materials: Number of possible materials of each of these.
        start_temperatures: Initial temperature of each [°C] if it is part of the state; else None.
        joints: Joints of the fields `joint_pos`, `joint_vel` and `joint_effort`: hinges and slides.
        actuators: Actuators of the field `last_action`.
        contacts_of: Geoms of objects, where they are not just their body's: see `parts_of`.
        link_parts: Geoms of links, where they are not just their body's: see `parts_of_link`.
        substeps: Physics steps per call, if a sensor advances at each of them: see `SceneState.substeps`.
        dt: Time between calls for which a sensor's constants are computed [s]; 0: for none.
    """

    fields: tuple[str, ...]
    bodies: tuple[str, ...]
    pairs: tuple[Pair, ...]
    bodies_of: Mapping[str, str]
    slots: int
    objects: tuple[str, ...] = ()
    num_variants: tuple[int, ...] = ()
    heated: tuple[str, ...] = ()
    num_materials: tuple[int, ...] = ()
    start_temperatures: tuple[float | None, ...] = ()
    joints: tuple[str, ...] = ()
    actuators: tuple[str, ...] = ()
    contacts_of: Mapping[str, tuple[ContactPart, ...]] = dataclasses.field(default_factory=dict)
    link_parts: Mapping[str, tuple[ContactPart, ...]] = dataclasses.field(default_factory=dict)
    substeps: int = 1
    dt: float = 0.0

    @cached_property
    def names(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the entries along each named axis of the fields."""
        return {
            "body": self.bodies,
            "pair": tuple(f"{pair.link} – {pair.object}" for pair in self.pairs),
            "object": self.objects,
            "heated": self.heated,
            "joint": self.joints,
            "actuator": self.actuators,
        }

    @cached_property
    def sizes(self) -> Mapping[str, int]:
        """Number of entries along each named axis of the fields."""
        return {**{axis: len(names) for axis, names in self.names.items()}, "slot": self.slots}

    def parts_of(self, name: str) -> tuple[ContactPart, ...]:
        """Return the geoms whose contacts are an object's; no geom is in two of its parts."""
        return self.contacts_of.get(name) or (ContactPart("body", self.bodies_of[name]),)

    def parts_of_link(self, link: str) -> tuple[ContactPart, ...]:
        """Return the geoms whose contacts are a link's; no geom is in two parts, nor in two links.

        A link is rigid: its body, and the child bodies that have no joint, carry no taxels of the layout, are no sensor's link
        and are not objects. This holds for all sensors of a module: a child body with taxels is a separate link even for a
        sensor on its parent alone.
        """
        return self.link_parts.get(link) or (ContactPart("body", link),)

    def touching(self, pair: Pair) -> tuple[Touching, ...]:
        """Return the parts between which contacts are a pair's."""
        return tuple(Touching(*parts) for parts in itertools.product(self.parts_of(pair.object), self.parts_of_link(pair.link)))

    def renamed(self, names: Mapping[str, str] | None = None, *, prefix: str = "") -> Inputs:
        """Return these inputs with another scene's names of bodies, geoms, joints and actuators.

        Args:
            names: The other scene's names, by the names here.
            prefix: Prefix of all other names there, such as "robot/"; the body "world" has none.

        Raises:
            StateError: If `names` has a name that is not among these.
        """
        names = names or {}
        parts = [part for geoms in (*self.contacts_of.values(), *self.link_parts.values()) for part in geoms]
        bodies = {*self.bodies, *self.bodies_of.values(), *(pair.link for pair in self.pairs)}
        names_here = {*bodies, *self.joints, *self.actuators, *(part.name for part in parts)}
        if unknown := [name for name in names if name not in names_here]:
            hint = did_you_mean(unknown[0], names_here)
            raise StateError(f'this module reads no body, geom, joint or actuator "{unknown[0]}"; {hint}')

        def there(name: str) -> str:
            return names.get(name, name if name == "world" else prefix + name)

        def parts_there(geoms: tuple[ContactPart, ...]) -> tuple[ContactPart, ...]:
            return tuple(ContactPart(part.kind, there(part.name)) for part in geoms)

        return dataclasses.replace(
            self,
            bodies=tuple(there(name) for name in self.bodies),
            pairs=tuple(Pair(there(pair.link), pair.object) for pair in self.pairs),
            bodies_of={name: there(body) for name, body in self.bodies_of.items()},
            joints=tuple(there(name) for name in self.joints),
            actuators=tuple(there(name) for name in self.actuators),
            contacts_of={name: parts_there(geoms) for name, geoms in self.contacts_of.items()},
            link_parts={there(link): parts_there(geoms) for link, geoms in self.link_parts.items()},
        )

    def __repr__(self) -> str:
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return "Inputs\n" + listing((name, spelled(value)) for name, value in values.items() if value and value != 1)


def contact_sensor_names(pair: Pair, index: int = 0) -> tuple[str, str]:
    """Return the names of the contact sensors of one of a pair's `Inputs.touching`: the point slots, and the net force."""
    end = f"{pair.link}/{pair.object}" + (f"/{index}" if index else "")
    return f"tgdsl/contact/{end}", f"tgdsl/netforce/{end}"
