"""Sources of sound: a plate that a ball presses, rubs or falls on, and a motor's joint.

Shapes: `step` physics steps, `env` environments, `sample` samples of all steps.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from oracles.setups.scenes import document
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.tuning.compile import compile

STEP = 0.001
"""A physics step [s]."""
PLATE = """
<mujoco>
  <option timestep="0.001" cone="elliptic"/>
  <worldbody>
    <body name="plate"><geom name="plate" type="box" size=".1 .1 .005"/></body>
    <body name="other" pos="1 0 0"><geom type="box" size=".1 .1 .005"/></body>
    <body name="ball" pos="0 0 .03"><freejoint/><geom type="sphere" size=".01" mass=".05"/></body>
  </worldbody>
</mujoco>
"""
MODES: list[dict[str, float]] = [
    {"frequency": 523.0, "decay": 6.0, "gain": 2.0},
    {"frequency": 1171.0, "decay": 20.0, "gain": -1.0},
    {"frequency": 2903.0, "decay": 55.0, "gain": 0.7},
]
"""Default modes of the plate."""
MOTOR = """
<mujoco>
  <option timestep="0.001"/>
  <worldbody>
    <body name="arm" pos="0 0 .1"><joint name="elbow" axis="0 1 0" pos=".01 0 .02"/><geom size=".01" mass=".5"/></body>
  </worldbody>
  <actuator><motor name="motor" joint="elbow"/></actuator>
</mujoco>
"""


def plate_document(folder: Path, **sensor: Any) -> dict[str, Any]:
    """Return a document of a plate that feels a ball; its scene is written to a folder."""
    (folder / "plate.xml").write_text(PLATE, encoding="utf-8")
    fields = {"kind": "contact_audio", "links": "plate", "feels": ["ball"], "modes": MODES}
    return document(folder / "plate.xml", "ball", {**fields, **sensor})


def plate(folder: Path, dtype: torch.dtype = torch.float64, **sensor: Any) -> TactileModule:
    """Return a compiled plate."""
    return compile(plate_document(folder, **sensor), dtype=dtype)


def pressed(
    touch: TactileModule, force: Sequence[float | int], speed: Sequence[float | int] | float | int = 0.0, step: float = STEP
) -> SceneState:
    """Return the state of a ball in each environment that presses with a normal force [N], sliding at a speed [m/s].

    The contact is tilted, and the plate moves and turns, so only relative motion counts.
    """
    forces, speeds = torch.as_tensor(force, dtype=torch.float64), torch.as_tensor(speed, dtype=torch.float64)
    state = touch.example_state(len(forces))
    for name in ("contact_force", "contact_normal", "contact_netforce", "body_angvel"):
        getattr(state, name).zero_()
    normal, along = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64), torch.tensor([0.8, 0.0, 0.6], dtype=torch.float64)
    pair = [pair.link for pair in touch.inputs.pairs].index("plate")
    state.contact_normal[:, pair, 0] = normal
    state.contact_force[:, pair, 0] = forces[:, None] * (normal + 0.3 * along)
    state.contact_netforce[:, pair] = state.contact_force[:, pair, 0]
    ball, link = (touch.inputs.bodies.index(name) for name in ("ball", "plate"))
    state.body_linvel[:, ball] = state.body_linvel[:, link] + speeds[..., None] * along + 0.4 * normal
    state.dt = step
    return state


def sound(touch: TactileModule, forces: Any, speeds: Any = 0.0, step: float = STEP) -> Float[np.ndarray, "env sample"]:
    """Return the sound [m/s] of successive normal forces (step, env) [N] and sliding speeds [m/s]."""
    forces = np.atleast_2d(np.asarray(forces, dtype=np.float64).T).T
    speeds = np.broadcast_to(np.asarray(speeds, dtype=np.float64), forces.shape)
    heard = [touch(pressed(touch, f.tolist(), v.tolist(), step))["s"][:, :, 0, 0] for f, v in zip(forces, speeds, strict=True)]
    return torch.cat(heard, dim=1).double().numpy()


def ringing(impulse: float, time: np.ndarray, modes: Sequence[Mapping[str, float]] = MODES) -> np.ndarray:
    """Return J Σ g e^(−dt) sin(2πft) [m/s], 0 before the impulse."""
    after = np.maximum(time, 0.0)
    each = [m["gain"] * np.exp(-m["decay"] * after) * np.sin(2 * math.pi * m["frequency"] * after) for m in modes]
    return impulse * np.sum(each, axis=0) * (time >= 0)


def amplitudes(
    touch: TactileModule, forces: Sequence[float | int] | np.ndarray, step: float = STEP
) -> Float[np.ndarray, "step mode"]:
    """Return the amplitude of the plate's modes, |z| [N·s], after each step of forces [N]."""
    rows = []
    for force in forces:
        touch(pressed(touch, [float(force)], step=step))
        rows.append(touch.memory.get_buffer("s:phasors").double().view(2, -1).norm(dim=0).numpy())
    return np.array(rows)


def energy(touch: TactileModule) -> float:
    """Return Σ |z|² of all modes now [N²·s²]."""
    return float((touch.memory.get_buffer("s:phasors").double() ** 2).sum())


