"""The physics under other options: errors of joints and objects against a fine run, and the time of a step.

Shapes: `step` control steps, `env` environments, `actuator` actuators, `coordinate` joint angles and positions.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any, NamedTuple

import mujoco
import numpy as np

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import SimulationError
from tgdsl.module.accuracy.errors import errors_of, halves, magnitude_of
from tgdsl.module.module import TactileModule
from tgdsl.plan.plan import Plan
from tgdsl.report.bench.results import Measured, Subject, median_of, with_front
from tgdsl.runtime.rollout import Script
from tgdsl.scene.scene import scene_model
from tgdsl.sensors.known import known_kinds
from tgdsl.tuning.recording import control_ranges, varied
from tgdsl.tuning.trials import Cost

FINE = 4  # the document's time step over the fine run's
ITERATIONS, TOLERANCE = 400, 1e-12  # of the solver in the fine run


class Setting(NamedTuple):
    """MuJoCo's options, and physics steps per control step."""

    label: str
    options: dict[str, Any]
    substeps: int
    is_own: bool = False


def settings(model: mujoco.MjModel, substeps: int) -> list[Setting]:
    """Return options that trade speed for error; all control steps are as long as `substeps` steps of the model."""
    step, cones = model.opt.timestep, ("pyramidal", "elliptic")
    tried = [Setting(f"as written: {cones[model.opt.cone]} cone, time step {1e3 * step:g} ms", {}, substeps, True)]
    tried.append(Setting(f"{cones[1 - model.opt.cone]} cone", {"cone": cones[1 - model.opt.cone]}, substeps))
    tried += [Setting(f"{n} iterations", {"iterations": n}, substeps) for n in (1, 3, 10) if n != model.opt.iterations]
    for times in (substeps, 0.5):
        if substeps / times >= 1 and times != 1:
            setting = {"timestep": step * times}
            tried.append(Setting(f"time step {1e3 * step * times:g} ms", setting, round(substeps / times)))
    return tried


def measure_physics(
    plan: Plan, script: Script, num_envs: int, steps: int, substeps: int, seed: int, progress: Progress = silent
) -> Subject:
    """Return the physics of a scene under several options.

    Errors are of joint angles and positions along the run, relative to their motion, against a run with a time step `FINE`
    times smaller and the document's cone. All runs take turns step by step, on the CPU; the document's setting has `substeps`
    physics steps.

    Raises:
        SimulationError: If the scene cannot be simulated.
    """
    model = scene_model(plan.scene)
    fine = {"timestep": model.opt.timestep / FINE, "iterations": ITERATIONS, "tolerance": TOLERANCE}
    tried = [*settings(model, substeps), Setting("fine", fine, FINE * substeps)]
    phases = 1 if script.keyframes is None and script.closing is None else 3
    seconds = steps / phases * substeps * model.opt.timestep
    inputs = dataclasses.replace(plan.inputs, substeps=1)  # no sensor is read, not even one of blocks
    unread = dataclasses.replace(plan, inputs=inputs)
    runs = [
        script.begin(TactileModule(unread, known_kinds()), num_envs, setting.substeps, seconds, setting.options)
        for setting in tried
    ]
    controls = varied(runs[0].controls, control_ranges(runs[0].sim.model), num_envs, seed)
    visited: list[list[np.ndarray]] = [[] for _ in tried]
    times: list[list[float]] = [[] for _ in tried]
    faults: dict[int, str] = {}
    for i, control in enumerate(controls):
        progress(f"physics: step {i + 1} of {len(controls)} under {len(tried)} settings")
        for k, run in enumerate(runs):
            if k in faults:
                continue
            start = time.perf_counter()
            try:
                run.sim.step(control)
            except SimulationError as error:
                faults[k] = str(error)
                continue
            times[k].append(time.perf_counter() - start)
            visited[k].append(run.sim.qpos.cpu().numpy().copy())
    for run in runs:
        run.sim.close()
    if len(tried) - 1 in faults or 0 in faults:
        raise SimulationError(faults.get(len(tried) - 1) or faults[0])
    return _subject(tried, faults, visited, times, model, num_envs, seed)


def _subject(
    tried: list[Setting],
    faults: dict[int, str],
    visited: list[list[np.ndarray]],
    times: list[list[float]],
    model: mujoco.MjModel,
    num_envs: int,
    seed: int,
) -> Subject:
    """Return the settings with their errors."""
    columns, quantities = coordinates(model)
    paths = {k: np.stack(places)[:, :, None, columns] for k, places in enumerate(visited) if k not in faults}
    exact = paths[len(tried) - 1]
    magnitude = magnitude_of(exact, quantities)
    cost = Cost(None, 0, 8 * (model.nq + model.nv), 8 * (model.nq + model.nv))
    points = []
    for k, setting in enumerate(tried[:-1]):
        if k in faults:
            continue
        drawn, verified = (
            errors_of(paths[k][:, half], exact[:, half], magnitude.of(half, range(len(quantities))), seed=seed)
            for half in halves(num_envs)
        )
        time_of_step = {num_envs: median_of(np.array(times[k]))}
        points.append(Measured(setting.label, "float64", setting.is_own, drawn, verified, time_of_step, cost))
    units = {"angle": "rad", "position": "m"}
    scales = {name: f"{scale:.4g} {units[name]}" for name, scale in zip(quantities, magnitude.scale, strict=True)}
    baseline = f"time step 1/{FINE}, up to {ITERATIONS} iterations to {TOLERANCE:g}"
    left_out = tuple((tried[k].label, why) for k, why in faults.items())
    return Subject("physics", "physics", baseline, "", scales, with_front(points), left_out)


def coordinates(model: mujoco.MjModel) -> tuple[list[int], list[str]]:
    """Return the indices in `qpos` of joint angles and positions, and the quantity of each; orientations are left out."""
    columns, quantities = [], []
    for joint in range(model.njnt):
        first, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            columns += [first, first + 1, first + 2]
            quantities += ["position"] * 3
        elif kind != mujoco.mjtJoint.mjJNT_BALL:
            columns.append(first)
            quantities.append("angle" if kind == mujoco.mjtJoint.mjJNT_HINGE else "position")
    return columns, quantities
