"""What a microphone hears of a tone, bodies moving along x.

Shapes: `env` environments, `sample` samples, `row` rows of a sensor.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from oracles.setups.tone import TONE
from tgdsl.module.module import TactileModule
from tgdsl.runtime.simulate import simulate
from tgdsl.tuning.compile import compile

SCENE = """<mujoco><option timestep=".001" gravity="0 0 0"/><worldbody>
  <body name="a"><freejoint/><geom size=".01"/></body>
  <body name="b"><freejoint/><geom size=".01"/></body>
</worldbody></mujoco>"""
RATE, SPEED = 20000.0, 343.0
"""Sample rate [Hz] and speed of sound [m/s]."""
PITCH = 3000.0
"""Of the tone, if no other is given [Hz]."""


def listening(
    folder: Path,
    mic: Mapping[str, Any] | None = None,
    tone: Mapping[str, Any] | None = None,
    dtype: torch.dtype | str = torch.float64,
    **sensors: Any,
) -> TactileModule:
    """Return a module with a microphone on `b`, `mic`, that hears a tone from `a`, `tone`, and other sensors."""
    (folder / "listening.xml").write_text(SCENE, encoding="utf-8")
    tones = {"kind": "tone", "links": "a", "samples": 20, "frequency": PITCH, **(tone or {})}
    ear = {"kind": "microphone", "body": "b", **(mic or {})}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "listening.xml")},
        "sensors": {"mic": ear, "tone": tones, **sensors},
    }
    return compile(document, kinds=[TONE], dtype=dtype)


def heard(
    touch: TactileModule,
    steps: int,
    source: Any = (0.0, 0, 0),
    listener: Any = (0.0, 0, 0),
    speeds: Any = (0.0, 0.0),
    names: Sequence[str] = ("mic",),
) -> Any:
    """Return all samples of some sensors, bodies moving along x from where they begin [m, m/s].

    Of several environments, whose source, listener or speeds are lists, (env, sample, row); of one (sample, row), and of a
    microphone alone without the row.
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
    found = [torch.cat(blocks[name], dim=1).double().numpy() for name in names]
    found = [own if num > 1 else own[0] for own in found]
    return found if len(found) > 1 else found[0][..., 0]


def frequency_of(samples: np.ndarray) -> float:
    """Return the frequency of a tone [Hz], by the peak of its windowed spectrum."""
    spectrum = np.abs(np.fft.rfft(samples / np.abs(samples).max() * np.hanning(len(samples)), 1 << 20))
    k = int(spectrum.argmax())
    left, top, right = np.log(spectrum[k - 1 : k + 2])
    return float((k + 0.5 * (left - right) / (left - 2 * top + right)) * RATE / (1 << 20))


def away(distances: Any) -> np.ndarray:
    """Return places at some distances along x [m]."""
    return np.outer(distances, [1.0, 0, 0])
