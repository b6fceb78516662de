"""Actuators of a policy: from an action to torques, with the imperfections of real drives.

An action a ∈ [−1, 1] per joint becomes a target once per control step; before each physics step (time t, position q, speed q̇)
the drive turns it into a torque:

    absolute    w = q_low + (a + 1)/2 (q_high − q_low)
    relative    w = clip(w' + s a, q_low, q_high)                  w' the previous target, s the action's scale [rad, m]
    offset      w = clip(w_0 + s a, q_low, q_high)                 w_0 the target at the start of the episode
    smoothed    w ← (1 − σ) w + σ w'
    delayed     w of `delay` control steps ago
    play        u = clip(u', w + b − β/2, w + b + β/2)             u' the previous u, b position bias, β backlash [rad]
    deadband    e = sign(u − q) max(|u − q| − δ, 0)
    drive       τ = clip(g_p k_p e − g_d k_d q̇, ± S τ_max)
    breakaway   τ ← κ τ  where |q̇| < `BREAKAWAY_SPEED`
    speed       |τ| ≤ τ_max max(0, 1 − |q̇|/q̇_max)  where τ q̇ > 0    (only with a `top_speed`)
    noise       τ ← clip(τ + ν τ_max U(−1, 1), ± S τ_max)          kick and noise stay within the drive's strength

k_p, k_d and τ_max come from the robot's position actuators. MuJoCo's own actuator gets the control q + e; the difference
between τ and its torque is applied as a joint force. Ideal drives therefore cost nothing and stay implicit in MuJoCo's
integrator. The factors g, S, κ, the offsets b, δ, β and the delay are drawn for each joint and environment at reset; noise at
each physics step. A robot such as the XHand1, with joint damping τ_max over its rated speed, already has the line of
`top_speed`.

Source of gains, strength, bias, deadband, backlash, kick and noise: Chung et al., *Tactile Genesis*, appendix, "Domain
Randomization". The paper prints the bias in metres and does not define deadband, backlash and kick: the definitions above are
ours, and so are delay and top speed.

Joints are hinges, or slides with m for rad and N for N·m. A document's angles (b, δ, β, a `top_speed`) apply to hinges alone;
slides have a separate scale.

Shapes: `env` environments, `joint` actuated joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Literal

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from pydantic import Discriminator, Tag, model_validator
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.fields.models import NonNegative, PositiveLength, Quantity, Range, RangeOf, SpecModel
from tgdsl.rl.draws import Draws, within
from tgdsl.runtime.simulators.model_ids import element_id
from tgdsl.tensors.env_ids import put

BREAKAWAY_SPEED = 0.05  # below this a joint counts as at rest, where its drive has to break away [rad/s]
ONE: Range = (1.0, 1.0)
ZERO: Range = (0.0, 0.0)
Factor = Annotated[Range, RangeOf("number", gt=0.0)]


Scale = Annotated[
    Annotated[Literal["half_range"], Tag("word")] | Annotated[float, Quantity("angle", gt=0.0), Tag("angle")],
    Discriminator(lambda value: "word" if isinstance(value, str) and value.isidentifier() else "angle"),
]


class ActionSpec(SpecModel):
    """Meaning of a policy's action."""

    mode: Literal["relative", "absolute", "offset"] = "relative"
    """Whether an action is a change of the target, the target itself (−1 and 1: the ends of the joint's range), or the
    target's offset from its value at the episode's start."""
    scale: Scale = 0.05
    """s, the target's motion for an action of 1 on a hinge [rad]: per control step if `relative`, in total if `offset`.
    `half_range`: half of each joint's range, slides included."""
    slide_scale: PositiveLength = 0.01
    """s for slides [m]."""
    smoothing: Annotated[float, Quantity("number", ge=0.0)] = 0.0
    """σ, share of the previous target in the new one, less than 1."""

    @model_validator(mode="after")
    def _check(self) -> ActionSpec:
        for name, unit in (("scale", "rad"), ("slide_scale", "m")):
            value = getattr(self, name)
            if self.mode == "absolute" and value != type(self).model_fields[name].default:
                text = value if isinstance(value, str) else f"{value:g} {unit}"
                problem = f"{name} is {text}, but absolute actions have none: they span the joint's range"
                raise ValueError(f"{problem}; leave it out, or take mode relative or offset")
        if self.smoothing >= 1.0:
            raise ValueError(f"smoothing is {self.smoothing:g}, expected less than 1: targets would never move")
        return self


