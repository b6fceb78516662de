"""MuJoCo on CPU threads.

`mujoco.batch`, which MuJoCo has from 3.17 on, is imported when a simulation is made: to compile, and to read another
simulator's state, an older MuJoCo will do.
"""

from __future__ import annotations

import importlib

import mujoco

from tgdsl.errors import SimulationError


def require_batch() -> None:
    """Import `mujoco.batch`.

    Raises:
        SimulationError: If this MuJoCo has none.
    """
    try:
        importlib.import_module("mujoco.batch")
    except ImportError as error:
        what = f"MuJoCo {mujoco.__version__} has no `mujoco.batch`, by which tgdsl simulates on a CPU"
        raise SimulationError(f'{what}: pip install "mujoco>=3.17"') from error
