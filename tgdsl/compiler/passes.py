"""The passes from lowered sensors to packed arrays: prune, share, fold, pack.

`prune` drops pairs that can never meet, `join` has sensors of one kind on different taxels computed as one, `share` lets
sensors with the same probes share one query, and those with the same objects and gate one answer, `fold` turns geom poses and
inactive probes into constants, `pack` numbers bodies and pairs and writes the index tables.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tgdsl.compiler.felt import FeltBody, Settled
from tgdsl.formats.model import Model
from tgdsl.layout.layout import Layout
from tgdsl.plan.plan import SLOT_FIELDS, ContactPart, Inputs, Pair, PlannedAnswer, PlannedObject, PlannedQuery
from tgdsl.quantities.contact_depth.geom_tables import accuracy, geom_tables, is_centred, placed_geoms
from tgdsl.quantities.moments.tables import MomentTables, pack_moments
from tgdsl.quantities.points.tables import Skin, pack_points, skin_rows
from tgdsl.sensors.base import Lowered, MomentsRequest, PointsRequest, ProbeSpec
from tgdsl.sensors.noise.lower import LoweredNoise


@dataclass(eq=False)
class DraftSensor:
    """One way to read a sensor, lowered.

    Attributes:
        name: Its name, see `plan.PlannedSensor`.
        kind: Its kind.
        spec: The sensor's spec.
        taxels: Its taxels, rows of the layout.
        lowered: What its kind says of it.
        folder: Where its constants are.
        is_pointwise: Whether each row of what it reads is of one taxel alone.
        joined: The sensors that are computed as one, itself among them; set by `join`, and empty if it is alone.
        readings: Names of its readings, reports left out.
        noise: Its imperfections.
    """

    name: str
    kind: str
    spec: ProbeSpec
    taxels: np.ndarray
    lowered: Lowered
    folder: str
    readings: tuple[str, ...]
    noise: LoweredNoise | None
    is_pointwise: bool = False
    joined: tuple[DraftSensor, ...] = field(default=())

    @property
    def probes(self) -> np.ndarray:
        """Taxels of its query: its own, or those of all that are joined, one sensor after the other."""
        return np.concatenate([sensor.taxels for sensor in self.joined or (self,)])

    @property
    def sensor(self) -> str:
        """The sensor's name in the document."""
        return self.name.removesuffix("/clean")

    @property
    def feels(self) -> tuple[str, ...]:
        """What it feels."""
        return self.spec.feels

    @property
    def is_gated(self) -> bool:
        """Whether an object is felt only in contact."""
        return self.spec.is_gated

    @property
    def radius_noise(self) -> float:
        """Largest disturbance of a radius [m]."""
        return 0.0 if self.noise is None else self.noise.radius


@dataclass(eq=False)
class Draft:
    """All sensors, before anything is shared.

    Attributes:
        layout: Taxels of all sensors.
        sensors: The sensors.
        objects: What is felt of each object that some sensor feels.
        scene: The model that says what can collide.
        dropped: What is not needed, and why; the passes add to it.
        settled: How the distance to each geom of each variant is found, of the objects that some sensor measures; set once the
            sensors' ranges are known.
        pairs: The (link body, object) pairs that are needed, sorted by object and link; set by `prune`.
        gated: Those of them whose contacts are needed.
        moments: The moments of each object, for each way in which some sensor wants them found; set like `settled`.
        clouds: The points of each object, by their number; set like `settled`, as the next.
        skins: The own geoms of each link that points may meet, by its name.
        contacts_of: The geoms that the contacts of `gated` act on, by object.
    """

    layout: Layout
    sensors: Sequence[DraftSensor]
    objects: dict[str, FeltBody]
    scene: Model
    dropped: list[tuple[str, str]]
    settled: dict[str, tuple[tuple[Settled, ...], ...]] = field(default_factory=dict)
    pairs: list[Pair] = field(default_factory=list)
    gated: list[Pair] = field(default_factory=list)
    moments: dict[tuple[MomentsRequest, str], MomentTables] = field(default_factory=dict)
    clouds: dict[tuple[int, str], dict[str, np.ndarray]] = field(default_factory=dict)
    skins: dict[str, Skin] = field(default_factory=dict)
    contacts_of: dict[str, tuple[ContactPart, ...]] = field(default_factory=dict)

    def bodies_of(self, taxels: np.ndarray) -> list[str]:
        """Return the body of each taxel."""
        return [self.layout.links[i].body for i in self.layout.link_id[taxels]]


