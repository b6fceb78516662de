"""Actuation audio: the sound of motors and joints, one emitter per actuated joint, K samples per physics step.

    ℓ = β_load |τ| + β_pow |τ ω|                                                              [Pa]
    s = ℓ Σ_h a_h w(h κ|ω|) sin(hφ) + β_fric |ω| √(f_s/2) n + a_hum sin(φ_hum)                [Pa]
    φ̇ = 2πκ ω,   φ̇_hum = 2π f_hum                                                             [rad/s]

s is the sound pressure at 1 m. ω is the joint's velocity [rad/s] and τ the torque of its actuators [N·m]; for slides they are
in m/s and N. f₀ = κ|ω| is the fundamental of the whine [Hz] and a_h the strength of its h-th multiple [1]. n is white normal
noise at the sample rate f_s [Hz], so friction has the spectral density (β_fric ω)² [Pa²/Hz] at any rate. a_hum is the hum of a
motor that is switched on.

- Within a step ω and ℓ are linear between the values at its ends, so nothing jumps. φ is the exact integral of ω and continues
  from step to step, backwards where the joint turns back, so the pitch follows |ω|.
- w fades a multiple out between 0.40 and 0.45 of the sample rate, which avoids aliasing. It fades in up to 20 Hz, so a joint
  that stands under load makes no steady pressure.
- At the first call after a reset φ = 0, and velocity and load count as constant before it.

Sample k = 1 … K of a step that begins at t is at the time t + kΔt/K; the last one is at the step's end.

Source: Chung et al., *Tactile Genesis*, appendix, "Contact and Actuation Audio".

Departures: φ is integrated and levels are linear within a step; the paper specifies neither, nor multiples above the sample
rate. The paper makes all three parts with two-pole resonators, which lose their phase when they are retuned.

Limits: the default levels describe no real motor; measure yours. Side bands and resonances of the housing are not modelled. The
sound comes from the joint's anchor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Generic, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, StrictInt, model_validator
from torch import Tensor

from tgdsl.fields.models import Frequency, NonNegative, Usual
from tgdsl.geometry.planes import pi
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.kinematics import Joints
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Array,
    Axis,
    Channel,
    Context,
    Kind,
    Lowered,
    Memory,
    OnJointsSpec,
    ReferenceContext,
    ReferenceState,
    SurfaceOf,
    scalar,
)
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.reference import normal_pair
from tgdsl.sensors.upstream import PLACE, SAMPLES, SOUND


def fade_band() -> tuple[float, float]:
    """Return the frequencies between which a partial fades out, as parts of the sample rate."""
    return 0.40, 0.45  # no floats of the module, see `planes`


def audible() -> float:
    """Return the frequency up to which a partial fades in [Hz]."""
    return 20.0


class ActuationAudioSpec(OnJointsSpec):
    """The sound of motors and joints."""

    kind: Literal["actuation_audio"]
    """Sound of each actuated joint, as sound pressure at 1 m: blocks of samples [Pa]."""
    samples: Annotated[StrictInt, Field(ge=1)] = 16
    """Samples per physics step, K: the sample rate is K over the time step [1]."""
    substeps: Annotated[StrictInt, Field(ge=1)] = 1
    """Physics steps per call: a reading holds the blocks of all of them, one after the other [1]."""
    load: NonNegative = 2e-3
    """Level of the whine by load, β_load [Pa/(N·m); slides: Pa/N]."""
    power: NonNegative = 5e-3
    """Level of the whine by mechanical power, β_pow [Pa/W]."""
    pitch: Annotated[NonNegative, Usual("number", high=1e5)] = 100.0
    """Fundamental of the whine by velocity, κ [Hz per rad/s; slides: Hz per m/s]."""
    partials: Annotated[tuple[NonNegative, ...], Field(min_length=1, max_length=64)] = (1.0, 0.5, 0.3, 0.2)
    """Strength of the fundamental and its multiples, a_1, a_2, … [1]."""
    friction: NonNegative = 2e-6
    """Noise by velocity, β_fric [Pa/√Hz per rad/s; slides: per m/s]."""
    hum: NonNegative = 1e-4
    """Hum of a motor that is switched on, moving or not, a_hum [Pa]."""
    hum_frequency: Frequency = 120.0
    """Its frequency, f_hum [Hz]."""

    @model_validator(mode="after")
    def _is_heard(self) -> ActuationAudioSpec:
        if not (self.load or self.power or self.friction or self.hum):
            raise ValueError("`load`, `power`, `friction` and `hum` are all 0: expected one that makes a sound")
        if not (self.load or self.power):
            for name in sorted(self.model_fields_set & {"pitch", "partials"}):
                raise ValueError(f"`{name}` has no effect without `load` or `power`; remove it")
        if not self.hum and "hum_frequency" in self.model_fields_set:
            raise ValueError("`hum_frequency` has no effect without `hum`; remove it")
        return self


def reference(
    spec: ActuationAudioSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return s (sample, joint, 1) [Pa], the new state, and the planes for microphones."""
    drive, num = gathered[Joints], spec.samples
    now = np.array([drive.velocity, spec.load * np.abs(drive.effort) + spec.power * np.abs(drive.effort * drive.velocity)])
    start = now if context.is_first else np.array([state["velocity"], state["level"]])
    phase, hum = (0.0 * now[0], np.zeros(1)) if context.is_first else (state["phase"], state["hum"])
    noise, rate, (whole, none) = noise_of(context, num, len(layout.links)), num / context.dt, fade_band()
    sound = np.zeros((num, len(layout.links)))
    for k in range(1, num + 1):
        time = k / num * context.dt
        velocity, level = start + k / num * (now - start)
        angle = phase + 2 * np.pi * spec.pitch * (start[0] * time + (now[0] - start[0]) / context.dt * time**2 / 2)
        for h, strength in enumerate(spec.partials, start=1):
            pitch = h * spec.pitch * np.abs(velocity)
            fade = np.clip((none - pitch / rate) / (none - whole), 0, 1) * np.clip(pitch / audible(), 0, 1)
            sound[k - 1] += level * strength * fade * np.sin(h * angle)
        sound[k - 1] += spec.friction * np.abs(velocity) * math.sqrt(rate / 2) * noise[k - 1]
        sound[k - 1] += spec.hum * np.sin(hum + 2 * np.pi * spec.hum_frequency * time)
    turned = phase + 2 * np.pi * spec.pitch * context.dt * (now[0] + start[0]) / 2
    hummed = hum + 2 * np.pi * spec.hum_frequency * context.dt
    after = {"velocity": now[0], "level": now[1], "phase": turned, "hum": hummed}
    return sound[:, :, None], after, {SAMPLES: sound, PLACE: drive.place.T}


