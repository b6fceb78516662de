"""One sensor from what it feels to what is read: gain, equation, noise, sampling, threshold.

Shapes: `env` environments, `row` taxels or bodies, `channel` numbers per row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import TgdslError, listed
from tgdsl.plan.sensors import PlannedSensor
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.sensors import Kind
from tgdsl.sensors.base import UNTIMED, Constants, Context
from tgdsl.sensors.noise import stages
from tgdsl.sensors.noise.instant import Now
from tgdsl.tensors.fusion import materialised

Tensors = dict[str, Tensor]


def joined_signal(
    kind: Kind, sensors: Sequence[PlannedSensor], gathered: Gathered, constants: Sequence[Constants]
) -> Float[Tensor, "env channel taxel"]:
    """Return the signals of sensors that are computed as one, one sensor's taxels after the other's.

    Args:
        kind: Their kind.
        sensors: The sensors.
        gathered: What they asked for, of the taxels of all of them.
        constants: What was folded for each of them: scalars.
    """
    of_taxels: Tensors = {}
    if names := tuple(constants[0]):
        counts = [end - first for first, end in (sensor.rows for sensor in sensors)]
        rows = [torch.cat([own[name].expand(n) for own, n in zip(constants, counts, strict=True)]) for name in names]
        of_taxels = dict(zip(names, materialised(torch.stack(rows)).unbind(), strict=True))
    found, _ = kind.forward(gathered, UNTIMED, of_taxels, {})
    return _stacked(found, "signal", sensors[0].signal)


def read(
    sensor: PlannedSensor,
    kind: Kind,
    gathered: Gathered,
    context: Context,
    constants: Constants,
    knobs: Tensors,
    memory: Tensors,
    now: Now | None,
    joined: Float[Tensor, "env channel row"] | None = None,
) -> tuple[Tensors, Tensors, Tensors]:
    """Return a sensor's readings by name (env, row, channel), its new memory, and what its kind's `forward` returned.

    Of a sensor with noise the clean signal is among the readings, as `<sensor>/signal` (env, channel, row): a compiler that
    fuses then has the equation write all channels side by side, and would else form them anew for each number of the noise.

    Args:
        sensor: The sensor.
        kind: Its kind.
        gathered: What it asked for.
        context: When its kind is called.
        constants: What its kind folded.
        knobs: Values of its noise, see `stages.knob_values`.
        memory: What it remembers, by name.
        now: When it is read; None if it does not matter.
        joined: Its signal, if that was computed with others'.
    """
    terms = () if sensor.noise is None else sensor.noise.terms
    at = now if "gain" in terms else None
    if at is not None and kind.gains_depth:
        felt = gathered[ContactDepth]
        gathered = gathered.replaced(ContactDepth, felt._replace(depth=stages.gain(knobs, at, felt.depth) * felt.depth))
    found, new = ({}, {}) if joined is not None else _answer(sensor, kind, gathered, context, constants, _own(memory))
    signal = clean = _stacked(found, "signal", sensor.signal) if joined is None else joined
    if at is not None and not kind.gains_depth:
        signal = stages.gain(knobs, at, clean[:, 0])[:, None] * clean
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
    return readings, new, found


def block(
    sensor: PlannedSensor,
    kind: Kind,
    gathered: Sequence[Gathered],
    contexts: Sequence[Context],
    constants: Constants,
    memory: Tensors,
) -> tuple[Tensors, Tensors, list[Tensors]]:
    """Return the reading of a sensor that is advanced at each substep, its new memory, and what its kind returned at each.

    The reading is (env, sample, row, channel).

    Args:
        sensor: The sensor.
        kind: Its kind.
        gathered: What it asked for, at each substep.
        contexts: When its kind is called.
        constants: What its kind folded.
        memory: What it remembers, by name.
    """
    samples, answers, state = [], [], _own(memory)
    for own, context in zip(gathered, contexts, strict=True):
        found, new = _answer(sensor, kind, own, context, constants, state)
        state = {**state, **new}
        made = _stacked(found, "signal", sensor.signal)
        samples.append(made if made.ndim == 4 else made[:, None])
        answers.append(found)
    made = samples[0] if len(samples) == 1 else torch.cat(samples, dim=1)
    return {sensor.name: made.transpose(2, 3)}, dict(state), answers


def _answer(
    sensor: PlannedSensor, kind: Kind, gathered: Gathered, context: Context, constants: Constants, state: Tensors
) -> tuple[Tensors, Tensors]:
    """Return what a kind's `forward` returns, after a look at it.

    Raises:
        TgdslError: If it is not what the kind said when it was lowered.
    """
    answer = kind.forward(gathered, context, constants, state)
    if not torch.compiler.is_compiling():
        _check_answer(sensor, answer, state)
    found, new = answer
    return dict(found), dict(new)


def _check_answer(sensor: PlannedSensor, answer: object, state: Tensors) -> None:
    where = f'sensor "{sensor.name}": `forward` of the kind "{sensor.kind}" returns'
    if not (isinstance(answer, tuple) and len(answer) == 2 and all(isinstance(part, Mapping) for part in answer)):
        raise TgdslError(f"{where} {type(answer).__name__}, expected planes by channel, and the new state by name")
    found, new = answer
    if missing := [name for name in sensor.provides if name not in found]:
        raise TgdslError(f"{where} {listed(list(found)) or 'nothing'}, without {missing[0]}, which the kind provides")
    if missing := [name for name in sensor.signal if name not in found and "signal" not in found]:
        raise TgdslError(f"{where} {listed(list(found)) or 'nothing'}, without the channel {missing[0]}")
    num_rows = sensor.readings[0].num_rows
    for name in ("signal",) if "signal" in found else sensor.signal:
        if found[name].shape[-1] != num_rows:
            shape = tuple(found[name].shape)
            raise TgdslError(f"{where} {name} of shape {shape}, expected {num_rows} rows as its reading has, (env, {num_rows})")
    for name, value in new.items():
        if name not in state:
            known = listed(list(state)) or "none"
            raise TgdslError(f'{where} the state "{name}", which `Lowered.state` does not have: {known}')
        if value.shape != state[name].shape:
            shapes = f"{tuple(value.shape)}, expected {tuple(state[name].shape)}"
            raise TgdslError(f'{where} the state "{name}" of shape {shapes} as the old one')


def _stacked(found: Mapping[str, Tensor], name: str, channels: Sequence[str]) -> Float[Tensor, "env *sample channel row"]:
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
