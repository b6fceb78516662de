"""The Plan: what to compute, with nothing left to decide. Plain values and NumPy arrays; the same input gives the same Plan.

It knows no text, no robot file and no simulator. Its arrays are float64 or int64 (grids float32) and named by path:

| array | shape | holds |
|---|---|---|
| `layout/{link_id,pos,normal,tangent,radius,area,cell}` | (taxel, …) | the taxels that some sensor has, see `layout.Layout` |
| `pairs/{link,object}` | (pair,) | body indices of each pair's link and object |
| `pairs/gate` | (pair,) | index of each pair among `inputs.pairs`; 0 where no query asks |
| `objects/<name>/{size,pos,rotation}` | (variant, geom, 3 or 9) | geoms in the object's body frame |
| `objects/<name>/is_absent` | (variant, geom) | 1 where a variant lacks a geom; only if the object has variants |
| `objects/<name>/<geom>/values` | (node,) | its baked grids, float32, see `geometry.grid.Grid` |
| `objects/<name>/<geom>/{first,num,origin,cell}` | (variant,), (variant, 3) ×2, (variant,) | where each variant's is |
| `objects/<name>/<geom>/<variant>/{vertices,faces}` | (v, 3), (f, 3) | triangles of a geom queried by raycast |
| `objects/<name>/<geom>/max_distance` | () | how far that query looks |
| `queries/<i>/{taxels,pos,pair}` | (taxel,), (3, taxel), (object, taxel) | probes, see `quantities.contact_depth.query.Probes` |
| `queries/<i>/bodies` | (body,) | body indices of the links that carry its probes, if contacts are wanted |
| `queries/<i>/<answer>/reach` | (object, taxel) | what an answer feels, see `query.feel` |
| `queries/<i>/<answer>/contacts` | (body, object) | whose contacts: indices into `inputs.pairs`, or their number for none |
| `queries/<i>/<answer>/moments/{pair,reach,radius_id}` | (object, taxel) | whose moments, see `quantities.moments.nearby.MomentSource` |
| `objects/<name>/moments/<request>/area` | (variant,) | area of its outer surface, planes left out |
| `objects/<name>/moments/<request>/{plane_pos,plane_rotation}` | (plane, 3 or 9) | its planes in its body's frame |
| `objects/<name>/moments/<request>/values` | (node, 4) | its fields, float32, see `quantities.moments.moments.MomentField` |
| `objects/<name>/moments/<request>/{first,num,origin,cell}` | (table, …) | where each is, by variant and radius |
| `objects/<name>/moments/<request>/{points,weight,lists}` | (3, row), (variant,), (bin, slot) | its points instead |
| `objects/<name>/points/<number>/{points,area}` | (3, variant, point), (variant,) | its points, by their number |
| `links/…` | (link, …) | the geoms of links that points may meet, as those of an object: a variant is a link |
| `queries/<i>/<answer>/points/<object>/{pair,link}` | (link,) | who meets it, see `quantities.points.points` |
| `sensors/<name>/<constant>` | | what the kind's `lower` folded |
| `sensors/<name>/noise/<knob>` | ([end,] channel, row) | values of its noise, see `sensors.noise.lower` |
| `observations/<group>/<i>/<constant>` | | what the observation's `lower` folded |
| `observations/<group>/<i>/rows` | (row,) | rows of a reading of joints or actuators that are observed, if not all |
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from tgdsl.console.tables import listing, spelled
from tgdsl.errors import ArtifactError
from tgdsl.layout.layout import Layout, Link

FORMAT = 10
"""Version of the Plan; a reader refuses any other."""


SLOT_FIELDS = ("contact_pos", "contact_force", "contact_torque", "contact_normal")
"""Fields of the state that are read contact by contact."""


@dataclass(frozen=True)
class Pair:
    """A link's body and an object that its taxels may feel."""

    link: str
    object: str


