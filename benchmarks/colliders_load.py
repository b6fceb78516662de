"""Why an object that is squeezed is loaded more by primitive colliders than by meshes: compliance of contacts, in C MuJoCo.

Used by colliders.py. Objects that links hold are left to settle for a second under constant targets, in the same states, with
several colliders and values of `solimp`'s d. A contact with the elliptic cone is at rest a spring of stiffness

    f / r = 1 / ((1 − d) t² A)        d: impedance [1], t: time constant of `solref` [s], A: inverse inertia [1/kg]

(MuJoCo's documentation, Computation, Constraint model), whatever the number of contacts of a pair: n of them are n times as
stiff.
Where their compliance exceeds the drives', the load depends on n: on the algorithm that finds contacts.

- `load_%`: of the object, median over states of the ratio to that with meshes of the same cone and d;
- `force`: its mean [N]; `contacts`: of the object, mean; `depth_mm`: of the deepest one, mean;
- `held`: in how many of the states the object is still held; the means are of those in which meshes hold it too.
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
"""d of `solimp`, constant with depth; None: the scene's own."""
HELD = 1.0
"""Load that an object bears which is held, not only carried [N]."""
SETTLING = 40
"""Control steps of constant targets."""
KINDS = ("mesh", "mesh, one contact a pair", "primitive")


def load(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return a row per cone, impedance and kind of colliders."""
    scenes, rows = Scenes(options.task), []
    held = _held(scenes, options.states)
    print(f"{len(held)} of {options.states} objects are held")
    print(f"{'colliders':<26} {'cone':<9} d      load_%  force contacts depth_mm held")
    for cone in options.cones:
        for impedance in IMPEDANCES:
            found = {kind: np.array([_settled(scenes, kind, cone, impedance, own)[1:] for own in held]) for kind in KINDS}
            for kind, own in found.items():
                rows.append({"colliders": kind, "cone": cone, "d": impedance} | _row(own, found["mesh"]))
                values = "{load_%:6.0f} {force:6.2f} {contacts:8.2f} {depth_mm:8.2f} {held:4d}".format_map(rows[-1])
                print(f"{kind:<26} {cone:<9} {impedance or 'scene':<6} {values}", flush=True)
    colliders_error.write(options, "load", rows)
    return rows


def stiffness(impedance: float, time_constant: float, inverse_inertia: float) -> float:
    """Return the stiffness of a contact at rest with the elliptic cone [N/m].

    Args:
        impedance: d of `solimp`.
        time_constant: The first number of `solref` [s].
        inverse_inertia: Of both bodies, at the contact along its normal [1/kg].
    """
    return 1 / ((1 - impedance) * time_constant**2 * inverse_inertia)


def _held(scenes: Scenes, count: int) -> list[Instant]:
    """Return settled states with meshes and the elliptic cone in which links hold the object."""
    found = []
    for own in colliders_error.instants(scenes, count, 10):
        qpos, force, *_ = _settled(scenes, "mesh", "elliptic", None, own)
        if force > HELD:
            found.append(Instant(own.number, qpos, np.zeros_like(own.qvel), own.targets[-1:]))
    return found


def _settled(
    scenes: Scenes, kind: str, cone: str, impedance: float | None, instant: Instant
) -> tuple[np.ndarray, float, int, float]:
    """Return positions, and load [N], number and greatest depth [m] of the object's contacts, once targets have been held."""
    model = scenes.model(Variant(kind.split(",")[0], cone), instant.number)
    kept, flags = model.geom_solimp.copy(), model.opt.disableflags
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
    model.geom_solimp[:], model.opt.disableflags = kept, flags
    return data.qpos.copy(), force, len(near), max([0.0, *near])


def _row(own: np.ndarray, exact: np.ndarray) -> dict[str, Any]:
    both = (own[:, 0] > HELD) & (exact[:, 0] > HELD)
    force, contacts, depth = (float(value) for value in own[both].mean(axis=0)) if both.any() else (0.0, 0.0, 0.0)
    ratio = 100.0 * statistics.median(own[both, 0] / exact[both, 0]) if both.any() else 0.0
    numbers = {"load_%": ratio, "force": force, "contacts": contacts, "depth_mm": 1e3 * depth}
    return numbers | {"held": int((own[:, 0] > HELD).sum())}
