"""Whether two compiled MuJoCo models are the same: every array and number of `MjModel`, its options, statistics and visuals."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

PATH_FIELDS = frozenset({"paths", "npaths", "mesh_pathadr", "hfield_pathadr", "skin_pathadr", "tex_pathadr", "nbuffer"})
"""Fields of file paths, and the buffer size that includes them: an artefact's scene names its files by content."""
ROUNDED = 1e-4  # relative error of numbers that MuJoCo computes of an MJCF text that it wrote itself, with six digits
TINY = 1e-6  # absolute error of differences of such numbers, in SI units
ROUNDING_SENSITIVE = (
    "bvh_",
    "body_bvh",
    "mesh_bvh",
    "mesh_graph",
    "mesh_poly",
    "oct_",
    "mesh_oct",
    "nbvh",
    "nmeshgraph",
    "nmeshpoly",
    "noct",
)
"""What MuJoCo finds by comparing coordinates, such as trees of boxes and faces of convex hulls: rounding may turn a tie."""


def differing_fields(loaded: mujoco.MjModel, kept: mujoco.MjModel, is_rounded: bool = False) -> list[str]:
    """Return the names of the fields that differ, dotted where they are in a structure, as in `opt.timestep`.

    Args:
        loaded: A model.
        kept: Another one.
        is_rounded: Whether the second was read from an MJCF text that MuJoCo wrote, with six digits; else every bit counts.
    """
    results = []
    for name, one, other in _fields(loaded, kept, ""):
        if name in PATH_FIELDS or (is_rounded and name.startswith(ROUNDING_SENSITIVE)):
            continue
        if not _same(one, other, is_rounded):
            results.append(name)
    return results


def _fields(one: Any, other: Any, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield name and both values of each field of a structure of MuJoCo's, and of the structures in it."""
    for name in dir(one):
        value = None if name.startswith("_") else getattr(one, name)
        if value is None or callable(value):
            continue
        if isinstance(value, (np.ndarray, int, float, bytes)):
            yield prefix + name, value, getattr(other, name)
        else:
            yield from _fields(value, getattr(other, name), f"{prefix}{name}.")


def _same(one: Any, other: Any, is_rounded: bool) -> bool:
    if not isinstance(one, np.ndarray) and one == other:
        return True
    first, second = np.asarray(one), np.asarray(other)
    if first.shape == second.shape and first.tobytes() == second.tobytes():
        return True
    is_real = first.dtype.kind == "f"
    if is_rounded and is_real:
        return first.shape == second.shape and np.allclose(first, second, rtol=ROUNDED, atol=TINY, equal_nan=True)
    return np.array_equal(first, second, equal_nan=is_real)
