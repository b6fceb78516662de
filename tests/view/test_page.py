"""The live page: values of its handles, and in a real browser what it shows and what its controls do."""

import io
import re
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import viser
import yaml
from box_hands import BOX_HAND
from faulty_lines import FaultyEmulator
from first_order_hands import first_order_hand
from hand_logs import write_log
from matplotlib.colors import to_hex
from press_scene import DOCUMENT, SCENE, WITHOUT_PROXIMITY
from scipy.spatial.transform import Rotation
from silent_browser import silent_browser
from xhand1_hands import PATIENT

import tgdsl
from tgdsl.commands.view import View
from tgdsl.errors import SimulationError, TgdslError
from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.text import new_draft
from tgdsl.runtime.xhand1.driver import Reading, XHand1
from tgdsl.runtime.xhand1.emulator.emulator import TipForces
from tgdsl.runtime.xhand1.log.log import Fault
from tgdsl.runtime.xhand1.observe import TIP_BODIES
from tgdsl.runtime.xhand1.wire.protocol import FINGERS, JOINTS, STATE_SIZE, decode_state
from tgdsl.scene.scene import scene_model
from tgdsl.schema.load import load_layout
from tgdsl.view.hand_stage import HandLogStage, LiveHandStage
from tgdsl.view.layout_page import LayoutPage
from tgdsl.view.live_scene import ARROW
from tgdsl.view.meshes import body_surfaces
from tgdsl.view.page import Page
from tgdsl.view.picture import HeatMaps
from tgdsl.view.stages import RunStage, SceneStage, Stage, contacts_of
from tgdsl.view.style import HEAT, LIVE_OBJECT, LIVE_OTHER, LIVE_REST, LIVE_SENSING

ROOT = Path(__file__).parents[2]
TWO_BALLS = "variants: [{type: sphere, size: [20 mm], density: 6000}, {type: sphere, size: [15 mm], density: 6000}]"
"""Shapes of an object in even and odd environments."""


@contextmanager
def opened(stage: Stage) -> Iterator[Page]:
    page = Page(stage, port=8300)
    try:
        yield page
    finally:
        page.close()
        stage.close()


def disc_of(page: Page):
    """Return the discs of the chosen reading, which has one link."""
    ((handle, _, _),) = page.scene.layers[0].members
    return handle


def test_discs_are_at_the_taxels_in_the_frame_of_their_body(document):
    touch = tgdsl.compile(document)
    with opened(SceneStage(touch)) as page:
        table, model = touch.taxels["touch"], page.stage.model
        (body,) = {model.body(name).id for name in table["body"]}
        disc = disc_of(page)
        distances = np.linalg.norm(disc.batched_positions - table["pos"], axis=1)
        assert distances.max() < 3e-4  # lifted off the surface
        normals = Rotation.from_quat(disc.batched_wxyzs, scalar_first=True).apply([0, 0, 1])
        np.testing.assert_allclose(normals, table["normal"], atol=1e-6)
        np.testing.assert_allclose(page.scene.frames[body].position, model.body("pad").pos, atol=1e-9)


def test_the_most_pressed_taxel_has_the_hottest_colour_and_its_reading_is_shown(document):
    touch = tgdsl.compile(document)
    with opened(SceneStage(touch)) as page:
        for _ in range(100):
            page.stage.advance()
        page.draw()
        contact = np.linalg.norm(page.stage.contacts(0).force)
        assert page.panel.status.content == f"t = 1.00 s · 16 taxels · 1 contact, largest {contact:.3g} N"
        force = page.stage.readings["touch"][0, :, :3].norm(dim=-1)
        disc = disc_of(page)
        hottest = int(force.argmax())
        assert force[hottest] > 0.01
        blue = disc.batched_colors[:, 2].astype(int)
        is_read = force.numpy() > 1e-3
        assert blue[hottest] == blue[is_read].min() < blue[is_read].max()
        np.testing.assert_array_equal((disc.batched_colors == LIVE_REST).all(axis=1), ~is_read)
        assert "|force| [N]" in page.panel.legend.content and "<span>0</span>" in page.panel.legend.content
        stops = re.findall("#......", page.panel.legend.content)
        assert [stops[0], stops[len(stops) // 2], stops[-1]] == [to_hex(HEAT(part)) for part in (0.0, 0.5, 1.0)]
        page.panel.channel.value = "force_z"
        page.draw()
        pressed = page.stage.readings["touch"][0, :, 2]
        assert pressed[hottest] < 0
        red, _, blue = disc_of(page).batched_colors.astype(int).T  # from blue, of negative values, to red
        assert blue[hottest] - red[hottest] == (blue - red).max() > 100
        most = f"{float(pressed.abs().max()):.3g}"
        assert f"<span>-{most}</span><span>{most}</span>" in page.panel.legend.content
        page.panel.channel.value = "magnitude"
        page._pick(hottest)
        page.draw()
        assert f"taxel {hottest}" in page.panel.value.content
        value = float(re.search(r"([\d.e-]+) N", page.panel.value.content)[1])
        assert value == pytest.approx(float(force[hottest]), rel=1e-3)


def test_a_slider_moves_its_actuator_and_a_keyframe_moves_the_sliders(document):
    touch = tgdsl.compile(document)
    with opened(SceneStage(touch)) as page:
        page.panel.sliders[0].value = -0.015
        page.run(seconds=0.5)
        low = page.stage.body_poses(0)[0][2, 2]
        page.panel.keyframe.value = "up"
        assert soon(lambda: (page.run(seconds=0.2), page.stage.body_poses(0)[0][2, 2] > low + 0.004)[1])
        assert page.panel.sliders[0].value == pytest.approx(0.01)


def test_sliders_have_the_names_and_ranges_of_actuators_and_begin_at_the_keyframe_of_the_initial_pose(tmp_path):
    keys = '<key name="up" qpos="0.01" ctrl="0.01 0"/><key qpos="0.01" ctrl="0 0"/><key name="rest" qpos="0" ctrl="0.005 0.2"/>'
    scene = re.sub("<key name.*/>", keys, SCENE).replace("</actuator>", '<motor joint="lift"/></actuator>')
    (tmp_path / "press.xml").write_text(scene)
    (tmp_path / "press.yaml").write_text(WITHOUT_PROXIMITY)
    with opened(SceneStage(tgdsl.compile(tmp_path / "press.yaml"))) as page:
        sliders = page.panel.sliders
        assert page.stage.sliders == [("lift", -0.02, 0.02), ("actuator 1", -1.0, 1.0)]
        assert [(slider.min, slider.max, slider.value) for slider in sliders] == [(-0.02, 0.02, 0.005), (-1.0, 1.0, 0.2)]
        assert page.panel.keyframe.options == ("", "up", "rest")
        page.panel.keyframe.value = "up"
        page._react()
        page._step_once()
        assert [slider.value for slider in sliders] == [0.01, 0.0] == page.stage.control.tolist()
        page._restart()
        assert [slider.value for slider in sliders] == [0.005, 0.2] and page.stage.time == 0
        assert page.stage.body_poses(0)[0][2, 2] == pytest.approx(0.0749)


def test_another_reading_has_its_own_channels(document):
    touch = tgdsl.compile(document)
    with opened(SceneStage(touch)) as page:
        discs = disc_of(page)
        page.panel.channel.value = "force_x"
        page.panel.reading.value = "near"
        page._react()
        page.draw()
        with pytest.warns(UserWarning, match="already removed"):
            discs.remove()
        channels = next(output.channels for output in touch.outputs if output.name == "near")
        assert page.panel.channel.options == ("magnitude", *channels)
        assert page.panel.channel.value == "magnitude"


def test_a_page_is_served_only_locally_by_default(document, monkeypatch):
    touch, themes = tgdsl.compile(document), []
    monkeypatch.setattr(viser.GuiApi, "configure_theme", lambda gui, **options: themes.append(options))
    with opened(SceneStage(touch)) as page, pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", page.server.get_port()))
    assert themes == [{"show_share_button": False}]  # which would open a tunnel from the internet
    with pytest.warns(match=r"served at 0\.0\.0\.0: whoever reaches this machine"):
        page = Page(SceneStage(touch), "0.0.0.0", port=8300)
    socket.create_connection(("127.0.0.2", page.server.get_port())).close()
    port = page.server.get_port()
    page.close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port))
    page.stage.close()


