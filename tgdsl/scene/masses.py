"""Masses of objects with geoms of their own: what their densities say, whatever the scene's compiler does to its bodies.

MJCF's compiler may leave geoms out of inertias (`inertiagrouprange`, `inertiafromgeom`), raise what is small (`boundmass`,
`boundinertia`) and scale all masses (`settotalmass`). That holds for the scene's own bodies, and for none of the objects.
"""

from __future__ import annotations

from collections.abc import Set

import mujoco
import numpy as np

from tgdsl.scene.mujoco_warnings import muted_mujoco

FORCED, IF_NEEDED = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE, mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
WEIGHED = ("type", "size", "pos", "quat", "density", "mass", "meshname")
"""What a geom's mass and inertia depend on, but for its mesh."""


def weigh(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """Give a body the mass and inertia of all of its geoms: MuJoCo's own in a model with nothing else in it."""
    alone = mujoco.MjSpec()
    alone.assets = spec.assets
    own = alone.worldbody.add_body()
    for name in sorted({geom.meshname for geom in body.geoms} - {""}):
        mesh = spec.mesh(name)
        alone.add_mesh(name=name, file=mesh.file, scale=mesh.scale, inertia=mesh.inertia)
    for geom in body.geoms:
        added = own.add_geom()
        for attribute in WEIGHED:
            setattr(added, attribute, getattr(geom, attribute))
    with muted_mujoco():
        model = alone.compile()
    _set_inertial(body, model, 1)


def freeze(spec: mujoco.MjSpec, new: Set[str], weighed: Set[str]) -> None:
    """Give the scene's bodies the inertias that its compiler makes for them, and let it change none from then on.

    Args:
        spec: The scene, changed in place; untouched if its compiler changes no inertias that are given.
        new: Names of the bodies that are not the scene's own: they do not count in its total mass.
        weighed: Names of the bodies whose inertias will be given.
    """
    compiler = spec.compiler
    total = compiler.settotalmass
    if not (compiler.boundmass or compiler.boundinertia or total > 0 or compiler.inertiafromgeom == FORCED):
        return
    with muted_mujoco():
        model = spec.compile()
    added = sum(float(model.body(name).mass[0]) for name in new)
    factor = total / (float(model.body_mass.sum()) - added) if total > 0 else 1.0
    for body in spec.bodies[1:]:
        if body.name not in weighed:
            _set_inertial(body, model, body.id, factor)
    compiler.boundmass, compiler.boundinertia, compiler.settotalmass = 0.0, 0.0, -1.0
    compiler.inertiafromgeom = IF_NEEDED


def _set_inertial(body: mujoco.MjsBody, model: mujoco.MjModel, id: int, factor: float = 1.0) -> None:
    """Give a body a compiled body's inertia, explicitly."""
    body.explicitinertial = True
    body.mass, body.inertia = float(model.body_mass[id]) * factor, model.body_inertia[id] * factor
    body.ipos, body.iquat = model.body_ipos[id], model.body_iquat[id]
    body.fullinertia = np.full(6, np.nan)
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
