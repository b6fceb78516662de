"""Where an object lies between the fingers of a hand: found by sweeping the hand through its closing motion, without forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.runtime.closing.moving import Movement

SHARES = np.linspace(0.0, 1.0, 9)
"""How far the hand is closed: where its tips are tried, and where touch is looked for."""
TOWARD_PALM = (0.0, 0.2, 0.4, 0.6, -0.25, -0.5)
"""How far from the tips' middle to the palm a place is tried."""
OPPOSED = -0.3
"""Two links that touch an object oppose each other if the cosine between their directions is less than this."""
OVERLAP = 0.1
"""How deep an object may lie in the open hand where it is left, as a share of its radius."""
_UNBOUNDED = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


@dataclass(frozen=True)
class Grip:
    """What a hand that closes meets of an object, at the first share at which each link does.

    Attributes:
        overlap: How deep the object lies in the open hand [m]; negative: how far it is from it.
        links: Bodies that meet it.
        is_opposed: Whether two of these do so from opposite sides.
        imbalance: Length of the mean of the directions from which they do.
    """

    overlap: float
    links: frozenset[int]
    is_opposed: bool
    imbalance: float

    @property
    def holds(self) -> bool:
        """Whether several links meet the object, from opposite sides."""
        return len(self.links) > 1 and self.is_opposed


class Sweep:
    """A hand that closes on an object, pose by pose."""

    def __init__(self, movement: Movement, body: int):
        self.movement, self.model, self.body = movement, movement.model, body
        self.data = mujoco.MjData(self.model)
        self.is_free = int(self.model.body_dofnum[body]) == 6 and int(self.model.body_jntnum[body]) == 1
        weld = self.model.body_weldid
        rigid = [b for b in range(self.model.nbody) if weld[b] == weld[body] and body in (*movement.path(b), 0)]
        self.object_geoms = [geom for b in rigid for geom in self._touchable(b)]
        self.hand_geoms = [geom for b in sorted(movement.hand) for geom in self._touchable(b)]
        self._posed(0.0)
        offsets = [self.data.geom_xpos[geom] - self.data.xpos[body] for geom in self.object_geoms]
        self.middle = self.data.xmat[body].reshape(3, 3).T @ np.mean(offsets, axis=0) if offsets else np.zeros(3)
        reach = [np.linalg.norm(p - np.mean(offsets, axis=0)) for p in offsets]
        self.radius = max((r + self.model.geom_rbound[g] for r, g in zip(reach, self.object_geoms, strict=True)), default=0.0)

    def place(self) -> Float[np.ndarray, " 3"] | None:
        """Return where the object's frame lies for a grip as good as any, in the world [m]; None if nowhere clear of the hand.

        First between all fingertips; if it cannot be held there, such as what is smaller than the gaps, between one fingertip
        and the palm, or two.
        """
        best, result = (False, 0, -np.inf), None
        tips = self.movement.tips
        for among in ([tips], [*((tip,) for tip in tips), *combinations(tips, 2)]):
            for candidate in self._candidates(among):
                origin = candidate - self.data.xmat[self.body].reshape(3, 3) @ self.middle
                grip = self.grip(origin)
                value = grip.is_opposed, len(grip.links), -grip.imbalance
                if grip.overlap <= 0 and grip.links and value > best:
                    best, result = value, origin
            if best[0]:
                break
        return result

    def grip(self, origin: Float[np.ndarray, " 3"] | None = None) -> Grip:
        """Return what the hand meets as it closes, the object's frame at `origin` in the world [m] or where it starts."""
        sides: dict[int, np.ndarray] = {}
        overlap = -np.inf
        for share in SHARES:
            self._posed(float(share), origin)
            middle = self.data.xpos[self.body] + self.data.xmat[self.body].reshape(3, 3) @ self.middle
            for geom in self.hand_geoms:
                link = int(self.model.geom_bodyid[geom])
                away = np.linalg.norm(self.data.geom_xpos[geom] - middle) - self.model.geom_rbound[geom]
                if link in sides or (share > 0 and away > self.radius):
                    continue
                gap, point = self._gap(geom)
                overlap = max(overlap, -gap) if share == 0 else overlap
                if gap < 0:
                    sides[link] = (point - middle) / max(float(np.linalg.norm(point - middle)), 1e-9)
        ways = np.array(list(sides.values())).reshape(-1, 3)
        is_opposed = bool(len(ways) and (ways @ ways.T).min() < OPPOSED)
        imbalance = float(np.linalg.norm(ways.mean(axis=0))) if len(ways) else 1.0
        return Grip(float(overlap), frozenset(sides), is_opposed, imbalance)

    def _candidates(self, among: Sequence[Sequence[int]]) -> list[Float[np.ndarray, " 3"]]:
        """Return places between fingertips, and from there toward the palm, while the hand closes."""
        results = []
        base = [b for b in sorted(self.movement.hand) if self._touchable(b)]
        for share in SHARES:
            self._posed(float(share))
            for bodies in among:
                tips = np.mean([self._middle_of(body) for body in bodies], axis=0)
                palm = self._middle_of(base[0]) if base[0] not in self.movement.tips else tips
                results += [(1.0 - toward) * tips + toward * palm for toward in TOWARD_PALM]
        return results

    def _middle_of(self, body: int) -> Float[np.ndarray, " 3"]:
        geoms = self._touchable(body)
        return np.mean(self.data.geom_xpos[geoms], axis=0) if geoms else self.data.xpos[body]

    def _gap(self, geom: int) -> tuple[float, Float[np.ndarray, " 3"]]:
        """Return the distance of a geom from the object [m], and the object's nearest point."""
        best, point, ends = 1.0, np.zeros(3), np.zeros(6)
        for other in self.object_geoms:
            gap = mujoco.mj_geomDistance(self.model, self.data, other, geom, 1.0, ends)
            if gap < best:
                best, point = gap, ends[:3].copy()
        return best, point

    def _posed(self, share: float, origin: Float[np.ndarray, " 3"] | None = None) -> None:
        self.data.qpos[:] = self.movement.pose(share)
        if origin is not None and self.is_free:
            address = int(self.model.jnt_qposadr[self.model.body_jntadr[self.body]])
            self.data.qpos[address : address + 3] = origin
        mujoco.mj_kinematics(self.model, self.data)

    def _touchable(self, body: int) -> list[int]:
        first, num = int(self.model.body_geomadr[body]), int(self.model.body_geomnum[body])
        geoms = [geom for geom in range(first, first + num) if int(self.model.geom_type[geom]) not in _UNBOUNDED]
        return [geom for geom in geoms if self.model.geom_contype[geom] or self.model.geom_conaffinity[geom]] or geoms
