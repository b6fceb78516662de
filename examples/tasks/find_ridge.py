"""Slide a fingertip over a plate and stop on a ridge that only touch can find: a task to copy.

An episode begins with the fingertip just above one end of the plate. The ridge is further on, at a uniformly random position.
Let p be the middle of the pad and v its velocity, r the position of the ridge, all across the ridge, and f the ridge's force on
the fingertip. The fingertip

    rests        |p − r| ≤ ε  and  |f| ≥ f_min  and  |v| ≤ v_max

An episode ends when its time is over, and succeeds if the fingertip rests then. This end is terminal: no value follows it.
A policy that knows nothing of the ridge does best at a fixed position, where it rests with a probability of at most
2 ε / (b − a), with r uniform on [a, b]: `chance`.

Groups: `command` has the targets of the joints [rad], the last action and the share of the episode that is left. None of them
depends on the ridge. `priv_ridge` has p − r [m], v [m/s] and |f| [N]. `proprio` has measured joint positions; where they differ
from the targets, something is in the way, so a policy without touch must not see them.

Without touch all positions within [a + ε, b − ε] pay the same, so a policy can learn nothing but chance. Score: whether the
fingertip rests.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.fields.models import Position, PositiveLength, Quantity, Range, RangeOf
from tgdsl.rl import rotations, terms
from tgdsl.rl.spec import RandomSpec, TaskSpec
from tgdsl.rl.task import HandNow, Now, Setup, Start, Task, reward_term
from tgdsl.runtime.simulators.watch import Watch

ACROSS = 1
"""World axis across the ridge."""


class RidgeRandomSpec(RandomSpec):
    """Random values."""

    place: Annotated[Range, RangeOf("length")] = (-0.008, 0.016)
    """a and b: range of the ridge's position along the world's y [m]."""


class FindRidgeSpec(TaskSpec):
    """Stop on a ridge that only touch can find."""

    randomise: RidgeRandomSpec = RidgeRandomSpec()
    """Random values."""
    tip: str = "right_hand_index_rota_link2"
    """The body of the fingertip."""
    pad: Position = (0.009, 0.0, 0.032)
    """The middle of its pad, in its frame [m]."""
    tolerance: PositiveLength = 0.001
    """ε: largest distance of the ridge from the middle of the pad [m]."""
    min_force: Annotated[float, Quantity("force", gt=0.0)] = 0.1
    """f_min: least force of the ridge at rest [N]."""
    max_speed: Annotated[float, Quantity("speed", gt=0.0)] = 0.01
    """v_max: largest speed at rest [m/s]."""


def chance(spec: FindRidgeSpec) -> float:
    """Return the probability with which the best fixed place is on the ridge."""
    low, high = spec.randomise.place
    return min(1.0, 2.0 * spec.tolerance / (high - low)) if high > low else 1.0


def reference(spec: FindRidgeSpec, record: Mapping[str, np.ndarray], dt: float) -> Iterator[dict[str, Any]]:
    """Yield the task's own terms without weights, `is_over` and `score` of each step of one environment, in float64.

    Args:
        spec: The task's document.
        record: One row per instant, the first that at the start: of the fingertip `pos` [m], `quat`, `linvel` [m/s] and
            `angvel` [rad/s]; `place`, where the ridge is [m]; `force`, of the ridge on the fingertip [N].
        dt: Δt [s].
    """
    for t in range(1, len(record["pos"])):
        w, x, y, z = record["quat"][t]
        turned = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        arm = turned @ np.array(spec.pad)
        offset = record["pos"][t][ACROSS] + arm[ACROSS] - record["place"][t]
        speed = (record["linvel"][t] + np.cross(record["angvel"][t], arm))[ACROSS]
        rests = (
            abs(offset) <= spec.tolerance
            and np.linalg.norm(record["force"][t]) >= spec.min_force
            and abs(speed) <= spec.max_speed
        )
        is_over = t >= round(spec.episode / dt)
        yield {"rest": rests, "found": rests and is_over, "is_over": is_over, "score": float(rests)}


def command(now: Now | HandNow, left: Float[Tensor, " env"]) -> Float[Tensor, "env feature"]:
    """Return targets [rad], the last action and the share of the episode that is left."""
    return torch.cat([now.target, now.action, left[:, None]], dim=1)


class FindRidge(Task[FindRidgeSpec]):
    """The task."""

    Spec = FindRidgeSpec
    senses = ("link_contact",)
    score_unit = "found"
    score_range = (0, 1)
    own_groups = ("command", "priv_ridge")
    hand_groups = ("command",)

    @reward_term(1.0, "1/s")
    def rest(self, now: Now) -> Bool[Tensor, " env"]:
        """The fingertip rests on the ridge."""
        return self.rests

    @reward_term(80.0, "1/s")
    def found(self, now: Now) -> Bool[Tensor, " env"]:
        """The fingertip rests on the ridge at the end."""
        return self.rests & self.is_over(now)

    action_rate = terms.ActionRate.of_task(-1e-3)

    def __init__(self, spec: FindRidgeSpec, setup: Setup):
        """Start with the ridge at its position in the scene.

        Raises:
            SimulationError: If the ridge is not a mocap body, and so cannot be moved.
        """
        super().__init__(spec, setup)
        model = setup.model
        self.num_steps = max(1, round(spec.episode / setup.control_step))
        self.ridge = int(model.body(setup.object).mocapid[0])
        if self.ridge < 0:
            raise SimulationError(f'the object\'s body "{setup.object}" is no mocap body: give it mocap="true" in the scene')
        bodies = np.flatnonzero(model.body_mocapid >= 0)[np.argsort(model.body_mocapid[model.body_mocapid >= 0])]
        self.mocap = torch.from_numpy(model.body_pos[bodies]).to(setup.device, setup.dtype)
        self.pad = torch.tensor(spec.pad, dtype=setup.dtype, device=setup.device).expand(setup.num_envs, 3)
        self.elapsed, self.rests = self.keep("elapsed"), self.keep("rests", dtype=torch.bool)

    @classmethod
    def watch(cls, spec: FindRidgeSpec) -> Watch:
        """Watch the fingertip."""
        return Watch(bodies=(spec.tip,))

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> Start:
        """Draw new positions of the ridges."""
        pos = self.mocap.repeat(self.setup.num_envs, 1, 1)
        pos[:, self.ridge, ACROSS] = self.setup.draws.uniform("place", episode, 1, *self.spec.randomise.place)[:, 0].to(pos)
        self.begin(chosen, elapsed=0.0, rests=0.0)
        return Start({"mocap_pos": pos})

    def advance(self, now: Now) -> None:
        """Update whether the fingertip rests on the ridge."""
        offset, speed, force = self._motion(now).unbind(dim=1)
        is_pressed = (force >= self.spec.min_force) & (speed.abs() <= self.spec.max_speed)
        self.rests.copy_(is_pressed & (offset.abs() <= self.spec.tolerance))
        self.elapsed += 1.0

    def is_over(self, now: Now) -> Bool[Tensor, " env"]:
        """Return the environments whose time is over."""
        return self.elapsed >= self.num_steps

    def observe(self, now: Now) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the command, and the privileged state of the ridge."""
        left = 1.0 - self.elapsed / self.num_steps
        return {"command": command(now, left), "priv_ridge": self._motion(now)}

    @classmethod
    def observe_hand(cls, spec: FindRidgeSpec, now: HandNow) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the command."""
        left = 1.0 - now.steps / max(1, round(spec.episode / now.control_step))
        return {"command": command(now, torch.full((len(now.target),), left, dtype=now.target.dtype))}

    def score(self) -> Float[Tensor, " env"]:
        """Return whether the fingertip rests."""
        return self.rests.to(self.setup.dtype)

    def script(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return the actions of a scripted policy for clean `depth` at `low`: slide, then centre the ridge under the pad.

        Three rows of taxels run along the finger. On the plate both outer rows have depth. The ridge lifts the finger, and then
        only the row on its side has depth.
        """
        target, depth = obs["command"][:, :2], obs["tactile_sensors"].view(-1, 3, 3)
        low, _, high = (1e3 * depth.sum(dim=2)).unbind(dim=1)  # [mm]
        is_on_plate, balance = (low > 3.0) & (high > 3.0), low - high
        passed = torch.where(balance < -0.6, 0.5, -0.5)
        bend = torch.where(is_on_plate, passed, (-0.1 * balance).clamp(-0.5, 0.5))
        bend = torch.where(depth.amax(dim=(1, 2)) > 0.0, bend, 0.0)
        press = ((0.225 - target[:, 1]) / float(self.spec.action.scale)).clamp(-1.0, 1.0)
        return torch.stack([bend, press, torch.zeros_like(bend)], dim=1)

    def _motion(self, now: Now) -> Float[Tensor, "env 3"]:
        """Return p − r [m], v [m/s] and |f| [N]."""
        tip = now.watched.body(self.spec.tip)
        arm = rotations.rotated(tip.quat, self.pad)
        offset = (tip.pos + arm - now.object.pos)[:, ACROSS]
        speed = (tip.linvel + torch.linalg.cross(tip.angvel, arm))[:, ACROSS]
        return torch.stack([offset, speed, now.link_force[:, 0].norm(dim=1)], dim=1)
