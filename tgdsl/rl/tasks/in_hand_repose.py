"""Turn an object on the palm to one orientation after another, with all fingers.

An episode begins with the object upright on the palm, turned about the vertical by any angle. The first goal is a rotation by
α = `goal_step` from there about a random axis. Each later goal is such a rotation of the previous goal, so errors do not
accumulate. With q the object's orientation, g_k goal k, a_k its unit axis in the world, and p and p_0 the object's position now
and at the start,

    g_0 = rot(a_0, α) q_0,   g_{k+1} = rot(a_{k+1}, α) g_k                goals
    φ   = angle(g_k q⁻¹)                                                   angle to the goal, from 0 to π [rad]
    k ← k + 1  where φ < ε for `goal_hold` control steps in a row          goal reached

a_k is uniform on the sphere (`goal_axis: any`), or the vertical, up or down (`vertical`). With `goal_axis: xy` the previous
goal is turned about the world's x and then its y, each by an angle uniform within ± α. Boxes and cylinders look alike from
several sides, but a goal is a single orientation. The default is the vertical, as the hand reaches little else: a planner that
knows the physics (`benchmarks/reachable_goals.py`, the XHand1, few episodes) reaches 0, 6 and 17 goals in a row about it, and
0 to 5 about any axis.

Groups: `goal` holds six numbers of the goal's orientation in the world and φ [rad]; the document's `goal` may list other parts.
`priv_obj_state` and `priv_obj_props` as in `groups`.

Weights of the reward's terms are the paper's. φ' and φ are the angles to the step's goal at the start and at the end of the
control step.

An episode terminates where the object is further than `drop_distance` from p_0, or below it, or where a goal is not reached
within `goal_timeout`, a time or a range to draw from for each goal; future rewards are then lost. Score: goals in a row, k.

Turning the wrong way does not pay: it lowers both tracking terms, and costs in `progress` at least as much as the way back
pays, as losses are not clipped. Nor does waiting near a goal: at φ = ε tracking pays 13.8 until the timeout, which costs 5,
while `success` pays 12.5 at once.

Source: Chung et al., *Tactile Genesis*, appendix, "Tasks and Hands", "Reward terms". The paper prints weights and names;
formulas, Δt as a factor of all terms, goals and how they are reached, α, ε, σ, φ_0, ω_max, λ and f_max are ours. Its text also
mentions penalties of grip and slip, which are missing in its table and here.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float, Int
from pydantic import model_validator
from torch import Tensor

from tgdsl.fields.models import Angle, PositiveLength, Range, RangeOf, with_defaults
from tgdsl.rl import groups, rotations, terms
from tgdsl.rl.draws import within
from tgdsl.rl.spec import Whole
from tgdsl.rl.students.spec import DistillSpec
from tgdsl.rl.task import Now, Setup, Start, reward_term
from tgdsl.rl.tasks.parts import PlacedTaskSpec, ProgressSpec
from tgdsl.rl.train.spec import TrainSpec
from tgdsl.tensors.env_ids import may_be_nonempty, put_rows


class Train(with_defaults(TrainSpec, iterations=20000)):
    """Training of a policy; the paper's numbers for this task."""


class Distill(with_defaults(DistillSpec, max_grad_norm=None)):
    """Training of students; the paper's numbers for this task."""


