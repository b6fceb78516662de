"""Readings as a table of text: one row per link, one column per sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from tgdsl.console.tables import TaxelTable
from tgdsl.module.memory import last_step
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.view.markers import THRESHOLDS


def outputs_on_taxels(touch: TactileModule) -> list[Output]:
    """Return the readings of taxels, and of the bodies that carry them: those that have a place on the robot."""
    sensors = {sensor.sensor for sensor in touch.plan.sensors if len(sensor.taxels)}
    return [output for output in touch.outputs if output.rows in ("taxel", "body") and output.sensor in sensors]


def table(touch: TactileModule, readings: Mapping[str, Tensor], env: int = 0) -> list[str]:
    """Return the readings of one environment, link by link.

    Each reading has one column: force as the magnitude of the link's summed force, depth as its largest, contact as the number
    of taxels in contact; any other vector, and any other channel, as the largest magnitude. Readings of bodies show the
    link's body. Readings with rows of their own, such as one per inertial sensor, follow with a line for each row; those of
    joints and actuators are left out.
    """
    taxels = touch.taxels
    outputs = outputs_on_taxels(touch)
    links = list(dict.fromkeys(link for sensor in taxels.values() for link in sensor["link"]))
    header = ["link"] + [f"{output.name} [{_summary_unit(output)}]" for output in outputs]
    rows = [[link] + [_cell(taxels[output.sensor], output, readings, link, env) for output in outputs] for link in links]
    lines = _aligned(header, rows) if outputs else []
    for output in (own for own in touch.outputs if own not in outputs and own.rows not in ("joint", "actuator")):
        lines += ([""] if lines else []) + _own_rows(touch.rows[output.name], output, readings, env)
    return lines


def _own_rows(table: TaxelTable, output: Output, readings: Mapping[str, Tensor], env: int) -> list[str]:
    """Return a reading with rows of its own: by the first column of its table, each channel of the last sample."""
    first, *_ = table.dtype.names or ("row",)
    values = last_step(readings[output.name])[env].detach().cpu().double().numpy()
    channels = [f"{name} [{unit}]" for name, unit in zip(output.channels, output.units, strict=True)]
    names = list(dict.fromkeys(table[first].tolist()))
    if len(names) < len(table):
        rows = [_span_row(str(name), values[table[first] == name], output.units) for name in names]
        return [output.name, *_aligned([first, f"{output.rows}s", *channels], rows)]
    rows = [
        [str(row[first]), *(_number(n, unit) for n, unit in zip(own, output.units, strict=True))]
        for row, own in zip(table, values, strict=True)
    ]
    return [output.name, *_aligned([output.rows, *channels], rows)]


def _span_row(name: str, values: np.ndarray, units: Sequence[str]) -> list[str]:
    ends = zip(values.min(axis=0), values.max(axis=0), units, strict=True)
    return [name, str(len(values)), *(f"{_number(low, unit)} … {_number(high, unit)}" for low, high, unit in ends)]


def _number(number: float, unit: str) -> str:
    return f"{number:.2f}" if unit == "degC" else f"{number:.3g}"


def _aligned(header: list[str], rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [
        "  ".join(text.ljust(w) if i == 0 else text.rjust(w) for i, (text, w) in enumerate(zip(row, widths, strict=True)))
        for row in [header, *rows]
    ]
    return [lines[0], "  ".join("─" * width for width in widths), *lines[1:]]


def _summary_unit(output: Output) -> str:
    return "taxels" if output.channels == ("contact",) else output.units[0]


def _cell(taxels: TaxelTable, output: Output, readings: Mapping[str, Tensor], link: str, env: int) -> str:
    own = taxels["link"] == link
    if not own.any():
        return "–"
    values = last_step(readings[output.name])[env].detach().cpu().double().numpy()
    values = values[[output.bodies.index(taxels["body"][own][0])]] if output.rows == "body" else values[own]
    if output.channels == ("contact",):
        return f"{int(values.sum())}/{len(values)}"
    if output.channels[:3] == ("force_x", "force_y", "force_z"):
        return f"{np.linalg.norm(values[:, :3].sum(axis=0)):.3f}"
    is_vector = output.channels[0].endswith("_x")
    largest = np.linalg.norm(values[:, : 3 if is_vector else 1], axis=1).max()
    return f"{largest:.2e}" if largest > THRESHOLDS.get(output.units[0], 0.0) else "0"
