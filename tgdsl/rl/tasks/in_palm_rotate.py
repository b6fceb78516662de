"""Turn an object that lies on the palm about the vertical, with some of the fingers, one quarter turn after another.

An episode begins with the object upright near the middle of the palm. Each goal is a quarter turn about the vertical n from
the previous one. With q the object's orientation, q_0 its start, p and p_0 its positions, and n up for
`direction: counterclockwise`, down for `clockwise`, as seen from above,

    ψ_t = ψ_{t−1} + twist_n(q_t q_{t−1}⁻¹)                      angle turned so far [rad]
    θ   = swing_n(q q_0⁻¹)                                      tilt [rad]
    g   = (k + 1) π/2                                           goal; k goals were reached, k ← k + 1 where g − ψ < ε, θ < θ_max

Groups: `goal` holds six numbers of the goal's orientation, rot_n(g) q_0, and the angle from there to q [rad], which reveals the
object's exact angle; the document's `goal` may list other parts. `priv_obj_state` and `priv_obj_props` as in `groups`.

Weights of the reward's terms are the paper's. Progress pays c, 1 where the object is held, else `hold.coasting_pay`: see
`parts`. s is Σ c max(0, Δψ) over Σ max(0, Δψ) since the previous goal. By default c = s = 1: coasting pays as much as holding.

`spin` pays a bounded rate, see `parts`, and only up to a tilt of `spin_tilt`.

An episode terminates where the object is further than `drop_distance` from p_0, or below it. Score: quarter turns, k.

Source: Chung et al., *Tactile Genesis*, appendix, "Tasks and Hands", "Reward terms". The paper prints weights and names;
formulas, Δt as a factor of all terms, goal, ε, θ_max, ω_max, λ, r and f_max are ours, and so are `effort`, `object_speed`, c
and s. Turning back costs as much as turning forward pays, at any speed, as `spin` is bounded above alone; coasting back costs
no less. Reached goals stay reached.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.fields.models import Angle, PositiveLength
from tgdsl.rl import groups, rotations, terms
from tgdsl.rl.students.spec import DecoderSpec, DistillSpec
from tgdsl.rl.task import Now, Setup, Start, reward_term
from tgdsl.rl.tasks.parts import Holding, HoldSpec, PlacedTaskSpec, ProgressSpec

QUARTER = 0.5 * math.pi


class Distill(DistillSpec):
    """Training of students; the paper's numbers for this task."""

    decoders: dict[str, DecoderSpec] = {"object_size": DecoderSpec(scale=20.0), "goal_distance": DecoderSpec()}
    """Heads by the privileged number that they predict: the object's height [m], and its angle to the goal [rad]."""


class InPalmRotateSpec(PlacedTaskSpec, ProgressSpec):
    """Turn an object on the palm about the vertical."""

    distill: Distill = Distill()
    """Training of students from a trained policy: `tgdsl distill`."""

    direction: Literal["counterclockwise", "clockwise"] = "counterclockwise"
    """Direction of rotation, seen from above."""
    goal_tolerance: Angle = 0.1
    """ε: angle to a goal below which it is reached [rad]."""
    max_tilt: Angle = 0.4
    """θ_max: largest tilt at which a goal is reached [rad]."""
    spin_tilt: Angle | None = None
    """Tilt above which `spin` is 0 [rad]; null: no bound."""
    free_distance: PositiveLength = 0.02
    """r: distance from the object's start without a penalty [m]."""
    drop_distance: PositiveLength = 0.07
    """Distance from its start (or below it: `drop_measure`) beyond which the object is lost [m]."""
    hold: HoldSpec = HoldSpec()
    """Reward of progress while the object coasts; by default the same as while it is held."""


