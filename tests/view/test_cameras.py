"""Cameras, touched taxels and sums of pictures, against MuJoCo's rays and sums by hand."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.rollout import held_controls, rollout
from tgdsl.view.cameras import VIEWS, ViewError, angles_of, best_camera, camera_of, facing_camera
from tgdsl.view.markers import Markers, Pose, markers_of, touched
from tgdsl.view.meshes import mesh_of
from tgdsl.view.picture import drawing as picture_of
from tgdsl.view.picture import picture
from tgdsl.view.raster import Camera
from tgdsl.view.table import table

FINGER = """
<mujoco>
  <worldbody>
    <body name="palm">
      <geom name="palm" type="box" size=".005 .04 .05"/>
      <body name="tip" pos=".03 0 .02">
        <joint axis="0 1 0"/>
        <geom name="tip" type="box" size=".005 .01 .02"/>
      </body>
    </body>
    <body name="ball" pos=".022 0 .02"><freejoint/><geom type="sphere" size=".004"/></body>
  </worldbody>
</mujoco>
"""
"""A fingertip whose taxels face the palm, which hides them."""


def finger(folder: Path, side: list[float]) -> tuple[tgdsl.TactileModule, BatchSimulation]:
    (folder / "finger.xml").write_text(FINGER)
    grid = {"method": "grid", "rows": 4, "columns": 3, "direction": side, "radius": 0.004}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(folder / "finger.xml"), "layout": {"resolutions": {"o": {"tip": grid}}}},
            "objects": {"ball": {"body": "ball"}},
            "sensors": {"depth": {"kind": "contact_depth", "links": "tip", "feels": ["ball"], "gate": "geometric"}},
        }
    )
    return touch, tgdsl.simulate(touch, 1)


def num_in_view(sim: BatchSimulation, markers: Markers, camera: Camera) -> int:
    """Return how many taxels can see the camera, by MuJoCo's rays; the ball hides none."""
    state = mujoco.MjData(sim.model)
    mujoco.mj_forward(sim.model, state)
    ball, count = sim.model.body("ball").id, 0
    for start, normal in zip(markers.pos + 1e-6 * markers.normal, markers.normal, strict=True):
        hit = mujoco.mj_ray(sim.model, state, start, camera.toward, None, 1, ball, np.zeros(1, dtype=np.int32))
        count += hit < 0 and normal @ camera.toward > 0
    return count


def cameras(touch, sim) -> tuple[Markers, Camera, Camera]:
    """Return the taxels, the camera that they face, and the chosen one."""
    state = sim.state()
    markers = markers_of(touch, sim, touch.outputs[0], touch(state)["depth"], 0)
    pose, palm = Pose(*sim.body_poses(0)), sim.model.body("palm").id
    hand = mesh_of(sim.model, pose, {palm, sim.model.body("tip").id})
    chosen = best_camera(markers, hand, sim.model, touch.plan.layout, pose, palm)
    return markers, facing_camera(markers, pose.pos[palm]), chosen


def test_a_fingertip_is_not_drawn_from_behind(tmp_path):
    touch, sim = finger(tmp_path, [1, 0, 0])
    sim.batch.qpos[:, 1] += 0.5  # nothing is touched, so all taxels count
    sim.step()
    markers, facing, chosen = cameras(touch, sim)
    assert num_in_view(sim, markers, facing) == 0
    layout, pose = touch.plan.layout, Pose(*sim.body_poses(0))
    most_in_view = max(num_in_view(sim, markers, camera_of(view, sim.model, [layout], pose, 1)) for view in VIEWS)
    assert num_in_view(sim, markers, chosen) >= max(most_in_view, 1)


def test_a_camera_that_shows_enough_is_kept(tmp_path):
    touch, sim = finger(tmp_path, [-1, 0, 0])
    markers, facing, chosen = cameras(touch, sim)
    assert num_in_view(sim, markers, facing) == len(markers.pos)
    for part, expected in zip(chosen, facing, strict=True):
        np.testing.assert_array_equal(part, expected)


