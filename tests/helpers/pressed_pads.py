"""A pad of 6 × 6 taxels under some bodies, in both simulators, and what presses on it."""

import numpy as np
import torch
from warp_cases import warp

import tgdsl
from tgdsl.formats.robot import export_model

G = 9.81
LOAD = 0.3 * G
RESTING = 1e-4
"""Part of the load by which a body at rest for half a second may still press more or less, in float32 too."""
MODELS = ("mujoco", "warp")


PAD = '<body name="pad"><geom name="pad" type="box" size=".06 .06 .01"/></body>'


def compiled(folder, bodies, objects, sensors, dtype=torch.float64, extra="", as_usd=False, pad=PAD):
    """Return a module of a pad of 6 × 6 taxels under some bodies."""
    text = f'<mujoco><option timestep=".002"/>{extra}<worldbody>{pad}{bodies}</worldbody></mujoco>'
    (folder / "scene.xml").write_text(text)
    model = folder / ("scene.usda" if as_usd else "scene.xml")
    if as_usd:
        export_model(folder / "scene.xml", model)
    line = np.linspace(-0.025, 0.025, 6)
    points = [{"pos": [float(x), float(y), 0.01], "normal": [0, 0, 1], "radius": 0.004} for x in line for y in line]
    layout = {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}}
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(model), "layout": layout},
            "objects": objects,
            "sensors": {name: {"links": "pad", **sensor} for name, sensor in sensors.items()},
        },
        dtype=dtype,
    )


def of_kinds(feels, **more):
    """Return sensors of every kind that reads the solver's force, each feeling the same."""
    return {
        "link": {"kind": "link_contact", "feels": feels, "outputs": ["force"], **more},
        "shared": {"kind": "force_taxel", "feels": feels, **more},
        "balanced": {"kind": "kinematic_taxel", "balance": "solver", "outputs": ["force"], "feels": feels, **more},
    }


def simulated(touch, which, num_envs=1, **options):
    if which == "warp":
        touch.float()
        return warp(touch, num_envs, **options)
    return tgdsl.simulate(touch, num_envs, **options)


def pressed(touch, which, steps=250, **options):
    """Return by sensor what presses down on the pad [N] after half a second."""
    sim = simulated(touch, which, substeps=steps, **options)
    sim.step()
    return {name: -float(value[0, :, 2].sum()) for name, value in touch(sim.state()).items() if "/" not in name}
