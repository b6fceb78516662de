"""What a quantity is: something that kinds of sensors ask of a scene, found once for all that ask alike.

A quantity is one file: the typed request that a kind puts into `Lowered.requests` and what the kind gets for it, its part of
the Plan, and a `Quantity` that plans (in NumPy), gathers (in torch) and has a float64 reference. It is registered in
`quantities/__init__.py`, or by an entry point.

Shapes: `env` environments, `taxel` taxels, `pair` (link, object) pairs, `row` rows of a sensor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.console.progress import Progress
from tgdsl.errors import TgdslError
from tgdsl.layout.layout import Layout, Link
from tgdsl.quantities.pairs import Pair, PairedObject, Pairs
from tgdsl.quantities.reference import ReferenceScene
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.sensed import SensedObject

Value = TypeVar("Value")
Report = Callable[[tuple[str | int, ...], str, str], None]  # notes a mistake: its place in the document, the problem, a hint


@dataclass(frozen=True, eq=False)
class Request(Generic[Value]):
    """What a kind asks of a scene; `Value` is what its `forward` gets."""

    objects: tuple[str, ...] = ()  #: objects that it concerns; empty where a request has nothing to do with objects
    is_gated: bool = False  #: whether an object counts only while the simulator has it in contact with the link
    wants_contacts: ClassVar[bool] = False  #: whether the contacts of each link with the objects are read from the state
    is_within_radii: ClassVar[bool] = False  #: whether it depends on the taxels' radii, which noise may disturb

    @property
    def num_slots(self) -> int:
        """Contacts per body and object that are read: its field `slots`, if it has one."""
        return getattr(self, "slots", 0)

    def key(self) -> tuple[Any, ...]:
        """Return what two requests at the same taxels must have in common to be one; by default all of it."""
        values = ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        return (type(self), *((name, v.tobytes() if isinstance(v, np.ndarray) else v) for name, v in values))

    def merged(self, other: Any) -> Request:
        """Return a request for what both ask for; they have one key."""
        return self

    def join_key(self) -> tuple[Any, ...]:
        """Return what requests at different taxels must have in common to be joined to one; by default all of it."""
        return self.key()

    def joined(self, others: Sequence[Any]) -> Request:
        """Return one request for several sensors' taxels, one after the other, this one's first; they have one join key."""
        return self

    def wants_distance(self, radius: Float[np.ndarray, " taxel"]) -> bool:
        """Return whether distances to surfaces are measured for it, for taxels of these radii [m]: work that can be shared."""
        return False


@dataclass(frozen=True, eq=False)
class Use:
    """A request and its taxels, shared by all sensors with equal requests."""

    request: Any  #: a `Request`
    sensors: tuple[str, ...]  #: the sensors, by their names in the document
    links: tuple[Link, ...]  #: the links that carry them
    taxels: Int[np.ndarray, " taxel"]  #: their taxels, rows of the layout
    #: where these are, (3, taxel) in the links' bodies' frames [m]; one array for all uses of the same taxels
    pos: Float[np.ndarray, "3 taxel"]
    radius_noise: str = ""  #: name of the sensor whose noise disturbs the taxels' radii, if any
    largest_shift: float = 0.0  #: by how much, at most [m]

    @property
    def bodies(self) -> tuple[str, ...]:
        """The bodies of its links, each once, in their order."""
        return tuple(dict.fromkeys(link.body for link in self.links))


@dataclass(frozen=True, eq=False)
class Planning:
    """What a quantity plans from."""

    layout: Layout  #: the taxels of all sensors
    sensed: Mapping[str, SensedObject]  #: what there is of each object that some sensor senses
    pairs: tuple[Pair, ...]  #: the pairs that may meet, sorted by object and link
    contact_pairs: tuple[Pair, ...]  #: the pairs whose contacts are read, in the order of the state
    objects: tuple[PairedObject, ...]  #: the objects that have pairs, in the Plan's order
    bodies: tuple[str, ...]  #: the bodies whose poses are read, in the order of the state
    #: returns the geoms that a link's taxels sit on, by its name: meshes as they are, not their convex hulls
    geoms_of: Callable[[str], tuple[SurfaceGeom, ...]]
    report: Report  #: notes a mistake
    progress: Progress  #: called with a line of text for each long job
    joints: tuple[str, ...] = ()  #: the joints that are read, in the order of the state
    #: where the anchor of each is in the frame of the body that it moves, by its name [m]
    anchors: Mapping[str, Float[np.ndarray, " 3"]] = field(default_factory=dict)

    def bodies_of(self, taxels: Int[np.ndarray, " taxel"]) -> list[str]:
        """Return the body of each taxel."""
        return [self.layout.links[i].body for i in self.layout.link_id[taxels]]

    def object_id(self, name: str) -> int | None:
        """Return the index of an object among the objects with pairs; None if it has none."""
        return next((i for i, target in enumerate(self.objects) if target.name == name), None)

    @property
    def heated(self) -> tuple[str, ...]:
        """The objects that hold heat, in the order of the fields `object_temperature` and `object_material` of a state.

        A quantity that reads these says so by its `fields`, and an index into them goes by `plan.inputs.heated`.
        """
        return heated_objects(self.objects, self.sensed)

    def own_pairs(self, name: str) -> list[Pair]:
        """Return an object's pairs, in order."""
        return [pair for pair in self.pairs if pair.object == name]

    def allowed(self, request: Request) -> set[Pair]:
        """Return a request's pairs: all, or only pairs that can be in contact."""
        return set(self.contact_pairs if request.is_gated else self.pairs)

    def body_ids(self, bodies: Sequence[str]) -> Int[np.ndarray, " body"]:
        """Return where bodies are in the state; 0 of one that touches nothing, which has no pose there and no contacts."""
        return np.array([self.bodies.index(body) if body in self.bodies else 0 for body in bodies], dtype=np.int64)

    def contact_table(
        self, bodies: Sequence[str], names: Sequence[str], missing: Collection[str] = ()
    ) -> Int[np.ndarray, "body object"]:
        """Return the index of each body's pair with each object among the pairs of the state; their number where there is none.

        None is looked up of objects that are `missing`.
        """
        index = {(pair.link, pair.object): i for i, pair in enumerate(self.contact_pairs) if pair.object not in missing}
        table = [[index.get((body, name), len(self.contact_pairs)) for name in names] for body in bodies]
        return np.array(table, dtype=np.int64).reshape(len(bodies), len(names))

    def pair_table(self, names: Sequence[str], taxels: Int[np.ndarray, " taxel"]) -> Int[np.ndarray, "object taxel"]:
        """Return the index of each taxel's pair with each object among that object's pairs; 0 where there is none."""
        bodies, table = self.bodies_of(taxels), []
        for name in names:
            index = {pair.link: i for i, pair in enumerate(self.own_pairs(name))}
            table.append([index.get(body, 0) for body in bodies])
        return np.array(table, dtype=np.int64).reshape(len(names), len(bodies))