class InHandReposeSpec(PlacedTaskSpec, ProgressSpec):
    """Turn an object in the hand to one orientation after another."""

    train: Train = Train()
    """Training of a policy: `tgdsl train`."""
    distill: Distill = Distill()
    """Training of students from a trained policy: `tgdsl distill`."""
    goal_step: Angle = 0.4
    """α: angle between consecutive goals [rad]."""
    goal_axis: Literal["any", "vertical", "xy"] = "vertical"
    """Axis of a goal's rotation: any; the vertical, either way; or the world's x and then its y, each by up to ± α."""
    goal_tolerance: Angle = 0.1
    """ε: angle to a goal below which it is reached [rad]."""
    goal_hold: Whole = 4
    """Number of consecutive control steps within ε before a goal is reached."""
    goal_timeout: Annotated[Range, RangeOf("time", gt=0.0)] = (5.0, 5.0)
    """Time limit of a goal, after which the episode terminates, drawn for each goal [s]."""
    track_width: Angle = 0.2
    """σ, width of `track_gaussian` [rad]."""
    track_half: Angle = 0.1
    """φ_0, angle at which `track_inverse` is half its maximum [rad]."""
    drop_distance: PositiveLength = 0.08
    """Distance from its start (or below it: `drop_measure`) beyond which the object is lost [m]."""

    @model_validator(mode="after")
    def _within_reach(self) -> InHandReposeSpec:
        control_step = self.physics.timestep * self.physics.substeps
        if not self.goal_tolerance < self.goal_step <= math.pi:
            expected = f"more than goal_tolerance, {self.goal_tolerance:g} rad, and at most a half turn"
            raise ValueError(f"goal_step is {self.goal_step:g} rad, expected {expected}")
        if self.goal_hold * control_step > self.goal_timeout[0]:
            problem = f"goal_hold, {self.goal_hold} control steps of {control_step:g} s, takes longer than goal_timeout"
            raise ValueError(f"{problem}, {self.goal_timeout[0]:g} s: no goal could be reached in time")
        return self


