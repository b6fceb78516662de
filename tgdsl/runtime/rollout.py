"""Rollouts: a scene stepped through controls, with every reading kept; and the default script of a scene.

Shapes: `step` control steps, `env` environments, `actuator` actuators, `taxel` and `channel` as the readings'.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import SimulationError
from tgdsl.files.arrays import read_arrays
from tgdsl.files.write import atomic_open
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.closing.closing import SERVO, START, Closing, closing_of
from tgdsl.runtime.simulators.machine import refuse_beyond_memory
from tgdsl.runtime.simulators.model_ids import element_id
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.state_values import control_tensor
from tgdsl.scene.options import Options
from tgdsl.scene.scene import scene_model

PLACES = ("link", "body", "pos", "normal", "area")  # columns of `taxels.taxel_table` that a recording holds
MISSED = 0.9  # share of a load that no taxel feels above which a run reports it
Controls = Float[np.ndarray, "step actuator"] | Float[np.ndarray, "step env actuator"]


class Step(NamedTuple):
    """One control step of a rollout: its number, and the time [s], the readings and MuJoCo's positions after it."""

    index: int
    time: float
    readings: dict[str, Tensor]
    qpos: Float[Tensor, "env nq"]


class Run(NamedTuple):
    """A scene at its start, and the controls that it is stepped through."""

    sim: BatchSimulation
    controls: Controls


@dataclass(frozen=True)
class Script:
    """How a scene is run."""

    # keyframes whose controls are held and moved between, in turn; None: the start is held
    keyframes: tuple[str, ...] | None = None
    closing: Closing | None = None  # how the hand closes on an object, where there are no keyframes
    note: str = ""  # what a user should know of it; may be empty

    def begin(self, touch: TactileModule, num_envs: int, substeps: int, seconds: float, options: Options | None = None) -> Run:
        """Start the scene; each hold and each move takes some seconds."""
        closing, prepare, keyframe = self.closing, None, self.keyframes[0] if self.keyframes else None
        if closing is not None:
            keyframe, prepare = START, closing.prepare
        sim = BatchSimulation(touch, num_envs, substeps=substeps, keyframe=keyframe, options=options, prepare=prepare)
        if closing is not None:
            return Run(sim, controls_between(closing.targets(sim.model.nu), seconds, sim.control_step))
        if self.keyframes is None:
            return Run(sim, held_controls(sim.model, seconds, sim.control_step))
        return Run(sim, scripted_controls(sim.model, self.keyframes, seconds, sim.control_step))


def substeps_of(touch: TactileModule, others: int) -> int:
    """Return the physics steps of a control step: as many as sensors that read blocks want, else `others`."""
    return max((sensor.substeps for sensor in touch.plan.sensors), default=0) or others


def script_of(touch: TactileModule, keyframes: tuple[str, ...] | None = None, progress: Progress = silent) -> Script:
    """Return how a scene is run: between keyframes, by default `rest` and `squeeze` if the scene has them.

    Else the hand closes on the first object that fits between its fingers, or, if it cannot, the start is held.
    """
    if keyframes is not None:
        return Script(keyframes)
    model = scene_model(touch.plan.scene)
    if {"rest", "squeeze"} <= {model.key(i).name for i in range(model.nkey)}:
        return Script(("rest", "squeeze"))
    progress("finding out how the hand closes")
    closing = closing_of(touch)
    if isinstance(closing, str):
        return Script(note=f"no keyframes rest and squeeze, and the hand does not close ({closing})")
    return Script(closing=closing, note=f"no keyframes rest and squeeze: {closing}")


def scripted_controls(model: mujoco.MjModel, keyframes: tuple[str, ...], seconds: float, control_step: float) -> Controls:
    """Return controls that hold the `ctrl` of each keyframe for some seconds and move evenly to the next one's in as long."""
    if not keyframes or not 0 < seconds < np.inf:
        raise SimulationError(f"{len(keyframes)} keyframes held for {seconds:g} s: expected at least one, and more than 0 s")
    targets = [model.key_ctrl[element_id(model, "key", name)] for name in keyframes]
    return controls_between(targets, seconds, control_step)


