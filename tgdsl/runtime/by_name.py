"""Fields of a state from the arrays of any physics engine, by the names that it has for bodies and geoms.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair, `own` the engine's
bodies, `contact` contacts of all environments in any order.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.geometry.rotations import rotated
from tgdsl.plan.inputs import ContactPart, Inputs
from tgdsl.quantities.contacts import SLOT_FIELDS


def index_of(name: str, known: Sequence[str], one: str, several: str) -> int:
    """Return the index of a name, or of the only one that ends in it after a slash, as "robot/palm" does in "palm".

    `one` and `several` are what elements are called, such as "body" and "bodies"; equal names count once.

    Raises:
        SimulationError: If there is none of that name, or several names end in it.
    """
    if name in known:
        return known.index(name)
    nested = list(dict.fromkeys(path for path in known if path.endswith(f"/{name}")))
    if len(nested) == 1:
        return known.index(nested[0])
    if nested:
        problem = f'"{name}" may be any of the {several} {listed(nested)}'
        raise SimulationError(f"{problem}; say which: touch.inputs.renamed({{{name!r}: {nested[0]!r}}})")
    raise SimulationError(f'the scene has no {one} "{name}"; {did_you_mean(name, list(dict.fromkeys(known)), several)}')


def bodies_by_name(
    inputs: Inputs,
    names: Sequence[str],
    pos: Float[Tensor, "env own 3"],
    quat: Float[Tensor, "env own 4"],
    linvel: Float[Tensor, "env own 3"] | None = None,
    angvel: Float[Tensor, "env own 3"] | None = None,
    *,
    quat_order: Literal["wxyz", "xyzw"] = "wxyz",
    linvel_at: Float[Tensor, "*env own 3"] | None = None,
) -> dict[str, Float[Tensor, "env body ..."]]:
    """Return poses and velocities of bodies as fields of a `SceneState`, from an engine's arrays.

    Args:
        inputs: Inputs of the module: `touch.inputs`, or `touch.inputs.renamed(…)` if names differ.
        names: Names of the engine's bodies, in the order of its arrays. Prefixes that end in a slash are ignored: "robot/palm"
            matches "palm". If the engine has no body "world", it rests at the origin.
        pos: Position of each body's frame, in the world [m].
        quat: Orientation of each body.
        linvel: Velocity of each body, in the world [m/s].
        angvel: Angular velocity of each body, in the world [rad/s].
        quat_order: Order of the components of `quat`.
        linvel_at: The point of each body to which `linvel` belongs, such as its centre of mass, in the body's frame [m];
            default: the frame's origin.

    Raises:
        SimulationError: If the engine lacks a body, or several names match it.
    """
    if quat_order == "xyzw":
        quat = quat[..., [3, 0, 1, 2]]
    if linvel is not None and linvel_at is not None:
        if angvel is None:
            raise SimulationError("linvel_at is given without angvel, which takes velocities to the origin")
        linvel = linvel - torch.linalg.cross(angvel, rotated(quat, linvel_at.expand_as(linvel)))
    fields = {"body_pos": pos, "body_quat": quat, "body_linvel": linvel, "body_angvel": angvel}
    missing = [name for name in fields if name in inputs.fields and fields[name] is None]
    if missing:
        raise SimulationError(f"this module reads {listed(missing)}, expected all arguments that determine them")
    needs_world = "world" in inputs.bodies and "world" not in names
    index = _body_index(inputs.bodies, (*names, "world") if needs_world else tuple(names), pos.device)
    result = {}
    for name, value in fields.items():
        if value is not None and name in inputs.fields:
            if needs_world:
                at_rest = torch.zeros_like(value[:, :1])
                at_rest[..., 0] = name == "body_quat"
                value = torch.cat([value, at_rest], dim=1)
            result[name] = value[:, index]
    return result


@functools.lru_cache(maxsize=64)
def _body_index(bodies: tuple[str, ...], names: tuple[str, ...], device: torch.device) -> Int[Tensor, " body"]:
    ids = [index_of(body, names, "body", "bodies") for body in bodies]
    if twice := [names[i] for i in ids if names.count(names[i]) > 1]:
        raise SimulationError(f'the scene has {names.count(twice[0])} bodies "{twice[0]}"; give each a unique name')
    return torch.tensor(ids, dtype=torch.int64, device=device)


class Geoms(NamedTuple):
    """The geoms (shapes, colliders) of an environment, by name."""

    bodies: tuple[str, ...]  #: name of the body of each geom
    names: tuple[str, ...] = ()  #: name of each geom; needed only for modules with objects that share a body
    #: name of each body's parent; needed only for modules whose objects or links have child bodies without joints
    parents: tuple[tuple[str, str], ...] = ()

    def of_part(self, part: ContactPart) -> Int[np.ndarray, " geom"]:
        """Return the indices of the geoms of a part of an object or link, ascending."""
        if part.kind == "geom":
            return np.array([index_of(part.name, self.names, "geom", "geoms")])
        parents = dict(self.parents)
        names = tuple(dict.fromkeys((*self.bodies, *parents)))
        bodies = {names[index_of(part.name, names, "body", "bodies")]}
        if part.kind == "subtree":
            if not parents:
                raise SimulationError(f'the contacts of "{part.name}" include bodies below it: Geoms needs `parents`')
            below = set(bodies)
            while below := {body for body, parent in parents.items() if parent in below} - bodies:
                bodies |= below
        return np.flatnonzero([body in bodies for body in self.bodies])


class PairRows(NamedTuple):
    """Which pairs the contacts of two geoms belong to.

    A row is a link and an object's geoms: pairs of one link whose objects have the same geoms share it.
    """

    row_of_pair: Int[np.ndarray, " pair"]  # the row of each pair
    num_rows: int  # number of rows
    link_of_geom: Int[np.ndarray, " geom"]  # index of each geom's link; of none, the number of links
    # the rows of contacts of an object's geom and a link; −1 where there are no more, and of no link
    row_of_geoms: Int[np.ndarray, "layer geom link"]


def pair_rows(inputs: Inputs, geoms: Geoms) -> PairRows:
    """Look up the geoms of a module's pairs."""
    return _pair_rows(tuple((inputs.parts_of(pair.object), inputs.parts_of_link(pair.link)) for pair in inputs.pairs), geoms)