def test_dropdowns_have_no_duplicate_options(document):
    """A browser would refuse such a page; the document has a group named "all"."""
    with opened(SceneStage(tgdsl.compile(document))) as page:
        for dropdown in (page.panel.group, page.panel.plotted, page.panel.reading, page.panel.channel):
            assert len(dropdown.options) == len(set(dropdown.options))


def test_pause_stops_and_step_once_takes_one_step(document):
    touch = tgdsl.compile(document)
    with opened(SceneStage(touch)) as page:
        page.panel.paused.value = True
        page.run(seconds=0.2)
        assert page.stage.time == 0
        page._step_once()
        assert page.stage.time == pytest.approx(page.stage.control_step)


def test_a_scene_runs_in_real_time_times_the_speed(document, monkeypatch):
    """By a clock that goes on only while the page waits, or works as long as `work` says."""
    clock = SimpleNamespace(now=100.0)

    def wait(seconds: float) -> None:
        clock.now += seconds

    monkeypatch.setattr("tgdsl.view.page.time", SimpleNamespace(monotonic=lambda: clock.now, sleep=wait))
    with opened(SceneStage(tgdsl.compile(document))) as page:

        def run(seconds: float, work: float = 0.0) -> tuple[int, float]:
            """Return how many frames a run has, and for how long the scene goes on."""
            starts, before = list[float](), page.stage.time

            def watch() -> None:
                starts.append(clock.now)
                assert starts[-31:] == starts or starts[-1] > starts[-31]  # the page waits between frames
                wait(work)

            page.run(watch, seconds)
            return len(starts), page.stage.time - before

        images = list[float]()
        monkeypatch.setattr(page, "_draw_images", lambda *_: images.append(clock.now))
        frames, elapsed = run(0.7)
        assert frames == pytest.approx(30 * 0.7, abs=1) and len(images) == pytest.approx(10 * 0.7, abs=1)
        assert 0.65 < elapsed <= 0.7  # the first frame has no step
        page.panel.speed.value = 0.5
        assert run(0.7)[1] == pytest.approx(0.35, abs=0.03)
        page.panel.speed.value = 4.0
        assert run(0.7)[1] == pytest.approx(2.8, abs=0.2)
        page.panel.speed.value = 1.0
        frames, elapsed = run(1.0, work=0.5)
        assert frames == 2 and elapsed == pytest.approx(0.5, abs=0.011)
        with monkeypatch.context() as slow:
            slow.setattr(page, "_advance", lambda: (page.stage.advance(), wait(0.02)))
            frames, elapsed = run(1.0)
        assert frames == pytest.approx(25, abs=1)  # two steps, the second of which ends after a frame's 33 ms
        assert elapsed == pytest.approx(2 * frames * page.stage.control_step, abs=0.03)
        page.panel.paused.value = True
        assert run(0.3)[1] == 0


@pytest.fixture(scope="module")
def recording(document, tmp_path_factory) -> Path:
    from tgdsl.commands.documents import Run

    folder = tmp_path_factory.mktemp("run")
    Run(document, keyframes=("up",), seconds=0.3, out=folder).run()
    return folder / "readings.npz"


def test_a_recorded_run_has_mujocos_poses(document, recording):
    touch = tgdsl.compile(document)
    stage = RunStage(touch, recording)
    assert stage.step_index == 0
    with np.load(recording) as arrays:
        qpos, readings = arrays["qpos"], arrays["touch"]
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[7, 0]
    mujoco.mj_kinematics(model, data)
    stage.seek(7)
    np.testing.assert_allclose(stage.body_poses(0)[0], data.xpos, atol=1e-12)
    assert np.array_equal(stage.readings["touch"].numpy(), readings[7])
    for step, expected in ((-1, 0), (99, len(readings) - 1)):
        stage.seek(step)
        assert stage.step_index == expected and stage.time == pytest.approx((expected + 1) * stage.control_step)
    stage.advance()
    assert stage.step_index == len(readings) - 1
    stage.restart()
    assert stage.step_index == 0
    with opened(stage) as page:
        assert page.panel.status.content == f"t = {stage.control_step:.2f} s · 16 taxels · 0 contacts"
        assert stage.contacts(0).force is None  # it is not recorded
        assert (page.panel.instant.min, page.panel.instant.max) == (0, len(readings) - 1)
        page.panel.instant.value = 3
        page._react()
        assert stage.step_index == 3
        page.panel.instant.value = 2  # by a browser, while a frame is drawn
        page.draw()
        page._react()
        assert stage.step_index == 2
        stage.advance()
        page.draw()
        assert page.panel.instant.value == 3


def test_a_run_of_another_document_is_refused_with_the_reading(document, recording):
    other = document.with_name("other.yaml")
    other.write_text(DOCUMENT.replace("near:", "close:"))
    with pytest.raises(SimulationError, match=r'no reading "close"'):
        RunStage(tgdsl.compile(other), recording)


def test_a_file_that_is_not_a_run_is_refused_with_the_missing_array(tmp_path):
    np.savez(tmp_path / "log.npz", time=np.zeros(3))
    with pytest.raises(SimulationError, match="it has no `qpos`"):
        View(tmp_path / "log.npz")._stage()