def controls_between(targets: Sequence[Float[np.ndarray, " actuator"]], seconds: float, control_step: float) -> Controls:
    """Return controls that hold each of some targets for some seconds and move evenly to the next in as long."""
    if not 0 < seconds < np.inf:
        raise SimulationError(f"held for {seconds:g} s: expected more than 0 s")
    steps, times = max(round(seconds / control_step), 1), 2 * len(targets) - 1
    refuse_beyond_memory(f"controls of {times * steps} steps", 8 * times * steps * len(targets[0]))
    parts = [np.tile(targets[0], (steps, 1))]
    for start, end in pairwise(targets):
        ramp = np.linspace(0.0, 1.0, steps)[:, None]
        parts += [start + ramp * (end - start), np.tile(end, (steps, 1))]
    return np.concatenate(parts)


def held_controls(model: mujoco.MjModel, seconds: float, control_step: float) -> Controls:
    """Return controls that stay zero, as in the initial state, for some time: see `controls_between`."""
    return controls_between([np.zeros(model.nu)], seconds, control_step)


def recorded_controls(path: Path) -> Controls:
    """Return the array `ctrl` of an `.npz` file, (step, actuator) or (step, env, actuator).

    Raises:
        SimulationError: If the file cannot be read or holds no such array, a number in it is not finite, or they are of servos
            that closed a hand.
    """
    arrays = read_arrays(path, expected := "an .npz file with an array `ctrl`", SimulationError)
    if "ctrl" not in arrays:
        raise SimulationError(f"{path}: expected {expected}: found {', '.join(arrays) or 'none'}")
    if any(name.startswith(SERVO) for name in arrays.get("actuators", np.array([], dtype=str)).tolist()):
        problem = "its controls are of servos that `tgdsl run` added to close the hand"
        raise SimulationError(f"{path}: {problem}; expected controls of the scene's own actuators")
    controls = arrays["ctrl"]
    if controls.ndim not in (2, 3) or not len(controls) or not np.issubdtype(controls.dtype, np.floating):
        expected = "expected floats (step, actuator) or (step, env, actuator)"
        raise SimulationError(f"{path}: `ctrl` is {controls.dtype} of shape {controls.shape}, {expected}")
    if len(bad := np.argwhere(~np.isfinite(controls))):
        place = ", ".join(map(str, bad[0]))
        more = f", and {len(bad) - 1} more" if len(bad) > 1 else ""
        raise SimulationError(f"{path}: `ctrl[{place}]` is {controls[tuple(bad[0])]}{more}: expected finite numbers")
    return controls.astype(np.float64)


def rollout(touch: TactileModule, sim: Simulation, controls: Controls) -> Iterator[Step]:
    """Step a scene through controls and yield the readings after each control step."""
    control_tensor(controls[0], sim.num_envs, sim.model.nu)
    for index, control in enumerate(controls):
        try:
            sim.step(control)
        except SimulationError as error:
            raise SimulationError(f"control step {index} of {len(controls)}: {error}") from error
        yield Step(index, (index + 1) * sim.control_step, touch(sim.state()), sim.qpos)


def touching_bodies(touch: TactileModule, sim: BatchSimulation) -> set[int]:
    """Return the bodies that are in contact with an object, and that object, in the first environment, where it is now.

    A contact is one that MuJoCo makes constraints for: nearer than the geoms' margin, and not within their gap alone.
    Bodies are MuJoCo's indices; of welded ones it is the first.
    """
    model = sim.env_model(0)
    data = mujoco.MjData(model)
    data.qpos[:] = sim.qpos[0].cpu().numpy()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)

    def rigid(body: int) -> int:
        return int(model.body_weldid[body]) or body

    objects = {rigid(model.body(target.body).id) for target in touch.plan.objects}
    # A geom of -1 is a flex, which is none of the objects.
    ends = [
        {rigid(int(model.geom_bodyid[geom])) if geom >= 0 else -1 for geom in c.geom} for c in data.contact if not c.exclude
    ]
    return set().union(*(bodies for bodies in ends if len(bodies) == 2 and bodies & objects))


