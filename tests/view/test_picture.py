"""Pictures: coloured taxels, their pixels, and errors."""

import struct
import tracemalloc
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from matplotlib.colors import to_rgb

import tgdsl
from tgdsl.compiler.pipeline import placed
from tgdsl.errors import TgdslError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.view.cameras import facing_camera, pose_of
from tgdsl.view.markers import Markers, Pose, is_visible, markers_of
from tgdsl.view.meshes import mesh_of
from tgdsl.view.picture import HeatMaps, _draw_names, chosen_output, distal, drawing, picture, short_names
from tgdsl.view.raster import Camera, Mesh, Viewport, rasterise, shade
from tgdsl.view.scene import rendered, seen
from tgdsl.view.style import REST, new_figure

TOLERANCE = 1e-9  # metres and pixels: centimetres in float64, a rotation and a sum

SCENE = """
<mujoco model="pad"><worldbody>
<geom name="floor" type="plane" size="1 1 .1"/>
<body name="pad" pos="0 0 0.05"><geom name="pad" type="box" size=".03 .03 .005"/></body>
<body name="side" pos="0.1 0 0.05"><geom name="side" type="cylinder" size=".02 .005"/></body>
<body name="cube" pos=".01 0 .0749"><freejoint/><geom name="cube" type="box" size=".02 .02 .02" mass="0.25"/></body>
</worldbody></mujoco>
"""
DOCUMENT = """
tgdsl: 1
robot:
  model: pad.xml
  layout:
    groups: {all: [pad, side]}
    resolutions:
      med:
        pad: {method: grid, rows: 6, columns: 6, direction: [0, 0, -1], radius: 4 mm}
        side:
          method: points
          points:
            - {pos: [0, 0, 0.005], normal: [0, 0, 1], radius: 4 mm}
            - {pos: [0.01, 0, 0.005], normal: [0, 0, 1], radius: 4 mm}
            - {pos: [0, 0, -0.005], normal: [0, 0, -1], radius: 0 mm}
objects: {cube: {body: cube}}
sensors:
  depth: {kind: contact_depth, links: pad, feels: [cube]}
  touch: {kind: kinematic_taxel, links: all, feels: [cube]}
"""


@pytest.fixture(scope="module")
def touch(tmp_path_factory: pytest.TempPathFactory) -> TactileModule:
    folder = tmp_path_factory.mktemp("pad")
    (folder / "pad.xml").write_text(SCENE)
    (folder / "pad.yaml").write_text(DOCUMENT)
    return tgdsl.compile(folder / "pad.yaml")


@pytest.fixture(scope="module")
def sim(touch: TactileModule) -> BatchSimulation:
    sim = tgdsl.simulate(touch, num_envs=2)
    sim.batch.qpos[1, 2] += 0.5  # the second environment's cube is far above
    for _ in range(3):
        sim.step()
    return sim


