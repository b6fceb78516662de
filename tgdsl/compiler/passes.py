"""The passes from lowered sensors to shared uses of quantities, each a function from values to a value.

`prune` drops pairs that can never meet, `join` computes sensors of one kind on different taxels as one, `share` merges equal
requests at the same taxels into one use, `number` assigns indices to objects and bodies.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tgdsl.compiler.lowered import LoweredSensor
from tgdsl.compiler.patches import LinkBodies
from tgdsl.errors import TgdslError
from tgdsl.formats.model import Model
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Quantity, Request, Use
from tgdsl.quantities.pairs import Pair, PairedObject, PairTable
from tgdsl.surfaces.sensed import SensedObject

Sensors = Sequence[LoweredSensor]
Joined = Mapping[str, tuple[LoweredSensor, ...]]  # the sensors that are computed as one, by the name of each of them


class Pruned(NamedTuple):
    """The pairs of links and objects."""

    pairs: tuple[Pair, ...]  # the (link body, object) pairs that are needed, sorted by object and link
    contact_pairs: tuple[Pair, ...]  # the subset whose contacts are needed
    dropped: tuple[Pair, ...]  # pairs that can never be in contact
    hopeless: tuple[tuple[str, str], ...]  # (sensor, object) where the sensor can never touch the object


def prune(sensors: Sensors, sensed: Mapping[str, SensedObject], link_bodies: LinkBodies, scene: Model) -> Pruned:
    """Return the requested pairs that can meet."""
    geoms = {link: [geom.id for geom in scene.rigid_geoms(bodies) if geom.is_colliding] for link, bodies in link_bodies.items()}
    can_meet: set[Pair] = set()
    touching: set[Pair] = set()
    never: set[Pair] = set()
    hopeless: list[tuple[str, str]] = []
    for sensor in sensors:
        for target in dict.fromkeys(name for request in sensor.requests for name in request.objects):
            requests = [request for request in sensor.requests if target in request.objects]
            pairs, surface = {Pair(body, target) for body in sensor.layout.bodies}, sensed[target]
            meeting = {p for p in pairs if scene.geoms_can_collide(geoms[p.link], surface.touched)}
            is_gated = any(request.is_gated for request in requests)
            if is_gated or any(request.wants_contacts for request in requests):
                touching |= meeting
            itself = {p for p in pairs if scene.compiled.body(p.link).id in surface.bodies}
            apart = pairs - meeting if is_gated else itself
            can_meet |= pairs - apart
            never |= apart
            if apart == pairs:
                hopeless.append((sensor.sensor, target))
    return Pruned(_sorted(can_meet), _sorted(touching), _sorted(never - can_meet), tuple(hopeless))


def _sorted(pairs: set[Pair]) -> tuple[Pair, ...]:
    return tuple(sorted(pairs, key=lambda pair: (pair.object, pair.link)))


def join(sensors: Sensors) -> Joined:
    """Return the sensors that are computed as one: sensors of one kind on different taxels, such as one on each finger.

    Their parameters may differ. No probe is measured twice: sensors that measure at the same taxels are all joined with
    sensors on the same other taxels, or none of them is joined.
    """
    alike: dict[Hashable, list[LoweredSensor]] = {}
    for sensor in sensors:
        alike.setdefault(_equation(sensor) or sensor.name, []).append(sensor)
    partners: dict[bytes, set[bytes]] = {}
    for group in alike.values():
        for sensor in group:
            if _is_measuring(sensor):
                partners.setdefault(sensor.taxels.tobytes(), set()).add(b"".join(s.taxels.tobytes() for s in group))
    joined: dict[str, tuple[LoweredSensor, ...]] = {}
    for group in alike.values():
        rows = np.concatenate([sensor.taxels for sensor in group])
        is_apart = len(np.unique(rows)) == len(rows)
        if len(group) > 1 and is_apart and all(len(partners[sensor.taxels.tobytes()]) == 1 for sensor in group):
            joined |= {sensor.name: tuple(group) for sensor in group}
    return joined


def _is_measuring(sensor: LoweredSensor) -> bool:
    return any(request.wants_distance(sensor.layout.radius) for request in sensor.requests)


def _equation(sensor: LoweredSensor) -> Hashable | None:
    """Return the key that sensors share if they can be computed as one; None for a sensor that never can."""
    lowered, kind = sensor.lowered, sensor.kind
    has_own = lowered.state or lowered.reports or sensor.radius_noise or any(c.ndim for c in lowered.constants.values())
    is_coupled = lowered.provides or lowered.upstream or lowered.substeps
    if not kind.is_pointwise or has_own or is_coupled or kind.is_timed or not _is_measuring(sensor):
        return None
    request_keys = tuple(request.join_key() for request in sensor.requests)
    return kind.name, sensor.name != sensor.sensor, request_keys, lowered.channels, tuple(sorted(lowered.constants))


class Shared(NamedTuple):
    """The distinct requests of all sensors."""

    uses: dict[str, list[Use]]  # by quantity the distinct requests, in the order in which sensors make them
    of_sensor: dict[str, dict[str, int]]  # by sensor the number of its use of each quantity


def share(sensors: Sensors, joined: Joined, layout: Layout, quantities: Sequence[Quantity]) -> Shared:
    """Return the distinct uses of each quantity: equal requests at the same taxels are one use."""
    places: dict[bytes, np.ndarray] = {}
    result: dict[tuple[Hashable, ...], Use] = {}
    keys: dict[str, list[tuple[Hashable, ...]]] = {}
    of_sensor: dict[str, dict[str, int]] = {}
    for sensor in sensors:
        group = joined.get(sensor.name, (sensor,))
        taxels = np.concatenate([other.taxels for other in group])
        use_layout = layout.take(taxels) if len(taxels) else sensor.layout
        pos = places.setdefault(taxels.tobytes(), np.ascontiguousarray(layout.pos[taxels].T))
        for i, request in enumerate(sensor.requests):
            if len(group) > 1:
                request = group[0].requests[i].joined([other.requests[i] for other in group[1:]])
            noise = sensor.name if request.is_within_radii and sensor.radius_noise > 0 else ""
            name = _quantity_of(request, quantities).name
            key = taxels.tobytes(), tuple(use_layout.links), noise, request.key()
            earlier = result.get(key)
            merged = request if earlier is None else earlier.request.merged(request)
            users = (*(earlier.sensors if earlier is not None else ()), sensor.sensor)
            shift = sensor.radius_noise if noise else 0.0
            result[key] = Use(merged, tuple(dict.fromkeys(users)), use_layout.links, taxels, pos, noise, shift)
            order = keys.setdefault(name, [])
            if key not in order:
                order.append(key)
            of_sensor.setdefault(sensor.name, {})[name] = order.index(key)
    return Shared({name: [result[key] for key in use_keys] for name, use_keys in keys.items()}, of_sensor)


def _quantity_of(request: Request, quantities: Sequence[Quantity]) -> Quantity:
    result = next((quantity for quantity in quantities if quantity.request is type(request)), None)
    if result is None:
        hint = "give its kind the quantity, `Kind(quantities=(…,))`, or install the package that brings it"
        raise TgdslError(f'no known quantity answers the request "{type(request).__name__}"; {hint}')
    return result


def rows_of(sensor: LoweredSensor, joined: Joined) -> tuple[int, int]:
    """Return a sensor's rows in its uses: the first row, and one past the last."""
    group = joined.get(sensor.name, ())
    first_row = sum(len(other.taxels) for other in group[: group.index(sensor)]) if group else 0
    return first_row, first_row + (len(sensor.taxels) or sensor.rows.size)


