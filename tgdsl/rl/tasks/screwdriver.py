"""Spin a screwdriver about its long axis, its tip in a screw: a gait of thumb and fingers.

An episode begins with a sampled grasp: see `tgdsl.rl.grasps`. The right way is clockwise as seen from the handle, which drives
a screw in. With q the object's orientation, a its body's z in the world, from the tip to the handle, n the vertical, p the
position of its body, the handle's middle, p_0 its position in the keyframe, where it stands upright, s and s_0 the tip's
positions, and j the joints that the policy moves, j_0 at the start of the episode,

    Δψ = −twist_z(q_{t−1}⁻¹ q_t)                                angle turned in a control step, about its own axis [rad]
    θ  = ∠(a, n)                                                tilt [rad]

Groups: `priv_obj_state` as in `groups`, and the distance from each probe to the object's surface [m]; `priv_obj_props` friction
and mass [kg] alone. There is no goal.

Weights of the reward's terms are the paper's. Progress pays c, 1 where the object is held, else `hold.coasting_pay`, 1 by
default: see `parts`. At 2 rad/s `spin` is worth 20 1/s; `near` is worth 1 if all probes touch, `drop` −2.5 in all,
`joint_limit` −1.9 for a finger stretched out, `action_rate` −0.05 for random actions of eight joints, `work` −0.002 at 2 W.

So a spin of 2 rad/s pays up to a tilt of 15°; `spin` pays a bounded rate, see `parts`. An episode terminates where
θ > `drop_tilt`, where the tip is out of the screw, |s − s_0| > `engagement`, or, with `stall`, where Σ Δψ does not grow by
`stall.turn` within `stall.within`. Score: angle turned at a tilt of less than 20°, over the duration of a whole episode
[rad/s]: after a drop nothing is added.

The scene's handles are cylinders, a box and capsules. An ellipsoid would be as informative, but its distance takes 18 Newton
steps (`geometry.shapes`), which take minutes to compile on a GPU, and MuJoCo Warp's search for the deepest point between two
convex shapes runs out of memory against it.

Source: Chung et al., *Tactile Genesis*, appendix, "Tasks and Hands", "Reward terms". The paper prints weights and names;
formulas, Δt as a factor of all terms, the way to turn, ω_max, λ, r, c, the last two terms, the ends of episodes and the 20° of
the score are ours.
Turning back costs as much as turning forward pays, at any speed, and no less while the object coasts: `spin` is bounded above
alone.
"""

from __future__ import annotations

import math

import mujoco
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.fields.models import Angle, Positive, PositiveLength, SpecModel, with_defaults
from tgdsl.rl import groups, rotations, terms
from tgdsl.rl.grasps.grasps import GraspSpec
from tgdsl.rl.spec import TaskSpec, Time
from tgdsl.rl.students.spec import DecoderSpec, DistillSpec
from tgdsl.rl.task import Now, Setup, Start, reward_term
from tgdsl.rl.tasks.parts import Holding, HoldSpec, ProgressSpec
from tgdsl.rl.train.spec import TrainSpec
from tgdsl.runtime.simulators.watch import Watch
from tgdsl.tensors.env_ids import put_rows

UPRIGHT = math.radians(20.0)  # tilt below which a turn counts for the score [rad]; ours


class Train(with_defaults(TrainSpec, iterations=5000, steps=12, discount=0.99, entropy=0.0)):
    """Training of a policy; the paper's numbers for this task."""


class Distill(
    with_defaults(
        DistillSpec,
        iterations=2000,
        steps=12,
        gradient_length=4,
        learning_rate=1e-5,
        max_grad_norm=0.5,
        loss="inverse_variance",
        clip=0.1,
    )
):
    """Training of students; the paper's numbers for this task."""

    decoders: dict[str, DecoderSpec] = {
        name: DecoderSpec(weight=0.5, hidden=(512, 128)) for name in ("object_tilt", "rotation_progress")
    }
    """Heads by the privileged number that they predict: tilt [rad] and rate of turning [rad/s]."""