class InHandRepose(terms.HandTask[InHandReposeSpec]):
    """The task."""

    Spec = InHandReposeSpec
    senses = ("link_contact", "surface_distance")
    constants = ("goal_step",)
    score_unit = "goals in a row"
    score_range = (0, math.inf)
    own_groups = ("goal", "priv_obj_state", "priv_obj_props")

    @reward_term(500.0, "1/s")
    def success(self, now: Now) -> Bool[Tensor, " env"]:
        """Goal reached in this step."""
        return self.is_reached

    @reward_term(2.0, "1/s")
    def track_gaussian(self, now: Now) -> Float[Tensor, " env"]:
        """Orientation near the goal, exp(−φ²/(2 σ²))."""
        return torch.exp(-0.5 * (self.error / self.spec.track_width).square())

    @reward_term(2.0, "1/s")
    def track_inverse(self, now: Now) -> Float[Tensor, " env"]:
        """Orientation near the goal, 1/(1 + (φ/φ_0)²)."""
        return 1.0 / (1.0 + (self.error / self.spec.track_half).square())

    @reward_term(0.2, "1/rad")
    def progress(self, now: Now) -> Float[Tensor, " env"]:
        """Rate at which the angle to the goal decreases, min((φ' − φ)/Δt, ω_max)."""
        return self.spec.pay(self.rate)

    near = terms.Near.of_task(0.5, width="near_width")
    contact_force = terms.ContactForce.of_task(-5.0, max_force="max_force")

    @reward_term(-100.0, "1/s")
    def drop(self, now: Now) -> Bool[Tensor, " env"]:
        """Object dropped in this step."""
        return self.spec.drop_extent(now.object.pos - self.start_pos) > self.spec.drop_distance

    @reward_term(-200.0, "1/s")
    def goal_timeout(self, now: Now) -> Bool[Tensor, " env"]:
        """Goal not reached in time."""
        return self.is_late

    action_rate = terms.ActionRate.of_task(-1e-5)
    joint_limit = terms.JointLimit.of_task(-20.0)
    work = terms.Work.of_task(-1e-3)

    def __init__(self, spec: InHandReposeSpec, setup: Setup):
        super().__init__(spec, setup)
        self.item = setup.free_qpos()
        self.up = torch.tensor([0.0, 0.0, 1.0], dtype=setup.dtype, device=setup.device).expand(setup.num_envs, 3)
        self.step = torch.full((setup.num_envs,), spec.goal_step, dtype=setup.dtype, device=setup.device)
        self.start_pos, self.goal = self.keep("start_pos", 3), self.keep("goal", 4)
        self.error, self.rate = self.keep("error"), self.keep("rate")  # φ of the last step's goal, and its rate of decrease
        self.left = self.keep("left")  # φ of the present goal
        self.episode, self.reached = self.keep("episode", dtype=torch.int64), self.keep("reached", dtype=torch.int64)
        self.held, self.waited = self.keep("held", dtype=torch.int64), self.keep("waited", dtype=torch.int64)
        self.is_reached, self.is_late = self.keep("is_reached", dtype=torch.bool), self.keep("is_late", dtype=torch.bool)
        self.parts = {
            "goal": [groups.goal(spec.goal, setup.object, lambda: self.goal)],
            "priv_obj_state": [groups.object_state(setup)],
            "priv_obj_props": [groups.object_props(setup), groups.distances(setup)],
        }

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> Start:
        """Place objects upright on the palm, moved and turned at random, and draw their first goals."""
        pos, quat = self.setup.start[:, self.item].split([3, 4], dim=1)
        for buffer in (self.reached, self.held, self.waited, self.is_reached, self.is_late):
            buffer.masked_fill_(chosen, 0)
        self.begin(chosen, start_pos=pos, episode=episode)
        goal = self._goal_after(quat)
        left = rotations.between(goal, quat)
        self.begin(chosen, goal=goal, left=left, error=left, rate=0.0)
        return Start({"qpos": self.setup.start})

    def advance(self, now: Now) -> None:
        """Measure the angle to the goal, and draw the next goal where it is reached."""
        spec, quat = self.spec, now.object.quat
        error = rotations.between(self.goal, quat)
        self.rate.copy_(((self.left - error) / self.setup.control_step).clamp(max=spec.max_spin))
        self.error.copy_(error)
        self.held.copy_(torch.where(error < spec.goal_tolerance, self.held + 1, 0))
        self.waited += 1
        self.is_reached.copy_(self.held >= spec.goal_hold)
        self.is_late.copy_((self.waited >= self._most_steps()) & ~self.is_reached)
        self.reached += self.is_reached
        for count in (self.held, self.waited):
            count.masked_fill_(self.is_reached, 0)
        self.left.copy_(error)
        if may_be_nonempty(self.is_reached):
            put_rows(self.goal, self.is_reached, self._goal_after(self.goal))
            self.left.copy_(rotations.between(self.goal, quat))

    def is_over(self, now: Now) -> Bool[Tensor, " env"]:
        """Return where the object was dropped or the goal was not reached in time."""
        return self.drop(now) | self.is_late

    def step_progress(self) -> Float[Tensor, " env"]:
        """Return the decrease of the angle to the goal in this control step [rad]."""
        return self.rate * self.setup.control_step

    def score(self) -> Float[Tensor, " env"]:
        """Return how many goals were reached."""
        return self.reached.to(self.setup.dtype)

    def _goal_after(self, quat: Float[Tensor, "env 4"]) -> Float[Tensor, "env 4"]:
        """Return orientations turned by a goal's step, drawn for goal number `reached`."""
        draws, count = self.setup.draws, self._goal_count()
        if self.spec.goal_axis == "xy":
            angles = draws.uniform("goal angles", count, 2, -self.spec.goal_step, self.spec.goal_step).to(quat.dtype)
            x, y, _ = torch.eye(3, dtype=quat.dtype, device=quat.device)
            turns = [rotations.about(axis.expand(len(quat), 3), angle) for axis, angle in zip((x, y), angles.T, strict=True)]
        elif self.spec.goal_axis == "vertical":
            side = draws.integers("goal side", count, 1, 0, 1).to(quat.dtype)
            turns = [rotations.about((2.0 * side - 1.0) * self.up, self.step)]
        else:
            axis = draws.normal("goal axis", count, 3).to(quat.dtype)
            turns = [rotations.about(axis / axis.norm(dim=1, keepdim=True), self.step)]
        for turn in turns:
            quat = rotations.product(turn, quat)
        return quat / quat.norm(dim=1, keepdim=True)

    def _goal_count(self) -> Int[Tensor, " env"]:
        return (self.episode << 32) | self.reached

    def _most_steps(self) -> Int[Tensor, " env"] | int:
        low, high = self.spec.goal_timeout
        if low == high:
            return round(low / self.setup.control_step)
        share = self.setup.draws.shares({"goal timeout": 1}, self._goal_count())["goal timeout"][:, 0]
        return (within(share, low, high) / self.setup.control_step).round().to(torch.int64)
