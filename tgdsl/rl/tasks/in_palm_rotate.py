"""Turn an object that lies on the palm about the vertical, with some of the fingers, one quarter turn after another.

An episode begins with the object upright near the middle of the palm. The goal is a quarter turn further about the vertical n,
and each time that it is reached, another one. With q the object's orientation, q_0 that at the start, p and p_0 its positions,
and n up for `direction: counterclockwise`, down for `clockwise`, as seen from above,

    ψ_t = ψ_{t−1} + twist_n(q_t q_{t−1}⁻¹)                      angle turned so far [rad]
    θ   = swing_n(q q_0⁻¹)                                      tilt [rad]
    g   = (k + 1) π/2                                           goal; k goals were reached, k ← k + 1 where g − ψ < ε, θ < θ_max

Groups: `goal` holds six numbers of the goal's orientation, rot_n(g) q_0, and the angle from there to q [rad], by which whoever
sees it knows the object's exact angle; `priv_obj_state` and `priv_obj_props` as in `groups`.

The reward is the sum of these terms times Δt; weights are the paper's.

    success            w · s (goal reached in this step)                         150 1/s
    spin               w · c min(Δψ/Δt, ω_max); w · Δψ/Δt where Δψ < 0           2 1/rad
    near               w · mean_p exp(−max(0, d_p)/λ)                            0.1 1/s
    tilt               w · θ                                                     −1 1/(rad s)
    object_distance    w · max(0, |p − p_0| − r)                                 −100 1/(m s)
    contact_force      w · Σ_l max(0, |f_l| − f_max)/f_max                       −5 1/s
    drop               w · (dropped in this step)                                −100 1/s
    action_rate        w · |a_t − a_{t−1}|²                                      −5e-4 1/s
    joint_limit        w · Σ_j max(0, |q_j − m_j| − 0.95 h_j)                    −40 1/(rad s)
    work               w · Σ_j |τ_j q̇_j|                                         −5e-3 1/J
    effort             w · Σ_j (τ_j/τ_max,j)²                                    0 1/s
    object_speed       w · (max(0, |v|/v_free − 1) + max(0, |ω|/ω_free − 1))     0 1/s

with c = 1 where the object is held, else `hold.coasting_pay`: see `holding`; and s the share of Σ max(0, Δψ) since the goal
before that was paid, Σ c max(0, Δψ) over it. By default c = s = 1: whether an object is held or coasts makes no difference.

An episode ends for good where the object is further than `drop_distance` from p_0. Score: quarter turns, k.

Source: Chung et al., *Tactile Genesis*, appendix, "Tasks and Hands", "Reward terms". The paper prints weights and names;
formulas, Δt as a factor of all terms, goal, ε, θ_max, ω_max, λ, r and f_max are ours, and so are `effort`, `object_speed`, c
and s. Turning back costs what turning forth has paid, however fast, as `spin` is bounded above alone, and no less for an object
that coasts; goals that were reached stay reached.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.fields.models import Angle, PositiveLength, Quantity, SpecModel
from tgdsl.rl import groups, rotations, terms
from tgdsl.rl.spec import PlacedRandomSpec, TaskSpec, Weight
from tgdsl.rl.students.spec import DecoderSpec, DistillSpec
from tgdsl.rl.task import Now, Setup, Start, Task
from tgdsl.rl.tasks import holding
from tgdsl.rl.tasks.holding import Holding, HoldSpec
from tgdsl.rl.tasks.placing import placed

QUARTER = 0.5 * math.pi


class Rewards(SpecModel):
    """Weights of the reward's terms; 0 leaves one out."""

    success: Weight = 150.0
    """Goal reached [1/s]."""
    spin: Weight = 2.0
    """Angular velocity about the vertical, the right way [1/rad]."""
    near: Weight = 0.1
    """How near fingers are to the object [1/s]."""
    tilt: Weight = -1.0
    """Tilt of the object [1/(rad s)]."""
    object_distance: Weight = -100.0
    """Distance of the object from where it started, beyond `free_distance` [1/(m s)]."""
    contact_force: Weight = -5.0
    """Force on links beyond `max_force` [1/s]."""
    drop: Weight = -100.0
    """Object dropped [1/s]."""
    action_rate: Weight = -5e-4
    """Change of the action [1/s]."""
    joint_limit: Weight = -40.0
    """Joints near the ends of their ranges [1/(rad s)]."""
    work: Weight = -5e-3
    """Power of the drives [1/J]."""
    effort: Weight = 0.0
    """Squares of the torques, as shares of the largest ones [1/s]."""
    object_speed: Weight = 0.0
    """Speed and spin of the object beyond `free_speed` and `free_spin`, as shares of these [1/s]."""