@dataclass(frozen=True)
class ContactPart:
    """Geoms whose contacts are an object's: those of a body, those of a body and of all bodies below it, or a single one."""

    kind: Literal["body", "subtree", "geom"]
    name: str


@dataclass(frozen=True)
class Inputs:
    """What a module wants of a scene, and in which order.

    Attributes:
        fields: Fields of `SceneState` that are read.
        bodies: Bodies whose poses (and velocities) are read.
        pairs: Pairs whose contacts are read.
        bodies_of: Body of each object named in `pairs`.
        slots: Contacts per pair of the slotted contact fields; 0 if none is read.
        objects: Objects that differ between environments: those of the fields `variant` and `object_size`.
        num_variants: How many variants each of these objects has; 1 if only its size differs.
        joints: Joints of the fields `joint_pos`, `joint_vel` and `joint_effort`: hinges and slides.
        actuators: Actuators of the field `last_action`.
        contacts_of: Whose contacts are an object's, where they are not just those of its body: see `parts_of`.
    """

    fields: tuple[str, ...]
    bodies: tuple[str, ...]
    pairs: tuple[Pair, ...]
    bodies_of: Mapping[str, str]
    slots: int
    objects: tuple[str, ...] = ()
    num_variants: tuple[int, ...] = ()
    joints: tuple[str, ...] = ()
    actuators: tuple[str, ...] = ()
    contacts_of: Mapping[str, tuple[ContactPart, ...]] = dataclasses.field(default_factory=dict)

    def parts_of(self, name: str) -> tuple[ContactPart, ...]:
        """Return the geoms whose contacts are an object's; no geom is in two of its parts."""
        return self.contacts_of.get(name) or (ContactPart("body", self.bodies_of[name]),)

    def __repr__(self) -> str:
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return "Inputs\n" + listing((name, spelled(value)) for name, value in values.items() if value)


@dataclass(frozen=True)
class PlannedObject:
    """An object that is felt.

    A geom stands for the geoms of one type that the variants have in its place; a variant may lack it.

    Attributes:
        name: Its name.
        body: Its body.
        shapes: How the distance to each of its geoms is found.
        is_centred: Which of them share the body's frame.
        first_pair: Index of its first pair.
        num_pairs: Number of its pairs.
        accuracy: What was measured of each variant's geoms: see `contact_depth.bake.Errors`; empty where exact.
        is_sized: Whether its size is part of the state.
    """

    name: str
    body: str
    shapes: tuple[str, ...]
    is_centred: tuple[bool, ...]
    first_pair: int
    num_pairs: int
    accuracy: tuple[tuple[Mapping[str, float], ...], ...]
    is_sized: bool

    @property
    def num_variants(self) -> int:
        """Number of its variants; 1 if it is the same in all environments."""
        return len(self.accuracy)


@dataclass(frozen=True)
class PlannedMoments:
    """Moments of objects' surfaces.

    Attributes:
        request: Number of the way in which they are found: a folder of the objects' arrays.
        backend: How: "field" or "points".
        objects: Indices of the objects.
        radii: For each object the radii that it has fields of [m].
        accuracy: For each object what was measured of each field, variant after variant: see `moments.fields.FieldErrors`.
        is_smooth: Whether fields are sums of quadratic B-splines: see `quantities.moments.moments.MomentField`.
    """

    request: int
    backend: Literal["field", "points"]
    objects: tuple[int, ...]
    radii: tuple[tuple[float, ...], ...]
    accuracy: tuple[tuple[Mapping[str, float], ...], ...]
    is_smooth: bool = False


@dataclass(frozen=True)
class PlannedPoints:
    """Points of objects that links may meet.

    Attributes:
        num_points: Points of each object.
        objects: Indices of the objects.
        links: For each object the links that may meet it: indices into `PlannedSkin.links`.
        taxels: For each object and link the first of its taxels among the query's, and one beyond the last.
    """

    num_points: int
    objects: tuple[int, ...]
    links: tuple[tuple[int, ...], ...]
    taxels: tuple[tuple[tuple[int, int], ...], ...]


