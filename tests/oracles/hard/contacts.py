"""Hard cases of contacts, memory and time: thousands of contacts, steps from 1 µs to 10 s, noise, resets, bytes."""

import dataclasses
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from oracles.filters import BRANCH, STRENGTH, TAU
from oracles.forces import made_up
from oracles.hard import case
from oracles.hard.case import Errors
from oracles.hard.probes import repeated
from oracles.hard.scene import pair_of, quiet, worst_of
from oracles.setups.scenes import BALL, compiled, document, folder, pad, points, probed, state, temporary
from oracles.setups.signals import Noise, one
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

STEPS = (1e-6, 1e-4, 1e-2, 1.0, 10.0)
"""Seconds between calls."""
hard = partial(case.hard, "contacts, time and memory")


def _total(touch: TactileModule, pos: np.ndarray, force: np.ndarray, net: np.ndarray | None = None) -> np.ndarray:
    """Return the sum (3,) [N] of taxels and `missed` for contacts (contact, 3)."""
    with quiet():
        readings = touch(made_up(touch, pos, force, net=net))
    return (readings["s"][0].double().sum(dim=0) + readings["s/missed"][0, 0].double()).numpy()


@hard(
    "{num:,} contacts on one pad", "indices overflow; force is lost in sums", "the sum of the contacts", "N", ("x", "y", "z"),
    float64=1e-12, float32=1e-5, defects=(1,),
)  # fmt: skip
def thousands_of_contacts(dtype: torch.dtype, num: int = 2000):
    rng = np.random.default_rng(0)
    pos = np.column_stack([rng.uniform(-0.03, 0.03, (num, 2)), np.full(num, 0.01)])
    force = np.column_stack([0.3 * rng.normal(size=(num, 2)), -rng.uniform(0.1, 1, num)]) / num
    return np.abs(_total(temporary(pad, slots=num, dtype=dtype), pos, force) - force.sum(axis=0))


@hard(
    "more contacts than slots", "what no slot shows is lost", "the net force", "of the load", [f"draw {i}" for i in range(20)],
    float64=1e-14, float32=1e-6,
)  # fmt: skip
def beyond_the_slots(dtype: torch.dtype):
    rng, errors = np.random.default_rng(0), []
    touch = temporary(pad, dtype=dtype, slots=3)
    draws = [(rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)) for _ in range(40)]
    for place, force, hidden in draws[:20] if dtype == torch.float64 else draws[20:]:
        net = force.sum(axis=0) + hidden
        total = _total(touch, place * [0.03, 0.03, 0.005] + [0, 0, 0.01], force, net)
        errors.append(np.abs(total - net).max() / max(1.0, np.abs(force).sum()))
    return errors


@hard(
    "calls from 1 µs to 10 s apart: {kind}", "memory that depends on the step, or overflows", "the kind's float64 definition",
    "of full scale", {f"{dt:g} s": dt for dt in STEPS}, each=["temperature_grid"],
)  # fmt: skip
def memory_over_steps(dtype: torch.dtype, dt: float, kind: str):
    most, pair, worst = 1e-9 if dtype == torch.float64 else 1e-5, pair_of(kind, dtype), 0.0
    for call in range(3):
        scene = dataclasses.replace(pair.module.example_state(2, seed=call), dt=dt)
        worst = max(worst, worst_of(pair, scene, enough=most))
    return Errors(worst, most)


@hard(
    "calls from 1 µs to 10 s apart: hysteresis", "1 − e^(−Δt/τ) loses its digits, or the branch depends on the step",
    "the Maxwell branch's closed form", "of full scale", {f"{dt:g} s": dt for dt in STEPS}, float64=1e-11, float32=1e-4,
    defects=(21,),
)  # fmt: skip
def hysteresis_over_steps(dtype: torch.dtype, dt: float):
    t, speed = dt * np.arange(100), 3.0 / dt
    exact = speed * t + STRENGTH * speed * TAU * (1 - np.exp(-t / TAU))
    return np.abs(one(Noise(BRANCH, dtype=dtype), (speed * t).tolist(), dt)[:, 0] - exact).max() / np.abs(exact).max()


