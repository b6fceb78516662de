"""The passes from lowered sensors to packed arrays: prune, share, fold, pack.

`prune` drops pairs that can never meet, `share` lets sensors with the same probes, objects and gate share one query, `fold`
turns geom poses and inactive probes into constants, `pack` numbers bodies and pairs and writes the index tables.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from tgdsl.compiler.felt import FeltGeom, Settled
from tgdsl.compiler.robot import Model
from tgdsl.layout import Layout
from tgdsl.plan import Inputs, Pair, PlannedObject, PlannedQuery
from tgdsl.sensors.base import Lowered


@dataclass(frozen=True, eq=False)
class DraftSensor:
    """A lowered sensor: its taxels (rows of the layout), what it feels and how that is gated."""

    name: str
    kind: str
    taxels: np.ndarray
    feels: tuple[str, ...]
    is_gated: bool
    lowered: Lowered
    readings: tuple[str, ...]


@dataclass(eq=False)
class Draft:
    """All sensors, before anything is shared.

    Attributes:
        layout: Taxels of all sensors.
        sensors: The sensors.
        objects: Geoms of each object that some sensor feels.
        scene: The model that says what can collide.
        dropped: What is not needed, and why; the passes add to it.
        settled: How the distance to each geom is found; set once the sensors' ranges are known.
        pairs: The (link body, object) pairs that are needed, sorted by object and link; set by `prune`.
        gated: Those of them whose contacts are needed.
    """

    layout: Layout
    sensors: Sequence[DraftSensor]
    objects: dict[str, tuple[FeltGeom, ...]]
    scene: Model
    dropped: list[tuple[str, str]]
    settled: dict[str, tuple[Settled, ...]] = field(default_factory=dict)
    pairs: list[Pair] = field(default_factory=list)
    gated: list[Pair] = field(default_factory=list)

    def bodies_of(self, taxels: np.ndarray) -> list[str]:
        """Return the body of each taxel."""
        return [self.layout.links[i].body for i in self.layout.link_id[taxels]]


@dataclass(eq=False)
class DraftQuery:
    """A query and what is needed to pack it."""

    taxels: np.ndarray
    objects: tuple[str, ...]
    is_gated: bool
    needs: set[str]
    planned: PlannedQuery = field(init=False)


def prune(work: Draft) -> Iterator[tuple[str, str]]:
    """Set the pairs that are needed, and drop those that can never meet.

    Yields:
        Sensor and object of each wish that can never come true.
    """
    wanted: set[Pair] = set()
    gated: set[Pair] = set()
    never: set[Pair] = set()
    hopeless: list[tuple[str, str]] = []
    for sensor in work.sensors:
        bodies = set(work.bodies_of(sensor.taxels))
        for target in sensor.feels:
            pairs = {Pair(body, target) for body in bodies}
            if sensor.is_gated:
                apart = {p for p in pairs if not work.scene.can_meet(p.link, work.objects[target][0].geom.body)}
                gated |= pairs - apart
            else:
                apart = {p for p in pairs if p.link == work.objects[target][0].geom.body}
            wanted |= pairs - apart
            never |= apart
            if apart == pairs:
                hopeless.append((sensor.name, target))
    for pair in sorted(never - wanted, key=_order):
        work.dropped.append((f"pair {pair.link} – {pair.object}", "they can never be in contact"))
    work.pairs = sorted(wanted, key=_order)
    work.gated = sorted(gated, key=_order)
    yield from hopeless


def _order(pair: Pair) -> tuple[str, str]:
    return pair.object, pair.link


def share(work: Draft) -> tuple[list[DraftQuery], dict[str, int]]:
    """Return the distinct queries, and which of them each sensor uses."""
    queries: dict[tuple, DraftQuery] = {}
    query_of: dict[str, int] = {}
    for sensor in work.sensors:
        key = (sensor.taxels.tobytes(), sensor.feels, sensor.is_gated)
        query = queries.setdefault(key, DraftQuery(sensor.taxels, sensor.feels, sensor.is_gated, set()))
        query.needs |= sensor.lowered.needs
        query_of[sensor.name] = list(queries).index(key)
    return list(queries.values()), query_of


def margin(work: Draft, name: str) -> float:
    """Return the largest distance from an object's surface that any sensor asks for [m]."""
    reaches = [max(float(work.layout.radius[s.taxels].max()), s.lowered.range) for s in work.sensors if name in s.feels]
    return max(reaches)