def test_touched_taxels_take_precedence(tmp_path):
    touch, sim = finger(tmp_path, [1, 0, 0])
    sim.step()
    markers, _, chosen = cameras(touch, sim)
    assert 0 < markers.is_read.sum() < len(markers.pos)
    touched_markers = Markers(
        *(getattr(markers, name)[markers.is_read] for name in ("pos", "normal", "size", "value")), "depth", "mm"
    )
    assert num_in_view(sim, touched_markers, chosen) == markers.is_read.sum()


@pytest.mark.parametrize(
    ("view", "angles"), [*VIEWS.items(), ("30,20", (30, 20)), ("-90, -90", (-90, -90)), ("1e2,0", (100, 0))]
)
def test_views_have_angles(view, angles):
    assert angles_of(view) == angles


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ("frnt", 'there is no view "frnt"; did you mean "front"?'),
        ("30", 'there is no view "30"; known views: '),
        ("30,", 'there is no view "30,"; expected azimuth and elevation in degrees, the latter from -90 to 90'),
        ("0,91", 'there is no view "0,91"; expected azimuth and elevation in degrees, '),
        ("nan,0", 'there is no view "nan,0"; expected azimuth and elevation in degrees, '),
        ("1,2,3", 'there is no view "1,2,3"; expected azimuth and elevation in degrees, '),
    ],
)
def test_invalid_views_are_refused(view, message):
    with pytest.raises(ViewError) as caught:
        angles_of(view)
    assert str(caught.value).startswith(message)


def test_angles_turn_about_the_hand(tmp_path):
    """By definition: azimuth about the up axis from the mean normal, then elevation."""
    touch, sim = finger(tmp_path, [-1, 0, 0])
    layout, pose = touch.plan.layout, Pose(*sim.body_poses(0))
    for azimuth, elevation in ((0, 0), (90, 0), (0, 90), (35, 20), (200, -40)):
        toward = camera_of(f"{azimuth},{elevation}", sim.model, [layout], pose, 1).toward
        a, r = np.radians([azimuth, elevation])
        np.testing.assert_allclose(toward, [np.cos(r) * np.cos(a), np.cos(r) * np.sin(a), np.sin(r)], atol=1e-9)


# Touched taxels and sums

PAD = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos=".012 0 .029"><freejoint/><geom type="box" size=".02 .02 .02" mass=".25"/></body>
  </worldbody>
</mujoco>
"""


SENSOR = {"kind": "kinematic_taxel", "outputs": ["force"], "normal_stiffness": 500}


def pad(folder: Path, sensor: dict[str, object] = SENSOR, **more: object) -> tuple[tgdsl.TactileModule, BatchSimulation]:
    (folder / "pad.xml").write_text(PAD)
    grid = {"method": "grid", "rows": 6, "columns": 6, "direction": [0, 0, -1], "radius": 0.004}
    module = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(folder / "pad.xml"), "layout": {"resolutions": {"o": {"pad": grid}}}},
            "objects": {"cube": {"body": "cube"}},
            "sensors": {"touch": {**sensor, "links": "pad", "feels": ["cube"], **more}},
        }
    )
    return module, tgdsl.simulate(module, 2)


NOISE = {"white_noise": 0.05}
BIT = {"kind": "contact", "noise": {"white_noise": 0.001}}


@pytest.mark.parametrize("more", [{}, {"readout": "both"}, {"rate": "100 Hz"}, {"history": 3}, {"sensor": BIT}])
@pytest.mark.parametrize("env", [0, 1])
def test_noise_does_not_count_as_touch(tmp_path, more, env):
    """The cube's footprint by hand in the first environment; in the second it is far above."""
    touch, sim = pad(tmp_path, **({} if "sensor" in more else {"noise": NOISE}), **more)
    sim.batch.qpos[1, 2] += 0.5
    *_, last = rollout(touch, sim, held_controls(sim.model, 0.02, sim.control_step))
    output = touch.outputs[0]
    before = {name: value.clone() for name, value in touch.state_dict().items()}
    is_touched = touched(touch, sim, output, last.readings, env)
    torch.testing.assert_close(dict(touch.state_dict()), before, rtol=0, atol=0)
    pos = touch.taxels["touch"]["pos"]
    # A probe's sphere of 4 mm reaches beyond the cube's sides by less than the distance to the next taxel.
    under = (np.abs(pos[:, 0] - 0.012) < 0.02) & (np.abs(pos[:, 1]) < 0.02)
    near = (np.abs(pos[:, 0] - 0.012) < 0.024) & (np.abs(pos[:, 1]) < 0.024)
    assert is_touched is not None
    assert (is_touched | ~under).all() if env == 0 else not is_touched.any()
    assert not (is_touched & ~near).any()
    assert markers_of(touch, sim, output, last.readings["touch"], env).is_read.sum() > is_touched.sum()