@dataclass(frozen=True)
class PlannedSkin:
    """The links' own surfaces that points are measured against: like an object that has a variant for each link.

    Attributes:
        links: Names of the links.
        shapes: How the distance to each geom is found.
        is_centred: Which of them share the bodies' frames.
        accuracy: What was measured of each link's geoms: see `PlannedObject`.
    """

    links: tuple[str, ...]
    shapes: tuple[str, ...]
    is_centred: tuple[bool, ...]
    accuracy: tuple[tuple[Mapping[str, float], ...], ...]


@dataclass(frozen=True)
class PlannedAnswer:
    """What some sensors feel of a query: which of its objects, whether they are gated, and what is wanted of them.

    The probes' radii are disturbed by the noise of the sensor named in `radius_noise`, if any.
    """

    objects: tuple[int, ...]
    is_gated: bool
    needs: tuple[str, ...]
    moments: PlannedMoments | None = None
    points: PlannedPoints | None = None
    radius_noise: str = ""


@dataclass(frozen=True)
class PlannedQuery:
    """One geometry query, shared by all sensors with the same probes, and the answers that are made of it."""

    objects: tuple[int, ...]
    num_taxels: int
    answers: tuple[PlannedAnswer, ...]


@dataclass(frozen=True)
class PlannedReading:
    """One entry of a module's readings: its name, what it has rows of, name and unit of each channel.

    `steps` calls are stacked in it, oldest first; 0: it is of one call and has no such dimension.
    """

    name: str
    rows: Literal["taxel", "body", "joint", "actuator"]
    num_rows: int
    channels: tuple[str, ...]
    units: tuple[str, ...]
    steps: int = 0


@dataclass(frozen=True)
class PlannedMemory:
    """What a sensor carries from one call to the next: its value at rest, and its shape after the leading `env`.

    With `past` it is a ring of what was so at each call of so many seconds before the present one, (env, call, *shape).
    """

    rest: float
    shape: tuple[int, ...]
    past: float = 0.0


@dataclass(frozen=True)
class PlannedNoise:
    """The imperfections of a sensor.

    Attributes:
        terms: The stages there are, in their order, see `sensors.noise.stages`.
        constants: Names of the values that they read.
        streams: What random numbers are drawn for, see `sensors.noise.random`.
    """

    terms: tuple[str, ...]
    constants: tuple[str, ...]
    streams: tuple[int, ...]


@dataclass(frozen=True)
class PlannedHistory:
    """How many calls a reading holds or is made of, how, and whether a stack of them is handed out as a view of the memory."""

    length: int
    reduce: Literal["stack", "last", "median", "mean"]
    view: bool = False


@dataclass(frozen=True)
class PlannedSensor:
    """One way to read a sensor: what is computed for it alone.

    A sensor that is read both clean and measured is computed once where noise comes after its equation, else twice.

    Attributes:
        name: Its name, `touch`, or `touch/clean` where another one is the measured sensor.
        sensor: The sensor's name in the document.
        kind: Its kind.
        query: Number of its query.
        answer: Which of that one's answers.
        joined: The sensors that are computed as one, in the order of the answer's rows; empty if it is alone.
        rows: Which of the answer's rows are its own: the first, and one beyond the last.
        folder: Where its constants are.
        constants: Their names.
        state: What it carries from one call to the next: the kind's own, `noise/…` and `sample/…`.
        signal: Channels of the signal that noise and sampling act on.
        readings: Its readings: first its own, measured if it has noise; then the clean one, if that is read too; then reports.
        noise: Its imperfections.
        period: Time between its samples [s]; 0: it takes one at every call.
        history: What is read of the last calls.
        notes: What an account of it says of its parameters, line by line.
    """

    name: str
    sensor: str
    kind: str
    query: int
    answer: int
    joined: tuple[str, ...]
    rows: tuple[int, int]
    folder: str
    constants: tuple[str, ...]
    state: Mapping[str, PlannedMemory]
    signal: tuple[str, ...]
    readings: tuple[PlannedReading, ...]
    noise: PlannedNoise | None = None
    period: float = 0.0
    history: PlannedHistory | None = None
    notes: tuple[str, ...] = ()

    @property
    def is_timed(self) -> bool:
        """Whether it wants to know when a reading is made: for chance, for what its noise remembers, or for its own rate."""
        return bool(self.noise and self.noise.streams) or any("/" in name for name in self.state)

    @property
    def own_readings(self) -> tuple[PlannedReading, ...]:
        """Its readings without reports: the measured one, the clean one, or both."""
        return tuple(reading for reading in self.readings if reading.name in (self.name, f"{self.name}/clean"))

    @property
    def windows(self) -> tuple[PlannedReading, ...]:
        """Those of its readings whose last calls are remembered."""
        return () if self.history is None or self.history.reduce == "last" else self.own_readings


