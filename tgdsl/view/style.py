"""What all pictures share: resolution and colours."""

import matplotlib
import numpy as np
from matplotlib.colors import LinearSegmentedColormap

DPI = 100
SUPERSAMPLING = 2  # pixels that are rendered per pixel of the file, along each axis
INK, FAINT, REST = "#2b2f36", "#7b828c", "#d3d6da"
_HEAT = LinearSegmentedColormap.from_list("touch", matplotlib.colormaps["YlOrRd"](np.linspace(0.2, 0.93, 256)))
HEAT = _HEAT.with_extremes(under=REST, bad=(0, 0, 0, 0))  # from little to much; zero, and less, is grey
WARMTH = LinearSegmentedColormap.from_list("warmth", matplotlib.colormaps["inferno"](np.linspace(0.2, 0.97, 256)))
"""From cold to warm, of even steps in lightness."""
