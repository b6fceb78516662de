"""Load on squeezed objects by collider and by compliance of contacts, in C MuJoCo: primitives load them more than meshes do.

Used by colliders.py. Objects held by links settle for a second under constant targets, from the same states, with several
colliders and values of `solimp`'s d. With the elliptic cone, a contact at rest is a spring of stiffness

    f / r = 1 / ((1 − d) t² A)        d: impedance [1], t: time constant of `solref` [s], A: inverse inertia [1/kg]

(MuJoCo's documentation, Computation, Constraint model). Each contact of a pair is such a spring: n contacts are n times as
stiff. Where their compliance exceeds the drives', the load depends on n, and so on the algorithm that detects contacts.

- `load_%`: load of the object over that with meshes of the same cone and d, median over states;
- `force`, `contacts`, `depth_mm`: mean load [N], number of the object's contacts, and greatest depth;
- `held`: number of states in which the object is still held; means are over those in which meshes hold it too.
"""

from __future__ import annotations

import argparse
import statistics
from typing import Any

import colliders_error
import mujoco
import numpy as np
from colliders_error import Instant, Scenes, Variant, advance, link_forces

IMPEDANCES = (None, 0.99, 0.999)
"""d of `solimp`, constant with depth; None: the scene's."""
HELD = 1.0
"""Load above which an object is held, not only carried [N]."""
SETTLING = 40
"""Control steps of constant targets."""
KINDS = ("mesh", "mesh, one contact a pair", "primitive")


def load(options: argparse.Namespace) -> None:
    """Print a row per cone, impedance and kind of colliders."""
    scenes = Scenes(options.task)
    held = _held(scenes, options.states)
    print(f"{len(held)} of {options.states} objects are held")
    print(f"{'colliders':<26} {'cone':<9} d      load_%  force contacts depth_mm held")
    for cone in options.cones:
        for impedance in IMPEDANCES:
            loads = {kind: np.array([_settled(scenes, kind, cone, impedance, start)[1:] for start in held]) for kind in KINDS}
            for kind, values in loads.items():
                row = _row(values, loads["mesh"])
                text = "{load_%:6.0f} {force:6.2f} {contacts:8.2f} {depth_mm:8.2f} {held:4d}".format_map(row)
                print(f"{kind:<26} {cone:<9} {impedance or 'scene':<6} {text}", flush=True)


def _held(scenes: Scenes, count: int) -> list[Instant]:
    """Return settled states with meshes and the elliptic cone in which links hold the object."""
    result = []
    for start in colliders_error.instants(scenes, count, 10):
        qpos, force, *_ = _settled(scenes, "mesh", "elliptic", None, start)
        if force > HELD:
            result.append(Instant(start.number, qpos, np.zeros_like(start.qvel), start.targets[-1:]))
    return result


def _settled(
    scenes: Scenes, kind: str, cone: str, impedance: float | None, instant: Instant
) -> tuple[np.ndarray, float, int, float]:
    """Return positions, and load [N], number and greatest depth [m] of the object's contacts, after constant targets."""
    model = scenes.model(Variant(kind.split(",")[0], cone), instant.number)
    solimp, flags = model.geom_solimp.copy(), model.opt.disableflags
    if impedance is not None:
        model.geom_solimp[:, :2] = impedance
    if "one" in kind:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    data, body = mujoco.MjData(model), int(model.body(scenes.body).id)
    data.qpos[:], data.qvel[:] = instant.qpos, instant.qvel
    for target in (*instant.targets, *[instant.targets[-1]] * SETTLING):
        advance(model, data, target, scenes.spec.physics.substeps)
    mujoco.mj_forward(model, data)
    near = [-data.contact[k].dist for k in range(data.ncon) if body in model.geom_bodyid[data.contact[k].geom]]
    force = float(np.linalg.norm(link_forces(model, data, body), axis=1).sum())
    model.geom_solimp[:], model.opt.disableflags = solimp, flags
    return data.qpos.copy(), force, len(near), max([0.0, *near])


def _row(values: np.ndarray, exact: np.ndarray) -> dict[str, Any]:
    both = (values[:, 0] > HELD) & (exact[:, 0] > HELD)
    force, contacts, depth = (float(value) for value in values[both].mean(axis=0)) if both.any() else (0.0, 0.0, 0.0)
    ratio = 100.0 * statistics.median(values[both, 0] / exact[both, 0]) if both.any() else 0.0
    numbers = {"load_%": ratio, "force": force, "contacts": contacts, "depth_mm": 1e3 * depth}
    return numbers | {"held": int((values[:, 0] > HELD).sum())}
