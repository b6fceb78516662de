"""MuJoCo on CPU threads as a source: "simulation"."""

from __future__ import annotations

from collections.abc import Sequence

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.simulators.connect import SimulationConnection, refuse_hand_only, set_control_step
from tgdsl.runtime.simulators.faults import OnFault
from tgdsl.runtime.simulators.objects.properties import PER_ENV
from tgdsl.runtime.simulators.watch import Watch
from tgdsl.runtime.source_kind import SimulatorKind
from tgdsl.runtime.stepped_scene import SceneConnection, SteppedScene, refuse_other_steps
from tgdsl.scene.options import Options


def simulate_on_cpu(
    touch: TactileModule,
    num_envs: int,
    *,
    substeps: int = 1,
    threads: int = 0,
    keyframe: str | None = None,
    options: Options | None = None,
    watch: Watch | None = None,
    per_env: Sequence[str] = (),
    on_fault: OnFault = "raise",
) -> BatchSimulation:
    """Simulate the module's scene, as `tgdsl.simulate` says it.

    Raises:
        SimulationError: As from `BatchSimulation`.
    """
    if unknown := [word for word in per_env if word not in PER_ENV]:
        raise SimulationError(f'per_env: there is no "{unknown[0]}" on "cpu"; {did_you_mean(unknown[0], PER_ENV, "words")}')
    return BatchSimulation(
        touch,
        num_envs,
        substeps=substeps,
        threads=threads,
        keyframe=keyframe,
        options=options,
        watch=watch,
        on_fault=on_fault,
    )


def simulate_at(
    touch: TactileModule, num_envs: int, control_step: float, keyframe: str | None, watch: Watch | None = None
) -> BatchSimulation:
    """Simulate the module's scene with control steps of some duration [s].

    Raises:
        SimulationError: If the scene cannot be stepped like this.
    """
    sim = BatchSimulation(touch, num_envs, keyframe=keyframe, threads=0 if num_envs > 1 else 1, watch=watch)
    set_control_step(sim, control_step)
    return sim


def _open(
    touch: TactileModule,
    source: str,
    *,
    num_envs: int,
    control_step: float,
    keyframe: str | None,
    scene: SteppedScene | None = None,
) -> Connection:
    refuse_hand_only(touch)
    if scene is not None:
        refuse_other_steps(scene, control_step)
        return SceneConnection(touch, scene)
    return SimulationConnection(touch, simulate_at(touch, num_envs, control_step, keyframe))


SIMULATION = SimulatorKind(
    "simulation",
    '"simulation"',
    _open,
    recognise=lambda source: source == "simulation",
    devices=("cpu",),
    simulate=simulate_on_cpu,
)
"""The module's own scene, in MuJoCo's `Batch`."""
