"""The overview: a panel per reading, with arrows along vectors."""

import re

import numpy as np
import pytest
import torch
from matplotlib.quiver import Quiver
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.view.cameras import ViewError
from tgdsl.view.markers import markers_of
from tgdsl.view.overview import ARROW, drawing, overview

SCENE = """
<mujoco><worldbody>
  <body name="arm"><geom type="capsule" fromto="0 0 .3 -.3 -.2 .3" size=".01"/>
    <body name="pad" pos=".1 .2 .3" euler="20 30 40"><joint/><geom type="box" size=".02 .02 .01"/></body>
  </body>
  <body name="ball" pos="0 0 1"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""
PADS = {"upper": 0.01, "lower": -0.01}
"""Heights of two pads that face away from each other [m]."""


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    layout = {"pad": {"method": "grid", "rows": 2, "columns": 3, "direction": [0, 0, -1], "radius": 0.004}}
    sensor = {"links": "pad", "feels": ["ball"]}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": layout}}},
            "objects": {"ball": {"body": "ball"}},
            "sensors": {
                "force": {"kind": "kinematic_taxel", "outputs": ["force"], **sensor},
                "depth": {"kind": "contact_depth", **sensor},
            },
        }
    )
    return touch, tgdsl.simulate(touch, 2)


def test_arrows_are_the_projected_vectors(scene):
    touch, sim = scene
    rng = np.random.default_rng(0)
    force = rng.normal(size=(2, 6, 3)) * [1, 1, 0]  # in the plane of the pad
    force[:, 4] = 0
    readings = {"force": torch.tensor(force), "depth": torch.zeros(2, 6, 1)}
    figure = drawing(touch, sim, readings, env=1, title="both")
    assert [axes.get_title("left").split()[0] for axes in figure.axes] == ["force", "depth"]
    assert all(0 <= axes.get_position().x0 < axes.get_position().x1 <= 1 for axes in figure.axes)
    (arrows,) = [part for part in figure.axes[0].collections if isinstance(part, Quiver)]
    assert not any(isinstance(part, Quiver) for part in figure.axes[1].collections)
    markers = markers_of(touch, sim, touch.outputs[0], readings["force"], 1)
    world = Rotation.from_euler("XYZ", [20, 30, 40], degrees=True).apply(force[1])
    np.testing.assert_allclose(markers.vector, world, atol=1e-12)
    # Pixels are a linear map of the pad's plane: fit it to the taxels' positions, and apply it to the vectors.
    is_read = np.arange(6) != 4
    positions, drawn = np.column_stack([arrows.X, arrows.Y]), np.column_stack([arrows.U, arrows.V])
    to_pixels = np.linalg.lstsq(np.column_stack([markers.pos[is_read], np.ones(5)]), positions, rcond=None)[0][:3]
    expected = world[is_read] @ to_pixels
    np.testing.assert_allclose(drawn / np.linalg.norm(drawn), expected / np.linalg.norm(expected), atol=1e-9)
    width = np.ptp(figure.axes[0].get_xlim())
    assert 0.7 * ARROW * width < np.linalg.norm(drawn, axis=1).max() <= ARROW * width


def test_the_picture_shows_the_pad_under_its_taxels_and_a_scale(scene):
    """Pixels are a linear map of the plane of the pad's upper side."""
    touch, sim = scene
    depth = torch.tensor([1e-3, 0, 2e-3, 0, 3e-3, 4e-3]).expand(2, -1)[..., None]
    figure = drawing(touch, sim, {"depth": depth})
    (axes,) = figure.axes
    rest, _, read = (np.asarray(part.get_offsets()) for part in axes.collections)
    taxels = markers_of(touch, sim, touch.outputs[1], depth, 0).pos[[1, 3, 0, 2, 4, 5]]  # the hottest is drawn last
    middle, dots = taxels.mean(axis=0), np.vstack([rest, read])
    to_pixels = np.linalg.lstsq(taxels - middle, dots - dots.mean(axis=0), rcond=None)[0]
    np.testing.assert_allclose((taxels - middle) @ to_pixels, dots - dots.mean(axis=0), atol=1e-6)
    turn = Rotation.from_euler("XYZ", [20, 30, 40], degrees=True)
    corners = turn.apply([[x, y, 0.01] for x in (-0.02, 0.02) for y in (-0.02, 0.02)]) + [0.1, 0.2, 0.3]
    column, row = ((corners - middle) @ to_pixels + dots.mean(axis=0)).T
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert left < column.min() and column.max() < right and bottom < row.min() and row.max() < top
    assert max(np.ptp(column) / (right - left), np.ptp(row) / (top - bottom)) > 0.6  # the arm may be out of the picture
    (image,) = axes.images
    assert tuple(image.get_extent()) == (left, right, bottom, top)
    pixels = image.get_array()
    column, row = 0.97 * column + 0.03 * column.mean(), 0.97 * row + 0.03 * row.mean()
    at = (row - bottom) / (top - bottom) * len(pixels), (column - left) / (right - left) * pixels.shape[1]
    assert pixels[at[0].astype(int), at[1].astype(int)].max() < 0.95
    assert (pixels == 1).all(axis=2).mean() > 0.1  # the background is white
    (bar,) = axes.lines
    (scale,) = (text for text in axes.texts if re.fullmatch(r"\d+ mm", text.get_text()))
    pixels_per_metre = np.linalg.svd(to_pixels, compute_uv=False)[0]
    assert np.ptp(bar.get_xdata()) == pytest.approx(1e-3 * int(scale.get_text().split()[0]) * pixels_per_metre)
    assert 0.05 < np.ptp(bar.get_xdata()) / (right - left) < 0.25
    assert left <= bar.get_xdata().min() and scale.get_position()[0] > bar.get_xdata()[-1]
    assert not axes.axison