_Parts = tuple[ContactPart, ...]


@functools.lru_cache(maxsize=64)
def _pair_rows(parts: tuple[tuple[_Parts, _Parts], ...], geoms: Geoms) -> PairRows:
    links = {link: i for i, link in enumerate(dict.fromkeys(link for _, link in parts))}
    pairs = [(_indices(geoms, target), links[link]) for target, link in parts]
    rows = {pair: row for row, pair in enumerate(dict.fromkeys(pairs))}
    link_of = np.full(len(geoms.bodies), len(links), dtype=np.int32)
    for link, i in links.items():
        link_of[list(_indices(geoms, link))] = i
    none = np.full((len(geoms.bodies), len(links) + 1), -1, dtype=np.int32)
    layers: list[np.ndarray] = []
    for (of_object, link), row in rows.items():
        for geom in of_object:
            free = next((layer for layer in layers if layer[geom, link] < 0), None)
            if free is None:
                free = none.copy()
                layers.append(free)
            free[geom, link] = row
    return PairRows(np.array([rows[pair] for pair in pairs], dtype=np.int64), len(rows), link_of, np.stack(layers or [none]))


def _indices(geoms: Geoms, parts: _Parts) -> tuple[int, ...]:
    return tuple(np.unique(np.concatenate([geoms.of_part(part) for part in parts])).tolist())


