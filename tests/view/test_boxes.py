"""Readings of boxes: positions and colours by closed forms, the table, and a picture."""

import numpy as np
import pytest
import torch
from matplotlib.colors import Normalize
from oracles.setups.boxes import heat_module
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.view.boxes import boxes_of, is_boxed
from tgdsl.view.markers import Pose
from tgdsl.view.overview import drawing as overview_drawing
from tgdsl.view.overview import drawn_outputs, overview
from tgdsl.view.style import WARMTH
from tgdsl.view.table import table

TOLERANCE = 1e-12  # metres: a rotation and a sum in float64
SIDES = {"a": [0.03, 0.02, 0.01], "b": [0.02, 0.02, 0.02]}
POSE = Pose(
    np.array([[0, 0, 0], [0.1, 0.2, 0.3], [-0.1, 0, 0]]), np.array([[1.0, 0, 0, 0], [0.5, 0.5, 0.5, 0.5], [1, 0, 0, 0]])
)


@pytest.fixture
def build(tmp_path):
    def built(**sensor):
        touch = heat_module(tmp_path, SIDES, {"material": "copper", "cells": [3, 2, 1], **sensor})
        return touch, tgdsl.simulate(touch, 2)

    return built


def reading(touch, values):
    """Return a reading with values in its second environment and zeros in the first."""
    values_per_box = torch.as_tensor(values, dtype=torch.float64)[:, None]
    return {touch.outputs[0].name: torch.stack([torch.zeros_like(values_per_box), values_per_box])}


def test_cells_fill_their_box(build):
    touch, _ = build()
    rows = touch.rows["heat"]
    for link, sides in SIDES.items():
        cells = rows[rows["link"] == link]
        np.testing.assert_allclose(cells["size"], np.tile(np.array(sides) / [3, 2, 1], (6, 1)), atol=TOLERANCE)
        expected = (cells["cell"] + 0.5) * cells["size"] - 0.5 * np.array(sides)
        np.testing.assert_allclose(cells["pos"], expected, atol=TOLERANCE)


@pytest.mark.parametrize("outputs", ["max", "mean"])
def test_a_whole_link_is_one_box(build, outputs):
    touch, _ = build(outputs=outputs)
    np.testing.assert_allclose(touch.rows["heat"]["size"], list(SIDES.values()), atol=TOLERANCE)
    np.testing.assert_allclose(touch.rows["heat"]["pos"], 0, atol=TOLERANCE)
    assert [output.name for output in drawn_outputs(touch)] == ["heat"]
    assert not is_boxed(touch, touch.outputs[1])


def test_a_point_has_the_colour_of_its_cell(build):
    """Cell (i, j) of link a is at 20 + i + 10 j °C: points in a turned body at its middle, near corners and slightly outside."""
    touch, sim = build()
    rows = touch.rows["heat"]
    values = np.where(rows["link"] == "a", 20.0 + rows["cell"][:, 0] + 10.0 * rows["cell"][:, 1], -7.0)
    boxes = boxes_of(touch, touch.outputs[0], reading(touch, values)["heat"], 1)
    assert (boxes.norm.vmin, boxes.norm.vmax) == (-7.0, 32.0)
    paint = boxes.painter(sim.model, POSE)
    rotation = Rotation.from_quat(POSE.quat[1], scalar_first=True)
    for offset in ([0, 0, 0], [0.49, -0.49, 0.49], [-0.49, 0.49, 0.7]):
        points = rows["pos"][:6] + np.array(offset) * rows["size"][:6]
        colours = paint(POSE.pos[1] + rotation.apply(points), np.full(6, sim.model.body("a").id))
        np.testing.assert_allclose(colours, WARMTH(Normalize(-7, 32)(values[:6]))[:, :3], atol=TOLERANCE)
    assert np.isnan(paint(np.zeros((1, 3)), np.array([0]))).all()  # the world stays grey


def test_inner_cells_are_not_drawn(build):
    """Of 4 × 3 × 3 cells two are inside; normals of exposed faces cancel over each link."""
    touch, _ = build(cells=[4, 3, 3])
    boxes = boxes_of(touch, touch.outputs[0], reading(touch, np.arange(72.0))["heat"], 1)
    assert len(boxes.chosen) == 2 * (36 - 2)
    assert boxes.layout.area.sum() == pytest.approx(2 * (6e-4 + 3e-4 + 2e-4) + 6 * 4e-4)
    np.testing.assert_allclose(boxes.layout.area @ boxes.layout.normal, 0, atol=1e-15)


@pytest.mark.parametrize(("values", "low", "high"), [([22.0] * 12, 21.5, 22.5), ([-5.0] + [40.0] * 11, -5, 40)])
def test_colours_range_over_the_values_or_a_given_range(build, values, low, high):
    touch, _ = build()
    temperatures = reading(touch, values)["heat"]
    norm = boxes_of(touch, touch.outputs[0], temperatures, 1).norm
    assert (norm.vmin, norm.vmax) == (low, high)
    norm = boxes_of(touch, touch.outputs[0], temperatures, 1, (0.0, 50.0)).norm
    assert (norm.vmin, norm.vmax, norm(-5.0)) == (0.0, 50.0, 0.0)


def test_the_picture_has_a_colour_bar_in_degrees(build, tmp_path):
    touch, sim = build(outputs="surface", noise="clean")
    values = reading(touch, np.linspace(20, 45, 12))
    figure = overview_drawing(touch, sim, values, env=1, title="warm")
    panel = figure.axes[0]
    assert panel.get_title("left") == "heat  ·  temperature_grid"
    red, _, blue = np.moveaxis(panel.images[0].get_array(), 2, 0)
    assert (red - blue > 0.3).mean() > 0.05  # the warm cells
    assert [text.get_text() for text in figure.texts] == ["warm"] and len(panel.lines) == 1
    assert "temperature 20.00 … 45.00 °C" in [text.get_text() for text in panel.texts]
    (bar,) = panel.child_axes
    assert bar.get_title() == "temperature [°C]"
    assert bar.get_xlim() == (20.0, 45.0)
    assert overview(touch, sim, values, tmp_path / "warm.png", env=1, view="30,20").stat().st_size > 5000


def test_a_terminal_shows_a_line_for_each_link(build):
    touch, _ = build()
    readings = reading(touch, [20, 21, 22, 23, 24, 25, -5, -5, -5, -5, -5, -4.5])
    readings["heat/heat"] = torch.zeros(2, 2, 5)
    assert table(touch, readings, env=1)[:5] == [
        "heat",
        "link  cells  temperature [degC]",
        "────  ─────  ──────────────────",
        "a         6       20.00 … 25.00",
        "b         6       -5.00 … -4.50",
    ]
