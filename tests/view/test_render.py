"""Pictures of hands: positions and visibility of discs, legends, and errors."""

from pathlib import Path

import matplotlib.image
import mujoco
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

import tgdsl
from tgdsl.compiler.pipeline import placed
from tgdsl.errors import SpecError, TgdslError
from tgdsl.layout.layout import Layout, Link
from tgdsl.view.cameras import VIEWS, camera_of, pose_of
from tgdsl.view.markers import Pose, taxels_of
from tgdsl.view.render import HEIGHT, MIN_SIZE, discs, drawing, group_of, legend, radii, render

TOLERANCE = 1e-9  # metres and pixels: centimetres in float64, a rotation and a sum

# A palm with taxels that face +x, a finger above it that bends toward them, and a lid in front of the palm's lower half.
ROBOT = """
<mujoco model="hand"><worldbody>
<body name="palm" pos="0.3 0 0.1" quat="1 0 0 0.4">
  <geom type="box" size=".005 .03 .04" pos="0 0 .04"/>
  <body name="lid"><geom type="box" size=".005 .03 .02" pos=".03 0 .02"/></body>
  <body name="finger" pos="0 0 .085">
    <joint name="bend" axis="0 1 0" range="0 3"/><geom type="box" size=".004 .01 .02" pos="0 0 .02"/>
  </body>
</body>
</worldbody>
<keyframe><key name="open" qpos="0"/><key name="bent" qpos="1.2"/></keyframe></mujoco>
"""
LAYOUT = """
tgdsl: 1
groups: {all: [palm, finger], tips: [finger]}
resolutions:
  few:
    palm: {method: grid, rows: 2, columns: 2, direction: [-1, 0, 0], radius: 4 mm}
    finger: {method: grid, rows: 3, columns: 2, direction: [-1, 0, 0], radius: 4 mm}
  many:
    palm: {method: grid, rows: 6, columns: 6, direction: [-1, 0, 0], radius: 4 mm}
    finger:
      method: points
      points:
        - {pos: [0.004, 0, 0.02], normal: [1, 0, 0], radius: 4 mm}
        - {pos: [-0.004, 0, 0.02], normal: [-1, 0, 0], radius: 4 mm}
        - {pos: [0.004, 0, 0.03], normal: [1, 0, 0], radius: 0 mm}
"""
SMALL = (600, 300)
Drawn = tuple[mujoco.MjModel, dict[str, Layout]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hand")
    (folder / "hand.xml").write_text(ROBOT)
    (folder / "layout.yaml").write_text(LAYOUT)
    (folder / "bare.yaml").write_text("tgdsl: 1\nrobot: {model: hand.xml, layout: layout.yaml}\n")
    sensors = "objects: {lid: {body: lid}}\nsensors: {touch: {kind: surface_distance, links: tips, feels: [lid]}}\n"
    (folder / "hand.yaml").write_text((folder / "bare.yaml").read_text() + f"resolution: many\n{sensors}")
    return folder


@pytest.fixture(scope="module")
def hand(folder: Path) -> Drawn:
    return placed(folder / "bare.yaml")[:2]


def marks(axes: Axes, which: str) -> np.ndarray:
    """Return the centre of each disc, or the two ends of each tick, in pixels of the panel."""
    collection = next(part for part in axes.collections if part.get_gid() == which)
    paths = [path.vertices[:24] if which != "normals" else path.vertices for path in collection.get_paths()]
    return np.array([np.asarray(path).mean(axis=0) if which != "normals" else path for path in paths])


def one_link(pos: list[list[float]], normal: list[list[float]], **more) -> Layout:
    count = len(pos)
    values = {"radius": np.full(count, 0.004), "area": np.full(count, 1e-4), "groups": {}} | more
    positions, normals = np.array(pos, dtype=float), np.array(normal, dtype=float)
    fields = {"link_id": np.zeros(count, dtype=np.int64), "tangent": normals[:, [1, 2, 0]], "cell": np.full((count, 2), -1)}
    return Layout(links=(Link("palm", "palm"),), pos=positions, normal=normals, **fields, **values)


# Positions of taxels ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("keyframe", [None, "bent"])
def test_discs_are_at_the_taxels(hand: Drawn, view: str, keyframe: str | None) -> None:
    """Positions by MuJoCo's matrices; the hand's corners, which fill the panel up to a margin, give the scale."""
    model, layouts = hand
    figure = drawing(model, layouts, view=view, keyframe=keyframe, size=SMALL)
    state = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, state, 1 if keyframe else 0)
    mujoco.mj_forward(model, state)
    camera = camera_of(view, model, list(layouts.values()), Pose(state.xpos, state.xquat), model.body("palm").id)
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    corners = [state.geom_xpos[i] + (signs * model.geom_size[i]) @ state.geom_xmat[i].reshape(3, 3).T for i in range(3)]
    image = np.concatenate(corners) @ np.stack([camera.right, camera.up], axis=1)
    low, high = image.min(axis=0), image.max(axis=0)
    for axes, layout in zip(figure.axes, layouts.values(), strict=True):
        body = [model.body(layout.links[i].body).id for i in layout.link_id]
        pos = np.array([state.xpos[b] + state.xmat[b].reshape(3, 3) @ p for b, p in zip(body, layout.pos, strict=True)])
        offsets = (pos[layout.radius > 0] @ np.stack([camera.right, camera.up], axis=1) - (low + high) / 2).round(12)
        centres = np.concatenate([marks(axes, name).reshape(-1, 2) for name in ("shown", "hidden")])
        bounds = np.array([axes.get_xlim(), axes.get_ylim()]) + 0.5
        scale = (bounds[:, 1] / ((high - low) + 0.03 * (high - low).max())).min()
        expected = bounds.mean(axis=1) + scale * offsets
        order, expected_order = (np.lexsort(points.round(3).T) for points in (centres, expected))
        np.testing.assert_allclose(centres[order], expected[expected_order], atol=1e-6)
        for bar, length in zip(axes.lines, axes.texts, strict=True):
            assert np.ptp(bar.get_xdata()) == pytest.approx(1e-3 * int(length.get_text().removesuffix(" mm")) * scale)
    assert [len(axes.lines) for axes in figure.axes] == [1, 0]