def test_another_stage_replaces_the_discs_and_all_bodies(document, tmp_path):
    lamp = '<body name="lamp" pos="0 0 .5"><geom type="box" size=".02 .02 .005"/></body>'
    (tmp_path / "press.xml").write_text(SCENE.replace("</worldbody>", f"{lamp}</worldbody>"))
    (tmp_path / "press.yaml").write_text(WITHOUT_PROXIMITY)
    with opened(SceneStage(tgdsl.compile(tmp_path / "press.yaml"))) as page:
        first, ((mesh, _),) = disc_of(page), page.scene._meshes[page.stage.model.body("lamp").id]
        page.show(SceneStage(tgdsl.compile(document)))
        assert disc_of(page) is not first
        assert len(disc_of(page).batched_positions) == len(first.batched_positions)
        with pytest.warns(UserWarning, match="already removed"):
            mesh.remove()


def test_the_camera_and_the_chosen_reading_stay_with_another_stage(document):
    touch = tgdsl.compile(document)
    with opened(SceneStage(touch)) as page:
        page.server.initial_camera.position = (1.0, 2.0, 3.0)
        page.panel.reading.value = "near"
        page.show(SceneStage(touch))
        assert page.panel.reading.value == "near" and page.scene.layers[0].output.name == "near"
        np.testing.assert_array_equal(page.server.initial_camera.position, (1, 2, 3))


def test_a_stage_with_nothing_to_draw_keeps_the_previous_one_and_shows_a_problem(document):
    bare = document.with_name("bare.yaml")
    bare.write_text(DOCUMENT.split("sensors:")[0] + "sensors:\n  hum: {kind: actuation_audio, samples: 32, substeps: 5}\n")
    silent = SceneStage(tgdsl.compile(bare))
    changes = [silent]
    with opened(SceneStage(tgdsl.compile(document))) as page:
        previous = page.stage
        page.run(lambda: changes.pop() if changes else None, seconds=0.1)
        assert page.stage is previous
        assert "nothing" in page.panel.problem.content or "to draw" in page.panel.problem.content
    with pytest.raises(TgdslError, match="to draw"):
        Page(SceneStage(tgdsl.compile(bare)), port=8300)


def test_a_policy_needs_a_task(document):
    with pytest.raises(TgdslError, match=r"press\.yaml is no task's document"):
        View(document, policy=Path("policy.pt"))._stage()


def test_a_saved_document_is_shown_and_mistakes_have_their_line(document):
    command = View(document)
    watch = command._watch()
    assert watch() is None
    document.write_text(DOCUMENT.replace("rows: 4", "rows: 5"))
    stage = watch()
    assert isinstance(stage, Stage)
    assert len(stage.touch.taxels["touch"]["pos"]) == 20
    stage.close()
    document.write_text(DOCUMENT.replace("kind: proximity", "kind: proximty"))
    problem = watch()
    assert isinstance(problem, str)
    assert "press.yaml:12" in problem
    assert "proximity" in problem
    document.write_text(DOCUMENT)


def test_a_saved_layout_is_shown(document):
    whole = yaml.safe_load(DOCUMENT)
    layout = document.with_name("layout.yaml")
    layout.write_text(yaml.safe_dump({"tgdsl": 1, **whole["robot"]["layout"]}))
    whole["robot"]["layout"] = layout.name
    file = document.with_name("own.yaml")
    file.write_text(yaml.safe_dump(whole))
    watch = View(file)._watch()
    assert watch() is None
    layout.write_text(layout.read_text().replace("rows: 4", "rows: 5"))
    stage = watch()
    assert isinstance(stage, Stage) and len(stage.touch.taxels["touch"]["pos"]) == 20
    stage.close()
    layout.write_text(layout.read_text().replace("rows: 5", "rows: five"))
    problem = watch()
    assert isinstance(problem, str) and "layout.yaml" in problem
    file.write_text(f"{file.read_text()}\nnotes: {'a text that is no name of a file ' * 20}\n")
    assert "notes" in str(watch())
    file.unlink()  # an editor replaces it
    assert watch() is None


def test_the_plot_restarts_with_another_environment_channel_or_an_earlier_time(document):
    with opened(SceneStage(tgdsl.compile(document), num_envs=2)) as page:
        page.run(seconds=0.3)
        assert len(page._history) > 1
        assert page.panel.env is not None
        page.panel.env.value = 1
        page._react()
        page.draw()
        assert len(page._history) == 1
        for time_then in (5.0, 20.0, 25.0):
            page.stage.time = time_then
            page.draw()
        np.testing.assert_array_equal(page.panel.plot.data[0], [20, 25])  # the last ten seconds
        for time_then in (22.0, 23.0):  # of a recorded run
            page.stage.time = time_then
            page.draw()
        np.testing.assert_array_equal(page.panel.plot.data[0], [20, 22, 23])
        page.draw()
        assert len(page._history) == 3  # a paused scene adds no points
        page.panel.channel.value = "force_x"
        page._react()
        assert not page._history


def test_saved_frames_match_the_drawn_ones(document):
    touch = tgdsl.compile(document)
    with opened(SceneStage(touch, num_envs=2)) as page:
        assert page.panel.env is not None
        page.panel.env.value = 1
        expected = []
        for _ in range(3):
            page.stage.advance()
            page.draw()
            page.draw()  # the same instant is saved once
            pos, quat = page.stage.body_poses(1)
            readings = {name: page.stage.readings[name][1].numpy().copy() for name in ("touch", "near")}
            expected.append({"time": page.stage.time, "env": 1, "body_pos": pos.copy(), "body_quat": quat.copy(), **readings})
        with np.load(io.BytesIO(page.saved_frames()), allow_pickle=False) as arrays:
            for name in expected[0]:
                np.testing.assert_array_equal(arrays[name][-3:], np.stack([frame[name] for frame in expected]))
            assert len(arrays["time"]) == 4  # the first frame is the start


# Drawing and switches ------------------------------------------------------------------------------------------------------------


