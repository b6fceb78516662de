"""Fields that were chosen because a sensor has an `accuracy`, and whether that is of what the sensor reads."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tgdsl.errors import TgdslError, did_you_mean, listed
from tgdsl.fields.accuracy import Bound
from tgdsl.plan.plan import Plan
from tgdsl.schema.loaded import Loaded
from tgdsl.schema.yaml import Path
from tgdsl.sensors.base import Lowered
from tgdsl.sensors.noise.lower import quantity


@dataclass(frozen=True)
class Choice:
    """What was chosen.

    Attributes:
        changes: Fields that nobody wrote, by dotted path: `objects.mug.tolerance`.
        notes: What an account of each sensor that has an `accuracy` says of it, line by line.
    """

    changes: Mapping[str, Any] = field(default_factory=dict)
    notes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def noted(self, plan: Plan) -> Plan:
        """Return a Plan that says why its fields are what they are."""
        sensors = [dataclasses.replace(own, notes=(*own.notes, *self.notes.get(own.name, ()))) for own in plan.sensors]
        return dataclasses.replace(plan, sensors=tuple(sensors))


def check_chosen(loaded: Loaded, choice: Choice) -> None:
    """Refuse a document some `accuracy` of which nobody has looked at.

    Raises:
        TgdslError: With the sensors.
    """
    names = [name for name, spec in loaded.spec.sensors.items() if spec.accuracy is not None and name not in choice.notes]
    if names:
        what = f"{listed(names)}: `accuracy` takes a run of the scene"
        raise TgdslError(f"{loaded.source.file}: {what}; compile with `tgdsl.compile`, or set it to null")


def check_accuracy(loaded: Loaded, name: str, lowered: Lowered) -> None:
    """Note a sensor's `accuracy` that is not of what it reads."""
    own = loaded.spec.sensors[name].accuracy
    if own is None:
        return
    units = {quantity(channel.name): channel.unit for channel in lowered.channels}
    at: Path = ("sensors", name, "accuracy")
    shown = listed([f"{found} [{unit}]" for found, unit in units.items()])
    for key, bound in own.bounds:
        path = (*at, key) if key else at
        if key and key not in units:
            what = f'the reading has no quantity "{key}"'
            loaded.problems.append(loaded.problem(path, what, did_you_mean(key, units, "quantities"), on_key=True))
        wrong = [found for found in ([key] if key in units else [] if key else units) if not _is_of(bound, units[found])]
        if wrong:
            what = f'"{bound.text}" is in {bound.unit}, and the reading has {shown}'
            loaded.problems.append(loaded.problem(path, what, _hint(units)))
    missing = [found for found in units if own.of(found) is None]
    if missing:
        what = f"nothing is said of {listed(missing)}, which the reading has too"
        loaded.problems.append(loaded.problem(at, what, "expected a bound of each quantity"))


def _is_of(bound: Bound, unit: str) -> bool:
    return not bound.unit or bound.unit == unit


def _hint(units: Mapping[str, str]) -> str:
    fraction = 'expected a fraction of the largest change, such as "1 %"'
    if len(units) == 1 or "1" in units.values():
        amounts = {unit for unit in units.values() if unit != "1"}
        return f"{fraction}, or an amount in {amounts.pop()}" if len(units) == 1 and amounts else fraction
    each = ", ".join(f"{name}: {'1 %' if i else f'… {unit}'}" for i, (name, unit) in enumerate(units.items()))
    return f"{fraction}, or one of each: {{{each}}}"
