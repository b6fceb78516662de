"""Microphone: the sound pressure at a point, the sum over all sources of sound, each later and fainter by its distance.

    p(t) = Σ_i l_i s_i(t − a_i(t)) / max(r_i, r_min)^p,   r_i = c a_i,   a_i = |m(t) − x_i(t − a_i)|/c          [Pa]

with s_i the sound pressure at 1 m from row i of a sensor that makes sound [Pa], l_i a factor for that sensor; r_i the distance
in metres from where the source was when it emitted what is heard to where the microphone is, and c the speed of sound
[m/s]. The sources that it hears are sensors of the document; it reads what they find at the same physics step, see
`sensors.upstream`: K samples, the last one at the step's end. So it reads a block of K samples, of each step of a call.

- Time: a_i is exact at the ends of steps (`retarded`), where source and microphone move evenly in between, and linear within a
  step. So a tone of frequency f is heard at f (1 − v_m/c)/(1 + v_s/c), with the speeds v_m and v_s of microphone and source
  away from one another.
- Between samples it is interpolated by 24 of them (`interpolation`), exact up to 0.4 of the sample rate. These look ahead, so
  that no sound is heard sooner than 12 samples after it was made: what is nearer than 12 c/f_s is so late, and as loud as its
  distance says.
- Level is linear within a step.
- A source farther than `reach` is not heard, and a warning says so. After a reset there has been no sound, and all stood still.

Source: the paper, appendix on audio (1/r^p and r/c); Pierce, *Acoustics*, 4.1 and 11.5, for the retarded time of a source that
moves. Departures: the paper says nothing of motion, nor of what is between samples.

Limits: free field. There is neither reflection nor obstacle, directivity, absorption by air, nor the factor of a fast source's
level.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tgdsl.errors import LowerError, did_you_mean
from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.kinematics import Places
from tgdsl.sensors.base import (
    Axis,
    Channel,
    Constants,
    Context,
    Fitting,
    Kind,
    Lowered,
    Memory,
    State,
    SurfaceOf,
    scalar,
)
from tgdsl.sensors.microphone.interpolation import LEAST_DELAY, TAPS, coefficients, delayed
from tgdsl.sensors.microphone.reference import reference
from tgdsl.sensors.microphone.retarded import age_of_sound
from tgdsl.sensors.microphone.spec import MicrophoneSpec
from tgdsl.sensors.upstream import PLACE, SAMPLES, SOUND, Upstream


def lower(spec: MicrophoneSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """A single row; sizes are those of the sources, see `fit`."""
    pos = (0.0, 0.0, 0.0) if spec.pos is None else spec.pos
    constants = {
        "falloff": scalar(spec.falloff),
        "nearest": scalar(spec.nearest),
        "speed": scalar(spec.speed),
        "reach": scalar(spec.reach),
        "coefficients": coefficients(),
    }
    if spec.body is None:
        constants["pos"] = np.array(pos)
    requests = () if spec.body is None else (Places(bodies=(spec.body,), offset=np.array([pos])),)
    rows = Axis("microphone", 1, {"body": ["world" if spec.body is None else spec.body], "pos": np.array([pos])})
    asked = Upstream(sensors=spec.hears or (), planes=SOUND, what="sound")
    return Lowered((Channel("pressure", "Pa"),), constants, requests=requests, rows=rows, upstream=asked)


def fit(spec: MicrophoneSpec, lowered: Lowered, fitting: Fitting) -> Lowered:
    """Return it with a level for each source's row, and room for as long as sound takes for the largest distance.

    Raises:
        LowerError: If sources make different numbers of samples, or a level is of none of them.
    """
    first = next(iter(fitting.upstream))
    blocks = {name: own.lowered.sound for name, own in fitting.upstream.items()}
    for name, count in blocks.items():
        if count != blocks[first]:
            problem = f'"{name}" makes {count} samples per physics step, "{first}" {blocks[first]}'
            raise LowerError(problem, "hears", "a microphone hears sources of one sample rate: expected as many of all")
    for name in spec.levels:
        if name not in fitting.upstream:
            raise LowerError(f'it does not hear "{name}"', "levels", did_you_mean(name, fitting.upstream, "sources"))
    levels, timestep = [], fitting.timestep
    for name, own in fitting.upstream.items():
        timestep = own.lowered.timestep or timestep
        levels += [spec.levels.get(name, 1.0)] * own.rows.size
    samples, substeps = blocks[first], fitting.upstream[first].lowered.substeps
    num_nodes = math.ceil(spec.reach / (spec.speed * timestep)) + 1
    room, num_rows = (num_nodes + 1) * samples + TAPS, len(levels)
    rate, least = samples / timestep, LEAST_DELAY * timestep / samples
    notes = (
        f"hears {', '.join(fitting.upstream)} up to {spec.reach:g} m at {rate:g} Hz",
        f"no sound sooner than {1e3 * least:.3g} ms after it was made: all within {spec.speed * least:.3g} m",
    )
    return replace(
        lowered,
        constants={**lowered.constants, "levels": np.array(levels), "num_samples": np.arange(1.0, samples + 1.0)},
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


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the samples of a step, (env, sample, 1, 1) [Pa]."""
    found = gathered[Upstream].values()
    made = torch.cat([planes_of[SAMPLES].transpose(1, 2) for planes_of in found], dim=1)
    place = torch.cat([planes_of[PLACE] for planes_of in found], dim=2)
    is_first = context.is_first
    history = torch.where(is_first[..., None], 0.0, state["history"])
    sound = torch.cat([history, made], dim=2)
    path, kept = _path(place, state, is_first)
    listener = _listener(gathered, constants, place)
    here = planes.vec((m - place[:, i]).to(made.dtype) for i, m in enumerate(listener))
    age = age_of_sound(planes.vec(here[i][:, None] - path[:, i] for i in range(3)), constants["speed"] * context.dt)
    before = torch.where(is_first, age, state["age"])
    num, room = made.shape[-1], history.shape[-1]
    share = constants["num_samples"] / num
    delay = num * (before[..., None] + share * (age - before)[..., None])
    end = torch.arange(num, device=made.device) + room
    heard = delayed(sound, end, delay.nan_to_num().clamp(LEAST_DELAY, room - TAPS // 2), constants["coefficients"])
    num_nodes = path.shape[2] - 1
    level, level_before = (_level(steps, num_nodes, constants, context.dt) for steps in (age, before))
    gain = level_before[..., None] + share * (level - level_before)[..., None]
    pressure = (gain * heard).sum(dim=1)
    beyond = torch.maximum(state["beyond"], torch.where(level > 0, 0.0, constants["speed"] * context.dt * age))
    new = {"history": sound[:, :, num:], "path": path[:, :, :-1], "age": age, "beyond": beyond, **kept}
    return {"signal": pressure[..., None, None]}, new


def _path(place: Tensor, state: State, is_first: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Return where sources were at each node, from where they are now (env, 3, node, row) [m], and what is kept of now.

    Differences are formed as precisely as the state knows places: what is kept of them is two numbers of the module's dtype.
    """
    dtype = state["place"].dtype
    before = state["place"].to(place.dtype) + state["place_low"].to(place.dtype)
    moved = torch.where(is_first[..., None], 0.0, (place - before).to(dtype))
    path = torch.where(is_first[..., None, None], 0.0, state["path"] - moved[:, :, None])
    path = torch.cat([torch.zeros_like(path[:, :, :1]), path], dim=2)
    high = place.to(dtype)
    return path, {"place": high, "place_low": (place - high.to(place.dtype)).to(dtype)}


def _listener(gathered: Gathered, constants: Constants, place: Tensor) -> Vec:
    """Return where the microphone is in the world, planes (env, 1) [m]."""
    if "pos" in constants:
        return planes.split(constants["pos"].to(place.dtype).expand(place.shape[0], 1, 3))
    return gathered[Places]


def _level(steps: Tensor, num_nodes: int, constants: Constants, dt: Tensor) -> Tensor:
    """Return by what samples are multiplied that were emitted some steps ago (env, row)."""
    distance = constants["speed"] * dt * steps
    near = torch.maximum(distance, constants["nearest"])
    level = constants["levels"] * torch.exp(-constants["falloff"] * torch.log(near))
    return torch.where((distance > constants["reach"]) | (steps >= num_nodes), 0.0, level)


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
)
