"""The variants of a sensor that trade speed for error: alternatives of its fields, from its kind, and of its mesh queries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from tgdsl.plan.plan import Plan
from tgdsl.quantities.geoms import GeomTable
from tgdsl.sensors.base import Alternative, AnySensorSpec, Kind

BARE: Mapping[str, Any] = {"readout": "clean", "rate": None, "history": None, "accuracy": None}
"""Fields of a sensor without imperfections, so that two variants can be compared reading by reading."""


@dataclass(frozen=True, eq=False)
class Variant:
    """A way to compute a sensor."""

    label: str  # what to call it
    changes: Mapping[str, Any] = field(default_factory=dict)  # changed fields by dotted path: `sensors.skin.operator`
    is_own: bool = False  # whether it is the document's own variant
    is_free: bool = True  # whether it may be chosen: it changes no field that the document sets, and no reading
    is_exact: bool = False  # whether it is exact up to rounding

    def joined(self, other: Variant) -> Variant:
        """Return the variant that has the changes of both."""
        changes, is_exact = {**self.changes, **other.changes}, self.is_exact and other.is_exact
        return Variant(f"{self.label}, {other.label}", changes, is_free=self.is_free and other.is_free, is_exact=is_exact)


@dataclass(frozen=True)
class Variants:
    """The variants of a sensor, from coarse to fine; each changes one thing of the document."""

    own: Variant  # the document's variant
    fields: tuple[Variant, ...]  # other choices of the sensor's fields
    queries: tuple[Variant, ...]  # other distance queries to the meshes that it senses


def bare(name: str) -> dict[str, Any]:
    """Return the changes that leave a sensor without imperfections and a document without observations."""
    return {"observations": "{}", **{f"sensors.{name}.{key}": value for key, value in BARE.items()}}


def variants_of(
    kind: Kind, name: str, spec: AnySensorSpec, queries: Mapping[str, Any], alternatives: Sequence[Alternative]
) -> Variants:
    """Return the variants of a sensor.

    `queries` has the fields of the sensed objects with meshes, `alternatives` the distance queries available for meshes.
    """
    fields = _variants((f"sensors.{name}",), (spec,), kind.alternatives(spec))
    ways = _variants(tuple(f"objects.{query}" for query in queries), tuple(queries.values()), alternatives) if queries else ()
    labels = [variant.label for variant in (*fields, *ways) if variant.is_own]
    return Variants(Variant(", ".join(labels) or "as written", {}, True), fields, ways)


def _variants(paths: Sequence[str], specs: Sequence[Any], alternatives: Sequence[Alternative]) -> tuple[Variant, ...]:
    results = []
    for alternative in alternatives:
        is_own = all(is_taken(spec, alternative) for spec in specs)
        changes = {f"{path}.{key}": value for path in paths for key, value in alternative.changes.items()}
        results.append(
            Variant(alternative.label, changes, is_own, all(is_free(spec, alternative) for spec in specs), alternative.is_exact)
        )
    return tuple(results)


def is_taken(spec: Any, alternative: Alternative) -> bool:
    """Return whether a sensor's or an object's fields already have an alternative's values."""
    return all(_is_same(getattr(spec, key), value) for key, value in alternative.changes.items())


def is_free(spec: Any, alternative: Alternative) -> bool:
    """Return whether an alternative may be chosen: it keeps and uses every field that is set, and reads the same."""
    if alternative.is_other and not is_taken(spec, alternative):
        return False
    changes = alternative.changes
    written = [key for key in spec.model_fields_set if key in changes or key in alternative.unused]
    return all(key in changes and _is_same(getattr(spec, key), changes[key]) for key in written)


def written_of(spec: Any, alternatives: Sequence[Alternative]) -> list[str]:
    """Return the fields of a spec that are set and that some alternative would change."""
    changed = {key for alternative in alternatives for key in (*alternative.changes, *alternative.unused)}
    return sorted(key for key in spec.model_fields_set & changed if getattr(spec, key) is not None)


def _is_same(own: Any, value: Any) -> bool:
    return own == (tuple(value) if isinstance(value, list) else value)


def queried_objects(plan: Plan) -> tuple[str, ...]:
    """Return the objects of a plan that have surfaces other than primitives, whose distances a grid or triangles give."""
    results = []
    for part in plan.quantities.values():
        tables: Sequence[Any] = getattr(part, "geoms", ())
        for target, table in zip(plan.objects, tables, strict=False):
            if isinstance(table, GeomTable) and any(surface is not None for surface in table.surfaces):
                results.append(target.name)
    return tuple(dict.fromkeys(results))