@dataclass(frozen=True)
class PlannedObservation:
    """One term of an observation group.

    Attributes:
        group: The group.
        index: Which of its terms.
        type: Its type.
        reading: The reading that is observed; None if it is of none.
        channels: Channels of the reading.
        constants: Names of what was folded for it.
        num_features: How many features it gives.
        axes: Order of the link-frame axes of an aggregate force; else empty.
    """

    group: str
    index: int
    type: str
    reading: str | None
    channels: tuple[int, ...]
    constants: tuple[str, ...]
    num_features: int
    axes: Literal["", "xyz", "zyx"] = ""


@dataclass(frozen=True)
class Asset:
    """A file that the scene needs: its name in the MJCF, where it was found, and what it held."""

    key: str
    path: str
    sha256: str


@dataclass(frozen=True)
class SceneGeom:
    """A geom that an object has in some environments.

    Attributes:
        size: Its size as MuJoCo defines it [m]; nothing for a mesh.
        pos: Its frame's origin in the body's frame [m].
        quat: Its orientation there, w, x, y, z.
        density: Its density [kg/m³].
        mesh: Key of its mesh's asset, or nothing.
        scale: Factor from the mesh file's unit to metres.
    """

    size: tuple[float, ...]
    pos: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    density: float
    mesh: str
    scale: float


@dataclass(frozen=True)
class SceneObject:
    """An object whose geometry differs between environments.

    Attributes:
        name: Its name in the document.
        body: Its body in the scene.
        types: MuJoCo's types of the geoms that it has instead of the scene's own; none if only its size differs.
        variants: Which of these geoms each variant has, and how; None where it lacks one.
        is_sized: Whether the size of its geom is chosen per environment.
        others: Bodies that are other objects: they keep their geoms where they are welded to its body.
    """

    name: str
    body: str
    types: tuple[str, ...]
    variants: tuple[tuple[SceneGeom | None, ...], ...]
    is_sized: bool
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class SceneFile:
    """The instrumented scene, as text, for whoever simulates it.

    Attributes:
        mjcf: The scene as MJCF, with the contact sensors that the module wants.
        parts: The MJCF files that it includes or attaches, by the names it has for them.
        assets: The meshes, textures and other files that they or the objects name.
        objects: Objects that differ between environments.
    """

    mjcf: str
    parts: Mapping[str, str]
    assets: tuple[Asset, ...]
    objects: tuple[SceneObject, ...] = ()


