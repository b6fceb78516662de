"""What is hard for contacts, memory and time: thousands of contacts, steps from 1 µs to 10 s, noise, resets, bytes."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from oracles.filters import STRENGTH, TAU
from oracles.forces import made_up
from oracles.hard.results import Allowed, Case, HardCase
from oracles.hard.scene import DTYPES, pair_of, quiet, worst_of
from oracles.setups.scenes import compiled, folder, pad, points, probed, state
from oracles.setups.signals import Noise, one
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

STEPS = (1e-6, 1e-4, 1e-2, 1.0, 10.0)
"""Seconds between calls."""


def thousands_of_contacts(num: int = 2000) -> HardCase:
    """Return how much force is lost of thousands of contacts on a pad: taxels and what is missed sum to the load."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        with folder() as where:
            touch = pad(where, slots=num, dtype=dtype)
        rng = np.random.default_rng(0)
        pos = np.column_stack([rng.uniform(-0.03, 0.03, (num, 2)), np.full(num, 0.01)])
        force = np.column_stack([0.3 * rng.normal(size=(num, 2)), -rng.uniform(0.1, 1, num)]) / num
        with quiet():
            readings = touch(made_up(touch, pos, force))
        total = readings["s"][0].double().sum(dim=0) + readings["s/missed"][0, 0].double()
        errors[precision] = Allowed(np.abs(total.numpy() - force.sum(axis=0)), 1e-12 if precision == "float64" else 1e-5)
    return HardCase(
        f"{num:,} contacts on one pad", "indices overflow; force is lost in sums", "the sum of the contacts", "N",
        ("x", "y", "z"), errors, defects=(1,),
    )  # fmt: skip


def beyond_the_slots() -> HardCase:
    """Return how much force is lost of contacts that are more than the slots, anywhere around the pad."""
    rng, errors = np.random.default_rng(0), dict[str, Allowed]()
    for precision, dtype in DTYPES.items():
        found = []
        with folder() as where:
            touch = pad(where, dtype=dtype, slots=3)
        for _ in range(20):
            pos, force = rng.normal(size=(3, 3)) * [0.03, 0.03, 0.005] + [0, 0, 0.01], rng.normal(size=(3, 3))
            net = force.sum(axis=0) + rng.normal(size=3)
            with quiet():
                readings = touch(made_up(touch, pos, force, net=net))
            total = readings["s"][0].double().sum(dim=0) + readings["s/missed"][0, 0].double()
            found.append(np.abs(total.numpy() - net).max() / max(1.0, np.abs(force).sum()))
        errors[precision] = Allowed(np.array(found), 1e-14 if precision == "float64" else 1e-6)
    return HardCase(
        "more contacts than slots", "what no slot shows is lost", "the net force", "of the load",
        tuple(f"draw {i}" for i in range(20)), errors,
    )  # fmt: skip


def memory_over_steps(kind: str) -> HardCase:
    """Return how far a kind with memory is from its definition over calls that are 1 µs to 10 s apart."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        most, found = 1e-9 if precision == "float64" else 1e-5, []
        for dt in STEPS:
            pair, worst = pair_of(kind, dtype), 0.0
            for call in range(4):
                given = dataclasses.replace(pair.module.example_state(3, seed=call), dt=dt)
                worst = max(worst, worst_of(pair, given, enough=most))
            found.append(worst)
        errors[precision] = Allowed(np.array(found), most)
    return HardCase(
        f"calls from 1 µs to 10 s apart: {kind}", "memory that depends on the step, or overflows",
        "the kind's float64 definition", "of full scale", tuple(f"{dt:g} s" for dt in STEPS), errors,
    )  # fmt: skip


def hysteresis_over_steps() -> HardCase:
    """Return how far a Maxwell branch on a ramp is off its closed form, over calls that are 1 µs to 10 s apart."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for dt in STEPS:
            t, speed = dt * np.arange(100), 3.0 / dt
            noise = Noise({"hysteresis": {"strength": STRENGTH, "time_constant": TAU}}, dtype=dtype)
            exact = speed * t + STRENGTH * speed * TAU * (1 - np.exp(-t / TAU))
            found.append(np.abs(one(noise, (speed * t).tolist(), dt)[:, 0] - exact).max() / np.abs(exact).max())
        errors[precision] = Allowed(np.array(found), 1e-11 if precision == "float64" else 1e-4)
    return HardCase(
        "calls from 1 µs to 10 s apart: hysteresis", "1 − e^(−Δt/τ) loses its digits, or the branch depends on the step",
        "the Maxwell branch's closed form", "of full scale", tuple(f"{dt:g} s" for dt in STEPS), errors, defects=(21,),
    )  # fmt: skip