@dataclass(frozen=True, eq=False)
class Scene:
    """What quantities are gathered from, at one instant."""

    tensors: Mapping[str, Tensor]  #: fields of `SceneState`, by name
    objects: tuple[PairedObject, ...]  #: the Plan's objects
    pairs: Pairs | None  #: relative poses of all pairs, in the order of the Plan; None if there are none
    radius_shifts: Mapping[str, Tensor]  #: errors of radii by sensor, where noise disturbs them: (env, taxel) [m]
    dtype: torch.dtype  #: dtype of the gathered values


def heated_objects(objects: Sequence[PairedObject], sensed: Mapping[str, SensedObject]) -> tuple[str, ...]:
    """Return the objects for which the document gives a material."""
    return tuple(target.name for target in objects if sensed[target.name].heat is not None)


def pairs_for(scene: Scene, is_gated: bool) -> Pairs:
    """Return a scene's pairs, with their gate or without."""
    assert scene.pairs is not None
    return scene.pairs if is_gated else scene.pairs._replace(gate=None)


def variant_of(scene: Scene, target: PairedObject) -> Int[Tensor, " env"] | None:
    """Return which variant of an object each environment has; None if all are alike."""
    return scene.tensors["variant"][:, target.varied].long() if target.num_variants > 1 else None


