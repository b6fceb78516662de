"""Where a layout puts taxels on all its links, whatever sensors a document has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

from tgdsl.compiler.resolve import taxels_of_all_links
from tgdsl.errors import SpecError, TgdslError, did_you_mean
from tgdsl.layout.layout import Layout
from tgdsl.schema.load import load
from tgdsl.schema.placement import LayoutSpec
from tgdsl.sensors.known import known_kinds


def all_layouts(
    document: str | PathLike[str] | Mapping[str, Any], overrides: Mapping[str, Any], resolutions: Sequence[str] = ()
) -> tuple[LayoutSpec, dict[str, Layout]]:
    """Return a document's layout as written, and the taxels of all its links at some resolutions (default: all).

    Raises:
        SpecError: All mistakes in the document and its layout, with file, line and column.
        RobotError: If the robot cannot be read, or holds what is not supported.
        TgdslError: If the layout has no such resolution.
    """
    kinds = known_kinds(())
    loaded = load(document, overrides, kinds, needs_sensors=False)
    if loaded.layout is None:
        if loaded.is_without_layout:
            hint = "only a layout has taxels to write down"
            loaded.problems.append(loaded.problem(("robot",), 'missing key "layout"', hint, on_key=True))
        raise SpecError(loaded.problems)
    spec = loaded.layout.spec
    for name in resolutions:
        if name not in spec.resolutions:
            raise TgdslError(f'the layout has no resolution "{name}"; {did_you_mean(name, spec.resolutions, "resolutions")}')
    names = dict.fromkeys(resolutions or spec.resolutions)
    each = {name: load(document, {**overrides, "resolution": name}, kinds, needs_sensors=False) for name in names}
    return spec, {name: taxels_of_all_links(resolved) for name, resolved in each.items()}
