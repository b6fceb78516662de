"""A pad of 6 × 6 force taxels and a cube of 4 cm on it, in MuJoCo."""

from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import tgdsl

PAD = """
<mujoco>
  <option timestep="{timestep}" cone="elliptic" impratio="10" gravity="{gravity}"/>
  <worldbody>
    <body name="pad" {mount}><geom name="pad" type="box" size=".06 .06 .01" friction="{friction}"/></body>
    <body name="cube" {place}><freejoint/><geom type="box" size=".02 .02 .02" mass="{mass}" friction="{friction}"/></body>
  </worldbody>
  <keyframe><key name="start" qvel="{qvel}"/></keyframe>
</mujoco>
"""
FOOTPRINT = 0.015
"""Radius of a footprint [m]: half of it reaches from the middle of a cell of the pad to its taxels."""
LINE = np.linspace(-0.025, 0.025, 6)
TAXELS = [(x, y, 0.01) for x in LINE for y in LINE]


def pad(
    folder, taxels=TAXELS, mass=0.25, place="pos='0 0 .03'", mount="", friction=1.0, qvel="0 0 0 0 0 0",
    timestep=0.002, dtype=torch.float64, gravity="0 0 -9.81", **sensor: Any,
):  # fmt: skip
    """Return a module with one sensor, `s`, whose taxels lie on top of a pad of 12 cm that carries a cube of 4 cm.

    They are force taxels, unless another kind is named.
    """
    text = PAD.format(mass=mass, place=place, mount=mount, friction=friction, qvel=qvel, timestep=timestep, gravity=gravity)
    (folder / "scene.xml").write_text(text)
    points = [{"pos": [float(v) for v in pos], "normal": [0, 0, 1], "radius": 0.004} for pos in taxels]
    kind = {} if "kind" in sensor else {"kind": "force_taxel", "footprint": FOOTPRINT}
    document = {
        "tgdsl": 1,
        "robot": {
            "model": str(folder / "scene.xml"),
            "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}},
        },
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"s": {"links": "pad", "feels": ["cube"], **kind, **sensor}},
    }
    return tgdsl.compile(document, dtype=dtype)


def settled(touch, steps=1500, **options):
    sim = tgdsl.simulate(touch, 1, substeps=steps, **options)
    sim.step()
    return sim.state()


def in_link(touch, state, vector):
    """Return world vectors of one environment in the pad's frame."""
    quat = state.body_quat[0, touch.inputs.bodies.index("pad")].numpy()
    return Rotation.from_quat(quat, scalar_first=True).inv().apply(vector)


def wrench(touch, state):
    """Return the solver's force on the pad and its moment about the pad's origin, in the pad's frame."""
    origin = state.body_pos[0, touch.inputs.bodies.index("pad")].numpy()
    arms = state.contact_pos[0, 0].numpy() - origin
    moment = np.cross(arms, state.contact_force[0, 0].numpy()) + state.contact_torque[0, 0].numpy()
    return in_link(touch, state, state.contact_netforce[0, 0].numpy()), in_link(touch, state, moment.sum(axis=0))
