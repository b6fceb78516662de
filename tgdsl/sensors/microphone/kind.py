"""Microphone: the sound pressure at a point, the sum over all sources of sound, each later and fainter by its distance.

    p(t) = Σ_i l_i s_i(t − a_i(t)) / max(r_i, r_min)^p,   r_i = c a_i,   a_i = |m(t) − x_i(t − a_i)|/c          [Pa]

with s_i the sound pressure at 1 m from row i of a sensor that makes sound [Pa], l_i a factor for that sensor; r_i the distance
in metres from the source, at the instant of emission, to the microphone, and c the speed of sound
[m/s]. The sources that it hears are sensors of the document; it reads what they find at the same physics step, see
`sensors.upstream`: K samples, the last one at the step's end. So it reads a block of K samples, of each step of a call.

- Time: a_i is exact at the ends of steps (`retarded`), where source and microphone move evenly in between, and linear within a
  step. So a tone of frequency f is heard at f (1 − v_m/c)/(1 + v_s/c), with the speeds v_m and v_s of microphone and source
  away from one another.
- Between samples it is interpolated by 24 of them (`interpolation`), exact up to 0.4 of the sample rate. These look ahead, so
  that sound arrives at least 12 samples after its emission: from sources nearer than 12 c/f_s it is late, but as loud as at
  their distance.
- Level is linear within a step.
- A source farther than `reach` is not heard, and a warning says so. After a reset there has been no sound, and all stood still.

Source: the paper, appendix on audio (1/r^p and r/c); Pierce, *Acoustics*, 4.1 and 11.5, for the retarded time of a source that
moves. Departures: the paper specifies neither motion nor interpolation between samples.

Limits: free field. There is neither reflection nor obstacle, directivity, absorption by air, nor the factor of a fast source's
level.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.errors import LowerError, did_you_mean
from tgdsl.geometry import planes
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.kinematics import Places
from tgdsl.sensors.base import (
    Array,
    Axis,
    Channel,
    Context,
    Fitting,
    Kind,
    Lowered,
    Memory,
    SurfaceOf,
    scalar,
)
from tgdsl.sensors.microphone.interpolation import LEAST_DELAY, TAPS, coefficients, delayed
from tgdsl.sensors.microphone.reference import reference
from tgdsl.sensors.microphone.retarded import age_of_sound
from tgdsl.sensors.microphone.spec import MicrophoneSpec
from tgdsl.sensors.upstream import PLACE, SAMPLES, SOUND, Upstream


@dataclass(frozen=True, eq=False)
class MicrophoneConstants(Generic[Array]):
    """Parameters; C of `interpolation`; l of each source's row; the samples' numbers from 1; and m [m], None on a body."""

    falloff: Array
    nearest: Array
    speed: Array
    reach: Array
    coefficients: Array
    levels: Array
    num_samples: Array
    pos: Array | None = None


class MicrophoneState(NamedTuple):
    """State of the sources; see `fit` for shapes.

    Attributes:
        history: Samples that have not yet arrived from the largest distance [Pa].
        path: Where sources were at earlier steps, from where they are now [m].
        place: Where they are in the world [m].
        place_low: What `place` rounds off [m].
        age: Age of the sound that arrives now, in steps.
        beyond: Distance at which a source was not heard [m]; 0: none.
    """

    history: Tensor
    path: Tensor
    place: Tensor
    place_low: Tensor
    age: Tensor
    beyond: Tensor


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
    """Return where sources were at each node, from where they are now (env, 3, node, row) [m].

    Differences are formed in the precision of `place`, which the state holds as two numbers of the module's dtype.
    """
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