@pytest.mark.slow
@pytest.mark.parametrize("view", VIEWS)
def test_visible_taxels_match_mujocos_rays_to_the_camera(hand: Drawn, view: str) -> None:
    """MuJoCo's rays use neither pixels nor triangles."""
    model, layouts = hand
    pose = pose_of(model, "bent")
    camera = camera_of(view, model, list(layouts.values()), pose, model.body("palm").id)
    state = mujoco.MjData(model)
    state.qpos[:] = 1.2
    mujoco.mj_forward(model, state)
    figure, total = drawing(model, layouts, view=view, keyframe="bent", size=(1000, 600)), 0
    for axes, layout in zip(figure.axes, layouts.values(), strict=True):
        taxels = taxels_of(model, pose, layout)
        is_clear = np.zeros(len(taxels.pos), dtype=bool)
        for i, start in enumerate(taxels.pos + 1e-6 * taxels.normal):
            hit = mujoco.mj_ray(model, state, start, camera.toward, None, 1, -1, np.zeros(1, dtype=np.int32))
            is_clear[i] = hit < 0 and taxels.normal[i] @ camera.toward > 0
        is_active = layout.radius > 0
        assert len(marks(axes, "shown")) == len(marks(axes, "normals")) == (is_clear & is_active).sum()
        assert len(marks(axes, "hidden")) == (~is_clear & is_active).sum()
        total += (is_clear & is_active).sum()
    assert total > 0 or view == "back"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["xhand1_right", "sharpa_right"])
