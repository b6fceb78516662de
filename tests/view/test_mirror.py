"""The page in its own process: frames, when they are sent, and a loop that outlives it."""

import os
import pickle
import signal
import socket
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from press_scene import DOCUMENT, WITHOUT_PROXIMITY
from silent_browser import silent_browser

import tgdsl
from tgdsl.errors import TgdslError
from tgdsl.view import mirror
from tgdsl.view.mirror import MirrorStage
from tgdsl.view.stages import SimStage


def answer(stage: SimStage, requests, frames) -> None:
    """Answer requests for frames, like a loop, until they end."""
    try:
        while True:
            frame = mirror.frame_of(stage, pickle.load(requests), b"")
            pickle.dump(pickle.loads(pickle.dumps(frame)), frames)
            frames.flush()
    except EOFError:
        pass


def close(copy: MirrorStage, sent, *others) -> None:
    """Close pipes, first the one of the frames, so that the mirror stops reading."""
    sent.close()
    while not copy.is_over:
        time.sleep(0.01)
    for end in others:
        end.close()


def test_a_mirror_has_the_poses_and_readings_of_the_requested_environment(document):
    touch = tgdsl.compile(document)
    sim = tgdsl.simulate(touch, num_envs=3)
    lift = np.array([[0.0], [0.01], [-0.002]])
    sim.reset(qpos=lift)
    stage = SimStage(touch, sim)
    assert stage.time == 0
    stage.update(touch(sim.state()))
    assert stage.time == stage.control_step
    (requests, request_pipe), (frames, frame_pipe) = (map(open, os.pipe(), ("rb", "wb")) for _ in range(2))
    opening = mirror._Opening(mirror._tables(touch), stage.model, 3, mirror.frame_of(stage, 0, b""), "127.0.0.1", 0)
    copy = MirrorStage(pickle.loads(pickle.dumps(opening)), frames, request_pipe)
    thread = threading.Thread(target=answer, args=(stage, requests, frame_pipe))
    thread.start()
    for env in (1, 0, 2):
        copy.body_poses(env)
        assert copy.readings == {}  # until a frame of this environment arrives
        while not copy.readings:
            time.sleep(0.001)
            copy.advance()
            pos, quat = copy.body_poses(env)
        np.testing.assert_allclose(pos[2], [0.01, 0.0, 0.0749 + lift[env, 0]], atol=1e-12)
        np.testing.assert_array_equal(quat, sim.body_poses(env)[1])
        np.testing.assert_array_equal(copy.readings["touch"][env], stage.readings["touch"][env])
        expected, contacts = stage.contacts(env), copy.contacts(env)
        assert contacts is not None and expected is not None
        np.testing.assert_array_equal(contacts.pos, expected.pos)
    assert float(copy.readings["touch"].norm()) > 0
    assert copy.time == stage.time
    request_pipe.close()
    thread.join()
    close(copy, frame_pipe, requests, frames)


def test_the_model_of_a_different_object_is_sent_once(document):
    variants = document.with_name("variants.yaml")
    shapes = "variants: [{type: sphere, size: [20 mm], density: 600}, {type: sphere, size: [15 mm], density: 600}]"
    variants.write_text(WITHOUT_PROXIMITY.replace("{body: ball}", f"{{body: ball, {shapes}}}"))
    touch = tgdsl.compile(variants)
    stage = SimStage(touch, tgdsl.simulate(touch, num_envs=2))
    known_shapes = mirror.shapes_of(stage.env_model(0))
    assert mirror.frame_of(stage, 0, known_shapes).model is None
    model = mirror.frame_of(stage, 1, known_shapes).model
    assert model is not None
    radius = pickle.loads(pickle.dumps(model)).geom("tgdsl/ball/0").size[0]
    assert radius == pytest.approx(0.015)
    assert mirror.frame_of(stage, 1, mirror.shapes_of(model)).model is None


def test_another_environment_of_a_halted_loop_is_not_drawn(document):
    touch = tgdsl.compile(document)
    stage = SimStage(touch, tgdsl.simulate(touch, num_envs=2))
    stage.update(touch(stage.sim.state()))
    (requests, request_pipe), (frames, frame_pipe) = (map(open, os.pipe(), ("rb", "wb")) for _ in range(2))
    opening = mirror._Opening(mirror._tables(touch), stage.model, 2, mirror.frame_of(stage, 0, b""), "127.0.0.1", 0)
    copy = MirrorStage(opening, frames, request_pipe)
    copy.body_poses(1)
    copy.advance()
    copy.body_poses(1)
    assert copy.readings == {}
    close(copy, frame_pipe, request_pipe, requests, frames)


def test_a_stage_with_nothing_to_draw_is_refused(document):
    bare = document.with_name("bare.yaml")
    bare.write_text(DOCUMENT.split("sensors:")[0] + "sensors:\n  hum: {kind: actuation_audio, samples: 32, substeps: 5}\n")
    touch = tgdsl.compile(bare)
    with pytest.raises(TgdslError, match="to draw"):
        tgdsl.show(touch, tgdsl.simulate(touch, num_envs=1, substeps=5))


def test_a_loops_page_shows_its_frames_and_ends_with_its_process(document, capsys):
    touch = tgdsl.compile(document)
    sim = tgdsl.simulate(touch, num_envs=1)
    page = tgdsl.show(touch, sim, port=8360)
    assert capsys.readouterr().out == f"tgdsl view: {page.url}\n"

    def sends(num: int) -> bool:
        begin, wanted = time.monotonic(), page.num_frames + num
        while page.num_frames < wanted and page._process.poll() is None and time.monotonic() < begin + 60:
            page.update(touch(sim.state()))
            time.sleep(0.01)
        return page.num_frames >= wanted

    with silent_browser(page.url):
        assert sends(2)
        page._process.send_signal(signal.SIGINT)  # as Ctrl-C does, for both processes of a terminal
        assert sends(10)
        expected = min(os.getpriority(os.PRIO_PROCESS, 0) + mirror.PRIORITY, mirror.LOWEST_PRIORITY)
        assert os.getpriority(os.PRIO_PROCESS, page._process.pid) == expected
        assert page._thread.daemon  # the loop's process ends without `close`
    page.close()
    assert capsys.readouterr().err == ""
    assert page._process.returncode is not None
    assert page._process.stdin.closed and page._process.stdout.closed
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", int(page.url.rpartition(":")[2])))


@pytest.mark.slow
def test_a_loop_sends_frames_while_a_browser_is_connected_and_outlives_the_page(document, capfd):
    touch = tgdsl.compile(document)
    sim = tgdsl.simulate(touch, num_envs=2)
    page = tgdsl.show(touch, sim, port=8350)

    def loop(seconds: float, is_over: Callable[[], bool] = lambda: False) -> int:
        begin, num_before = time.monotonic(), page.num_frames
        while time.monotonic() - begin < seconds and not is_over():
            sim.step()
            page.update(touch(sim.state()))
            time.sleep(0.002)
        return page.num_frames - num_before

    assert loop(0.5) == 0
    for _ in range(2):  # closed and opened again
        with silent_browser(page.url):
            num_before = page.num_frames
            loop(60.0, lambda num_before=num_before: page.num_frames > num_before + 2)
            assert page.num_frames > num_before + 2
            assert loop(1.0) <= 31  # 30 per second
        loop(60.0, lambda: loop(1.0) == 0)
        assert loop(0.5) == 0
    page._process.kill()
    page._thread.join()
    assert loop(0.1) == 0
    assert "the loop goes on without it" in capfd.readouterr().err
    page.close()
