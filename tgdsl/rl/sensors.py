"""The module of a task: only the sensors that the policy or the task reads.

Shapes: `env` environments, `step` physics steps of a control step, the first one first, `feature` numbers of a group.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.console.progress import Progress
from tgdsl.errors import Problem, SpecError, did_you_mean, listed
from tgdsl.layout.layout import Layout
from tgdsl.module.module import TactileModule
from tgdsl.observations.observations import OfReading, PerLink
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.spec import touch_types
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.schema.load import Loaded, load
from tgdsl.schema.select import matching
from tgdsl.schema.yaml import SET
from tgdsl.schema.yaml import Path as Place
from tgdsl.sensors.known import known_kinds
from tgdsl.tensors.env_ids import put_rows
from tgdsl.tuning.compile import compile as compile_document

GROUP = "tactile_sensors"  # the observation group of a policy's touch
CLEAN = "clean"  # the noise profile without noise
KEYS: dict[str, Place] = {
    "links": ("placement",),
    "noise": ("noise",),
    "resolution": ("resolution",),
    "robot": ("physics", "collision"),
    "objects": ("variants",),
}
"""A task's keys that override the sensors' document, by the document's key."""


class PolicyTouch(NamedTuple):
    """Touch of a policy: a `TouchType` except "none", a link group or name with shell wildcards, and a noise profile."""

    type: str
    placement: str
    noise: str

    @property
    def group(self) -> str:
        """Its group of observations, where policies with different touch share a simulation."""
        return f"{GROUP}/{self.type}/{self.placement}/{self.noise}"

    @property
    def kind(self) -> str:
        """The kind of its sensor."""
        return touch_types()[self.type][0]

    @property
    def is_per_link(self) -> bool:
        """Whether its features are per link, not per taxel."""
        return issubclass(touch_types()[self.type][1], PerLink)

    @property
    def observation(self) -> str:
        """The module's observation that contains the group."""
        return f"{GROUP}_{self.type}_{self.noise}"


def _observation(type_: str, reading: str) -> OfReading:
    """Return the observation of a reading for a word of `touch:`."""
    model = touch_types()[type_][1]
    return model.model_validate({"type": get_args(model.model_fields["type"].annotation)[0], "of": reading})


class Source(NamedTuple):
    """Source of a group: the module's observation, the columns in it (None: all), and their taxels."""

    observation: str
    spec: OfReading
    columns: Int[Tensor, " feature"] | None
    layout: Layout


@dataclass(frozen=True, eq=False)
class TaskSensors:
    """A task's sensors, and the names of their readings."""

    touch: TactileModule
    policy_sensor: str | None  # name of the policy's sensor; None without touch
    contact: str | None  # name of the `link_contact` sensor; None if the task takes none
    channels: tuple[str, ...]  # its channels: the force is among them, and the normal force if the task wants it
    distance: str | None  # name of the `surface_distance` sensor; None if the task takes none
    object: str  # body of the task's object in the scene
    by_kind: Mapping[str, str]  # name of the sensor of each kind that the task looks at
    groups: Mapping[str, Source]  # groups of touch observations

    def observe(self, readings: Mapping[str, Tensor]) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the groups of touch, in the units of their sensors."""
        observed = self.touch.observe(readings) if self.groups else {}
        parts = {name: (observed[source.observation], source.columns) for name, source in self.groups.items()}
        return {name: value if columns is None else value.index_select(1, columns) for name, (value, columns) in parts.items()}

    def num_variants(self, name: str) -> int:
        """Return how many variants an object of the document has; 1 if it has none."""
        inputs = self.touch.inputs
        return inputs.num_variants[inputs.objects.index(name)] if name in inputs.objects else 1

    def forces(
        self, readings: Mapping[str, Tensor], like: Float[Tensor, "env joint"]
    ) -> tuple[Float[Tensor, "env link 3"], Float[Tensor, "env loaded"]]:
        """Return the object's force on each link, and the sum of its normal forces on each, as `Now` has them [N]."""
        none = like[:, :0]
        if self.contact is None:
            return none[:, :, None].expand(-1, -1, 3), none
        of_links, first = readings[self.contact].to(like), self.channels.index("force_x")
        force = of_links[:, :, first : first + 3].contiguous()
        return force, of_links[:, :, self.channels.index("normal_force")] if "normal_force" in self.channels else none