@hard(
    "calls from 0.1 ms to 10 s apart: delay", "a delay counted in calls", "x(t − Δ)", "of the time",
    {f"{dt:g} s": dt for dt in (1e-4, *STEPS[2:])}, float64=1e-14, float32=1e-6, defects=(19,),
)  # fmt: skip
def delay_over_steps(dtype: torch.dtype, dt: float, late: float = 5.3e-3):
    clock = dt * np.arange(60)
    readings = one(Noise({"read_delay": late}, dt=dt, dtype=dtype), clock.tolist(), dt)[:, 0]
    return np.abs(readings - np.maximum(clock - late, 0)).max() / clock.max()


NOISY: dict[str, Any] = {
    "white_noise": 1e-4, "bias": [-1e-4, 1e-4], "drift": 1e-5, "gain": [0.9, 1.1], "read_delay": "5 ms", "jitter": "2 ms",
    "hysteresis": {"strength": 0.3, "time_constant": 0.05}, "dead_probability": 0.05,
}  # fmt: skip


@hard(
    "not-a-number in what noise remembers", "it stays after the reset, or reaches others", "the same unbroken", "m",
    ("others", "itself after its reset"), defects=(16,),
)  # fmt: skip
def broken_reading_in_memory(dtype: torch.dtype):
    whole, broken = (probed([(0, 0, 0.02)], BALL, kind="contact_depth", dtype=dtype, noise=NOISY) for _ in range(2))
    apart, is_fresh = 0.0, True
    for call in range(6):
        scenes = [_of_envs(touch, 3, 0.025 - 1e-3 * call) for touch in (whole, broken)]
        if call == 2:
            scenes[1].body_pos[1] = torch.nan
        if call == 3:
            whole.reset([1])
            broken.reset([1])
        with quiet():
            expected, reading = (touch(scene)["s"] for touch, scene in zip((whole, broken), scenes, strict=True))
        apart = max(apart, float((reading[[0, 2]] - expected[[0, 2]]).abs().max()))
        is_fresh = is_fresh and (call < 3 or bool((reading[1] == expected[1]).all()))
    return [apart, 0.0 if is_fresh else np.inf]


def _of_envs(touch: TactileModule, num: int, height: float) -> SceneState:
    """Return the probes' object at a height in several environments."""
    return dataclasses.replace(repeated(state(touch, pos=[0, 0, height]), num), dt=0.01)


@hard(
    "the first reading of filters", "it starts from zero", "the reading without filters", "m", ("first", "after a reset"),
    defects=(14,),
)  # fmt: skip
def first_reading(dtype: torch.dtype):
    late = {"read_delay": "50 ms", "hysteresis": {"strength": 0.5, "time_constant": 0.1}}
    touch, plain = (probed([(0, 0, 0.02)], BALL, kind="contact_depth", dtype=dtype, **noise) for noise in ({"noise": late}, {}))
    errors = []
    for height in (0.012, 0.016):
        reading = touch(_of_envs(touch, 2, height))["s"]
        errors.append(float((reading - plain(_of_envs(plain, 2, height))["s"]).abs().max()))
        for other in (0.011, 0.013):
            touch(_of_envs(touch, 2, other))
        touch.reset()
    return errors


SENSORS: dict[str, tuple[dict[str, Any], int]] = {
    "no noise": ({}, 0),
    "white noise, gain, dead taxels": ({"noise": {"white_noise": 1e-3, "gain": [0.9, 1.1], "dead_probability": 0.1}}, 0),
    "drift": ({"noise": {"drift": 1e-3}}, 3 * 4),
    "history of 4": ({"history": 4}, 4 * 3 * 4),
}
"""Fields of a sensor, and the bytes per taxel of its state."""