def test_without_noise_every_active_taxel_is_touched(tmp_path):
    touch, sim = pad(tmp_path)
    sim.step()
    readings = touch(sim.state())
    assert touched(touch, sim, touch.outputs[0], readings, 0) is None
    assert markers_of(touch, sim, touch.outputs[0], readings["touch"], 0).is_touched.any()


def test_table_and_picture_agree_on_sums(tmp_path):
    """Both give the norm of the summed force, with partly cancelling shear; the headline starts with the sum of norms."""
    touch, sim = pad(tmp_path)
    sim.step()
    force = torch.randn(2, 36, 3, generator=torch.Generator().manual_seed(1)).double() + torch.tensor([0, 0, -1.0])
    markers = markers_of(touch, sim, touch.outputs[0], force, 0)
    expected = force[0].sum(dim=0).norm().item()
    assert markers.summary() == f"|Σ| {expected:.3g} N · max {force[0].norm(dim=-1).max().item():.2g} N"
    sizes = force[0].norm(dim=-1).sum().item()
    assert markers.headline.startswith(f"Σ |force| {sizes:.3g} · |Σ force| {expected:.3g} · max ")
    assert table(touch, {"touch": force})[2].split()[1] == f"{expected:.3f}"
    small = markers_of(touch, sim, touch.outputs[0], 0.01 * force, 0)
    assert small.summary().startswith(f"|Σ| {10 * expected:.3g} mN")


def test_rounding_does_not_count_as_touch(tmp_path):
    touch, sim = pad(tmp_path)
    force = torch.zeros(2, 36, 3)
    force[0, :, 2] = torch.tensor([-2.0, 0.0011, 0.0009, 1e-7] * 9)
    markers = markers_of(touch, sim, touch.outputs[0], force, 0)
    np.testing.assert_array_equal(markers.is_touched, [True, True, False, False] * 9)
    assert markers.threshold_label == "1 mN"
    figure = picture_of(touch, sim, {"touch": force})
    assert any("18 of 36 taxels touched (above 1 mN)" in text.get_text() for text in figure.texts)


def test_opposed_forces_do_not_hide_the_load(tmp_path):
    """36 forces of 0.5 N whose vector sum is float32's rounding."""
    touch, sim = pad(tmp_path)
    force = torch.zeros(1, 36, 3)
    force[0, :, 0] = torch.tensor([0.5, -0.5] * 18)
    force[0, 0, 0] += 1e-7
    markers = markers_of(touch, sim, touch.outputs[0], force, 0)
    assert markers.headline == "Σ |force| 18 · |Σ force| 0 · max 0.5 N"


GRIPPER = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 .3" euler="180 0 0">
      <geom type="cylinder" size=".01 .02"/>
      <body name="left" pos=".03 0 .05"><joint type="slide" axis="1 0 0"/><geom type="box" size=".006 .01 .03"/></body>
      <body name="right" pos="-.03 0 .05"><joint type="slide" axis="1 0 0"/><geom type="box" size=".006 .01 .03"/></body>
    </body>
    <body name="ball"><freejoint/><geom type="sphere" size=".01"/></body>
  </worldbody>