def compile_sensors(
    loaded: LoadedTask,
    device: torch.device | str,
    progress: Progress | None = None,
    only: Sequence[str] | None = None,
    touches: Sequence[PolicyTouch] | None = None,
    also: Mapping[str, Sequence[Mapping[str, Any]]] | None = None,
) -> TaskSensors:
    """Compile a task's sensors."""
    spec, document = loaded.spec, sensors_document(loaded)
    senses = loaded.senses if only is None else only
    of_policy = [] if only is not None or spec.touch == "none" else [spec.touch]
    types = of_policy if touches is None else [each.type for each in touches]
    sensor = _sensors_of(loaded, document, {"task": senses, "touch": [touch_types()[type_][0] for type_ in types]})
    by_kind = {kind: sensor[kind] for kind in senses}
    overrides, observations = _sensor_overrides(loaded), dict[str, OfReading]()
    if spec.resolution is not None:
        overrides["resolution"] = spec.resolution
    if spec.variants is not None:
        overrides[f"objects.{spec.object}.variants"] = _variants(loaded, document)
    if spec.physics.collision is not None:
        overrides["robot.collision"] = spec.physics.collision
    policy_sensor, sensor_of = None, {each: sensor[each.kind] for each in touches or ()}
    if touches is not None:
        more, observations = _overrides(loaded, sensor_of)
        overrides |= more
    elif of_policy:
        policy_sensor = sensor[touch_types()[spec.touch][0]]
        overrides |= {f"sensors.{policy_sensor}.links": spec.placement, f"sensors.{policy_sensor}.noise": spec.noise}
        observations = {GROUP: _observation(spec.touch, policy_sensor)}
    contact = by_kind.get("link_contact")
    if contact:
        outputs = document.spec.sensors[contact].outputs  # type: ignore[attr-defined]
        forces = ("force", "normal_force") if loaded.task.wants_normal_force else ("force",)
        overrides[f"sensors.{contact}.outputs"] = list(dict.fromkeys((*outputs, *forces)))
    observed = {name: [observation.model_dump(exclude_unset=True)] for name, observation in observations.items()}
    overrides = {"observations": observed | dict(also or {})} | overrides
    with _mistakes_at_keys(loaded, of_several=touches is not None):
        touch = compile_document(
            loaded.folder / spec.document,
            sensors=set(sensor.values()) or None,
            overrides=overrides,
            device=device,
            progress=progress,
        )
    layouts = {planned.name: touch.plan.layout_of(planned) for planned in touch.plan.sensors}
    groups = {
        each.group: _source(loaded, touch, each, observations[each.observation], layouts[name])
        for each, name in sensor_of.items()
    }
    if policy_sensor:
        groups[GROUP] = Source(GROUP, observations[GROUP], None, layouts[policy_sensor])
    return TaskSensors(
        touch=touch,
        policy_sensor=policy_sensor,
        contact=contact,
        channels=next((output.channels for output in touch.outputs if output.name == contact), ()),
        distance=by_kind.get("surface_distance"),
        object=document.spec.objects[spec.object].body_of(spec.object),
        by_kind=by_kind,
        groups=groups,
    )


def _overrides(loaded: LoadedTask, sensor_of: Mapping[PolicyTouch, str]) -> tuple[dict[str, Any], dict[str, OfReading]]:
    """Return overrides of the sensors' document for policies with different touch, and the module's observations."""
    result, observations = dict[str, Any](), dict[str, OfReading]()
    for sensor in dict.fromkeys(sensor_of.values()):
        carried = [wanted for wanted, carrier in sensor_of.items() if carrier == sensor]
        noises = list(dict.fromkeys(wanted.noise for wanted in carried if wanted.noise != CLEAN))
        if len(noises) > 1:
            problem = f"noise {listed(noises)} of one sensor in one simulation, expected at most one and {CLEAN}"
            raise loaded.error(("noise",), problem)
        is_both = bool(noises) and any(wanted.noise == CLEAN for wanted in carried)
        result[f"sensors.{sensor}.links"] = list(dict.fromkeys(wanted.placement for wanted in carried))
        result[f"sensors.{sensor}.noise"] = noises[0] if noises else CLEAN
        result[f"sensors.{sensor}.readout"] = "both" if is_both else "measured"
        for wanted in carried:
            reading = f"{sensor}/clean" if is_both and wanted.noise == CLEAN else sensor
            observations[wanted.observation] = _observation(wanted.type, reading)
    return result, observations