@pytest.fixture(scope="module")
def readings(touch: TactileModule, sim: BatchSimulation) -> dict[str, torch.Tensor]:
    return touch(sim.state())


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of few pixels, which take less time."""
    monkeypatch.setattr("tgdsl.view.picture.SIZE", (4.0, 2.25))


def markers(touch: TactileModule, sim: BatchSimulation, readings: dict[str, torch.Tensor], name: str, env: int = 0) -> Markers:
    output = next(output for output in touch.outputs if output.name == name)
    return markers_of(touch, sim, output, readings[name], env)


def some_markers(pos: list[list[float]], normal: list[list[float]], value: list[float]) -> Markers:
    columns = (np.array(column, dtype=float) for column in (pos, normal, [0.001] * len(pos), value))
    return Markers(*columns, "depth", "mm")


# Coloured taxels -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env", [0, 1])
def test_exactly_the_active_taxels_are_coloured(touch, sim, readings, env: int) -> None:
    for name, reading in readings.items():
        expected = (reading[env, :, :3] != 0).any(dim=-1).numpy()
        np.testing.assert_array_equal(markers(touch, sim, readings, name, env).is_read, expected)
    assert markers(touch, sim, readings, "depth", 0).is_read.any()
    assert not markers(touch, sim, readings, "depth", 1).is_read.any()


def test_magnitude_is_the_norm_of_channels_with_one_unit(touch, sim, readings) -> None:
    result = markers(touch, sim, readings, "touch")
    assert result.colour_label.startswith("|force| [N] ")
    np.testing.assert_allclose(result.value, readings["touch"][0, :, :3].norm(dim=-1), rtol=1e-6)


def test_small_values_get_a_unit_prefix(touch, sim, readings) -> None:
    result = markers(touch, sim, readings, "depth")
    assert result.colour_label.startswith("depth [mm] ")
    np.testing.assert_allclose(result.value, 1e3 * readings["depth"][0, :, 0].double(), rtol=1e-6)


def test_dots_are_at_the_taxels(touch, sim, readings) -> None:
    result, table = markers(touch, sim, readings, "touch"), touch.taxels["touch"]
    origin = np.where((table["body"] == "pad")[:, None], [0, 0, 0.05], [0.1, 0, 0.05])
    np.testing.assert_allclose(result.pos, table["pos"] + origin, atol=TOLERANCE)
    np.testing.assert_array_equal(result.size == 0, table["radius"] == 0)


def test_summary_adds_forces_but_not_depths() -> None:
    depth = some_markers([[0, 0, 0]] * 3, [[0, 0, 1]] * 3, [1.0, 2.0, 0.0])
    assert depth.summary() == "max 2 mm"
    assert depth.summary(np.array([2])) == "0 mm"
    force = Markers(depth.pos, depth.normal, depth.size, depth.value, "|force|", "N")
    assert force.summary() == "Σ 3 N · max 2 N"
    contact = Markers(depth.pos, depth.normal, depth.size, np.sign(depth.value), "contact", "")
    assert contact.summary() == "Σ 2"


def test_the_view_has_a_dot_at_each_taxel_and_hotter_ones_last(touch, sim, small) -> None:
    """Pixels of an orthographic view are a linear map of positions: fit it to all dots but check each."""
    depth = 1e-4 * (1.0 + torch.randperm(36, generator=torch.Generator().manual_seed(0)))
    figure = drawing(touch, sim, {"depth": depth.expand(2, 36)[..., None]})
    title, facts, *_ = (text.get_text() for text in figure.texts)
    counted = "36 of 36 taxels touched (above 1 µm)"
    assert title == "depth"
    assert facts.split("   ·   ") == ["contact_depth", "resolution med", counted, "depth max 3.6 mm", "environment 0"]
    axes = figure.axes[0]
    image = axes.images[0].get_array()
    for border in (image[0], image[-1], image[:, 0], image[:, -1]):
        assert (border == 1).all()  # nothing is cut off
    (dots,) = (part for part in axes.collections if part.get_array() is not None)
    order = depth.argsort().numpy()
    np.testing.assert_allclose(dots.get_array(), 1e3 * depth[order], rtol=1e-6)
    assert dots.get_clim() == pytest.approx((0, 3.6))
    places = np.column_stack([touch.taxels["depth"]["pos"][order], np.ones(36)])
    pixels = np.asarray(dots.get_offsets())
    np.testing.assert_allclose(places @ np.linalg.lstsq(places, pixels, rcond=None)[0], pixels, atol=1e-6)
    assert np.ptp(pixels, axis=0).min() > 50


def test_the_most_touched_link_has_the_first_map(touch, sim, small, monkeypatch) -> None:
    links = touch.taxels["touch"]["link"]
    for first, num in (("pad", 2), ("side", 1)):
        monkeypatch.setattr("tgdsl.view.picture.MAX_MAPS", num)
        force = torch.from_numpy(np.where(links == first, 2.0, 0.01)).expand(2, -1)[..., None].expand(-1, -1, 6)
        figure = drawing(touch, sim, {"touch": force}, title="A pad")
        maps = [axes.get_label() for axes in figure.axes if axes.get_label() in links]
        names = [text for text in figure.axes[0].texts if text.get_text() in links]
        assert maps == (["pad", "side"] if num > 1 else ["side"]) and {text.get_text() for text in names} == set(maps)
        texts = [text.get_text() for text in figure.texts]
        assert "A pad" in texts and any(text.startswith("touch   ·   kinematic_taxel   ·   ") for text in texts)
        rest = [text for text in texts if "not shown" in text]
        assert rest == ([] if num > 1 else ["not shown: 1 of 2 links, touched less or not at all"])


def test_names_of_links_at_one_place_do_not_cover_each_other() -> None:
    viewport = Viewport(Camera(*np.eye(3), np.zeros(3)), np.zeros(2), 1000.0, 200, 100)
    axes = new_figure(2, 1).add_subplot()
    _draw_names(axes, viewport, {name: np.array([0.02, 0.05, 0.0]) for name in "abc"})
    rows = [text.get_position()[1] for text in axes.texts]
    assert rows[0] == pytest.approx(50) and np.diff(rows).min() > 2


def test_maps_have_grey_cells_where_nothing_is_read_and_no_frame(touch, sim, small) -> None:
    depth = torch.zeros(2, 36, 1, dtype=torch.float64)
    figure = drawing(touch, sim, {"depth": depth})
    assert "depth: nothing is touched" in [text.get_text() for text in figure.texts]
    depth[:, 0] = 1e-3
    _, pad, bar = drawing(touch, sim, {"depth": depth}).axes
    assert bar.get_title() == "depth [mm]   (grey: up to 1 µm)" and bar.get_xlim() == (0, 1)
    (cells,) = pad.collections
    cells.update_scalarmappable()
    is_grey = np.isclose(cells.get_facecolor()[:, :3], to_rgb(REST)).all(axis=1)
    assert is_grey.sum() == 35 and pad.get_aspect() == pytest.approx(1)
    assert not any(spine.get_visible() for spine in pad.spines.values())


def test_objects_are_blue_before_the_robot_and_hidden_behind_it(touch, sim, readings) -> None:
    """The cube on the pad covers 40 × 40 mm."""
    for view, side in (("0,0", 0.04), ("180,0", 0.0)):
        in_view = seen(touch, sim, markers(touch, sim, readings, "depth"), 0, 400, 400, view)
        image = rendered(in_view).image
        is_blue = image[..., 2] - image[..., 0] > 0.1
        assert is_blue.sum() == pytest.approx((side * in_view.viewport.scale / 2) ** 2, rel=0.05)


def test_paint_is_darkened_never_lightened(touch, sim, readings) -> None:
    """Grey paint on the pad, whose sides are shaded."""
    view = seen(touch, sim, markers(touch, sim, readings, "depth", env=1), 1, 200, 200, "back")
    drawn = rendered(view, lambda pos, body: np.full((len(pos), 3), 0.5))
    is_robot = (drawn.fragments.face.reshape(100, 2, 100, 2) >= 0).all(axis=(1, 3))
    colours = drawn.image[is_robot]
    assert colours.max() <= 0.5 + 1e-9 and colours.min() < 0.49


# Camera and pixels ---------------------------------------------------------------------------------------------------


def test_projection_matches_values_by_hand() -> None:
    """Seen along −x with z up: y points right, and nearness is x."""
    camera = Camera(np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(camera.project(np.array([0.5, 0.25, 0.1])), [0.05, -0.2, 0.4], atol=TOLERANCE)


@pytest.mark.parametrize("normal", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.6, 0, 0.8], [0, -1, 0]])
def test_active_taxels_face_the_camera(normal: list[float]) -> None:
    away = [-part for part in normal]
    camera = facing_camera(some_markers([[0, 0, 0.1], [0, 0.1, 0]], [normal, away], [3.0, 1.0]), np.zeros(3))
    axes = np.stack([camera.right, camera.up, camera.toward])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=TOLERANCE)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert camera.toward @ normal > 0.85


def test_the_nearer_triangle_wins() -> None:
    """A square of 4 × 4 pixels at nearness 1 behind a triangle at nearness 2 that covers its lower left half."""
    square = [[[0, 0, 1], [3, 0, 1], [3, 3, 1]], [[0, 0, 1], [3, 3, 1], [0, 3, 1]]]
    fragments = rasterise(np.array([*square, [[0, 0, 2], [3, 0, 2], [0, 3, 2]]], dtype=float), 6, 5)
    column, row = np.meshgrid(np.arange(6), np.arange(5))
    expected = np.where((column < 4) & (row < 4), np.where(column + row <= 3, 2.0, 1.0), -np.inf)
    np.testing.assert_allclose(fragments.nearness, expected, atol=TOLERANCE)
    np.testing.assert_array_equal(fragments.face == 2, expected == 2)


def test_nearness_is_interpolated() -> None:
    corners = np.array([[[-2.0, -2, 0], [20, -2, 22], [-2, 20, 44]]])
    fragments = rasterise(corners, 5, 4)
    column, row = np.meshgrid(np.arange(5), np.arange(4))
    np.testing.assert_allclose(fragments.nearness, (column + 2) + 2 * (row + 2), atol=TOLERANCE)


def test_a_surface_is_lit_from_the_upper_right_and_has_dark_edges() -> None:
    """A square on pixels 2 to 5 of 8, half a metre before an empty background of 0.9."""
    corners = np.array([[[2.0, 2, 500], [5, 2, 500], [5, 5, 500]], [[2, 2, 500], [5, 5, 500], [2, 5, 500]]]) / 1000
    viewport = Viewport(Camera(*np.eye(3), np.zeros(3)), np.zeros(2), 1000.0, 8, 8)

    def shaded(normal: list[float]) -> np.ndarray:
        mesh = Mesh(corners, np.broadcast_to(np.array(normal), (2, 3, 3)), np.zeros(2, dtype=np.int64))
        fragments = rasterise(viewport.project(corners), 8, 8)
        return shade(np.full((8, 8, 3), 0.9), fragments, mesh, np.full((2, 3), 0.5), viewport)[..., 0]

    towards_light, flat, away = (shaded([0.6 * side, 0, 0.8] if side else [0, 0, 1]) for side in (1, 0, -1))
    assert towards_light[3, 3] > away[3, 3] and flat[3, 3] > away[3, 3]
    assert shaded([0, 0.6, 0.8])[3, 3] > shaded([0, -0.6, 0.8])[3, 3]
    np.testing.assert_allclose(shaded([0, 0, -1]), flat)  # surfaces have two sides
    assert flat[3, 3] == pytest.approx(flat[2, 4]) and flat[7, 7] == 0.9
    assert max(flat[5, 2:6].max(), flat[2:6, 5].max()) < 0.8 * flat[3, 3]


def test_many_overlapping_triangles_take_little_memory() -> None:
    """Forty triangles over half of 300 × 300 pixels are 1.8 million fragments; the picture takes 3.6 MB."""
    corners = np.array([[[0, 0, i], [299, 0, i], [0, 299, i]] for i in range(40)], dtype=float)
    tracemalloc.start()
    fragments = rasterise(corners, 300, 300)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert set(np.unique(fragments.face)) == {-1, 39}
    assert peak < 60e6


def test_hidden_taxels_are_not_visible() -> None:
    fragments = rasterise(np.array([[[0.0, 0, 0.01], [9, 0, 0.01], [0, 9, 0.01]]]), 10, 10)
    camera = Camera(*np.eye(3), np.zeros(3))
    taxels = some_markers([[0, 0, 0]] * 4, [[0, 0, 1]] * 3 + [[0, 0, -1]], [1.0] * 4)
    positions = np.array(
        [[2, 2, 0.01], [2, 2, 0.0], [8, 8, 0.0], [2, 2, 0.01]]
    )  # on the triangle, behind it, next to it, turned away
    np.testing.assert_array_equal(is_visible(taxels, positions, fragments, camera), [True, False, True, False])


@pytest.mark.parametrize(
    ("shape", "size", "half"),
    [
        ("box", ".01 .02 .03", [0.01, 0.02, 0.03]),
        ("sphere", ".02", [0.02, 0.02, 0.02]),
        ("capsule", ".01 .02", [0.01, 0.01, 0.03]),
        ("cylinder", ".01 .02", [0.01, 0.01, 0.02]),
        ("ellipsoid", ".01 .02 .03", [0.01, 0.02, 0.03]),
    ],
)
def test_shapes_have_mujocos_poses(touch, shape: str, size: str, half: list[float]) -> None:
    geom = f'<geom type="{shape}" size="{size}" pos="0.1 0 0" quat="1 0 1 0"/>'  # z of the geom is x of the body
    scene = SCENE.replace("</worldbody>", f'<body name="it" pos="0 0 1" quat="1 0 0 1">{geom}</body></worldbody>')
    spec = tgdsl.instrument(mujoco.MjSpec.from_string(scene), touch.inputs)
    sim = BatchSimulation(touch, 1, model=spec.compile())
    pose = Pose(sim.batch.xpos[0], sim.batch.xquat[0])
    mesh = mesh_of(sim.batch.get_model(0), pose, {sim.model.body("it").id})
    points = mesh.corners.reshape(-1, 3)
    expected = np.array([half[1], half[2], half[0]])  # x of the body is y of the world
    centre = np.array([0, 0.1, 1])
    np.testing.assert_allclose(points.min(axis=0), centre - expected, atol=1e-4)
    np.testing.assert_allclose(points.max(axis=0), centre + expected, atol=1e-4)
    outward = mesh.corners.mean(axis=1) - centre
    assert ((mesh.normals.mean(axis=1) * outward).sum(axis=1) > 0).all()
    has_edges = shape in ("box", "cylinder")  # a face's corners share a normal there; a round surface has one for each corner
    assert (np.ptp(mesh.normals, axis=1).max(axis=1) < 1e-9).all() == has_edges


def test_short_names_drop_the_common_prefix() -> None:
    names = short_names(["right_hand_link", "right_hand_mid_link2", "right_hand_thumb_rota_link1"])
    assert list(names.values()) == ["hand_link", "mid_link2", "thumb_rota_link1"]
    assert short_names(["pad"]) == {"pad": "pad"}
    assert short_names(["pad", "side"]) == {"pad": "pad", "side": "side"}


# The maps ------------------------------------------------------------------------------------------------------------

FINGER = """
<mujoco><worldbody>
<body name="palm" pos="0 0 .1" euler="0 0 20">
  <geom type="box" size=".03 .02 .01"/>
  <body name="near" pos=".04 0 0"><joint axis="0 1 0"/><geom type="box" size=".02 .01 .01" pos=".02 0 0"/>
    <body name="far" pos=".05 0 0"><joint axis="0 1 0"/><geom type="box" size=".02 .01 .01" pos=".02 0 0"/></body>
  </body>
