"""The default script of a scene: keyframes in turn, or the hand closes on an object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from tgdsl.console.progress import Progress, silent
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.closing.closing import START, Closing, closing_of
from tgdsl.runtime.rollout import Controls, controls_between, held_controls, scripted_controls
from tgdsl.scene.options import Options
from tgdsl.scene.scene import scene_model


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
        if self.closing is not None:
            prepare = self.closing.prepare
            sim = BatchSimulation(touch, num_envs, substeps=substeps, keyframe=START, options=options, prepare=prepare)
            return Run(sim, controls_between(self.closing.targets(sim.model.nu), seconds, sim.control_step))
        keyframe = self.keyframes[0] if self.keyframes else None
        sim = BatchSimulation(touch, num_envs, substeps=substeps, keyframe=keyframe, options=options)
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
    names = keyframes
    if names is None:
        model = scene_model(touch.plan.scene)
        is_scripted = {"rest", "squeeze"} <= {model.key(i).name for i in range(model.nkey)}
        names = ("rest", "squeeze") if is_scripted else ()
    if names or keyframes is not None:
        return Script(names)
    progress("finding out how the hand closes")
    closing = closing_of(touch)
    if isinstance(closing, str):
        return Script(note=f"no keyframes rest and squeeze, and the hand does not close ({closing})")
    return Script(closing=closing, note=f"no keyframes rest and squeeze: {closing}")
