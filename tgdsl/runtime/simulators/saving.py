"""The state of a simulation as tensors by name: what its environments' future follows from.

Names: `state/<array of MuJoCo>`, `properties/<field of the model>`, `heat/temperature` and `heat/material`,
`start/is_placed`, `start/<field of a state>`, and `faults/counts`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.runtime.simulators.faults import EnvFaults
from tgdsl.runtime.simulators.objects.properties import ObjectProperties
from tgdsl.runtime.simulators.start_contacts import StartContacts
from tgdsl.runtime.simulators.state_values import INTEGRATED


def saved_state(
    arrays: Mapping[str, Tensor],
    heat: Mapping[str, Tensor],
    properties: ObjectProperties,
    start: StartContacts,
    faults: EnvFaults,
) -> dict[str, Tensor]:
    """Return copies of a simulation's state by name."""
    is_placed, values = start.placed
    found = {f"state/{name}": arrays[name] for name in INTEGRATED} | dict(heat)
    found |= {f"properties/{name}": value for name, value in properties.fields().items()}
    if is_placed is not None:
        found |= {"start/is_placed": is_placed} | {f"start/{name}": value for name, value in values.items()}
    return {name: value.clone() for name, value in (found | {"faults/counts": faults.counts}).items()}


def load_state(
    saved: Mapping[str, Tensor],
    arrays: Mapping[str, Tensor],
    heat: Mapping[str, Tensor],
    properties: ObjectProperties,
    start: StartContacts,
    faults: EnvFaults,
    forward: Callable[[], None],
) -> None:
    """Put a simulation into a saved state, and evaluate poses and contacts there.

    Raises:
        SimulationError: If it is that of another simulation; nothing has changed.
    """
    wanted = {f"state/{name}": arrays[name] for name in INTEGRATED} | {**heat, "faults/counts": faults.counts}
    wrong = [name for name, now in wanted.items() if name not in saved or saved[name].shape != now.shape]
    if wrong:
        raise SimulationError(f"this is the state of another simulation: {listed(wrong)} missing or of another shape")
    own = {part: _below(saved, part) for part in ("properties", "start")}
    properties.set_fields(own["properties"])
    with torch.no_grad():
        for name, now in wanted.items():
            now.copy_(saved[name])
        faults.clear(torch.ones_like(faults.mask))
    forward()
    is_placed = own["start"].pop("is_placed", None)
    device = faults.counts.device
    start.placed = None if is_placed is None else (is_placed.to(device), {n: v.to(device) for n, v in own["start"].items()})


def _below(saved: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    return {name.removeprefix(f"{part}/"): value for name, value in saved.items() if name.startswith(f"{part}/")}
