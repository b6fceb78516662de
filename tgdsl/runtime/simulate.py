"""Simulation of a module's scene, by the simulator that is taken for a device."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any, Literal, overload

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.known import known_sources
from tgdsl.runtime.simulators.devices import checked_device
from tgdsl.runtime.simulators.faults import OnFault
from tgdsl.runtime.simulators.watch import Watch
from tgdsl.runtime.source_kind import SimulatorKind, keyword_options
from tgdsl.runtime.warp import WarpSimulation
from tgdsl.scene.options import Options

MUJOCO = "mujoco"
"""What users call the kind "simulation" where they name a simulator."""
_DEFAULTS = {
    "substeps": 1,
    "threads": 0,
    "keyframe": None,
    "options": None,
    "watch": None,
    "per_env": (),
    "on_fault": "raise",
    "nconmax": None,
    "njmax": None,
}


@overload
def simulate(
    touch: TactileModule,
    num_envs: int,
    *,
    device: Literal["cpu"] = "cpu",
    substeps: int = 1,
    threads: int = 0,
    keyframe: str | None = None,
    options: Options | None = None,
    watch: Watch | None = None,
    per_env: Sequence[str] = (),
    on_fault: OnFault = "raise",
) -> BatchSimulation: ...
@overload
def simulate(
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
) -> BatchSimulation | WarpSimulation: ...
def simulate(
    touch: TactileModule,
    num_envs: int,
    *,
    device: str = "cpu",
    substeps: int = 1,
    threads: int = 0,
    keyframe: str | None = None,
    options: Options | None = None,
    watch: Watch | None = None,
    per_env: Sequence[str] = (),
    on_fault: OnFault = "raise",
    nconmax: int | None = None,
    njmax: int | None = None,
) -> BatchSimulation | WarpSimulation:
    """Simulate the scene that a module was compiled for.

    Args:
        touch: The module.
        num_envs: Number of environments.
        device: Where physics runs: "cpu" is MuJoCo's Batch, "cuda" or "cuda:1" is MuJoCo Warp. The state is handed out on the
            module's device; both on one GPU need no copies.
        substeps: Physics steps per control step. What `state` hands out after a step is of the start of the last one: with
            `substeps=1`, of the instant before the step. `sim.forward()` evaluates where the environments are now.
        threads: CPU threads; 0: one per CPU.
        keyframe: Name of the keyframe to start from.
        options: Fields of MuJoCo's `mjOption` that are to differ from the scene's, by name and in its units, such as
            `{"timestep": 0.005, "cone": "pyramidal", "iterations": 10}`, and `solref` and `solimp` of all contacts; no XML is
            edited.
        per_env: What environments shall have of their own: "mass" and "friction" for `sim.properties`, on a GPU also fields of
            MuJoCo's model by name. On the CPU environments may always have these.
        watch: Names of bodies, sites, joints, actuators and pairs that `sim.watched()` returns, of the instant of readings.
        on_fault: What becomes of environments that diverge or are given controls that are not finite: "raise" has `step` raise
            until they are reset, "reset" restarts them, in the simulator and in the module, "note" leaves that to whoever
            looks at `faults` and resets them. All are counted, and the last two warn once.
        nconmax: On a GPU, capacity for contacts per environment, in a pool that all share: see `WarpSimulation`.
        njmax: On a GPU, capacity for rows of constraints in each environment.

    Raises:
        ArtifactError: If an asset of the scene is missing or has changed.
        SimulationError: If the device is not supported, an argument is for another device, or the scene lacks what the module
            wants.
    """
    if not isinstance(touch, TactileModule):
        made = f"tgdsl.compile({touch!r})" if isinstance(touch, (str, PathLike)) else "tgdsl.compile(document)"
        raise SimulationError(f"found a {type(touch).__name__}, expected a module: {made}")
    given: dict[str, Any] = {"substeps": substeps, "threads": threads, "keyframe": keyframe, "on_fault": on_fault}
    given |= {"options": options, "watch": watch, "per_env": tuple(per_env), "nconmax": nconmax, "njmax": njmax}
    kind = simulator_for(device)
    known = keyword_options(kind.simulate)
    if unknown := [name for name, value in given.items() if name not in known and value != _DEFAULTS[name]]:
        what = f'"{kind.name}", which simulates on "{device}", has no option {listed(unknown)}'
        raise SimulationError(f"{what}; it knows {listed(known)}")
    options = {name: value for name, value in (given | {"device": device}).items() if name in known}
    return kind.simulate(touch, num_envs, **options)


def simulator_for(device: str, name: str | None = None) -> SimulatorKind:
    """Return a simulator: by its name, or the one that is taken for a device.

    Args:
        device: Where physics runs.
        name: "mujoco", "warp" or one that a package brings: see `tgdsl.runtime.known`.

    Raises:
        SimulationError: If there is no such device or simulator, or MuJoCo is asked for on a GPU.
    """
    simulators = [kind for kind in known_sources() if isinstance(kind, SimulatorKind)]
    type_ = device.partition(":")[0]
    if name is not None:
        by_name = {MUJOCO if kind.name == "simulation" else kind.name: kind for kind in simulators}
        if name not in by_name:
            raise SimulationError(f'simulator is "{name}"; {did_you_mean(name, by_name, "simulators")}')
        if name == MUJOCO and type_ != "cpu":
            raise SimulationError(f'MuJoCo steps on the CPU, and the device is "{device}"; leave `simulator` out')
        return by_name[name]
    results = [kind for kind in simulators if type_ in kind.devices]
    if not results:
        checked_device(device, sorted({type_ for kind in simulators for type_ in kind.devices}, reverse=True))
    return results[0]