@dataclass(eq=False)
class DraftAnswer:
    """What some sensors feel of a query.

    Attributes:
        objects: Names of the objects.
        is_gated: Whether they are felt only in contact.
        radius: How far from each taxel [m]; −∞ for inactive ones.
        request: How moments are found, if they are.
        points: Which points of objects are wanted, if any.
        radius_noise: The sensor whose noise disturbs the radii, if any.
        needs: What else they need.
    """

    objects: tuple[str, ...]
    is_gated: bool
    radius: np.ndarray
    request: MomentsRequest | None = None
    points: PointsRequest | None = None
    radius_noise: str = ""
    needs: set[str] = field(default_factory=set)


@dataclass(eq=False)
class DraftQuery:
    """A query, its answers, and what is planned of it."""

    taxels: np.ndarray
    answers: list[DraftAnswer] = field(default_factory=list)
    planned: PlannedQuery = field(init=False)


def prune(work: Draft) -> list[tuple[str, str]]:
    """Set the pairs that are needed, drop those that can never meet; return sensors that can never feel an object of theirs."""
    wanted: set[Pair] = set()
    gated: set[Pair] = set()
    never: set[Pair] = set()
    hopeless: list[tuple[str, str]] = []
    for sensor in work.sensors:
        bodies = set(work.bodies_of(sensor.taxels))
        for target in sensor.feels:
            pairs, felt = {Pair(body, target) for body in bodies}, work.objects[target]
            meeting = {p for p in pairs if work.scene.can_collide_with(p.link, felt.touched)}
            if sensor.is_gated or "contacts" in sensor.lowered.needs:
                gated |= meeting
            itself = {p for p in pairs if work.scene.compiled.body(p.link).id in felt.bodies}
            apart = pairs - meeting if sensor.is_gated else itself
            wanted |= pairs - apart
            never |= apart
            if apart == pairs:
                hopeless.append((sensor.sensor, target))
    for pair in sorted(never - wanted, key=_order):
        work.dropped.append((f"pair {pair.link} – {pair.object}", "they can never be in contact"))
    work.pairs = sorted(wanted, key=_order)
    work.gated = sorted(gated, key=_order)
    return hopeless


def _order(pair: Pair) -> tuple[str, str]:
    return pair.object, pair.link


def join(work: Draft) -> None:
    """Set which sensors are computed as one: those of one kind on different taxels, such as one on each finger.

    Their parameters may differ. No probe is measured twice for it: of sensors that measure at the same taxels all are joined
    with sensors on the same other taxels, or none is.
    """
    alike: dict[Hashable, list[DraftSensor]] = {}
    for sensor in work.sensors:
        alike.setdefault(_equation(work, sensor) or sensor.name, []).append(sensor)
    partners: dict[bytes, set[bytes]] = {}
    for sensors in alike.values():
        for sensor in sensors:
            if _is_measuring(reach_of(work, sensor), sensor.lowered.needs):
                partners.setdefault(sensor.taxels.tobytes(), set()).add(b"".join(s.taxels.tobytes() for s in sensors))
    for sensors in alike.values():
        rows = np.concatenate([sensor.taxels for sensor in sensors])
        is_apart = len(np.unique(rows)) == len(rows)
        if len(sensors) > 1 and is_apart and all(len(partners[sensor.taxels.tobytes()]) == 1 for sensor in sensors):
            for sensor in sensors:
                sensor.joined = tuple(sensors)


def _equation(work: Draft, sensor: DraftSensor) -> Hashable | None:
    """Return what sensors that can be computed as one have in common; None of one that never can."""
    lowered = sensor.lowered
    has_own = lowered.state or lowered.reports or sensor.radius_noise or any(c.ndim for c in lowered.constants.values())
    if not sensor.is_pointwise or has_own or not _is_measuring(reach_of(work, sensor), lowered.needs):
        return None
    constants, is_clean = tuple(sorted(lowered.constants)), sensor.name != sensor.sensor
    return sensor.kind, is_clean, sensor.feels, sensor.is_gated, lowered.needs, lowered.channels, constants


def share(work: Draft) -> tuple[list[DraftQuery], dict[str, tuple[int, int]]]:
    """Return the distinct queries, and which of them, and which answer of it, each sensor uses."""
    queries: dict[bytes, DraftQuery] = {}
    answers: dict[tuple[Hashable, ...], DraftAnswer] = {}
    answer_of: dict[str, tuple[int, int]] = {}
    for sensor in work.sensors:
        probes = sensor.probes.tobytes()
        radius = np.concatenate([reach_of(work, other) for other in sensor.joined or (sensor,)])
        wanted = sensor.lowered.moments, sensor.lowered.points, sensor.name if sensor.radius_noise > 0 else ""
        query = queries.setdefault(probes, DraftQuery(sensor.probes))
        key = probes, sensor.feels, sensor.is_gated, radius.tobytes(), *wanted
        if key not in answers:
            answers[key] = DraftAnswer(sensor.feels, sensor.is_gated, radius, *wanted)
            query.answers.append(answers[key])
        answers[key].needs.update(sensor.lowered.needs)
        answer_of[sensor.name] = list(queries).index(probes), query.answers.index(answers[key])
    return list(queries.values()), answer_of