def test_bundled_hands_show_their_taxels(name: str) -> None:
    """From the front few taxels are hidden (at tips or on the thumb); from the back most are."""
    model, layouts, _ = placed({"tgdsl": 1, "robot": {"model": name}})
    front, back = (drawing(model, layouts, view=view, size=(1500, 500)) for view in ("front", "back"))
    for axes, behind, layout in zip(front.axes, back.axes, layouts.values(), strict=True):
        assert len(marks(axes, "shown")) + len(marks(axes, "hidden")) == layout.num_taxels
        assert len(marks(axes, "shown")) > 0.9 * layout.num_taxels
        assert len(marks(behind, "shown")) < 0.2 * layout.num_taxels
        counts = {group: len(layout.taxels_of(members)) for group, members in layout.groups.items()}
        other = counts["fingers"] - counts["tips"]
        words = [text.get_text() for text in axes.get_legend().get_texts()]
        assert words == [f"palm {counts['palm']}", f"other fingers {other}", f"tips {counts['tips']}"]
        assert counts["palm"] + other + counts["tips"] == counts["hand"] == layout.num_taxels


def test_ticks_start_at_the_discs_and_show_a_wrong_normal(hand: Drawn) -> None:
    model, _ = hand
    right = one_link([[0.005, 0, 0.06], [0.005, 0.02, 0.06]], [[1, 0, 0], [1, 0, 0]])
    wrong = one_link([[0.005, 0, 0.06], [0.005, 0.02, 0.06]], [[1, 0, 0], [0.6, 0, 0.8]])
    ends = [marks(drawing(model, {"x": layout}, size=SMALL).axes[0], "normals") for layout in (right, wrong)]
    lengths = [np.linalg.norm(np.diff(tick_ends, axis=1), axis=-1).ravel() for tick_ends in ends]
    np.testing.assert_allclose(*lengths[0])
    assert lengths[1].max() > 2 * lengths[0].max()
    np.testing.assert_allclose(ends[0][:, 0], marks(drawing(model, {"x": right}, size=SMALL).axes[0], "shown"), atol=1e-6)


def test_discs_lie_in_tangent_planes(hand: Drawn) -> None:
    model, layouts = hand
    layout = layouts["few"]
    taxels, radius = taxels_of(model, pose_of(model, "bent"), layout), radii(layout, layout.pos)
    offsets = discs(taxels, radius) - taxels.pos[:, None]
    np.testing.assert_allclose(np.einsum("tcx,tx->tc", offsets, taxels.normal), 0, atol=TOLERANCE)
    np.testing.assert_allclose(
        np.linalg.norm(offsets, axis=-1), np.broadcast_to(radius[:, None], offsets.shape[:2]), atol=TOLERANCE
    )


def test_discs_do_not_overlap(hand: Drawn) -> None:
    layout = hand[1]["many"]
    distances = np.linalg.norm(layout.pos[:36, None] - layout.pos[None, :36], axis=-1) + np.eye(36)
    assert 2 * radii(layout, layout.pos)[:36].max() < distances.min()


# The camera ----------------------------------------------------------------------------------------------------------


def test_the_front_faces_the_mean_normal_with_the_fingers_up(hand: Drawn) -> None:
    model, layouts = hand
    pose = pose_of(model, None)
    axes = mujoco.MjData(model)
    mujoco.mj_forward(model, axes)
    palm = axes.xmat[model.body("palm").id].reshape(3, 3)
    for view, (azimuth, elevation) in VIEWS.items():
        camera = camera_of(view, model, [layouts["few"]], pose, model.body("palm").id)
        frame = np.stack([camera.right, camera.up, camera.toward])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=TOLERANCE)
        assert np.linalg.det(frame) == pytest.approx(1)
        assert camera.toward @ palm[:, 0] == pytest.approx(np.cos(np.radians(azimuth)) * np.cos(np.radians(elevation)))
        assert camera.up @ palm[:, 2] == pytest.approx(np.cos(np.radians(elevation)))
    assert camera_of("right", model, [layouts["few"]], pose, 1).toward @ palm[:, 1] > 0.9  # the picture's right, seen from +x


def test_the_camera_does_not_follow_the_fingers(hand: Drawn) -> None:
    model, layouts = hand
    straight, bent = (camera_of("iso", model, [layouts["few"]], pose_of(model, name), 1) for name in ("open", "bent"))
    np.testing.assert_allclose(straight, bent, atol=TOLERANCE)


