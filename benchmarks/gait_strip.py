"""Draw the motion of a policy: a strip of instants in one image, or a GIF in real time with taxels on a translucent hand.

    MUJOCO_GL=osmesa python benchmarks/gait_strip.py examples/tasks/screwdriver.yaml policies/screwdriver.pt --every 0.05 \
        --distance 0.45 --azimuth=200 --elevation=-25 --out docs/images/screwdriver.png
    MUJOCO_GL=egl python benchmarks/gait_strip.py examples/tasks/in_palm_rotate_cube_held.yaml \
        policies/in_palm_rotate_cube_held.pt --set touch=force_taxel --first 2.075 --every 0.05 --frames 45 --distance 0.175 \
        --azimuth=60 --elevation=-50 --out docs/images/turn.gif

One environment with the task's first variant runs in MuJoCo, without exploration.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from tgdsl.commands.arguments import parsed_overrides
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.policy import policy_for, read_policy
from tgdsl.view.trace import TouchTrace

COLUMNS, ROWS, WIDTH, HEIGHT = 6, 2, 240, 200
"""Images per row, rows, and pixels of each image."""
FRAME = (480, 300)
"""Pixels of a GIF's frame."""
HAND, OBJECT, HIDDEN = (0.55, 0.58, 0.64, 0.36), (0.3, 0.5, 0.8, 1.0), (0.0, 0.0, 0.0, 0.0)


def poses(options: argparse.Namespace) -> tuple[mujoco.MjModel, int, list[np.ndarray], TouchTrace]:
    """Return the model, the object's body, and `qpos` and the first sensor's readings at each instant."""
    env = TouchEnv(options.task, 1, seed=options.seed, overrides=parsed_overrides(tuple(options.set)))
    policy, obs, instants = policy_for(env, read_policy(options.policy)), env.reset(), []
    first, every = (round(time / env.control_step) for time in (options.first, options.every))
    trace = TouchTrace(env.touch, next(output for output in env.touch.outputs if output.rows == "taxel"), options.frames)
    for step in range(first + every * options.frames):
        if step >= first and (step - first) % every == 0:
            trace.add(len(instants), env.now.readings)
            instants.append(env.sim.qpos[0].double().numpy().copy())
        result = env.step(policy(obs))
        obs = result.obs
        if result.info.ended.any():
            raise SystemExit(f"the episode ends after {step + 1} control steps, before the last instant: take another --seed")
    model = env.sim.model
    body = int(model.body(env.task.setup.object).id)
    env.close()
    return model, body, instants, trace


def images(
    model: mujoco.MjModel, body: int, instants: list[np.ndarray], options: argparse.Namespace, trace: TouchTrace | None
) -> Iterator[Image.Image]:
    """Yield an image of each instant; the camera looks at the object's first position."""
    width, height = (WIDTH, HEIGHT) if trace is None else (2 * FRAME[0], 2 * FRAME[1])
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    data.qpos[:] = instants[0]
    mujoco.mj_forward(model, data)
    camera.lookat[:], camera.distance = data.xpos[body], options.distance
    camera.azimuth, camera.elevation = options.azimuth, options.elevation
    with mujoco.Renderer(model, height, width) as renderer:
        for i, pose in enumerate(instants):
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            if trace is not None:
                draw_taxels(renderer.scene, model, data, trace, i)
            yield Image.fromarray(renderer.render())


def strip(frames: Iterable[Image.Image]) -> Image.Image:
    """Return the images in rows."""
    image = Image.new("RGB", (COLUMNS * WIDTH, ROWS * HEIGHT))
    for i, frame in enumerate(frames):
        image.paste(frame, (i % COLUMNS * WIDTH, i // COLUMNS * HEIGHT))
    return image.quantize(128)


def draw_taxels(scene: mujoco.MjvScene, model: mujoco.MjModel, data: mujoco.MjData, trace: TouchTrace, step: int) -> None:
    """Add the taxels to a scene; those with nonzero readings glow."""
    first = scene.ngeom
    trace.draw(scene, model, data, step)
    for geom in scene.geoms[first : scene.ngeom]:
        geom.emission = 0.9 if np.ptp(geom.rgba[:3]) > 0.2 else 0.0  # grey: the reading is 0


def darken(model: mujoco.MjModel, body: int) -> None:
    """Make the hand translucent and hide the floor and the sky, so that taxels stand out."""
    is_object, is_plane = model.geom_bodyid == body, model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_rgba[:] = np.where(is_object[:, None], OBJECT, np.where(is_plane[:, None], HIDDEN, HAND))
    model.geom_matid[:] = -1
    model.tex_data[:] = 30
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.25, 0.35
    model.light_diffuse[:] = 0.35
    model.light_ambient[:], model.light_castshadow[:] = 0.0, False


def palette(frames: list[Image.Image]) -> Image.Image:
    """Return an image with 160 colours for all frames; half of them are warm colours of taxels, which cover few pixels."""
    pixels = np.concatenate([np.asarray(frame).reshape(-1, 3) for frame in frames[:: max(1, len(frames) // 6)]])
    warm = pixels[pixels[:, 0] > pixels[:, 2].astype(int) + 25]
    balanced = np.concatenate([pixels, np.resize(warm, pixels.shape)]) if len(warm) else pixels
    return Image.fromarray(balanced.reshape(-1, FRAME[0], 3)).quantize(160, method=Image.Quantize.MEDIANCUT)


def main() -> None:
    """Draw a strip or a GIF."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", type=Path)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--first", type=float, default=2.0, help="first instant [s]")
    parser.add_argument("--every", type=float, default=0.075, help="time between instants [s]")
    parser.add_argument("--frames", type=int, default=COLUMNS * ROWS, help="number of instants")
    parser.add_argument("--distance", type=float, default=0.3, help="distance of the camera from the object [m]")
    parser.add_argument("--azimuth", type=float, default=150.0, help="azimuth of the camera [deg]")
    parser.add_argument("--elevation", type=float, default=-40.0, help="elevation of the camera [deg]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="change the task's document")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    model, body, instants, trace = poses(options)
    if options.out.suffix == ".gif":
        darken(model, body)
        trace.values = trace.values.clip(max=np.quantile(trace.values[trace.values > 0.0], 0.95))
        frames = [frame.resize(FRAME, Image.Resampling.LANCZOS) for frame in images(model, body, instants, options, trace)]
        colours, none = palette(frames), Image.Dither.NONE
        first, *rest = (frame.quantize(palette=colours, dither=none) for frame in frames)
        first.save(options.out, save_all=True, append_images=rest, duration=round(1e3 * options.every), loop=0, optimize=True)
    else:
        strip(images(model, body, instants, options, None)).save(options.out, optimize=True)
    print(options.out)


if __name__ == "__main__":
    main()