</body>
<body name="ball" pos="0 0 1"><freejoint/><geom size=".01"/></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("joint", ["type='slide' axis='0 1 0'", "type='hinge' axis='1 0 0' pos='0 0 .03'"])
def test_a_jaw_with_its_origin_in_the_middle_points_away_from_its_mount(joint: str) -> None:
    """It hangs below the mount with taxels around its origin, which do not tell the distal end."""
    jaw = f"<body name='jaw' pos='0 .03 -.05'><joint {joint}/><geom type='box' size='.01 .004 .03'/></body>"
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><body name='mount'><geom size='.01'/>{jaw}</body></worldbody></mujoco>"
    )
    along, is_tip = distal(model, "jaw", np.array([[0.0, -0.004, z] for z in (-0.02, 0.0, 0.02)]))
    assert is_tip and along[2] < 0 and abs(along[2]) > abs(along[:2]).max()


@pytest.mark.parametrize("along", [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
def test_maps_have_the_distal_end_up_as_seen_from_outside(tmp_path: Path, small: None, along: list[int]) -> None:
    """The finger runs along x, its taxels face z: the map's up is x and its right −y, for any direction of columns."""
    (tmp_path / "finger.xml").write_text(FINGER)
    grid = {"method": "grid", "rows": 3, "columns": 3, "direction": [0, 0, -1], "columns_along": along, "radius": 0.004}
    layout = {
        "palm": grid,
        "near": {"method": "poisson", "count": 12, "radius": 0.004, "region": {"facing": [0, 0, 1], "within": 0.1}},
        "far": grid,
    }
    module = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "finger.xml"), "layout": {"resolutions": {"o": layout}}},
            "objects": {"ball": {"body": "ball"}},
            "sensors": {"depth": {"kind": "contact_depth", "links": "*", "feels": ["ball"]}},
        }
    )
    table = module.taxels["depth"]
    value = 0.01 + 0.1 * table["pos"][:, 0] + 0.03 * table["pos"][:, 1]
    sim = tgdsl.simulate(module, num_envs=1)
    figure = drawing(module, sim, {"depth": torch.tensor(value)[None, :, None]})
    maps = {axes.get_label(): axes for axes in figure.axes if axes.get_label() in ("palm", "near", "far")}
    x, y, _ = np.ptp(table["pos"][table["link"] == "palm"], axis=0)
    image = HeatMaps(sim.model, table).image(
        np.where(table["link"] == "palm", 7, 9)[:, None].repeat(3, axis=1).astype(np.uint8)
    )
    high, wide = np.ptp(np.argwhere((image == 7).all(axis=2)), axis=0) + 1
    assert maps["palm"].get_aspect() == pytest.approx(x / y) and high / wide == pytest.approx(x / y, rel=0.02)
    for name in ("palm", "far"):
        taxels = table["link"] == name
        order = np.lexsort((-table["pos"][taxels, 1].round(6), -table["pos"][taxels, 0].round(6)))
        np.testing.assert_allclose(maps[name].collections[0].get_array().ravel(), 1e3 * value[taxels][order])
    x, y = np.asarray(maps["near"].collections[0].get_offsets()).T
    taxels = table["pos"][table["link"] == "near"]
    np.testing.assert_allclose(x, -1e3 * taxels[:, 1], atol=1e-6)
    np.testing.assert_allclose(y, 1e3 * taxels[:, 0], atol=1e-6)
    marks = {name: [text.get_text() for text in axes.texts] for name, axes in maps.items()}
    assert marks == {"palm": ["▲ distal"], "near": ["▲ distal"], "far": ["▲ tip"]}
    named = {text.get_text() for text in figure.axes[0].texts}
    assert {axes.get_title().splitlines()[0] for axes in maps.values()} <= named