def noise_of(context: ReferenceContext, num_samples: int, num_rows: int) -> Float[np.ndarray, "sample row"]:
    """Return n: two numbers per random word, for a sample and the next one."""
    count = (num_samples + 1) // 2
    pairs = normal_pair(context.words(np.arange(count * num_rows, dtype=np.uint64)))
    return np.stack([part.reshape(count, num_rows) for part in pairs], axis=1).reshape(-1, num_rows)[:num_samples]


@dataclass(frozen=True, eq=False)
class ActuationAudioConstants(Generic[Array]):
    """Parameters; None of parts that make no sound. `share` is k/K of each sample."""

    share: Array
    pitch: Array
    load: Array | None = None
    power: Array | None = None
    partials: Array | None = None
    friction: Array | None = None
    hum: Array | None = None
    hum_frequency: Array | None = None


class ActuationAudioState(NamedTuple):
    """ω and ℓ at the end of the last step; φ; and φ_hum, (env, 1)."""

    velocity: Tensor
    level: Tensor
    phase: Tensor
    hum: Tensor


def lower(spec: ActuationAudioSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """A row for each joint; parts that make no sound are left out."""
    joints, num = [link.name for link in layout.links], spec.samples
    has_whine = bool(spec.load or spec.power)
    constants = ActuationAudioConstants(
        share=np.arange(1, num + 1) / num,
        pitch=scalar(spec.pitch),
        load=scalar(spec.load) if has_whine else None,
        power=scalar(spec.power) if has_whine else None,
        partials=np.array(spec.partials) if has_whine else None,
        friction=scalar(spec.friction) if spec.friction else None,
        hum=scalar(spec.hum) if spec.hum else None,
        hum_frequency=scalar(spec.hum_frequency) if spec.hum else None,
    )
    rows = Axis("joint", len(joints), {"joint": joints, "body": [link.body for link in layout.links]}, np.arange(len(joints)))
    return Lowered(
        channels=(Channel("sound", "Pa"),),
        constants=constants,
        state={"velocity": Memory(), "level": Memory(), "phase": Memory(), "hum": Memory(shape=(1,))},
        requests=(Joints(),),
        rows=rows,
        substeps=spec.substeps,
        samples=num,
        provides=SOUND,
        sound=num,
    )


def forward(
    gathered: Gathered, context: Context, constants: ActuationAudioConstants[Tensor], state: ActuationAudioState
) -> tuple[dict[str, Tensor], ActuationAudioState]:
    """Return s (env, sample, 1, joint) [Pa] with the planes for microphones, and the new state."""
    drive, is_first = gathered[Joints], context.is_first
    share, dt = constants.share[:, None], context.dt
    velocity, begun = drive.velocity, torch.where(is_first, drive.velocity, state.velocity)
    swept = begun[:, None] * share + 0.5 * (velocity - begun)[:, None] * share * share
    phase = torch.where(is_first, 0.0, state.phase)
    angle = phase[:, None] + 2 * pi() * constants.pitch * dt * swept
    speed = (begun[:, None] + share * (velocity - begun)[:, None]).abs()
    rate = share.shape[0] / dt
    sound, level = torch.zeros_like(speed), torch.zeros_like(velocity)
    if constants.load is not None and constants.power is not None and constants.partials is not None:
        level = constants.load * drive.effort.abs() + constants.power * (drive.effort * velocity).abs()
        start = torch.where(is_first, level, state.level)[:, None]
        whine = _whine(angle, speed, rate, constants.pitch, constants.partials)
        sound = (start + share * (level[:, None] - start)) * whine
    if constants.friction is not None:
        sound = sound + constants.friction * speed * torch.sqrt(0.5 * rate) * _noise(context, speed)
    hum = torch.where(is_first, 0.0, state.hum)
    if constants.hum is not None and constants.hum_frequency is not None:
        step = 2 * pi() * constants.hum_frequency * dt
        sound = sound + constants.hum * torch.sin(hum[:, None] + step * share)
        hum = _wrapped(hum + step)
    new = ActuationAudioState(velocity, level, _wrapped(angle[:, -1]), hum)
    return {"signal": sound[:, :, None], SAMPLES: sound, PLACE: torch.stack(drive.place, dim=1)}, new


def _whine(
    angle: Tensor, speed: Tensor, rate: Tensor, pitch_ratio: Tensor, partials: Tensor
) -> Float[Tensor, "env sample joint"]:
    """Return the sum of the whine's multiples, for a level of 1."""
    whine, (whole, none) = torch.zeros_like(angle), fade_band()
    for h, strength in enumerate(partials.unbind(), start=1):
        pitch = h * pitch_ratio * speed
        fade = ((none - pitch / rate) / (none - whole)).clamp(0.0, 1.0) * (pitch / audible()).clamp(0.0, 1.0)
        whine = whine + strength * fade * torch.sin(h * angle)
    return whine


def _noise(context: Context, like: Float[Tensor, "env sample joint"]) -> Float[Tensor, "env sample joint"]:
    """Return normal numbers, two per random word, for a sample and the next one."""
    _, num_samples, num_rows = like.shape
    count = (num_samples + 1) // 2
    assert context.stream is not None
    words = random.words(context.stream, torch.arange(count * num_rows, dtype=torch.int32, device=like.device))
    pairs = [part.unflatten(1, (count, num_rows)) for part in random.normal_pair(words, like.dtype)]
    return torch.stack(pairs, dim=2).flatten(1, 2)[:, :num_samples]


def _wrapped(angle: Tensor) -> Tensor:
    return angle - 2 * pi() * torch.round(angle / (2 * pi()))


ACTUATION_AUDIO = Kind(
    ActuationAudioSpec,
    lower,
    forward,
    reference,
    knobs=frozenset(),
    is_timed=True,
    is_random=True,
    provides=SOUND,
    constants=ActuationAudioConstants,
    state=ActuationAudioState,
)