def _source(loaded: LoadedTask, touch: TactileModule, wanted: PolicyTouch, spec: OfReading, layout: Layout) -> Source:
    """Return a group's source: the placement's taxels or links of the sensor."""
    links = [link.name for link in layout.links]
    names = layout.groups.get(wanted.placement) or tuple(matching(wanted.placement, links))
    if set(names) == set(links):
        return Source(wanted.observation, spec, None, layout)
    taxels = layout.taxels_of(names)
    size = sum(term.num_features for term in touch.plan.observations if term.group == wanted.observation)
    rows = np.flatnonzero([name in names for name in links]) if wanted.is_per_link else taxels
    num_rows = len(links) if wanted.is_per_link else layout.num_taxels
    if not num_rows or size % num_rows:
        problem = f'"{wanted.type}" at {wanted.placement} cannot share a sensor with other links: its numbers are not of taxels'
        raise loaded.error(("placement",), problem)
    columns = (np.arange(size // num_rows)[:, None] * num_rows + rows).ravel()
    return Source(wanted.observation, spec, torch.from_numpy(columns).to(touch.device), layout.take(taxels))


def check_touch(loaded: LoadedTask, touches: Sequence[PolicyTouch]) -> None:
    """Raise `SpecError` if the sensors' document lacks a sensor for a policy's touch, or has mistakes."""
    _sensors_of(loaded, sensors_document(loaded), {"touch": [each.kind for each in touches]})


def types_of(loaded: LoadedTask) -> list[str]:
    """Return the touch types that the sensors' document has sensors for, and "none"."""
    return _types([sensor.kind for sensor in sensors_document(loaded).spec.sensors.values()])  # type: ignore[attr-defined]


def _types(kinds: Sequence[str]) -> list[str]:
    return ["none", *(name for name, (kind, _) in touch_types().items() if kind in kinds)]


def num_variants(loaded: LoadedTask) -> int:
    """Return how many variants the task's object has; 1 if it has none."""
    document, spec = sensors_document(loaded), loaded.spec
    if spec.variants is not None:
        return len(_variants(loaded, document))
    return len(document.spec.objects[spec.object].variants or ()) or 1


def _variants(loaded: LoadedTask, document: Loaded) -> list[Any]:
    """Return the variants of its object that a task takes, as the sensors' document has them."""
    spec = loaded.spec
    assert spec.variants is not None
    variants = document.raw(("objects", spec.object, "variants")) or []
    if not variants:
        raise loaded.error(("variants",), f'the object "{spec.object}" of "{spec.document}" has no variants', "leave it out")
    for place, variant in enumerate(spec.variants):
        if variant >= len(variants) or variant in spec.variants[:place]:
            problem = f"variant {variant}, expected each once, from 0 to {len(variants) - 1}"
            raise loaded.error(("variants", place), problem)
    return [variants[variant] for variant in spec.variants]


def sensors_document(loaded: LoadedTask) -> Loaded:
    """Return the sensors' document."""
    spec = loaded.spec
    file = loaded.folder / spec.document
    if not file.is_file():
        hint = "paths are relative to this document"
        raise loaded.error(("document",), f'there is no file "{spec.document}"', hint)
    document = load(file, kinds=known_kinds())
    document.raise_problems()
    for name in spec.sensors.keys() - document.spec.sensors.keys():
        problem = f'"{spec.document}" has no sensor "{name}"'
        raise loaded.error(("sensors", name), problem, did_you_mean(name, document.spec.sensors, "sensors"))
    if spec.sensors:
        with _mistakes_at_keys(loaded):
            document = load(file, _sensor_overrides(loaded), known_kinds())
            document.raise_problems()
    if spec.object not in document.spec.objects:
        problem = f'"{spec.document}" has no object "{spec.object}", only {listed(list(document.spec.objects))}'
        raise loaded.error(("object",), problem)
    return document


@contextmanager
def _mistakes_at_keys(loaded: LoadedTask, of_several: bool = False) -> Iterator[None]:
    """Locate mistakes in values that a task sets in the sensors' document at the task's keys.

    `of_several`: placements and noise come from several policies' touch, not from the task.
    """
    try:
        yield
    except SpecError as error:
        raise SpecError([_at_key(loaded, problem, of_several) for problem in error.problems]) from error


def _at_key(loaded: LoadedTask, problem: Problem, of_several: bool) -> Problem:
    if not problem.file.startswith(SET):
        return problem
    first, *names = problem.file.removeprefix(SET).partition("=")[0].split(".")
    if first == "sensors" and names[-1] in loaded.spec.sensors.get(names[0], {}):
        return loaded.source.problem((first, *names), problem.what, problem.hint)
    place = KEYS.get(names[-1] if first == "sensors" else first)
    if place is None:
        return problem
    if of_several and first == "sensors":
        return replace(problem, file=place[0], path="")
    return loaded.source.problem(place, problem.what, problem.hint)


def _sensor_overrides(loaded: LoadedTask) -> dict[str, Any]:
    return {f"sensors.{name}.{key}": value for name, keys in loaded.spec.sensors.items() for key, value in keys.items()}


def _sensors_of(loaded: LoadedTask, document: Loaded, wanted: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return the document's only sensor of each kind, by kind; `wanted` has the kinds by the task's key that needs them."""
    sensor, problems = {}, []
    for key, kind in dict.fromkeys((key, kind) for key, some in wanted.items() for kind in some):
        names = [name for name, other in document.spec.sensors.items() if other.kind == kind]  # type: ignore[attr-defined]
        if len(names) == 1:
            sensor[kind] = names[0]
            continue
        which = f"the sensors {listed(names)}" if names else "no sensor"
        problem = f'"{loaded.spec.document}" has {which} of kind "{kind}", expected one'
        kinds = [other.kind for other in document.spec.sensors.values()]  # type: ignore[attr-defined]
        hint = f"its sensors allow `touch` {listed(_types(kinds))}" if key == "touch" else did_you_mean(kind, kinds, "kinds")
        problems += loaded.error((key,), problem, "" if names else hint).problems
    if problems:
        raise SpecError(problems)
    return sensor


class SubstepTouch:
    """The touch groups after each physics step of the last control step (`temporal: stack`); all equal at a start."""

    def __init__(self, sensors: TaskSensors, sim: Simulation):
        self._sensors, self._sim = sensors, sim
        self.stacks: dict[str, Float[Tensor, "env step feature"]] = {}  # live tensors

    def step(self, control: Float[Tensor, "env nu"]) -> dict[str, Tensor]:
        """Make a control step with readings at each physics step; return the last ones."""
        readings: dict[str, Tensor] = {}
        for i, state in enumerate(self._sim.substates(control)):
            readings = self._sensors.touch(state)
            for name, value in self._sensors.observe(readings).items():
                self.stacks[name][:, i].copy_(value)
        return readings

    def begin(self, chosen: Bool[Tensor, " env"], readings: dict[str, Tensor]) -> None:
        """Fill the stacks of environments that begin an episode with the readings of their start."""
        for name, value in self._sensors.observe(readings).items():
            start = value[:, None].expand(-1, self._sim.substeps, -1)
            if name not in self.stacks:
                self.stacks[name] = start.clone()
            put_rows(self.stacks[name], chosen, start)

    def observe(self) -> dict[str, Float[Tensor, "env feature"]]:
        """Return copies of the groups: all features of the first physics step, then of the second."""
        return {name: value.flatten(1).clone() for name, value in self.stacks.items()}
