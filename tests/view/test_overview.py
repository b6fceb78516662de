"""The overview: a panel per reading, with arrows along vectors."""

import numpy as np
import pytest
import torch
from matplotlib.quiver import Quiver
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.view.cameras import ViewError
from tgdsl.view.markers import markers_of
from tgdsl.view.overview import drawing, overview

SCENE = """
<mujoco><worldbody>
  <body name="pad" pos=".1 .2 .3" euler="20 30 40"><joint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="ball" pos="0 0 1"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""


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


def test_each_active_panel_has_a_colour_bar(scene):
    touch, sim = scene
    readings = {"force": torch.full((2, 6, 3), 2e-7), "depth": torch.full((2, 6, 1), 3e-3)}
    force, depth = drawing(touch, sim, readings).axes[:2]
    assert not force.child_axes  # nothing is above 1 mN
    assert not any(isinstance(part, Quiver) for part in force.collections)
    (bar,) = depth.child_axes
    assert bar.get_title() == "depth [mm]   (grey: up to 1 µm)"
    np.testing.assert_allclose(bar.get_xlim(), (0, 3), rtol=1e-6)


def test_a_missing_environment_or_reading_is_refused(scene, tmp_path):
    touch, sim = scene
    with pytest.raises(ViewError, match="environment 2 does not exist, expected 0 to 1"):
        overview(touch, sim, touch(sim.state()), tmp_path / "a.png", env=2)
    with pytest.raises(ViewError, match="there is nothing to draw"):
        overview(touch, sim, {}, tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()
    assert overview(touch, sim, touch(sim.state()), tmp_path / "new" / "a.png").stat().st_size > 5000
