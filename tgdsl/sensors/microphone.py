"""Microphone: the sound pressure at a point, the sum over all sources, each delayed and attenuated by its distance.

    p(t) = Σ_i l_i s_i(t − a_i(t)) / max(r_i, r_min)^p,   r_i = c a_i,   a_i = |m(t) − x_i(t − a_i)|/c          [Pa]

s_i is the sound pressure at 1 m of row i of a sensor that makes sound [Pa] and l_i a factor for that sensor. r_i is the
distance from the source, at the instant of emission, to the microphone [m], and c the speed of sound [m/s]. The sources are
other sensors of the document, read at the same physics step (see `sensors.upstream`). A reading is a block of K samples for
each step of a call; the last sample is at the step's end.

- Time: a_i is exact at the ends of steps (`age_of_sound`) where source and microphone move uniformly, and linear within a step.
  So a tone of frequency f is heard at f (1 − v_m/c)/(1 + v_s/c), with the speeds v_m and v_s of microphone and source away from
  each other.
- Between samples, 24 of them are interpolated (`delayed`), exact up to 0.4 of the sample rate. The filter looks ahead, so sound
  arrives at least 12 samples after its emission. Sources nearer than 12 c/f_s are late, but as loud as at their distance.
- Level is linear within a step.
- A source beyond `reach` is not heard, and a warning says so. After a reset there has been no sound, and all was at rest.

Source: Chung et al., *Tactile Genesis*, appendix on audio (1/r^p and r/c). Retarded time of a moving source: Pierce,
*Acoustics*, 4.1 and 11.5.

Departures: motion and interpolation between samples, which the paper does not specify.

Limits: free field, without reflections, obstacles, directivity or absorption by air. The level of a fast source follows its
distance alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, ClassVar, Generic, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field, model_validator
from torch import Tensor

from tgdsl.errors import LowerError, did_you_mean
from tgdsl.fields.models import NonNegative, Position, Positive, PositiveLength, Quantity, Usual
from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.kinematics import Places
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    AnySensorSpec,
    Array,
    Axis,
    Channel,
    Context,
    Fitting,
    Kind,
    Lowered,
    Memory,
    ReferenceContext,
    ReferenceState,
    SurfaceOf,
    scalar,
)
from tgdsl.sensors.upstream import PLACE, SAMPLES, SOUND, Upstream

Speed = Annotated[float, Quantity("speed", gt=0.0)]


class MicrophoneSpec(AnySensorSpec):
    """The sound pressure at a point, from the sensors that make sound."""

    kind: Literal["microphone"]
    """Sound pressure at a point [Pa]: the sum over all sources, each delayed and fainter by its distance; blocks of samples."""
    pos: Position | None = None
    """Position [m]: in the world, or with `body` in that body's frame."""
    body: str | None = None
    """Body of the scene that carries it, at its frame's origin unless `pos` is given; default: fixed in the world."""
    hears: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Sensors to hear; default: all sensors of the document that make sound."""
    levels: dict[str, Positive] = {}
    """Factor on the sound of each sensor, by its name [1]; default: 1."""
    falloff: NonNegative = 1.0
    """Exponent p of the level 1/r^p, r in metres [1]; 1 for a point source in a free field."""
    nearest: Annotated[PositiveLength, Usual("length", low=1e-3, high=1.0)] = 0.01
    """Distance below which a source gets no louder [m]."""
    reach: Annotated[PositiveLength, Usual("length", low=0.05, high=100.0)] = 10.0
    """Distance beyond which nothing is heard [m]; it sets how long sound is remembered."""
    speed: Annotated[Speed, Usual("speed", high=7000.0)] = 343.0
    """Speed of sound, c [m/s]; default: air at 20 °C."""
    is_on_taxels: ClassVar[bool] = False
    needs_taxels: ClassVar[bool] = False

    @model_validator(mode="after")
    def _check(self) -> MicrophoneSpec:
        if self.pos is None and self.body is None:
            raise ValueError("expected `pos`, in the world, or `body`, or both")
        if self.nearest >= self.reach:
            raise ValueError(f"nearest {self.nearest:g} m is not below reach {self.reach:g} m")
        return self

    @property
    def named_bodies(self) -> Mapping[str, str]:
        """The body that carries it."""
        return {} if self.body is None else {"body": self.body}


TAPS, ORDER = 24, 6  # samples T per interpolated value, and coefficients of each tap's polynomial
PASS_BAND = 0.4  # frequency up to which values are exact, as a part of the sample rate
LEAST_DELAY = TAPS // 2  # samples by which sound is late at the least: the filter looks as far ahead


@cache
def coefficients() -> Float[np.ndarray, "power tap"]:
    """Return C.

    Fractional delay: band-limited interpolation between samples by a filter whose taps are polynomials of the fraction.

        x(n + d) ≈ Σ_k h_k(d) x[n + k],   h_k(d) = Σ_m C_mk (d − ½)^m,   k = 1 − T/2 … T/2,   0 ≤ d ≤ 1

    C is the least-squares fit to e^(iωd) for all d and all frequencies up to `PASS_BAND` of the sample rate: there level and
    delay are off by at most 4e-4 and 1e-4 samples. Beyond it level falls, for d = ½ by 1.5 dB at 0.45 and to nothing at 0.5.

    Source: Farrow, "A continuously variable digital delay element", ISCAS 1988; Laakso et al., "Splitting the unit delay", IEEE
    Signal Processing Magazine 13 (1), 1996, for its design by least squares.
    """
    fraction, taps = np.linspace(0.0, 1.0, 17), np.arange(TAPS) - (TAPS // 2 - 1)
    omega = 2 * np.pi * np.linspace(0.0, PASS_BAND, 49)
    powers = (fraction[:, None] - 0.5) ** np.arange(ORDER)
    heard = np.einsum("wk,dm->wdmk", np.exp(1j * np.outer(omega, taps)), powers).reshape(-1, ORDER * TAPS)
    ideal = np.exp(1j * np.outer(omega, fraction)).reshape(-1)
    rows, right = (np.concatenate([np.real(part), np.imag(part)]) for part in (heard, ideal))
    return np.linalg.lstsq(rows, right, rcond=1e-12)[0].reshape(ORDER, TAPS)


def delayed(
    samples: Float[Tensor, "env row sample"],
    end: Int[Tensor, " out"],
    delay: Float[Tensor, "env row out"],
    coefficients: Float[Tensor, "power tap"],
) -> Float[Tensor, "env row out"]:
    """Return samples delayed by a fraction of a sample.

    Args:
        samples: The history, oldest first.
        end: Index of the sample that each delay counts back from.
        delay: Delay in samples, from `LEAST_DELAY` to the length of the history.
        coefficients: C.
    """
    whole = torch.ceil(delay)
    fraction = (whole - delay)[..., None] - 0.5
    first = end - whole.to(torch.int64) - (TAPS // 2 - 1)
    windows = samples.unfold(-1, TAPS, 1)
    taps = torch.gather(windows, 2, first[..., None].expand(*first.shape, TAPS))
    parts = torch.matmul(taps, coefficients.transpose(0, 1)).unbind(-1)
    value = parts[-1]
    for part in parts[-2::-1]:
        value = value * fraction[..., 0] + part
    return value


def age_of_sound(away: Vec, length: Tensor) -> Float[Tensor, "env row"]:
    """Return the age of the sound that arrives now, in steps, at most the last node's age.

    This is the retarded time of moving sources and a moving microphone:

        a = |m(t) − s(t − a)|/c                                                                   [s]

    with the microphone at m and the source at s. Positions are known at the ends of steps, Δt apart, and linear in between. So
    with X_j = m(t) − s(t − jΔt), L = cΔt and the first j with |X_(j+1)| < (j+1) L,

        (j + b)² L² = |X_j + b D|²,   D = X_(j+1) − X_j,   a = (j + b) Δt,

    whose root in 0 ≤ b ≤ 1 is exact for this path. It is the one root where sources are slower than sound. Where one is faster,
    or put elsewhere without a reset, its newest sound to arrive is heard.

    Shapes: `env` environments, `row` rows of sources, `node` steps before now, from 0.

    Args:
        away: X, from the source's places at each node to where the microphone is now: planes (env, node, row) [m].
        length: L, how far sound travels in a step [m].
    """
    distance = planes.safe_sqrt(planes.dot(away, away))
    last = distance.shape[1] - 1
    number = torch.arange(last + 1, device=distance.device)[:, None]
    has_arrived = distance < number * length
    node = torch.where(has_arrived, number, last).amin(dim=1, keepdim=True) - 1
    first, second = (planes.vec(torch.gather(part, 1, node + i)[:, 0] for part in away) for i in (0, 1))
    steps, node_distance = node[:, 0].to(distance.dtype), torch.gather(distance, 1, node)[:, 0]
    moved = planes.sub(second, first)
    # (L² − |D|²) b² + 2 half b + ahead = 0
    square = length * length - planes.dot(moved, moved)
    half = length * length * steps - planes.dot(first, moved)
    ahead = (length * steps - node_distance) * (length * steps + node_distance)
    root = half.abs() + planes.safe_sqrt((half * half - square * ahead).clamp(min=0.0))
    is_none = root <= planes.tiny()
    b = torch.where(half >= 0, -ahead / torch.where(is_none, 1.0, root), root / torch.where(square > 0, square, 1.0))
    return steps + torch.where(is_none, 0.0, b).clamp(0.0, 1.0)


def reference(
    spec: MicrophoneSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return p (sample, 1, 1) [Pa], and the next state."""
    sources = gathered[Upstream]
    emitted = np.concatenate([source[SAMPLES] for source in sources.values()], axis=1)
    place = np.concatenate([source[PLACE] for source in sources.values()], axis=1)
    listener = np.array(spec.pos) if spec.body is None else gathered[Places][0]
    num, num_rows = emitted.shape
    num_nodes, room = state["path"].shape[1], state["history"].shape[1]
    level = np.concatenate([np.full(source[SAMPLES].shape[1], spec.levels.get(name, 1.0)) for name, source in sources.items()])
    if context.is_first:
        track, history = np.repeat(place[None], num_nodes + 1, axis=0), np.zeros((room, num_rows))
    else:
        track, history = np.concatenate([place[None], state["track"][:-1]]), state["emitted"]
    sound = np.concatenate([history, emitted])
    far = spec.reach / spec.speed
    pressure, ages = np.zeros((num, 1, 1)), np.zeros(num_rows)
    for row in range(num_rows):
        ages[row] = reference_age(listener, track[:, :, row], context.dt, spec.speed)
        previous_age = ages[row] if context.is_first else state["ages"][row]
        is_heard = [age <= far and age < num_nodes * context.dt for age in (previous_age, ages[row])]
        distances = [max(spec.speed * age, spec.nearest) for age in (previous_age, ages[row])]
        gains = [level[row] / r**spec.falloff if heard else 0.0 for r, heard in zip(distances, is_heard, strict=True)]
        for k in range(1, num + 1):
            share = k / num
            delay = (previous_age + share * (ages[row] - previous_age)) * num / context.dt
            delay = float(min(max(delay, LEAST_DELAY), room - TAPS // 2))
            value = interpolated(sound[:, row], room + k - 1 - delay)
            pressure[k - 1] += (gains[0] + share * (gains[1] - gains[0])) * value
    after = {"path": state["path"], "history": state["history"]}
    return pressure, after | {"track": track, "emitted": sound[num:], "ages": ages}


def reference_age(listener: Float[np.ndarray, " 3"], track: Float[np.ndarray, "node 3"], dt: float, speed: float) -> float:
    """Return the age of the sound that arrives now [s]; `track` has the source's positions at the last steps, newest first."""
    from scipy.optimize import brentq

    def early(age: float) -> float:
        where = [np.interp(age, dt * np.arange(len(track)), track[:, i]) for i in range(3)]
        return age - float(np.linalg.norm(listener - where)) / speed

    for node in range(1, len(track)):
        if early(node * dt) > 0:
            first, last = (node - 1) * dt, node * dt
            tolerance = {"xtol": 1e-18, "rtol": 4 * np.finfo(float).eps}
            return first if early(first) == 0 else float(brentq(early, first, last, **tolerance))  # type: ignore[arg-type]
    return (len(track) - 1) * dt


def interpolated(samples: Float[np.ndarray, " sample"], place: float) -> float:
    """Return the value between samples, at a number of them from the first."""
    first = int(np.floor(place))
    taps = coefficients().T @ (place - first - 0.5) ** np.arange(len(coefficients()))
    return float(taps @ samples[first - TAPS // 2 + 1 : first + TAPS // 2 + 1])


@dataclass(frozen=True, eq=False)
class MicrophoneConstants(Generic[Array]):
    """Parameters; C of `coefficients`; l of each source's row; the samples' numbers from 1; and m [m], None on a body."""

    falloff: Array
    nearest: Array
    speed: Array
    reach: Array
    coefficients: Array
    levels: Array
    num_samples: Array
    pos: Array | None = None


class MicrophoneState(NamedTuple):
    """State of the sources; see `fit` for shapes."""

    history: Tensor  # samples that have not yet arrived from the largest distance [Pa]
    path: Tensor  # where sources were at earlier steps, from where they are now [m]
    place: Tensor  # where they are in the world [m]
    place_low: Tensor  # what `place` rounds off [m]
    age: Tensor  # age of the sound that arrives now, in steps
    beyond: Tensor  # distance at which a source was not heard [m]; 0: none


def lower(spec: MicrophoneSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """A single row; sizes follow from the sources, see `fit`."""
    pos = (0.0, 0.0, 0.0) if spec.pos is None else spec.pos
    requests = () if spec.body is None else (Places(bodies=(spec.body,), offset=np.array([pos])),)
    rows = Axis("microphone", 1, {"body": ["world" if spec.body is None else spec.body], "pos": np.array([pos])})
    upstream = Upstream(sensors=spec.hears or (), planes=SOUND, what="sound")
    return Lowered((Channel("pressure", "Pa"),), requests=requests, rows=rows, upstream=upstream)


def fit(spec: MicrophoneSpec, lowered: Lowered, fitting: Fitting) -> Lowered:
    """Return it with a level for each source's row, and room for as long as sound takes for the largest distance.

    Raises:
        LowerError: If sources make different numbers of samples, or a level is of none of them.
    """
    first = next(iter(fitting.upstream))
    blocks = {name: source.lowered.sound for name, source in fitting.upstream.items()}
    for name, count in blocks.items():
        if count != blocks[first]:
            problem = f'"{name}" makes {count} samples per physics step, "{first}" {blocks[first]}'
            raise LowerError(problem, "hears", "a microphone hears sources of one sample rate: expected as many of all")
    for name in spec.levels:
        if name not in fitting.upstream:
            raise LowerError(f'it does not hear "{name}"', "levels", did_you_mean(name, fitting.upstream, "sources"))
    levels, timestep = [], fitting.timestep
    for name, source in fitting.upstream.items():
        timestep = source.lowered.timestep or timestep
        levels += [spec.levels.get(name, 1.0)] * source.rows.size
    samples, substeps = blocks[first], fitting.upstream[first].lowered.substeps
    num_nodes = math.ceil(spec.reach / (spec.speed * timestep)) + 1
    room, num_rows = (num_nodes + 1) * samples + TAPS, len(levels)
    rate, least = samples / timestep, LEAST_DELAY * timestep / samples
    notes = (
        f"hears {', '.join(fitting.upstream)} up to {spec.reach:g} m at {rate:g} Hz",
        f"no sound sooner than {1e3 * least:.3g} ms after its emission: all within {spec.speed * least:.3g} m",
    )
    constants = MicrophoneConstants(
        falloff=scalar(spec.falloff),
        nearest=scalar(spec.nearest),
        speed=scalar(spec.speed),
        reach=scalar(spec.reach),
        coefficients=coefficients(),
        levels=np.array(levels),
        num_samples=np.arange(1.0, samples + 1.0),
        pos=np.array(spec.pos) if spec.body is None else None,
    )
    return replace(
        lowered,
        constants=constants,
        state={
            "history": Memory(shape=(num_rows, room)),
            "path": Memory(shape=(3, num_nodes, num_rows)),
            "place": Memory(shape=(3, num_rows)),
            "place_low": Memory(shape=(3, num_rows)),
            "age": Memory(shape=(num_rows,)),
            "beyond": Memory(shape=(num_rows,)),
        },
        substeps=substeps,
        samples=samples,
        timestep=timestep,
        notes=notes,
    )


def forward(
    gathered: Gathered, context: Context, constants: MicrophoneConstants[Tensor], state: MicrophoneState
) -> tuple[dict[str, Tensor], MicrophoneState]:
    """Return the samples of a step, (env, sample, 1, 1) [Pa]."""
    sources = gathered[Upstream].values()
    emitted = torch.cat([source[SAMPLES].transpose(1, 2) for source in sources], dim=1)
    place = torch.cat([source[PLACE] for source in sources], dim=2)
    is_first = context.is_first
    history = torch.where(is_first[..., None], 0.0, state.history)
    sound = torch.cat([history, emitted], dim=2)
    path = _path(place, state, is_first)
    fixed = None if constants.pos is None else constants.pos.to(place.dtype).expand(place.shape[0], 1, 3)
    listener = gathered[Places] if fixed is None else planes.split(fixed)
    here = planes.vec((m - place[:, i]).to(emitted.dtype) for i, m in enumerate(listener))
    age = age_of_sound(planes.vec(here[i][:, None] - path[:, i] for i in range(3)), constants.speed * context.dt)
    last_age = torch.where(is_first, age, state.age)
    num, room = emitted.shape[-1], history.shape[-1]
    share = constants.num_samples / num
    delay = num * (last_age[..., None] + share * (age - last_age)[..., None])
    end = torch.arange(num, device=emitted.device) + room
    delay = delay.nan_to_num().clamp(LEAST_DELAY, room - TAPS // 2)
    arrived = delayed(sound, end, delay, constants.coefficients)
    num_nodes = path.shape[2] - 1
    level, last_level = (_level(steps, num_nodes, constants, context.dt) for steps in (age, last_age))
    gain = last_level[..., None] + share * (level - last_level)[..., None]
    pressure = (gain * arrived).sum(dim=1)
    beyond = torch.maximum(state.beyond, torch.where(level > 0, 0.0, constants.speed * context.dt * age))
    high = place.to(state.place.dtype)
    low = (place - high.to(place.dtype)).to(high.dtype)
    return {"signal": pressure[..., None, None]}, MicrophoneState(sound[:, :, num:], path[:, :, :-1], high, low, age, beyond)


def _path(place: Tensor, state: MicrophoneState, is_first: Tensor) -> Tensor:
    """Return where sources were at each node, from where they are now (env, 3, node, row) [m]."""
    # The state holds places as two numbers of the module's dtype: differences are formed in the precision of `place`.
    last_place = state.place.to(place.dtype) + state.place_low.to(place.dtype)
    moved = torch.where(is_first[..., None], 0.0, (place - last_place).to(state.place.dtype))
    path = torch.where(is_first[..., None, None], 0.0, state.path - moved[:, :, None])
    return torch.cat([torch.zeros_like(path[:, :, :1]), path], dim=2)


def _level(steps: Tensor, num_nodes: int, constants: MicrophoneConstants[Tensor], dt: Tensor) -> Tensor:
    """Return the factor of samples that were emitted some steps ago (env, row)."""
    distance = constants.speed * dt * steps
    near = torch.maximum(distance, constants.nearest)
    level = constants.levels * torch.exp(-constants.falloff * torch.log(near))
    return torch.where((distance > constants.reach) | (steps >= num_nodes), 0.0, level)


def not_heard(name: str, constants: Mapping[str, np.ndarray], rows: Sequence[str], beyond: np.ndarray) -> list[str]:
    """Return which sources were too far away."""
    reach = float(constants["reach"])
    far = [row for row, distance in zip(rows, beyond, strict=True) if distance > 0]
    return [f'"{name}" does not hear {row}: it was farther than `reach`, {reach:g} m' for row in far]


MICROPHONE = Kind(
    MicrophoneSpec,
    lower,
    forward,
    reference,
    knobs=frozenset(),
    is_timed=True,
    reads="hears",
    warns=(("beyond", not_heard),),
    fit=fit,
    constants=MicrophoneConstants,
    state=MicrophoneState,
)
