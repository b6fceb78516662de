"""A video of one environment, drawn by MuJoCo with OpenGL from a record of poses, and encoded by ffmpeg.

Shapes: `step` control steps, `nq` as in MuJoCo's model.
"""

from __future__ import annotations

import contextlib
import copy
import math
import subprocess
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import FileError, TgdslError, did_you_mean
from tgdsl.files.write import atomic_path
from tgdsl.view.trace import TouchTrace

WIDTH, HEIGHT = 960, 720  # pixels of a frame
MAX_RATE = 60.0  # frames per second that a video has at most
Frame = UInt8[np.ndarray, "row column 3"]


class VideoError(TgdslError):
    """A video that cannot be rendered or encoded here."""


def check_camera(model: mujoco.MjModel, camera: str | None) -> None:
    """Raise `VideoError` if a scene lacks a camera."""
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera is not None and camera not in names:
        raise VideoError(f'the scene has no camera "{camera}"; {did_you_mean(camera, names, "cameras")}')


def video(
    model: mujoco.MjModel,
    poses: Mapping[str, Float[np.ndarray, "step ..."]],
    control_step: float,
    path: Path,
    camera: str | None = None,
    progress: Progress = silent,
    trace: TouchTrace | None = None,
) -> Path:
    """Draw an environment in real time; return the file."""
    check_camera(model, camera)
    every = max(1, math.ceil(1.0 / (MAX_RATE * control_step) - 1e-9))
    steps, encoder = range(0, len(poses["qpos"]), every), _encoder()
    with closing(_renderer(model)) as renderer, atomic_path(path) as temporary:
        frames = _frames(model, poses, steps, renderer, camera, trace, progress)
        _encode(encoder, frames, 1.0 / (every * control_step), temporary, path)
    return path


def _frames(
    model: mujoco.MjModel,
    poses: Mapping[str, Float[np.ndarray, "step ..."]],
    steps: range,
    renderer: mujoco.Renderer,
    camera: str | None,
    trace: TouchTrace | None,
    progress: Progress,
) -> Iterator[Frame]:
    data, bars = mujoco.MjData(model), None if trace is None else trace.bars()
    seen_from = camera if camera is not None else (0 if model.ncam else -1)
    for number, i in enumerate(steps):
        progress(f"drawing the video: frame {number + 1} of {len(steps)}")
        for name, values in poses.items():
            getattr(data, name)[:] = values[i]
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, seen_from)
        if trace is None or bars is None:
            yield renderer.render()
        else:
            trace.draw(renderer.scene, model, data, i)
            yield bars.draw(renderer.render(), i)


def _renderer(model: mujoco.MjModel) -> mujoco.Renderer:
    drawn = copy.copy(model)
    drawn.vis.global_.offwidth, drawn.vis.global_.offheight = WIDTH, HEIGHT
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of GLFW, which then raises as well
            return mujoco.Renderer(drawn, height=HEIGHT, width=WIDTH)
    except Exception as error:  # each of MuJoCo's OpenGL backends raises different errors
        problem = f"OpenGL cannot be started ({type(error).__name__}: {error})"
        raise VideoError(f"{problem}; without a display set the environment variable MUJOCO_GL to egl or osmesa") from error


def _encoder() -> str:
    try:
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise VideoError(f'a video needs imageio-ffmpeg: pip install "tgdsl[rl]" ({error})') from error


def _encode(encoder: str, frames: Iterable[Frame], rate: float, file: Path, target: Path) -> None:
    input_options = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", f"{rate:.9g}", "-i", "-"]
    output_options = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(file)]
    command = [encoder, "-y", "-v", "error", *input_options, *output_options]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe) as process:
        assert process.stdin is not None and process.stderr is not None
        try:
            with contextlib.suppress(BrokenPipeError):  # it has ended: its own words follow
                for frame in frames:
                    process.stdin.write(np.ascontiguousarray(frame).data)
                process.stdin.close()
        except BaseException:
            process.kill()
            raise
        said = process.stderr.read().decode(errors="replace").strip().splitlines()
    if process.returncode:
        raise FileError(target, said[-1] if said else f"ffmpeg ended with code {process.returncode}")
