"""What a quantity is: something that kinds of sensors ask of a scene, found once for all that ask alike.

A quantity is one folder. It holds, in this order of use:

    request.py     the typed request, which a kind puts into `Lowered.requests`, and what the kind gets for it
    planning.py    from requests to its part of the Plan: what is computed beforehand, as typed arrays (`bake.py`, …)
    gathering.py   from the state of a scene to what was asked for, in torch (and `*_kernel.py`)
    reference.py   the definition in float64, environment by environment

and ends in a `Quantity` that ties them together and is registered in `quantities/known.py`, or by an entry point.

Shapes: `env` environments, `taxel` taxels, `pair` (link, object) pairs, `row` rows of a sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.sensed import SensedObject

Value = TypeVar("Value")
Report = Callable[[Sequence[str | int], str, str], None]
"""Notes a mistake: the place in the document, what is wrong, and a hint."""


@dataclass(frozen=True, eq=False)
class Request(Generic[Value]):
    """What a kind asks of a scene; `Value` is what its `forward` gets.

    Attributes:
        objects: Objects that it is asked of; none for what has nothing to do with objects.
        is_gated: Whether an object counts only while the simulator has it in contact with the link.
    """

    objects: tuple[str, ...] = ()
    is_gated: bool = False
    wants_contacts: ClassVar[bool] = False
    """Whether the contacts of each link with the objects are read from the state."""
    is_within_radii: ClassVar[bool] = False
    """Whether it depends on the taxels' radii, which noise may disturb."""

    @property
    def num_slots(self) -> int:
        """Contacts per body and object that are read."""
        return 0

    def key(self) -> tuple[Any, ...]:
        """Return what two requests at the same taxels must have in common to be one; by default all of it."""
        values = ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        return (type(self), *((name, v.tobytes() if isinstance(v, np.ndarray) else v) for name, v in values))

    def merged(self, other: Request) -> Request:
        """Return a request for what both ask for; they have one key."""
        return self

    def join_key(self) -> tuple[Any, ...]:
        """Return what requests at different taxels must have in common to be joined to one; by default all of it."""
        return self.key()

    def joined(self, others: Sequence[Request]) -> Request:
        """Return one request for several sensors' taxels, one after the other, this one's first; they have one join key."""
        return self

    def wants_distance(self, radius: Float[np.ndarray, " taxel"]) -> bool:
        """Return whether distances to surfaces are measured for it, for taxels of these radii [m]: work that can be shared."""
        return False


@dataclass(frozen=True, eq=False)
class Use:
    """A request, and where it is made: one for all sensors that ask alike.

    Attributes:
        request: What is asked for.
        sensors: The sensors, by their names in the document.
        links: The links that carry them.
        taxels: Their taxels, rows of the layout.
        pos: Where these are, (3, taxel) in the links' bodies' frames [m]; one array for all uses of the same taxels.
        radius_noise: Name of the sensor whose noise disturbs the taxels' radii, if any.
        largest_shift: By how much, at most [m].
    """

    request: Request
    sensors: tuple[str, ...]
    links: tuple[Link, ...]
    taxels: Int[np.ndarray, " taxel"]
    pos: Float[np.ndarray, "3 taxel"]
    radius_noise: str = ""
    largest_shift: float = 0.0


@dataclass(frozen=True, eq=False)
class Planning:
    """What a quantity plans from.

    Attributes:
        layout: The taxels of all sensors.
        sensed: What there is of each object that some sensor senses.
        pairs: The pairs that may meet, sorted by object and link.
        contact_pairs: Those of them whose contacts are read, in the order of the state.
        objects: The objects that have pairs, in the Plan's order.
        bodies: The bodies whose poses are read, in the order of the state.
        geoms_of: Returns the geoms that a link's taxels sit on, by its name: meshes as they are, not their convex hulls.
        report: Notes a mistake.
        progress: Is told what is done.
        joints: The joints that are read, in the order of the state.
        anchors: Where the anchor of each is in the frame of the body that it moves, by its name [m].
    """

    layout: Layout
    sensed: Mapping[str, SensedObject]
    pairs: tuple[Pair, ...]
    contact_pairs: tuple[Pair, ...]
    objects: tuple[PairedObject, ...]
    bodies: tuple[str, ...]
    geoms_of: Callable[[str], tuple[SurfaceGeom, ...]]
    report: Report
    progress: Progress
    joints: tuple[str, ...] = ()
    anchors: Mapping[str, Float[np.ndarray, " 3"]] = field(default_factory=dict)

    def bodies_of(self, taxels: Int[np.ndarray, " taxel"]) -> list[str]:
        """Return the body of each taxel."""
        return [self.layout.links[i].body for i in self.layout.link_id[taxels]]

    def object_id(self, name: str) -> int | None:
        """Return the place of an object among those that have pairs; None if it has none."""
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
        """Return the pairs that a request is of: all, or those that can be in contact."""
        return set(self.contact_pairs if request.is_gated else self.pairs)

    def pair_table(self, names: Sequence[str], taxels: Int[np.ndarray, " taxel"]) -> Int[np.ndarray, "object taxel"]:
        """Return the index of each taxel's pair with each object among that object's pairs; 0 where there is none."""
        bodies, table = self.bodies_of(taxels), []
        for name in names:
            own = {pair.link: i for i, pair in enumerate(self.own_pairs(name))}
            table.append([own.get(body, 0) for body in bodies])
        return np.array(table, dtype=np.int64).reshape(len(names), len(bodies))


