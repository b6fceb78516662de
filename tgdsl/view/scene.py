"""The robot and the objects of its sensors as pixels, and markers on top.

Shapes: `h` and `w` rows and columns of pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from tgdsl.layout.layout import Layout
from tgdsl.module.module import TactileModule
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.view.cameras import best_camera, camera_of
from tgdsl.view.markers import Markers, Pose, is_visible
from tgdsl.view.meshes import mesh_of, robot_bodies
from tgdsl.view.raster import Fragments, Mesh, Viewport, downsample, rasterise, shade, viewport_for
from tgdsl.view.style import DPI, HEAT, INK, OBJECT, OTHER, SENSING, SUPERSAMPLING

Array = np.ndarray
_DEPTH = 0.5  # how much of the shading painted surfaces keep
# returns the colours of points of the robot's surface [m] on some bodies, NaN where these stay grey
Paint = Callable[[Array, Array], Array]


class RenderedScene(NamedTuple):
    """The robot and its sensors' objects as pixels, row 0 at the bottom, with fragments and viewport."""

    image: Float[Array, "h w 3"]
    fragments: Fragments
    viewport: Viewport


class Seen(NamedTuple):
    """The visible meshes: the robot, its bodies with sensors, the objects of the sensors; and the viewport."""

    hand: Mesh
    carriers: frozenset[int]
    objects: Mesh
    viewport: Viewport


def seen(
    touch: TactileModule,
    sim: Simulation,
    markers: Markers,
    env: int,
    width: int,
    height: int,
    view: str | None = None,
    layouts: Sequence[Layout] = (),
) -> Seen:
    """Return robot and felt objects, seen from where some taxels are in view; default view: see `cameras.best_camera`.

    Width and height count before `SUPERSAMPLING` pixels become one. `layouts` are what else carries sensors; the first gives
    views their names where the module has no taxels.
    """
    model, pose = sim.model, Pose(*sim.body_poses(env))
    layouts = (touch.plan.layout, *layouts)
    links = [link for layout in layouts for link in layout.links]
    carriers = {model.body(link.body).id for link in links}
    framed, robot = robot_bodies(model, carriers)
    felt = {model.body(target.body).id for target in touch.plan.objects} - carriers
    hand, objects = (mesh_of(sim.env_model(env), pose, bodies, links) for bodies in (robot - felt, felt))
    frame = np.isin(hand.body, list(framed))
    named = next((layout for layout in layouts if (layout.radius > 0).any()), layouts[0])
    root = min(framed)
    camera = (
        best_camera(markers, hand, model, named, pose, root) if view is None else camera_of(view, model, [named], pose, root)
    )
    box = _bounds(camera.project(hand.corners[frame] if frame.any() else markers.pos[:, None]), camera.project(objects.corners))
    return Seen(hand, frozenset(carriers), objects, viewport_for(camera, box, width, height))


def rendered(seen: Seen, paint: Paint | None = None) -> RenderedScene:
    """Draw the visible meshes; objects are fainter over a painted robot."""
    hand, carriers, objects, viewport = seen
    fragments = rasterise(viewport.project(hand.corners), viewport.width, viewport.height)
    colour = np.where(np.isin(hand.body, list(carriers))[:, None], SENSING, OTHER)
    image = shade(np.ones((viewport.height, viewport.width, 3)), fragments, hand, colour, viewport)
    if paint is not None:
        drawn = fragments.face >= 0
        face, weights = fragments.face[drawn], fragments.weights[drawn]
        painted = paint(np.einsum("pi,pij->pj", weights, hand.corners[face]), hand.body[face])
        light = 1 - _DEPTH * (1 - np.minimum(image[drawn] / colour[face], 1))
        image[drawn] = np.where(np.isnan(painted), image[drawn], painted * light)
    over = rasterise(viewport.project(objects.corners), viewport.width, viewport.height)
    over.face[over.nearness < fragments.nearness] = -1
    blue = np.broadcast_to(OBJECT, (len(objects.body), 3))
    image = shade(image, over, objects, blue, viewport, opacity=0.4 if paint is None else 0.25)
    return RenderedScene(downsample(image, SUPERSAMPLING), fragments, viewport)


