"""Find the hot one among balls that look and move alike, by temperature alone, and stay on it.

An episode begins with the hand above a tilted bin and each ball near a separate place; the hot ball's place is random. Each
finger link has a grid of temperatures. With T_ic the reading of link i's grid in cell c, f_l the hot ball's force on
fingertip l, d_p the distance from probe p of the fingertips to its surface,

    π_i = clamp((max_c T_ic − T_a)/(T_h − T_a), 0, 1)           progress of a link [1]
    π   = max_i π_i                                             progress of the hand [1]
    c   = (max_l |f_l| ≥ f_min)                                 a fingertip is on the hot ball
    b_t = b_{t−1} or π ≥ 1 − m                                  heat latch, off at the start
    S   = Σ_t Δt b_t c_t                                        latched contact [s]

Groups: `priv_heat` holds π_i of each link, b and c; `priv_obj_state` and `priv_obj_props` are of the hot ball, as in `groups`.
The policy must see none of them: it has `proprio` and `tactile_sensors` with `touch: temperature`.

An episode terminates where the hot ball has left the bin: its centre is below `lost_height`. Score: S.

Source: Chung et al., *Tactile Genesis*, appendix, "Task and Success Metric": bin, balls, temperatures, observations, π_i, the
latch with m = 0.12, and S. The paper prints no reward. Ours rewards approach, then contact, then the progress that fires the
latch, and last S's integrand, which is worth more than all other terms. `lost`, `action_rate` and `work` have the weights of
the paper's palm tasks. π comes from the hot ball alone unless a link has a heat source. f_min is ours and excludes rounding
errors. A fingertip that also leans on a cold ball reads the mean of both, and never latches. Random friction, mass or pushes
would apply to the hot ball alone and identify it: they are refused.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from pydantic import model_validator
from torch import Tensor

from tgdsl.errors import LowerError, SimulationError
from tgdsl.fields.models import Length, PositiveLength, Quantity, Range, RangeOf, Temperature
from tgdsl.rl import groups, terms
from tgdsl.rl.spec import RandomSpec, TaskSpec
from tgdsl.rl.task import Features, Now, Part, Setup, Start, reward_term


class HotBallRandomSpec(RandomSpec):
    """Random values."""

    xy: Annotated[Range, RangeOf("length")] = (0.0, 0.0)
    """Offset of each ball's place along the world's x and y, each [m]."""

    @model_validator(mode="after")
    def _check(self) -> HotBallRandomSpec:
        names = [name for name in ("friction", "mass", "push") if getattr(self, name) != getattr(RandomSpec(), name)]
        if names:
            raise ValueError(f"`{names[0]}` would be the hot ball's alone and tell it from others: expected it to be left out")
        return self


class HotBallSpec(TaskSpec):
    """Find the hot ball, and stay on it."""

    others: tuple[str, ...] = ()
    """Bodies of the other balls; episodes permute the keyframe's places among all balls."""
    randomise: HotBallRandomSpec = HotBallRandomSpec()
    """Random values."""
    ambient: Temperature = 22.0
    """T_a, temperature of the surroundings, as the sensors' document has it [°C]."""
    target: Temperature = 45.0
    """T_h, temperature of the hot ball at the start, as the sensors' document has it [°C]."""
    margin: Annotated[float, Quantity("number", ge=0.0, le=1.0)] = 0.12
    """m: the latch fires where a link's progress is 1 − m [1]."""
    min_force: terms.Force = 0.05
    """f_min: less force of the hot ball is no contact [N]."""
    near_width: PositiveLength = 0.2
    """λ, decay length of `approach` [m]."""
    lost_height: Length = 0.06
    """Height of the hot ball's centre below which it has left the bin [m]."""

    @model_validator(mode="after")
    def _check(self) -> HotBallSpec:
        if self.target <= self.ambient:
            raise ValueError(f"`target` is {self.target:g} °C, expected more than `ambient`, {self.ambient:g} °C")
        return self


