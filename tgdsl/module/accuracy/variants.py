"""The variants of a sensor that trade speed for error: what its kind says of its fields, and how its meshes are queried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from tgdsl.plan.plan import Plan
from tgdsl.quantities.geoms.tables import GeomTable
from tgdsl.sensors.base import Alternative, AnySensorSpec, Kind

BARE: Mapping[str, Any] = {"readout": "clean", "rate": None, "history": None}
"""Fields of a sensor without imperfections, so that two variants can be compared reading by reading."""


@dataclass(frozen=True, eq=False)
class Variant:
    """A way to compute a sensor.

    Attributes:
        label: What to call it.
        changes: What is other than in the document, by dotted path: `sensors.skin.operator`.
        is_own: Whether it is what the document says.
    """

    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    is_own: bool = False

    def joined(self, other: Variant) -> Variant:
        """Return the variant that has the changes of both."""
        return Variant(f"{self.label}, {other.label}", {**self.changes, **other.changes})


@dataclass(frozen=True)
class Variants:
    """The variants of a sensor, from coarse to fine; each changes one thing of the document.

    Attributes:
        own: What the document says.
        fields: Other choices of the sensor's fields.
        queries: Other ways to find distances to the meshes that it feels.
    """

    own: Variant
    fields: tuple[Variant, ...]
    queries: tuple[Variant, ...]


def bare(name: str) -> dict[str, Any]:
    """Return the changes that leave a sensor without imperfections and a document without observations."""
    return {"observations": "{}", **{f"sensors.{name}.{key}": value for key, value in BARE.items()}}


def variants_of(
    kind: Kind, name: str, spec: AnySensorSpec, queries: Mapping[str, Any], alternatives: Sequence[Alternative]
) -> Variants:
    """Return the variants of a sensor.

    Args:
        kind: Its kind.
        name: Its name.
        spec: Its fields.
        queries: Of the objects with meshes that it feels, their fields.
        alternatives: How distances to meshes may be found.
    """
    fields = _variants((f"sensors.{name}",), (spec,), kind.alternatives(spec))
    ways = _variants(tuple(f"objects.{own}" for own in queries), tuple(queries.values()), alternatives) if queries else ()
    labels = [variant.label for variant in (*fields, *ways) if variant.is_own]
    return Variants(Variant(", ".join(labels) or "as written", {}, True), fields, ways)


def _variants(paths: Sequence[str], specs: Sequence[Any], alternatives: Sequence[Alternative]) -> tuple[Variant, ...]:
    found = []
    for label, changes in alternatives:
        is_own = all(_is_same(getattr(spec, key), value) for spec in specs for key, value in changes.items())
        found.append(Variant(label, {f"{path}.{key}": value for path in paths for key, value in changes.items()}, is_own))
    return tuple(found)


def _is_same(own: Any, value: Any) -> bool:
    return own == (tuple(value) if isinstance(value, list) else value)


def queried_objects(plan: Plan) -> tuple[str, ...]:
    """Return the objects of a plan that have surfaces other than primitives, whose distances a grid or triangles give."""
    found = []
    for part in plan.quantities.values():
        tables: Sequence[Any] = getattr(part, "geoms", ())
        for target, table in zip(plan.objects, tables, strict=False):
            if isinstance(table, GeomTable) and any(surface is not None for surface in table.surfaces):
                found.append(target.name)
    return tuple(dict.fromkeys(found))
