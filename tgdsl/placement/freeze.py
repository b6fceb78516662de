"""A layout whose taxels are written down: the same links and groups, and a table of points for each resolution.

A number in a table is the shortest text that reads back as the same float64.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path

from tgdsl.fields.models import Selection
from tgdsl.layout.layout import Layout
from tgdsl.placement.propose.text import one_line, quoted
from tgdsl.placement.sample.sample import CELL, REQUIRED, TANGENT
from tgdsl.schema.placement import LayoutSpec

_HEADER = """\
# The taxels of {origin}, written by `tgdsl layout`: they no longer depend on the robot's meshes or on sampling.
# The tables next to this file hold one taxel per row, in the link's body frame, in metres; do not reorder the rows.
"""
_COLUMNS = ("link", *CELL, *REQUIRED, *TANGENT, "radius", "area")


def frozen_files(spec: LayoutSpec, layouts: Mapping[str, Layout], out: Path, origin: str) -> dict[Path, bytes]:
    tables = _table_names(layouts, out)
    files = {out.with_name(tables[name]): _table(layout).encode() for name, layout in layouts.items()}
    return {**files, out: _text(spec, layouts, tables, origin).encode()}


def _table_names(layouts: Mapping[str, Layout], out: Path) -> dict[str, str]:
    """Return the name of each resolution's table; characters that a file's name may lack are left out."""
    result: dict[str, str] = {}
    for name in layouts:
        stem = f"{out.stem}.{re.sub(r'[^A-Za-z0-9_-]', '_', name)}"
        taken = {other.lower() for other in result.values()}
        tries = (f"{stem}{suffix}.csv" for suffix in ("", *(f"_{i}" for i in range(2, len(layouts) + 2))))
        result[name] = next(file for file in tries if file.lower() not in taken)
    return result


def _table(layout: Layout) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for i in range(layout.num_taxels):
        cell = [str(n) for n in layout.cell[i].tolist()] if layout.cell[i].min() >= 0 else ["", ""]
        numbers = [*layout.pos[i], *layout.normal[i], *layout.tangent[i], layout.radius[i]]
        area = repr(float(layout.area[i])) if layout.area[i] > 0 else ""  # of a filler that covers nothing
        writer.writerow([layout.links[layout.link_id[i]].name, *cell, *(repr(float(number)) for number in numbers), area])
    return text.getvalue()


def _text(spec: LayoutSpec, layouts: Mapping[str, Layout], tables: Mapping[str, str], origin: str) -> str:
    lines = ["tgdsl: 1"]
    if spec.groups:
        lines += ["groups:", *(f"  {quoted(name)}: {_selection(group)}" for name, group in spec.groups.items())]
    lines.append("resolutions:")
    for name, layout in layouts.items():
        lines.append(f"  {quoted(name)}:  # {layout.num_taxels} taxels")
        entry = f"{{method: points, points: {quoted(tables[name])}}}"
        lines += [f"    {quoted(key)}: {entry}" for key in spec.resolutions[name]]
    return _HEADER.format(origin=one_line(origin)) + "\n".join(lines) + "\n"


def _selection(group: Selection) -> str:
    include = ", ".join(map(quoted, group.include))
    exclude = ", ".join(map(quoted, group.exclude))
    return f"{{include: [{include}], exclude: [{exclude}]}}" if exclude else f"[{include}]"
