"""A cube on a table and an arm with a pad, stepped by MuJoCo Warp on its CPU device and by MuJoCo, and how they are compared."""

import dataclasses

import mujoco
import numpy as np
import torch

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.warp import WarpSimulation

TOLERANCE = 1e-5
"""Of the largest magnitude of a field in the batch: float32 against float64."""
MOVING_FORCE = 1e-3
"""The same for forces of contacts that slide and part, with a solver that stops where MuJoCo's does: found are up to 2e-4."""
WEIGHT = 0.25 * 9.81
FORCES = ("contact_force", "contact_torque", "contact_netforce")
CONTACTS = ("contact_found", "contact_pos", "contact_force", "contact_torque", "contact_normal", "contact_netforce")

SCENE = """
<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="10" integrator="implicitfast"/>
  <worldbody>
    <body name="table"><geom type="box" size=".05 .05 .01" friction="1"/></body>
    <body name="cube" pos="0 0 .0299"><freejoint/><geom name="cube" type="box" size=".02 .02 .02" mass=".25" friction="1"/></body>
    <body name="arm" pos=".3 -.2 .3" quat=".8 .2 -.4 .1">
      <joint name="one" axis="0 1 .2"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .2 .05 0" contype="2" conaffinity="2"/>
      <body name="pad" pos=".2 .05 .03" euler="20 40 -30">
        <joint name="two" axis="1 0 .3" pos=".01 .02 0"/>
        <geom type="box" size=".03 .02 .015" pos=".008 -.01 .02" euler="10 20 30"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="one" joint="one" gear=".5"/>
    <motor name="two" joint="two" gear=".2"/>
  </actuator>
  <keyframe>
    <key name="home" qpos="0 0 .0299 1 0 0 0 .3 -.2" qvel=".1 -.2 0 .5 -.3 1 3 -2" ctrl=".1 -.1"/>
  </keyframe>
</mujoco>
"""
CUBE, JOINTS = slice(0, 6), slice(6, 8)


def module(folder, text=SCENE, links=("table", "pad"), target=None, observations=None, **sensor) -> TactileModule:
    (folder / "scene.xml").write_text(text)
    probes = [{"pos": [x, y, 0.01], "normal": [0, 0, 1]} for x in (-0.01, 0.01) for y in (-0.01, 0.01)]
    points = {"method": "points", "points": probes, "radius": 0.005}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"only": dict.fromkeys(links, points)}}},
        "objects": {"cube": {"body": "cube", **(target or {})}},
        "sensors": {"touch": {"kind": "kinematic_taxel", "links": list(links), "feels": ["cube"], **sensor}},
        **({"observations": observations} if observations else {}),
    }
    return tgdsl.compile(document)


def wanting_contacts(folder, slots=4) -> tuple[TactileModule, mujoco.MjModel]:
    """Return a module as if its sensors read every contact field too, and a model with the sensors for it."""
    touch = module(folder)
    inputs = dataclasses.replace(touch.inputs, fields=tuple(dict.fromkeys((*touch.inputs.fields, *CONTACTS))), slots=slots)
    spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    return TactileModule(dataclasses.replace(touch.plan, inputs=inputs)), tgdsl.instrument(spec, inputs).compile()


def warp(touch, num_envs, **keys) -> WarpSimulation:
    return WarpSimulation(touch, num_envs, device="cpu", **keys)


def hand_over(sim: WarpSimulation, cpu: BatchSimulation) -> None:
    """Give the CPU's simulation the float32 state of the other."""
    for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
        getattr(cpu.batch, name)[...] = sim.arrays[name].numpy()


def in_order(state, name: str) -> np.ndarray:
    """Return a field in float64; slots, whose order is free, by position along a slanted line."""
    value = getattr(state, name).double()
    if value.ndim == 4:
        order = (state.contact_pos.double() @ torch.tensor([1.0, 0.3, 0.1], dtype=torch.float64)).argsort(dim=-1)
        value = torch.gather(value, 2, order[..., None].expand_as(value))
    return value.numpy()


def assert_agree(state, other, fields, force_tolerance=TOLERANCE) -> None:
    for name in fields:
        found, expected = in_order(state, name), in_order(other, name)
        scale = np.abs(expected).max()
        tolerance = force_tolerance if name in FORCES else TOLERANCE
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * scale, err_msg=name)


def pushed(sim: WarpSimulation, seed: int) -> None:
    rng = np.random.default_rng(seed)
    speeds = rng.normal(size=sim.arrays["qvel"].shape) * [0.2, 0.2, 0.1, 1, 1, 1, 3, 3]
    sim.arrays["qvel"].copy_(torch.from_numpy(speeds))
