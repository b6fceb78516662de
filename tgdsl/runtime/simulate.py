"""Simulation of a module's scene by a device's default simulator."""

from __future__ import annotations

from os import PathLike
from typing import Literal, Unpack, overload

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.connect import known_sources
from tgdsl.runtime.connection import SimulatorKind, keyword_options
from tgdsl.runtime.simulators.machine import checked_device
from tgdsl.runtime.simulators.simulation import SimOptions
from tgdsl.runtime.warp import WarpSimulation

MUJOCO = "mujoco"  # what users call the kind "simulation" where they name a simulator


@overload
def simulate(
    touch: TactileModule, num_envs: int, *, device: Literal["cpu"] = "cpu", **options: Unpack[SimOptions]
) -> BatchSimulation: ...
@overload
def simulate(
    touch: TactileModule, num_envs: int, *, device: str, **options: Unpack[SimOptions]
) -> BatchSimulation | WarpSimulation: ...
def simulate(
    touch: TactileModule, num_envs: int, *, device: str = "cpu", **options: Unpack[SimOptions]
) -> BatchSimulation | WarpSimulation:
    """Simulate the scene that a module was compiled for.

    Args:
        touch: The module.
        num_envs: Number of environments.
        device: Where physics runs: "cpu" is MuJoCo's Batch, "cuda" or "cuda:1" is MuJoCo Warp. States are on the module's
            device; both on one GPU need no copies.
        **options: `substeps`, `threads`, `keyframe`, `options`, `watch`, `per_env`, `on_fault`, `nconmax`, `njmax`, `model`,
            `prepare`, `graph`: see `SimOptions`. With `substeps=1`, the default, `state` is of the instant before the step:
            see `Simulation`.

    Raises:
        ArtifactError: If an asset of the scene is missing or has changed.
        SimulationError: If the device is not supported, an argument is for another device, or the scene lacks what the module
            wants.
    """
    if not isinstance(touch, TactileModule):
        example = f"tgdsl.compile({touch!r})" if isinstance(touch, (str, PathLike)) else "tgdsl.compile(document)"
        raise SimulationError(f"found a {type(touch).__name__}, expected a module: {example}")
    if misspelt := [name for name in options if name not in SimOptions.__annotations__]:
        hint = did_you_mean(misspelt[0], SimOptions.__annotations__, "options")
        raise SimulationError(f'simulate has no option "{misspelt[0]}"; {hint}')
    kind = simulator_for(device)
    kind_options = keyword_options(kind.simulate)
    if unknown := [name for name, value in options.items() if name not in kind_options and value]:
        problem = f'"{kind.name}", which simulates on "{device}", has no option {listed(unknown)}'
        raise SimulationError(f"{problem}; it knows {listed(kind_options)}")
    return kind.simulate(touch, num_envs, **{n: v for n, v in {**options, "device": device}.items() if n in kind_options})


def simulator_for(device: str, name: str | None = None) -> SimulatorKind:
    """Return a simulator: by its name, or the default of a device.

    Args:
        device: Where physics runs.
        name: "mujoco", "warp" or one that a package brings: see `known_sources`.

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
