"""Which differences of two MuJoCo models rounding alone explains: those that copies of one of them show, too.

Where boxes touch along a face, or two corners are equally deep, the last digits decide which contacts there are.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator

import mujoco
import numpy as np

COPIES, TWICE = 64, 2.0
"""Rounded copies that a difference beyond its limit is held against, and how many times theirs it may be."""
ROUNDED = (
    "body_pos",
    "body_quat",
    "body_ipos",
    "body_mass",
    "body_inertia",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "jnt_pos",
    "jnt_axis",
)
"""What the copies round."""


def ordered(one: int, two: int) -> tuple[int, int]:
    """Return two indices, the smaller first."""
    return min(one, two), max(one, two)


def contacts(model: mujoco.MjModel, data: mujoco.MjData) -> dict[tuple[int, int], tuple[float, float]]:
    """Return of each pair of bodies in contact the greatest depth [m] and the sum of normal forces [N]."""
    found: dict[tuple[int, int], tuple[float, float]] = {}
    force = np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        key = ordered(*(int(model.geom_bodyid[g]) for g in contact.geom))
        mujoco.mj_contactForce(model, data, i, force)
        depth, total = found.get(key, (0.0, 0.0))
        found[key] = (max(depth, -float(contact.dist)), total + float(force[0]))
    return found


def contacts_at(model: mujoco.MjModel, qpos: np.ndarray) -> dict[tuple[int, int], tuple[float, float]]:
    """Return the contacts of a state at rest."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return contacts(model, data)


def apart(first: dict[tuple[int, int], tuple[float, float]], second: dict[tuple[int, int], tuple[float, float]]) -> np.ndarray:
    """Return of each pair of bodies the differences of depth [m] and of force, relative to the largest of the first: (N, 2)."""
    largest, found = max([force for _, force in first.values()], default=0.0), []
    for key in first.keys() | second.keys():
        (depth, force), (other, pull) = first.get(key, (0.0, 0.0)), second.get(key, (0.0, 0.0))
        found.append((abs(depth - other), abs(force - pull) / largest if largest else float(pull > 0)))
    return np.array(found).reshape(-1, 2)


def rounded_copies(model: mujoco.MjModel) -> Iterator[mujoco.MjModel]:
    """Yield copies, each number of `ROUNDED` moved at random by up to the spacing of float32.

    Each is the one before, changed again.
    """
    own, generator = copy.deepcopy(model), np.random.default_rng(0)
    for _ in range(COPIES):
        for name in ROUNDED:
            exact = getattr(model, name)
            getattr(own, name)[:] = exact * (1 + np.finfo(np.float32).eps * generator.uniform(-1, 1, exact.shape))
        mujoco.mj_setConst(own, mujoco.MjData(own))
        yield own


def is_marginal(
    model: mujoco.MjModel, off: np.ndarray, limits: np.ndarray, measured: Callable[[mujoco.MjModel], np.ndarray]
) -> bool:
    """Return whether rounded copies of a model differ from it at least half as much as what is beyond its limit.

    Args:
        model: The model as written, unrounded.
        off: How far another one is from it: (Q,).
        limits: Of each quantity: (Q,).
        measured: Returns how far a copy is from the model: (Q,).
    """
    own = np.zeros_like(off)
    for rounded in rounded_copies(model):
        own = np.maximum(own, measured(rounded))
        if (off <= np.maximum(limits, TWICE * own)).all():
            return True
    return False
