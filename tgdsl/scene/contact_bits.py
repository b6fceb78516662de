"""Which geoms collide, by MuJoCo's bits `contype` and `conaffinity`, and what a geom in another's place has of it."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from tgdsl.errors import TgdslError

INHERITED = (
    *("contype", "conaffinity", "condim", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap"),
    *("group", "rgba", "material"),
)
"""What a geom in the place of a body's geoms has of the first of them."""


def free_bit(spec: mujoco.MjSpec, who: str, error: type[TgdslError], fields: tuple[str, ...] = ("conaffinity",)) -> int:
    """Return a bit that no geom collides with; if there is none, an error says who needs it."""
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