class Distill(DistillSpec):
    """How students are taught; the paper's numbers for this task."""

    decoders: dict[str, DecoderSpec] = {"object_size": DecoderSpec(scale=20.0), "goal_distance": DecoderSpec()}
    """Heads by the privileged number that they tell: the object's height [m], and its angle to the goal [rad]."""


class InPalmRotateSpec(TaskSpec):
    """Turn an object on the palm about the vertical."""

    distill: Distill = Distill()
    """How students are taught by a policy that is there: `tgdsl distill`."""

    randomise: PlacedRandomSpec = PlacedRandomSpec()
    """What is random."""
    rewards: Rewards = Rewards()
    """Weights of the reward's terms."""
    direction: Literal["counterclockwise", "clockwise"] = "counterclockwise"
    """Which way the object is to turn, seen from above."""
    goal_tolerance: Angle = 0.1
    """ε: a goal is reached this close to it [rad]."""
    max_tilt: Angle = 0.4
    """θ_max: no goal is reached with a larger tilt [rad]."""
    max_spin: Annotated[float, Quantity("number", gt=0.0)] = 4.0
    """ω_max: what is faster pays no more [rad/s]."""
    near_width: PositiveLength = 0.02
    """λ, decay length of `near` [m]."""
    free_distance: PositiveLength = 0.02
    """r: closer to where it started, the object costs nothing [m]."""
    drop_distance: PositiveLength = 0.07
    """Further from where it started, the object is lost [m]."""
    max_force: Annotated[float, Quantity("force", gt=0.0)] = 10.0
    """f_max: less force on a link costs nothing [N]."""
    hold: HoldSpec = HoldSpec()
    """What progress pays while the object coasts; by default as much as while it is held."""
    free_speed: Annotated[float, Quantity("speed", gt=0.0)] = 0.2
    """v_free: a slower object costs nothing [m/s]."""
    free_spin: Annotated[float, Quantity("number", gt=0.0)] = 4.0
    """ω_free: the same of its angular velocity, about whatever axis [rad/s]."""


