"""Draw instants of what a policy does, side by side, in one image.

    MUJOCO_GL=osmesa python benchmarks/gait_strip.py examples/tasks/screwdriver.yaml policies/screwdriver.pt --every 0.05 \
        --distance 0.45 --azimuth=200 --elevation=-25 --out docs/images/screwdriver.png

One environment with the task's first variant, in MuJoCo, without exploration.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from tgdsl.commands.arguments import parsed_overrides
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.policy import policy_for, read_policy

COLUMNS, ROWS, WIDTH, HEIGHT = 6, 2, 240, 200
"""Images beside and below one another, and pixels of each."""


def poses(options: argparse.Namespace) -> tuple[mujoco.MjModel, int, list[np.ndarray]]:
    """Return the model, the object's body, and `qpos` at the instants that are drawn."""
    env = TouchEnv(options.task, 1, seed=options.seed, overrides=parsed_overrides(tuple(options.set)))
    policy, obs, found = policy_for(env, read_policy(options.policy)), env.reset(), []
    first, every = (round(time / env.control_step) for time in (options.first, options.every))
    for step in range(first + every * COLUMNS * ROWS):
        if step >= first and (step - first) % every == 0:
            found.append(env.sim.qpos[0].double().numpy().copy())
        made = env.step(policy(obs))
        obs = made.obs
        if made.info.ended.any():
            raise SystemExit(f"the episode ends after {step + 1} control steps, before the last instant: take another --seed")
    model = env.sim.model
    body = int(model.body(env.task.setup.object).id)
    env.close()
    return model, body, found


def strip(model: mujoco.MjModel, body: int, instants: list[np.ndarray], options: argparse.Namespace) -> Image.Image:
    """Return the image: the camera looks at where the object is at the first instant."""
    data, image = mujoco.MjData(model), Image.new("RGB", (COLUMNS * WIDTH, ROWS * HEIGHT))
    data.qpos[:] = instants[0]
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = data.xpos[body], options.distance
    camera.azimuth, camera.elevation = options.azimuth, options.elevation
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for i, pose in enumerate(instants):
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            image.paste(Image.fromarray(renderer.render()), (i % COLUMNS * WIDTH, i // COLUMNS * HEIGHT))
    return image


def main() -> None:
    """Draw one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", type=Path)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--first", type=float, default=2.0, help="first instant [s]")
    parser.add_argument("--every", type=float, default=0.075, help="from one to the next [s]")
    parser.add_argument("--distance", type=float, default=0.3, help="of the camera from the object [m]")
    parser.add_argument("--azimuth", type=float, default=150.0, help="of where it looks [deg]")
    parser.add_argument("--elevation", type=float, default=-40.0, help="the same [deg]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="of the task's document")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    strip(*poses(options), options).quantize(128).save(options.out, optimize=True)
    print(options.out)


if __name__ == "__main__":
    main()