def test_taxels_behind_the_pad_are_rings_if_they_read_and_a_panel_alone_is_larger(scene):
    touch, sim = scene
    depth = torch.tensor([1e-3, 0, 2e-3, 0, 3e-3, 4e-3]).expand(2, -1)[..., None]
    front, back = (drawing(touch, sim, {"depth": depth}, view=view) for view in ("front", "back"))
    for figure, expected in ((front, [2, 0, 4]), (back, [0, 4, 0])):
        assert [len(part.get_offsets()) for part in figure.axes[0].collections] == expected
    assert front.get_figwidth() > drawing(touch, sim, {"depth": depth, "force": torch.zeros(2, 6, 3)}).get_figwidth() / 2


def test_each_active_panel_has_a_colour_bar(scene):
    touch, sim = scene
    readings = {"force": torch.full((2, 6, 3), 2e-7), "depth": torch.tensor([3e-3, 0, 0, 0, 0, 0]).expand(2, -1)[..., None]}
    force, depth = drawing(touch, sim, readings).axes[:2]
    assert not force.child_axes  # nothing is above 1 mN
    assert not any(isinstance(part, Quiver) for part in force.collections)
    (bar,) = depth.child_axes
    assert bar.get_title() == "depth [mm]   (grey: up to 1 µm)"
    np.testing.assert_allclose(bar.get_xlim(), (0, 3), rtol=1e-6)


def test_the_camera_faces_taxels_that_read_rather_than_a_body_that_does(tmp_path):
    """Two pads back to back: the first reading is of the upper one as a whole, the second of the taxels of the lower one."""
    pads = "".join(
        f'<body name="{name}" pos="0 0 {z}"><geom type="box" size=".02 .02 .004"/></body>' for name, z in PADS.items()
    )
    ball = '<body name="ball" pos="0 0 1"><freejoint/><geom size=".03"/></body>'
    (tmp_path / "pads.xml").write_text(f'<mujoco><worldbody><body name="arm">{pads}</body>{ball}</worldbody></mujoco>')
    grid = {"method": "grid", "rows": 2, "columns": 2, "radius": 0.004}
    layout = {name: {**grid, "direction": [0, 0, -np.sign(z)]} for name, z in PADS.items()}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "pads.xml"), "layout": {"resolutions": {"r": layout}}},
            "objects": {"ball": {"body": "ball"}},
            "sensors": {
                "net": {"kind": "link_contact", "links": "upper", "feels": ["ball"], "outputs": ["force"]},
                "depth": {"kind": "contact_depth", "links": "*", "feels": ["ball"]},
            },
        }
    )
    depth = torch.from_numpy(np.where(touch.taxels["depth"]["link"] == "lower", 1e-3, 0.0))[None, :, None]
    _, axes = drawing(touch, tgdsl.simulate(touch, 1), {"net": torch.ones(1, 1, 3), "depth": depth}).axes
    assert [len(part.get_offsets()) for part in axes.collections] == [0, 0, 4]  # the four that read are in front


def test_a_missing_environment_or_reading_is_refused(scene, tmp_path):
    touch, sim = scene
    with pytest.raises(ViewError, match="environment 2 does not exist, expected 0 to 1"):
        overview(touch, sim, touch(sim.state()), tmp_path / "a.png", env=2)
    with pytest.raises(ViewError, match="there is nothing to draw"):
        overview(touch, sim, {}, tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()
    assert overview(touch, sim, touch(sim.state()), tmp_path / "new" / "a.png").stat().st_size > 5000
