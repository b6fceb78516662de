"""One sensor from what it feels to what is read: gain, equation, noise, sampling, threshold.

Shapes: `env` environments, `row` taxels or bodies, `channel` numbers per row.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry.query import Felt, Probes
from tgdsl.plan import PlannedSensor
from tgdsl.sensors import Kind
from tgdsl.sensors.noise import stages
from tgdsl.sensors.noise.instant import Now, Planes

Tensors = dict[str, Tensor]


def read(
    sensor: PlannedSensor,
    kind: Kind,
    felt: Felt,
    probes: Probes,
    constants: Tensors,
    knobs: Tensors,
    memory: Tensors,
    now: Now | None,
) -> tuple[dict[str, Float[Tensor, "env row channel"]], Tensors]:
    """Return a sensor's readings by name, and its new memory.

    Args:
        sensor: The sensor.
        kind: Its kind.
        felt: What its probes feel.
        probes: Its probes.
        constants: What its kind folded.
        knobs: Values of its noise, see `stages.knob_values`.
        memory: What it remembers, by name.
        now: When it is read; None if it does not matter.
    """
    names = sensor.signal
    terms = () if sensor.noise is None else sensor.noise.terms
    gain = stages.gain(knobs, now, felt.depth) if "gain" in terms and now is not None else None
    if gain is not None and kind.gains_depth:
        felt = felt._replace(depth=gain * felt.depth)
    found, new = kind.forward(felt, probes, constants, _own(memory))
    clean: Planes = [found[name] for name in names]
    signal, noted = clean, {}
    if gain is not None and not kind.gains_depth:
        signal = [gain * plane for plane in signal]
    if terms:
        past = {key: [memory[f"noise/{key}/{name}"] for name in names] for key in _keys(memory, "noise/")}
        signal, noted = stages.disturb(signal, terms, knobs, past, now)
    new = dict(new)
    for key, planes in noted.items():
        new |= {f"noise/{key}/{name}": plane for name, plane in zip(names, planes, strict=True)}
    own = [reading for reading in sensor.readings if reading.name in (sensor.name, f"{sensor.name}/clean")]
    readings: Tensors = {}
    for reading, which, planes in zip(own, ("measured", "clean"), (signal, clean), strict=False):
        made: Mapping[str, Tensor] = {**found, **dict(zip(names, planes, strict=True))}
        if now is not None and now.is_sample is not None:
            held = {name: torch.where(now.is_sample, made[name], memory[f"sample/{which}/{name}"]) for name in names}
            new |= {f"sample/{which}/{name}": plane for name, plane in held.items()}
            made = {**made, **held}
        if kind.decide is not None:
            released = {name: knobs[name][:, 0] for name in ("release_threshold",) if name in knobs}
            made, decided = kind.decide(made, {**constants, **released}, _own(memory))
            new |= decided
        readings[reading.name] = torch.stack([made[name] for name in reading.channels], dim=1).transpose(1, 2)
    for reading in sensor.readings[len(own) :]:
        readings[reading.name] = torch.stack([found[name] for name in reading.channels], dim=1).transpose(1, 2)
    if sensor.period > 0 and now is not None:
        new["sample/phase"] = _phase(memory["sample/phase"], sensor.period, now)
    return readings, new


def _own(memory: Tensors) -> Tensors:
    """Return what the kind remembers."""
    return {name: value for name, value in memory.items() if "/" not in name}


def _keys(memory: Tensors, prefix: str) -> list[str]:
    """Return what is remembered of each channel under a prefix."""
    return list(dict.fromkeys(name.split("/")[1] for name in memory if name.startswith(prefix)))


def _phase(phase: Float[Tensor, " env"], period: float, now: Now) -> Float[Tensor, " env"]:
    """Return the time since a sample was due [s]: from −dt/2 on, as samples are taken at the call that is nearest."""
    assert now.dt is not None
    since = phase + now.dt
    whole = torch.floor((since + 0.5 * now.dt) / period).clamp(min=0)
    return torch.where(now.age[:, 0] == 0, 0.0, since - whole * period)