class StallSpec(SpecModel):
    """When a screwdriver counts as stalled."""

    within: Time = 2.0
    """Time for a further turn [s]."""
    turn: Angle = 0.1
    """Angle that it must turn in that time, the right way [rad]."""


class ScrewdriverSpec(TaskSpec, ProgressSpec):
    """Spin a screwdriver about its long axis."""

    train: Train = Train()
    """Training of a policy: `tgdsl train`."""
    distill: Distill = Distill()
    """Training of students from a trained policy: `tgdsl distill`."""

    episode: Time = 20.0
    """Duration of an episode [s]."""
    grasps: GraspSpec = GraspSpec()
    """Sampling of the grasps that episodes begin with."""
    tip: str = "tip"
    """The scene's site at the tip."""
    max_spin: Positive = 6.0
    """ω_max: upper bound of the rate [rad/s]."""
    hold: HoldSpec = HoldSpec()
    """Reward of progress while the object coasts; by default the same as while it is held."""
    free_distance: PositiveLength = 0.02
    """r: distance of the handle from its upright position without a penalty [m]."""
    drop_tilt: Angle = 0.8
    """Tilt above which the screwdriver has fallen over [rad]."""
    engagement: PositiveLength = 0.005
    """Distance from its start beyond which the tip is out of the screw [m]."""
    stall: StallSpec | None = None
    """Terminates episodes in which the screwdriver stops turning; null: never."""


