"""A scene in which a hand that nobody has described closes on a ball: how its actuators close it, and where the ball fits.

Everything is found by simulating the hand alone, without gravity: an actuator closes toward the end of its range that brings
the fingertips together. A robot without actuators gets position servos on its joints that have a range.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.formats.mjcf import mjcf_of
from tgdsl.formats.robot import load_model
from tgdsl.layout.layout import Layout

SETTLE = 0.4
"""How long an actuator is held to see what it moves [s]."""
OPEN, CLOSE = 0.3, 0.7
"""How long the hand opens, and how long it then closes [s]."""
LEAST_GAIN = 0.02
"""Least share by which the fingertips must draw nearer for an end of a range to be the closed one."""
LARGEST, SMALLEST = 0.04, 0.004
"""Radii that are tried for the ball, from the largest [m]."""
TORQUE = 0.02
"""Moment of a servo at half of its joint's range, per kilogram of what the joint carries, about 5 cm away [N·m or N]."""
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))

Tips = Mapping[int, Float[np.ndarray, " 3"]]
"""The middle of each fingertip's taxels in its body's frame, by the body's index [m]."""


@dataclass(frozen=True, eq=False)
class Grasp:
    """How a hand closes on a ball.

    Attributes:
        model: The hand, as its scene has it.
        control: What its actuators are told, step by step: it opens, closes, and stays closed.
        centre: Where the ball is [m].
        radius: The ball's [m].
    """

    model: mujoco.MjModel
    control: Float[np.ndarray, "step actuator"]
    centre: Float[np.ndarray, " 3"]
    radius: float


def with_servos(robot: Path, out: Path) -> Path | None:
    """Write a robot that has no actuators as MJCF with a position servo on each joint; None if it has its own.

    Joints without a range, and those that follow another, get none.

    Args:
        robot: The robot's file.
        out: The file to write.
    """
    model = load_model(robot)
    if model.compiled.nu:
        return None
    compiled, spec = model.compiled, model.spec
    followers = set(compiled.eq_obj1id[compiled.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)].tolist())
    for i in range(compiled.njnt):
        if int(compiled.jnt_type[i]) not in _SCALAR or not compiled.jnt_limited[i] or i in followers:
            continue
        low, high = compiled.jnt_range[i].tolist()
        mass = float(compiled.body_subtreemass[compiled.jnt_bodyid[i]])
        gain = max(TORQUE, 5.0 * mass) / (0.5 * (high - low))
        servo = spec.add_actuator(name=f"servo_{i}", target=compiled.joint(i).name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=gain)
        servo.ctrlrange, servo.ctrllimited = [low, high], True
        joint = spec.joint(compiled.joint(i).name)
        joint.damping = np.maximum(joint.damping, 0.1 * gain)
        joint.armature = max(joint.armature, 1e-4)
    spec.compile()
    _with_files(spec, out)
    return out


def _with_files(spec: mujoco.MjSpec, out: Path) -> None:
    """Write a spec, its meshes named by where they are; those that it has in memory are written beside it."""
    folder = Path(spec.modelfiledir, spec.meshdir)
    for mesh in spec.meshes:
        if mesh.file in spec.assets:
            out.with_name(mesh.file).write_bytes(spec.assets[mesh.file])
        if mesh.file:
            mesh.file = str(out.with_name(mesh.file) if mesh.file in spec.assets else (folder / mesh.file).resolve())
    spec.meshdir = ""
    out.write_text(mjcf_of(spec))


def fingertips(model: mujoco.MjModel, layout: Layout) -> dict[int, Float[np.ndarray, " 3"]]:
    """Return the middle of each fingertip's taxels; where there is only one tip, of all links of the hand."""
    names = set(layout.groups.get("tips", ()))
    if len(names) < 2:
        names = set(layout.groups.get("hand", ()))
    found = {}
    for i, link in enumerate(layout.links):
        if link.name in names and (layout.link_id == i).any():
            found[int(model.body(link.body).id)] = layout.pos[layout.link_id == i].mean(axis=0)
    return found


