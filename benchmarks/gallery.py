"""Draw the small pictures of `examples/README.md` into docs/images/gallery: examples, tasks, and a panel per kind.

    MUJOCO_GL=egl python benchmarks/gallery.py                  # all, minutes on one core
    MUJOCO_GL=egl python benchmarks/gallery.py tasks/hot_ball   # one picture

A document is stepped as by `tgdsl run`, a task by its published policy or without actions.
Taxels with nonzero readings are large and coloured. `plugins/plugins` needs `pip install examples/plugins`.
docs/images/motors.png is the spectrogram of `tgdsl listen examples/every_sensor.yaml --sensors motors`.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
import torch._dynamo  # before OpenGL: loaded later, its LLVM and Mesa's crash the process
from gait_strip import darken, draw_taxels
from PIL import Image

import tgdsl
from tgdsl.commands.documents import Run
from tgdsl.module.outputs import Output
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.policy import policy_for, read_policy
from tgdsl.view.trace import TouchTrace

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "images" / "gallery"
SIZE = (360, 250)
"""Pixels of a picture."""


@dataclass(frozen=True)
class Shot:
    """A picture: the camera looks at a body from a distance [m] along an azimuth and an elevation [deg]."""

    at: str
    distance: float
    azimuth: float
    elevation: float
    policy: str = ""
    seconds: float = 1.5
    overrides: tuple[tuple[str, object], ...] = ()
    hides: str = ""
    """A body in front of the others, drawn almost transparent."""


SHOTS = {
    "xhand1_palm": Shot("cube", 0.19, 60, -50),
    "noisy_hand": Shot("cube", 0.19, 60, -50),
    "xhand1_tips": Shot("cube", 0.19, 60, -50),
    "plugins/plugins": Shot("cube", 0.19, 60, -50),
    "in_hand": Shot("cube", 0.19, 20, -50),
    "bin_balls": Shot("ball2", 0.45, 60, -30, hides="bin"),
    "screwdriver": Shot("screwdriver", 0.34, 225, -25),
    "pyramid": Shot("sensor", 0.9, 60, -25),
    "tasks/in_palm_rotate": Shot("item", 0.19, 60, -50, "in_palm_rotate", 2.0),
    "tasks/in_palm_rotate_cube": Shot("item", 0.19, 60, -50, "in_palm_rotate_cube"),
    "tasks/in_palm_rotate_cube_held": Shot("item", 0.19, 60, -50, "in_palm_rotate_cube_held", 2.1),
    "tasks/in_palm_rotate_held": Shot("item", 0.19, 60, -50, "in_palm_rotate_held", 2.1),
    "tasks/in_palm_rotate_cube_gentle": Shot(
        "item", 0.19, 60, -50, "in_palm_rotate_cube_held", 2.6, (("action.smoothing", 0.6),)
    ),
    "tasks/published/in_palm_rotate": Shot("item", 0.19, 60, -50),
    "tasks/published/in_hand_repose": Shot("item", 0.24, 60, -50, seconds=0.3),
    "tasks/published/screwdriver": Shot("screwdriver", 0.34, 225, -30, seconds=0.3, overrides=(("grasps.num", 4),)),
    "tasks/in_hand_repose": Shot("item", 0.24, 60, -50, "in_hand_repose", 0.7),
    "tasks/in_hand_repose_sharpa": Shot("item", 0.28, 60, -50),
    "tasks/screwdriver": Shot("screwdriver", 0.34, 225, -30, "screwdriver", overrides=(("grasps.num", 4),)),
    "tasks/screwdriver_held": Shot("screwdriver", 0.34, 225, -30, "screwdriver_held", overrides=(("grasps.num", 4),)),
    "tasks/grip_force": Shot("item", 0.28, 270, -45, "grip_force"),
    "tasks/hot_ball": Shot("ball0", 0.9, 60, -30, overrides=(("touch", "depth"), ("placement", "hand")), hides="bin"),
    "tasks/find_ridge": Shot("ridge", 0.12, 60, -15, "find_ridge"),
}
PANELS = ("contact", "contact_depth", "surface_distance", "kinematic_taxel", "force_taxel", None, None, "link_contact")
PANELS += ("proximity", "elastomer", "temperature_grid")
"""Kinds in the panels of docs/images/every_sensor.png (by `tgdsl run examples/every_sensor.yaml`), in rows of four."""
CROPS = {
    "every_sensor": ("every_sensor.png", (0, 50, 1560, 1133)),
    "warm_palm": ("warm_palm.png", (0, 100, 624, 590)),
    "learn": ("learn.png", (0, 0, 1200, 600)),
    "materials_audio": ("materials_audio.png", (0, 0, 1000, 585)),
    "kind_contact_audio": ("materials_audio.png", (0, 0, 1000, 300)),
    "kind_microphone": ("materials_audio.png", (0, 880, 1000, 1230)),
    "kind_actuation_audio": ("motors.png", (0, 14, 900, 265)),
}
CROPS |= {
    f"kind_{kind}": ("every_sensor.png", (65 + 388 * (i % 4), 104 + 365 * (i // 4), 330 + 388 * (i % 4), 377 + 365 * (i // 4)))
    for i, kind in enumerate(PANELS)
    if kind is not None
}
"""Crops of other pictures: the file in docs/images, and left, top, right and bottom [pixel]."""


def document(name: str) -> tuple[mujoco.MjModel, np.ndarray, TouchTrace]:
    """Return the scene of a document, and the `qpos` and readings of the step with most nonzero taxels."""
    path = ROOT / "examples" / f"{name}.yaml"
    touch = tgdsl.compile(path)
    with tempfile.TemporaryDirectory() as folder:
        Run(path, out=Path(folder)).run()
        record = dict(np.load(Path(folder) / "readings.npz"))
    output = first_on_taxels([*touch.outputs])
    trace = TouchTrace(touch, output, 1)
    step = int(np.argmax((np.abs(record[output.name]) > 0.0).sum(axis=(1, 2, 3))))
    trace.add(0, {output.name: torch.as_tensor(record[output.name][step])})
    sim = tgdsl.simulate(touch, 1)
    return sim.env_model(0), record["qpos"][step, 0], trace


def task(name: str, shot: Shot) -> tuple[mujoco.MjModel, np.ndarray, TouchTrace]:
    """Return the scene of a task, and its `qpos` and readings after some seconds."""
    env = TouchEnv(ROOT / "examples" / f"{name}.yaml", 1, seed=0, overrides=dict(shot.overrides))
    policy = policy_for(env, read_policy(ROOT / "policies" / f"{shot.policy}.pt")) if shot.policy else None
    obs = env.reset()
    for _ in range(round(shot.seconds / env.control_step)):
        obs = env.step(torch.zeros(1, env.num_actions) if policy is None else policy(obs)).obs
    trace = TouchTrace(env.touch, first_on_taxels([*env.touch.outputs]), 1)
    trace.add(0, env.now.readings)
    return env.sim.env_model(0), env.sim.qpos[0].double().numpy().copy(), trace


def first_on_taxels(outputs: list[Output]) -> Output:
    """Return the first output with a row per taxel."""
    return next(output for output in outputs if output.rows == "taxel" and output.kind != "surface_distance")


def picture(model: mujoco.MjModel, qpos: np.ndarray, trace: TouchTrace, shot: Shot) -> Image.Image:
    """Draw a picture."""
    darken(model, model.body(shot.at).id)
    if shot.hides:
        model.geom_rgba[model.geom_bodyid == model.body(shot.hides).id, 3] = 0.1
    model.vis.global_.offwidth, model.vis.global_.offheight = 2 * SIZE[0], 2 * SIZE[1]
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    camera.lookat[:] = data.xpos[model.body(shot.at).id]
    camera.distance, camera.azimuth, camera.elevation = shot.distance, shot.azimuth, shot.elevation
    with mujoco.Renderer(model, 2 * SIZE[1], 2 * SIZE[0]) as renderer:
        renderer.update_scene(data, camera)
        draw_taxels(renderer.scene, model, data, trace, 0)
        return Image.fromarray(renderer.render()).resize(SIZE, Image.Resampling.LANCZOS)


def crop(name: str) -> Image.Image:
    """Return a crop of another picture, at most as large as `SIZE`."""
    file, box = CROPS[name]
    image = Image.open(ROOT / "docs" / "images" / file).convert("RGB").crop(box)
    image.thumbnail(SIZE, Image.Resampling.LANCZOS)
    return image


def main() -> None:
    """Draw the named pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="pictures; default: all")
    names = parser.parse_args().names
    OUT.mkdir(exist_ok=True)
    for name in names or (*SHOTS, *CROPS):
        if name in CROPS:
            save(crop(name), name)
        else:
            scene = task(name, SHOTS[name]) if name.startswith("tasks/") else document(name)
            save(picture(*scene, SHOTS[name]), name.replace("/", "_"))


def save(image: Image.Image, name: str) -> None:
    """Write a picture with 256 colours."""
    path = OUT / f"{name}.png"
    image.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path.relative_to(ROOT), path.stat().st_size)


if __name__ == "__main__":
    main()
