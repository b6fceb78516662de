"""The kinds that a document may use: those of tgdsl, those that installed packages bring, and those that a caller gives.

A package brings a kind by an entry point, in its pyproject.toml:

    [project.entry-points."tgdsl.kinds"]
    my_kind = "my_package.my_kind:MY_KIND"
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tgdsl.errors import LowerError, TgdslError, did_you_mean
from tgdsl.files.plugins import known
from tgdsl.quantities.base import Quantity
from tgdsl.quantities.known import known_quantities
from tgdsl.sensors import KINDS
from tgdsl.sensors.base import Kind, Lowered, SensorSpec

GROUP = "tgdsl.kinds"
"""Group of the entry points by which packages bring kinds."""


def known_kinds(given: Sequence[Kind] = ()) -> tuple[Kind, ...]:
    """Return all kinds: those of tgdsl, of installed packages by package and name, and those that are given.

    An installed kind that cannot be had is left out, with a warning, the first time.

    Args:
        given: Kinds of the caller's own. One that an installed package brings too may be among them.

    Raises:
        TgdslError: If two kinds have one name, or a kind that is given is none.
    """
    return known(GROUP, "sensor kind", "kinds", KINDS, given, _wrong)


def kinds_by_sensor(kinds: Sequence[Kind], wanted: Mapping[str, str]) -> dict[str, Kind]:
    """Return the kind of each sensor.

    Args:
        kinds: The kinds that there are.
        wanted: Names of the sensors' kinds, by those of the sensors.

    Raises:
        TgdslError: If there is no such kind.
    """
    known = {kind.name: kind for kind in kinds}
    for sensor, name in wanted.items():
        if name not in known:
            hint = did_you_mean(name, known, "kinds")
            raise TgdslError(f'sensor "{sensor}" is of kind "{name}", which is not given; {hint}')
    return {sensor: known[name] for sensor, name in wanted.items()}


def quantities_of(kinds: Sequence[Kind]) -> tuple[Quantity, ...]:
    """Return all quantities that kinds may ask for: those that are known, and those that kinds bring themselves.

    Raises:
        TgdslError: If two quantities have one name.
    """
    own = {id(quantity): quantity for kind in kinds for quantity in kind.quantities}
    return known_quantities(tuple(own.values()))


def check_lowered(kind: Kind, lowered: Lowered, spec: SensorSpec) -> None:
    """Refuse what a kind may not say of a sensor: names that readings need for something else, requests that contradict.

    Raises:
        TgdslError: With the kind and what is wrong.
        LowerError: If the document asks of a block what a block has not.
    """
    channels = [*lowered.channels, *(lowered.signal or ()), *(c for report in lowered.reports.values() for c in report)]
    if any(channel.name == "signal" for channel in channels):
        what = 'what `forward` returns as "signal" is all channels in one tensor'
        raise TgdslError(f'kind "{kind.name}" has a channel called "signal"; rename it: {what}')
    for name, what in (("signal", "the reading before its noise"), ("clean", "the reading without noise")):
        if name in lowered.reports:
            raise TgdslError(f'kind "{kind.name}" has a report called "{name}"; rename it: "<sensor>/{name}" is {what}')
    types = [type(request) for request in lowered.requests]
    if twice := [kind.__name__ for kind in types if types.count(kind) > 1]:
        raise TgdslError(f'kind "{kind.name}" makes the request {twice[0]} twice; expected at most one of each type')
    if (lowered.substeps or lowered.samples) and not (lowered.substeps and not kind.knobs and kind.decide is None):
        what = "a block of samples wants `substeps` above 0, `knobs=frozenset()` and no `decide`"
        raise TgdslError(f'kind "{kind.name}": {what}: noise, rates and thresholds are of single readings')
    if lowered.substeps and (spec.rate is not None or spec.history is not None):
        field = "rate" if spec.rate is not None else "history"
        raise LowerError("this sensor reads a block of samples at each call", field, f"leave `{field}` out")
    if lowered.substeps and lowered.reports:
        raise TgdslError(f'kind "{kind.name}" has reports and reads blocks; a block has none')


def _wrong(kind: object) -> str:
    """Return why something is no kind that a document can name, or nothing."""
    if not isinstance(kind, Kind):
        return f"found {type(kind).__name__}, expected a tgdsl.sensors.Kind"
    field = kind.spec.model_fields.get("kind")
    names = getattr(field and field.annotation, "__args__", ())
    if len(names) != 1 or not isinstance(names[0], str):
        return f'the spec {kind.spec.__name__} has no field `kind: Literal["its_name"]`'
    return ""
