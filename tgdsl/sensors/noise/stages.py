"""The stages; `STAGES` at the end has their order.

    radius          R̃_j = max(0, R_j + ε_j), ε_j ~ U[−ρ, ρ] at each reading, before the distance query [m]
    gain            x ← γ_j x, γ_j ~ U[γ_low, γ_high] at reset; of an elastomer the depth at each taxel
    hysteresis      ξ ← e^(−r) ξ + (1 − e^(−r))/r (x_t − x_(t−1)), r = Δt/τ; x ← x + β ξ; ξ = 0 at reset
    delay           x ← x(t − Δ), Δ = Δ_read + U[0, J] at each reading, the same for all taxels
    offset          y = x + b + n_t + d_t, n_t ~ N(0, σ²), d_t = d_(t−1) + w_t, w_t ~ N(0, σ_rw²); d = 0 at reset
    quantization    y ← q round(y/q); gradients pass as if it were not there
    dead            y ← z_j where M_j, M_j ~ Bernoulli(p), z_j = low + s_j (high − low), s_j ~ U[0, 1], both at reset

Each acts on each channel alone. Where a kind makes bits of its signal (`contact`, `link_contact`), noise acts on the signal,
before the threshold. Noise is drawn once per sample of a sensor with a rate; n and w are both from one random word. M_j and s_j
are the same in all channels of a taxel.

Hysteresis is a Maxwell branch, exact for signals that are linear between calls, so it is the same at any step; the paper's
ξ ← e^(−r) ξ + x_t − x_(t−1) depends on the step. For the delay too the signal is linear between calls, and before the first
call equal to the first one.

Source: Chung et al., *Tactile Genesis*, appendix, "Sensor Noise Model".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import model_validator
from torch import Tensor

from tgdsl.fields.models import Range, RangeOf, SpecModel, Usual
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.reference import ReferenceCall, normal_pair
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.spec import (
    NO_AMPLITUDE,
    ZERO,
    AnyAmplitude,
    Factor,
    LengthRange,
    NonNegativeAmplitude,
    Share,
    TimeRange,
)
from tgdsl.sensors.noise.stage import NoMemory, Now, Number, Signal, Stage, Table, compact, uniform
from tgdsl.tensors.fusion import materialised
from tgdsl.tensors.link_products import LINK_PRODUCTS


class Radius(Stage):
    """Disturbs radii by `shift`; the signal stays as it is."""

    name = "radius_noise"

    class Knobs(SpecModel):
        radius_noise: Annotated[LengthRange, Usual("length", high=0.1)] = ZERO
        """ρ, half-width of the uniform disturbance of each probe's radius, drawn at each reading [m]."""

    radius_noise: Annotated[Tensor, Number(0, unit=" m", stream=random.RADIUS)]
    """ρ [m]."""

    def shift(self, now: Now, like: Tensor) -> Tensor:
        """Return the disturbance of each probe's radius (env, taxel) [m]."""
        share = materialised(uniform(now, random.RADIUS, 0, like))
        return self.radius_noise[:, 0] * (2 * share - 1)

    @staticmethod
    def reference_radius(radius: np.ndarray, call: ReferenceCall) -> np.ndarray:
        """Return this step's radii (row,) of probes with these radii [m]."""
        disturbed = radius[:, None] + call.number("radius_noise") * (2 * call.uniform(random.RADIUS) - 1)
        return np.maximum(0, disturbed[:, 0])