@pytest.mark.parametrize("normal", [[1, 0, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0], [0.6, 0, 0.8]])
def test_the_front_faces_a_pad_of_any_direction(hand: Drawn, normal: list[float]) -> None:
    model, _ = hand
    layout = one_link([[0, 0, 0.04]], [normal])
    pose = pose_of(model, None)
    taxels = taxels_of(model, pose, layout)
    assert camera_of("front", model, [layout], pose, 1).toward @ taxels.normal[0] > 0.65


# Groups and labels ---------------------------------------------------------------------------------------------------


def test_a_link_has_the_colour_of_its_smallest_group(hand: Drawn) -> None:
    _, layouts = hand
    assert group_of(layouts["few"]) == ["all", "tips"]
    assert legend(layouts["few"]) == {"other all": 4, "tips": 6}
    assert legend(layouts["many"]) == {"other all": 36, "tips": 2}  # fillers do not count
    figure = drawing(*hand, size=SMALL)
    parts = {part.get_gid(): part for part in figure.axes[0].collections}
    colours = np.concatenate([parts["hidden"].get_edgecolor(), parts["shown"].get_facecolor()])[:, :3]
    hues = {tuple(hue) for hue in (colours / colours.max(axis=1, keepdims=True)).round(6)}  # shaded discs keep theirs
    assert len(hues) == 2
    marks = np.array([to_rgb(handle.get_color()) for handle in figure.axes[0].get_legend().legend_handles])
    assert {tuple(hue) for hue in (marks / marks.max(axis=1, keepdims=True)).round(6)} == hues


def test_legend_without_groups() -> None:
    layout = one_link([[0, 0, 0]] * 3, [[0, 0, 1]] * 3)
    assert legend(layout) == {"taxels": 3}
    named = one_link([[0, 0, 0]] * 3, [[0, 0, 1]] * 3, groups={"palm": ("palm",)})
    assert legend(named) == {"palm": 3}


def test_titles_name_resolutions_and_count_taxels(hand: Drawn) -> None:
    figure = drawing(*hand, size=SMALL)
    assert [axes.get_label() for axes in figure.axes] == ["few", "many"]
    titles = [[part.get_text() for part in axes.artists[0].get_child().get_children()] for axes in figure.axes]
    assert titles == [["few", "10 taxels"], ["many", "38 taxels and 1 inactive"]]


# The file ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_picture_is_reproducible(hand: Drawn, tmp_path: Path) -> None:
    model, layouts = hand
    first = render(model, layouts, tmp_path / "new" / "first.png")
    assert first == tmp_path / "new" / "first.png"
    assert render(model, layouts, tmp_path / "second.png").read_bytes() == first.read_bytes()
    assert render(model, layouts, tmp_path / "bent.png", keyframe="bent", size=SMALL).read_bytes() != first.read_bytes()
    assert matplotlib.image.imread(first).shape[0] == HEIGHT


def test_a_picture_is_as_high_as_the_command_says(hand: Drawn) -> None:
    """`tgdsl render --help`: by default 750 pixels."""
    figure = drawing(hand[0], {"few": hand[1]["few"]})
    assert figure.get_figheight() * figure.dpi == pytest.approx(750)


