"""Events of all environments: from `randomise`, and from a document's `terms`.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.fields.models import SpecModel
from tgdsl.rl.actuation import ONE, ZERO, Actuation, DriveSpec
from tgdsl.rl.draws import whole
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.spec import PlacedRandomSpec, PushSpec, RandomSpec, TaskSpec
from tgdsl.rl.task import Setup
from tgdsl.rl.terms import CurriculumTerm, Drive, Event, EventTerm, Friction, Mass, Placement, Push, Term
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.tensors.env_ids import may_be_nonempty, put_rows


def event_terms(random: RandomSpec, terms: Mapping[str, Term]) -> dict[str, EventTerm]:
    """Return the events of a task's document by the names of their random numbers."""
    events: dict[str, EventTerm] = {}
    if random.friction != ONE:
        events["friction"] = Friction(factor=random.friction)
    if random.mass != ZERO:
        events["mass"] = Mass(added=random.mass)
    if isinstance(random, PlacedRandomSpec):
        events["placement"] = Placement(xy=random.xy, yaw=random.yaw)
    if random.drive != DriveSpec():
        events["drive"] = Drive()
    if any(getattr(random.push, axis) != getattr(PushSpec(), axis) for axis in "xyz"):
        events["push"] = Push(**dict(random.push))
    return events | {f"event {name}": term for name, term in terms.items() if isinstance(term, EventTerm)}


class Events:
    """The events of all environments.

    `memory` has live tensors by name: control steps until the next event, negative while one lasts; and the number of events,
    with the episode in the upper 32 bits.
    """

    def __init__(self, terms: Mapping[str, EventTerm], sim: Simulation, setup: Setup, actuation: Actuation):
        """Make the counters of interval events; each reset draws the time of the first ones."""
        self._terms, self._setup, self.memory = terms, setup, dict[str, Tensor]()
        self._event = partial(Event, sim, setup, actuation)
        for name, term in terms.items():
            if term.mode == "reset":
                continue
            if term.interval[0] < setup.control_step:
                called = name.removeprefix("event ")
                problem = f'the event "{called}" comes every {term.interval[0]:g} s, more often than control steps'
                raise SimulationError(f"{problem} of {setup.control_step:g} s; expected an interval of at least one")
            for kind in ("left", "count"):
                self.memory[f"{name}/{kind}"] = torch.zeros(setup.num_envs, dtype=torch.int64, device=setup.device)

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"], is_placed: bool) -> None:
        """Apply reset events, end the running interval events, and draw when they happen next."""
        for name, term in self._terms.items():
            if term.mode == "reset":
                if term.changes_model != is_placed:
                    term.apply(self._event(chosen, episode, name))
            elif is_placed:
                put_rows(self.memory[f"{name}/count"], chosen, episode << 32)
                term.end(self._event(chosen, self.memory[f"{name}/count"], name))
                self._wait(name, term, chosen)

    def advance(self) -> None:
        """Begin and end events: once per control step, before its physics."""
        for name, term in self._terms.items():
            if term.mode == "reset":
                continue
            left, count = self.memory[f"{name}/left"], self.memory[f"{name}/count"]
            left -= 1
            begins, ends = left == 0, left == -term.num_steps(self._setup.control_step)
            if may_be_nonempty(begins | ends):
                count += begins
                term.apply(self._event(begins, count, name))
                term.end(self._event(ends, count, name))
                self._wait(name, term, ends)

    def _wait(self, name: str, term: EventTerm, chosen: Bool[Tensor, " env"]) -> None:
        """Draw the number of control steps until the next event."""
        first, last = (round(end / self._setup.control_step) for end in term.interval)
        purpose = f"{name} interval"
        share = self._setup.draws.shares({purpose: 1}, self.memory[f"{name}/count"], chosen)[purpose]
        put_rows(self.memory[f"{name}/left"], chosen, whole(share, first, last)[:, 0])


M = TypeVar("M", bound=SpecModel)


class Curricula:
    """The curricula of a task's document: `values` of the numbers that they change, by dotted path, scalar tensors.

    `spec` and `terms` are the document's, with these tensors instead of the numbers.
    """

    def __init__(self, loaded: LoadedTask, like: Tensor):
        self._terms = {name: term for name, term in loaded.terms.items() if isinstance(term, CurriculumTerm)}
        self.values = {term.of: torch.zeros((), dtype=like.dtype, device=like.device) for term in self._terms.values()}
        self.spec: TaskSpec = _with(loaded.spec, {path: v for path, v in self.values.items() if not path.startswith("terms.")})
        other_terms = {name: term for name, term in loaded.terms.items() if name not in self._terms}
        self.terms: Mapping[str, Term] = {
            name: _with(term, _below(f"terms.{name}", self.values)) for name, term in other_terms.items()
        }
        self.advance(0, None)

    def advance(self, iteration: int, score: float | None) -> None:
        """Write the numbers at an iteration; a GPU is not waited for."""
        for term in self._terms.values():
            self.values[term.of].fill_(term.value(iteration, score))


def _below(start: str, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {path.removeprefix(f"{start}."): value for path, value in values.items() if path.startswith(f"{start}.")}


def _with(model: M, values: Mapping[str, Tensor]) -> M:
    """Return a model with other values by dotted path, without validation."""
    update: dict[str, Any] = {path: value for path, value in values.items() if "." not in path}
    for name in {path.partition(".")[0] for path in values} - update.keys():
        update[name] = _with(getattr(model, name), _below(name, values))
    return model.model_copy(update=update)