def is_counted(work: Draft, name: str, felt: Sequence[str]) -> bool:
    """Return whether the contacts with an object are among those with another one that is felt too.

    Objects may be made of the same body, whose force is one. Of two that share all contacts the first one counts.
    """
    own, before = work.objects[name].touched, list(felt).index(name)
    others = [work.objects[other].touched for other in felt]
    return any(own < other or (own == other and i < before) for i, other in enumerate(others) if own)


def reach_of(work: Draft, sensor: DraftSensor) -> np.ndarray:
    """Return how far from each taxel a sensor feels objects [m]; −∞ for inactive probes."""
    radius = work.layout.radius[sensor.taxels]
    return np.where(radius > 0, radius if sensor.lowered.radius is None else sensor.lowered.radius, -np.inf)


def margin(work: Draft, name: str) -> float | None:
    """Return the largest distance from an object's surface that any sensor asks for [m]; None if no sensor measures it."""
    users = [s for s in work.sensors if name in s.feels and _is_measuring(reach_of(work, s), s.lowered.needs)]
    return max((max(float(reach_of(work, s).max()), s.lowered.range) + s.radius_noise for s in users), default=None)


def _is_measuring(radius: np.ndarray, needs: Collection[str]) -> bool:
    """Return whether a sensor wants distances: one that reads contacts alone lets no probe reach anywhere.

    Nor does one that reads moments, unless it says what it wants of the nearest surface.
    """
    if "moments" in needs and not {"normal", "distance", "frame"} & set(needs):
        return False
    return bool((radius > -np.inf).any()) or "distance" in needs


def fold(work: Draft) -> dict[str, np.ndarray]:
    """Return the constant arrays of layout and objects."""
    layout = work.layout
    fields = ("link_id", "pos", "normal", "tangent", "radius", "area", "cell")
    arrays = {f"layout/{name}": getattr(layout, name) for name in fields}
    for name in work.objects:
        if name not in work.settled:
            continue  # nobody measures the distance to it
        arrays |= geom_tables(f"objects/{name}", placed_geoms(work.objects[name].variants, work.settled[name])[1])
    if work.skins:
        arrays |= geom_tables("links", skin_rows(work.skins)[1])
    for (num, name), cloud in work.clouds.items():
        arrays |= {f"objects/{name}/points/{num}/{key}": value for key, value in cloud.items()}
    return arrays


def pack(work: Draft, queries: Sequence[DraftQuery], arrays: dict[str, np.ndarray]) -> tuple[tuple[PlannedObject, ...], Inputs]:
    """Number bodies, pairs and objects, and write the index tables of pairs and queries into the arrays."""
    names = sorted({pair.object for pair in work.pairs})
    body_of = {name: work.objects[name].body for name in names}
    bodies = sorted({pair.link for pair in work.pairs} | set(body_of.values()))
    objects = tuple(_object(work, name) for name in names)
    gate = {pair: i for i, pair in enumerate(work.gated)}
    arrays["pairs/link"] = np.array([bodies.index(pair.link) for pair in work.pairs], dtype=np.int64)
    arrays["pairs/object"] = np.array([bodies.index(body_of[pair.object]) for pair in work.pairs], dtype=np.int64)
    arrays["pairs/gate"] = np.array([gate.get(pair, 0) for pair in work.pairs], dtype=np.int64)
    for i, query in enumerate(queries):
        _pack_query(work, query, names, i, arrays)
        if any("contacts" in answer.needs for answer in query.answers):
            own = work.layout.take(query.taxels).bodies  # one that touches nothing has no pose in the state, and no contacts
            arrays[f"queries/{i}/bodies"] = np.array([bodies.index(body) if body in bodies else 0 for body in own])
    answers = [answer for query in queries for answer in query.answers]
    needs = {need for answer in answers for need in answer.needs}
    slots = max(sensor.lowered.slots for sensor in work.sensors)
    varied = [target for target in objects if target.is_sized or target.num_variants > 1]
    fields = ["body_pos", "body_quat"]
    fields += ["body_linvel", "body_angvel"] if "motion" in needs else []
    fields += ["contact_found"] if slots or any(answer.is_gated for answer in answers) else []
    fields += SLOT_FIELDS if slots else []
    fields += ["contact_netforce"] if slots or "contacts" in needs else []
    fields += ["variant"] if any(target.num_variants > 1 for target in varied) else []
    fields += ["object_size"] if any(target.is_sized for target in varied) else []
    fields += ["dt"] if any(_is_timed(sensor) for sensor in work.sensors) else []
    inputs = Inputs(
        fields=tuple(fields),
        bodies=tuple(bodies),
        pairs=tuple(work.gated),
        bodies_of={pair.object: body_of[pair.object] for pair in work.gated},
        slots=slots,
        objects=tuple(target.name for target in varied),
        num_variants=tuple(target.num_variants for target in varied),
        contacts_of={n: parts for n, parts in work.contacts_of.items() if parts != (ContactPart("body", body_of[n]),)},
    )
    return objects, inputs


