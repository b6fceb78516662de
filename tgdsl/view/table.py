"""Readings as a table of text: one row per link, one column per sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from tgdsl.console.tables import TaxelTable
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.view.markers import THRESHOLDS, read_now


def outputs_on_taxels(touch: TactileModule) -> list[Output]:
    """Return the readings that have a place on the robot: of taxels, and of the bodies that carry them."""
    sensors = {sensor.sensor for sensor in touch.plan.sensors if len(sensor.taxels)}
    return [output for output in touch.outputs if output.rows in ("taxel", "body") and output.sensor in sensors]


def table(touch: TactileModule, readings: Mapping[str, Tensor], env: int = 0) -> list[str]:
    """Return the readings of one environment, link by link.

    Each reading has one column: force as the magnitude of the link's summed force, contact alone as the number of taxels in
    contact, any other channel or vector as the largest magnitude. Readings of bodies show the link's body. Readings with other
    rows, such as one per inertial sensor, follow with a line for each row; readings of joints and actuators are left out.
    """
    taxels = touch.taxels
    outputs = outputs_on_taxels(touch)
    links = list(dict.fromkeys(link for sensor in taxels.values() for link in sensor["link"]))
    units = ["taxels" if output.channels == ("contact",) else output.units[_first(output)] for output in outputs]
    header = ["link"] + [f"{output.name} [{unit}]" for output, unit in zip(outputs, units, strict=True)]
    rows = [[link] + [_cell(taxels[output.sensor], output, readings, link, env) for output in outputs] for link in links]
    lines = _aligned(header, rows) if outputs else []
    for output in (o for o in touch.outputs if o not in outputs and o.rows not in ("joint", "actuator")):
        lines += ([""] if lines else []) + _other_rows(touch.rows[output.name], output, readings, env)
    return lines


def _other_rows(table: TaxelTable, output: Output, readings: Mapping[str, Tensor], env: int) -> list[str]:
    """Return a reading with other rows: by the first column of its table, each channel of the last sample.

    Rows that share that column, such as the cells of a link, are one line: how many they are, the lowest and the highest.
    """
    first, *_ = table.dtype.names or ("row",)
    values = read_now(readings[output.name], env)
    channels = [f"{name} [{unit}]" for name, unit in zip(output.channels, output.units, strict=True)]
    names = list(dict.fromkeys(table[first].tolist()))
    if len(names) == len(table):
        rows = [[str(name), *_numbers(samples, output.units)] for name, samples in zip(names, values, strict=True)]
        return [output.name, *_aligned([output.rows, *channels], rows)]
    rows = []
    for name in names:
        samples = values[table[first] == name]
        ends = zip(_numbers(samples.min(axis=0), output.units), _numbers(samples.max(axis=0), output.units), strict=True)
        rows.append([str(name), str(len(samples)), *map(" … ".join, ends)])
    return [output.name, *_aligned([first, f"{output.rows}s", *channels], rows)]


def _numbers(values: np.ndarray, units: Sequence[str]) -> list[str]:
    return [f"{value:.2f}" if unit == "degC" else f"{value:.3g}" for value, unit in zip(values, units, strict=True)]


def _aligned(header: list[str], rows: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    header, *rows = [
        [text.rjust(width) if i else text.ljust(width) for i, (text, width) in enumerate(zip(row, widths, strict=True))]
        for row in [header, *rows]
    ]
    return ["  ".join(row) for row in (header, ["─" * width for width in widths], *rows)]


def _first(output: Output) -> int:
    """Return the first channel that is shown: the force where there is one, as beside the contact bit of `link_contact`."""
    return output.channels.index("force_x") if "force_x" in output.channels else 0


def _cell(taxels: TaxelTable, output: Output, readings: Mapping[str, Tensor], link: str, env: int) -> str:
    is_on_link = taxels["link"] == link
    if not is_on_link.any():
        return "–"
    values = read_now(readings[output.name], env)
    values = values[[output.bodies.index(taxels["body"][is_on_link][0])]] if output.rows == "body" else values[is_on_link]
    if output.channels == ("contact",):
        return f"{int(values.sum())}/{len(values)}"
    first = _first(output)
    if output.channels[first] == "force_x":
        return f"{np.linalg.norm(values[:, first : first + 3].sum(axis=0)):.3f}"
    is_vector = output.channels[0].endswith("_x")
    largest = np.linalg.norm(values[:, : 3 if is_vector else 1], axis=1).max()
    return f"{largest:.2e}" if largest > THRESHOLDS.get(output.units[0], 0.0) else "0"
