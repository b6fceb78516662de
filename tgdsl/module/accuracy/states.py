"""Recorded states: moved, some of their fields or environments, and what a module reads of them.

Shapes: `step` calls, `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from scipy.spatial.transform import Rotation
from torch import Tensor

from tgdsl.errors import StateError, listed
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SHAPES, SceneState
from tgdsl.plan.inputs import Inputs
from tgdsl.quantities.contacts import SLOT_FIELDS


def moved(state: SceneState, offset: np.ndarray, turn: Rotation) -> SceneState:
    """Return the whole scene, rotated about the origin and then shifted [m]; float64."""
    rotation = torch.from_numpy(turn.as_matrix())
    values = {name: getattr(state, name) for name in (*SHAPES, "dt")}
    for name in ("body_pos", "body_linvel", "body_angvel", *SLOT_FIELDS, "contact_netforce"):
        if values[name] is not None:
            values[name] = values[name].double() @ rotation.T
    values["body_pos"] = values["body_pos"] + torch.from_numpy(offset)
    if values["contact_pos"] is not None:
        is_used = (values["contact_normal"] != 0).any(dim=-1, keepdim=True)
        values["contact_pos"] = torch.where(is_used, values["contact_pos"] + torch.from_numpy(offset), 0.0)
    quats = Rotation.from_quat(values["body_quat"].reshape(-1, 4).numpy(), scalar_first=True)
    turned = torch.from_numpy((turn * quats).as_quat(scalar_first=True))
    values["body_quat"] = turned.reshape(values["body_quat"].shape)
    return SceneState(**values, substeps=tuple(moved(part, offset, turn) for part in state.substeps))


def only(state: SceneState, envs: Any) -> SceneState:
    """Return some of the environments of a state."""
    values: dict[str, Any] = {name: getattr(state, name) for name in (*SHAPES, "dt")}
    selected: dict[str, Any] = {name: value[envs] if isinstance(value, Tensor) else value for name, value in values.items()}
    return SceneState(**selected, substeps=tuple(only(part, envs) for part in state.substeps))


TOGETHER = 1e-6  # distances [m] that differ by less count as equal where a row is looked for by its place


def narrowed(state: SceneState, have: Mapping[str, Sequence[str]], inputs: Inputs) -> SceneState:
    """Return what a module wants of a state that has more; `have` is `Inputs.names` of the module that it was recorded for."""
    want = inputs.names
    for axis in want:
        if missing := [name for name in want[axis] if name not in have[axis]]:
            raise StateError(f"these states lack the {axis} {listed(missing)}: they are of another document")
    places = {axis: torch.tensor([have[axis].index(name) for name in want[axis]], dtype=torch.int64) for axis in want}
    values: dict[str, Any] = {}
    for name in (name for name in inputs.fields if name in SHAPES):
        value = getattr(state, name)
        if value is None:
            raise StateError(f"these states have no {name}: they are of another document")
        for dim, axis in enumerate(SHAPES[name], start=1):
            if axis == "slot":
                if value.shape[dim] < inputs.slots:
                    raise StateError(f"these states have {value.shape[dim]} contacts of a pair, expected {inputs.slots}")
                value = value.narrow(dim, 0, inputs.slots)
            elif isinstance(axis, str):
                value = value.index_select(dim, places[axis].to(value.device))
        values[name] = value
    parts = tuple(narrowed(part, have, inputs) for part in state.substeps)
    return SceneState(**values, dt=state.dt, substeps=parts)


def readings_of(touch: TactileModule, states: Sequence[SceneState], name: str) -> Float[np.ndarray, "step env row channel"]:
    """Return what a module reads of states that follow each other, from a reset on; samples of blocks are rows."""
    touch.free()
    results = []
    with torch.no_grad():
        for state in states:
            reading = touch(state.to(touch.device))[name].double().cpu()
            results.append(reading.flatten(1, -2))
    touch.free()
    return torch.stack(results).numpy()


class Common(NamedTuple):
    """The shared part of two modules' readings of a sensor: readings at the same places, samples at the same times."""

    here: Int[np.ndarray, " row"] | None  # rows of the first module's reading that the second has too; None: all
    there: Sequence[Int[np.ndarray, " row"]] | None  # per row, rows of the second reading to average; None: the same
    channels: Int[np.ndarray, " channel"] | None  # per channel, the second's channel; -1: none, read as 0; None: the same

    def of_one(self, readings: Shaped[np.ndarray, "step env row channel"]) -> np.ndarray:
        """Return the first module's reading in the shared rows."""
        return readings if self.here is None else readings[:, :, self.here]

    def of_other(self, readings: Float[np.ndarray, "step env row channel"]) -> np.ndarray:
        """Return the second module's reading in the shared rows, in the first's channels."""
        if self.there is not None:
            readings = np.stack([readings[:, :, at].mean(axis=2) for at in self.there], axis=2)
        if self.channels is not None:
            readings = np.where(self.channels >= 0, readings[..., self.channels], 0.0)
        return readings


def common_of(own: TactileModule, other: TactileModule, name: str) -> Common:
    """Return the shared part of two modules' readings of a sensor.

    A row is compared with the nearest row on the same link, or with the mean of equally near rows. A block's last sample is at
    its end; samples are compared at times that both blocks have. Channels are matched by name.
    """
    one, two = (next(output for output in touch.outputs if output.name == name) for touch in (own, other))
    there = _rows_at(own, other, name)
    channels = None
    if one.channels != two.channels:
        channel_index = {channel: i for i, channel in enumerate(two.channels)}
        channels = np.array([channel_index.get(channel, -1) for channel in one.channels])
    samples, more = (output.shape[0] if len(output.shape) > 2 else 1 for output in (one, two))
    if samples == more:
        width = two.shape[-2]
        rows_there = None if there is None else [k * width + at for k in range(samples) for at in there]
        return Common(None, rows_there, channels)
    times = [(k, (k + 1) * more // samples - 1) for k in range(samples) if (k + 1) * more % samples == 0]
    rows, width = one.shape[-2], two.shape[-2]
    alone = [np.array([row]) for row in range(rows)] if there is None else there
    here = np.concatenate([k * rows + np.arange(rows) for k, _ in times])
    return Common(here, [j * width + at for _, j in times for at in alone], channels)


def _rows_at(own: TactileModule, other: TactileModule, name: str) -> list[Int[np.ndarray, " row"]] | None:
    """Return, for each row of a module's reading, the rows of another's at its place; None: they are the same rows."""
    here, there = (touch.rows.get(name) for touch in (own, other))
    if here is None or there is None or (len(here) == len(there) and (here == there).all()):
        return None
    columns = here.dtype.names or ()
    if not {"link", "pos"} <= set(columns):
        raise StateError(f'readings of "{name}" differ in their rows, which have no places: {", ".join(columns)}')
    results = []
    for link, pos in zip(here["link"], here["pos"], strict=True):
        at = np.flatnonzero(there["link"] == link)
        distance = np.linalg.norm(there["pos"][at] - pos, axis=1)
        results.append(at[distance <= distance.min() + TOGETHER])
    return results