@hard(
    "state of terms that are off", "memory that is never used", "counted by hand", "bytes per taxel", SENSORS, float64=None,
    defects=(17, 18),
)  # fmt: skip
def bytes_of_state(dtype: torch.dtype, part: tuple[dict[str, Any], int]):
    sensor, needed = part
    probes = [(0.001 * i, 0.0, 0.02) for i in range(10)]
    touch = probed(probes, BALL, kind="kinematic_taxel", outputs=["force"], dtype=dtype, **sensor)
    touch(_of_envs(touch, 2, 0.025))
    per_row = [b for n, b in touch.memory.named_buffers() if b.is_floating_point() and b.ndim > 2]
    return sum(b[0].numel() * b.element_size() for b in per_row) / len(probes) - needed


TACTILE = """
<mujoco>
  <asset><mesh name="patch" builtin="sphere" params="3" scale=".03 .025 .02"/></asset>
  <worldbody>
    <body name="pad" euler="20 -10 35" pos=".01 .02 .03">
      <geom name="pad" type="mesh" mesh="patch" pos=".004 -.003 .002" euler="10 0 0"/>
    </body>
    <body name="item"><freejoint/><geom name="item" type="{shape}" size="{size}" pos=".003 .001 0" euler="0 15 0"/></body>
  </worldbody>
  <sensor><tactile geom="pad" mesh="patch"/></sensor>
</mujoco>
"""
TACTILE_TOLERANCE = 1e-6
"""Tolerance [m]: MuJoCo keeps mesh vertices in float32, 1e-9 m, and its distances of these shapes are exact."""
TACTILE_SHAPES = {"sphere": ".02", "capsule": ".012 .02", "cylinder": ".015 .02"}


def tactile_depth(shape: str) -> tuple[float, int]:
    """Return the errors of depths against MuJoCo's `tactile` sensor at its vertices [m], and how many it touches.

    Pad and geoms are rotated and off their bodies' centres of mass.
    """
    text = TACTILE.format(shape=shape, size=TACTILE_SHAPES[shape])
    model = mujoco.MjModel.from_xml_string(text)
    data, geom = mujoco.MjData(model), model.geom("pad")
    vertices = Rotation.from_quat(geom.quat, scalar_first=True).apply(model.mesh_vert) + geom.pos
    with folder() as where:
        (where / "scene.xml").write_text(text, encoding="utf-8")
        sensor = {"kind": "surface_distance", "links": "pad", "feels": ["item"]}
        touch = compiled(document(where / "scene.xml", "item", sensor, points(vertices, 1e-3)))
    rng, worst, num_touched = np.random.default_rng(0), 0.0, 0
    for _ in range(20):
        data.qpos[:3] = np.array([0.01, 0.02, 0.03]) + 0.03 * rng.uniform(-1, 1, 3)
        data.qpos[3:] = rng.normal(size=4)
        mujoco.mj_forward(model, data)
        bodies = [model.body(name).id for name in touch.inputs.bodies]
        pos, quat = (torch.from_numpy(part[bodies][None]) for part in (data.xpos, data.xquat))
        depth = np.maximum(-touch(SceneState(body_pos=pos, body_quat=quat))["s"][0, :, 0].numpy(), 0)
        theirs = data.sensordata.reshape(3, -1)[0]
        if data.ncon:
            worst = max(worst, float(np.abs(depth - theirs).max()))
            num_touched += int((theirs > 0).sum())
    return worst, num_touched


@hard(
    "a turned pad off its centre of mass", "a wrong frame of the taxels", "MuJoCo's tactile sensor", "m",
    dict(zip(TACTILE_SHAPES, TACTILE_SHAPES, strict=True)), float64=TACTILE_TOLERANCE, float32=None, defects=(22,),
)  # fmt: skip
def tactile_frames(dtype: torch.dtype, shape: str):
    worst, num_touched = tactile_depth(shape)
    return worst if num_touched > 500 else np.nan