def test_the_contact_is_below_the_ball_and_balances_weight_and_actuator(document):
    stage = SceneStage(tgdsl.compile(document), num_envs=2)
    for _ in range(200):
        stage.advance()
    ball, weight, stiffness = stage.model.body("ball"), 0.2 * 9.81, 400.0
    for env in (0, 1):
        contacts = stage.contacts(env)
        np.testing.assert_allclose(contacts.pos, [[0.01, 0, 0.055]], atol=5e-4)  # half the ball's penetration
        normal_force = weight + stiffness * float(stage.sim.qpos[env, 0])  # the actuator's target is 0
        on_pad = contacts.forces_on(frozenset({stage.model.body("pad").id}))
        np.testing.assert_allclose(on_pad, [[0, 0, -normal_force]], rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(contacts.forces_on(frozenset({ball.id})), -on_pad)
    stage.close()


def test_a_contact_in_a_gap_is_none():
    text = "<mujoco><worldbody><geom type='plane' size='1 1 1'/>{}</worldbody></mujoco>"
    for zone, num in (("margin='.01'", 1), ("gap='.01'", 0)):
        model = mujoco.MjModel.from_xml_string(text.format(f"<body pos='0 0 .105'><freejoint/><geom size='.1' {zone}/></body>"))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        assert data.ncon == 1 and len(contacts_of(model, data).pos) == num


def test_contacts_are_drawn_and_can_be_switched_off(document):
    with opened(SceneStage(tgdsl.compile(document))) as page:
        for _ in range(100):
            page.stage.advance()
        contacts = page.stage.contacts(0)
        page.scene.draw_contacts(contacts._replace(force=2.7e-7 / np.linalg.norm(contacts.force) * contacts.force))
        assert not page.scene._forces.visible  # rounding
        (pos,), (bodies,), (force,) = contacts
        page.scene.draw_contacts(
            contacts._replace(pos=np.stack([pos] * 2), bodies=np.stack([bodies] * 2), force=np.stack([0 * force, force]))
        )
        assert page.scene._forces.visible
        assert len(page.scene._points.points) == 2
        assert len(page.scene._forces.points) == 1  # without one for the contact that carries nothing
        page.draw()
        assert "1 contact, largest" in page.panel.status.content
        ((begin, end),) = page.scene._forces.points
        np.testing.assert_allclose(begin[:2], [0.01, 0], atol=1e-3)
        assert page.scene._points.visible
        assert page.scene._forces.visible
        assert begin[2] - end[2] == pytest.approx(ARROW, rel=1e-3)  # the ball presses the pad down
        page.panel.parts["contacts"].value = False
        page.draw()
        assert not page.scene._points.visible
        assert not page.scene._forces.visible


def test_arrows_lead_from_the_taxels_along_their_forces(tmp_path):
    (tmp_path / "press.xml").write_text(SCENE.replace('"pad" pos="0 0 0.05"', '"pad" pos="0 0 0.05" euler="10 0 30"'))
    (tmp_path / "press.yaml").write_text(WITHOUT_PROXIMITY)
    with opened(SceneStage(tgdsl.compile(tmp_path / "press.yaml"))) as page:
        first = float(page.stage.readings["touch"][0, :, :3].norm(dim=-1).max())
        for _ in range(100):
            page.stage.advance()
        page.draw()
        force = page.stage.readings["touch"][0, :, :3].double().numpy()
        is_read, turn = np.linalg.norm(force, axis=1) > 1e-3, Rotation.from_euler("XYZ", [10, 0, 30], degrees=True)
        taxels = turn.apply(page.stage.touch.taxels["touch"]["pos"][is_read]) + [0, 0, 0.05]
        arrows, camera = page.scene._arrows, page.server.initial_camera
        np.testing.assert_allclose(camera.look_at, turn.apply([0, 0, 0.005]) + [0, 0, 0.05], atol=1e-6)
        away = np.asarray(camera.position) - camera.look_at
        assert away @ turn.apply([0, 0, 1]) > 0.85 * np.linalg.norm(away)
        assert camera.near < 0.05 < np.linalg.norm(away) < 0.15  # the taxels are up to 3 cm from the middle
        assert arrows.visible and 0 < is_read.sum() < 16
        assert np.linalg.norm(arrows.points[:, 0] - taxels, axis=1).max() < 3e-4  # lifted off the surface
        along, expected = arrows.points[:, 1] - arrows.points[:, 0], turn.apply(force[is_read])
        np.testing.assert_allclose(along / np.linalg.norm(along), expected / np.linalg.norm(expected), atol=1e-5)  # float32
        largest = np.linalg.norm(force, axis=1).max()
        assert np.linalg.norm(along, axis=1).max() == pytest.approx(ARROW * largest / max(first, largest), rel=1e-5)
        page._pick(int(np.flatnonzero(is_read)[0]))
        page.draw()
        assert np.linalg.norm(page.scene._name.position - taxels[0]) < 1e-3
        rows, shown = page.scene.layers[0].rows, page.scene.layers[0].read(page.stage.readings["touch"], 0, "magnitude")
        page.scene.draw_arrows(rows, shown, page.stage.body_poses(0), np.arange(16) == shown.value.argmax())
        assert arrows.visible and len(arrows.points) == 1
        page.panel.parts["arrows"].value = False
        page.draw()
        assert not arrows.visible


def test_parts_links_groups_and_sensors_can_be_switched_on_and_off(tmp_path):
    side = '<body name="side" pos="0 .1 .05"><geom name="side" type="box" size=".02 .02 .005" rgba="0 1 0 1"/></body>'
    table = '<geom type="box" pos="0 0 -.1" size=".2 .2 .01" rgba="1 0 0 .5"/>'
    (tmp_path / "press.xml").write_text(SCENE.replace('<body name="ball"', f'{table}{side}<body name="ball"'))
    grid = "{method: grid, rows: 2, columns: 2, direction: [0, 0, -1], radius: 6 mm}"
    text = DOCUMENT.replace("{pad: {", f"{{side: {grid}, pad: {{").replace("{all: [pad]}", "{all: [pad, side], one: [side]}")
    (tmp_path / "press.yaml").write_text(text)
    with opened(SceneStage(tgdsl.compile(tmp_path / "press.yaml"))) as page:

        def visible_links() -> set[str]:
            page._react()
            page.draw()
            return {link for handle, link, _ in page.scene.layers[0].members if handle.visible}

        assert visible_links() == {"pad", "side"}
        assert not page.panel.value.content.endswith(" 0 N")
        page.panel.links["pad"].value = False
        assert visible_links() == {"side"}
        assert page.panel.value.content == "**sum**: |force| 0 N"  # the ball lies on the other link
        page.panel.links["pad"].value, page.panel.links["side"].value = True, False
        assert visible_links() == {"pad"}
        assert not page.panel.value.content.endswith(" 0 N")
        page.panel.group.value = "one"
        page.panel.links["pad"].value = True
        assert visible_links() == {"side"}
        page.panel.group.value = "all"
        assert visible_links() == {"pad", "side"}
        page.panel.parts["taxels"].value = False
        assert visible_links() == set()
        assert [layer.output.name for layer in page.scene.layers] == ["touch"]
        page.panel.also["near"].value = True
        page._react()
        page.draw()
        assert [layer.output.name for layer in page.scene.layers] == ["touch", "near"]
        below, above = ({link: handle for handle, link, _ in layer.members}["pad"] for layer in page.scene.layers)
        assert (above.batched_positions[:, 2] > below.batched_positions[:, 2]).all()
        assert (above.batched_scales < below.batched_scales).all()
        assert (above.batched_colors != LIVE_REST).any()  # the ball is near

        def meshes() -> dict[str, tuple[bool, tuple[int, ...]]]:
            """Return by body whether its mesh is visible, and the mesh's colour."""
            page._react()
            names = {page.stage.model.body(body).name: handles for body, handles in page.scene._meshes.items()}
            return {name: (mesh.visible, tuple(mesh.color)) for name, ((mesh, _),) in names.items()}

        robot = {"world": (True, LIVE_OTHER), "pad": (True, LIVE_SENSING), "side": (True, LIVE_SENSING)}
        assert meshes() == {**robot, "ball": (True, LIVE_OBJECT)}
        page.panel.is_plain.value = False
        painted = {"world": (True, (255, 0, 0)), "side": (True, (0, 255, 0))}
        assert meshes() == {**robot, **painted, "ball": (True, LIVE_OBJECT)}
        assert [page.scene._meshes[body][0][0].opacity for body in range(3)] == [0.5, None, None]
        page.panel.parts["robot"].value = False
        assert {name for name, (is_visible, _) in meshes().items() if is_visible} == {"ball"}
        page.panel.parts["objects"].value = False
        assert not any(is_visible for is_visible, _ in meshes().values())
        assert not any(frame.show_axes for frame in page.scene.frames.values())


def test_a_chosen_link_is_plotted_and_a_clicked_taxel_named(document, clicks):
    with opened(SceneStage(tgdsl.compile(document))) as page:
        for _ in range(100):
            page.stage.advance()
        page.panel.plotted.value = "pad"
        page._react()
        page.draw()
        force = page.stage.readings["touch"][0, :, :3].norm(dim=-1)
        assert "sum of pad" in page.panel.value.content
        assert page._history[-1][1] == pytest.approx(float(force.sum()), rel=1e-3)
        hottest = int(force.argmax())
        clicks[disc_of(page).name](SimpleNamespace(instance_index=hottest))
        page._react()
        page.draw()
        assert page.scene._name.visible and page.panel.plotted.value == "(all)"
        assert page.scene._name.text == f"pad, taxel {hottest}: {float(force[hottest]):.4g} N"
        position = ", ".join(f"{1e3 * x:.1f}" for x in page.stage.touch.taxels["touch"]["pos"][hottest])
        assert f"({position}) mm" in page.panel.value.content
        clicks[disc_of(page).name](SimpleNamespace(instance_index=hottest))
        page._react()
        page.draw()
        assert not page.scene._name.visible and page.panel.value.content.startswith("**sum**")


def test_objects_have_the_colours_of_their_materials():
    text = """<mujoco><asset><texture name="t" type="2d" builtin="flat" rgb1="1 .5 0" width="4" height="4"/>
    <material name="m" texture="t" rgba=".8 .8 .8 .5"/></asset><worldbody><body><geom size=".1" material="m"/>
    <geom size=".1" rgba="0 1 0 1" material="m"/><geom size=".1"/></body></worldbody></mujoco>"""
    orange, green, none = (surface.colour for surface in body_surfaces(mujoco.MjModel.from_xml_string(text), 1))
    assert orange == pytest.approx((0.8, 0.4, 0, 0.5), abs=0.005)
    assert green == (0, 1, 0, 1)
    assert none is None


def test_meshes_that_collide_with_anything_are_drawn_and_visual_ones_are_not():
    """Two tetrahedra with edges along the axes of the body, and a large visual sphere."""
    text = """<mujoco><asset><mesh name="a" vertex="0 0 0 1 0 0 0 1 0 0 0 1" smoothnormal="true"/>
    <mesh name="b" vertex="0 0 0 0 0 4 0 3 0 2 0 0" smoothnormal="true"/>
    </asset><worldbody><body><geom type="mesh" mesh="a" contype="0" rgba="1 0 0 1"/>
    <geom type="mesh" mesh="b" conaffinity="0" rgba="0 1 0 1"/><geom size="9" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
    red, green = body_surfaces(mujoco.MjModel.from_xml_string(text), 1)
    for surface, ends, colour in ((red, (1, 1, 1), (1, 0, 0, 1)), (green, (2, 3, 4), (0, 1, 0, 1))):
        corners = surface.corners.reshape(-1, 3)
        np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [(0, 0, 0), ends], atol=1e-6)
        assert surface.colour == colour and len(surface.corners) == 4
        sides = np.cross(surface.corners[:, 1] - surface.corners[:, 0], surface.corners[:, 2] - surface.corners[:, 0])
        outward = surface.corners.mean(axis=1) - np.array(ends) / 4
        assert ((sides * outward).sum(axis=1) > 0).all()
        assert ((surface.normals * (surface.corners - np.array(ends) / 4)).sum(axis=2) > 0).all()


def test_another_environment_shows_its_own_object(document):
    variants = document.with_name("variants.yaml")
    shapes = "variants: [{type: sphere, size: [20 mm], density: 600}, {type: box, size: [10 mm, 12 mm, 14 mm], density: 600}]"
    variants.write_text(WITHOUT_PROXIMITY.replace("{body: ball}", f"{{body: ball, {shapes}}}"))
    with opened(SceneStage(tgdsl.compile(variants), num_envs=2)) as page:
        assert page.panel.env is not None
        ball = page.stage.model.body("ball").id

        def half_widths() -> np.ndarray:
            page._react()
            page.draw()
            ((mesh, _),) = page.scene._meshes[ball]
            return np.ptp(mesh.vertices, axis=0) / 2

        np.testing.assert_allclose(half_widths(), 0.02, atol=1e-3)
        page.panel.env.value = 1
        np.testing.assert_allclose(half_widths(), [0.01, 0.012, 0.014], atol=1e-6)
        page.panel.env.value = 0
        np.testing.assert_allclose(half_widths(), 0.02, atol=1e-3)


def test_temperatures_colour_the_surfaces_of_links(document, clicks):
    warm = document.with_name("warm.yaml")
    objects = "{ball: {body: ball, material: aluminium, temperature: 60 degC}}"
    heat = "{kind: temperature_grid, links: [pad], feels: [ball], spacing: 10 mm, material: aluminium, outputs: surface}"
    warm.write_text(f"tgdsl: 1\nrobot: {{model: press.xml}}\nobjects: {objects}\nsensors: {{heat: {heat}}}\n")
    with opened(SceneStage(tgdsl.compile(warm))) as page:
        for _ in range(100):
            page.stage.advance()
        page.draw()
        (layer,) = page.scene.layers
        values = page.stage.readings["heat"][0, :, 0].numpy()
        assert np.ptp(values) > 0.01
        warmest = layer.rows.pos[layer.read(page.stage.readings["heat"], 0, layer.channels[0]).value.argmax()]
        np.testing.assert_allclose(warmest, page.stage.touch.rows["heat"]["pos"][values.argmax()])
        area = 0.0
        for mesh, _, row in layer.members:
            corners = mesh.vertices[mesh.faces]
            distances = np.abs(corners.mean(axis=1) - layer.rows.pos[row]).max(axis=1)
            assert distances.max() < 0.0101  # a triangle's centre is in its cell, or in one next to it
            area += np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
        assert area == pytest.approx(2 * (0.06**2 + 2 * 0.06 * 0.01), rel=1e-4)
        page._react()
        assert {mesh.visible for mesh, _ in page.scene._meshes[page.stage.model.body("pad").id]} == {False}
        drawn = next(mesh for mesh, _, row in layer.members if (layer.rows.pos[row] == warmest).all())
        clicks[drawn.name](None)
        page._react()
        page.draw()
        assert "temperature [°C]" in page.panel.legend.content and " cells" in page.panel.status.content
        assert page.panel.value.content.startswith(f"**pad, cell {values.argmax()}** at ")
        assert f"{values.max():.4g} °C" in page.panel.value.content
        page._restart()
        assert float(np.ptp(page.stage.readings["heat"].numpy())) < 1e-6  # the links have cooled


def test_a_heat_map_has_its_distal_end_up_and_scattered_taxels_as_dots(document):

    touch = tgdsl.compile(document)
    table = touch.taxels["touch"]
    maps = HeatMaps(scene_model(touch.plan.scene), table)
    colour = np.zeros((len(table["pos"]), 3), dtype=np.uint8)
    colour[:, 0], colour[:, 1] = 10 * np.arange(len(colour)), 7
    image = maps.image(colour)
    assert set(np.unique(image[image[..., 1] == 7][:, 0])) == set(colour[:, 0])

    def middle(taxel: int, image: np.ndarray = image) -> np.ndarray:
        return np.argwhere((image == colour[taxel]).all(axis=-1)).mean(axis=0)

    cells = {(int(row), int(column)): i for i, (row, column) in enumerate(zip(table["row"], table["column"], strict=True))}
    down, right = middle(cells[3, 0]) - middle(cells[0, 0]), middle(cells[0, 3]) - middle(cells[0, 0])
    assert abs(down @ right) < 1e-9
    outward = np.cross(*(table["pos"][cells[cell]] - table["pos"][cells[0, 0]] for cell in ((3, 0), (0, 3))))
    assert np.sign(down[0] * right[1] - down[1] * right[0]) == np.sign(outward @ table["normal"][0])  # seen from outside
    scattered = table.copy()
    scattered["row"] = scattered["column"] = -1
    for taxels in (np.arange(len(table)), [cells[0, 0], cells[0, 1], cells[0, 3]]):  # two of the latter are neighbours
        dots = HeatMaps(scene_model(touch.plan.scene), scattered[taxels]).image(colour[taxels])
        assert set(np.unique(dots[dots[..., 1] == 7][:, 0])) == set(colour[taxels, 0])
        widths = [2 * np.sqrt((dots == each).all(axis=-1).sum() / np.pi) for each in colour[taxels]]
        apart = np.linalg.norm(middle(cells[0, 1], dots) - middle(cells[0, 0], dots))
        np.testing.assert_allclose(widths, apart, rtol=0.03)  # dots of whole pixels touch their nearest neighbours


def test_the_heat_map_has_the_readings_colours(document):
    with opened(SceneStage(tgdsl.compile(document))) as page:
        for _ in range(100):
            page.stage.advance()
        page._images_due = 0.0
        page.draw()
        assert page.panel.maps.visible
        hottest = page.scene.layers[0].read(page.stage.readings["touch"], 0, "magnitude").colour
        image = page.panel.maps.image.reshape(-1, 3)
        assert {tuple(each) for each in hottest.tolist()} <= {tuple(each) for each in image.tolist()}
        page.panel.parts["heat maps"].value = False
        page._images_due = 0.0
        page.draw()
        assert not page.panel.maps.visible


def test_observations_are_live_values_and_sound_has_a_spectrogram(document):
    observed = document.with_name("observed.yaml")
    hum = "  hum: {kind: actuation_audio, samples: 32, substeps: 5, load: 0, friction: 0, hum: 1, hum_frequency: 2 kHz}\n"
    observed.write_text(DOCUMENT + hum + "observations:\n  policy: [{type: force, of: touch}, {type: joint_pos}]\n")
    with opened(SceneStage(tgdsl.compile(observed))) as page:
        for _ in range(100):
            page._advance()
        page._images_due = 0.0
        page.draw()
        assert page.panel.spectrogram is not None
        assert "0 to 8 kHz upward" in page.panel.spectrogram.label  # half of 32 samples in each 2 ms
        bright = page.panel.spectrogram.image.astype(int).sum(axis=2)[:, -20]
        assert abs((len(bright) - bright.argmax()) / len(bright) - 2 / 8) < 0.02
        force = page.stage.readings["touch"][0, :, :3]
        lift = float(page.stage.sim.qpos[0, 0])
        assert page.panel.group_values is not None
        rows = {
            cells[1].strip(): cells[2].strip()
            for line in page.panel.group_values.content.splitlines()[2:]
            if (cells := line.split("|"))
        }
        low, high = map(float, rows["touch"].split(" … "))
        assert (low, high) == pytest.approx((float(force.min()), float(force.max())), rel=0.01)
        assert float(rows["joint_pos"]) == pytest.approx(lift, rel=0.02)


def test_a_task_moves_by_policy_or_by_hand():
    task = View(ROOT / "examples/tasks/in_palm_rotate_cube.yaml")._stage()
    with opened(task) as page:
        assert page.panel.by_hand is not None and not page.panel.by_hand.value
        task.advance()
        page._react()
        assert [slider.value for slider in page.panel.sliders] == [0.0] * len(task.env.joint_names)  # without a policy
        page.panel.by_hand.value = True
        page.panel.sliders[1].value = 0.5
        page._react()
        before = task.env.now.joint_pos[0, 1].item()
        for _ in range(10):
            task.advance()
        assert task.acted(0)[1] == pytest.approx(0.5)
        assert abs(task.env.now.joint_pos[0, 1].item() - before) > 0.01
        page.panel.by_hand.value = False
        page._react()
        task.advance()
        assert (task.acted(0) == 0).all()
        page._images_due = 0.0
        page.draw()
        assert page.panel.observed is not None and page.panel.group_values is not None
        assert page.panel.observed.options == tuple(task.env.groups)
        joint = task.env.joint_names[1]
        match = re.search(rf"position of {joint} \| (\S+) \| rad", page.panel.group_values.content)
        assert float(match[1]) == pytest.approx(float(task.env.observe()["proprio"][0, 1]), rel=0.01, abs=1e-3)
        assert "object_distance" in page.panel.notes.content


@pytest.mark.slow
def test_a_policy_moves_a_task():
    policy = ROOT / "policies/in_palm_rotate_cube.pt"
    with opened(View(ROOT / "examples/tasks/in_palm_rotate_cube.yaml", policy=policy, envs=2)._stage()) as page:
        page.stage.advance()
        page.draw()
        assert (page.stage.acted(1) != 0).any()
        assert len(page.scene.layers[0].rows.body) == 199
        assert "object_distance" in page.panel.notes.content


# Hands -------------------------------------------------------------------------------------------------------------------------


def reading_at(time: float, position: np.ndarray, counts: np.ndarray) -> Reading:
    state = decode_state(bytes(STATE_SIZE))
    state = replace(state, position=position.astype(np.float32), total_force=counts.astype(np.int16))
    return Reading(1 + round(100 * time), time - 0.008, time, state)


def hand_log(path: Path) -> tuple[Path, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    position, counts = rng.uniform(0.1, 0.5, (5, 12)), rng.integers(-100, 100, (5, 5, 3))
    readings = [reading_at(1.0 + 0.01 * i, position[i], counts[i]) for i in range(5)]
    fault = Fault(1.022, "HandTimeoutError", "no reply")
    return write_log(path, readings, (fault,)), position, counts


def test_a_hands_log_has_its_angles_and_forces(tmp_path):
    path, position, counts = hand_log(tmp_path / "log.npz")
    stage = View(path)._stage()
    assert isinstance(stage, HandLogStage)
    assert stage.step_index == 0 and stage.num_steps == 5 and stage.control_step == pytest.approx(0.01)
    for step, expected in ((-1, 0), (99, 4), (2, 2)):
        stage.seek(step)
        assert stage.step_index == expected and stage.time == pytest.approx(0.01 * expected)
    model = stage.model
    data = mujoco.MjData(model)
    for joint, angle in zip(JOINTS, position[2].astype(np.float32), strict=True):
        data.joint(f"right_hand_{joint}").qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(stage.body_poses(0)[0], data.xpos, atol=1e-12)
    by_finger = [next(i for i, name in enumerate(TIP_BODIES) if body.endswith(name)) for body in stage.outputs[0].bodies]
    np.testing.assert_array_equal(stage.readings["tips"][0].numpy(), counts[2][by_finger])
    assert stage.outputs[0].units == ("counts",) * 3
    assert stage.time == pytest.approx(0.02)
    assert stage.notes(0) == {"then no reading": "HandTimeoutError: no reply"}
    with opened(stage) as page:
        assert "[counts]" in page.panel.legend.content
        assert page.panel.instant is not None
        page.panel.instant.value = 4
        page._react()
        page.draw()
        assert stage.step_index == 4
        total = np.linalg.norm(counts[4], axis=1).sum()
        assert float(re.search(r"([\d.e+-]+) counts", page.panel.value.content)[1]) == pytest.approx(total, rel=1e-3)


def test_a_calibration_converts_a_hands_log_to_newtons(tmp_path):
    path, _, counts = hand_log(tmp_path / "log.npz")
    calibration = ROOT / "examples/xhand1_calibration.yaml"
    stage = View(path, calibration=calibration)._stage()
    assert stage.outputs[0].units == ("N",) * 3
    bodies = stage.outputs[0].bodies
    thumb, index = (next(i for i, body in enumerate(bodies) if name in body) for name in ("thumb", "index"))
    force = stage.readings["tips"][0].numpy()
    np.testing.assert_allclose(force[thumb], 0.1 * counts[0, 0], rtol=1e-6)
    np.testing.assert_allclose(force[index], 0.1 * counts[0, 1, ::-1], rtol=1e-6)  # its sensor faces along the link's x


def test_a_calibration_needs_a_hand(document):
    with pytest.raises(TgdslError, match=r"press\.yaml is neither a hand nor the log of one"):
        View(document, calibration=ROOT / "examples/xhand1_calibration.yaml")._stage()


def test_an_emulated_hand_is_shown_and_its_unplugging_noted():
    forces = TipForces.zero()
    forces.total[1] = (3, 4, 12)
    with FaultyEmulator(first_order_hand(forces=lambda time, position: forces)) as emulator:
        hand = XHand1.open(emulator.device, timing=PATIENT, max_age_s=20.0)
        stage = LiveHandStage(hand)
        stage.opened.callback(hand.close)
        with opened(stage) as page:
            stage.advance()
            page.draw()
            assert "13 counts" in page.panel.value.content
            assert stage.time > 0
            stage.restart()
            assert stage.time == 0
            stage.advance()
            assert stage.time < 10.0
            names = [f"{name} [°C]" for name in FINGERS]
            assert list(stage.notes(0)) == ["failures", "joints with errors", *names] and stage.notes(0)["failures"] == 0
            assert page.panel.notes.content.splitlines()[2:4] == ["| failures | 0 |", "| joints with errors | 0 |"]
            emulator.unplug()
            assert soon(lambda: (stage.advance(), "NO NEW READING" in stage.notes(0))[1]) and stage.notes(0)["failures"] > 0
            emulator.replug()
            assert soon(lambda: (stage.advance(), "NO NEW READING" not in stage.notes(0))[1])


@pytest.mark.slow
def test_a_frame_of_667_taxels_takes_less_than_a_twentieth_of_a_second():
    """Processor time, so that a busy machine does not matter: three control steps of 10 ms and the drawing."""
    with opened(View(ROOT / "examples/xhand1_palm.yaml", set=("resolution=high",))._stage()) as page, silent_browser(page.url):
        assert len(page.scene.layers[0].rows.body) == 667
        begin = time.process_time()
        for _ in range(20):
            for _ in range(3):
                page._advance()
            page._react()
            page.draw()
        assert (time.process_time() - begin) / 20 < 1 / 20


# In a browser ------------------------------------------------------------------------------------------------------------------


@contextmanager
def serving(command: View) -> Iterator[Page]:
    """Serve a command's page in this process, with a thread that steps it, and yield it."""
    stage = command._stage()
    page = Page(stage, port=8320)
    is_over = threading.Event()
    watch = command._watch()

    def loop() -> None:
        while not is_over.is_set():
            page.run(watch, seconds=0.5)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield page
    finally:
        is_over.set()
        thread.join()
        page.close()
        page.stage.close()


@pytest.fixture(scope="module")
def browser():
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed (apt-get install chromium): the live page is not opened in a browser")
    from playwright.sync_api import sync_playwright

    options = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium, args=list(options))
        yield opened
        opened.close()


