"""Boxes with made-up contacts: a module of temperatures and its states.

Shapes: `env` environments, `link` links, `x`, `y`, `z` cells.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from oracles.setups.scenes import compiled, folder
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

Contact = tuple[Sequence[Any], Sequence[Any], float | int]
"""A point [m], a normal out of the object, and a normal force [N]."""


def heat_module(
    folder: Path, links: Mapping[str, Sequence[Any]], sensor: Mapping[str, Any],
    objects: Mapping[str, tuple[Sequence[Any] | None, Mapping[str, Any]]] | None = None, dtype: torch.dtype = torch.float64,
) -> TactileModule:  # fmt: skip
    """Return a module with one sensor, `heat`, on boxes with sides [m]; objects have sides (None: a plane) and fields."""
    objects, bodies = objects or {}, []
    for name, sides in {**links, **{name: sides for name, (sides, _) in objects.items()}}.items():
        if sides is None:
            bodies.append(f'<body name="{name}"><geom type="plane" size="1 1 .1"/></body>')
        else:
            half = " ".join(str(0.5 * side) for side in sides)
            bodies.append(f'<body name="{name}"><freejoint/><geom type="box" size="{half}"/></body>')
    path = folder / "boxes.xml"
    path.write_text(f"<mujoco><worldbody>{''.join(bodies)}</worldbody></mujoco>", encoding="utf-8")
    document = {
        "tgdsl": 1,
        "robot": {"model": str(path)},
        "objects": {name: {"body": name, **said} for name, (_, said) in objects.items()},
        "sensors": {"heat": {"kind": "temperature_grid", "links": list(links), "feels": list(objects), **sensor}},
    }
    return compiled(document, dtype)


def heat_state(
    module: TactileModule, dt: float | int, contacts: Mapping[tuple[str, str], Sequence[Contact]] | None = None,
    num_envs: int = 1, heights: Mapping[str, float] | None = None,
) -> SceneState:  # fmt: skip
    """Return a state with contacts by (link, object), in the world's axes; bodies are at the origin, or at heights [m]."""
    inputs, values = module.inputs, dict[str, Any]()
    values["body_pos"] = torch.zeros(num_envs, len(inputs.bodies), 3, dtype=torch.float64)
    for name, height in (heights or {}).items():
        values["body_pos"][:, inputs.bodies.index(name), 2] = height
    values["body_quat"] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(num_envs, len(inputs.bodies), 4).clone()
    if inputs.pairs:
        shape = (num_envs, len(inputs.pairs), inputs.slots, 3)
        for name in ("contact_pos", "contact_force", "contact_torque", "contact_normal"):
            values[name] = torch.zeros(shape, dtype=torch.float64)
        values["contact_netforce"] = torch.zeros(num_envs, len(inputs.pairs), 3, dtype=torch.float64)
        values["contact_found"] = torch.zeros(num_envs, len(inputs.pairs))
        for i, pair in enumerate(inputs.pairs):
            for slot, (pos, normal, force) in enumerate((contacts or {}).get((pair.link, pair.object), ())):
                values["contact_pos"][:, i, slot] = torch.tensor(pos, dtype=torch.float64)
                values["contact_normal"][:, i, slot] = torch.tensor(normal, dtype=torch.float64)
                push = force * torch.tensor(normal, dtype=torch.float64)
                values["contact_force"][:, i, slot] = push
                values["contact_netforce"][:, i] += push
                values["contact_found"][:, i] = 1.0
    return SceneState(**values, dt=dt)


def face_contacts(
    sides: Sequence[Any], height: float, normal: Sequence[Any] = (0, 0, 1), force: float | int = 1.0
) -> list[Contact]:
    """Return contacts at the corners of a centred rectangle across z, at a height [m]."""
    x, y = 0.5 * sides[0], 0.5 * sides[1]
    return [((sx * x, sy * y, height), normal, force) for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1))]


def cells_of(module: TactileModule) -> torch.Tensor:
    """Return the buffer of the links' temperatures above ambient (env, link, x, y, z) [K]; writing it sets them."""
    return module.memory.get_buffer("heat:cells")


def begin(module: TactileModule, state: SceneState, above: np.ndarray | None = None) -> None:
    """Read once to start the episode, and set temperatures of the first link [K]."""
    module(state)
    if above is not None:
        cells_of(module)[:, 0] = torch.as_tensor(above, dtype=cells_of(module).dtype)


def heated(
    links: Mapping[str, Sequence[Any]], sensor: Mapping[str, Any], dt: float, steps: int,
    objects: Mapping[str, tuple[Sequence[Any] | None, Mapping[str, Any]]] | None = None,
    contacts: Mapping[tuple[str, str], Sequence[Contact]] | None = None, heights: Mapping[str, float] | None = None,
    above: np.ndarray | None = None, dtype: torch.dtype = torch.float64,
) -> Iterator[Mapping[str, torch.Tensor]]:  # fmt: skip
    """Yield the readings of each step after the first: see `heat_module`, `heat_state` and `begin`."""
    with folder() as where:
        module = heat_module(where, links, sensor, objects, dtype)
    state = heat_state(module, dt, contacts, heights=heights)
    begin(module, state, above)
    for _ in range(steps):
        yield module(state)
