"""What environments take of this computer's memory, found before any of it is taken."""

from __future__ import annotations

import os

import mujoco

from tgdsl.errors import SimulationError


def refuse_beyond_memory(what: str, num_bytes: int) -> None:
    """Raise an error if something needs more memory than this computer has; where that is not known, do nothing."""
    try:
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # no such call on Windows
        return
    if num_bytes > there > 0:
        raise SimulationError(f"{what} need about {num_bytes / 1e9:.3g} GB, and this computer has {there / 1e9:.3g} GB")


def bytes_per_env(model: mujoco.MjModel) -> int:
    """Return what the state of one environment takes: MuJoCo's own, poses, velocities and sensors."""
    state = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION)
    return 8 * (state + model.nbody * (3 + 4 + 6 + 3) + model.nsensordata)
