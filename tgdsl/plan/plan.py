"""The Plan: what to compute, with nothing left to decide. Plain values and NumPy arrays; the same input gives the same Plan.

It knows no text, no robot file and no simulator. It is a tree of frozen dataclasses whose arrays have the names of their
places in it, `quantities/contact_depth/queries/0/pos`, `sensors/touch/normal_stiffness`; only the artefact sees these names,
and who looks for a constant of a module.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_type_hints

import numpy as np

from tgdsl.errors import ArtifactError
from tgdsl.layout.identity import taxels_id
from tgdsl.layout.layout import Layout, Unfelt
from tgdsl.plan import tree
from tgdsl.plan.inputs import Inputs
from tgdsl.plan.scene import SceneFile
from tgdsl.plan.sensors import PlannedObservation, PlannedReading, PlannedSensor
from tgdsl.quantities import QUANTITIES
from tgdsl.quantities.base import Quantity
from tgdsl.quantities.pairs import PairedObject, PairTable

FORMAT = 17
"""Version of the Plan; a reader refuses any other. 0.3 must read what 0.2 writes: a new field has a default, and a change
that breaks old files converts them in `Plan.from_json`."""


@dataclass(frozen=True)
class Origin:
    """Sources of a plan; its resolution is empty if it has no layout."""

    document_sha256: str
    robot: str
    robot_sha256: str
    resolution: str
    versions: Mapping[str, str]

    @property
    def at_resolution(self) -> str:
        """Suffix for a number of taxels, or a robot, in a report."""
        return f" at resolution {self.resolution}" if self.resolution else ""


@dataclass(frozen=True, eq=False)
class Plan:
    """All a module is built from."""

    origin: Origin  # its sources
    inputs: Inputs  # the fields of the scene that it reads
    layout: Layout  # the taxels of all sensors
    objects: tuple[PairedObject, ...]  # what taxels feel
    pairs: PairTable[np.ndarray]  # the (link, object) pairs that may meet, in the order of the objects
    quantities: Mapping[str, Any]  # sensors' requests to the scene: each quantity's part, by its name, in their order
    sensors: tuple[PlannedSensor[np.ndarray], ...]  # sensors, in the document's order
    proprioception: tuple[PlannedReading, ...]  # fields of joints and actuators that are readings too
    observations: tuple[PlannedObservation[np.ndarray], ...]  # observation terms, in the document's order
    dropped: tuple[tuple[str, str], ...]  # unused parts of the scene or the document, and why
    unfelt: tuple[Unfelt, ...]  # taxels that cannot reach anything their sensors feel, and why
    scene: SceneFile  # the instrumented scene

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays by name, sorted."""
        arrays = tree.flatten(self._parts())[1]
        return {name: arrays[name] for name in sorted(arrays)}

    @cached_property
    def taxels_id(self) -> str:
        """A hash of all taxels, within rounding: see `layout.identity`."""
        return taxels_id(self.layout)

    def layout_of(self, sensor: PlannedSensor) -> Layout:
        """Return the taxels of one sensor, or its links if it has no taxels."""
        if not len(sensor.taxels):
            return Layout.of_links(sensor.links, self.layout.groups)
        return self.layout.take(sensor.taxels)

    def readings(self) -> dict[str, PlannedReading]:
        """Return all readings by name, in the order of the module's output."""
        readings = {reading.name: reading for sensor in self.sensors for reading in sensor.readings}
        return readings | {reading.name: reading for reading in self.proprioception}

    def sensor_of(self, reading: str) -> PlannedSensor[np.ndarray]:
        """Return the sensor of a reading."""
        return next(sensor for sensor in self.sensors if reading in [candidate.name for candidate in sensor.readings])

    def to_json(self) -> str:
        """Return the plan with sorted keys; arrays appear as names and one hash."""
        plain = tree.flatten(self._parts())[0] | {"format": FORMAT, "arrays": _digest(self.arrays), "taxels_id": self.taxels_id}
        return json.dumps(plain, sort_keys=True, ensure_ascii=False, separators=(",", ":"))

    @staticmethod
    def from_json(text: str, arrays: Mapping[str, np.ndarray], quantities: Sequence[Quantity] = QUANTITIES) -> Plan:
        """Return the plan that `to_json` wrote."""
        try:
            plain = json.loads(text)
            version, digest, _ = (plain.pop(name, None) for name in ("format", "arrays", "taxels_id"))
            if version != FORMAT:
                problem = f"plan format {version!r} is not {FORMAT}, which this version of tgdsl reads"
                raise ArtifactError(f"{problem}; compile the document again")
            if digest != _digest(arrays):
                raise ArtifactError("the arrays differ from the arrays that the plan was written with")
            hints, requested = get_type_hints(Plan), plain.pop("quantities")
            values = {name: tree.restored(hints[name], part, arrays) for name, part in plain.items()}
            plan = Plan(**values, quantities=_quantities(requested, arrays, quantities))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ArtifactError(f"not a plan: {error}") from error
        return plan

    def _parts(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


def _quantities(plain: Mapping[str, Any], arrays: Mapping[str, np.ndarray], known: Sequence[Quantity]) -> dict[str, Any]:
    """Return the parts of quantities, each as its quantity's type, in the order of `known`."""
    part_of = {quantity.name: quantity.part for quantity in known}
    if missing := sorted(plain.keys() - part_of.keys()):
        hint = "give the kind that brings it, or install its package"
        raise ArtifactError(f'the plan asks for the quantity "{missing[0]}", which is not known; {hint}')
    return {name: tree.restored(part, plain[name], arrays) for name, part in part_of.items() if name in plain}


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return a hash of names, dtypes, shapes and contents."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape} ".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()