MOST_DELAY = 1000  # longest delay of a target [control steps]; each environment stores this many targets


class DriveSpec(SpecModel):
    """Imperfections of drives. All may be ranges, drawn for each joint and environment at reset."""

    gain: Factor = ONE
    """g_p, factor on the proportional gain."""
    damping: Factor = ONE
    """g_d, factor on the derivative gain."""
    strength: Factor = ONE
    """S, factor on the largest torque."""
    bias: Annotated[Range, RangeOf("angle")] = ZERO
    """b, offset of a position target [rad]."""
    deadband: Annotated[Range, RangeOf("angle", ge=0.0)] = ZERO
    """δ, position error without torque [rad]."""
    backlash: Annotated[Range, RangeOf("angle", ge=0.0)] = ZERO
    """β, play that a target crosses at a reversal [rad]."""
    kick: Factor = ONE
    """κ, factor on the torque of a joint at rest."""
    torque_noise: NonNegative = 0.0
    """ν, uniform noise of the torque at each physics step, as a share of the largest torque."""
    delay: Annotated[Range, RangeOf("number", ge=0.0)] = ZERO
    """How many control steps late a target arrives; whole numbers, both ends included."""
    top_speed: Annotated[float, Quantity("number", gt=0.0)] | Literal["robot"] | None = None
    """q̇_max, speed at which the largest accelerating torque reaches zero [rad/s]; `robot`: τ_max over joint damping."""

    @model_validator(mode="after")
    def _check(self) -> DriveSpec:
        if any(end != int(end) for end in self.delay):
            raise ValueError(f"delay is {self.delay[0]:g} to {self.delay[1]:g} control steps, expected whole numbers")
        if self.delay[1] > MOST_DELAY:
            raise ValueError(f"delay is up to {self.delay[1]:g} control steps, expected at most {MOST_DELAY}")
        return self

    @property
    def is_ideal(self) -> bool:
        """Whether a drive is the robot's actuator and nothing else."""
        ideal = DriveSpec()
        return all(getattr(self, name) == getattr(ideal, name) for name in type(self).model_fields if name != "delay")


@dataclass(frozen=True, eq=False)
class Actuators:
    """The position actuators of some joints, and where both stand in a model."""

    names: tuple[str, ...]
    actuator: Int[np.ndarray, " joint"]  # index of each one's actuator
    qpos: Int[np.ndarray, " joint"]  # where each stands in `qpos`
    dof: Int[np.ndarray, " joint"]  # where each stands in `qvel`
    low: Float[np.ndarray, " joint"]  # lower end of each range [rad]
    high: Float[np.ndarray, " joint"]  # upper end of each range [rad]
    stiffness: Float[np.ndarray, " joint"]  # k_p [N·m/rad]
    damping: Float[np.ndarray, " joint"]  # k_d of the actuator, not of the joint [N·m·s/rad]
    limit: Float[np.ndarray, " joint"]  # τ_max [N·m]; infinite where there is none
    top_speed: Float[np.ndarray, " joint"]
    """Speed at which joint damping takes all of τ_max [rad/s]; infinite where there is none."""
    is_slide: Bool[np.ndarray, " joint"]  # whether a joint is a slide: m for rad and N for N·m in all of these

    @classmethod
    def of(cls, model: mujoco.MjModel, names: Sequence[str]) -> Actuators:
        """Look up the actuators of joints."""
        rows = [_actuator_row(model, name) for name in names]
        columns = [np.array(column) for column in zip(*rows, strict=True)]
        return cls(tuple(names), *columns)