def soon(condition: Callable[[], bool], seconds: float = 60.0) -> bool:
    """Return whether a condition becomes true within some seconds."""
    begin = time.monotonic()
    while time.monotonic() - begin < seconds:
        if condition():
            return True
        time.sleep(0.3)
    return False


@contextmanager
def at_rest(page: Page) -> Iterator[None]:
    """Pause the scene: without a GPU, a browser opens and takes pictures only while no new frames arrive."""
    was_paused, page.panel.paused.value = page.panel.paused.value, True
    yield
    page.panel.paused.value = was_paused


def is_drawn(view) -> bool:
    """Return whether more than 2 % of the picture's left half is not background."""
    from matplotlib.image import imread

    pixels = imread(io.BytesIO(view.screenshot()))[:, :600, :3]
    return bool((np.abs(pixels - pixels[5, 400]) > 0.05).any(axis=2).mean() > 0.02)


def open_tab(browser, url: str):
    view = browser.new_page(viewport={"width": 960, "height": 640})
    view.set_default_timeout(120_000)  # WebGL in software
    view.goto(url)
    view.get_by_text("taxels").first.wait_for()
    return view


def open_page(browser, page: Page):
    with at_rest(page):
        return open_tab(browser, page.url)


def field_of(view, label: str):
    """Return the input field of a control; for a slider, the one with its number."""
    return view.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]").locator("input").last


