"""Taxels that cannot feel are crossed out in pictures and counted in the legend."""

from pathlib import Path

import matplotlib.image
import mujoco
import numpy as np
import pytest
from matplotlib.axes import Axes

from tgdsl.compiler.pipeline import placed
from tgdsl.layout.layout import BURIED, COVERED, Layout, Unfelt
from tgdsl.view.render import drawing, render

ROBOT = """<mujoco><worldbody><body name="palm"><geom type="box" size=".005 .03 .04"/>
<body name="finger" pos="0 0 .065"><joint axis="0 1 0"/><geom type="box" size=".004 .01 .02"/></body></body></worldbody></mujoco>"""
GRID = {"method": "grid", "rows": 2, "columns": 2, "direction": [-1, 0, 0], "radius": "4 mm"}
MANY = {"method": "poisson", "count": 36, "radius": "4 mm"}
SMALL = (600, 300)
Drawn = tuple[mujoco.MjModel, dict[str, Layout]]


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Drawn:
    file = tmp_path_factory.mktemp("hand") / "hand.xml"
    file.write_text(ROBOT)
    resolutions = {"few": {"palm": GRID}, "many": {"palm": MANY, "finger": GRID}}
    return placed({"tgdsl": 1, "robot": {"model": str(file), "layout": {"resolutions": resolutions}}})[:2]


def marks(axes: Axes, which: str) -> np.ndarray:
    """Return the middle of each disc, in pixels of the panel."""
    collection = next(part for part in axes.collections if part.get_gid() == which)
    return np.array([np.asarray(path.vertices[:24]).mean(axis=0) for path in collection.get_paths()])


def test_taxels_that_cannot_feel_are_crossed_out(hand: Drawn) -> None:
    """Two bars per taxel cross at its disc's centre, opaque if visible, faint if hidden; the legend counts them."""
    model, layouts = hand
    layout = layouts["many"]
    palm, finger = layout.taxels_of(("palm",)), layout.taxels_of(("finger",))
    records = (Unfelt("palm", BURIED, "", palm[:5], len(palm)), Unfelt("finger", COVERED, "", finger[:2], len(finger)))
    plain, crossed = (drawing(model, layouts, size=SMALL, unfelt=unfelt) for unfelt in (None, {"many": records}))
    few, many = crossed.axes
    assert [part.get_gid() for part in few.collections] == [part.get_gid() for part in plain.axes[0].collections]
    bars = next(part for part in many.collections if part.get_gid() == "unfelt")
    segments = np.array([path.vertices for path in bars.get_paths()]).reshape(-1, 2, 2, 2)  # taxel, bar, end, pixel
    assert len(segments) == 7
    middles = np.concatenate([marks(many, name).reshape(-1, 2) for name in ("shown", "hidden")])
    first, second = segments[:, 0].mean(axis=1), segments[:, 1].mean(axis=1)
    np.testing.assert_allclose(first, second, atol=1e-6)
    distances = np.linalg.norm(first[:, None] - middles[None], axis=2)
    assert (distances.min(axis=1) < 0.05).all() and len(set(distances.argmin(axis=1))) == 7
    is_shown = distances.argmin(axis=1) < len(marks(many, "shown"))
    np.testing.assert_allclose(np.asarray(bars.get_colors())[:, 3], np.repeat(np.where(is_shown, 1.0, 0.3), 2))
    legends = [[text.get_text() for text in axes.get_legend().get_texts()] for axes in crossed.axes]
    assert legends[1][-1] == "cannot feel 7" and legends[1][:-1] == [
        t.get_text() for t in plain.axes[1].get_legend().get_texts()
    ]
    assert not any("feel" in text for text in legends[0])


def test_the_file_has_red_pixels_only_in_crossed_out_panels(hand: Drawn, tmp_path: Path) -> None:
    model, layouts = hand
    taxels = np.arange(36)
    for name, unfelt in (("plain", {}), ("crossed", {"many": (Unfelt("palm", BURIED, "", taxels, 36),)})):
        image = matplotlib.image.imread(render(model, layouts, tmp_path / f"{name}.png", size=(1200, 600), unfelt=unfelt))
        is_red = (image[..., 0] > 0.7) & (image[..., 1] < 0.2) & (image[..., 2] < 0.2)
        left, right = is_red[:, :600].sum(), is_red[:, 600:].sum()
        assert left == 0 and (right > 20) == (name == "crossed")