def test_panels_are_side_by_side_and_as_wide_as_the_hand_needs(hand: Drawn, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tgdsl.view.render.HEIGHT", 250)  # fewer pixels take less time
    left, right = drawing(*hand, view="top").axes
    for axes in (left, right):
        is_hand = (axes.images[0].get_array() < 0.995).any(axis=2)
        for axis in (0, 1):
            drawn = np.flatnonzero(is_hand.any(axis=axis)) / is_hand.shape[1 - axis]
            assert 0 < drawn[0] < 0.03 and 0.97 < drawn[-1] < 1
    (bar,) = left.lines
    row = left.transAxes.inverted().transform(left.transData.transform(bar.get_xydata()))[:, 1]
    assert (row > 1).all() and (row * left.get_position().height + left.get_position().y0 < 1).all()  # between panel and edge
    left, right = left.get_position(), right.get_position()
    assert 0 < left.x0 < left.x1 < right.x0 < right.x1 < 1 and left.width == pytest.approx(right.width)
    assert left.x0 == pytest.approx(1 - right.x1, abs=0.01)


def test_a_hollow_is_darker_than_the_surface_around_it() -> None:
    """A plate with a block of 2 cm on it: beside the block, and 3 cm from it."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="palm"><geom type="box" size=".05 .05 .005"/>
        <geom type="box" size=".01 .01 .01" pos="0 0 .01"/></body></worldbody></mujoco>"""
    )
    (axes,) = drawing(model, {"x": one_link([[0, 0, 0.02]], [[0, 0, 1]])}, view="0,0", size=(300, 300)).axes
    image = axes.images[0].get_array()[..., 0]
    row = image[len(image) // 2]
    left, right = np.flatnonzero(row < 0.995)[[0, -1]]
    for side in (-1, 1):
        beside, away = (row[round((left + right) / 2 + side * x / 0.1 * (right - left))] for x in (0.013, 0.04))
        assert beside < away - 0.02
        assert away == pytest.approx(row[round((left + right) / 2)], abs=0.03)  # the block's top, which lies in no hollow


def test_the_hand_fills_a_panel_of_the_given_size(hand: Drawn, tmp_path: Path) -> None:
    """In the middle, ink comes within 2.5 pixels of the intended margins."""
    model, layouts = hand
    path = render(model, {"few": layouts["few"]}, tmp_path / "x.png", size=(640, 500))
    image = matplotlib.image.imread(path)[..., :3]
    assert image.shape == (500, 640, 3)
    ink = np.flatnonzero((image[43:457, 20:-20] < 0.995).any(axis=(1, 2)))
    np.testing.assert_allclose([ink[0], ink[-1]], [0.0146 * 415, 415 - 0.0146 * 415], atol=2.5)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"view": "frnt"}, r'^there is no view "frnt"; did you mean "front"\?$'),
        ({"view": "x"}, r'^there is no view "x"; known views: back, bottom, front, iso, left, right, top$'),
        ({"keyframe": "bend"}, r'^the scene has no keyframe "bend"; did you mean "bent"\?$'),
        ({"size": (500, 20)}, rf"^a picture of 500 × 20 pixels is too small, expected at least {MIN_SIZE} of each$"),
    ],
)
def test_invalid_options_are_refused(hand: Drawn, tmp_path: Path, chosen: dict, message: str) -> None:
    with pytest.raises(TgdslError, match=message):
        render(*hand, tmp_path / "x.png", **chosen)
    assert not (tmp_path / "x.png").exists()


def test_layouts_without_taxels_are_refused(hand: Drawn, tmp_path: Path) -> None:
    for empty in ({}, {"x": one_link([[0, 0, 0]], [[0, 0, 1]], radius=np.zeros(1))}):
        with pytest.raises(TgdslError, match=r"^there is nothing to draw: no layout has a taxel$"):
            render(hand[0], empty, tmp_path / "x.png")