class Gain(Stage):
    """x ← γ_j x."""

    name = "gain"

    class Knobs(SpecModel):
        gain: tuple[Factor, Factor] = ((1.0, 1.0), (1.0, 1.0))
        """Lowest and highest gain: each probe draws its own at reset."""

        @model_validator(mode="after")
        def _ordered(self) -> Self:
            if self.gain[0][0] > self.gain[1][1]:
                raise ValueError(f"gain [{self.gain[0][0]:g}, {self.gain[1][1]:g}] is not ordered, expected [low, high]")
            return self

    gain_low: Annotated[Tensor, Number(1, "from ", knob="gain.0", neutral=1.0, stream=random.GAIN)]
    gain_high: Annotated[Tensor, Number(2, "to ", knob="gain.1", neutral=1.0, stream=random.GAIN)]

    def of_taxels(self, now: Now, like: Tensor) -> Tensor:
        """Return each taxel's gain (env, taxel)."""
        low, high = self.gain_low[:, 0], self.gain_high[:, 0]
        return low + uniform(now, random.GAIN, 0, like) * (high - low)

    def forward(self, signal: Signal, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        return self.of_taxels(now, signal[:, 0])[:, None] * signal, memory

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        low, high = call.number("gain_low"), call.number("gain_high")
        return (low + call.uniform(random.GAIN)[:, :1] * (high - low)) * signal


class MaxwellBranch(SpecModel):
    """Viscoelastic memory of the substrate: one Maxwell branch."""

    strength: Annotated[Range, RangeOf("number", ge=0.0)]
    """β, overshoot after a step, as a share of the step."""
    time_constant: Annotated[Range, RangeOf("time", gt=0.0), Usual("time", high=3600.0)]
    """τ, time constant of the decay [s]."""


class HysteresisMemory(NamedTuple):
    """ξ, and the signal of the last call."""

    lag: Tensor
    last: Tensor


class Hysteresis(Stage):
    """x ← x + β ξ."""

    name = "hysteresis"
    Memory = HysteresisMemory
    needs_dt = True

    class Knobs(SpecModel):
        hysteresis: MaxwellBranch | None = None
        """Viscoelastic memory."""

    hysteresis_strength: Annotated[Tensor, Number(3, "strength ", knob="hysteresis.strength")]
    """β [1]."""
    hysteresis_time: Annotated[Tensor, Number(4, "time constant ", " s", "hysteresis.time_constant", (1.0, 1.0), None)]
    """τ [s]."""

    def forward(self, signal: Signal, memory: HysteresisMemory, now: Now) -> tuple[Signal, HysteresisMemory]:
        assert now.dt is not None
        ratio = now.dt / self.hysteresis_time
        ramp = torch.where(ratio > 0, -torch.expm1(-ratio) / torch.where(ratio > 0, ratio, 1.0), 1.0)
        decay, ramp = materialised(torch.exp(-ratio)), materialised(ramp)
        lag = torch.where(now.age[..., None] == 0, 0.0, decay * memory.lag + ramp * (signal - memory.last))
        is_broken = signal.isnan()  # of a pose that is not finite: go on from the last finite signal
        fields = (torch.where(is_broken, *pair) for pair in ((memory.lag, lag), (memory.last, signal)))
        return signal + self.hysteresis_strength * lag, HysteresisMemory(*fields)

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        lag = memory.get("lag", 0.0)
        if "last" in memory:
            r = call.dt / call.number("hysteresis_time")
            lag = np.exp(-r) * lag - np.expm1(-r) / r * (signal - memory["last"])
        memory.update(lag=lag, last=signal)
        return signal + call.number("hysteresis_strength") * lag


class DelayMemory(NamedTuple):
    """The signals of the last calls, (env, call, channel, row); the new one is this call's, (env, channel, row)."""

    ring: Tensor


class Delay(Stage):
    """x ← x(t − Δ)."""

    name = "delay"
    Memory = DelayMemory
    needs_dt = True

    class Knobs(SpecModel):
        read_delay: Annotated[TimeRange, Usual("time", high=1.0)] = ZERO
        """Age of the signal that is read [s]; between two calls the signal counts as linear."""
        jitter: Annotated[TimeRange, Usual("time", high=1.0)] = ZERO
        """Largest additional age, drawn uniformly at each reading for all taxels together [s]."""

    read_delay: Annotated[Tensor, Number(7, unit=" s")]
    """Δ_read [s]."""
    jitter: Annotated[Tensor | None, Number(8, "jitter ", " s", stream=random.JITTER)]
    """J [s]."""

    @classmethod
    def past(cls, values: Table) -> float:
        return float((values["read_delay"][1] + values["jitter"][1]).max())

    def forward(self, signal: Signal, memory: DelayMemory, now: Now) -> tuple[Signal, DelayMemory]:
        assert now.ages is not None
        late, ring = self.read_delay[:, 0], memory.ring
        if self.jitter is not None:
            index = torch.zeros_like(now.streams[random.JITTER].first[:1, 0])
            word = random.words(now.streams[random.JITTER], index)
            late = late + self.jitter[:, 0] * random.uniform(word, late.dtype)
        length = ring.shape[1]
        ages = now.ages[:, :length]
        newer = torch.minimum((ages[:, None] <= late[..., None]).sum(dim=-1), torch.clamp(now.age, max=length))
        is_oldest = newer >= torch.clamp(now.age, max=length)
        start = torch.where(newer > 0, ages.gather(1, (newer - 1).clamp(min=0)), 0.0)
        rest = (late - start) / (ages.gather(1, newer.clamp(max=length - 1)) - start)
        rest, newer = materialised(torch.where(is_oldest, 0.0, rest)), materialised(newer)
        after, older = (_entry(ring, materialised((now.step - newer - k) % length)) for k in (0, 1))
        after = torch.where(newer[:, None] == 0, signal, after)
        return torch.where(rest[:, None] > 0, after + rest[:, None] * (older - after), after), DelayMemory(signal)

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        times, signals = memory.setdefault("times", []), memory.setdefault("signals", [])
        times.append(times[-1] + call.dt if times else 0.0)
        signals.append(signal)
        late = call.number("read_delay") + call.uniform(random.JITTER)[0, 0] * call.number("jitter")
        past, result = np.array(signals), np.empty(signal.shape)
        for place in np.ndindex(signal.shape):
            result[place] = np.interp(times[-1] - late[place], times, past[:, *place])
        return result


def _entry(ring: Tensor, slot: Tensor) -> Signal:
    """Return the entries of a ring (env, call, channel, row) at slots (env, 1) or (env, row)."""
    env = torch.arange(ring.shape[0], device=ring.device)
    if slot.shape[1] == 1:  # whole signals, which are contiguous
        return ring[env, slot[:, 0]]
    place = slot[:, None, None].expand(-1, 1, *ring.shape[2:])
    return ring.gather(1, place)[:, 0]


class OffsetMemory(NamedTuple):
    """d; None without drift."""

    walk: Tensor | None = None


class Offset(Stage):
    """y = x + b + n + d."""

    name = "offset"
    Memory = OffsetMemory
    is_split = True

    class Knobs(SpecModel):
        bias: AnyAmplitude = NO_AMPLITUDE
        """Constant offset [unit of the reading]."""
        white_noise: NonNegativeAmplitude = NO_AMPLITUDE
        """σ, standard deviation of additive Gaussian noise [unit of the reading]."""
        drift: NonNegativeAmplitude = NO_AMPLITUDE
        """Standard deviation of the random walk's step at each reading [unit of the reading]; the walk starts at reset."""

    bias: Annotated[Tensor | None, Number(9, unit=None)]
    """b."""
    white_noise: Annotated[Tensor | None, Number(10, unit=None, stream=random.READING)]
    """σ."""
    drift: Annotated[Tensor | None, Number(11, unit=None, stream=random.READING)]
    """σ_rw."""

    @classmethod
    def remembered(cls, terms: Sequence[str]) -> tuple[str, ...]:
        return ("walk",) if "drift" in terms else ()

    def forward(self, signal: Signal, memory: OffsetMemory, now: Now) -> tuple[Signal, OffsetMemory]:
        if self.bias is not None:
            signal = signal + self.bias
        if self.white_noise is None and self.drift is None:
            return signal, memory
        channels, rows = signal.shape[1:]
        index = torch.arange(channels * rows, dtype=torch.int32, device=signal.device).view(channels, rows)
        first, second = now.streams[random.READING]
        word = random.words(random.Stream(first[..., None], second[..., None]), index)
        noise, step = random.normal_pair(word, signal.dtype)
        if self.white_noise is not None:
            signal = signal + self.white_noise * noise
        if self.drift is None or memory.walk is None:
            return signal, memory
        step = self.drift * step
        step = step if now.is_sample is None else torch.where(now.is_sample[..., None], step, 0.0)
        walk = torch.where(now.age[..., None] == 0, 0.0, memory.walk) + step
        return signal + walk, OffsetMemory(walk)

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        noise, step = normal_pair(call.words(random.READING, signal.shape[1]))
        if call.is_sample:
            memory["walk"] = memory.get("walk", 0.0) + call.number("drift") * step
        return signal + call.number("bias") + (call.number("white_noise") * noise + memory["walk"])


class Quantization(Stage):
    """y ← q round(y/q)."""

    name = "quantization"

    class Knobs(SpecModel):
        quantization: NonNegativeAmplitude = NO_AMPLITUDE
        """Step of the quantiser [unit of the reading]; 0: none."""

    quantization: Annotated[Tensor, Number(12, unit=None)]
    """q."""

    def forward(self, signal: Signal, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        step = self.quantization
        per_step = materialised(torch.where(step > 0, 1 / torch.where(step > 0, step, 1.0), 0.0))
        level = torch.where(step > 0, step * torch.round(signal * per_step), signal)
        return level.detach() + (signal - signal.detach()) if signal.requires_grad else level, memory

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        q = call.number("quantization")
        return np.where(q > 0, q * np.round(signal / np.where(q > 0, q, 1.0)), signal)


class Dead(Stage):
    """y ← z_j where M_j."""

    name = "dead"

    class Knobs(SpecModel):
        dead_probability: Share = ZERO
        """Chance that a taxel is dead for an episode."""
        dead_range: tuple[AnyAmplitude, AnyAmplitude] = (NO_AMPLITUDE, NO_AMPLITUDE)
        """Lowest and highest stuck reading of a dead taxel, drawn at reset [unit of the reading]."""

    dead_probability: Annotated[Tensor, Number(13, "probability ", " %", stream=random.DEAD)]
    """p."""
    dead_low: Annotated[Tensor, Number(14, "stuck from ", None, "dead_range.0", neutral=None)]
    dead_high: Annotated[Tensor | None, Number(15, "to ", None, "dead_range.1", neutral=None)]
    """None where it is the same as the lower end, for all."""

    @classmethod
    def constants(cls, values: Table, layout: Layout) -> dict[str, np.ndarray]:
        constants = super().constants(values, layout)
        if (np.ptp([*values["dead_low"], *values["dead_high"]], axis=0) == 0).all():
            del constants["dead_high"]
        return constants

    def forward(self, signal: Signal, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        one = signal[:, 0]
        share = torch.zeros_like(one) if self.dead_high is None else uniform(now, random.DEAD, 1, one)
        is_dead = uniform(now, random.DEAD, 0, one) < self.dead_probability[:, 0]
        share = materialised(torch.where(is_dead, share, -1.0))
        share, stuck = share[:, None], self.dead_low
        if self.dead_high is not None:
            stuck = stuck + share * (self.dead_high - stuck)
        return torch.where(share < 0, signal, stuck), memory

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        share = call.uniform(random.DEAD, 2)
        low, high = call.number("dead_low"), call.number("dead_high")
        return np.where(share[:, :1] < call.number("dead_probability"), low + share[:, 1:] * (high - low), signal)


class Release(Stage):
    """Release threshold of bits [m]. It replaces the constant that `decide` of the kind reads; the signal stays as it is."""

    name = "release_threshold"

    class Knobs(SpecModel):
        release_threshold: Annotated[LengthRange | None, Usual("length", high=0.1)] = None
        """Depth below which a `contact` taxel switches off again [m]; default: the sensor's own."""

    release_threshold: Annotated[Tensor, Number(16, unit=" m", absent=(-1.0, -1.0))]

    @classmethod
    def active(cls, values: Table) -> tuple[str, ...]:
        return (cls.name,) if (values["release_threshold"] >= 0).all() else ()


KERNEL = "kernel/"  # kernels of the links, (σ, taxel from, taxel to): `kernel/0000` and so on, in the order of the taxels
NEGLIGIBLE = 1e-14
"""Share of a taxel's signal below which it is set to 0: a millionth of float32's last digit. Products with subnormal numbers
are ten times slower."""


class Neighbourhood(SpecModel):
    """Mixing of neighbouring taxels of a link; the sum over its taxels is conserved."""

    strength: Share
    """χ, share of each taxel's signal that goes to its neighbourhood."""
    sigma: Annotated[Range, RangeOf("length", gt=0.0), Usual("length", high=0.1)]
    """Standard deviation of the Gaussian neighbourhood [m]."""


class Crosstalk(Stage):
    """Spreads each taxel's signal over its link, a product for each: with W, or with G where χ or σ differ between episodes.

    Crosstalk of the taxels of a link: x_j ← Σ_i W_ji x_i, W_ji = (1 − χ_i) δ_ji + χ_i G_ji, G_ji = K_ji / Σ_k K_ki.

    K_ij = exp(−|x_i − x_j|²/2σ²) where the normals are within 90°, else 0. Columns of W add up to 1, so the sum over a link
    stays the same, at edges and corners too, on any layout; a blur that is padded with zeros loses half of a force at a corner.
    Where σ is a range, G mixes the kernels of its ends with a share that is drawn uniformly.
    """

    name = "crosstalk"

    class Knobs(SpecModel):
        crosstalk: Neighbourhood | None = None
        """Mixing of neighbouring taxels."""

    crosstalk_strength: Annotated[Tensor | None, Number(5, "strength ", knob="crosstalk.strength")]
    """χ; None where it is part of the kernels."""
    crosstalk_sigma: Annotated[None, Number(None, knob="crosstalk.sigma", absent=(1.0, 1.0), neutral=None)]
    """σ, part of the kernels."""
    crosstalk_mixture: Annotated[Tensor | None, Number(6, None, knob=None, neutral=None)]
    """Share of the upper σ's kernel; None where σ is no range."""
    kernels: Sequence[Tensor]
    """Of each link, see `KERNEL`."""

    @classmethod
    def constants(cls, values: Table, layout: Layout) -> dict[str, np.ndarray]:
        """Return each link's W, (σ, from, to); where χ or σ is a range, G of the lower σ and the change to the upper one."""
        result: dict[str, np.ndarray] = {}
        strength, (low, high) = values["crosstalk_strength"][:, 0], values["crosstalk_sigma"][:, 0]
        is_wider = bool((low != high).any())
        is_drawn = is_wider or bool((strength[0] != strength[1]).any())
        for i in range(len(layout.links)):
            taxels = np.flatnonzero(layout.link_id == i)
            kernel, wider = (crosstalk_kernel(layout.take(taxels), sigma[taxels]) for sigma in (low, high))
            if not is_drawn:
                kernel = np.diag(1 - strength[0, taxels]) + strength[0, taxels] * kernel
            kernels = [kernel, wider - kernel] if is_wider else [kernel]
            result[f"{KERNEL}{i:04d}"] = np.stack(kernels).transpose(0, 2, 1)
        if is_drawn:
            result["crosstalk_strength"] = compact(values["crosstalk_strength"])
        if is_wider:
            result["crosstalk_mixture"] = np.array([0.0, 1.0])[:, None, None]
        return result

    @classmethod
    def of(cls, values: Mapping[str, Tensor]) -> Crosstalk:
        kernels = [values[name] for name in sorted(name for name in values if name.startswith(KERNEL))]
        return cls(values.get("crosstalk_strength"), None, values.get("crosstalk_mixture"), kernels)

    def forward(self, signal: Signal, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        strength, mixture, kernels = self.crosstalk_strength, self.crosstalk_mixture, self.kernels
        spread = signal if strength is None else signal * strength
        mixed = _product(spread, [kernel[0] for kernel in kernels])
        if mixture is not None:
            mixed = mixed + mixture * _product(spread, [kernel[1] for kernel in kernels])
        return mixed if strength is None else signal - spread + mixed, memory

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        if "operator" not in memory:
            memory["operator"] = _reference_operator(call)
        return memory["operator"] @ signal


def _product(signal: Signal, kernels: Sequence[Tensor]) -> Signal:
    lines = signal.flatten(0, 1)  # of all environments and channels: one product, not one for each environment
    return LINK_PRODUCTS(lines, [kernel[:, None] for kernel in kernels])[0].view(signal.shape)


def crosstalk_kernel(layout: Layout, sigma: Float[np.ndarray, " taxel"]) -> Float[np.ndarray, "taxel taxel"]:
    """Return G (to, from), each column adding up to 1.

    Args:
        layout: Taxels of one link; inactive ones keep their signal.
        sigma: Standard deviation of each giver's neighbourhood [m].
    """
    apart = layout.pos[:, None] - layout.pos[None]
    weight = np.exp(-np.sum(apart**2, axis=-1) / (2 * sigma[None] ** 2))
    weight *= layout.normal @ layout.normal.T > 0
    is_active = layout.radius > 0
    weight *= is_active[:, None] & is_active[None]
    weight[weight < NEGLIGIBLE] = 0.0
    weight[np.diag_indices(len(weight))] = 1.0
    return weight / weight.sum(axis=0)


def _reference_operator(call: ReferenceCall) -> Float[np.ndarray, "row row"]:
    """Return W (to, from), a sum over pairs of taxels."""
    strength, mixture = call.number("crosstalk_strength")[:, 0], call.share("crosstalk_mixture")
    mixed = np.eye(len(strength))
    for i in np.flatnonzero(strength).tolist():
        low, high = (_reference_column(call.layout, i, sigma) for sigma in call.range_of_row(i, "crosstalk_sigma"))
        mixed[:, i] = (1 - strength[i]) * mixed[:, i] + strength[i] * (low + mixture * (high - low))
    return mixed


def _reference_column(layout: Layout | None, i: int, sigma: float) -> Float[np.ndarray, " row"]:
    """Return the share of taxel i's signal that each taxel gets."""
    assert layout is not None
    kernel = np.zeros(layout.num_taxels)
    for j in range(layout.num_taxels):
        are_active = layout.radius[i] > 0 and layout.radius[j] > 0
        if i == j or (are_active and layout.link_id[i] == layout.link_id[j] and layout.normal[i] @ layout.normal[j] > 0):
            kernel[j] = np.exp(-sum((layout.pos[i] - layout.pos[j]) ** 2) / (2 * sigma**2))
    return kernel / kernel.sum()


STAGES: tuple[type[Stage], ...] = (Radius, Gain, Hysteresis, Crosstalk, Delay, Offset, Quantization, Dead, Release)
"""The stages of tgdsl, in their order."""


def _knobs(*stages: type[Stage]) -> frozenset[str]:
    return frozenset(name for stage in stages for name in stage.Knobs.model_fields)


BASE = _knobs(Delay, Offset, Quantization)  # knobs of every kind
PROBE = BASE | _knobs(Radius)  # knobs of a kind that reads distances
TAXEL = PROBE | _knobs(Gain, Dead, Hysteresis)  # knobs of a kind that reads contact
FORCE = TAXEL | _knobs(Crosstalk)  # knobs of a kind whose taxels read forces
