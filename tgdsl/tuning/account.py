"""What is said of a choice: what was chosen, the errors that were measured, and what did not hold the accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from tgdsl.errors import listed
from tgdsl.tuning.trial import Outcome, Places, Trial, brief, shown, shown_errors, written_fields


class Shared(NamedTuple):
    """How sensors share objects.

    Attributes:
        places: How distances to each object are found.
        alone: The same as each sensor would have it by itself.
        floors: Of objects that sensors without an accuracy feel too, what they have.
    """

    places: Places
    alone: Mapping[str, Places]
    floors: Places


def account(trial: Trial, own: Outcome, shared: Shared) -> tuple[str, ...]:
    """Return what an account of a sensor says of what was chosen, what was measured, and why, line by line."""
    exact, written = trial.exact, written_fields(trial)
    lines = [shown_errors(trial, own)]
    for (name, errors), bound in zip(own.chosen.items(), trial.bounds.values(), strict=True):
        lines.append(f"{name}: 99 % within {shown(errors.p99, bound)}, largest {shown(errors.largest.value, bound)}")
    scales = zip(exact.quantities, exact.magnitude.scale.tolist(), exact.units, strict=True)
    changes = {name: f"{name} {scale:.3g}{'' if unit == '1' else f' {unit}'}" for name, scale, unit in scales}
    where = f"on a {trial.recording.source}; largest changes: {', '.join(changes.values())}"
    lines.append(f"against {exact.variant.label} in float64, {where}")
    lines.append(f"cheapest by count: {own.cost.operations} operations, {own.cost.constants} bytes of constants")
    failed = sorted((other for other in trial.outcomes.values() if not other.is_held), key=_cost)
    worst = [f"{other.variant.label} ({brief(max(other.excess, other.verified_excess))} times the bound)" for other in failed]
    lines += [f"not within it: {', '.join(worst)}"] if worst else []
    lines += [f"object {target}: {why}" for target, why in _reasons(trial.sensor.name, shared).items()]
    lines += [f"left as written: {', '.join(written)}"] if written else []
    return (f"accuracy {trial.accuracy}: {own.variant.label}", *(f"  {line}" for line in lines))


def _reasons(sensor: str, shared: Shared) -> dict[str, str]:
    """Return why objects are finer than a sensor by itself would have them."""
    found = {}
    for target, place in shared.alone[sensor].items():
        others = [name for name, own in shared.alone.items() if own.get(target) == shared.places[target]]
        if place < shared.places[target]:
            found[target] = f"as fine as {listed(others)} needs"
        elif shared.floors.get(target) == place:
            found[target] = "no coarser than written, as sensors without an accuracy feel it too"
    return found


def _cost(outcome: Outcome) -> tuple[int, int]:
    return outcome.cost.operations or 0, outcome.cost.constants
