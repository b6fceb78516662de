"""Stick and slip of a ball on a skin of taxels: tangential cycles on a Winkler foundation, and Mindlin's."""

import numpy as np
import torch

from oracles.comparison import Values, field
from tgdsl.geometry.planes import rot, vec
from tgdsl.quantities.contact_depth import Distance, Penetration
from tgdsl.quantities.geoms import Frame
from tgdsl.sensors.elastomer.anchors import PLANES, StickSlip, advance

oracle = field("contact mechanics: friction", "elastomer")
RADIUS, DEPTH, SLIP = 0.02, 1e-3, 0.4
"""Radius and depth of the ball [m], and the largest displacement per depth."""
TURN = 0.8
"""Reversals of the motion, over the displacement of full slip."""


class _Pad:
    """A ball held in a pad and moved along x; its pull relative to full slip."""

    def __init__(self) -> None:
        line = np.linspace(-7e-3, 7e-3, 121)
        x, y = (part.reshape(-1) for part in np.meshgrid(line, line))
        h = DEPTH - (x * x + y * y) / (2 * RADIUS)
        zero = np.zeros(len(h))
        self.pos, self.normal = self._vec(x, y, zero), self._vec(zero, zero, zero + 1)
        self.depth, self.full = h, SLIP * np.maximum(h, 0).sum()
        self.memory = {name: torch.zeros(1, len(h), dtype=torch.float64) for name in PLANES}
        self.pull(0.0)

    @staticmethod
    def _vec(*parts: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return vec(torch.from_numpy(np.array(part)) for part in parts)

    def pull(self, s: float) -> float:
        """Return the pull of a ball moved by s [m], relative to full slip."""
        depth = torch.from_numpy(self.depth)[None]
        zero = torch.zeros_like(depth)
        frame = Frame(rot((zero + 1, zero, zero, zero, zero + 1, zero, zero, zero, zero + 1)), (zero - s, zero, zero))
        distance = Distance(-depth, (zero, zero, zero))
        contact = Penetration(self.pos, depth.clamp(min=0), None, None, None, {"o": distance}, {"o": frame})
        displacement, self.memory = advance(contact, self.pos, self.normal, StickSlip(0.0, 0.0, 1e-2, SLIP), self.memory)
        return float(displacement[0].sum()) / self.full


def loading(ratio: np.ndarray) -> np.ndarray:
    """Return Q/μP of a ball on a Winkler foundation over the displacement s/s*.

    h = δ − r²/2R, dA = 2πR dh, and each taxel sticks up to κ h: Q = 2πR K_t ∫ min(s, κh) dh = 2πR K_t (s δ − s²/2κ),
    full slip at s* = κδ with μP = πR K_t κ δ².
    """
    return np.asarray(1 - (1 - np.clip(ratio, 0, 1)) ** 2)


def mindlin(ratio: np.ndarray) -> np.ndarray:
    """Return Q/μP of a ball on a half-space over the displacement s/s* (Johnson 7.42)."""
    return np.asarray(1 - (1 - np.clip(ratio, 0, 1)) ** 1.5)


@oracle(
    "A tangential cycle is the Winkler–Coulomb loop: {part}",
    "Q/μP = 1 − (1 − s/s*)²; Mindlin's half-space: 1 − (1 − s/s*)^1.5",
    "Masing's rule; Johnson 1985, 7.2, for a foundation of springs", "pull over μP [1]",
    "displacement over that of full slip [1]", each=["out", "back", "again"],
)  # fmt: skip
def cycle(part: str):
    pad, out = _Pad(), np.linspace(0, TURN, 9)
    down = np.linspace(TURN, -TURN, 9)
    ways = {"out": out, "back": down, "again": -down}
    ours = {name: [pad.pull(w * SLIP * DEPTH) for w in way] for name, way in ways.items()}
    turn = loading(np.array(TURN))
    exact = {
        "out": loading(out),
        "back": turn - 2 * loading((TURN - down) / 2),
        "again": -turn + 2 * loading((TURN - down) / 2),
    }
    return Values(exact[part], ours[part], at=ways[part], atol=2e-3 if part == "out" else 3e-3)


@oracle(
    "The loop closes", "Q(s) after a cycle = Q(s) before", "Masing's rule", "pull over μP [1]", at=[f"s = {TURN} s*"], atol=1e-3
)
def loop_closes():
    pad = _Pad()
    first = [pad.pull(w * (SLIP * DEPTH)) for w in np.linspace(0, TURN, 9)][-1]
    again = [pad.pull(w * (SLIP * DEPTH)) for w in (*np.linspace(TURN, -TURN, 9), *np.linspace(-TURN, TURN, 9))][-1]
    return first, again


@oracle("Beyond full slip the pull is μP", "Q = μP", "Coulomb's law", "pull over μP [1]", at=["s = 1.5 s*"], atol=1e-9)
def full_slip():
    return 1.0, _Pad().pull(1.5 * SLIP * DEPTH)


@oracle(
    "A skin of springs is stiffer than Mindlin's half-space", "27/256 at s/s* = 7/16",
    "maximum of (1 − x)^1.5 − (1 − x)² by hand", "largest difference of pulls over μP [1]", at=["s from 0 to s*"], atol=3e-3,
)  # fmt: skip
def off_mindlin():
    pad, way = _Pad(), np.linspace(0, 1, 129)
    difference = np.array([pad.pull(w * SLIP * DEPTH) for w in way]) - mindlin(way)
    return 27 / 256, difference.max()