</mujoco>
"""


def gripper(folder: Path, left_direction: int, tilt: float = 0.0) -> tuple[tgdsl.TactileModule, BatchSimulation]:
    """Return a gripper, tilted about y [degrees], whose taxels lie in opposite directions along x."""
    (folder / "gripper.xml").write_text(GRIPPER.replace('"180 0 0"', f'"180 {tilt} 0"'))
    grid = {"method": "grid", "rows": 4, "columns": 3, "radius": 0.004}
    links = {
        "left": {**grid, "direction": [left_direction, 0, 0]},
        "right": {**grid, "direction": [-left_direction, 0, 0]},
    }
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(folder / "gripper.xml"), "layout": {"resolutions": {"o": links}}},
            "objects": {"ball": {"body": "ball"}},
            "sensors": {"touch": {**SENSOR, "links": "*", "feels": ["ball"]}},
        }
    )
    return touch, tgdsl.simulate(touch, 1)


def best_camera_of_gripper(touch, sim, force: torch.Tensor) -> tuple[Markers, Camera]:
    """Return the taxels that read forces, and the chosen camera."""
    pose, base = Pose(*sim.body_poses(0)), sim.model.body("base").id
    markers = markers_of(touch, sim, touch.outputs[0], force, 0)
    hand = mesh_of(sim.model, pose, {sim.model.body(name).id for name in ("base", "left", "right")})
    return markers, best_camera(markers, hand, sim.model, touch.plan.layout, pose, base)


@pytest.mark.parametrize("tilt", [0, 30])
def test_a_hanging_gripper_is_upright_and_shows_a_pad(tmp_path, tilt):
    """Its pads face each other; elevation counts from the horizon."""
    touch, sim = gripper(tmp_path, 1, tilt)
    markers, best = best_camera_of_gripper(touch, sim, torch.ones(1, 24, 3))
    for camera in (camera_of("front", sim.model, [touch.plan.layout], Pose(*sim.body_poses(0)), 1), best):
        assert camera.toward[2] == pytest.approx(np.sin(np.radians(VIEWS["front"][1])))
        assert camera.up[2] == pytest.approx(np.cos(np.radians(VIEWS["front"][1])))
        assert 0.4 < abs(camera.toward[0]) < 0.8  # along the normals; 0 would be edge-on
        assert num_in_view(sim, markers, camera) == 12  # all of one pad


@pytest.mark.parametrize("pad", ["left", "right"])
def test_the_one_pad_that_is_touched_is_faced(tmp_path, pad):
    """The pads look away from each other, so none hides the other."""
    touch, sim = gripper(tmp_path, -1)
    is_touched = torch.from_numpy(touch.taxels["touch"]["link"] == pad)
    markers, camera = best_camera_of_gripper(touch, sim, is_touched[None, :, None] * torch.ones(3))
    assert (markers.normal[is_touched.numpy()] @ camera.toward).min() > 0.85


def test_names_of_links_are_at_the_nearer_edge_with_a_line_to_the_taxels(tmp_path, monkeypatch):
    monkeypatch.setattr("tgdsl.view.picture.SIZE", (4.0, 2.25))  # of few pixels, which take less time
    touch, sim = gripper(tmp_path, 1)
    axes, *maps, _ = picture_of(touch, sim, {"touch": torch.ones(1, 24, 3)}).axes
    places = np.concatenate([part.get_offsets() for part in axes.collections])
    is_left = places[:, 0] < places[:, 0].mean()
    left, right = sorted((text for text in axes.texts if text.get_text() in ("left", "right")), key=lambda text: text.xy[0])
    for text, is_side, edge in ((left, is_left, 0), (right, ~is_left, np.ptp(axes.get_xlim()))):
        assert is_side.sum() == 12
        np.testing.assert_allclose(text.xy, places[is_side].mean(axis=0), atol=1e-6)
        assert text.get_position() == (edge, text.xy[1])
    assert (left.get_ha(), right.get_ha()) == ("left", "right")
    for each in maps:
        assert each.get_position().y1 < 0.9  # below the title
        assert each.get_aspect() == 2.5  # cells of 20 mm × 5 mm; more would be too narrow


@pytest.mark.slow
def test_run_draws_from_the_given_view(tmp_path, here):
    view = "-60,25"
    touch, sim = pad(tmp_path, noise=NOISE)
    sim.step()
    readings = touch(sim.state())
    pictures = [
        picture(touch, sim, readings, tmp_path / f"{i}.png", view=angles).read_bytes() for i, angles in enumerate((None, view))
    ]
    assert pictures[0] != pictures[1]
    tgdsl.save(touch, tmp_path / "pad.safetensors")
    code, _, error = here(tmp_path, "run", "pad.safetensors", "--seconds", "0.01", "--view", view)
    assert code == 0, error


def test_run_checks_the_view_first(tmp_path, here):
    code, _, error = here(tmp_path, "run", "none.yaml", "--view", "bak")
    assert (code, error) == (2, 'tgdsl: there is no view "bak"; did you mean "back"?\n')
