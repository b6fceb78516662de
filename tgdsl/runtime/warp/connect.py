"""MuJoCo Warp as a source: "warp" or "warp:DEVICE"."""

from __future__ import annotations

from tgdsl.module.module import TactileModule
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.simulators.connect import SimulationConnection, refuse_hand_only, set_control_step
from tgdsl.runtime.source_kind import SimulatorKind
from tgdsl.runtime.stepped_scene import SceneConnection, SteppedScene, refuse_other_steps
from tgdsl.runtime.warp.simulation import WarpSimulation


def _open(
    touch: TactileModule,
    source: str,
    *,
    num_envs: int,
    control_step: float,
    keyframe: str | None,
    scene: SteppedScene | None = None,
    nconmax: int | None = None,
    njmax: int | None = None,
) -> Connection:
    refuse_hand_only(touch)
    if scene is not None:
        refuse_other_steps(scene, control_step)
        return SceneConnection(touch, scene)
    device = source.partition(":")[2] or "cuda"
    sim = WarpSimulation(touch, num_envs, device=device, keyframe=keyframe, nconmax=nconmax, njmax=njmax)
    set_control_step(sim, control_step)
    return SimulationConnection(touch, sim)


WARP = SimulatorKind("warp", '"warp", "warp:DEVICE"', _open, devices=("cuda",), simulate=WarpSimulation)
"""The module's own scene, in MuJoCo Warp."""
