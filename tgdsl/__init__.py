"""Touch for robot learning: a scene and sensor language compiled to one batched PyTorch module.

touch = tgdsl.compile("hand.yaml")
sim = tgdsl.simulate(touch, num_envs=1024)
sim.step(control)
readings = touch(sim.state())
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tgdsl import testing as testing
    from tgdsl.calibration.fit import calibrate as calibrate
    from tgdsl.calibration.fit import compare as compare
    from tgdsl.compiler.scene import instrument as instrument
    from tgdsl.errors import ArtifactError as ArtifactError
    from tgdsl.errors import FileError as FileError
    from tgdsl.errors import HandError as HandError
    from tgdsl.errors import ObservationError as ObservationError
    from tgdsl.errors import RobotError as RobotError
    from tgdsl.errors import SimulationError as SimulationError
    from tgdsl.errors import SpecError as SpecError
    from tgdsl.errors import StateError as StateError
    from tgdsl.errors import TaxelError as TaxelError
    from tgdsl.errors import TgdslError as TgdslError
    from tgdsl.module.artifact import load as load
    from tgdsl.module.artifact import save as save
    from tgdsl.module.module import TactileModule as TactileModule
    from tgdsl.module.state import SceneState as SceneState
    from tgdsl.module.taxels import check_taxels as check_taxels
    from tgdsl.rl.env import TouchEnv as TouchEnv
    from tgdsl.runtime.batch.simulation import BatchSimulation as BatchSimulation
    from tgdsl.runtime.by_name import Geoms as Geoms
    from tgdsl.runtime.by_name import bodies_by_name as bodies_by_name
    from tgdsl.runtime.by_name import contacts_by_pair as contacts_by_pair
    from tgdsl.runtime.connect import connect as connect
    from tgdsl.runtime.connect import simulate as simulate
    from tgdsl.runtime.read import read_mujoco as read_mujoco
    from tgdsl.runtime.read import read_warp as read_warp
    from tgdsl.runtime.warp import WarpSimulation as WarpSimulation
    from tgdsl.tuning.compile import compile as compile
    from tgdsl.view.mirror import show as show

_PLACES = {
    "ArtifactError": "errors",
    "BatchSimulation": "runtime.batch.simulation",
    "FileError": "errors",
    "Geoms": "runtime.by_name",
    "HandError": "errors",
    "ObservationError": "errors",
    "RobotError": "errors",
    "SceneState": "module.state",
    "SimulationError": "errors",
    "SpecError": "errors",
    "StateError": "errors",
    "TactileModule": "module.module",
    "TaxelError": "errors",
    "TgdslError": "errors",
    "TouchEnv": "rl.env",
    "WarpSimulation": "runtime.warp",
    "bodies_by_name": "runtime.by_name",
    "calibrate": "calibration.fit",
    "compare": "calibration.fit",
    "check_taxels": "module.taxels",
    "compile": "tuning.compile",
    "connect": "runtime.connect",
    "contacts_by_pair": "runtime.by_name",
    "instrument": "compiler.scene",
    "load": "module.artifact",
    "read_mujoco": "runtime.read",
    "read_warp": "runtime.read",
    "save": "module.artifact",
    "show": "view.mirror",
    "simulate": "runtime.connect",
}

__all__ = sorted([*_PLACES, "testing"])  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, so that commands start without unneeded imports."""
    if name == "__version__":
        return version("tgdsl")
    if name == "testing":
        return import_module("tgdsl.testing")
    if name not in _PLACES:
        raise AttributeError(f"module 'tgdsl' has no attribute {name!r}")
    return getattr(import_module(f"tgdsl.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, all of them and no others."""
    return sorted([*__all__, "__version__"])