@dataclass(frozen=True)
class Origin:
    """What a plan was made from."""

    document_sha256: str
    robot: str
    robot_sha256: str
    resolution: str
    versions: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Plan:
    """All a module is built from.

    Attributes:
        origin: What it was made from.
        inputs: What it reads.
        links: Links that carry taxels.
        groups: Links of each link group.
        objects: What taxels feel.
        skin: The links' own surfaces, if points of objects are measured against them.
        queries: Geometry queries.
        sensors: Sensors, in the document's order.
        proprioception: Readings of joints and actuators, which are fields of the state, handed out by the same names.
        observations: Observation terms, in the document's order.
        dropped: What the scene or the document has and the module does not need, and why.
        arrays: Constants by path.
        scene: The instrumented scene.
    """

    origin: Origin
    inputs: Inputs
    links: tuple[Link, ...]
    groups: Mapping[str, tuple[str, ...]]
    objects: tuple[PlannedObject, ...]
    skin: PlannedSkin | None
    queries: tuple[PlannedQuery, ...]
    sensors: tuple[PlannedSensor, ...]
    proprioception: tuple[PlannedReading, ...]
    observations: tuple[PlannedObservation, ...]
    dropped: tuple[tuple[str, str], ...]
    arrays: Mapping[str, np.ndarray]
    scene: SceneFile

    def layout(self) -> Layout:
        """Return the taxels of all sensors."""
        fields = ("link_id", "pos", "normal", "tangent", "radius", "area", "cell")
        return Layout(self.links, self.groups, **{name: self.arrays[f"layout/{name}"] for name in fields})

    def layout_of(self, sensor: PlannedSensor) -> Layout:
        """Return the taxels of one sensor."""
        return self.layout().take(self.arrays[f"queries/{sensor.query}/taxels"][slice(*sensor.rows)])

    def readings(self) -> dict[str, PlannedReading]:
        """Return all readings by name, in the order in which they are handed out."""
        own = {reading.name: reading for sensor in self.sensors for reading in sensor.readings}
        return own | {reading.name: reading for reading in self.proprioception}

    def sensor_of(self, reading: str) -> PlannedSensor:
        """Return the sensor that makes a reading."""
        return next(sensor for sensor in self.sensors if reading in [own.name for own in sensor.readings])

    def to_json(self) -> str:
        """Return everything but the arrays, of which only a hash, with sorted keys."""
        plain: dict[str, Any] = {
            field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self) if field.name != "arrays"
        }
        plain |= {"format": FORMAT, "arrays": _digest(self.arrays)}
        return json.dumps(plain, sort_keys=True, ensure_ascii=False, separators=(",", ":"))

    @staticmethod
    def from_json(text: str, arrays: Mapping[str, np.ndarray]) -> Plan:
        """Return the plan that `to_json` wrote.

        Raises:
            ArtifactError: If the text is not a plan of this version, or the arrays are not its own.
        """
        try:
            plain = json.loads(text)
            version = plain.pop("format", None)
            if version != FORMAT:
                raise ArtifactError(f"plan format {version} is not {FORMAT}, which this version of tgdsl reads; compile again")
            if plain.pop("arrays", None) != _digest(arrays):
                raise ArtifactError("the arrays are not those that the plan was written with")
            types = _field_types()
            if plain.keys() != types.keys():
                raise ArtifactError(f"a plan has the parts {sorted(types)}, found {sorted(plain)}")
            values = {name: TypeAdapter(kind).validate_python(plain[name]) for name, kind in types.items()}
        except (ValidationError, ValueError, TypeError, AttributeError) as error:
            raise ArtifactError(f"not a plan: {error}") from error
        return Plan(**values, arrays=arrays)


def _field_types() -> dict[str, Any]:
    hints = get_type_hints(Plan)
    return {field.name: hints[field.name] for field in dataclasses.fields(Plan) if field.name != "arrays"}


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return a hash of names, dtypes, shapes and contents."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape} ".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(part) for part in value]
    return value


def contact_sensor_names(pair: Pair, part: int = 0) -> tuple[str, str]:
    """Return the names of the contact sensors of a pair and a part of its object: the point slots, and the net force."""
    end = f"{pair.link}/{pair.object}" + (f"/{part}" if part else "")
    return f"tgdsl/contact/{end}", f"tgdsl/netforce/{end}"
