"""A page per kind: its docstring, parameters, readings, noise, and cost where it was measured."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tgdsl
from tgdsl.sensors import KINDS
from tgdsl.sensors.base import Kind
from tgdsl.sensors.noise import Knobs
from tgdsl_docs.accuracy import Accuracy
from tgdsl_docs.links import ROOT
from tgdsl_docs.tables import fields_table, inline, split_unit, table

EXAMPLE = "examples/every_sensor.yaml"
"""The document whose sensors are the pages' examples; it has every kind."""
MEASURED = "docs/measured/gpu_h200.json"
"""Timings of the module alone: see docs/background/performance.md."""
ENVS, TAXELS = 16384, 100
"""Size of the rows with the cost; kinds per body have one body."""


def kind_pages(source: Path, accuracy: Accuracy) -> dict[str, str]:
    """Return a page per kind with its plot, and an index with what each measures and costs.

    Args:
        source: Folder of the pages.
        accuracy: Comparisons with closed forms.

    Raises:
        ValueError: If the example lacks a kind.
    """
    blocks, outputs = _examples()
    if lacking := [kind.name for kind in KINDS if kind.name not in blocks]:
        raise ValueError(f"{EXAMPLE}: found no sensor of kind {', '.join(lacking)}, expected one of each kind")
    measured = json.loads((ROOT / MEASURED).read_text(encoding="utf-8"))
    pages = {
        f"kinds/{kind.name}.md": _page(kind, blocks[kind.name], outputs, measured, source)
        + f"\n## Accuracy\n\n{accuracy.section(kind.name)}"
        for kind in KINDS
    }
    pages |= {f"kinds/accuracy_{kind.name}.svg": accuracy.plot(kind.name) for kind in KINDS if accuracy.of(kind.name)}
    return {"kinds/index.md": _index(outputs, measured)} | pages


def _examples() -> tuple[dict[str, str], list[Any]]:
    """Return the lines of the first sensor of each kind in the example, and the outputs of all."""
    text = (ROOT / EXAMPLE).read_text(encoding="utf-8")
    sensors = text.split("\nsensors:\n")[1].split("\n\n")[0]
    blocks: dict[str, str] = {}
    for block in re.split(r"\n(?=  \S)", sensors):
        kind = re.search(r"\bkind: (\w+)", block)
        if kind:
            blocks.setdefault(kind[1], block)
    return blocks, list(tgdsl.compile(ROOT / EXAMPLE).outputs)


def _index(outputs: list[Any], measured: Mapping[str, Any]) -> str:
    rows = []
    for kind in KINDS:
        about = inline((kind.spec.__doc__ or "").strip().splitlines()[0])
        costs = _rows(kind, measured)
        cost = (f"{costs[0]['graph']:.3f}", f"{costs[0]['error']:.0e}") if costs else ("", "")
        rows.append((f"[`{kind.name}`]({kind.name}.md)", about, "; ".join(_channels(kind, outputs)), *cost))
    header = ("kind", "what it measures", "channels of the example", f"ms, {ENVS:,} × {TAXELS}", "float32 error")
    names = "\n".join(kind.name for kind in KINDS)
    return (
        "# Sensor kinds\n\n[Which kind to use](../../start/which-kind.md) compares them. The channels are from "
        f"[every_sensor.yaml](../../../{EXAMPLE}).\n\n{table(header, rows)}\n{_about_cost(measured)}\n\n"
        f"```{{toctree}}\n:hidden:\n\n{names}\n```\n"
    )


def _about_cost(measured: Mapping[str, Any]) -> str:
    return (
        f"Time: one call of the module in graph replay on one {measured['device']}, {ENVS:,} environments of {TAXELS} taxels "
        "(`link_contact`: of one body), one object, no noise. Error: 99.9 % quantile of float32 against float64, relative to "
        "the channel's largest magnitude. [Performance](../../background/performance.md) has the method and all rows; a kind "
        "without numbers has no row there."
    )


