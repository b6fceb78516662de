"""Which part of a link's surface a proposed layout samples, so that every taxel can feel, and by which options.

A link is sampled on its meshes as they are, unless these have hollows that are deeper inside the hulls that the simulator
collides than a taxel's radius; what is inside other colliding geoms in the initial state is left out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tgdsl.errors import SampleError
from tgdsl.formats.model import Model
from tgdsl.placement.reach import Colliders
from tgdsl.placement.sample import poisson
from tgdsl.placement.sample.poisson import Pool
from tgdsl.surfaces import meshlab
from tgdsl.surfaces.region import Region
from tgdsl.surfaces.surface import Surface

MIN_AREA = 1e-8
"""A surface smaller than this is degenerate [m²]."""
_ANYWHERE = Region(is_geom=None, facings=(), boxes=(), spheres=())
Options = Mapping[str, str | bool]
"""Options of a placement, `surface` and `exposed`, as the grammar has them."""


def surface_pool(surface: Surface) -> Pool | None:
    """Return points on the outside of a link's surface; None if none of it can be touched from outside.

    Raises:
        SampleError: If pymeshlab is not installed.
    """
    try:
        shell = meshlab.outer_shell(surface)
    except ImportError as error:
        raise SampleError(f"sampling needs pymeshlab: {error}", "pip install pymeshlab") from error
    return poisson.pool(shell, _ANYWHERE, seed=0, count=1, spacing=None)


def exposed_pool(robot: Model, colliders: Colliders, body: str, pool: Pool, radius: float) -> tuple[Pool | None, Options]:
    """Return points on what is to be sampled of a link, and the options that have a placement sample just that.

    Args:
        robot: The robot.
        colliders: What the simulator collides of it.
        body: The link.
        pool: Points on the link's meshes as they are.
        radius: The least sensing radius of its taxels [m].

    Returns:
        The points, None if other links cover all of them; and the options.
    """
    geoms, options = robot.touchable(body), {}
    if not all(geom.is_colliding for geom in geoms):
        return pool, options
    is_covered = colliders.cover_of(body, geoms)
    covered = is_covered(pool.pos)
    deep, _ = colliders.is_buried(int(robot.compiled.body(body).id), pool.pos, np.full(len(pool.pos), radius))
    if (deep & ~covered).any():
        options["surface"] = "collision"
        on_hulls = surface_pool(robot.surface(geoms, as_collided=True))
        if on_hulls is None:
            return None, options
        pool, covered = on_hulls, is_covered(on_hulls.pos)
    if covered.any():
        options["exposed"] = True
        pool = Pool(pool.pos[~covered], pool.normal[~covered], pool.point_area[~covered])
    return (pool if pool.area > MIN_AREA else None), options
