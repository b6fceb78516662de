"""Where a sensor's taxels are, for users: as a table, and as images of those on grids.

Shapes: `env` environments, `taxel` taxels of one sensor, `channel` numbers per taxel, `row`, `column` cells of a link's grid.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.console.tables import TaxelTable
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.layout.layout import Layout
from tgdsl.module.memory.history import last_step
from tgdsl.plan.plan import Plan


def taxel_table(layout: Layout) -> TaxelTable:
    """Return a layout as a NumPy structured array that prints as a table, a row per taxel.

    Columns: `link`, `body`, `pos` and `normal` and `tangent` (body frame), `radius` [m], `area` [m²], `row`, `column` (−1 where
    there is no grid), `groups` (names joined by commas).
    """
    groups = [",".join(g for g, members in layout.groups.items() if link.name in members) for link in layout.links]
    columns: list[tuple[str, Any]] = [
        ("link", np.array([link.name for link in layout.links])[layout.link_id]),
        ("body", np.array([link.body for link in layout.links])[layout.link_id]),
        ("pos", layout.pos),
        ("normal", layout.normal),
        ("tangent", layout.tangent),
        ("radius", layout.radius),
        ("area", layout.area),
        ("row", layout.cell[:, 0]),
        ("column", layout.cell[:, 1]),
        ("groups", np.array(groups)[layout.link_id]),
    ]
    table = np.empty(layout.num_taxels, dtype=[(name, column.dtype, column.shape[1:]) for name, column in columns])
    for name, column in columns:
        table[name] = column
    return table.view(TaxelTable)


def row_tables(plan: Plan) -> dict[str, TaxelTable]:
    """Return what the rows of each reading of a sensor are: of taxels `taxel_table`, else what its kind declares."""
    result = {}
    for sensor in plan.sensors:
        for reading, axis in zip(sensor.readings, sensor.axes, strict=True):
            if axis.name == "taxel":
                result[reading.name] = taxel_table(plan.layout_of(sensor))
                continue
            columns = [(name, np.array(texts)) for name, texts in axis.texts.items()] + list(axis.numbers.items())
            dtype: list[Any] = [(name, column.dtype, column.shape[1:]) for name, column in columns]
            table = np.empty(axis.size, dtype=dtype or [("row", np.int64)])
            for name, column in columns or [("row", np.arange(axis.size))]:
                table[name] = column
            result[reading.name] = table.view(TaxelTable)
    return result


def images_of(
    plan: Plan, name: str, readings: Mapping[str, Tensor]
) -> tuple[dict[str, Float[Tensor, "env channel row column"]], dict[str, Bool[Tensor, "row column"]]]:
    """Return a reading of taxels as one image per link, and where its pixels are taxels: see `TactileModule.images`."""
    owner = {r.name: sensor for sensor in plan.sensors for r in sensor.readings if r.rows == "taxel"}
    if name not in owner:
        raise TgdslError(f'there is no reading of taxels "{name}"; {did_you_mean(name, owner, "readings of taxels")}')
    if not isinstance(readings, Mapping):
        raise TgdslError(f"found a {type(readings).__name__}, expected readings by name, as a call of the module returns them")
    by_channel = last_step(readings[name]).transpose(1, 2)
    images, masks = {}, {}
    for link, index in image_indices(plan.layout_of(owner[name])).items():
        place = torch.from_numpy(index).to(by_channel.device)
        masks[link] = place >= 0
        images[link] = torch.where(masks[link], by_channel[:, :, place.clamp(min=0)], 0.0)
    return images, masks


def image_indices(layout: Layout) -> Mapping[str, Int[np.ndarray, "row column"]]:
    """Return which taxel is in which cell of its link's grid, by link; −1 where there is none.

    Inactive fillers (radius 0) are none. Links whose taxels are on no grid are left out.

    Raises:
        TgdslError: If no link's taxels are on a grid.
    """
    result: dict[str, np.ndarray] = {}
    for i, link in enumerate(layout.links):
        link_rows = np.flatnonzero(layout.link_id == i)
        rows, columns = layout.cell[link_rows].T
        if (rows < 0).any():
            continue
        image = np.full((rows.max() + 1, columns.max() + 1), -1, dtype=np.int64)
        image[rows, columns] = np.where(layout.radius[link_rows] > 0, link_rows, -1)
        result[link.name] = image
    if not result:
        names = ", ".join(link.name for link in layout.links)
        raise TgdslError(f"no image without a grid: the taxels of {names} are not laid out with `method: grid`")
    return result