def draw_markers(axes: Axes, scene: RenderedScene, markers: Markers, norm: Normalize) -> None:
    """Draw taxels on their scene; behind a surface of the robot, reading ones as rings and the others not at all."""
    viewport = scene.viewport
    draw_image(axes, scene.image, viewport)
    at = viewport.project(markers.pos)
    seen = is_visible(markers, at, scene.fragments, viewport.camera)
    size = np.minimum(markers.size, np.median(markers.size))
    area = (np.clip(0.62 * viewport.scale / SUPERSAMPLING * size, 3.5, 20.0) * 72 / DPI) ** 2
    in_front, hidden, rest = seen & markers.is_read, ~seen & markers.is_read, seen & ~markers.is_read & (markers.size > 0)
    axes.scatter(*at[rest, :2].T, s=0.3 * area[rest], c="#8d949e", linewidths=0, zorder=3)
    ring = HEAT(norm(markers.value[hidden]))
    axes.scatter(*at[hidden, :2].T, s=0.6 * area[hidden], facecolors="none", edgecolors=list(ring), linewidths=1.0, zorder=4)
    order = np.argsort(markers.value[in_front], kind="stable")
    place, value, size = at[in_front, :2][order], markers.value[in_front][order], area[in_front][order]
    axes.scatter(*place.T, s=size, c=value, cmap=HEAT, norm=norm, edgecolors=INK, linewidths=0.5, zorder=5)
    draw_scale_bar(axes, viewport, -44.0)


def draw_image(axes: Axes, image: Float[Array, "h w 3"], viewport: Viewport) -> None:
    """Fill axes with an image, in the viewport's coordinates [pixel]."""
    extent = (-0.5, viewport.width - 0.5, -0.5, viewport.height - 0.5)
    axes.imshow(image, origin="lower", extent=extent, interpolation="nearest", aspect="auto")
    axes.set_axis_off()
    axes.autoscale(False)


def draw_scale_bar(axes: Axes, viewport: Viewport, row: float) -> None:
    """Draw a round number of millimetres at the left of a row [pixel]."""
    steps = np.array([1, 2, 5, 10, 20, 50, 100, 200, 500, 1000])
    length = steps[np.abs(steps * viewport.scale / 1000 / viewport.width - 0.12).argmin()]
    end = 8 + length * viewport.scale / 1000
    axes.plot([8, end], [row, row], color=INK, linewidth=1.6, solid_capstyle="butt", clip_on=False)
    axes.text(end + 16, row - 1, f"{length} mm", fontsize=9.5, color=INK, va="center")


def draw_colour_bar(axes: Axes, norm: Normalize, colours: Colormap, label: str, size: float = 8.5) -> None:
    """Fill axes with the bar of a panel's colours, its label above it in some size [pt]."""
    assert isinstance(axes.figure, Figure)
    bar = axes.figure.colorbar(ScalarMappable(norm, colours), cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    axes.set_title(label, fontsize=size, color=INK, pad=3)
    axes.tick_params(labelsize=size - 0.5, colors=INK, length=2, pad=1.5)
    axes.locator_params(nbins=5)


def _bounds(hand: Array, objects: Array) -> Array:
    """Return the lower and upper corner of the view: the hand, and objects near it."""
    low, high = hand[..., :2].min(axis=(0, 1)), hand[..., :2].max(axis=(0, 1))
    room = 0.3 * (high - low).max()
    if len(objects):
        near = objects[..., :2].reshape(-1, 2)
        near = near[((near > low - room) & (near < high + room)).all(axis=1)]
        low, high = np.vstack([near, [low]]).min(axis=0), np.vstack([near, [high]]).max(axis=0)
    margin = 0.03 * (high - low).max()
    return np.stack([low - margin, high + margin])
