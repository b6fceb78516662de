"""What all pictures share: resolution, colours, and how a figure begins and is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from tgdsl.files.write import atomic_open, with_folder

DPI = 100
SUPERSAMPLING = 2  # pixels that are rendered per pixel of the file, along each axis
INK, FAINT, REST = "#2b2f36", "#7b828c", "#d3d6da"
_HEAT = LinearSegmentedColormap.from_list("touch", matplotlib.colormaps["YlOrRd"](np.linspace(0.2, 0.93, 256)))
HEAT = _HEAT.with_extremes(under=REST, bad=(0, 0, 0, 0))  # from little to much; zero, and less, is grey
# from cold to warm, of even steps in lightness
WARMTH = LinearSegmentedColormap.from_list("warmth", matplotlib.colormaps["inferno"](np.linspace(0.2, 0.97, 256)))


# links with taxels, other links, objects: in pictures, and on the page, whose light is brighter
SENSING, OTHER, OBJECT = np.array([0.83, 0.84, 0.86]), np.array([0.60, 0.62, 0.66]), np.array([0.33, 0.55, 0.83])
LIVE_SENSING, LIVE_OTHER, LIVE_OBJECT = (176, 181, 190), (128, 134, 145), (60, 112, 186)
LIVE_REST = (62, 72, 88)  # of taxels on the page that read nothing
DISC_RADIUS = (0.0006, 0.0022)  # least and largest radius of a taxel's disc [m]


def new_figure(width: float, height: float, dpi: float = DPI, **options: Any) -> Figure:
    """Return a white figure of some inches that needs no display."""
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white", **options)
    FigureCanvasAgg(figure)
    return figure


def pixels_of(figure: Figure) -> UInt8[np.ndarray, "h w 3"]:
    """Return a figure as an image, row 0 at the top."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def shortened(name: str, letters: int) -> str:
    """Return a name, or its end if it has too many letters."""
    return name if len(name) <= letters else f"…{name[1 - letters :]}"


def save_figure(figure: Figure, path: Path, **options: Any) -> Path:
    """Write a figure as a PNG file, its folder made if need be; return the path."""
    with atomic_open(with_folder(path)) as file:
        figure.savefig(file, format="png", **options)
    return path
