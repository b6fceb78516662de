"""From the state of a scene to what the sensors feel of it: the Plan's geometry queries, and the answers made of each.

Shapes: `env` environments, `pair` pairs of `inputs.pairs`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.module.felt_objects import FeltObjects
from tgdsl.plan.plan import Plan
from tgdsl.quantities.contact_depth.query import Felt, FeltObject, Near, Pairs, Probes, feel, measure, relate
from tgdsl.quantities.contact_depth.search import search
from tgdsl.quantities.contact_depth.search_tables import Tables
from tgdsl.quantities.contacts.contacts import contacts
from tgdsl.quantities.moments.nearby import with_moments
from tgdsl.quantities.moments.sources import moment_sources
from tgdsl.quantities.points.points import with_points
from tgdsl.sensors.noise import stages
from tgdsl.sensors.noise.instant import Now
from tgdsl.tensors.buffers import Constants

Tensors = Mapping[str, Tensor]
Knobs = Mapping[str, Mapping[str, Tensor]]
"""Values of the sensors' noise, by their names."""
Answer = tuple[Felt, Probes]


class Queries:
    """A Plan's queries. Each is measured once, whatever number of sensors it has answers for."""

    def __init__(self, plan: Plan):
        """Make what they measure against."""
        self._plan = plan
        self._felt_objects = FeltObjects(plan)

    def constants(self) -> dict[str, np.ndarray]:
        """Return the Plan's arrays that a module keeps, and tables made of them, by their paths."""
        unused = ("layout/", *self._felt_objects.kept)
        arrays = {path: array for path, array in self._plan.arrays.items() if not path.startswith(unused)}
        return arrays | self._felt_objects.searched() | self._felt_objects.tiles()

    def answers(self, constants: Constants, tensors: Tensors, nows: Mapping[str, Now], knobs: Knobs) -> list[list[Answer]]:
        """Return the answers to all queries, and the probes of each.

        Args:
            constants: What `constants` returned, on the device.
            tensors: The fields of `SceneState` that `inputs` names.
            nows: When sensors are read, by their names.
            knobs: Values of their noise, which may disturb the probes' radii.
        """
        pairs = _pairs(constants, tensors)
        measured = sorted({o for query in self._plan.queries for o in query.objects})
        objects = {o: self._felt_objects.felt(self._plan.objects[o], constants, tensors) for o in measured}
        found = []
        for i, query in enumerate(self._plan.queries):
            x, y, z = constants[f"queries/{i}/pos"]
            probes = Probes((x, y, z), constants[f"queries/{i}/pair"])
            targets = [objects[o] for o in query.objects]
            found.append(self._answers(i, pairs, probes, targets, constants, tensors, nows, knobs))
        return found

    def _answers(
        self,
        i: int,
        pairs: Pairs,
        probes: Probes,
        targets: Sequence[FeltObject],
        constants: Constants,
        tensors: Tensors,
        nows: Mapping[str, Now],
        knobs: Knobs,
    ) -> list[Answer]:
        """Return the answers to one query."""
        near: tuple[Near, ...] | None = None
        answers = []
        for a, answer in enumerate(self._plan.queries[i].answers):
            path = f"queries/{i}/{a}"
            own = pairs if answer.is_gated else pairs._replace(gate=None)
            reach, shift = constants[f"{path}/reach"], None
            if answer.radius_noise:
                half_width, now = knobs[answer.radius_noise]["radius_noise"], nows[answer.radius_noise]
                shift = stages.radius_shift(half_width, now, probes.pos[0])
                reach = stages.shifted(reach[:, None], shift)
            met = None
            if "contacts" in answer.needs:
                met = contacts(tensors, constants[f"queries/{i}/bodies"], constants[f"{path}/contacts"], constants.dtype)
            felt = None
            if known := [name for name in Tables._fields if f"{path}/search/{name}" in constants]:
                tables = constants.under(f"{path}/search", known)
                felt = search(own, probes, [targets[o] for o in answer.objects], tables, reach, answer.needs, met)
            if felt is None:
                near = near if near is not None else measure(pairs, probes, targets)
                felt = feel(own, probes, [near[o] for o in answer.objects], reach, answer.needs, met)
            if answer.moments is not None:
                sources = moment_sources(self._plan, constants, f"{path}/moments", answer.moments, tensors, shift)
                felt = with_moments(felt, own, probes, sources)
            if answer.points is not None:
                points = self._felt_objects.point_sources(f"{path}/points", answer.points, constants, tensors)
                felt = with_points(felt, _with_lost(own), points)
            answers.append((felt, probes))
        return answers


def _with_lost(pairs: Pairs) -> Pairs:
    """Return pairs that are nowhere, their offset not-a-number, where their gate is not-a-number."""
    if pairs.gate is None:
        return pairs
    lost = pairs.gate.clamp(min=0.0)  # zero where it is a number
    return pairs._replace(offset=planes.vec(part + lost for part in pairs.offset))


def _pairs(constants: Constants, tensors: Tensors) -> Pairs:
    """Return the relative poses and motions of all pairs, and which of them may be felt."""
    gate = None
    if "contact_found" in tensors:
        found = tensors["contact_found"][:, constants["pairs/gate"]]
        gate = torch.where(found > 0, 0.0, torch.where(found.isnan(), torch.nan, -torch.inf)).to(constants.dtype)
    return relate(
        tensors["body_pos"],
        tensors["body_quat"],
        constants["pairs/link"],
        constants["pairs/object"],
        constants.dtype,
        tensors.get("body_linvel"),
        tensors.get("body_angvel"),
        gate,
    )