def half_sine(duration: float, step: float, impulse: float = 0.02, rest: float = 0.06) -> list[float]:
    """Return a half-sine of force of an impulse [N·s], averaged over each step, silence before and after [N]."""
    edges = np.arange(0, duration + rest, step)
    passed = impulse * 0.5 * (1 - np.cos(math.pi * np.clip(edges / duration, 0, 1)))
    return [0.0, *(np.diff(passed) / step).tolist()]


def struck(
    touch: TactileModule, forces: Sequence[float | int] | np.ndarray, decay: float, step: float = STEP
) -> tuple[float, int]:
    """Return the amplitude of the only mode at the time of the last strike, if it were alone, |z| e^(d Δt) [N·s]; its step."""
    amplitude = amplitudes(touch, forces, step)[:, 0]
    last = int(np.argmax(np.diff([0.0, *amplitude]) > 0))
    return float(amplitude[last] * math.exp(decay * step)), last


def motor(folder: Path, dtype: torch.dtype | str = torch.float64, **fields: Any) -> TactileModule:
    """Return a module that hears a joint, `elbow`, in `motors`: only parts of its sound with given levels."""
    (folder / "motor.xml").write_text(MOTOR, encoding="utf-8")
    parts = {"load": 0.0, "power": 0.0, "friction": 0.0, "hum": 0.0}
    sensor = {"kind": "actuation_audio", "joints": ["elbow"], "samples": 20, **parts, **fields}
    document = {"tgdsl": 1, "robot": {"model": str(folder / "motor.xml")}, "sensors": {"motors": sensor}}
    return compile(document, dtype=dtype)


def driven(
    touch: TactileModule, velocities: Sequence[float | int] | np.ndarray, efforts: Any, num_envs: int = 1
) -> Float[np.ndarray, "env sample"]:
    """Return all samples [Pa] of a joint with these velocities [rad/s] and efforts [N·m] per step."""
    state, blocks = touch.example_state(num_envs), []
    one = torch.ones_like(state.joint_vel)
    for velocity, effort in zip(velocities, np.broadcast_to(efforts, len(velocities)), strict=True):
        state = replace(state, joint_vel=float(velocity) * one, joint_effort=float(effort) * one, dt=STEP)
        blocks.append(touch(state)["motors"][:, :, 0, 0])
    return torch.cat(blocks, dim=1).double().numpy()


MASS, GRAVITY = 0.05, 9.81
"""Mass of the ball and gravity [kg, m/s²]."""
DROPS = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <body name="plate"><geom type="box" size=".1 .1 .005" solref="{stiffness}"/></body>
    <body name="ball" pos="0 0 .0160"><freejoint/><geom type="sphere" size=".01" mass="0.05" solref="{stiffness}"/></body>
  </worldbody>
</mujoco>
"""
HEIGHTS = np.array([0.005, 0.01, 0.02, 0.04, 0.08, 0.16])
"""Heights of the ball's lowest point above the plate [m]."""


def dropped(
    folder: Path, simulator: Callable[..., Any] = BatchSimulation, heights: np.ndarray = HEIGHTS, step: float = 0.001,
    stiffness: str = "-1e6 -4", substeps: int = 1, **sensor: Any,
) -> tuple[Any, TactileModule]:  # fmt: skip
    """Return a simulation of balls that fall from heights [m], and its module."""
    (folder / "drops.xml").write_text(DROPS.format(step=step, stiffness=stiffness), encoding="utf-8")
    fields = {"kind": "contact_audio", "links": "plate", "feels": ["ball"], "modes": MODES, "scrape": 0}
    sensor = {**fields, "samples": 8, "substeps": substeps, **sensor}
    touch = compile(document(folder / "drops.xml", "ball", sensor))
    sim = simulator(touch, len(heights), substeps=substeps)
    place = sim.qpos.clone()
    place[:, sim.joints["ball"].qpos.start + 2] = torch.as_tensor(0.015 + heights, dtype=place.dtype)
    sim.reset(qpos=place)
    return sim, touch


def loudest(sim: Any, touch: TactileModule, seconds: float) -> tuple[Float[np.ndarray, " env"], Float[np.ndarray, " env"]]:
    """Return each environment's amplitude of the first mode after its first collision, and that collision's impulse [N·s]."""
    largest, impulse = np.zeros((2, sim.num_envs))
    is_over, is_next = np.zeros((2, sim.num_envs), dtype=bool)
    for _ in range(round(seconds / sim.model.opt.timestep)):
        sim.step()
        state = sim.state()
        touch(state)
        force = state.contact_netforce[:, 0].norm(dim=-1).double().numpy()
        is_next |= is_over & (force > 0)
        is_over |= (impulse > 0) & (force == 0)
        impulse += np.where(is_over, 0.0, force * sim.model.opt.timestep)
        phasors = touch.memory.get_buffer("s:phasors")[:, 0].double().numpy()
        largest = np.where(is_next, largest, np.maximum(largest, np.hypot(phasors[:, 0], phasors[:, len(MODES)])))
    return largest, impulse