def silent_readings(
    touch: TactileModule, sim: BatchSimulation, readings: Mapping[str, Tensor], touching: set[int]
) -> dict[str, list[str]]:
    """Return the readings of taxels that are 0 although bodies with these taxels touch an object, and these bodies.

    `touching` is what `touching_bodies` returns.
    """
    weld, body = sim.model.body_weldid, sim.model.body
    result = {}
    for output in touch.outputs:
        bodies = [name for name in output.bodies if (int(weld[body(name).id]) or body(name).id) in touching]
        if output.rows == "taxel" and bodies and not readings[output.name][0].any():
            result[output.name] = bodies
    return result


def missed_loads(touch: TactileModule, readings: Mapping[str, Tensor]) -> dict[str, str]:
    """Return the readings whose load is nearly all where no taxel is, with a message, by the name of the report of it.

    Loads are the sizes of forces by body, in the first environment: of what a body's taxels feel together, and of what it
    misses. Readings with a history are left out.
    """
    result = {}
    for output in touch.outputs:
        report = f"{output.name}/missed"
        missed = readings.get(report)
        if missed is None or "force_x" not in output.channels or missed.ndim + len(output.shape) != 5:
            continue
        first, names = output.channels.index("force_x"), list(touch.rows[output.name]["body"])
        force = readings[output.name][0, :, first : first + 3].double().cpu().numpy()
        of_bodies = [np.add.reduce(force[[name == body for name in names]], axis=0) for body in output.bodies]
        felt = float(np.linalg.norm(of_bodies, axis=1).sum())
        lost = float(missed[0].double().norm(dim=-1).sum())
        if lost > MISSED * (felt + lost):
            result[report] = f'"{output.name}" misses {lost:.3g} of {felt + lost:.3g} N, which act where none of its taxels is'
    return result


class Recorder:
    """Keeps the readings of a rollout and writes them as one `.npz` file.

    The file holds `time` (step,) [s], `ctrl` (step, …, actuator), names of `actuators`, MuJoCo's `qpos` (step, env, nq) after
    the step, the path of the `document`, each reading by its name (step, env, taxel, channel) as float32, and its channels'
    names and units under `<name>:channels` and `<name>:units`. Where its taxels are is under `<name>:link`, `<name>:body`,
    `<name>:pos` and `<name>:normal` (frame of the body [m]) and `<name>:area` [m²]. Readings of bodies have only
    `<name>:body`; readings with other rows have the columns of `touch.rows[<name>]`.
    """

    def __init__(self, touch: TactileModule, num_steps: int, num_envs: int):
        self._outputs, self._taxels, self._rows = touch.outputs, touch.taxels, touch.rows
        size = 4 * num_steps * num_envs * sum(math.prod(output.shape) for output in self._outputs)
        refuse_beyond_memory(f"readings of {num_envs} environments at {num_steps} steps", size)
        shapes = {output.name: (num_steps, num_envs, *output.shape) for output in self._outputs}
        self._readings = {name: np.empty(shape, dtype=np.float32) for name, shape in shapes.items()}
        self._time = np.empty(num_steps)
        self._qpos: list[np.ndarray] = []

    def add(self, step: Step) -> None:
        """Keep one step."""
        self._time[step.index] = step.time
        self._qpos.append(step.qpos.detach().cpu().numpy().copy())
        for name, column in self._readings.items():
            column[step.index] = step.readings[name].detach().cpu().numpy()

    def write(self, path: Path, controls: Controls, document: Path, actuators: Sequence[str]) -> None:
        """Write the file; it appears whole or not at all. `tgdsl view` finds the scene again by the document or artefact."""
        arrays: dict[str, np.ndarray] = {"time": self._time, "ctrl": controls, **self._readings}
        arrays["actuators"] = np.array(actuators, dtype=str)
        arrays |= {"qpos": np.array(self._qpos), "document": np.array(str(document.resolve()))}
        for output in self._outputs:
            arrays[f"{output.name}:channels"] = np.array(output.channels)
            arrays[f"{output.name}:units"] = np.array(output.units)
            if output.rows == "body":
                arrays[f"{output.name}:body"] = np.array(output.bodies)
            elif output.rows == "taxel":
                arrays |= {f"{output.name}:{column}": self._taxels[output.sensor][column] for column in PLACES}
            elif output.name in self._rows:
                table = self._rows[output.name]
                arrays |= {f"{output.name}:{column}": table[column] for column in table.dtype.names or ()}
        with atomic_open(path) as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
