"""A tone that each link emits, and a microphone that hears it while bodies move along x.

Shapes: `env` environments, `sample` samples, `row` rows of a sensor.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, StrictInt
from torch import Tensor

from tgdsl.fields.models import Frequency, Number
from tgdsl.layout.layout import Layout
from tgdsl.module.module import TactileModule
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.kinematics import Places
from tgdsl.quantities.reference import References
from tgdsl.runtime.connect import simulate
from tgdsl.sensors.base import (
    Channel,
    Constants,
    Context,
    Kind,
    LinkSpec,
    Lowered,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    body_axis,
    scalar,
)
from tgdsl.sensors.upstream import PLACE, SAMPLES, SOUND
from tgdsl.tuning.compile import compile


class ToneSpec(LinkSpec):
    """A tone."""

    kind: Literal["tone"]
    """A tone [Pa]."""
    frequency: Frequency = 100.0
    """Frequency of the first link [Hz]; others are 1.3, 1.6, … times as high."""
    pulse: StrictInt = -1
    """Instead of a tone: a pulse at this sample of the episode's second step."""
    samples: Annotated[StrictInt, Field(ge=1)] = 16
    """Per step."""
    substeps: Annotated[StrictInt, Field(ge=1)] = 1
    """Steps per call."""
    amplitude: Number = 1.0
    """[Pa]."""


def reference(
    spec: ToneSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the samples and the positions of their sources."""
    rows, count = len(layout.bodies), np.arange(1, spec.samples + 1)
    time = context.time - context.dt + count * context.dt / spec.samples
    rate = 2 * np.pi * spec.frequency * (1 + 0.3 * np.arange(rows))
    made = spec.amplitude * np.sin(np.outer(time, rate)) * (time >= 0)[:, None]
    return made[:, None, :, None].swapaxes(1, 2), {}, {SAMPLES: made, PLACE: gathered[Places].T}


def lower(spec: ToneSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Rows are bodies."""
    rows = len(layout.bodies)
    constants = {
        "rate": 2 * np.pi * spec.frequency * (1 + 0.3 * np.arange(rows)),
        "share": np.arange(1, spec.samples + 1) / spec.samples - 1,
        "amplitude": scalar(spec.amplitude),
        "pulse": scalar(float(spec.pulse)),
    }
    places = Places(bodies=layout.bodies, offset=np.zeros((rows, 3)))
    blocks: dict[str, Any] = {"substeps": spec.substeps, "samples": spec.samples, "sound": spec.samples, "provides": SOUND}
    return Lowered((Channel("tone", "Pa"),), constants, requests=(places,), rows=body_axis(layout), **blocks)


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the samples and the positions of their sources."""
    time = context.time.double() + constants["share"].double() * context.dt.double()
    phase = time[:, :, None] * constants["rate"].double()
    made = constants["amplitude"] * (torch.sin(phase) * (time >= 0)[:, :, None]).to(context.time.dtype)
    count = torch.arange(made.shape[1], device=made.device)[None, :, None]
    is_pulse = (count == constants["pulse"]) & (torch.abs(context.time - context.dt) < 0.5 * context.dt)[..., None]
    made = torch.where(constants["pulse"] >= 0, is_pulse.to(made.dtype), made)
    return {"signal": made[:, :, None], SAMPLES: made, PLACE: torch.stack(gathered[Places], dim=1)}, {}


TONE = Kind(ToneSpec, lower, forward, reference, knobs=frozenset(), is_timed=True, provides=SOUND)


SCENE = """<mujoco><option timestep=".001" gravity="0 0 0"/><worldbody>
  <body name="a"><freejoint/><geom size=".01"/></body>
  <body name="b"><freejoint/><geom size=".01"/></body>
</worldbody></mujoco>"""
RATE, SPEED = 20000.0, 343.0
"""Sample rate [Hz] and speed of sound [m/s]."""
PITCH = 3000.0
"""Default frequency of the tone [Hz]."""


def listening(
    folder: Path, mic: Mapping[str, Any] | None = None, tone: Mapping[str, Any] | None = None,
    dtype: torch.dtype | str = torch.float64, **sensors: Any,
) -> TactileModule:  # fmt: skip
    """Return a module with a microphone on `b`, `mic`, that hears a tone from `a`, `tone`, and other sensors."""
    (folder / "listening.xml").write_text(SCENE, encoding="utf-8")
    tones = {"kind": "tone", "links": "a", "samples": 20, "frequency": PITCH, **(tone or {})}
    ear = {"kind": "microphone", "body": "b", **(mic or {})}
    robot = {"model": str(folder / "listening.xml")}
    return compile({"tgdsl": 1, "robot": robot, "sensors": {"mic": ear, "tone": tones, **sensors}}, kinds=[TONE], dtype=dtype)


def heard(
    touch: TactileModule, steps: int, source: Any = (0.0, 0, 0), listener: Any = (0.0, 0, 0), speeds: Any = (0.0, 0.0),
    names: Sequence[str] = ("mic",),
) -> Any:  # fmt: skip
    """Return all samples of some sensors while bodies move along x from their starts [m, m/s].

    Shape: (env, sample, row) if source, listener or speeds are lists over environments, otherwise (sample, row), or
    (sample,) for a microphone.
    """
    source, listener, speeds = (np.atleast_2d(np.asarray(value, dtype=np.float64)) for value in (source, listener, speeds))
    num = max(len(source), len(listener), len(speeds))
    sim = simulate(touch, num)
    sim.qpos[:, :3], sim.qpos[:, 7:10] = torch.from_numpy(source), torch.from_numpy(listener)
    sim.qvel[:, [0, 6]] = torch.from_numpy(np.broadcast_to(speeds, (num, 2)).copy())
    sim.forward()
    blocks: dict[str, list[torch.Tensor]] = {name: [] for name in names}
    for _ in range(steps):
        sim.step()
        readings = touch(sim.state())
        for name in names:
            blocks[name].append(readings[name][:, :, :, 0])
    samples = [torch.cat(blocks[name], dim=1).double().numpy() for name in names]
    samples = samples if num > 1 else [block[0] for block in samples]
    return samples if len(samples) > 1 else samples[0][..., 0]


def frequency_of(samples: np.ndarray) -> float:
    """Return the frequency of a tone [Hz], by the peak of its windowed spectrum."""
    spectrum = np.abs(np.fft.rfft(samples / np.abs(samples).max() * np.hanning(len(samples)), 1 << 20))
    k = int(spectrum.argmax())
    left, top, right = np.log(spectrum[k - 1 : k + 2])
    return float((k + 0.5 * (left - right) / (left - 2 * top + right)) * RATE / (1 << 20))


def away(distances: Any) -> np.ndarray:
    """Return positions at these distances along x [m]."""
    return np.outer(distances, [1.0, 0, 0])
