"""Heat maps of the live page: one for each link, its distal end up, grids as cells and scattered taxels as dots.

Shapes: `taxel` taxels of one sensor, `h` and `w` rows and columns of pixels.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from scipy.spatial import KDTree

from tgdsl.console.tables import TaxelTable
from tgdsl.view.picture import distal, short_names, turned
from tgdsl.view.raster import unit
from tgdsl.view.style import DPI, INK, new_figure

Array = np.ndarray
WIDTH = 340  # columns of pixels of all maps together
_TITLE, _MARGIN = 16, 4  # rows of a map's title, and pixels around a map


class HeatMaps:
    """Maps of all links that carry taxels, as one image."""

    def __init__(self, model: mujoco.MjModel, table: TaxelTable):
        links = list(dict.fromkeys(table["link"].tolist()))
        columns = math.ceil(math.sqrt(len(links)))
        side = WIDTH // columns
        room = side - 2 * _MARGIN
        rows = -(-len(links) // columns)
        self._taxel: Int[Array, "h w"] = np.full((rows * (side + _TITLE), columns * side), -1)
        figure = new_figure(self._taxel.shape[1] / DPI, self._taxel.shape[0] / DPI)
        for i, (link, name) in enumerate(short_names(links).items()):
            row, column = divmod(i, columns)
            top, left = row * (side + _TITLE), column * side
            chosen = np.flatnonzero(table["link"] == link)
            along, _ = distal(model, str(table["body"][chosen[0]]), table["pos"][chosen])
            map_ = _map_of(table[chosen], along, room)
            first = top + _TITLE + _MARGIN + (room - len(map_)) // 2, left + _MARGIN + (room - map_.shape[1]) // 2
            pixels = self._taxel[first[0] : first[0] + len(map_), first[1] : first[1] + map_.shape[1]]
            pixels[:] = np.where(map_ >= 0, chosen[map_], -1)
            height, width = self._taxel.shape
            letters = side // 6
            text = name if len(name) <= letters else f"…{name[1 - letters :]}"
            x, y = (left + side / 2) / width, 1 - (top + _TITLE / 2) / height
            figure.text(x, y, text, size=6.5, color=INK, ha="center", va="center")
        canvas = figure.canvas
        assert isinstance(canvas, FigureCanvasAgg)
        canvas.draw()
        self._blank = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        self._drawn = self._taxel >= 0

    def image(self, colour: UInt8[Array, "taxel 3"]) -> UInt8[Array, "h w 3"]:
        """Return the maps with taxels in these colours."""
        result = self._blank.copy()
        result[self._drawn] = colour[self._taxel[self._drawn]]
        return result


def _map_of(table: TaxelTable, along: Float[Array, " 3"], room: int) -> Int[Array, "h w"]:
    """Return which taxel of a link each pixel of its map shows, -1 for none; the map has at most `room` pixels a side."""
    active = table["radius"] > 0
    across, quarters = turned(table, along)
    normal = unit(table["normal"].mean(axis=0), table["normal"][0])
    places = table["pos"] @ np.stack([across, np.cross(normal, across)], axis=1)
    if (table["row"] >= 0).all():
        cells = np.full((table["row"].max() + 1, table["column"].max() + 1), -1)
        cells[table["row"][active], table["column"][active]] = np.flatnonzero(active)
        pitch = np.ptp(places, axis=0)[::-1] / np.maximum(np.array(cells.shape) - 1, 1)
        pitch = np.where(pitch > 0, pitch, pitch.max() or 1.0)  # of a single row or column there is no pitch
        size = pitch * cells.shape
        if quarters % 2:
            size = size[::-1]
        cells = np.rot90(cells, quarters)
        height, width = np.maximum(1, np.floor(room * size / size.max())).astype(int)
        row, column = np.arange(height) * len(cells) // height, np.arange(width) * cells.shape[1] // width
        return cells[row[:, None], column]
    low, high = places.min(axis=0), places.max(axis=0)
    apart = KDTree(places).query(places, k=min(2, len(places)))[0].reshape(len(places), -1)[:, -1]
    reach = 0.5 * float(np.median(apart)) or 1e-3
    pixel = float((high - low + 2 * reach).max()) / room
    width, height = np.maximum(1, np.floor((high - low + 2 * reach) / pixel)).astype(int)
    x, y = np.meshgrid(low[0] - reach + pixel * (np.arange(width) + 0.5), high[1] + reach - pixel * (np.arange(height) + 0.5))
    distance, taxel = KDTree(places[active]).query(np.stack([x, y], axis=-1))
    return np.where(distance < reach, np.flatnonzero(active)[taxel], -1)
