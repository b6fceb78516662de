"""How a policy moves an object: whether it holds or flicks it, and the loads of hand and object.

Each control step counts by the instant of its readings, except an episode's last one, whose readings begin the next episode.
With f_l the object's force on link l, Δψ the step's progress (`Task.step_progress`), τ and q̇ torques and velocities of the
joints that the policy moves, d_p the distance from probe p to the object, v and ω the object's velocity and angular velocity:

    coasting         Σ max(0, Δψ) over instants at which no finger touches, as a share of Σ max(0, Δψ) over all
    untouched        share of instants at which no finger touches: |f_l| ≤ 0.01 N for each finger's link l
    saturation       share of instants at which |τ_j| ≥ (0.98 S_j − ν) τ_max,j: of the joint with the largest share
    any_saturation   share of instants at which any joint is saturated
    penetration      99th percentile of max_p (−d_p), where it is more than 0 [m]
    force            99th percentile of |f_l| over links and instants where it is more than 0.01 N [N]
    speed, spin      99th percentiles of |v| [m/s] and |ω| [rad/s]; max_speed, max_spin: the largest
    joint_speed      99th percentile of |q̇_j| over its rated speed: of the joint with the largest one [1]

with τ_max the largest torque, S its random factor, and ν the noise of torques: see `tgdsl.rl.actuation`.

Percentiles come from histograms with bins 1 % wide. Quantities that a task lacks are None: progress, probes, links, limits of
torques or speeds. At the rated speed a joint's damping takes all of its largest torque.

Shapes: `env` environments, `link` links of `Setup.links`, `joint` joints that the policy moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.console.tables import text_table
from tgdsl.fields.units import Dimension
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.task import Now
from tgdsl.rl.tasks.parts import are_fingers

TOUCH = 0.01  # force above which a link touches the object [N]
SATURATED = 0.98  # share of the largest torque from which on a joint is at its torque limit
LEAST, WIDTH, NUM_BINS = 1e-6, math.log(1.01), 2800
"""Lower end of the first bin, width of the bins of the logarithm, and their number: up to 1.3e6."""
PERCENTILE = 0.99
SHARE = "share"  # a plain number, or one in percent
SPIN = Dimension("angular speed", {"rad/s": 1.0})
UNITS: dict[str | Dimension, str] = {"length": "m", "force": "N", "speed": "m/s", SPIN: "rad/s"}
METRICS: dict[str, tuple[str, str | Dimension]] = {
    "coasting": ("progress while no finger touches the object", SHARE),
    "untouched": ("time without a finger at the object", SHARE),
    "saturation": ("time at the torque limit, joint with the most", SHARE),
    "any_saturation": ("time with any joint at its torque limit", SHARE),
    "penetration": ("penetration, 99 % below", "length"),
    "force": ("force on links, 99 % below", "force"),
    "speed": ("object's speed, 99 % below", "speed"),
    "max_speed": ("object's speed, largest", "speed"),
    "spin": ("object's spin, 99 % below", SPIN),
    "max_spin": ("object's spin, largest", SPIN),
    "joint_speed": ("joint speed over rated speed, 99 % below", SHARE),
}
"""The numbers of a gait: what tables call each, and its dimension."""


@dataclass(frozen=True)
class Gait:
    """How a policy moves an object: see the top of this page; by name, what each link and joint bears."""

    coasting: float | None
    untouched: float | None
    saturation: float | None
    any_saturation: float | None
    penetration: float | None
    force: float | None
    speed: float | None
    spin: float | None
    max_speed: float
    max_spin: float
    joint_speed: float | None
    saturations: dict[str, float]
    link_forces: dict[str, float]
    joint_speeds: dict[str, float]
    rated_speeds: dict[str, float]

    def __str__(self) -> str:
        rows = [(label, _cell(getattr(self, name), dimension)) for name, (label, dimension) in METRICS.items()]
        parts = [text_table(("gait", ""), rows)]
        if self.link_forces:
            forces = [(name, f"{force:.3g}") for name, force in self.link_forces.items()]
            parts.append(text_table(("link", "force, 99 % below [N]"), forces))
        joints = [
            (name, _cell(self.saturations.get(name), SHARE), f"{speed:.3g}", _cell(self.rated_speeds.get(name), "number"))
            for name, speed in self.joint_speeds.items()
        ]
        unit = "[rad/s, slides m/s]"
        parts.append(text_table(("joint", "at its torque limit", f"speed, 99 % below {unit}", f"rated speed {unit}"), joints))
        return "\n\n".join(parts)


def _cell(value: float | None, dimension: str | Dimension) -> str:
    if value is None:
        return "–"
    if dimension == SHARE:
        return f"{value:.1%}"
    return f"{1e3 * value:.3g} mm" if dimension == "length" else f"{value:.3g} {UNITS.get(dimension, '')}".rstrip()


class GaitMeter:
    """Adds up how policies move objects, each in a block of environments."""

    def __init__(self, env: TouchEnv, blocks: int):
        setup, num, device = env.task.setup, env.num_envs, env.sim.qpos.device
        self._env, self._blocks, actuators = env, blocks, setup.actuators
        self._links, self._joints = setup.links, actuators.names
        self._fingers = torch.from_numpy(are_fingers(setup.model, setup.links)).to(device)
        self._limit, self._rated = (torch.from_numpy(value).to(device) for value in (actuators.limit, actuators.top_speed))
        sizes = {"penetration": 1, "force": len(setup.links), "speed": 1, "spin": 1, "joint_speed": len(actuators.names)}
        ends = [0, *accumulate(sizes.values())]
        self._rows = {name: slice(*pair) for name, pair in zip(sizes, pairwise(ends), strict=True)}
        self._counts = torch.zeros((blocks, ends[-1], NUM_BINS), dtype=torch.int64, device=device)
        block = torch.arange(num, device=device) // (num // blocks)
        self._first = ((block[:, None] * ends[-1] + torch.arange(ends[-1], device=device)) * NUM_BINS).flatten()
        names = ("steps", "untouched", "any_saturation", "forth", "coasted")
        self._sums = {name: torch.zeros(num, dtype=torch.float64, device=device) for name in names}
        self._saturated = torch.zeros((num, len(actuators.names)), dtype=torch.float64, device=device)
        self._most = torch.zeros((num, 2), dtype=torch.float64, device=device)

    def add(self, counts: Bool[Tensor, " env"]) -> None:
        """Add the instant after a step of the environments."""
        actuation = self._env.actuation
        strength = SATURATED * actuation.drawn["strength"] - actuation.spec.torque_noise
        self.add_instant(self._env.now, self._env.task.step_progress(), strength, counts)

    def add_instant(
        self,
        now: Now,
        progress: Float[Tensor, " env"] | None,
        strength: Float[Tensor, "env joint"],
        counts: Bool[Tensor, " env"],
    ) -> None:
        """Add an instant."""
        counts = counts.to(now.joint_pos.device)
        force, torque = vector_norm(now.link_force, dim=2).double(), now.torque.double().abs()
        is_untouched = ~((force > TOUCH) & self._fingers).any(dim=1)
        is_saturated = torque >= strength * self._limit
        numbers = {"steps": torch.ones_like(is_untouched), "untouched": is_untouched, "any_saturation": is_saturated.any(dim=1)}
        if progress is not None:
            forth = progress.double().clamp(min=0.0)
            numbers |= {"forth": forth, "coasted": torch.where(is_untouched, forth, 0.0)}
        for name, value in numbers.items():
            self._sums[name] += torch.where(counts, value.double(), 0.0)
        self._saturated += torch.where(counts[:, None], is_saturated.double(), 0.0)
        motion = torch.stack([vector_norm(v.double(), dim=1) for v in (now.object.linvel, now.object.angvel)], dim=1)
        self._most = torch.where(counts[:, None], torch.maximum(self._most, motion), self._most)
        depth = -now.distance.double()
        deepest = depth.amax(dim=1, keepdim=True) if depth.shape[1] else torch.zeros_like(motion[:, :1])
        loads = torch.where(force > TOUCH, force, 0.0)
        self._count(torch.cat([deepest, loads, motion, now.joint_vel.double().abs()], dim=1), counts)

    def _count(self, values: Float[Tensor, "env row"], counts: Bool[Tensor, " env"]) -> None:
        """Add values to the histograms, but depths and forces of 0, which are of no contact."""
        is_moving = torch.arange(values.shape[1], device=values.device) >= self._rows["speed"].start
        is_counted = counts[:, None] & ((values > 0) | is_moving) & values.isfinite()
        place = (values.clamp(min=LEAST) / LEAST).log().div(WIDTH).nan_to_num(0.0).clamp(max=NUM_BINS - 1).to(torch.int64)
        self._counts.view(-1).scatter_add_(0, self._first + place.flatten(), is_counted.flatten().to(torch.int64))

    def gaits(self) -> list[Gait]:
        """Return how the policy of each block moves its object."""
        blocks = self._blocks
        sums = {name: value.view(blocks, -1).sum(dim=1).tolist() for name, value in self._sums.items()}
        saturated = self._saturated.view(blocks, -1, len(self._joints)).sum(dim=1).tolist()
        most, counts = self._most.view(blocks, -1, 2).amax(dim=1).tolist(), self._counts.cpu()
        return [
            self._gait({name: value[i] for name, value in sums.items()}, saturated[i], most[i], counts[i])
            for i in range(blocks)
        ]

    def _gait(self, sums: dict[str, float], saturated: list[float], most: list[float], counts: Tensor) -> Gait:
        steps, limits, rated = sums["steps"], self._limit.tolist(), self._rated.tolist()
        parts = {name: counts[rows] for name, rows in self._rows.items()}
        has_limits, has_fingers = any(map(math.isfinite, limits)) and steps > 0, bool(self._fingers.any()) and steps > 0
        shares = {
            name: share / steps
            for name, share, limit in zip(self._joints, saturated, limits, strict=True)
            if steps and math.isfinite(limit)
        }
        rates = {name: speed for name, speed in zip(self._joints, rated, strict=True) if math.isfinite(speed)}
        speeds = _percentiles(self._joints, parts["joint_speed"])
        ratios = [speeds[name] / speed for name, speed in rates.items() if name in speeds]
        return Gait(
            coasting=sums["coasted"] / sums["forth"] if sums["forth"] and has_fingers else None,
            untouched=sums["untouched"] / steps if has_fingers else None,
            saturation=max(shares.values(), default=None),
            any_saturation=sums["any_saturation"] / steps if has_limits else None,
            penetration=percentile(parts["penetration"][0]),
            force=percentile(parts["force"].sum(dim=0)),
            speed=percentile(parts["speed"][0]),
            spin=percentile(parts["spin"][0]),
            max_speed=most[0],
            max_spin=most[1],
            joint_speed=max(ratios, default=None),
            saturations=shares,
            link_forces=_percentiles(self._links, parts["force"]),
            joint_speeds=speeds,
            rated_speeds=rates,
        )


def percentile(counts: Tensor, share: float = PERCENTILE) -> float | None:
    """Return the middle of the bin below whose upper end a share of all values lies; None if there are none."""
    total = int(counts.sum())
    if not total:
        return None
    place = int(torch.searchsorted(counts.cumsum(dim=0), math.ceil(share * total)))
    return LEAST * math.exp((place + 0.5) * WIDTH) if place else 0.0


def _percentiles(names: Sequence[str], counts: Tensor) -> dict[str, float]:
    result = {name: percentile(row) for name, row in zip(names, counts, strict=True)}
    return {name: value for name, value in result.items() if value is not None}