def delay_over_steps(late: float = 5.3e-3) -> HardCase:
    """Return how far a clock read late is off, over calls 0.1 ms to 10 s apart, and uneven ones."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for dt in (1e-4, *STEPS[2:]):
            noise, clock = Noise({"read_delay": late}, dt=dt, dtype=dtype), dt * np.arange(60)
            reading = one(noise, clock.tolist(), dt)[:, 0]
            found.append(np.abs(reading - np.maximum(clock - late, 0)).max() / clock.max())
        errors[precision] = Allowed(np.array(found), 1e-14 if precision == "float64" else 1e-6)
    return HardCase(
        "calls from 0.1 ms to 10 s apart: delay", "a delay counted in calls", "x(t − Δ)", "of the time",
        tuple(f"{dt:g} s" for dt in (1e-4, *STEPS[2:])), errors, defects=(19,),
    )  # fmt: skip


NOISY: dict[str, Any] = {
    "white_noise": 1e-4, "bias": [-1e-4, 1e-4], "drift": 1e-5, "gain": [0.9, 1.1], "read_delay": "5 ms", "jitter": "2 ms",
    "hysteresis": {"strength": 0.3, "time_constant": 0.05}, "dead_probability": 0.05,
}  # fmt: skip


def broken_reading_in_memory() -> HardCase:
    """Return how far other environments' noisy readings are off while one is broken, and it after its reset."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        whole, broken = (probed([(0, 0, 0.02)], BALL, kind="contact_depth", dtype=dtype, noise=NOISY) for _ in range(2))
        apart, fresh = 0.0, True
        for call in range(6):
            scenes = [_of_envs(touch, 3, 0.025 - 1e-3 * call) for touch in (whole, broken)]
            assert scenes[1].body_pos is not None
            if call == 2:
                scenes[1].body_pos[1] = torch.nan
            if call == 3:
                whole.reset([1])
                broken.reset([1])
            expected, reading = (touch(scene)["s"] for touch, scene in zip((whole, broken), scenes, strict=True))
            apart = max(apart, float((reading[[0, 2]] - expected[[0, 2]]).abs().max()))
            fresh = fresh and (call < 3 or bool((reading[1] == expected[1]).all()))
        errors[precision] = Allowed(np.array([apart, 0.0 if fresh else np.inf]), 0.0)
    return HardCase(
        "not-a-number in what noise remembers", "it stays after the reset, or reaches others", "the same unbroken", "m",
        ("others", "itself after its reset"), errors, defects=(16,),
    )  # fmt: skip


BALL = '<geom type="sphere" size=".02"/>'


def _of_envs(touch: TactileModule, num: int, height: float) -> SceneState:
    """Return the probes' object at some height in several environments."""
    scene = state(touch, pos=[0, 0, height])
    names = ("body_pos", "body_quat", "body_linvel", "body_angvel", "contact_found")
    values = {n: v.expand(num, *v.shape[1:]).clone() for n in names if (v := getattr(scene, n)) is not None}
    return SceneState(**values, dt=0.01)


def first_reading() -> HardCase:
    """Return how far readings with a delay and hysteresis are off the truth at the first call, and after a reset."""
    late = {"read_delay": "50 ms", "hysteresis": {"strength": 0.5, "time_constant": 0.1}}
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        touch = probed([(0, 0, 0.02)], BALL, kind="contact_depth", dtype=dtype, noise=late)
        plain = probed([(0, 0, 0.02)], BALL, kind="contact_depth", dtype=dtype)
        found = []
        for height in (0.012, 0.016):
            reading = touch(_of_envs(touch, 2, height))["s"]
            found.append(float((reading - plain(_of_envs(plain, 2, height))["s"]).abs().max()))
            for other in (0.011, 0.013):
                touch(_of_envs(touch, 2, other))
            touch.reset()
        errors[precision] = Allowed(np.array(found), 0.0)
    return HardCase(
        "the first reading of filters", "it starts from zero", "the reading without filters", "m",
        ("first", "after a reset"), errors, defects=(14,),
    )  # fmt: skip