def _actuator_row(model: mujoco.MjModel, name: str) -> tuple[int | float, ...]:
    joint = model.joint(element_id(model, "joint", name))
    actuators = np.flatnonzero((model.actuator_trnid[:, 0] == joint.id) & (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT))
    if len(actuators) != 1:
        raise SimulationError(f'joint "{name}" has {len(actuators)} actuators, expected one position actuator')
    i = int(actuators[0])
    stiffness, (bias, spring, damper) = model.actuator_gainprm[i, 0], model.actuator_biasprm[i, :3]
    is_position = (
        model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        and spring == -stiffness
        and not bias
        and model.actuator_gear[i, 0] == 1
    )
    if not is_position or not model.jnt_limited[joint.id]:
        problem = f'the actuator of joint "{name}" is no position servo of gear 1, or the joint has no range'
        raise SimulationError(f"{problem}; a policy's actions are targets within it")
    limit = float(model.actuator_forcerange[i, 1]) if model.actuator_forcelimited[i] else np.inf
    dof = int(model.jnt_dofadr[joint.id])
    passive = float(model.dof_damping[dof])
    low, high = model.jnt_range[joint.id].tolist()
    top_speed = limit / passive if passive and np.isfinite(limit) else np.inf
    is_slide = bool(model.jnt_type[joint.id] == mujoco.mjtJoint.mjJNT_SLIDE)
    return (i, int(model.jnt_qposadr[joint.id]), dof, low, high, float(stiffness), -float(damper), limit, top_speed, is_slide)