class Quantity(ABC):
    """A quantity: how it is planned, gathered and explained. One instance of each is registered."""

    name: ClassVar[str]  #: its name, also of its part of the Plan
    request: ClassVar[type[Request]]  #: the type of its requests
    #: the type of its part of the Plan: a frozen dataclass, generic in its arrays (NumPy's in the Plan, torch's at run time)
    part: ClassVar[type]
    #: whether memory may have a row for each row of its value, as `Memory(rows=…)` asks: see `num_rows`
    has_rows: ClassVar[bool] = False
    #: whether kernels on a CPU are to be as large as can be: all that is computed is alike, and would be read again
    is_fused: ClassVar[bool] = False

    reads: ClassVar[tuple[str, ...]] = ()  #: fields of `SceneState` that are read, whatever is asked
    shown: ClassVar[str] = ""  #: a use in a sensor's report

    def plan(self, planning: Planning, uses: Sequence[Use]) -> Any:
        """Return the part of the Plan for all uses; mistakes go to `planning.report`, and then the part does not matter."""
        return self.part(tuple(self.plan_use(planning, use) for use in uses))

    def plan_use(self, planning: Planning, use: Use) -> Any:
        """Return the part of one use, where the uses have nothing in common and the part's only field is `uses`."""
        raise NotImplementedError

    def gather(self, part: Any, scene: Scene) -> tuple[Any, ...]:
        """Return the value of each use: pure, traceable."""
        return tuple(self.gather_use(use, scene) for use in part.uses)

    def gather_use(self, part: Any, scene: Scene) -> Any:
        """Return the value of one use from its part: see `plan_use`."""
        raise NotImplementedError

    @abstractmethod
    def reference(self, part: Any, use: int, scene: ReferenceScene) -> Any:
        """Return the value of one use in float64 for one environment: the definition."""

    def fields(self, part: Any) -> set[str]:
        """Return the names of the fields of `SceneState` that are read."""
        return {*self.reads}

    def bodies(self, use: Use) -> tuple[str, ...]:
        """Return the bodies whose poses are read in addition to the pairs' bodies."""
        return ()

    def num_rows(self, part: Any, use: int) -> int:
        """Return the number of rows of a use's value."""
        raise NotImplementedError

    def is_light(self, part: Any) -> bool:
        """Return whether the work per taxel is small, so kernels may be tiled over environments and taxels."""
        return False

    def explain(self, part: Any, use: int, objects: Sequence[PairedObject]) -> list[str]:
        """Return a use's lines in a sensor's report."""
        return [self.shown] if self.shown else []

    def account(self, part: Any, objects: Sequence[PairedObject]) -> dict[str, list[str]]:
        """Return measured errors and sizes of precomputed tables, by headline."""
        return {}


class Gathered(dict[type[Request], Any]):
    """What a sensor asked for, by the type of the request: `gathered[ContactDepth].depth`."""

    if TYPE_CHECKING:

        def __getitem__(self, request: type[Request[Value]]) -> Value: ...

    def __missing__(self, request: object) -> Any:
        """Refuse a request that was not made.

        Raises:
            TgdslError: Always.
        """
        name = getattr(request, "__name__", repr(request))
        names = ", ".join(key.__name__ for key in self) or "none"
        raise TgdslError(f"gathered[{name}] was not asked for: put it among `Lowered.requests`, which hold {names}")

    def replaced(self, request: type[Request[Value]], value: Value) -> Gathered:
        """Return the same with another value for a request."""
        return Gathered({**self, request: value})
