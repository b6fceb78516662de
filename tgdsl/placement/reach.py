"""Taxels that nothing can touch: not collided by the simulator, buried in their link, or covered by another link.

MuJoCo collides convex solids: primitives, and the convex hulls of meshes. A taxel on a concave mesh may be so deep inside its
link's hull that no object comes within its radius. Everything is evaluated in the model's initial state.

Shapes: `taxel` taxels of a layout, `n` points of one body, `solid` colliding geoms.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from tgdsl.formats.model import Model
from tgdsl.layout.layout import BURIED, COVERED, NOT_COLLIDED, Layout, Unfelt
from tgdsl.surfaces.convex import ConvexSolid, hull_planes
from tgdsl.surfaces.geom import Geom
from tgdsl.surfaces.rays import sphere_directions
from tgdsl.surfaces.region import Covered

INSIDE = 1e-6  # depth from which a point counts as inside a solid [m]: links that touch face to face overlap by rounding
DIRECTIONS = 100  # directions in which a ball is tested for reaching out of several solids together
FEW_DIRECTIONS = (4, 20)  # most balls reach out in one of the first few directions: the rest are tested for the other balls
NEVER_MET = "on a body that is never in contact with its sensor's objects, which it reads by contact alone"
_UNBOUNDED = ("plane", "hfield", "sdf", "unknown")
"""Types of geoms that are no convex solid: the ground, and shapes that MuJoCo collides otherwise."""


@dataclass(frozen=True, eq=False)
class Reach:
    """What the colliding geoms of a robot leave of each taxel."""

    is_collided: Bool[np.ndarray, " taxel"]  # whether any geom of the taxel's body can be in a contact
    depth: Float[np.ndarray, " taxel"]  # in its own rigid link [m]; at most 0 outside
    is_buried: Bool[np.ndarray, " taxel"]  # whether its whole ball is inside its own rigid link
    cover: Int[np.ndarray, " taxel"]  # index of the body of another link that it is inside of; −1 if none


class Colliders:
    """The colliding geoms of a robot as convex solids in the world, in its initial state."""

    def __init__(self, robot: Model):
        """Pose the solids; planes, height fields and signed distance fields are none."""
        self.robot, model = robot, robot.compiled
        self.state = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.state)
        geoms = (robot.geom(i) for i in range(model.ngeom))
        self.geom = np.array([g.id for g in geoms if g.is_colliding and g.shape not in _UNBOUNDED], dtype=np.int64)
        self.body = model.geom_bodyid[self.geom].astype(np.int64)
        self.solids = [self._solid(int(i)) for i in self.geom]
        weld, root = model.body_weldid, model.body_rootid
        self.segment = np.where(weld > 0, weld, root).astype(np.int64)
        roots = np.arange(model.nbody)[root]
        self.is_loose = np.array([self._floats(int(i)) for i in roots])

    def collides(self, body: int) -> bool:
        first, count = int(self.robot.compiled.body_geomadr[body]), int(self.robot.compiled.body_geomnum[body])
        return any(self.robot.geom(i).is_colliding for i in range(first, first + count))

    def in_world(self, body: int, pos: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return self.state.xpos[body] + pos @ self.state.xmat[body].reshape(3, 3).T

    def solids_of(self, body: int) -> Int[np.ndarray, " solid"]:
        return np.flatnonzero(self.segment[self.body] == self.segment[body])

    def solids_of_others(self, body: int, ignored: Collection[int] = ()) -> Int[np.ndarray, " other"]:
        """Return the solids of other links; separate free bodies are objects, and the world is no link."""
        is_near = (self.robot.compiled.body_rootid == self.robot.compiled.body_rootid[body]) | ~self.is_loose
        is_link = is_near & (self.segment != self.segment[body])
        is_link[[0, *ignored]] = False
        return np.flatnonzero(is_link[self.body])

    def depths(self, solids: Int[np.ndarray, " solid"], pos: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "solid n"]:
        """Return the depth of world points inside each solid [m], see `ConvexSolid.depth`."""
        results = [self.solids[i].depth(pos) for i in solids]
        return np.stack(results) if results else np.zeros((0, len(pos)))

    def are_inside(self, solids: Int[np.ndarray, " solid"], pos: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return which points of the world are inside any of some solids."""
        result = np.zeros(len(pos), dtype=bool)
        low, high = pos.min(axis=0, initial=np.inf), pos.max(axis=0, initial=-np.inf)
        for i in solids:
            if self.solids[i].is_beyond(low, high):
                continue
            rest = np.flatnonzero(~result)
            result[rest] = self.solids[i].depth(pos[rest]) > INSIDE
        return result

    def is_buried(
        self, body: int, pos: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, " n"]
    ) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return which balls about points of a body's frame are wholly inside its rigid link, and the points' depths [m]."""
        solids, at = self.solids_of(body), self.in_world(body, pos)
        depths = self.depths(solids, at)
        depth = depths.max(axis=0, initial=-np.inf)
        is_buried = depth > radius + INSIDE
        several = (depth > INSIDE) & ~is_buried & ((depths > -radius).sum(axis=0) > 1)
        for directions in np.split(sphere_directions(DIRECTIONS), FEW_DIRECTIONS):
            doubtful = np.flatnonzero(several)
            if not len(doubtful):
                break
            rim = (at[doubtful, None] + radius[doubtful, None, None] * directions).reshape(-1, 3)
            several[doubtful] = self.are_inside(solids, rim).reshape(len(doubtful), -1).all(axis=1)
        return is_buried | several, depth

    def cover_of(self, body: str, geoms: Sequence[Geom], ignored: Collection[int] = ()) -> Covered:
        """Return a function that says which points of a body's frame are inside other colliding geoms of any link."""
        body_id = int(self.robot.compiled.body(body).id)
        solids = np.concatenate([self.solids_of(body_id), self.solids_of_others(body_id, ignored)])
        solids = solids[~np.isin(self.geom[solids], [geom.id for geom in geoms])]

        def is_covered(pos: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
            return self.are_inside(solids, self.in_world(body_id, pos))

        return is_covered

    def _solid(self, i: int) -> ConvexSolid:
        model, geom = self.robot.compiled, self.robot.geom(i)
        centre, half = model.geom_aabb[i, :3], model.geom_aabb[i, 3:]
        planes = hull_planes(self.robot.hull(geom)) if geom.shape == "mesh" else np.zeros((0, 4))
        pos, rotation = self.state.geom_xpos[i].copy(), self.state.geom_xmat[i].reshape(3, 3).copy()
        return ConvexSolid(geom.shape, geom.size, pos, rotation, planes, centre - half, centre + half)

    def _floats(self, root: int) -> bool:
        """Return whether a tree's first body goes anywhere: by a free joint, or as a mocap body."""
        model = self.robot.compiled
        first, count = int(model.body_jntadr[root]), int(model.body_jntnum[root])
        kinds = model.jnt_type[first : first + count] if count else []
        return bool(model.body_mocapid[root] >= 0 or int(mujoco.mjtJoint.mjJNT_FREE) in kinds)


def reach(colliders: Colliders, layout: Layout, ignored: Collection[int] = ()) -> Reach:
    """Return which taxels the robot's colliding geoms bury or cover; inactive fillers (radius 0) count as reachable."""
    count, model = layout.num_taxels, colliders.robot.compiled
    result = Reach(np.ones(count, bool), np.full(count, -np.inf), np.zeros(count, bool), np.full(count, -1))
    for place, name in enumerate(layout.bodies):
        taxels = np.flatnonzero((layout.body_id == place) & (layout.radius > 0))
        body, pos = int(model.body(name).id), layout.pos[taxels]
        result.is_collided[taxels] = colliders.collides(body)
        result.is_buried[taxels], result.depth[taxels] = colliders.is_buried(body, pos, layout.radius[taxels])
        solids = colliders.solids_of_others(body, ignored)
        depths = colliders.depths(solids, colliders.in_world(body, pos))
        if len(solids):
            deepest = depths.argmax(axis=0)
            is_inside = depths.max(axis=0) > INSIDE
            result.cover[taxels] = np.where(is_inside, colliders.body[solids[deepest]], -1)
    return result


def unfelt(colliders: Colliders, layout: Layout, reached: Reach) -> tuple[Unfelt, ...]:
    """Return the unreachable taxels by link and reason; each taxel is in one record."""
    records: list[Unfelt] = []
    is_buried = reached.is_collided & reached.is_buried
    is_covered = reached.is_collided & ~reached.is_buried & (reached.cover >= 0)
    for i, link in enumerate(layout.links):
        is_on_link = layout.link_id == i
        if len(taxels := np.flatnonzero(is_on_link & ~reached.is_collided)):
            collides = colliders.collides(int(colliders.robot.compiled.body(link.body).id))
            why = NEVER_MET if collides else "on a body that the simulator does not collide"
            records.append(Unfelt(link.name, NOT_COLLIDED, why, taxels, int(is_on_link.sum())))
        if len(taxels := np.flatnonzero(is_on_link & is_buried)):
            depth = f"{1e3 * reached.depth[taxels].max():.2g} mm"
            why = f"buried in the link's own colliding geoms, up to {depth} deep, beyond their radius"
            records.append(Unfelt(link.name, BURIED, why, taxels, int(is_on_link.sum())))
        for body in np.unique(reached.cover[is_on_link & is_covered]).tolist():
            taxels = np.flatnonzero(is_on_link & is_covered & (reached.cover == body))
            name = colliders.robot.compiled.body(body).name
            other = f'"{name}"' if name else f"unnamed body {body}"
            records.append(Unfelt(link.name, COVERED, f"inside {other} in the initial state", taxels, int(is_on_link.sum())))
    return tuple(records)
