"""States that errors are measured on: of a run of the scene, or of a file.

Shapes: `step` control steps, `env` environments, `actuator` actuators.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import StateError, TgdslError
from tgdsl.files.arrays import read_arrays
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.module.accuracy.states import narrowed
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SHAPES, SceneState
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.rollout import Script, script_of, substeps_of
from tgdsl.scene.scene import scene_model

LEAST_ENVS = 2  # half of the environments choose, the others verify
SWAY, PERIODS = 0.03, (0.05, 0.4)
"""Amplitude of the motion added to the controls, as a fraction of their range, and its periods, as fractions of a run."""
REACH = (0.5, 1.1)  # range of each environment's control amplitude, over the script's


@dataclass(frozen=True)
class Recording:
    """States of a scene, one after the other."""

    states: tuple[SceneState, ...]  # the states
    names: Mapping[str, Sequence[str]]  # what stands at each place of the axes of their fields
    source: str  # where they are from

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        assert self.states[0].body_pos is not None
        return self.states[0].body_pos.shape[0]

    def for_module(self, inputs: Inputs) -> list[SceneState]:
        """Return what a module wants of them.

        Raises:
            StateError: If they are of another document.
        """
        return [narrowed(state, self.names, inputs) for state in self.states]


def control_ranges(model: mujoco.MjModel) -> Float[np.ndarray, "actuator 2"]:
    """Return the lowest and highest control of each actuator; 0 and 0: it has none."""
    return np.where(model.actuator_ctrllimited[:, None] > 0, model.actuator_ctrlrange, 0.0)


def varied(
    controls: Float[np.ndarray, "step actuator"], ranges: Float[np.ndarray, "actuator 2"], num_envs: int, seed: int
) -> Float[np.ndarray, "step env actuator"]:
    """Return a script's controls per environment: each goes further or less far, and sways; the first has the script's.

    `ranges` are from `control_ranges`.
    """
    rng = np.random.default_rng(seed)
    num_steps, num = controls.shape
    reach = rng.uniform(*REACH, size=(num_envs, 1))
    period, phase = rng.uniform(*PERIODS, size=(num_envs, num)), rng.uniform(0, 2 * np.pi, size=(num_envs, num))
    reach[0], is_own = 1.0, np.arange(num_envs)[:, None] == 0
    time = np.linspace(0, 1, num_steps)[:, None, None]
    width = ranges[:, 1] - ranges[:, 0]
    sway = np.where(is_own, 0.0, SWAY * width * (np.sin(2 * np.pi * time / period + phase) - np.sin(phase)))
    result = controls[0] + reach * (controls[:, None] - controls[0]) + sway
    return np.where(width > 0, np.clip(result, ranges[:, 0], ranges[:, 1]), result)


def record(
    touch: TactileModule,
    num_envs: int,
    *,
    steps: int = 90,
    substeps: int = 5,
    seed: int = 0,
    script: Script | None = None,
    progress: Progress = silent,
) -> Recording:
    """Run a module's scene by its script on the CPU, and keep every state.

    Args:
        touch: The module.
        num_envs: Environments.
        steps: Control steps, about.
        substeps: Physics steps of each. A module with sensors that are advanced at physics steps has as many as these want; if
            fewer, it makes more control steps, so that the run lasts as long.
        seed: Of what differs between environments.
        script: How it is run; default: as `tgdsl run` does.
        progress: Called with a line of text for each long job.

    Raises:
        TgdslError: If there are fewer than two environments or no steps.
        SimulationError: If the scene cannot be simulated.
    """
    if num_envs < LEAST_ENVS or steps < 1:
        raise TgdslError(f"{num_envs} environments of {steps} steps: expected at least {LEAST_ENVS}, and at least one step")
    num_substeps = substeps_of(touch, substeps)
    script = script or script_of(touch, progress=progress)
    phases = 1 if script.keyframes is None and script.closing is None else 3
    seconds = steps / phases * max(num_substeps, substeps) * scene_model(touch.plan.scene).opt.timestep
    sim, controls = script.begin(touch, num_envs, num_substeps, seconds)
    results = []
    for control in varied(controls, control_ranges(sim.model), num_envs, seed):
        progress(f"recording states: {len(results) + 1} of {len(controls)}")
        sim.step(control)
        results.append(_copy(sim.state()))
    sim.close()
    touch.free()
    description = f"{len(results)} steps of {1e3 * sim.control_step:g} ms in {num_envs} environments, seed {seed}"
    return Recording(tuple(results), touch.inputs.names, f"scripted run: {description}")


def _copy(state: SceneState) -> SceneState:
    parts = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    values: dict[str, Any] = {name: value.clone() if isinstance(value, Tensor) else value for name, value in parts.items()}
    return SceneState(**{**values, "substeps": tuple(_copy(part) for part in state.substeps)})


def save_recording(recording: Recording, path: Path) -> None:
    """Write states as an `.npz` file: each field (step, env, …), `dt` (step,) [s], and `names:<axis>`.

    Raises:
        FileError: If it cannot be written.
        TgdslError: If the states have substeps, which such a file does not hold.
    """
    if any(state.substeps for state in recording.states):
        raise TgdslError(f"{path}: these states have substeps, which a file of states does not hold")
    first = recording.states[0]
    fields = [name for name in SHAPES if getattr(first, name) is not None]
    arrays = {name: torch.stack([getattr(state, name) for state in recording.states]).cpu().numpy() for name in fields}
    arrays |= {f"names:{axis}": np.array(names, dtype=str) for axis, names in recording.names.items()}
    if first.dt is not None:
        arrays["dt"] = np.array([state.dt for state in recording.states])
    with atomic_open(with_folder(path)) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_recording(path: Path) -> Recording:
    """Read states that `save_recording` wrote.

    Raises:
        StateError: If the file cannot be read, is not a file of states, or holds too few.
    """
    arrays = read_arrays(path, "an .npz file of states", StateError)
    fields = [name for name in SHAPES if name in arrays]
    if "body_pos" not in fields or "names:body" not in arrays:
        raise StateError(
            f"{path}: expected states, with the arrays body_pos and names:body; found {', '.join(arrays) or 'none'}"
        )
    steps, envs = arrays["body_pos"].shape[:2]
    if envs < LEAST_ENVS or not steps:
        raise StateError(f"{path}: {steps} steps of {envs} environments: expected at least {LEAST_ENVS}, and at least one step")
    if wrong := [name for name in fields if arrays[name].shape[:2] != (steps, envs)]:
        raise StateError(f"{path}: {wrong[0]} has shape {arrays[wrong[0]].shape}, expected ({steps}, {envs}, …)")
    tensors = {name: torch.from_numpy(arrays[name]) for name in fields}
    dt: Sequence[float | None] = arrays["dt"].tolist() if "dt" in arrays else [None] * steps
    states = [SceneState(**{name: value[i] for name, value in tensors.items()}, dt=dt[i]) for i in range(steps)]  # type: ignore[arg-type]
    names = {name.removeprefix("names:"): array.tolist() for name, array in arrays.items() if name.startswith("names:")}
    return Recording(tuple(states), names, f"{path}: {steps} steps in {envs} environments")
