"""Pictures of a hand and its taxels: one panel per resolution, taxels as discs that lie on the surface, coloured by link group.

A disc is drawn in its taxel's tangent plane and carries a tick along the normal, so that a normal that is not the surface's
shows.

Shapes: `taxel` taxels of one layout, `corner` corners of a disc, `h` and `w` rows and columns of pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from tgdsl.errors import FileError
from tgdsl.files.write import check_writable
from tgdsl.layout.layout import Layout, Unfelt, unfelt_ids
from tgdsl.view.cameras import ViewError, angles_of, camera_of, pose_of
from tgdsl.view.markers import Taxels, is_visible, taxels_of
from tgdsl.view.meshes import mesh_of, robot_bodies
from tgdsl.view.raster import Fragments, Mesh, Viewport, downsample, light_direction, rasterise, shade, viewport_for
from tgdsl.view.scene import draw_image, draw_scale_bar
from tgdsl.view.style import DISC_RADIUS, FAINT, INK, new_figure, save_figure

Array = np.ndarray
COLOURS = ("#0f7fb8", "#e8871e", "#c2315b", "#3a9d5d", "#7a55b0", "#8c6d46", "#d4b106", "#4f5d75")
HEIGHT = 750  # default number of rows of the file
MIN_SIZE = 200  # columns and rows that a file has at least
_INCHES = 6.0  # the figure's height, whatever its pixels: text scales with it
_HEAD, _FOOT, _GAP = 0.085, 0.085, 0.03  # parts of the figure's height
_SUPERSAMPLING = 3  # pixels rendered per pixel of the file, along each axis
_SURFACE = np.array([0.91, 0.92, 0.94])
_CROSS = "#d40000"
_DIAGONALS = np.array([[3, 15], [9, 21]])  # corners of a disc of 24 that lie opposite each other
_AMBIENT_OCCLUSION = ((0.004, 12.0), (0.012, 6.0))  # width [m] of hollows, and how much darker per metre of depth


def render(model: mujoco.MjModel, layouts: Mapping[str, Layout], out: Path, **options: Any) -> Path:
    """Write `drawing` as a PNG file; return the path. A file that cannot be written is a `ViewError`."""
    try:
        check_writable(out)
        return save_figure(drawing(model, layouts, **options), out)
    except FileError as error:
        raise ViewError(f"cannot write {error}") from error


def drawing(
    model: mujoco.MjModel,
    layouts: Mapping[str, Layout],
    *,
    keyframe: str | None = None,
    view: str = "front",
    size: tuple[int, int] | None = None,
    unfelt: Mapping[str, Sequence[Unfelt]] | None = None,
) -> Figure:
    """Draw the taxels of one layout or more on the robot that has them.

    Args:
        model: The robot, or a scene with it.
        layouts: What to draw, by the title of its panel.
        keyframe: Name of the model's keyframe that gives the pose; default: the model's own initial state.
        view: One of `cameras.VIEWS`, or azimuth and elevation in degrees. In `front` the taxels' mean normal points at the
            camera, or nearly so.
        size: Columns and rows of the file; default: `HEIGHT` rows and as many columns as the hand needs.
        unfelt: Taxels of each panel that cannot feel: they are crossed out.

    Raises:
        ViewError: If there is no such keyframe or view, or there is nothing to draw.
    """
    angles_of(view)
    if not any((layout.radius > 0).any() for layout in layouts.values()):
        raise ViewError("there is nothing to draw: no layout has a taxel")
    if size is not None and min(size) < MIN_SIZE:
        raise ViewError(f"a picture of {size[0]} × {size[1]} pixels is too small, expected at least {MIN_SIZE} of each")
    pose = pose_of(model, keyframe)
    taxels = [taxels_of(model, pose, layout) for layout in layouts.values()]
    links = [link for layout in layouts.values() for link in layout.links]
    framed, robot = robot_bodies(model, {model.body(link.body).id for link in links})
    camera = camera_of(view, model, list(layouts.values()), pose, min(framed))
    hand = mesh_of(model, pose, robot, links)
    points = [hand.corners[np.isin(hand.body, list(framed))].reshape(-1, 3), *(each.pos for each in taxels)]
    box = _box(camera.project(np.concatenate(points))[:, :2])
    width, height = size or _natural_size(box, len(layouts))
    rows, columns = round(height * (1 - _HEAD - _FOOT)), int((width - _GAP * height) / len(layouts) - _GAP * height)
    viewport = viewport_for(camera, box, _SUPERSAMPLING * columns, _SUPERSAMPLING * rows)
    fragments = rasterise(viewport.project(hand.corners), viewport.width, viewport.height)
    image = _image(hand, fragments, viewport)
    figure = new_figure(width / height * _INCHES, _INCHES, dpi=height / _INCHES)
    for i, (name, layout) in enumerate(layouts.items()):
        left = _GAP * height + i * (columns + _GAP * height)
        axes = figure.add_axes((left / width, _FOOT, columns / width, rows / height), label=name)
        draw_image(axes, image, viewport)
        crossed = unfelt_ids((unfelt or {}).get(name, ()))
        _draw_taxels(axes, layout, taxels[i], viewport, fragments, crossed)
        _draw_captions(axes, name, layout, len(crossed))
    draw_scale_bar(figure.axes[0], viewport, 1.03 * viewport.height)
    return figure


def _box(points: Float[Array, "point 2"]) -> Float[Array, "2 2"]:
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.015 * (high - low).max()
    return np.stack([low - margin, high + margin])


def _natural_size(box: Float[Array, "2 2"], panels: int) -> tuple[int, int]:
    across, up = box[1] - box[0]
    columns = HEIGHT * (1 - _HEAD - _FOOT) * np.clip(across / up, 0.75, 3.0)
    return round(panels * columns + (panels + 1) * _GAP * HEIGHT), HEIGHT


def _image(hand: Mesh, fragments: Fragments, viewport: Viewport) -> Float[Array, "h w 3"]:
    """Return the hand alone: lit, with hollows darkened by their depth below the surrounding surface."""
    image = np.ones((viewport.height, viewport.width, 3))
    colour = np.broadcast_to(_SURFACE, (len(hand.body), 3))
    image = downsample(shade(image, fragments, hand, colour, viewport), _SUPERSAMPLING)
    near = fragments.nearness[_SUPERSAMPLING // 2 :: _SUPERSAMPLING, _SUPERSAMPLING // 2 :: _SUPERSAMPLING]
    is_hand = np.isfinite(near)
    near = np.where(is_hand, near, near[is_hand].min())
    for width, amount in _AMBIENT_OCCLUSION:
        behind = gaussian_filter(near, width * viewport.scale / _SUPERSAMPLING) - near
        image *= np.where(is_hand, 1 - np.clip(amount * behind, 0, 0.35), 1)[..., None]
    return image


def _draw_taxels(
    axes: Axes, layout: Layout, taxels: Taxels, viewport: Viewport, fragments: Fragments, crossed: Int[Array, " unfelt"]
) -> None:
    """Draw visible taxels as discs with a tick along the normal, far ones first, and hidden taxels as faint rings."""
    at = viewport.project(taxels.pos)
    seen, active = is_visible(taxels, at, fragments, viewport.camera), taxels.size > 0
    radius = radii(layout, taxels.pos)
    rims = viewport.project(discs(taxels, radius))[..., :2]
    ends = viewport.project(taxels.pos + 2.0 * radius[:, None] * taxels.normal)
    groups = group_of(layout)
    names = list(dict.fromkeys(groups))
    colour = np.array([to_rgb(COLOURS[names.index(group) % len(COLOURS)]) for group in groups])[layout.link_id]
    lit = np.minimum(colour * (0.72 + 0.33 * np.clip(taxels.normal @ light_direction(viewport.camera), 0, 1))[:, None], 1)
    order = np.argsort(at[:, 2], kind="stable")
    visible, hidden = (order[(mask & active)[order]] for mask in (seen, ~seen))
    rings = [(*rgb, 0.3) for rgb in colour[hidden]]
    axes.add_collection(PolyCollection(list(rims[hidden]), fc="none", ec=rings, lw=0.5, zorder=3, gid="hidden"))
    axes.add_collection(PolyCollection(list(rims[visible]), fc=list(lit[visible]), ec="white", lw=0.35, zorder=4, gid="shown"))
    ticks = list(np.stack([at[visible, :2], ends[visible, :2]], axis=1))
    axes.add_collection(LineCollection(ticks, colors=list(0.45 * colour[visible]), lw=0.6, zorder=5, gid="normals"))
    if len(crossed):
        ends = rims[np.repeat(crossed, 2)[:, None], np.tile(_DIAGONALS, (len(crossed), 1))]
        colours = [(*to_rgb(_CROSS), 1.0 if is_seen else 0.3) for is_seen in np.repeat(seen[crossed], 2)]
        axes.add_collection(LineCollection(list(ends), colors=colours, lw=1.0, zorder=6, gid="unfelt"))


def _draw_captions(axes: Axes, name: str, layout: Layout, num_crossed: int) -> None:
    """Write the panel's name and its number of taxels above it, and the number of each group below."""
    count, fillers = int((layout.radius > 0).sum()), int((layout.radius == 0).sum())
    counts = f"{count} taxels" + (f" and {fillers} inactive" if fillers else "")
    title = TextArea(name, textprops={"size": 12, "weight": "bold", "color": INK})
    line = HPacker(children=[title, TextArea(counts, textprops={"size": 12, "color": FAINT})], pad=0, sep=8, align="baseline")
    place = {"bbox_to_anchor": (0.5, 1.0), "bbox_transform": axes.transAxes, "borderpad": 0.5, "pad": 0.0}
    axes.add_artist(AnchoredOffsetbox("lower center", child=line, frameon=False, **place))
    handles = [
        Line2D([], [], marker="o", linestyle="", markersize=6, color=COLOURS[i % len(COLOURS)], label=f"{label} {number}")
        for i, (label, number) in enumerate(legend(layout).items())
    ]
    if num_crossed:
        handles.append(Line2D([], [], marker="x", linestyle="", color=_CROSS, label=f"cannot feel {num_crossed}"))
    style = {"frameon": False, "handletextpad": 0.1, "columnspacing": 1.1, "fontsize": 10, "labelcolor": INK}
    columns = len(handles) if len(handles) <= 3 else -(-len(handles) // 2)
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.005), ncols=columns, **style)