class Actuation:
    """The drives of all environments: their targets, drawn parameters and torques."""

    target: Float[Tensor, "env joint"]  # position targets after the last action [rad]
    start: Float[Tensor, "env joint"]  # position targets at the start of the episodes [rad]
    torque: Float[Tensor, "env joint"]  # what each drive exerted in the last physics step [N·m]
    drawn: Mapping[str, Float[Tensor, "env joint"]]  # each drive's parameters, by field of `DriveSpec`

    def __init__(
        self,
        actuators: Actuators,
        arrays: Mapping[str, Tensor],
        action: ActionSpec,
        drive: DriveSpec,
        draws: Draws,
        substeps: int = 1,
    ):
        """Begin with all drives ideal, at their joints' present positions."""
        self._arrays, self._draws, self.spec, self.action, self._ahead = arrays, draws, drive, action, substeps
        qpos = arrays["qpos"]
        device, dtype, num_envs, num = qpos.device, qpos.dtype, len(qpos), len(actuators.names)
        unlimited = [name for name, limit in zip(actuators.names, actuators.limit, strict=True) if not np.isfinite(limit)]
        if unlimited and (drive.torque_noise or drive.top_speed or drive.strength != ONE):
            raise SimulationError(f"joints {listed(unlimited)} have no largest torque, which this drive's options scale")
        if "scale" in action.model_fields_set and not isinstance(action.scale, str) and actuators.is_slide.all():
            problem = f"action.scale is {action.scale:g} rad, but the policy moves slides alone: {listed(actuators.names)}"
            raise SimulationError(f"{problem}; expected action.slide_scale [m]")
        self._index = {f: torch.from_numpy(getattr(actuators, f)).to(device, torch.int64) for f in ("actuator", "qpos", "dof")}
        self._is_slide = actuators.is_slide
        scale = 0.5 * (actuators.high - actuators.low)
        if not isinstance(action.scale, str):
            scale = np.where(actuators.is_slide, action.slide_scale, action.scale)
        self.scale = torch.from_numpy(scale).to(device, dtype)
        values = [f.name for f in fields(actuators) if f.name not in ("names", "is_slide", *self._index)]
        self._values = {name: torch.from_numpy(getattr(actuators, name)).to(device, dtype) for name in values}
        ideal = DriveSpec()
        shape = (num_envs, num)
        self.drawn = {name: torch.full(shape, getattr(ideal, name)[0], device=device, dtype=dtype) for name in _DRAWN}
        self._random = tuple(name for name in _DRAWN if getattr(drive, name) != getattr(ideal, name))
        self._drawn = torch.zeros((len(self._random), *shape), device=device, dtype=dtype)
        for name, values_of in zip(self._random, self._drawn, strict=True):
            self.drawn[name] = values_of.copy_(self.drawn[name])
        low, high = (self._ends(i) for i in (0, 1))
        self._low, self._span = low.float().to(device), (high - low).float().to(device)
        self._past = torch.zeros((int(drive.delay[1]) + 1, num_envs, num), device=device, dtype=dtype)
        self.target, self.torque = torch.zeros_like(self._past[0]), torch.zeros_like(self._past[0])
        self._play, self.start = torch.zeros_like(self.target), torch.zeros_like(self.target)
        self._count = torch.zeros(num_envs, dtype=torch.int64, device=device)  # of physics steps, above them of episodes
        self.is_ideal = drive.is_ideal
        """Whether the robot's own actuators do all; if not, `drive` has to be called before each physics step."""
        self._top_speed = self._values["top_speed"]
        if isinstance(drive.top_speed, float):
            self._top_speed = torch.from_numpy(np.where(actuators.is_slide, np.inf, drive.top_speed)).to(device, dtype)
        self.place(torch.ones(num_envs, dtype=torch.bool, device=device))

    def draw(self, chosen: Bool[Tensor, " env"], count: Int[Tensor, " env"]) -> None:
        """Draw the drives of some environments again."""
        if self._random:
            num = self.target.shape[1]
            share = self._draws.side_by_side(dict.fromkeys(self._random, num), count, chosen).view(len(count), -1, num)
            new = self._low + self._span * share
            if self._random[-1] == "delay":
                new = torch.cat([new[:, :-1], new[:, -1:].floor().clamp(max=int(self.spec.delay[1]))], dim=1)
            put(self._drawn, chosen[:, None], new.to(self._drawn.dtype).transpose(0, 1))

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"], at_controls: bool = False) -> None:
        """Restart the drives of some environments: see `place`."""
        put(self._count, chosen, episode << 32)
        self.place(chosen, at_controls)

    def place(self, chosen: Bool[Tensor, " env"], at_controls: bool = False) -> None:
        """Set the targets of some environments to their joints' present positions, or to the present controls."""
        name, which = ("ctrl", "actuator") if at_controls else ("qpos", "qpos")
        now, mask = self._arrays[name].index_select(1, self._index[which]), chosen[:, None]
        for held in (self.target, self._past, self.start):
            put(held, mask, now)
        put(self._play, mask, now + self.drawn["bias"])
        put(self.torque, mask, 0.0)

    def command(self, action: Float[Tensor, "env joint"]) -> None:
        """Set new targets from an action of each environment; the drives see them after the delay.

        Actions are clipped to [−1, 1]; a non-finite action leaves its target unchanged.
        """
        self._take(self.commanded(action))

    def commanded(self, action: Float[Tensor, "env joint"]) -> Float[Tensor, "env joint"]:
        """Return the targets that an action would lead to [rad]; nothing changes."""
        low, high, action = self._values["low"], self._values["high"], action.to(self.target.dtype).clamp(-1.0, 1.0)
        if self.action.mode == "absolute":
            command = low + 0.5 * (action + 1.0) * (high - low)
        else:
            origin = self.start if self.action.mode == "offset" else self.target
            command = torch.minimum(torch.maximum(origin + self.scale * action, low), high)
        command = torch.lerp(command, self.target, self.action.smoothing)
        return torch.where(action.isfinite(), command, self.target)

    def follow(self, control: Float[Tensor, "env actuator"]) -> None:
        """Set targets from external set-points of all actuators, such as a hand's serial line, instead of actions."""
        self._arrays["ctrl"].copy_(control)
        self._take(control.index_select(1, self._index["actuator"]).to(self.target))

    def _take(self, target: Float[Tensor, "env joint"]) -> None:
        """Set new targets; the drives see them after the delay."""
        self.target.copy_(target)
        self._past.copy_(torch.cat([self.target[None], self._past[:-1]]))
        if self.is_ideal:
            self._arrays["ctrl"][:, self._index["actuator"]] = self._arrived()

    def drive(self) -> None:
        """Compute the drives' torques before a physics step: see the module's equations."""
        arrays, values, drawn = self._arrays, self._values, self.drawn
        pos, speed = (arrays[name].index_select(1, self._index[which]) for name, which in (("qpos", "qpos"), ("qvel", "dof")))
        delayed, half = self._arrived() + drawn["bias"], 0.5 * drawn["backlash"]
        self._play.copy_(torch.minimum(torch.maximum(self._play, delayed - half), delayed + half))
        error = self._play - pos
        error = error.sign() * (error.abs() - drawn["deadband"]).clamp(min=0.0)
        # MuJoCo clips controls to the joint's range: the excess is part of the joint force.
        control = torch.minimum(torch.maximum(pos + error, values["low"]), values["high"])
        plain = _within(values["stiffness"] * (control - pos) - values["damping"] * speed, values["limit"])
        torque = drawn["gain"] * values["stiffness"] * error - drawn["damping"] * values["damping"] * speed
        torque = _within(torque, drawn["strength"] * values["limit"])
        torque = torch.where(speed.abs() < BREAKAWAY_SPEED, drawn["kick"] * torque, torque)
        if self.spec.top_speed is not None:
            share = (1.0 - speed.abs() / self._top_speed).clamp(min=0.0)
            torque = torch.where(torque * speed > 0, _within(torque, share * values["limit"]), torque)
        if self.spec.torque_noise:
            share = self._draws.shares_ahead("torque_noise", self._count, torque.shape[1], self._ahead)
            noise = within(share, -1.0, 1.0)
            torque = torque + self.spec.torque_noise * values["limit"] * noise.to(torque.dtype)
        torque = _within(torque, drawn["strength"] * values["limit"])
        self._count += 1
        self.torque.copy_(torque)
        arrays["ctrl"][:, self._index["actuator"]] = control
        arrays["qfrc_applied"][:, self._index["dof"]] = torque - plain

    def memory(self) -> dict[str, Tensor]:
        """Return its state by name: live tensors (env, joint); `past` is (step, env, joint), `count` (env,)."""
        memory = {"target": self.target, "start": self.start, "torque": self.torque}
        memory |= {"play": self._play, "past": self._past, "count": self._count}
        return memory | {f"drawn/{name}": value for name, value in self.drawn.items()}

    def _ends(self, which: int) -> Float[Tensor, "drawn joint"]:
        """Return the lower or upper bounds of the drawn parameters; a delay, rounded down, has an upper bound one higher."""
        ends = torch.zeros((len(self._random), len(self._is_slide)), dtype=torch.float64)
        for name, bounds in zip(self._random, ends, strict=True):
            bounds += getattr(self.spec, name)[which] + (which if name == "delay" else 0)
            if name in _ANGLES:
                bounds[torch.from_numpy(self._is_slide)] = 0.0
        return ends

    def _arrived(self) -> Float[Tensor, "env joint"]:
        if len(self._past) == 1:
            return self._past[0]
        return self._past.gather(0, self.drawn["delay"].to(torch.int64)[None])[0]


_DRAWN = ("gain", "damping", "strength", "bias", "deadband", "backlash", "kick", "delay")
"""Parameters drawn for each drive; whole numbers last."""
_ANGLES = ("bias", "deadband", "backlash")  # angles, which slides do not have


def _within(value: Tensor, limit: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(value, -limit), limit)