def grasp(scene: Path, layout: Layout) -> Grasp:
    """Return how the hand of a scene closes on a ball.

    Args:
        scene: The hand with actuators.
        layout: Its proposed layout, which says which links are fingertips.
    """
    model = load_model(scene).compiled
    weightless = load_model(scene).compiled
    weightless.opt.gravity[:] = 0.0
    tips = fingertips(model, layout)
    opened, closed = _ends(weightless, tips)
    steps = [max(1, round(seconds / model.opt.timestep)) for seconds in (OPEN, CLOSE)]
    ramp = np.linspace(0.0, 1.0, steps[1])[:, None]
    control = np.concatenate(
        [np.tile(opened, (steps[0], 1)), opened + ramp * (closed - opened), np.tile(closed, (steps[1] // 2, 1))]
    )
    poses = _rollout(weightless, control)
    centre, radius = _ball(weightless, tips, poses, steps[0])
    return Grasp(model, control, centre, radius)


def _ends(model: mujoco.MjModel, tips: Tips) -> tuple[np.ndarray, np.ndarray]:
    """Return the controls of the open and of the closed hand; actuators that do neither stay as they start."""
    start = np.clip(np.zeros(model.nu), *_ranges(model).T)
    opened, closed = start.copy(), start.copy()
    steps = max(1, round(SETTLE / model.opt.timestep))
    for i, (low, high) in enumerate(_ranges(model)):
        spans = []
        for end in (low, high):
            held = start.copy()
            held[i] = end
            spans.append(_span(model, tips, _rollout(model, np.tile(held, (steps, 1)))[-1]))
        gain = (spans[0] - spans[1]) / max(*spans, 1e-9)
        if abs(gain) > LEAST_GAIN:
            opened[i], closed[i] = (low, high) if gain > 0 else (high, low)
    return opened, closed


def _ranges(model: mujoco.MjModel) -> Float[np.ndarray, "actuator 2"]:
    """Return the range of each actuator's control; of one without, that of its joint."""
    ranges = model.actuator_ctrlrange.copy()
    for i in np.flatnonzero(model.actuator_ctrllimited == 0):
        joint = int(model.actuator_trnid[i, 0])
        is_joint = int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_JOINT)
        ranges[i] = model.jnt_range[joint] if is_joint and model.jnt_limited[joint] else (-1.0, 1.0)
    return ranges


def _rollout(model: mujoco.MjModel, control: Float[np.ndarray, "step actuator"]) -> list[np.ndarray]:
    """Return the joint positions after each step."""
    state, poses = mujoco.MjData(model), []
    for row in control:
        state.ctrl[:] = row
        mujoco.mj_step(model, state)
        poses.append(state.qpos.copy())
    return poses


def _centres(model: mujoco.MjModel, state: mujoco.MjData, tips: Tips) -> Float[np.ndarray, "tip 3"]:
    return np.array([state.xpos[body] + state.xmat[body].reshape(3, 3) @ middle for body, middle in tips.items()])


def _posed(model: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    state = mujoco.MjData(model)
    state.qpos[:] = qpos
    mujoco.mj_kinematics(model, state)
    return state


def _span(model: mujoco.MjModel, tips: Tips, qpos: np.ndarray) -> float:
    """Return the mean distance between fingertips [m]."""
    centres = _centres(model, _posed(model, qpos), tips)
    return float(np.mean([np.linalg.norm(a - b) for a, b in itertools.combinations(centres, 2)]))


def _ball(model: mujoco.MjModel, tips: Tips, poses: list[np.ndarray], opened: int) -> tuple[np.ndarray, float]:
    """Return where the fingertips meet, and the largest ball there that the hand does not touch while it opens.

    The place is the tips' mean half way between the open and the closed hand, or later where there is no room for a ball.
    """
    path = poses[opened - 1 :]
    for share in (0.5, 0.65, 0.8, 1.0):
        centre = _centres(model, _posed(model, path[round(share * (len(path) - 1))]), tips).mean(axis=0)
        room = min(_room(model, centre, qpos) for qpos in (poses[0], poses[opened // 2], poses[opened - 1]))
        if (radius := min(LARGEST, 0.8 * room)) >= SMALLEST:
            return centre, radius
    return centre, SMALLEST


def _room(model: mujoco.MjModel, centre: np.ndarray, qpos: np.ndarray) -> float:
    """Return the distance from a point to the colliding geoms of a pose [m]."""
    state = _posed(model, qpos)
    found = []
    for direction in _directions(64):
        geom = np.zeros(1, dtype=np.int32)
        distance = mujoco.mj_ray(model, state, centre, direction, None, 1, -1, geom)
        if distance >= 0:
            found.append(distance)
    return min(found, default=LARGEST)


def _directions(count: int) -> Float[np.ndarray, "ray 3"]:
    """Return directions that are spread evenly over the sphere (a Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    height, angle = 1.0 - 2.0 * i / count, np.pi * (1.0 + 5.0**0.5) * i
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