class InPalmRotate(terms.HandTask[InPalmRotateSpec]):
    """The task."""

    Spec = InPalmRotateSpec
    senses = ("link_contact", "surface_distance")
    score_unit = "quarter turns"
    own_groups = ("goal", "priv_obj_state", "priv_obj_props")

    @reward_term(150.0, "1/s")
    def success(self, now: Now) -> Float[Tensor, " env"]:
        """Goal reached in this step: s."""
        return self.is_reached * self.share

    @reward_term(2.0, "1/rad")
    def spin(self, now: Now) -> Float[Tensor, " env"]:
        """Angular velocity about n, the right way: c min(Δψ/Δt, ω_max), and Δψ/Δt where Δψ < 0."""
        rate = self.spec.pay(self.rate) * torch.where(self.rate > 0, self.pay, 1.0)
        return rate if self.spec.spin_tilt is None else rate * (self.tilt <= self.spec.spin_tilt)

    near = terms.Near.of_task(0.1, width="near_width")

    @reward_term(-1.0, "1/(rad s)", name="tilt")
    def tilt_angle(self, now: Now) -> Float[Tensor, " env"]:
        """Tilt of the object, θ."""
        return self.tilt

    @reward_term(-100.0, "1/(m s)")
    def object_distance(self, now: Now) -> Float[Tensor, " env"]:
        """Distance of the object from where it started beyond `free_distance`, max(0, |p − p_0| − r)."""
        return (vector_norm(now.object.pos - self.start_pos, dim=1) - self.spec.free_distance).clamp(min=0.0)

    contact_force = terms.ContactForce.of_task(-5.0, max_force="max_force")

    @reward_term(-100.0, "1/s")
    def drop(self, now: Now) -> Float[Tensor, " env"]:
        """Object dropped in this step."""
        return self.is_over(now)

    action_rate = terms.ActionRate.of_task(-5e-4)
    joint_limit = terms.JointLimit.of_task(-40.0)
    work = terms.Work.of_task(-5e-3)
    effort = terms.Effort.of_task(0.0)
    object_speed = terms.ObjectSpeed.of_task(0.0, free_speed="free_speed", free_spin="free_spin")

    def __init__(self, spec: InPalmRotateSpec, setup: Setup):
        super().__init__(spec, setup)
        self.item = setup.free_qpos()
        up = 1.0 if spec.direction == "counterclockwise" else -1.0
        self.axis = torch.tensor([0.0, 0.0, up], dtype=setup.dtype, device=setup.device).expand(setup.num_envs, 3)
        self.holding = Holding(spec.hold, setup)
        self.start_pos, self.start_quat = self.keep("start_pos", 3), self.keep("start_quat", 4)
        self.quat = self.keep("quat", 4)
        self.angle, self.rate, self.tilt = self.keep("angle"), self.keep("rate"), self.keep("tilt")
        self.reached, self.is_reached = self.keep("reached"), self.keep("is_reached", dtype=torch.bool)
        self.pay, self.share = self.keep("pay"), self.keep("share")  # c of this step, and s of the goal that is under way
        self.forth, self.paid = self.keep("forth"), self.keep("paid")  # Σ max(0, Δψ) and Σ c max(0, Δψ) since the goal before
        self.parts = {
            "goal": [groups.goal(spec.goal, setup.object, self._goal_quat)],
            "priv_obj_state": [groups.object_state(setup)],
            "priv_obj_props": [
                groups.object_props(setup),
                *([groups.distances(setup)] if "surface_distance" in setup.rows else []),
            ],
        }

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> Start:
        pos, quat = self.setup.start[:, self.item].split([3, 4], dim=1)
        self.begin(chosen, start_pos=pos, start_quat=quat, quat=quat, angle=0.0, rate=0.0, tilt=0.0, reached=0.0)
        self.begin(chosen, is_reached=0.0, pay=1.0, share=1.0, forth=0.0, paid=0.0)
        return Start({"qpos": self.setup.start})

    def advance(self, now: Now) -> None:
        """Accumulate the object's rotation, and set the next goal where one is reached."""
        quat = now.object.quat
        since = rotations.product(quat.expand(2, -1, -1), rotations.inverse(torch.stack([self.quat, self.start_quat])))
        step = rotations.twist(since[0], self.axis)
        self.angle += step
        self.rate.copy_(step / self.setup.control_step)
        self.tilt.copy_(rotations.swing(since[1], self.axis))
        self.is_reached.copy_((self._goal() - self.angle < self.spec.goal_tolerance) & (self.tilt < self.spec.max_tilt))
        self.reached += self.is_reached
        self.quat.copy_(quat)
        if not self.holding.pays_in_full:
            self._note_pay(now, step)

    def _note_pay(self, now: Now, step: Float[Tensor, " env"]) -> None:
        forth = step.clamp(min=0.0)
        self.pay.copy_(self.holding.pay(now))
        self.forth += forth
        self.paid += self.pay * forth
        self.share.copy_(torch.where(self.forth > 0, self.paid / self.forth, 1.0))
        for total in (self.forth, self.paid):
            total.masked_fill_(self.is_reached, 0.0)

    def is_over(self, now: Now) -> Bool[Tensor, " env"]:
        """Return where the object was dropped."""
        return self.spec.drop_extent(now.object.pos - self.start_pos) > self.spec.drop_distance

    def step_progress(self) -> Float[Tensor, " env"]:
        """Return the angle that the object has turned in this control step [rad]."""
        return self.rate * self.setup.control_step

    def decoded(self, now: Now) -> dict[str, Float[Tensor, " env"]]:
        """Return the object's height when it stands upright [m], and the angle from the goal to its orientation [rad]."""
        distance = rotations.between(self._goal_quat(), now.object.quat)
        return {"object_size": 2.0 * self.setup.half_height, "goal_distance": distance}

    def score(self) -> Float[Tensor, " env"]:
        """Return how many quarter turns were reached."""
        return self.reached

    def _goal_quat(self) -> rotations.Quat:
        return rotations.product(rotations.about(self.axis, self._goal()), self.start_quat)

    def _goal(self) -> Float[Tensor, " env"]:
        return (self.reached + 1.0) * QUARTER