def bytes_of_state() -> HardCase:
    """Return the bytes per taxel and environment that sensors carry from call to call, beyond what their terms need.

    A force of three numbers needs none; a delay a ring, a drift one number per channel.
    """
    probes = [(0.001 * i, 0.0, 0.02) for i in range(10)]
    wanted: dict[str, tuple[dict[str, Any], int]] = {
        "no noise": ({}, 0),
        "white noise, gain, dead taxels": ({"noise": {"white_noise": 1e-3, "gain": [0.9, 1.1], "dead_probability": 0.1}}, 0),
        "drift": ({"noise": {"drift": 1e-3}}, 3 * 4),
        "history of 4": ({"history": 4}, 4 * 3 * 4),
    }
    found = []
    for sensor, needed in wanted.values():
        touch = probed(probes, BALL, kind="kinematic_taxel", outputs=["force"], dtype=torch.float32, **sensor)
        touch(_of_envs(touch, 2, 0.025))
        per_row = [b for n, b in touch.memory.named_buffers() if b.is_floating_point() and b.ndim > 2]
        found.append(sum(b[0].numel() * b.element_size() for b in per_row) / len(probes) - needed)
    return HardCase(
        "state of terms that are off", "memory that is never used", "counted by hand", "bytes per taxel", tuple(wanted),
        {"float32": Allowed(np.array(found), 0.0)}, defects=(17, 18),
    )  # fmt: skip


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
"""MuJoCo keeps mesh vertices in float32, 1e-9 m, and its distances of these shapes are exact: both leave room in this [m]."""
TACTILE_SHAPES = {"sphere": ".02", "capsule": ".012 .02", "cylinder": ".015 .02"}


def tactile_depth(shape: str) -> tuple[float, int]:
    """Return how far depths are from those of MuJoCo's own `tactile` sensor at its vertices [m], and how many it touches.

    Pad and geoms are turned and off their bodies' centres of mass.
    """
    text = TACTILE.format(shape=shape, size=TACTILE_SHAPES[shape])
    model = mujoco.MjModel.from_xml_string(text)
    data, geom = mujoco.MjData(model), model.geom("pad")
    vertices = Rotation.from_quat(geom.quat, scalar_first=True).apply(model.mesh_vert) + geom.pos
    with folder() as where:
        (where / "scene.xml").write_text(text, encoding="utf-8")
        layout = {"resolutions": {"r": {"pad": points(vertices, 1e-3)}}}
        touch = compiled(
            {
                "tgdsl": 1,
                "robot": {"model": str(where / "scene.xml"), "layout": layout},
                "objects": {"item": {"body": "item"}},
                "sensors": {"d": {"kind": "surface_distance", "links": "pad", "feels": ["item"]}},
            }
        )
    rng, worst, num_touched = np.random.default_rng(0), 0.0, 0
    for _ in range(20):
        data.qpos[:3] = np.array([0.01, 0.02, 0.03]) + 0.03 * rng.uniform(-1, 1, 3)
        data.qpos[3:] = rng.normal(size=4)
        mujoco.mj_forward(model, data)
        bodies = [model.body(name).id for name in touch.inputs.bodies]
        pos, quat = (torch.from_numpy(part[bodies][None]) for part in (data.xpos, data.xquat))
        depth = np.maximum(-touch(SceneState(body_pos=pos, body_quat=quat))["d"][0, :, 0].numpy(), 0)
        theirs = data.sensordata.reshape(3, -1)[0]
        if data.ncon:
            worst = max(worst, float(np.abs(depth - theirs).max()))
            num_touched += int((theirs > 0).sum())
    return worst, num_touched


def tactile_frames() -> HardCase:
    """Return how far depths on a turned pad are from MuJoCo's own tactile sensor, for three shapes."""
    found = [worst if num > 500 else np.nan for worst, num in map(tactile_depth, TACTILE_SHAPES)]
    return HardCase(
        "a turned pad off its centre of mass", "a wrong frame of the taxels", "MuJoCo's tactile sensor", "m",
        tuple(TACTILE_SHAPES), {"float64": Allowed(np.array(found), TACTILE_TOLERANCE)}, defects=(22,),
    )  # fmt: skip


CASES: tuple[Case, ...] = (
    thousands_of_contacts,
    beyond_the_slots,
    partial(memory_over_steps, "temperature_grid"),
    hysteresis_over_steps,
    delay_over_steps,
    broken_reading_in_memory,
    first_reading,
    bytes_of_state,
    tactile_frames,
)