def test_an_unwritable_file_is_an_error(hand: Drawn, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file" / "x.png", tmp_path):
        with pytest.raises(TgdslError, match=f"^cannot write {out}: "):
            render(hand[0], {"few": hand[1]["few"]}, out)


# Documents -----------------------------------------------------------------------------------------------------------


def test_a_document_without_sensors_has_all_taxels_and_resolutions(hand: Drawn) -> None:
    assert {name: layout.num_taxels for name, layout in hand[1].items()} == {"few": 10, "many": 39}


def test_a_document_has_the_taxels_of_its_sensors_at_its_resolution(folder: Path) -> None:
    layouts = placed(folder / "hand.yaml").layouts
    assert {name: layout.num_taxels for name, layout in layouts.items()} == {"many": 3}
    layouts = placed(folder / "hand.yaml", resolutions=("many", "few")).layouts
    assert {name: layout.num_taxels for name, layout in layouts.items()} == {"many": 3, "few": 6}
    layouts = placed(folder / "hand.yaml", {"sensors.touch.links": "all", "resolution": "few"}).layouts
    assert {name: layout.num_taxels for name, layout in layouts.items()} == {"few": 10}


def test_progress_names_the_links(folder: Path) -> None:
    messages: list[str] = []
    placed(folder / "bare.yaml", resolutions=("few",), progress=messages.append)
    assert messages[-2:] == ["placing taxels on palm (1 of 2 links)", "placing taxels on finger (2 of 2 links)"]


def test_the_drawn_layout_is_the_compiled_one(folder: Path) -> None:
    plan = tgdsl.compile(folder / "hand.yaml").plan
    drawn = placed(folder / "hand.yaml").layouts["many"]
    assert drawn.links == plan.layout.links
    for name in ("link_id", "pos", "normal", "tangent", "radius", "area", "cell"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(plan.layout, name))


def test_mistakes_of_documents_are_reported(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(TgdslError, match=r'^the layout has no resolution "man"; did you mean "many"\?$'):
        placed(folder / "bare.yaml", resolutions=("man",))
    with pytest.raises(SpecError, match=r'--set resolution=fw: resolution: unknown resolution "fw"; did you mean "few"\?$'):
        placed(folder / "bare.yaml", {"resolution": "fw"})
    (tmp_path / "x.yaml").write_text("tgdsl: 1\nrobot: {model: none.xml, layout: none.yaml}\nobjekts: {}\n")
    with pytest.raises(SpecError) as caught:
        placed(tmp_path / "x.yaml")
    assert len(caught.value.problems) == 3  # the robot, the layout and the key: all in one run
    with pytest.raises(SpecError, match='missing key "sensors"'):
        tgdsl.compile(folder / "bare.yaml")


# The command ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def command(here, folder: Path):
    """Run `tgdsl render` in the folder of the hand; return exit code, output and errors."""
    return lambda *arguments: here(folder, "render", *arguments)


@pytest.mark.slow
def test_command_draws_a_robot_a_document_and_an_artefact(command, folder: Path, tmp_path: Path) -> None:
    out = str(tmp_path / "x.png")
    assert command("hand.xml", "--out", out) == (0, f"few: 10 taxels, many: 39 taxels\npicture: {out}\n", "")
    assert command("bare.yaml", "--resolutions", "few", "-o", out)[1] == f"few: 10 taxels\npicture: {out}\n"
    assert command("hand.xml", "--keyframe", "bent", "--view", "iso", "--size", "600", "400")[1].endswith("picture: hand.png\n")
    assert (folder / "hand.png").is_file()
    assert command("hand.yaml", "-o", out, "--set", "sensors.touch.links=all")[1].startswith("many: 39 taxels\n")
    drawn = Path(out).read_bytes()
    tgdsl.save(tgdsl.compile("hand.yaml", overrides={"sensors.touch.links": "all"}), folder / "hand.safetensors")
    assert command("hand.safetensors", "-o", out)[0] == 0
    assert Path(out).read_bytes() == drawn


@pytest.mark.slow
def test_command_draws_a_robot_by_name(command, tmp_path: Path) -> None:
    out = str(tmp_path / "x.png")
    assert command("xhand1", "--resolutions", "low", "-o", out) == (0, f"low: 90 taxels\npicture: {out}\n", "")


def test_mistakes_of_the_command_are_reported(command, folder: Path, tmp_path: Path) -> None:
    tgdsl.save(tgdsl.compile(folder / "hand.yaml"), folder / "hand.safetensors")
    (tmp_path / "lone.xml").write_text(ROBOT)
    only = 'tgdsl: an artefact has the layout and resolution it was compiled with, "many", and no other\n'
    cases = {
        ("xhand",): 'tgdsl: there is no document, artefact or robot "xhand"; did you mean "xhand1"?\n',
        ("none.yaml",): "none.yaml: cannot read this file: No such file or directory\n1 mistake\n",
        (
            f"{tmp_path}/lone.xml",
        ): f"tgdsl: {tmp_path}/lone.xml: there is no layout.yaml next to this robot; name its layout with --layout\n",
        (
            "bare.yaml",
            "--layout",
            "x.yaml",
        ): "tgdsl: --layout x.yaml: a document names its layout itself; try --set robot.layout=x.yaml\n",
        ("hand.safetensors", "--resolutions", "few"): only,
        ("hand.safetensors", "--set", "resolution=few"): only,
        ("hand.xml", "--view", "bak"): 'tgdsl: there is no view "bak"; did you mean "back"?\n',
    }
    for arguments, message in cases.items():
        assert command(*arguments) == (2, "", message)