def write(view, label: str, text: str) -> None:
    """Write the number of a slider as typing does; events are sent by hand, since typing would wait for frames."""
    field = field_of(view, label)
    field.focus()
    field.evaluate(
        """(field, text) => {
            Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, text);
            field.dispatchEvent(new Event("input", {bubbles: true}));
            field.blur();
        }""",
        text,
    )


def total(view) -> float:
    """Return the number next to "sum" on the page."""
    text = view.get_by_text("sum").first.locator("xpath=..").inner_text()
    return float(re.search(r"(-?[\d.]+(?:e-?\d+)?) N", text)[1])


def seconds(view) -> float:
    """Return the scene's time on the page [s]."""
    return float(re.search(r"t = ([\d.]+) s", view.get_by_text("t = ").first.inner_text())[1])


@pytest.mark.browser
@pytest.mark.slow
def test_a_browser_shows_a_document_and_its_controls_work(browser, document):
    file = document.with_name("two_balls.yaml")
    text = DOCUMENT.replace("{body: ball}", f"{{body: ball, {TWO_BALLS}}}")
    file.write_text(text)
    with serving(View(file, envs=2)) as page:
        view = open_page(browser, page)
        with at_rest(page):
            assert soon(lambda: is_drawn(view))
        assert soon(lambda: total(view) > 0)
        before = total(view)
        write(view, "lift", "-0.02")
        assert soon(lambda: page.panel.sliders[0].value == pytest.approx(-0.02))
        assert soon(lambda: abs(total(view) - before) > 0.1 * before)
        option = view.get_by_role("option", name="force_z", include_hidden=True)  # hidden until a frame is drawn
        assert soon(lambda: view.locator("input[value='magnitude']").first.dispatch_event("click") or option.count() > 0)
        option.first.dispatch_event("click")
        assert soon(lambda: view.get_by_text("force_z [N]").count() > 0)
        write(view, "environment", "1")
        ball, meshes = page.stage.model.body("ball").id, page.scene._meshes  # for a moment without the ball's
        assert soon(lambda: page.panel.env_index == 1 and ball in meshes and np.ptp(meshes[ball][0][0].vertices) < 0.035)
        assert soon(lambda: total(view) == pytest.approx(float(page.stage.readings["touch"][1, :, 2].sum()), rel=0.01))

        # Opened twice: both show the same, and a control set in one changes in the other.
        with at_rest(page):
            other = open_page(browser, page)
            assert soon(lambda: total(other) == total(view) != 0)
            write(other, "lift", "0.02")
            assert soon(lambda: field_of(view, "lift").input_value() == "0.02")
            other.close()
        assert soon(lambda: total(view) == 0)

        # Connection lost: the scene goes on, and the browser reconnects automatically.
        assert soon(lambda: len(page.server.get_clients()) == 1)
        lost_at, clients = page.stage.time, set(page.server.get_clients())
        page.server._websock_server.disconnect_all_clients()  # an offline browser would keep its local connections
        assert soon(lambda: page.stage.time > lost_at + 0.2)
        assert soon(lambda: page.server.get_clients().keys() - clients)
        assert soon(lambda: seconds(view) > page.stage.time - 1.0 > lost_at)
        write(view, "lift", "-0.02")
        assert soon(lambda: total(view) != 0)

        view.reload()
        view.get_by_text("16 taxels").wait_for()
        file.write_text(text.replace("rows: 4", "rows: 3"))
        view.get_by_text("12 taxels").wait_for()
        file.write_text(text.replace("kind: proximity", "kind: proximty"))
        view.get_by_text("two_balls.yaml:12").first.wait_for()
        file.write_text(text)
        view.get_by_text("16 taxels").wait_for()
        view.close()