class Numbered(NamedTuple):
    """Objects, bodies whose poses are read, and their pairs, in the order of the Plan and the state."""

    objects: tuple[PairedObject, ...]
    bodies: tuple[str, ...]
    table: PairTable[np.ndarray]


def number(
    pruned: Pruned, sensed: Mapping[str, SensedObject], uses: Mapping[str, Sequence[Use]], quantities: Sequence[Quantity]
) -> Numbered:
    """Return objects and bodies in their order, and the table of pairs."""
    names = sorted({pair.object for pair in pruned.pairs})
    body_of = {name: sensed[name].body for name in names}
    extra = {body for q in quantities for use in uses.get(q.name, ()) for body in q.bodies(use)}
    bodies = sorted({pair.link for pair in pruned.pairs} | set(body_of.values()) | extra)
    varied = [name for name in names if sensed[name].is_sized or len(sensed[name].variants) > 1]
    objects = []
    for name in names:
        pair_ids = [i for i, pair in enumerate(pruned.pairs) if pair.object == name]
        place = varied.index(name) if name in varied else -1
        counts = pair_ids[0], len(pair_ids), len(sensed[name].variants)
        objects.append(PairedObject(name, body_of[name], *counts, sensed[name].is_sized, place))
    gate = {pair: i for i, pair in enumerate(pruned.contact_pairs)}
    table = PairTable(
        link=np.array([bodies.index(pair.link) for pair in pruned.pairs], dtype=np.int64),
        object=np.array([bodies.index(body_of[pair.object]) for pair in pruned.pairs], dtype=np.int64),
        gate=np.array([gate.get(pair, 0) for pair in pruned.pairs], dtype=np.int64),
    )
    return Numbered(tuple(objects), tuple(bodies), table)