def test_a_link_on_a_visual_mesh_is_drawn_with_it(tmp_path: Path) -> None:
    """An OBJ file with two objects: a visual box of 20 × 20 × 60 mm around a colliding core of 10 mm."""
    boxes = [trimesh.creation.box((0.02, 0.02, 0.03)).apply_translation((0, 0, z)) for z in (-0.015, 0.015)]
    lines, count = [], 1
    for i, box in enumerate(boxes):
        lines += [f"o part{i}", *(f"v {x} {y} {z}" for x, y, z in box.vertices)]
        lines += [f"f {a} {b} {c}" for a, b, c in box.faces + count]
        count += len(box.vertices)
    (tmp_path / "skin.obj").write_text("\n".join(lines))
    (tmp_path / "hand.xml").write_text(
        """<mujoco><asset><mesh name="skin" file="skin.obj"/></asset><worldbody><body name="tip">
        <geom type="mesh" mesh="skin" contype="0" conaffinity="0"/><geom type="box" size=".005 .005 .005"/>
        </body></worldbody></mujoco>"""
    )
    grid = {"method": "grid", "rows": 6, "columns": 2, "direction": [-1, 0, 0], "radius": 0.004}
    with pytest.warns(UserWarning, match="read whole"):
        model, layouts, _ = placed(
            {"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": {"resolutions": {"o": {"skin": grid}}}}}
        )
    body, pose = {model.body("tip").id}, pose_of(model, None)
    skin = mesh_of(model, pose, body, layouts["o"].links).corners.reshape(-1, 3)
    np.testing.assert_allclose([skin.min(axis=0), skin.max(axis=0)], [[-0.01, -0.01, -0.03], [0.01, 0.01, 0.03]], atol=1e-7)
    assert np.abs(mesh_of(model, pose, body).corners).max() == pytest.approx(0.005)