def contacts_by_pair(
    inputs: Inputs,
    geoms: Geoms | Sequence[str],
    pairs: Int[Tensor, "contact 2"],
    *,
    pos: Float[Tensor, "contact 3"],
    normal: Float[Tensor, "contact 3"],
    force: Float[Tensor, "contact 3"],
    torque: Float[Tensor, "contact 3"] | None = None,
    force_on: Literal[1, 2] = 2,
    env: Int[Tensor, " contact"] | None = None,
    num_envs: int = 1,
    is_contact: Bool[Tensor, " contact"] | None = None,
) -> dict[str, Float[Tensor, "env pair ..."]]:
    """Return contacts as fields of a `SceneState`, from an engine's contacts in any order.

    It never waits for a GPU. Contacts fill a pair's slots in the given order; further ones count in the net force.

    Args:
        inputs: Inputs of the module: `touch.inputs`, or `touch.inputs.renamed(…)` if names differ.
        geoms: Name of the body of each geom of an environment, or `Geoms`; `pairs` has indices into it.
        pairs: The two geoms of each contact; a negative index means no contact.
        pos: Position of each contact, in the world [m].
        normal: Unit normal from the first geom to the second, in the world.
        force: Force on the body of the geom `force_on`, in the world [N].
        torque: Torque about `pos` on the same body, in the world [N·m]; default: zero.
        force_on: The geom on whose body `force` and `torque` act: the first or the second.
        env: The environment of each contact; default: the first.
        num_envs: Number of environments.
        is_contact: Which rows are contacts; default: rows with a force.

    Raises:
        SimulationError: If the engine lacks a body or geom, or several names match it.
    """
    rows = pair_rows(inputs, geoms if isinstance(geoms, Geoms) else Geoms(tuple(geoms)))
    row_of_pair, link_of_geom, row_of_geoms = (
        torch.from_numpy(table).to(pos.device) for table in (rows.row_of_pair, rows.link_of_geom, rows.row_of_geoms)
    )
    is_contact = (force != 0).any(dim=-1) if is_contact is None else is_contact
    is_contact = is_contact & (pairs >= 0).all(dim=-1)
    one, other = pairs.long().clamp(min=0).T
    env = torch.zeros_like(one) if env is None else env.long()
    # A contact may count in several rows: a geom may be object in one pair and link in another, or be part of several objects.
    row_ids = torch.cat([row_of_geoms[:, one, link_of_geom[other]], row_of_geoms[:, other, link_of_geom[one]]])
    num_layers, bins = len(row_of_geoms), num_envs * rows.num_rows  # one more bin holds contacts of no pair
    key = torch.where((row_ids >= 0) & is_contact, env * rows.num_rows + row_ids, bins).T
    key, shape = key.flatten(), key.shape
    sign = pos.new_ones(2 * num_layers, 1)
    sign[num_layers:] = -1.0  # there the object is the second geom

    def on_link(values: Tensor, sign: Tensor) -> Tensor:
        return (values[:, None] * sign).expand(*shape, 3).reshape(-1, 3)

    acting = sign if force_on == 2 else -sign
    forces, fields = on_link(force, acting), {}
    if "contact_netforce" in inputs.fields:
        fields["contact_netforce"] = pos.new_zeros(bins + 1, 3).index_add_(0, key, forces)[:-1].view(num_envs, -1, 3)
    if "contact_found" in inputs.fields:
        fields["contact_found"] = pos.new_zeros(bins + 1).index_add_(0, key, torch.ones_like(forces[:, 0]))[:-1]
        fields["contact_found"] = fields["contact_found"].view(num_envs, -1)
    if slot_fields := [name for name in SLOT_FIELDS if name in inputs.fields]:
        slotted = {
            "contact_pos": on_link(pos, torch.ones_like(sign)),
            "contact_normal": on_link(normal, sign),
            "contact_force": forces,
            "contact_torque": torch.zeros_like(forces) if torque is None else on_link(torque, acting),
        }
        slot = _ranks(key)
        place = torch.where((key < bins) & (slot < inputs.slots), key * inputs.slots + slot, bins * inputs.slots)
        for name in slot_fields:
            filled = pos.new_zeros(bins * inputs.slots + 1, 3).index_copy_(0, place, slotted[name])
            fields[name] = filled[:-1].view(num_envs, -1, inputs.slots, 3)
    return {name: value[:, row_of_pair] for name, value in fields.items()}


def _ranks(key: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    ordered, order = key.sort(stable=True)
    rank = torch.arange(len(key), device=key.device) - torch.searchsorted(ordered, ordered)
    return torch.empty_like(rank).index_copy_(0, order, rank)
