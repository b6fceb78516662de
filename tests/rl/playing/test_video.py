"""Videos: frames of poses in real time; OpenGL is replaced here, as not every computer has it."""

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
    """Draws a grey as bright as the body is high, and records its instances."""

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
    process = subprocess.run(command, capture_output=True, check=True)
    header = re.search(r"Video: h264.* (\d+)x(\d+),.* ([\d.]+) fps", process.stderr.decode())
    frames = np.frombuffer(process.stdout, dtype=np.uint8).reshape(-1, HEIGHT * WIDTH)
    return (int(header[1]), int(header[2])), float(header[3]), frames.mean(axis=1) / 255


def test_each_pose_is_a_frame(opengl, tmp_path):
    heights = np.linspace(0.1, 0.9, 20)
    messages, model = [], model_of()
    assert video(model, {"qpos": heights[:, None]}, 0.025, tmp_path / "v.mp4", progress=messages.append) == tmp_path / "v.mp4"
    size, rate, means = frames_of(tmp_path / "v.mp4")
    assert (size, rate) == ((WIDTH, HEIGHT), 40.0)
    np.testing.assert_allclose(means, heights, atol=0.02)  # the codec rounds colours
    assert messages[-1] == "drawing the video: frame 20 of 20"
    assert (model.vis.global_.offheight, model.vis.global_.offwidth) == (480, 640)  # the caller's model is unchanged
    assert Renderer.asked[0].is_closed and list(tmp_path.iterdir()) == [tmp_path / "v.mp4"]


def test_short_control_steps_are_thinned_out(opengl, tmp_path):
    """At 5 ms every fourth pose is shown: 50 per second."""
    heights = np.linspace(0.1, 0.9, 21)
    video(model_of(), {"qpos": heights[:, None]}, 0.005, tmp_path / "v.mp4")
    _, rate, means = frames_of(tmp_path / "v.mp4")
    assert rate == 50.0
    np.testing.assert_allclose(means, heights[::4], atol=0.02)


def test_choice_of_the_camera(opengl, tmp_path):
    """The named camera, else the scene's first, else MuJoCo's free one."""
    scene_without_camera = re.sub("<camera.*?/>", "", SCENE)
    for scene, camera, used in ((SCENE, "left side", "left side"), (SCENE, None, 0), (scene_without_camera, None, -1)):
        video(model_of(scene), {"qpos": np.zeros((1, 1))}, 0.025, tmp_path / "v.mp4", camera=camera)
        assert Renderer.asked[-1].camera == used
    with pytest.raises(VideoError, match='the scene has no camera "frond"; did you mean "front"'):
        video(model_of(), {"qpos": np.zeros((1, 1))}, 0.025, tmp_path / "v.mp4", camera="frond")


def test_missing_opengl_is_reported(monkeypatch, tmp_path):
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


def test_mocap_bodies_are_drawn_in_place(opengl, monkeypatch, tmp_path):
    """The example task moves its object by mocap."""
    env = TouchEnv(TASK, 2, threads=1, overrides={"touch": "none"})
    env.reset(0)
    record, positions = PlayRecord(env, 2), []
    for frame in rollout(ZeroActor(env), env, 2):
        record.add(frame)

    def record_position(self, data, camera):
        self.lifted = 0.0
        positions.append(data.body("ridge").xpos.copy())

    monkeypatch.setattr(Renderer, "update_scene", record_position)
    video(env.sim.env_model(1), record.poses(1), env.control_step, tmp_path / "v.mp4")
    expected = env.sim.arrays["mocap_pos"][1, 0].numpy()
    np.testing.assert_allclose(positions, [expected] * len(positions))
    assert positions and abs(expected[1]) > 1e-4 and "mocap_pos" in record.poses(0)
    env.close()


def test_missing_ffmpeg_is_reported(opengl, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(VideoError, match=r'a video needs imageio-ffmpeg: pip install "tgdsl\[rl\]"'):
        video(model_of(), {"qpos": np.zeros((1, 1))}, 0.025, tmp_path / "v.mp4")


def test_a_failed_video_is_reported_and_leaves_no_file(opengl, monkeypatch, tmp_path):
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

    def recording_popen(*arguments, **options):
        started.append(popen(*arguments, **options))
        return started[-1]

    def interrupt(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", recording_popen)
    monkeypatch.setattr(Renderer, "render", interrupt)
    with pytest.raises(KeyboardInterrupt):
        video(model_of(), {"qpos": np.zeros((3, 1))}, 0.025, tmp_path / "v.mp4")
    assert started[0].returncode is not None and not list(tmp_path.iterdir())