# The file ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_picture_writes_a_png(touch, sim, readings, tmp_path: Path) -> None:
    path = picture(touch, sim, readings, tmp_path / "new" / "touch.png", env=1, reading="depth", title="A pad")
    header = path.read_bytes()[:24]
    assert path == tmp_path / "new" / "touch.png"
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", header[16:]) == (1600, 900)


def test_the_default_reading_is_the_kinematic_taxel(touch, readings) -> None:
    assert list(readings) == ["depth", "touch"]
    assert chosen_output(touch, readings).name == "touch"
    assert chosen_output(touch, readings, "depth").name == chosen_output(touch, {"depth": readings["depth"]}).name == "depth"


def test_an_unknown_reading_is_refused(touch, sim, readings, tmp_path: Path) -> None:
    with pytest.raises(TgdslError, match=r'^there is no reading "dept"; did you mean "depth"\?$'):
        picture(touch, sim, readings, tmp_path / "x.png", reading="dept")


@pytest.mark.parametrize("env", [-1, 2])
def test_an_environment_out_of_range_is_refused(touch, sim, readings, tmp_path: Path, env: int) -> None:
    with pytest.raises(TgdslError, match=rf"^environment {env} does not exist, expected 0 to 1$"):
        picture(touch, sim, readings, tmp_path / "x.png", env=env)


def test_readings_of_another_module_are_refused(touch, sim, tmp_path: Path) -> None:
    with pytest.raises(TgdslError, match=r"^there is nothing to draw: the readings given hold none of this module's taxels$"):
        picture(touch, sim, {}, tmp_path / "x.png")