def reference(spec: InPalmRotateSpec, record: Mapping[str, np.ndarray], dt: float) -> dict[str, np.ndarray]:
    """Return the terms of the reward [1/s], `is_over` and `score` at each step of one environment, in float64.

    Args:
        spec: The task's document.
        record: One row per instant, the first that at the start: `pos` [m], `quat`, `joint_pos` [rad], `joint_vel` [rad/s],
            `torque` [N·m], `action`, `link_force` (step, link, 3) [N], `distance` [m], `linvel` [m/s], `angvel` [rad/s]; and
            `low`, `high`, limits [rad], `limit`, largest torques [N·m], `fingers`, which links are fingers.
        dt: Δt [s].
    """
    weights, way = spec.rewards, _way(spec)
    pos, quat, low, high = record["pos"], record["quat"], record["low"], record["high"]
    angle, reached, forth, paid, rows = 0.0, 0, 0.0, 0.0, []
    limit, fingers = record["limit"], record["fingers"]
    for t in range(1, len(pos)):
        w, x, y, z = _quat_product(quat[t], quat[t - 1] * [1, -1, -1, -1])
        step = 2.0 * way * math.atan2(z if w >= 0 else -z, abs(w))
        angle += step
        w, x, y, z = _quat_product(quat[t], quat[0] * [1, -1, -1, -1])
        tilt = math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))
        is_reached = (reached + 1) * QUARTER - angle < spec.goal_tolerance and tilt < spec.max_tilt
        reached += is_reached
        pay = holding.reference(spec.hold, record["link_force"][t], fingers)
        forth, paid = forth + max(0.0, step), paid + pay * max(0.0, step)
        share = paid / forth if forth else 1.0
        forth, paid = (0.0, 0.0) if is_reached else (forth, paid)
        speed, spin = (np.linalg.norm(record[name][t]) for name in ("linvel", "angvel"))
        distance, force = np.linalg.norm(pos[t] - pos[0]), np.linalg.norm(record["link_force"][t], axis=1)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        is_over = distance > spec.drop_distance
        row = {
            "success": weights.success * is_reached * share,
            "spin": weights.spin * min(step / dt, spec.max_spin) * (pay if step > 0 else 1.0),
            "near": weights.near * np.mean(np.exp(-np.maximum(record["distance"][t], 0.0) / spec.near_width)),
            "tilt": weights.tilt * tilt,
            "object_distance": weights.object_distance * max(0.0, distance - spec.free_distance),
            "contact_force": weights.contact_force * sum(max(0.0, f - spec.max_force) / spec.max_force for f in force),
            "drop": weights.drop * is_over,
            "action_rate": weights.action_rate * np.sum((record["action"][t] - record["action"][t - 1]) ** 2),
            "joint_limit": weights.joint_limit * np.sum(np.maximum(abs(record["joint_pos"][t] - middle) - 0.95 * half, 0.0)),
            "work": weights.work * np.sum(np.abs(record["torque"][t] * record["joint_vel"][t])),
            "effort": weights.effort * np.sum((record["torque"][t] / limit) ** 2),
            "object_speed": weights.object_speed
            * (max(0.0, speed / spec.free_speed - 1) + max(0.0, spin / spec.free_spin - 1)),
        }
        rows.append(row | {"is_over": is_over, "score": reached})
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _way(spec: InPalmRotateSpec) -> float:
    """Return the axis' component along the vertical."""
    return 1.0 if spec.direction == "counterclockwise" else -1.0


def _quat_product(left: np.ndarray, right: np.ndarray) -> Any:
    (a, *v), (b, *u) = left, right
    return np.concatenate([[a * b - np.dot(v, u)], a * np.array(u) + b * np.array(v) + np.cross(v, u)])