class HotBall(terms.HandTask[HotBallSpec]):
    """The task."""

    Spec = HotBallSpec
    senses = ("temperature_grid", "link_contact", "surface_distance")
    score_unit = "s of latched contact"
    score_range = (0, math.inf)
    own_groups = ("priv_heat", "priv_obj_state", "priv_obj_props")

    @reward_term(1.0, "1/s")
    def approach(self, now: Now) -> Float[Tensor, " env"]:
        """How near the nearest fingertip is to the hot ball, exp(−max(0, min_p d_p)/λ)."""
        return torch.exp(-now.distance.amin(dim=1).clamp(min=0.0) / self.spec.near_width)

    @reward_term(1.0, "1/s")
    def contact(self, now: Now) -> Bool[Tensor, " env"]:
        """A fingertip is on the hot ball, c."""
        return self.is_touched

    @reward_term(2.0, "1/s", name="progress")
    def highest_progress(self, now: Now) -> Float[Tensor, " env"]:
        """How hot the hottest finger link is, π."""
        return self.progress.amax(dim=1)

    @reward_term(10.0, "1/s")
    def latched(self, now: Now) -> Bool[Tensor, " env"]:
        """A fingertip is on the hot ball, and the latch on, b c."""
        return self.is_latched & self.is_touched

    @reward_term(-100.0, "1/s")
    def lost(self, now: Now) -> Bool[Tensor, " env"]:
        """The hot ball has left the bin in this step."""
        return self.is_over(now)

    def __init__(self, spec: HotBallSpec, setup: Setup):
        """Look up the balls, and the cells of each link; raise `LowerError` if another ball has no free joint."""
        super().__init__(spec, setup)
        self.places = _places(spec, setup).to(setup.device)
        self.heat, table = setup.rows["temperature_grid"]
        self.cells = _cells(np.asarray(table["link"])).to(setup.device)
        self.progress = self.keep("progress", len(self.cells))
        self.is_latched, self.is_touched = (self.keep(name, dtype=torch.bool) for name in ("is_latched", "is_touched"))
        self.held = self.keep("held")
        links = dict.fromkeys(table["link"])
        names = ("whether the latch is on", "whether the hot ball is touched")
        heat = [*(Features("progress", 1, "1", "", link) for link in links), *(Features(name, 1) for name in names)]
        self.parts = {
            "priv_heat": [Part(self._heat_numbers, heat)],
            "priv_obj_state": [groups.object_state(setup)],
            "priv_obj_props": [groups.object_props(setup), groups.distances(setup)],
        }

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> Start:
        """Rotate the balls' places by a random number, and offset each ball."""
        draws, num = self.setup.draws, len(self.places)
        qpos = self.setup.qpos.repeat(self.setup.num_envs, 1)
        first = draws.integers("place", episode, 1, 0, num - 1)
        taken = (torch.arange(num, device=first.device) + first) % num
        moved = draws.uniform("placement", episode, 2 * num, *self.spec.randomise.xy).to(qpos.dtype)
        pos = qpos[:, self.places][torch.arange(len(qpos), device=first.device)[:, None], taken]
        pos[:, :, :2] += moved.view(-1, num, 2)
        qpos[:, self.places] = pos
        self.begin(chosen, progress=0.0, is_latched=0.0, is_touched=0.0, held=0.0)
        return Start({"qpos": qpos})

    def advance(self, now: Now) -> None:
        """Update the links' progress, contact and the latch."""
        spec = self.spec
        reading = now.readings[self.heat].to(self.progress)[:, :, 0]
        above = reading[:, self.cells].amax(dim=2) - spec.ambient
        self.progress.copy_((above / (spec.target - spec.ambient)).clamp(0.0, 1.0))
        self.is_latched |= self.progress.amax(dim=1) >= 1.0 - spec.margin
        self.is_touched.copy_(now.link_force.norm(dim=2).amax(dim=1) >= spec.min_force)
        self.held += self.setup.control_step * (self.is_latched & self.is_touched)

    def is_over(self, now: Now) -> Bool[Tensor, " env"]:
        """Return where the hot ball has left the bin."""
        return now.object.pos[:, 2] < self.spec.lost_height

    def score(self) -> Float[Tensor, " env"]:
        """Return for how long a fingertip was on the hot ball with the latch on [s]."""
        return self.held

    def _heat_numbers(self, now: Now) -> Float[Tensor, "env feature"]:
        bits = torch.stack([self.is_latched, self.is_touched], dim=1)
        return torch.cat([self.progress, bits.to(self.progress)], dim=1)


def _places(spec: HotBallSpec, setup: Setup) -> Int[Tensor, "ball 7"]:
    """Return where each ball's position and quaternion stand in `qpos`, the hot one's first."""
    rows = [setup.free_qpos()]
    for name in spec.others:
        try:
            rows.append(setup.free_qpos(name))
        except SimulationError as error:
            raise LowerError(str(error), "others") from error
    if len({row.start for row in rows}) < len(rows):
        raise LowerError("a ball is named twice, or the object is among them", "others", "expected each of the others once")
    return torch.tensor([list(range(row.start, row.stop)) for row in rows])


def _cells(links: np.ndarray) -> Int[Tensor, "link cell"]:
    rows = [np.flatnonzero(links == name) for name in dict.fromkeys(links.tolist())]
    most = max(len(links) for links in rows)
    return torch.from_numpy(np.array([np.concatenate([links, np.repeat(links[:1], most - len(links))]) for links in rows]))