def _page(kind: Kind, block: str, outputs: list[Any], measured: Mapping[str, Any], source: Path) -> str:
    module = sys.modules[kind.spec.__module__]
    package = sys.modules[kind.forward.__module__]
    about = package.__doc__ or module.__doc__ or ""
    path = f"{package.__name__.replace('.', '/')}.py"
    schema = kind.spec.model_json_schema()
    fields, inherited = _fields(kind)
    picture = f"images/gallery/kind_{kind.name}.png"
    image = f"![A reading of this kind](../../{picture})\n\n" if (source / picture).is_file() else ""
    parts = [
        f"# `{kind.name}`\n\n{image}{_body(about, kind)}\n",
        f"Defined in [{path}](../../../{path}), with a float64 reference.\n{_mentions(kind, source)}",
        f"\n## Example\n\nFrom [every_sensor.yaml](../../../{EXAMPLE}):\n\n```yaml\nsensors:\n{block}\n```\n",
        table(("reading", "shape", "channels"), _readings(kind, outputs)),
        f"\n## Parameters\n\n{fields_table(schema, fields, _link) if fields else 'This kind adds no parameters.'}",
        f"\n## Parameters shared with other kinds\n\n{fields_table(schema, inherited, _link)}",
        f"\n## Noise\n\n{_noise(kind)}",
        f"\n## Cost\n\n{_cost(kind, measured)}",
    ]
    return "\n".join(parts)


def _link(name: str) -> str:
    return f"[{name}](../grammar/document.md#documents-{name.lower()})"


def _body(text: str, kind: Kind) -> str:
    """Return a module's docstring as Markdown, with links to other kinds."""
    names = {other.name for other in KINDS} - {kind.name}
    blocks = []
    for block in text.strip().split("\n\n"):
        if not block.startswith("    "):
            block = re.sub(r"^(Source|Departures|Limits)\b", r"**\1**", inline(block))
            block = re.sub(r"`(\w+)`", lambda m: f"[`{m[1]}`]({m[1]}.md)" if m[1] in names else m[0], block)
        else:
            lines = [re.sub(r" {3,}(?=\[[^\]]*\]$)", "   ", line[4:]) for line in block.splitlines()]  # units near the equation
            block = "```text\n" + "\n".join(lines) + "\n```"
        blocks.append(block)
    return "\n\n".join(blocks)


def _mentions(kind: Kind, source: Path) -> str:
    """Return links to the pages that name the kind at least twice."""
    pages = sorted(page for folder in ("how-to", "background") for page in (source / folder).glob("*.md"))
    mentions = [page for page in pages if page.read_text(encoding="utf-8").count(f"`{kind.name}`") >= 2]
    links = ", ".join(f"[{page.stem}](../../{page.parent.name}/{page.name})" for page in mentions)
    return f"More: {links}.\n" if links else ""


def _fields(kind: Kind) -> tuple[list[str], list[str]]:
    """Return the names of the kind's fields, without and with inheritance."""
    names = [name for name in kind.spec.model_fields if name != "kind"]
    above = {name for base in kind.spec.__mro__[1:] for name in getattr(base, "model_fields", ())}
    return [name for name in names if name not in above], [name for name in names if name in above]


def _readings(kind: Kind, outputs: list[Any]) -> list[tuple[str, str, str]]:
    rows = []
    for output in outputs:
        if output.kind == kind.name:
            shape = ", ".join(map(str, output.shape))
            rows.append((f"`{output.name}`", f"(env, {shape}), a row per {output.rows}", _named(output)))
    return rows


def _named(output: Any) -> str:
    pairs = zip(output.channels, output.units, strict=True)
    return ", ".join(f"`{name}`" + (f" [{unit}]" if unit != "1" else "") for name, unit in pairs)


def _channels(kind: Kind, outputs: list[Any]) -> list[str]:
    return [_named(output) for output in outputs if output.kind == kind.name and "/" not in output.name]


def _noise(kind: Kind) -> str:
    knobs = [name for name in Knobs.model_fields if name in kind.knobs]
    rows = []
    for name in knobs:
        meaning, unit = split_unit(Knobs.model_fields[name].description or "")
        idle = " Has no effect on this kind." if name in kind.idle_knobs else ""
        rows.append((f"`{name}`", unit, inline(meaning) + idle))
    about = "[Noise and time](../../background/noise.md) has equations and order."
    return f"{table(('knob', 'unit', 'meaning'), rows)}\n{about}\n" if rows else "None.\n"


def _rows(kind: Kind, measured: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [
        row
        for row in measured["rows"]
        if row["kind"] == kind.name
        and row["num_envs"] == ENVS
        and row["num_taxels"] in {TAXELS, 1}
        and row["num_objects"] == 1
        and row["noise"] == "clean"
    ]


def _cost(kind: Kind, measured: Mapping[str, Any]) -> str:
    rows = [
        (row["case"], f"{row['graph']:.4f}", f"{row['error']:.0e}", f"{row['per_taxel']:.1f}") for row in _rows(kind, measured)
    ]
    if not rows:
        return "Not among the rows of [performance](../../background/performance.md).\n"
    header = ("row", "graph, ms", "float32 error", "bytes per taxel and environment")
    return f"{table(header, rows)}\n{_about_cost(measured)}\n"
