"""MuJoCo Warp as a source: "warp" or "warp:DEVICE"."""

from __future__ import annotations

from collections.abc import Sequence

from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.simulators.connect import SimulationConnection, refuse_hand_only, set_control_step
from tgdsl.runtime.simulators.faults import OnFault
from tgdsl.runtime.simulators.watch import Watch
from tgdsl.runtime.source_kind import SimulatorKind
from tgdsl.runtime.stepped_scene import SceneConnection, SteppedScene, refuse_other_steps
from tgdsl.runtime.warp.simulation import WarpSimulation
from tgdsl.scene.options import Options


def _simulate(
    touch: TactileModule,
    num_envs: int,
    *,
    device: str,
    substeps: int = 1,
    threads: int = 0,
    keyframe: str | None = None,
    options: Options | None = None,
    watch: Watch | None = None,
    per_env: Sequence[str] = (),
    on_fault: OnFault = "raise",
    nconmax: int | None = None,
    njmax: int | None = None,
) -> WarpSimulation:
    """Simulate the module's scene, as `tgdsl.simulate` says it.

    Raises:
        SimulationError: As from `WarpSimulation`, or if an argument is for a CPU.
    """
    if threads:
        raise SimulationError(f'threads is {threads}, but only physics on "cpu" has threads, and the device is "{device}"')
    return WarpSimulation(
        touch,
        num_envs,
        device=device,
        substeps=substeps,
        keyframe=keyframe,
        options=options,
        watch=watch,
        per_env=per_env,
        on_fault=on_fault,
        nconmax=nconmax,
        njmax=njmax,
    )


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


WARP = SimulatorKind("warp", '"warp", "warp:DEVICE"', _open, devices=("cuda",), simulate=_simulate)
"""The module's own scene, in MuJoCo Warp."""
