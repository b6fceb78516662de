"""Touch in videos: spheres at the taxels' sites, colours of readings, and bars by sums by hand."""

import mujoco
import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.view.style import HEAT
from tgdsl.view.trace import TouchTrace

SCENE = """
<mujoco><worldbody>
  <body name="left" pos=".1 .2 .3" euler="20 30 40"><joint axis="0 1 0"/><geom type="box" size=".02 .02 .01"/>
    <site name="left0" pos=".01 0 .01"/><site name="left1" pos="-.01 0 .01"/></body>
  <body name="right" pos="-.1 0 0"><joint axis="1 0 0"/><geom type="box" size=".02 .02 .01"/><site name="right0" pos="0 0 .01"/></body>
  <body name="ball" pos="0 0 1"><freejoint/><geom size=".03"/></body>
</worldbody></mujoco>
"""
READ = torch.tensor([[[3.0, 0, 4], [0, 0, 1], [0, 2, 0]], [[0, 0, 1e-4], [0, 0, 5], [0, 0, 0]]])[:, None]
"""Two steps of one environment: sizes 5, 1, 2 and then 0 (rounding), 5, 0 [N]."""


@pytest.fixture
def touch(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)

    def points(*x: float) -> dict:
        return {"method": "points", "radius": 0.004, "points": [{"pos": [i, 0, 0.01], "normal": [0, 0, 1]} for i in x]}

    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(tmp_path / "scene.xml"),
                "layout": {"resolutions": {"o": {"left": points(0.01, -0.01), "right": points(0.0)}}},
            },
            "objects": {"ball": {"body": "ball"}},
            "sensors": {"touch": {"kind": "kinematic_taxel", "outputs": ["force"], "links": "*", "feels": ["ball"]}},
        }
    )


@pytest.fixture
def trace(touch):
    return trace_of(touch, READ)


def trace_of(touch, read):
    trace = TouchTrace(touch, touch.outputs[0], 3)
    for step, reading in enumerate(read):
        trace.add(step + 1, {"touch": reading})
    trace.add(3, {"touch": read[0]})  # beyond the last step
    return trace


def test_values_are_magnitudes_above_the_threshold(trace):
    np.testing.assert_allclose(trace.values, [[0, 0, 0], [5, 1, 2], [0, 5, 0]])


@pytest.mark.parametrize("step", [0, 1, 2])
def test_spheres_are_at_the_taxels_in_the_colours_of_their_readings(touch, trace, step):
    model = mujoco.MjModel.from_xml_string(SCENE)
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, 100)
    data.qpos[:2] = 0.4, -0.3
    mujoco.mj_forward(model, data)
    before = scene.ngeom
    trace.draw(scene, model, data, step)
    spheres = [scene.geoms[i] for i in range(before, scene.ngeom)]
    sites = [data.site(name).xpos for name in ("left0", "left1", "right0")]
    np.testing.assert_allclose([sphere.pos for sphere in spheres], sites, atol=1e-6)
    sizes = [[0, 0, 0], [5, 1, 2], [0, 5, 0]][step]
    for sphere, size in zip(spheres, sizes, strict=True):
        np.testing.assert_allclose(sphere.rgba, HEAT(size / 5) if size else HEAT(-1.0), atol=1e-6)
    radii = np.array([sphere.size[0] for sphere in spheres])
    width = np.sqrt(touch.taxels["touch"]["area"])
    assert (radii < width / 2).all() and ((radii > width / 4) == (np.array(sizes) > 0)).all()  # what reads is larger


def test_a_full_scene_gets_no_more_spheres(trace):
    model = mujoco.MjModel.from_xml_string(SCENE)
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, 2)
    mujoco.mj_forward(model, data)
    trace.draw(scene, model, data, 1)
    assert scene.ngeom == 2


def test_bars_name_links_and_the_largest_sum_and_are_full_in_the_hottest_colour(trace, monkeypatch):
    frame = np.zeros((200, 400, 3), dtype=np.uint8)
    hottest = trace.bars().draw(frame, 1)[-27, 130].astype(float)  # the left link's, which is full
    np.testing.assert_allclose(hottest / hottest.max(), np.array(HEAT(1.0)[:3]) / HEAT(1.0)[0], atol=0.01)
    monkeypatch.setattr("tgdsl.view.trace.LinkBars", lambda names, parts, title: (names, title))
    assert trace.bars() == (("left", "right"), "Σ |force|, full: 6 N; spheres: up to 5")


def test_the_most_pressed_links_have_bars(trace, monkeypatch):
    monkeypatch.setattr("tgdsl.view.trace.MAX_MAPS", 1)
    np.testing.assert_allclose(trace.bars().parts, np.array([[0], [6], [5]]) / 6)


def test_bars_are_proportional_to_the_sums_of_links(trace):
    """Relative to 6 N, the left link's largest sum; measured in pixels along the middle of each row."""
    bars = trace.bars()
    np.testing.assert_allclose(bars.parts, np.array([[0, 0], [6, 2], [5, 0]]) / 6)
    frame = np.zeros((200, 400, 3), dtype=np.uint8)
    empty = bars.draw(frame, 0)
    assert not frame.any() and not empty[:, 300:].any() and not empty[:100].any()
    lengths = [(bars.draw(frame, step) != empty).any(axis=2)[[-27, -9]].sum(axis=1) for step in (1, 2)]
    np.testing.assert_allclose(lengths, 172 * np.array([[6, 2], [5, 0]]) / 6, atol=1)


def test_small_forces_fill_the_bars_too(touch):
    np.testing.assert_allclose(trace_of(touch, 0.05 * READ).bars().parts, np.array([[0, 0], [6, 2], [5, 0]]) / 6, rtol=1e-6)