@pytest.mark.browser
@pytest.mark.slow
def test_a_browser_shows_a_run_and_scrubs_it(browser, recording):
    with serving(View(recording)) as page:
        with at_rest(page):
            view = open_tab(browser, page.url)
            assert soon(lambda: is_drawn(view))
        assert soon(lambda: not field_of(view, "pause").is_checked())  # the scene goes on in the browser too
        field_of(view, "pause").dispatch_event("click")
        assert soon(lambda: page.panel.paused.value)
        write(view, "step", "2")
        with np.load(recording) as arrays:
            time_then = arrays["time"][2]
        view.get_by_text(f"t = {time_then:.2f} s").wait_for()
        view.close()


@pytest.mark.browser
@pytest.mark.slow
def test_a_browser_shows_an_emulated_hand_and_saves_its_frames(browser, tmp_path):
    with serving(View(Path("emulator"))) as page:
        view = open_page(browser, page)
        with at_rest(page):
            assert soon(lambda: is_drawn(view))
        assert view.get_by_text("joints with errors").count() > 0
        with view.expect_download() as download:
            view.get_by_role("button", name="save last minute").dispatch_event("click")
        download.value.save_as(tmp_path / "seen.npz")
        with np.load(tmp_path / "seen.npz") as arrays:
            assert arrays["tips"].shape[1:] == (5, 3)
            assert (np.diff(arrays["time"]) > 0).all()
        view.close()