class Screwdriver(terms.HandTask[ScrewdriverSpec]):
    """The task."""

    Spec = ScrewdriverSpec
    senses = ("link_contact", "surface_distance")
    constants = ("grasps", "stall")
    score_unit = "rad/s"
    own_groups = ("priv_obj_state", "priv_obj_props")

    @reward_term(10.0, "1/rad")
    def spin(self, now: Now) -> Float[Tensor, " env"]:
        """Angular velocity about the long axis, the right way: c min(Δψ/Δt, ω_max), and Δψ/Δt where Δψ < 0."""
        return self.spec.pay(self.rate) * self._pay(now)

    near = terms.Near.of_task(1.0, width="near_width")

    @reward_term(-400.0, "1/s")
    def alignment(self, now: Now) -> Float[Tensor, " env"]:
        """Tilt of the object, 1 − cos θ: −1.5 1/s at 5°, −6 at 10°, −24 at 20°."""
        return 2.0 * (0.5 * self.tilt).sin().square()

    @reward_term(-300.0, "1/(m s)")
    def object_distance(self, now: Now) -> Float[Tensor, " env"]:
        """Distance of the handle from where it stands upright beyond `free_distance`, max(0, |p − p_0| − r): from 6° on."""
        return ((now.object.pos - self.upright_pos).norm(dim=1) - self.spec.free_distance).clamp(min=0.0)

    @reward_term(-1.0, "1/(rad² s)")
    def hand_pose(self, now: Now) -> Float[Tensor, " env"]:
        """Squared deviation of the joints from where they started, |j − j_0|²: −0.7 1/s for eight joints 0.3 rad away."""
        return (now.joint_pos - self.start_joints).square().sum(dim=1)

    @reward_term(-100.0, "1/s")
    def drop(self, now: Now) -> Bool[Tensor, " env"]:
        """Object dropped in this step."""
        return self.is_over(now)

    action_rate = terms.ActionRate.of_task(-1e-2)
    joint_limit = terms.JointLimit.of_task(-40.0)
    work = terms.Work.of_task(-1e-3)
    contact_force = terms.ContactForce.of_task(0.0, max_force="max_force")
    effort = terms.Effort.of_task(0.0)

    def __init__(self, spec: ScrewdriverSpec, setup: Setup):
        """Begin with all screwdrivers upright, as in the keyframe; raise `SimulationError` if there are no grasps."""
        super().__init__(spec, setup)
        if setup.grasps is None:
            raise SimulationError("this task begins with grasps, and there are none")
        self.grasps = setup.grasps
        self.axis = torch.tensor([0.0, 0.0, 1.0], dtype=setup.dtype, device=setup.device).expand(setup.num_envs, 3)
        self.holding = Holding(spec.hold, setup)
        self.joints = torch.from_numpy(setup.actuators.qpos).to(setup.device, torch.int64)
        self.upright_pos, self.upright_tip = (place.to(setup.device, setup.dtype) for place in _upright(setup, spec.tip))
        self.quat, self.start_joints = self.keep("quat", 4), self.keep("start_joints", len(setup.actuators.names))
        self.rate, self.tilt, self.turned = self.keep("rate"), self.keep("tilt"), self.keep("turned")
        if spec.stall:
            self.angle, self.mark = (
                self.keep("angle"),
                self.keep("mark"),
            )  # Σ Δψ, and its value at the last turn that counted
            self.since = self.keep("since", dtype=torch.int64)  # control steps since then
        self.parts = {
            "priv_obj_state": [groups.object_state(setup), groups.distances(setup)],
            "priv_obj_props": [groups.object_props(setup)],
        }

    @classmethod
    def watch(cls, spec: ScrewdriverSpec) -> Watch:
        return Watch(sites=(spec.tip,))

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> Start:
        """Begin with a grasp of each environment's handle."""
        drawn = self.grasps.draw(episode)
        qpos = drawn.values.get("qpos")
        assert isinstance(qpos, Tensor)
        self.begin(chosen, quat=drawn.quat, start_joints=qpos[:, self.joints], rate=0.0, turned=0.0)
        self.begin(chosen, tilt=rotations.swing(drawn.quat, self.axis))
        if self.spec.stall:
            self.begin(chosen, angle=0.0, mark=0.0, since=0)
        return Start(drawn.values, drawn.contacts)

    def advance(self, now: Now) -> None:
        """Accumulate the screwdriver's rotation."""
        quat = now.object.quat
        step = -rotations.twist(rotations.product(rotations.inverse(self.quat), quat), self.axis)
        self.rate.copy_(step / self.setup.control_step)
        self.tilt.copy_(rotations.swing(quat, self.axis))
        self.turned += torch.where(self.tilt < UPRIGHT, step, 0.0)
        self.quat.copy_(quat)
        if self.spec.stall:
            self.angle += step
            is_further = self.angle >= self.mark + self.spec.stall.turn
            put_rows(self.mark, is_further, self.angle)
            self.since.copy_(torch.where(is_further, 0, self.since + 1))

    def is_over(self, now: Now) -> Bool[Tensor, " env"]:
        """Return where the screwdriver has fallen over, its tip is out of the screw, or it has stalled."""
        tip_distance = (now.watched.site_pos[:, 0] - self.upright_tip).norm(dim=1)
        is_lost = (self.tilt > self.spec.drop_tilt) | (tip_distance > self.spec.engagement)
        stall = self.spec.stall
        return is_lost | (self.since >= round(stall.within / self.setup.control_step)) if stall else is_lost

    def step_progress(self) -> Float[Tensor, " env"]:
        """Return the angle that the screwdriver has turned in this control step [rad]."""
        return self.rate * self.setup.control_step

    def decoded(self, now: Now) -> dict[str, Float[Tensor, " env"]]:
        """Return the screwdriver's tilt [rad], and its rate of turning [rad/s]."""
        return {"object_tilt": self.tilt, "rotation_progress": self.rate}

    def score(self) -> Float[Tensor, " env"]:
        """Return the angle turned while upright, over the duration of a whole episode [rad/s]."""
        return self.turned / self.spec.episode

    def _pay(self, now: Now) -> Float[Tensor, " env"]:
        if self.holding.pays_in_full:
            return torch.ones_like(self.rate)
        return torch.where(self.rate > 0, self.holding.pay(now), 1.0)


def _upright(setup: Setup, tip: str) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    state = mujoco.MjData(setup.model)
    state.qpos[:] = setup.qpos.cpu().numpy()
    mujoco.mj_kinematics(setup.model, state)
    return tuple(torch.from_numpy(place.copy()) for place in (state.body(setup.object).xpos, state.site(tip).xpos))  # type: ignore[return-value]
