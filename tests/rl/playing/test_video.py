"""A video: frames of the poses at the speed of time; OpenGL is replaced here, as not every computer has it."""

import re
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest

from tgdsl.errors import FileError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing import video as module
from tgdsl.rl.playing.record import PlayRecord
from tgdsl.rl.playing.rollout import ZeroActor, rollout
from tgdsl.rl.playing.video import HEIGHT, WIDTH, VideoError, video

SCENE = """
<mujoco>
  <worldbody>
    <camera name="front"/><camera name="left side"/>
    <body><joint name="lift" type="slide" axis="0 0 1"/><geom size=".1"/></body>
  </worldbody>
</mujoco>
"""
TASK = Path(__file__).parents[3] / "examples" / "tasks" / "find_ridge.yaml"


class Renderer(mujoco.Renderer):
    """Draws a grey as bright as the body is high, and notes what it was asked for."""

    asked: list = []

    def __init__(self, model, height, width):
        assert (height, width) == (HEIGHT, WIDTH)
        assert (model.vis.global_.offheight, model.vis.global_.offwidth) == (HEIGHT, WIDTH)
        self.is_closed = False
        Renderer.asked.append(self)

    def update_scene(self, data, camera):
        self.lifted, self.camera = data.xpos[1, 2], camera

    def render(self):
        return np.full((HEIGHT, WIDTH, 3), round(255 * self.lifted), dtype=np.uint8)

    def close(self):
        self.is_closed = True


@pytest.fixture
def opengl(monkeypatch):
    Renderer.asked = []
    monkeypatch.setattr(mujoco, "Renderer", Renderer)


def model_of(scene=SCENE):
    return mujoco.MjModel.from_xml_string(scene)


def frames_of(path):
    """Return size and rate of a video, and the mean brightness of each frame."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    ran = subprocess.run(command, capture_output=True, check=True)
    said = re.search(r"Video: h264.* (\d+)x(\d+),.* ([\d.]+) fps", ran.stderr.decode())
    frames = np.frombuffer(ran.stdout, dtype=np.uint8).reshape(-1, HEIGHT * WIDTH)
    return (int(said[1]), int(said[2])), float(said[3]), frames.mean(axis=1) / 255


def test_each_pose_is_a_frame(opengl, tmp_path):
    heights = np.linspace(0.1, 0.9, 20)
    told, model = [], model_of()
    assert video(model, {"qpos": heights[:, None]}, 0.025, tmp_path / "v.mp4", progress=told.append) == tmp_path / "v.mp4"
    size, rate, means = frames_of(tmp_path / "v.mp4")
    assert (size, rate) == ((WIDTH, HEIGHT), 40.0)
    np.testing.assert_allclose(means, heights, atol=0.02)  # of the colours' coding
    assert told[-1] == "drawing the video: frame 20 of 20"
    assert (model.vis.global_.offheight, model.vis.global_.offwidth) == (480, 640)  # the caller's stays as it was
    assert Renderer.asked[0].is_closed and list(tmp_path.iterdir()) == [tmp_path / "v.mp4"]


def test_short_control_steps_are_thinned_out(opengl, tmp_path):
    """At 5 ms every fourth pose is shown, 50 per second."""
    heights = np.linspace(0.1, 0.9, 21)
    video(model_of(), {"qpos": heights[:, None]}, 0.005, tmp_path / "v.mp4")
    _, rate, means = frames_of(tmp_path / "v.mp4")
    assert rate == 50.0
    np.testing.assert_allclose(means, heights[::4], atol=0.02)


def test_cameras(opengl, tmp_path):
    """The one that is named, the scene's first, or MuJoCo's free one."""
    without = re.sub("<camera.*?/>", "", SCENE)
    for scene, camera, used in ((SCENE, "left side", "left side"), (SCENE, None, 0), (without, None, -1)):
        video(model_of(scene), {"qpos": np.zeros((1, 1))}, 0.025, tmp_path / "v.mp4", camera=camera)
        assert Renderer.asked[-1].camera == used
    with pytest.raises(VideoError, match='the scene has no camera "frond"; did you mean "front"'):
        video(model_of(), {"qpos": np.zeros((1, 1))}, 0.025, tmp_path / "v.mp4", camera="frond")


def test_without_opengl(monkeypatch, tmp_path):
    def renderer(*_, **__):
        raise mujoco.FatalError("gladLoadGL error")

    monkeypatch.setattr(mujoco, "Renderer", renderer)
    with pytest.raises(VideoError) as raised:
        video(model_of(), {"qpos": np.zeros((1, 1))}, 0.025, tmp_path / "v.mp4")
    assert str(raised.value) == (
        "OpenGL cannot be started (FatalError: gladLoadGL error); without a display set the environment variable MUJOCO_GL to egl "
        "or osmesa"
    )
    assert not list(tmp_path.iterdir())


def test_bodies_that_are_put_by_mocap_are_where_they_were(opengl, monkeypatch, tmp_path):
    """The example to copy moves its object so."""
    env = TouchEnv(TASK, 2, threads=1, overrides={"touch": "none"})
    env.reset(0)
    record, places = PlayRecord(env, 2), []
    for played in rollout(ZeroActor(env), env, 2):
        record.add(played)

    def noted(self, data, camera):
        self.lifted = 0.0
        places.append(data.body("ridge").xpos.copy())

    monkeypatch.setattr(Renderer, "update_scene", noted)
    video(env.sim.env_model(1), record.poses(1), env.control_step, tmp_path / "v.mp4")
    expected = env.sim.arrays["mocap_pos"][1, 0].numpy()
    np.testing.assert_allclose(places, [expected] * len(places))
    assert places and abs(expected[1]) > 1e-4 and "mocap_pos" in record.poses(0)
    env.close()


def test_without_ffmpeg(opengl, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(VideoError, match=r'a video needs imageio-ffmpeg: pip install "tgdsl\[rl\]"'):
        video(model_of(), {"qpos": np.zeros((1, 1))}, 0.025, tmp_path / "v.mp4")


def test_what_cannot_be_written_is_named_and_not_left(opengl, monkeypatch, tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"before")
    monkeypatch.setattr(module, "_encoder", lambda: str(tmp_path / "encoder"))
    (tmp_path / "encoder").write_text("#!/bin/sh\nhead -c 100 > /dev/null\necho 'No space left on device' >&2\nexit 1\n")
    (tmp_path / "encoder").chmod(0o755)
    with pytest.raises(FileError) as raised:
        video(model_of(), {"qpos": np.zeros((3, 1))}, 0.025, tmp_path / "v.mp4")
    assert str(raised.value) == f"{tmp_path}/v.mp4: No space left on device"
    assert (tmp_path / "v.mp4").read_bytes() == b"before" and len(list(tmp_path.iterdir())) == 2


def test_an_interruption_ends_the_encoder(opengl, monkeypatch, tmp_path):
    started = []
    popen = subprocess.Popen

    def noted(*arguments, **more):
        started.append(popen(*arguments, **more))
        return started[-1]

    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", noted)
    monkeypatch.setattr(Renderer, "render", interrupted)
    with pytest.raises(KeyboardInterrupt):
        video(model_of(), {"qpos": np.zeros((3, 1))}, 0.025, tmp_path / "v.mp4")
    assert started[0].returncode is not None and not list(tmp_path.iterdir())