def radii(layout: Layout, pos: Float[Array, "taxel 3"]) -> Float[Array, " taxel"]:
    """Return the radius of each disc [m]: the same on a link, and small enough to leave room between neighbours."""
    radius = np.full(len(pos), DISC_RADIUS[1])
    for link in range(len(layout.links)):
        members = np.flatnonzero(layout.link_id == link)
        if len(members) > 1:
            apart = KDTree(pos[members]).query(pos[members], k=2)[0][:, 1]
            radius[members] = np.clip(0.44 * np.median(apart), *DISC_RADIUS)
    return radius


def discs(taxels: Taxels, radius: Float[Array, " taxel"]) -> Float[Array, "taxel corner 3"]:
    """Return discs about the taxels, in their tangent planes."""
    least = np.eye(3)[np.abs(taxels.normal).argmin(axis=1)]
    first = np.cross(taxels.normal, least)
    first *= (radius / np.linalg.norm(first, axis=1))[:, None]
    second = np.cross(taxels.normal, first)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)[:, None]
    return taxels.pos[:, None] + np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]


def group_of(layout: Layout) -> list[str]:
    """Return the group that each link is coloured by: the one of fewest links that it is in; empty if it is in none."""
    groups = sorted(layout.groups.items(), key=lambda group: (len(group[1]), group[0]))
    return [next((group for group, members in groups if link.name in members), "") for link in layout.links]


def legend(layout: Layout) -> dict[str, int]:
    """Return the label of each group that colours any link, in the links' order, and how many taxels have its colour.

    A group some of whose links have the colour of a smaller one is called `other`.
    """
    group_names = group_of(layout)
    active = np.bincount(layout.link_id[layout.radius > 0], minlength=len(layout.links))
    counts: dict[str, int] = {}
    for group in dict.fromkeys(group_names):
        is_whole = group_names.count(group) == len(layout.groups.get(group, ()))
        nobody = "no group" if layout.groups else "taxels"
        label = nobody if not group else group if is_whole else f"other {group}"
        counts[label] = int(sum(active[i] for i, name in enumerate(group_names) if name == group))
    return counts