def _is_timed(sensor: DraftSensor) -> bool:
    """Return whether a sensor wants to know how much time has passed."""
    terms = () if sensor.noise is None else sensor.noise.terms
    return sensor.spec.rate is not None or "hysteresis" in terms or "delay" in terms


def _object(work: Draft, name: str) -> PlannedObject:
    num_variants = len(work.objects[name].variants)
    shapes, rows = (), [[]] * num_variants
    if name in work.settled:
        shapes, rows = placed_geoms(work.objects[name].variants, work.settled[name])
    own = [i for i, pair in enumerate(work.pairs) if pair.object == name]
    return PlannedObject(
        name=name,
        body=work.objects[name].body,
        shapes=shapes,
        is_centred=is_centred(rows),
        first_pair=own[0],
        num_pairs=len(own),
        accuracy=accuracy(rows),
        is_sized=work.objects[name].is_sized,
    )


def _pack_query(work: Draft, query: DraftQuery, names: list[str], i: int, arrays: dict[str, np.ndarray]) -> None:
    measuring = [answer for answer in query.answers if _is_measuring(answer.radius, answer.needs)]
    felt = [name for name in dict.fromkeys(name for answer in measuring for name in answer.objects) if name in names]
    bodies = work.bodies_of(query.taxels)
    of_object = {name: [pair for pair in work.pairs if pair.object == name] for name in felt}
    pairs = {name: [Pair(body, name) for body in bodies] for name in felt}
    index = [[of_object[name].index(pair) if pair in of_object[name] else 0 for pair in pairs[name]] for name in felt]
    arrays[f"queries/{i}/taxels"] = query.taxels
    arrays[f"queries/{i}/pos"] = work.layout.pos[query.taxels].T
    arrays[f"queries/{i}/pair"] = np.array(index, dtype=np.int64).reshape(len(felt), len(bodies))
    answers = []
    for a, answer in enumerate(query.answers):
        reachable = [name for name in answer.objects if name in names]
        chosen = reachable if answer in measuring else []
        allowed = set(work.gated if answer.is_gated else work.pairs)
        can_meet = np.array([[pair in allowed for pair in pairs[name]] for name in chosen], dtype=bool)
        arrays[f"queries/{i}/{a}/reach"] = np.where(can_meet.reshape(len(chosen), len(bodies)), answer.radius, -np.inf)
        if "contacts" in answer.needs:
            counted = [name for name in reachable if not is_counted(work, name, answer.objects)]
            places = [[Pair(body, name) for name in counted] for body in dict.fromkeys(bodies)]
            table = [[work.gated.index(p) if p in work.gated else len(work.gated) for p in row] for row in places]
            arrays[f"queries/{i}/{a}/contacts"] = np.array(table, dtype=np.int64)
        moments = None
        if answer.request is not None:
            path, request = f"queries/{i}/{a}/moments", answer.request
            moments = pack_moments(request, reachable, answer.radius, bodies, work.pairs, names, work.moments, path, arrays)
        points = None
        if answer.points is not None:
            path, layout = f"queries/{i}/{a}/points", work.layout.take(query.taxels)
            points = pack_points(answer.points, reachable, layout, work.pairs, allowed, names, list(work.skins), path, arrays)
        chosen_ids = tuple(felt.index(name) for name in chosen)
        needs = tuple(sorted(answer.needs))
        answers.append(PlannedAnswer(chosen_ids, answer.is_gated, needs, moments, points, answer.radius_noise))
    query.planned = PlannedQuery(tuple(names.index(name) for name in felt), len(bodies), tuple(answers))
