"""Terms of rewards that tasks share, without their weights.

    action_rate       |a_t − a_{t−1}|²                                                      [1]
    joint_limit       Σ_j max(0, |q_j − m_j| − s h_j)                                       [rad]
    work              Σ_j |τ_j q̇_j|                                                         [W]
    contact_force     Σ_l max(0, |f_l| − f_max) / f_max                                     [1]
    near              mean_p exp(−max(0, d_p) / λ)                                          [1]
    effort            Σ_j (τ_j/τ_max,j)²                                                    [1]
    object_speed      max(0, |v|/v_free − 1) + max(0, |ω|/ω_free − 1)                       [1]

with a the action, q, q̇ and τ positions, velocities and torques of the joints that the policy moves, m and h middle and half
width of their ranges, s the share of these that is free, f_l the object's force on link l, d_p the distance from probe p to the
object, τ_max the largest torques of the drives, v and ω the object's velocity and angular velocity.

Source of the names: Chung et al., *Tactile Genesis*, appendix, "Reward terms", which prints no formulas: these are ours.
`effort` and `object_speed` are ours altogether.

Shapes: `env` environments, `joint` joints, `link` links, `probe` probes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.rl.task import Now

FREE_SHARE = 0.95
"""s, share of a joint's range that costs nothing."""


def action_rate(now: Now) -> Float[Tensor, " env"]:
    """Return |a_t − a_{t−1}|²."""
    return (now.action - now.last_action).square().sum(dim=1)


def joint_limit(now: Now, low: Float[Tensor, " joint"], high: Float[Tensor, " joint"]) -> Float[Tensor, " env"]:
    """Return how far joints are beyond the middle `FREE_SHARE` of their ranges, summed [rad]."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return ((now.joint_pos - middle).abs() - FREE_SHARE * half).clamp(min=0.0).sum(dim=1)


def work(now: Now) -> Float[Tensor, " env"]:
    """Return the power of all drives, that which brakes included [W]."""
    return (now.torque * now.joint_vel).abs().sum(dim=1)


def contact_force(now: Now, most: float) -> Float[Tensor, " env"]:
    """Return by how much the object's force on each link exceeds a limit [N], as a share of it, summed."""
    return ((vector_norm(now.link_force, dim=2) - most).clamp(min=0.0) / most).sum(dim=1)


def near(now: Now, width: float) -> Float[Tensor, " env"]:
    """Return how near the probes are to the object's surface, from 0 to 1, which is touch; `width` λ [m]."""
    return torch.exp(-now.distance.clamp(min=0.0) / width).mean(dim=1)


def effort(now: Now, limit: Float[Tensor, " joint"]) -> Float[Tensor, " env"]:
    """Return the squares of the torques as shares of the largest ones, summed; a drive without a limit makes none."""
    return (now.torque / limit).square().sum(dim=1)


def object_speed(now: Now, free_speed: float, free_spin: float) -> Float[Tensor, " env"]:
    """Return by how much the object is faster than what costs nothing [m/s, rad/s], as shares of that, summed."""
    own, free = (now.object.linvel, now.object.angvel), (free_speed, free_spin)
    speed, spin = ((vector_norm(value, dim=1) / most - 1.0).clamp(min=0.0) for value, most in zip(own, free, strict=True))
    return speed + spin
