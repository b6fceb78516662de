"""Readings as images: each pixel is the taxel of its row and column."""

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import TgdslError

SCENE = """
<mujoco><worldbody>
  <body name="pad"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="disc"><freejoint/><geom type="cylinder" size=".02 .01"/></body>
  <body name="loose"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="item"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""
GRID = {"method": "grid", "direction": [0, 0, -1], "radius": 0.004}
LAYOUT = {
    "pad": {**GRID, "rows": 3, "columns": 4},
    "disc": {**GRID, "rows": 6, "columns": 6},  # its corners miss the round face
    "loose": {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]},
}


@pytest.fixture
def touch(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    sensor = {"feels": ["item"], "gate": "geometric"}
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": LAYOUT}}},
            "objects": {"item": {"body": "item"}},
            "sensors": {
                "touch": {"kind": "kinematic_taxel", "links": "*", "readout": "both", **sensor},
                "none": {"kind": "contact_depth", "links": "loose", **sensor},
            },
        },
        dtype=torch.float64,
    )


def test_a_pixel_is_the_taxel_of_its_row_and_column(touch):
    readings = {"touch": torch.randn(2, len(touch.taxels["touch"]), 6, dtype=torch.float64)}
    images, masks = touch.images("touch", readings)
    assert list(images) == ["pad", "disc"]
    assert images["pad"].shape == (2, 6, 3, 4) and images["disc"].shape == (2, 6, 6, 6)
    table = touch.taxels["touch"]
    for link, image in images.items():
        taxels = np.flatnonzero(table["link"] == link)
        for taxel in taxels:
            row, column = table["row"][taxel], table["column"][taxel]
            assert masks[link][row, column]
            torch.testing.assert_close(image[:, :, row, column], readings["touch"][:, taxel], rtol=0, atol=0)
        assert masks[link].sum() == len(taxels)
    assert masks["pad"].all() and not masks["disc"][0, 0] and not images["disc"][:, :, ~masks["disc"]].any()
    # On a disc of radius 20 mm, of 6 × 6 cells of 6.67 mm, those with their centre inside.
    centre = (np.arange(6) - 2.5) * 0.04 / 6
    np.testing.assert_array_equal(masks["disc"].numpy(), np.hypot(centre[:, None], centre) < 0.02)


def test_images_have_gradients(touch):
    """The gradient of an image reaches only its link's taxels."""
    readings = {name: value.requires_grad_() for name, value in {"touch/clean": torch.randn(1, 45, 6)}.items()}
    images, _ = touch.images("touch/clean", readings)
    images["pad"].sum().backward()
    gradient = readings["touch/clean"].grad
    assert gradient is not None and gradient[:, :12].eq(1).all() and not gradient[:, 12:].any()


def test_readings_without_an_image_are_refused(touch):
    readings = touch(touch.example_state(1))
    with pytest.raises(TgdslError, match='there is no reading of taxels "tuch"; did you mean "touch"'):
        touch.images("tuch", readings)
    with pytest.raises(TgdslError, match="no image without a grid: the taxels of loose are not laid out with `method: grid`"):
        touch.images("none", readings)