@pytest.mark.browser
@pytest.mark.slow
def test_a_browser_changes_a_layout_and_writes_it(browser, tmp_path):
    (tmp_path / "hand.xml").write_text(BOX_HAND)
    out = tmp_path / "layout.yaml"
    page = LayoutPage(new_draft(load_model(tmp_path / "hand.xml"), "4/cm2", True, out, False), out, port=8340)
    is_over = threading.Event()

    def loop() -> None:
        while not is_over.is_set():
            page.run(seconds=0.2)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        view = open_tab(browser, page.url)
        assert soon(lambda: is_drawn(view))
        before, after = (page.draft.proposal.links[0].counts["med"] * num for num in (1, 2))
        option = view.get_by_role("option", name="palm", exact=True, include_hidden=True)
        assert soon(lambda: view.locator("input[value='(all)']").first.dispatch_event("click") or option.count() > 0)
        option.first.dispatch_event("click")
        view.get_by_text(f"{before} of them").wait_for()
        write(view, "taxels per cm²", "8")
        view.get_by_text(f"{after} of them").wait_for()
        view.reload()
        view.get_by_text(f"{after} of them").wait_for()
        view.get_by_role("button", name="write layout.yaml").dispatch_event("click")
        assert soon(out.exists)
        assert load_layout(out).spec.resolutions["med"]["palm"].count == after
        view.close()
    finally:
        is_over.set()
        thread.join()
        page.close()
