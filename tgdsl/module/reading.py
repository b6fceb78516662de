"""One sensor from what it feels to what is read: gain, equation, noise, sampling, threshold.

Shapes: `env` environments, `row` taxels or bodies, `channel` numbers per row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.plan.plan import PlannedSensor
from tgdsl.quantities.contact_depth.query import Felt, Probes
from tgdsl.sensors import Kind
from tgdsl.sensors.base import Constants
from tgdsl.sensors.noise import stages
from tgdsl.sensors.noise.instant import Now
from tgdsl.tensors.fusion import materialised

Tensors = dict[str, Tensor]


def joined_signal(
    kind: Kind, sensors: Sequence[PlannedSensor], felt: Felt, probes: Probes, constants: Sequence[Constants]
) -> Float[Tensor, "env channel taxel"]:
    """Return the signals of sensors that are computed as one, one sensor's taxels after the other's.

    Args:
        kind: Their kind.
        sensors: The sensors.
        felt: What the probes of all of them feel.
        probes: The probes.
        constants: What was folded for each of them: scalars.
    """
    of_taxels: Tensors = {}
    if names := tuple(constants[0]):
        counts = [end - first for first, end in (sensor.rows for sensor in sensors)]
        rows = [torch.cat([own[name].expand(n) for own, n in zip(constants, counts, strict=True)]) for name in names]
        of_taxels = dict(zip(names, materialised(torch.stack(rows)).unbind(), strict=True))
    found, _ = kind.forward(felt, probes, of_taxels, {})
    return _stacked(found, "signal", sensors[0].signal)


def read(
    sensor: PlannedSensor,
    kind: Kind,
    felt: Felt,
    probes: Probes,
    constants: Tensors,
    knobs: Tensors,
    memory: Tensors,
    now: Now | None,
    joined: Float[Tensor, "env channel row"] | None = None,
) -> tuple[Tensors, Tensors]:
    """Return a sensor's readings by name (env, row, channel), and its new memory.

    Of a sensor with noise the clean signal is among the readings, as `<sensor>/signal` (env, channel, row): a compiler that
    fuses then has the equation write all channels side by side, and would else form them anew for each number of the noise.

    Args:
        sensor: The sensor.
        kind: Its kind.
        felt: What its probes feel.
        probes: Its probes.
        constants: What its kind folded.
        knobs: Values of its noise, see `stages.knob_values`.
        memory: What it remembers, by name.
        now: When it is read; None if it does not matter.
        joined: Its signal, if that was computed with others'.
    """
    terms = () if sensor.noise is None else sensor.noise.terms
    like = felt.depth if joined is None else joined[:, 0]
    gain = stages.gain(knobs, now, like) if "gain" in terms and now is not None else None
    if gain is not None and kind.gains_depth:
        felt = felt._replace(depth=gain * felt.depth)
    found, new = ({}, {}) if joined is not None else kind.forward(felt, probes, constants, _own(memory))
    new = dict(new)
    signal = clean = _stacked(found, "signal", sensor.signal) if joined is None else joined
    if gain is not None and not kind.gains_depth:
        signal = gain[:, None] * clean
    if terms:
        past = {name.removeprefix("noise/"): value for name, value in memory.items() if name.startswith("noise/")}
        signal, noted = stages.disturb(signal, terms, knobs, past, now)
        new |= {f"noise/{name}": value for name, value in noted.items()}
    own = [reading for reading in sensor.readings if reading.name in (sensor.name, f"{sensor.name}/clean")]
    readings: Tensors = {f"{sensor.name}/signal": clean} if terms else {}
    for reading, which, made in zip(own, ("measured", "clean"), (signal, clean), strict=False):
        if now is not None and now.is_sample is not None:
            made = torch.where(now.is_sample[..., None], made, memory[f"sample/{which}"])
            new[f"sample/{which}"] = made
        if kind.decide is not None:
            released = {name: knobs[name][:, 0] for name in ("release_threshold",) if name in knobs}
            planes = dict(zip(sensor.signal, made.unbind(1), strict=True))
            planes, decided = kind.decide(planes, {**constants, **released}, _own(memory))
            made = torch.stack([planes[name] for name in reading.channels], dim=1)
            new |= decided
        readings[reading.name] = made.transpose(1, 2)
    for reading in sensor.readings[len(own) :]:
        report = reading.name.rpartition("/")[2]
        readings[reading.name] = _stacked(found, f"{report}/signal", reading.channels).transpose(1, 2)
    if now is not None and now.period is not None:
        new["sample/phase"] = _phase(memory["sample/phase"], now.period, now)
    return readings, new


def _stacked(found: Mapping[str, Tensor], name: str, channels: Sequence[str]) -> Float[Tensor, "env channel row"]:
    """Return what a kind found as one tensor: by its name, or of the planes of its channels."""
    return found[name] if name in found else torch.stack([found[channel] for channel in channels], dim=1)


def _own(memory: Tensors) -> Tensors:
    """Return what the kind remembers."""
    return {name: value for name, value in memory.items() if "/" not in name}


def _phase(phase: Float[Tensor, " env"], period: Tensor, now: Now) -> Float[Tensor, " env"]:
    """Return the time since a sample was due [s]: from −dt/2 on, as samples are taken at the call that is nearest."""
    assert now.dt is not None
    since = phase + now.dt
    whole = torch.floor((since + 0.5 * now.dt) / period).clamp(min=0)
    return torch.where(now.age[:, 0] == 0, 0.0, since - whole * period)
