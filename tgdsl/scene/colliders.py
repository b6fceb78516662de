"""Primitive colliders that replace the robot's geoms, which stay visible: `robot: {collision: primitive}`.

One or more colliders of a link are its *core*. Links with colliders collide with each other by their cores alone, and with
the rest of the scene by all colliders. So the number of geom pairs grows with the number of links, and the other colliders
refine contacts with objects only.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np

from tgdsl.errors import RobotError, TgdslError
from tgdsl.plan.scene import Collider

INHERITED = (
    *("contype", "conaffinity", "condim", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap"),
    *("group", "rgba", "material"),
)
"""What a geom in the place of a body's geoms has of the first of them."""


def free_bit(spec: mujoco.MjSpec, who: str, error: type[TgdslError], fields: tuple[str, ...] = ("conaffinity",)) -> int:
    """Return a bit that no geom collides with; if there is none, raise an error that names the user of the bit."""
    used = int(np.bitwise_or.reduce([int(getattr(geom, field)) for geom in spec.geoms for field in fields]))
    free = next((1 << bit for bit in range(30, -1, -1) if not used >> bit & 1), None)
    if free is None:
        names = " and ".join(f"`{field}`" for field in fields)
        raise error(f"the scene's geoms use all bits of {names}; {who} need a free one")
    return free


def bits_that_meet(geoms: Iterable[mujoco.MjsGeom]) -> tuple[int, int]:
    """Return `contype` and `conaffinity` of a geom that collides with all that collide with any: 1 and 1 where that will do."""
    contype = conaffinity = 1
    for geom in geoms:
        if (geom.contype or geom.conaffinity) and not meets(1, 1, geom):
            contype, conaffinity = contype | geom.conaffinity, conaffinity | geom.contype
    return contype, conaffinity


def meets(contype: int, conaffinity: int, geom: mujoco.MjsGeom) -> bool:
    return bool((contype & geom.conaffinity) | (geom.contype & conaffinity))


GROUP = 3  # MuJoCo's group of colliders, which its viewers hide by default


def collider_name(body: str, i: int) -> str:
    return f"tgdsl/{body}/collider/{i}"


def with_colliders(spec: mujoco.MjSpec, colliders: Sequence[Collider]) -> mujoco.MjSpec:
    """Replace the colliding geoms of links by colliders; the spec is changed in place and returned.

    The geoms stay visible. Masses and inertias do not change. A link's colliders copy contact parameters, such as friction,
    from its first colliding geom.

    Raises:
        RobotError: If the scene lacks a body, or one has no geom that collides; if another geom collides with a link only by
            the `contype` of the link's geoms, or by an explicit pair of geoms.
    """
    by_body: dict[str, list[Collider]] = {}
    for collider in colliders:
        by_body.setdefault(collider.body, []).append(collider)
    if not by_body:
        return spec
    geoms_of = {body: _colliding(spec, body) for body in by_body}
    replaced = [geom for geoms in geoms_of.values() for geom in geoms]
    _refuse_pairs(spec, replaced)
    rest = [geom for geom in spec.geoms if geom not in replaced]
    is_self_colliding = any(meets(one.contype, one.conaffinity, other) for one in replaced for other in replaced)
    core = free_bit(spec, "links with primitive colliders", RobotError, ("contype", "conaffinity")) if is_self_colliding else 0
    for body, parts in by_body.items():
        _refuse_lost(body, geoms_of[body], rest)
        for i, collider in enumerate(parts):
            _add(spec, collider, i, geoms_of[body][0], core if collider.is_core else 0)
    for geom in replaced:
        geom.contype = geom.conaffinity = 0
    return spec


def _colliding(spec: mujoco.MjSpec, body: str) -> list[mujoco.MjsGeom]:
    owner = spec.body(body)
    if owner is None:
        raise RobotError(f'the scene has no body "{body}", which has primitive colliders')
    geoms = [geom for geom in owner.geoms if geom.contype or geom.conaffinity]
    if not geoms:
        raise RobotError(f'no geom of body "{body}" collides, expected one whose place its primitive colliders take')
    return geoms


def _refuse_pairs(spec: mujoco.MjSpec, replaced: Sequence[mujoco.MjsGeom]) -> None:
    names = {geom.name for geom in replaced if geom.name}
    for pair in spec.pairs:
        if named := names & {pair.geomname1, pair.geomname2}:
            problem = f'the scene has a contact pair of geom "{sorted(named)[0]}", whose place primitive colliders take'
            raise RobotError(f"{problem}; expected pairs of other geoms")


def _refuse_lost(body: str, replaced: Sequence[mujoco.MjsGeom], others: Sequence[mujoco.MjsGeom]) -> None:
    """Refuse a scene where a geom collides with a link only by the link's `contype`, which its colliders do not have."""
    for other in others:
        met = any(meets(geom.contype, geom.conaffinity, other) for geom in replaced)
        if met and not meets(0, replaced[0].conaffinity, other):
            problem = f'geom "{other.name}" (body "{other.parent.name}") collides with "{body}" by its `conaffinity` alone'
            raise RobotError(f"{problem}; primitive colliders collide only with geoms whose `contype` has one of their bits")


def _add(spec: mujoco.MjSpec, collider: Collider, i: int, like: mujoco.MjsGeom, core: int) -> None:
    geom = spec.body(collider.body).add_geom(
        name=collider_name(collider.body, i),
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{collider.type.upper()}"),
        size=[*collider.size, 0.0, 0.0][:3],
        pos=collider.pos,
        quat=collider.quat,
    )
    geom.fromto, geom.meshname = np.full(6, np.nan), ""  # whatever the scene's defaults say
    geom.fluid_ellipsoid = 0.0
    for name in INHERITED:
        setattr(geom, name, getattr(like, name))
    geom.contype, geom.conaffinity, geom.group = core, int(like.conaffinity) | core, GROUP
    geom.mass, geom.density = 0.0, 0.0
