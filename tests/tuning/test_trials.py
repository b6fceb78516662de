"""The cheapest variant and the variants that are free, of stand-ins with costs and errors by hand."""

from types import SimpleNamespace

import pytest

from tgdsl.errors import LowerError, TgdslError
from tgdsl.module.accuracy.variants import Variant
from tgdsl.schema.objects import ObjectSpec
from tgdsl.tuning.trials import Cost, Level, Outcome, Sensor, Trial, cheapest, level_of


def outcome(label: str, excess: float = 0.5, verified: float = 0.5) -> Outcome:
    return Outcome(Variant(label), Cost(1, 0, 0, 0), {}, {}, excess, verified)


def test_an_accuracy_is_held_up_to_the_bound_in_both_halves():
    assert outcome("a", 1.0, 1.0).is_held
    assert not outcome("a", 1.01, 0.5).is_held and not outcome("a", 0.5, 1.01).is_held


class Measured:
    """A trial of variants with known operations, bytes and excess of their errors, by label."""

    def __init__(self, known: dict[str, tuple[int | None, int, float]]):
        self.known, self.measured = known, set[str]()

    def cost(self, variant: Variant) -> Cost | None:
        operations, constants, _ = self.known.get(variant.label, (None, -1, 0.0))
        return None if constants < 0 else Cost(operations, constants, 0, 0)

    def outcome(self, variant: Variant) -> Outcome | None:
        self.measured.add(variant.label)
        return outcome(variant.label, self.known[variant.label][2])


NONE = Level(Variant(""), {})


def test_fewest_operations_win_then_fewest_bytes():
    known = {"a": (10, 5, 0.9), "b": (10, 3, 0.9), "missed": (5, 9, 1.1), "small": (20, 1, 0.1)}
    trial = Measured(known)
    found, level = cheapest(trial, [Variant(label) for label in (*known, "unavailable")], [NONE])
    assert found.variant.label == "b" and level is NONE
    assert trial.measured == {"missed", "b"}


def test_choices_that_miss_with_the_finest_of_the_other_are_dropped():
    """Of two choices of fields and two of queries, the rough field is never tried with the coarse query."""
    fields = [Variant("rough", {"sensors.s.steps": 1}), Variant("as written", is_own=True)]
    levels = [level_of({"stone": i}) for i in (0, 4)]
    trial = Measured({
        "rough, grid, 1 mm": (1, 0, 3.0),
        "rough, raycast": (2, 0, 2.0),
        "grid, 1 mm": (3, 0, 0.5),
        "raycast": (4, 0, 0.1),
    })  # fmt: skip
    found, level = cheapest(trial, fields, levels)
    assert found.variant.label == "grid, 1 mm" and level is levels[0]
    assert trial.measured == {"rough, raycast", "grid, 1 mm", "raycast"}


def sensor_of(fields: list[Variant], **objects: ObjectSpec) -> SimpleNamespace:
    own = next((choice for choice in fields if choice.is_own), Variant("as written", is_own=True))
    return SimpleNamespace(variants=SimpleNamespace(own=own, fields=fields), queried=objects)


def trial_of(sensor: SimpleNamespace, left_out: dict[str, str] | None = None) -> Trial:
    """Return a trial without states."""
    trial = object.__new__(Trial)
    trial.sensor, trial.left_out = sensor, left_out or {}
    return trial


def labels(trial: Trial) -> list[str]:
    return [choice.label for choice in trial.fields()]


def test_fields_may_be_left_as_written():
    """Unless that is among the choices, or the finest one, which the errors are measured against."""
    exact = Variant("exact", is_exact=True)
    assert labels(trial_of(sensor_of([Variant("rough"), Variant("own", is_own=True), exact]))) == ["rough", "own", "exact"]
    assert labels(trial_of(sensor_of([Variant("rough"), exact]))) == ["as written", "rough", "exact"]
    taken = Variant("own", is_own=True, is_free=False)
    assert labels(trial_of(sensor_of([Variant("rough"), taken, exact]))) == ["as written", "rough", "exact"]
    assert labels(trial_of(sensor_of([Variant("rough"), Variant("own", is_own=True)]))) == ["rough"]
    with pytest.raises(LowerError, match="the document's own own is the finest variant"):
        trial_of(sensor_of([Variant("own", is_own=True)])).fields()


def places(trial: Trial, **floors: int) -> list[int]:
    return [level.places["stone"] for level in trial.levels(floors)]


def test_queries_are_no_coarser_than_their_floor():
    """Four grids and rays; where rays are missing the finest grid is the reference, and no choice."""
    free = sensor_of([], stone=ObjectSpec(body="stone"))
    without_rays = {"raycast": "no Warp"}
    assert places(trial_of(free)) == [0, 1, 2, 3, 4] and places(trial_of(free), stone=2) == [2, 3, 4]
    assert places(trial_of(free, without_rays), stone=1) == [1, 2]
    finest = sensor_of([], stone=ObjectSpec(body="stone", query="sdf", tolerance=1e-5))
    assert places(trial_of(finest)) == [3]
    with pytest.raises(LowerError) as caught:
        places(trial_of(finest, without_rays))
    assert "the document's own grid, 0.01 mm is the finest variant" in caught.value.what
    assert caught.value.what.endswith("; raycast: no Warp")


def test_an_unavailable_variant_is_tried_once():
    tried = []

    def plan(variant: Variant) -> None:
        tried.append(variant.label)
        if variant.label == "rays":
            raise TgdslError("no Warp")

    sensor, left_out = SimpleNamespace(plan=plan), {}
    found = [Sensor.has(sensor, Variant(label), left_out) for label in ("rays", "grid", "rays")]
    assert found == [False, True, False] and tried == ["rays", "grid"] and left_out == {"rays": "no Warp"}


def test_a_variant_that_is_tried_is_named():
    sensor, messages = SimpleNamespace(name="skin", has=lambda variant, left_out: False), []
    trial = trial_of(sensor)
    trial._costs, trial._progress = {}, messages.append
    assert trial.cost(Variant("rays")) is None and messages == ["skin: rays"]