def fold(work: Draft) -> dict[str, np.ndarray]:
    """Return the constant arrays of layout and objects."""
    layout = work.layout
    fields = ("link_id", "pos", "normal", "tangent", "radius", "area", "cell")
    arrays = {f"layout/{name}": getattr(layout, name) for name in fields}
    for name, geoms in work.objects.items():
        arrays[f"objects/{name}/size"] = np.stack([felt.geom.size for felt in geoms])
        arrays[f"objects/{name}/pos"] = np.stack([felt.geom.pos for felt in geoms])
        arrays[f"objects/{name}/rotation"] = np.stack([felt.geom.rotation.reshape(9) for felt in geoms])
        for i, settled in enumerate(work.settled[name]):
            arrays |= {f"objects/{name}/{i}/{key}": value for key, value in settled.arrays.items()}
    return arrays


def pack(work: Draft, queries: Sequence[DraftQuery], arrays: dict[str, np.ndarray]) -> tuple[tuple[PlannedObject, ...], Inputs]:
    """Number bodies, pairs and objects, and write the index tables of pairs and queries into the arrays."""
    names = sorted({pair.object for pair in work.pairs})
    body_of = {name: work.objects[name][0].geom.body for name in names}
    bodies = sorted({pair.link for pair in work.pairs} | set(body_of.values()))
    objects = tuple(_object(work, name) for name in names)
    gate = {pair: i for i, pair in enumerate(work.gated)}
    arrays["pairs/link"] = np.array([bodies.index(pair.link) for pair in work.pairs], dtype=np.int64)
    arrays["pairs/object"] = np.array([bodies.index(body_of[pair.object]) for pair in work.pairs], dtype=np.int64)
    arrays["pairs/gate"] = np.array([gate.get(pair, 0) for pair in work.pairs], dtype=np.int64)
    for i, query in enumerate(queries):
        _pack_query(work, query, names, i, arrays)
    needs = {need for query in queries for need in query.needs}
    fields = ["body_pos", "body_quat"]
    fields += ["body_linvel", "body_angvel"] if "motion" in needs else []
    fields += ["contact_found"] if work.gated else []
    inputs = Inputs(tuple(fields), tuple(bodies), tuple(work.gated), {p.object: body_of[p.object] for p in work.gated}, 0)
    return objects, inputs


def _object(work: Draft, name: str) -> PlannedObject:
    geoms = work.objects[name]
    own = [i for i, pair in enumerate(work.pairs) if pair.object == name]
    return PlannedObject(
        name=name,
        body=geoms[0].geom.body,
        shapes=tuple(settled.shape for settled in work.settled[name]),
        is_centred=tuple(bool(not f.geom.pos.any() and np.array_equal(f.geom.rotation, np.eye(3))) for f in geoms),
        first_pair=own[0],
        num_pairs=len(own),
        accuracy=tuple(dict(settled.accuracy) for settled in work.settled[name]),
    )


def _pack_query(work: Draft, query: DraftQuery, names: list[str], i: int, arrays: dict[str, np.ndarray]) -> None:
    felt = [name for name in query.objects if name in names]
    bodies = work.bodies_of(query.taxels)
    radius = work.layout.radius[query.taxels]
    reach = np.full((len(felt), len(bodies)), -np.inf)
    index = np.zeros((len(felt), len(bodies)), dtype=np.int64)
    allowed = set(work.gated if query.is_gated else work.pairs)
    for row, name in enumerate(felt):
        own = [pair for pair in work.pairs if pair.object == name]
        for column, body in enumerate(bodies):
            pair = Pair(body, name)
            if pair in allowed:
                index[row, column] = own.index(pair)
                reach[row, column] = radius[column] if radius[column] > 0 else -np.inf
    arrays[f"queries/{i}/taxels"] = query.taxels
    arrays[f"queries/{i}/pos"] = work.layout.pos[query.taxels].T
    arrays[f"queries/{i}/reach"] = reach
    arrays[f"queries/{i}/pair"] = index
    query.planned = PlannedQuery(
        objects=tuple(names.index(name) for name in felt),
        is_gated=query.is_gated,
        needs=tuple(sorted(query.needs)),
        num_taxels=len(bodies),
    )