@dataclass(frozen=True, eq=False)
class Scene:
    """What quantities are gathered from, at one instant.

    Attributes:
        tensors: Fields of `SceneState`, by name.
        objects: The Plan's objects.
        pairs: Relative poses of all pairs, in the order of the Plan; None if there are none.
        radius_shifts: By how much the radii of sensors with such noise are off, by sensor: (env, taxel) [m].
        dtype: Dtype of what is gathered.
    """

    tensors: Mapping[str, Tensor]
    objects: tuple[PairedObject, ...]
    pairs: Pairs | None
    radius_shifts: Mapping[str, Tensor]
    dtype: torch.dtype


def heated_objects(objects: Sequence[PairedObject], sensed: Mapping[str, SensedObject]) -> tuple[str, ...]:
    """Return those of some objects of which the document says what they are made of."""
    return tuple(target.name for target in objects if sensed[target.name].heat is not None)


def pairs_for(scene: Scene, is_gated: bool) -> Pairs:
    """Return a scene's pairs, with their gate or without."""
    assert scene.pairs is not None
    return scene.pairs if is_gated else scene.pairs._replace(gate=None)


def variant_of(scene: Scene, target: PairedObject) -> Int[Tensor, " env"] | None:
    """Return which variant of an object each environment has; None if all are alike."""
    return scene.tensors["variant"][:, target.varied].long() if target.num_variants > 1 else None


def _no_fields(part: Any) -> set[str]:
    return set()


def _no_bodies(use: Use) -> tuple[str, ...]:
    return ()


def _nothing_to_explain(part: Any, use: int, objects: Sequence[PairedObject]) -> list[str]:
    return []


def _not_light(part: Any) -> bool:
    return False


def _nothing_measured(part: Any, objects: Sequence[PairedObject]) -> dict[str, list[str]]:
    return {}


@dataclass(frozen=True, eq=False)
class Quantity:
    """A quantity. A module holds it, and can be pickled where its functions can: a lambda cannot.

    Attributes:
        name: Its name: that of its folder, and of its part of the Plan.
        request: The type of its requests.
        part: The type of its part of the Plan: a frozen dataclass, generic in its arrays (NumPy's in the Plan, torch's at run
            time).
        plan: `(planning, uses) → part`. Mistakes go to `planning.report`; what is returned then does not matter.
        gather: `(part, scene) → values`, one for each use: pure, traceable.
        reference: `(part, use, scene) → value` in float64 for one environment, see `testing.scene.ReferenceScene`.
        fields: `(part) → names of the fields of SceneState` that are read.
        bodies: `(use) → bodies` whose poses are read besides those of pairs.
        num_rows: `(part, use) → rows` of memory with one per row of the value, for `Memory(rows=…)`.
        explain: `(part, use, objects of the Plan) → what an account of a sensor says of it`.
        is_light: `(part) → whether` little is found per taxel, so that kernels may be tiled over environments and taxels.
        is_fused: Whether kernels on a CPU are to be as large as can be: all that is computed is alike, and would be read again.
        account: `(part, objects of the Plan) → lines by headline`: what was measured of what is computed beforehand.
    """

    name: str
    request: type[Request]
    part: type
    plan: Callable[[Planning, Sequence[Use]], Any]
    gather: Callable[[Any, Scene], tuple[Any, ...]]
    reference: Callable[[Any, int, Any], Any]
    fields: Callable[[Any], set[str]] = _no_fields
    bodies: Callable[[Use], tuple[str, ...]] = _no_bodies
    num_rows: Callable[[Any, int], int] | None = None
    explain: Callable[[Any, int, Sequence[PairedObject]], list[str]] = _nothing_to_explain
    is_light: Callable[[Any], bool] = _not_light
    is_fused: bool = False
    account: Callable[[Any, Sequence[PairedObject]], dict[str, list[str]]] = _nothing_measured


class Gathered(dict[type[Request], Any]):
    """What a sensor asked for, by the type of the request: `gathered[ContactDepth].depth`."""

    if TYPE_CHECKING:

        def __getitem__(self, request: type[Request[Value]]) -> Value: ...

    def __missing__(self, request: object) -> Any:
        """Say what was not asked for.

        Raises:
            TgdslError: Always.
        """
        wanted = getattr(request, "__name__", repr(request))
        asked = ", ".join(own.__name__ for own in self) or "none"
        raise TgdslError(f"gathered[{wanted}] was not asked for: put it among `Lowered.requests`, which hold {asked}")

    def replaced(self, request: type[Request[Value]], value: Value) -> Gathered:
        """Return the same with another value for a request."""
        return Gathered({**self, request: value})
