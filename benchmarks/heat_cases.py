"""Scenes for `heat.py`: five links that touch boxes at random points; and sums of the heat that `temperature_grid` reports."""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

LINKS = 5
SIDE = 0.02
"""Edge of a link's and an object's box [m]."""
EXCHANGE: dict[str, Any] = {"source": {"power": 0.5}, "emissivity": "material", "convection": 10.0}
LAG = {"lag": 0.05}
CASES: dict[str, tuple[int, int, dict[str, Any]]] = {
    "all": (2, 5, EXCHANGE | LAG),
    "one object": (2, 1, EXCHANGE | LAG),
    "five sensors": (2, -5, EXCHANGE | LAG),
    "contact alone": (2, 5, {}),
    "all, 10 × 10 × 10": (10, 5, EXCHANGE | LAG),
    "one object, 10 × 10 × 10": (10, 1, EXCHANGE | LAG),
    "conduction alone, 10 × 10 × 10": (10, 0, {}),
}
"""Cells along each axis, objects (negative: one per link, each with a separate sensor), and fields of the sensor."""


def document(name: str, folder: Path) -> dict[str, Any]:
    """Return the document of a case; write its scene to a folder."""
    cells, num_objects, fields = CASES[name]
    links, objects = [f"link{i}" for i in range(LINKS)], [f"object{i}" for i in range(abs(num_objects))]
    box = f'<freejoint/><geom type="box" size="{0.5 * SIDE} {0.5 * SIDE} {0.5 * SIDE}"/>'
    bodies = "".join(f'<body name="{body}">{box}</body>' for body in [*links, *objects])
    model = folder / "scene.xml"
    model.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    sensor = {"kind": "temperature_grid", "cells": [cells] * 3, "material": "silicone", "temperature": 30.0, **fields}
    sensors = {"heat": {**sensor, "links": links, "feels": objects}}
    if num_objects < 0:
        pairs = zip(links, objects, strict=True)
        sensors = {f"heat{i}": {**sensor, "links": link, "feels": [target]} for i, (link, target) in enumerate(pairs)}
    return {
        "tgdsl": 1,
        "robot": {"model": str(model)},
        "objects": {target: {"body": target, "material": "steel", "temperature": 60.0} for target in objects},
        "sensors": sensors,
    }


def artefact(folder: Path, name: str) -> Path:
    """Return the path of a case's artefact."""
    return folder / f"heat_{name.replace(',', '').replace(' × ', 'x').replace(' ', '_')}.safetensors"


def make_artefacts(options: argparse.Namespace) -> None:
    """Compile all cases."""
    options.folder.mkdir(parents=True, exist_ok=True)
    for name in CASES:
        with TemporaryDirectory() as scratch:
            tgdsl.save(tgdsl.compile(document(name, Path(scratch))), artefact(options.folder, name))


def state_of(touch: TactileModule, num_envs: int, seed: int, share: float = 1.0) -> SceneState:
    """Return a random float32 state on the CPU: each link touches one object (link i object i if there are five) or none.

    Args:
        touch: The module.
        num_envs: Environments.
        seed: Seed of the state.
        share: Probability that a link touches its object.
    """
    state = touch.example_state(num_envs, seed=seed, dtype=torch.float32, spread=0.4 * SIDE).to("cpu")
    if state.contact_found is None:
        return state
    pairs = touch.inputs.pairs
    few = len({pair.object for pair in pairs}) < LINKS
    is_pair = torch.tensor([few or pair.link[4:] == pair.object[6:] for pair in pairs])
    is_contact = is_pair & (torch.rand(num_envs, len(pairs), generator=torch.Generator().manual_seed(seed)) < share)
    for name in ("contact_found", "contact_netforce", "contact_force", "contact_torque", "contact_normal", "contact_pos"):
        value = getattr(state, name)
        value.copy_(value * is_contact.reshape(*is_contact.shape, *[1] * (value.ndim - 2)))
    return state


def reports(readings: dict[str, Tensor], name: str) -> list[Tensor]:
    """Return a report of all sensors (env, row, channel), in float64."""
    return [value.double() for key, value in readings.items() if key.endswith(f"/{name}")]


def stored(readings: dict[str, Tensor]) -> Tensor:
    """Return the heat stored in links and objects (env,) [J]."""
    links, objects = reports(readings, "heat"), reports(readings, "objects")
    return sum((part[..., 0].sum(dim=1) for part in links), start=torch.zeros(())) + sum(
        part[..., 1].sum(dim=1) for part in objects
    )


def gained(readings: dict[str, Tensor]) -> Tensor:
    """Return the heat that links and objects gained from source, radiation and convection (env,) [J]."""
    links, objects = reports(readings, "heat"), reports(readings, "objects")
    of_links = sum((part[..., 1:4].sum(dim=(1, 2)) for part in links), start=torch.zeros(()))
    return of_links + sum(part[..., 2:4].sum(dim=(1, 2)) for part in objects)


def exchanged(readings: dict[str, Tensor]) -> Tensor:
    """Return the sum of the magnitudes of all heat that links and objects exchanged, by contact too (env,) [J]."""
    links, objects = reports(readings, "heat"), reports(readings, "objects")
    of_links = sum((part[..., 1:].abs().sum(dim=(1, 2)) for part in links), start=torch.zeros(()))
    return of_links + sum(part[..., 2:].abs().sum(dim=(1, 2)) for part in objects)
