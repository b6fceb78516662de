"""What users look at in a console, printed as tables: the same tuples, dictionaries and arrays as ever to code."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

MAX_ROWS = 20  # rows of a table that are shown; the rest is counted
_WIDTH = 110


def text_table(header: Sequence[str], rows: Iterable[Sequence[str]], more: int = 0) -> str:
    """Return rows of cells under their header, in aligned columns; `more` rows are left out and counted."""
    cells = [list(header), *map(list, rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    lines.insert(1, "  ".join("─" * width for width in widths))
    return "\n".join(lines + ([f"… and {more} more"] if more else []))


def listing(entries: Iterable[tuple[str, str]], indent: str = "  ") -> str:
    """Return names with their texts, wrapped to the right of the name."""
    entries = list(entries)
    width = max((len(name) for name, _ in entries), default=0) + 2
    lines = []
    for name, text in entries:
        wrapped = textwrap.wrap(text, _WIDTH - width, break_long_words=False, break_on_hyphens=False) or ["none"]
        lines += [indent + (name if not i else "").ljust(width) + part for i, part in enumerate(wrapped)]
    return "\n".join(lines)


def shapes(value: Any) -> str:
    """Return dtype and shape of a tensor, or of each tensor of a mapping by name; for anything else its type's name."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {shapes(part)}" for name, part in value.items())
    return f"{value.dtype} {tuple(value.shape)}".removeprefix("torch.") if hasattr(value, "dtype") else type(value).__name__


def with_units(channels: Sequence[str], units: Sequence[str]) -> str:
    """Return channels, each unit once after its last channel: `force_x, force_y, force_z [N]`."""
    parts = []
    for i, (channel, unit) in enumerate(zip(channels, units, strict=True)):
        is_last = i + 1 == len(units) or units[i + 1] != unit
        parts.append(f"{channel} [{unit}]" if is_last and unit != "1" else channel)
    return ", ".join(parts)


class Outputs(tuple[Any, ...]):
    """A tuple of `module.Output` that prints as a table, a row per reading."""

    def __repr__(self) -> str:
        rows = [
            (output.name, output.kind, f"(env, {', '.join(map(str, output.shape))})", with_units(output.channels, output.units))
            for output in self
        ]
        return text_table(("reading", "kind", "shape", "channels"), rows)


class Observations(dict[str, tuple[Any, ...]]):
    """A dictionary of observation groups' terms that prints as a table, a row per term."""

    def __repr__(self) -> str:
        each = [(group, term) for group, terms in self.items() for term in terms]
        rows = [(group, term.name, term.type, f"{term.slice.start}:{term.slice.stop}") for group, term in each]
        return text_table(("group", "term", "type", "features"), rows)


class TaxelTable(np.ndarray):
    """A structured array that prints as a table, a row per taxel; its columns are ordinary arrays."""

    def __getitem__(self, key: Any) -> Any:
        result = super().__getitem__(key)
        return result.view(np.ndarray) if isinstance(result, TaxelTable) and result.dtype.names is None else result

    def __repr__(self) -> str:
        names = self.dtype.names
        if names is None or self.ndim != 1:
            return repr(self.view(np.ndarray))
        shown_rows = self[:MAX_ROWS]
        rows = [(str(i), *(_cell(row[name]) for name in names)) for i, row in enumerate(shown_rows)]
        return text_table(("", *names), rows, len(self) - len(shown_rows))

    __str__ = __repr__


def _cell(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return " ".join(f"{round(part, 4) + 0.0:8.4f}" for part in value.tolist())
    return f"{value:.4g}" if isinstance(value, np.floating) else str(value)


class TaxelTables(dict[str, TaxelTable]):
    """A dictionary of taxel tables by sensor that prints a table of links, once for sensors on the same taxels."""

    def __repr__(self) -> str:
        alike: dict[bytes, list[str]] = {}
        for sensor, table in self.items():
            alike.setdefault(table.tobytes(), []).append(sensor)
        return "\n\n".join(f"{', '.join(sensors)}\n{_links(self[sensors[0]])}" for sensors in alike.values())


def _links(table: TaxelTable) -> str:
    """Return a row per link: its body, its number of taxels, their radius or range of radii, and their area."""
    rows = []
    for link in dict.fromkeys(table["link"].tolist()):
        link_rows = table[table["link"] == link]
        radii = link_rows["radius"][link_rows["radius"] > 0]
        ends = dict.fromkeys(f"{1e3 * end:.3g}" for end in (radii.min(), radii.max())) if len(radii) else ["0"]
        rows.append((link, link_rows["body"][0], str(len(link_rows)), "–".join(ends), f"{1e6 * link_rows['area'].sum():.4g}"))
    return text_table(("link", "body", "taxels", "radius [mm]", "area [mm²]"), rows)


def spelled(value: Any) -> str:
    """Return a field as text: names joined by commas, pairs as `link – object`, mappings as `key: value`."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {spelled(part)}" for key, part in value.items())
    if isinstance(value, tuple):
        return ", ".join(map(spelled, value))
    return f"{value.link} – {value.object}" if hasattr(value, "link") else str(value)