class InPalmRotate(Task[InPalmRotateSpec]):
    """The task."""

    Spec = InPalmRotateSpec
    senses = ("link_contact", "surface_distance")
    score_unit = "quarter turns"

    def __init__(self, spec: InPalmRotateSpec, setup: Setup):
        """Begin with all objects where the keyframe has them."""
        super().__init__(spec, setup)
        self.axis = torch.tensor([0.0, 0.0, _way(spec)], dtype=setup.dtype, device=setup.device).expand(setup.num_envs, 3)
        self.holding = Holding(spec.hold, setup)
        self.start_pos, self.start_quat = self.keep("start_pos", 3), self.keep("start_quat", 4)
        self.quat = self.keep("quat", 4)
        self.angle, self.rate, self.tilt = self.keep("angle"), self.keep("rate"), self.keep("tilt")
        self.reached, self.is_reached = self.keep("reached"), self.keep("is_reached", dtype=torch.bool)
        self.pay, self.share = self.keep("pay"), self.keep("share")  # c of this step, and s of the goal that is under way
        self.forth, self.paid = self.keep("forth"), self.keep("paid")  # Σ max(0, Δψ) and Σ c max(0, Δψ) since the goal before

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> Start:
        """Put objects upright on the palm, moved and turned at random."""
        qpos, pos, quat = placed(self.setup, self.spec.randomise, chosen, episode)
        self.begin(chosen, start_pos=pos, start_quat=quat, quat=quat, angle=0.0, rate=0.0, tilt=0.0, reached=0.0)
        self.begin(chosen, is_reached=0.0, pay=1.0, share=1.0, forth=0.0, paid=0.0)
        return Start({"qpos": qpos})

    def advance(self, now: Now) -> None:
        """Add up what the object has turned, and give it another goal where it has reached one."""
        quat = now.object.quat
        since = rotations.product(quat.expand(2, -1, -1), rotations.inverse(torch.stack([self.quat, self.start_quat])))
        step = rotations.twist(since[0], self.axis)
        self.angle += step
        self.rate.copy_(step / self.setup.control_step)
        self.tilt.copy_(rotations.swing(since[1], self.axis))
        self.is_reached.copy_((self._goal() - self.angle < self.spec.goal_tolerance) & (self.tilt < self.spec.max_tilt))
        self.reached += self.is_reached
        self.quat.copy_(quat)
        if self.spec.hold.coasting_pay < 1.0:
            self._note_pay(now, step)

    def _note_pay(self, now: Now, step: Float[Tensor, " env"]) -> None:
        """Note what progress pays now, and which share of it was paid since the goal before."""
        forth = step.clamp(min=0.0)
        self.pay.copy_(self.holding.pay(now))
        self.forth += forth
        self.paid += self.pay * forth
        self.share.copy_(torch.where(self.forth > 0, self.paid / self.forth, 1.0))
        for total in (self.forth, self.paid):
            total.masked_fill_(self.is_reached, 0.0)

    def is_over(self, now: Now) -> Bool[Tensor, " env"]:
        """Return where the object was dropped."""
        return vector_norm(now.object.pos - self.start_pos, dim=1) > self.spec.drop_distance

    def reward(self, now: Now, is_over: Bool[Tensor, " env"]) -> dict[str, Float[Tensor, " env"]]:
        """Return the terms of the reward: see the top of this page."""
        spec, weights = self.spec, self.spec.rewards
        distance = vector_norm(now.object.pos - self.start_pos, dim=1)
        return {
            "success": weights.success * self.is_reached * self.share,
            "spin": weights.spin * self.rate.clamp(max=spec.max_spin) * torch.where(self.rate > 0, self.pay, 1.0),
            "near": weights.near * terms.near(now, spec.near_width),
            "tilt": weights.tilt * self.tilt,
            "object_distance": weights.object_distance * (distance - spec.free_distance).clamp(min=0.0),
            "contact_force": weights.contact_force * terms.contact_force(now, spec.max_force),
            "drop": weights.drop * (distance > spec.drop_distance),
            "action_rate": weights.action_rate * terms.action_rate(now),
            "joint_limit": weights.joint_limit * terms.joint_limit(now, self.setup),
            "work": weights.work * terms.work(now),
            "effort": weights.effort * terms.effort(now, self.setup),
            "object_speed": weights.object_speed * terms.object_speed(now, spec.free_speed, spec.free_spin),
        }

    def step_progress(self) -> Float[Tensor, " env"]:
        """Return the angle that the object has turned in this control step [rad]."""
        return self.rate * self.setup.control_step

    def observe(self, now: Now) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the goal, and what is privileged of the object."""
        goal = rotations.product(rotations.about(self.axis, self._goal()), self.start_quat)
        error = rotations.between(goal, now.object.quat)
        return {
            "goal": torch.cat([rotations.six_numbers(goal), error[:, None]], dim=1),
            "priv_obj_state": groups.object_state(now),
            "priv_obj_props": groups.object_props(now),
        }

    def decoded(self, now: Now) -> dict[str, Float[Tensor, " env"]]:
        """Return the object's height when it stands upright [m], and the angle from the goal to its orientation [rad]."""
        return {"object_size": 2.0 * self.setup.half_height, "goal_distance": self.observe(now)["goal"][:, -1]}

    def score(self) -> Float[Tensor, " env"]:
        """Return how many quarter turns were reached."""
        return self.reached

    def _goal(self) -> Float[Tensor, " env"]:
        """Return the angle of the next goal [rad]."""
        return (self.reached + 1.0) * QUARTER
