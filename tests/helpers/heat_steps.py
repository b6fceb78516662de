"""Random arguments of a step of temperatures: links of which some touch objects of one temperature."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.quantities.patches import ContactPatch, HeatOfObjects, Topology, is_cell, tables
from tgdsl.sensors.temperature_grid.losses import stefan_boltzmann, zero_celsius
from tgdsl.sensors.temperature_grid.rows import rows_of

NUM_ENVS = 7


class Case(NamedTuple):
    """What there is: cells of each link along each axis, objects, terms, whether materials differ by environment, Δt [s].

    `keeps`: whether the last object keeps its temperature.
    """

    count: tuple[tuple[int, int, int], ...]
    num_objects: int
    terms: tuple[str, ...] = ("emissivity", "convection", "source")
    is_per_env: bool = False
    dt: float = 0.01
    keeps: bool = False


CASES = {
    "one object": Case(((2, 2, 2),) * 5, 1),
    "other cells": Case(((2, 3, 2), (1, 2, 4), (3, 1, 1)), 1, is_per_env=True),
    "contact alone": Case(((2, 2, 2),) * 3, 1, ()),
    "one cell": Case(((1, 1, 1),), 1, ("convection",)),
    "long steps": Case(((2, 2, 3), (2, 2, 2)), 1, dt=10.0),
    "a plane": Case(((2, 2, 3), (2, 2, 2)), 1, keeps=True),
}


def arguments(name: str, dtype: torch.dtype, num_envs: int = NUM_ENVS) -> tuple:
    """Return the arguments of `step`."""
    case, rng = CASES[name], np.random.default_rng(3)
    num, objects = len(case.count), case.num_objects

    def tensor(value) -> Tensor:
        return torch.as_tensor(np.asarray(value, dtype=np.float32)).to(dtype)

    low = rng.uniform(-0.02, 0.0, (num, 3))
    boxes = np.stack([low, low + rng.uniform(0.01, 0.03, (num, 3))], axis=1)
    count, size = np.array(case.count), boxes[:, 1] - boxes[:, 0]
    there = is_cell(count)
    given = {"emissivity": rng.uniform(0.3, 0.9, num), "convection": 20.0, "source": rng.uniform(0, 0.5, there.shape) * there}
    given = {key: value for key, value in given.items() if key in case.terms}
    conductivity, cell = rng.uniform(0.2, 50.0, num), size / count
    radiated = 4 * stefan_boltzmann() * given.get("emissivity", np.zeros(num)) * (22.0 + zero_celsius()) ** 3
    total = (radiated + given.get("convection", 0.0))[:, None]
    film = total / (1 + total * cell / (2 * conductivity[:, None]) * (1 - 2 / (3 * count)))
    found = tables(count, size, loss=film * cell / conductivity[:, None])
    if film.any():
        found |= {"film": film, "film_radiated": radiated / total[:, 0]}
    constants = {key: tensor(value) for key, value in found.items()} | {
        "box": tensor(np.concatenate([low, size / count, count], axis=1)),
        "conductivity": tensor(conductivity),
        "volumetric_heat": tensor(rng.uniform(1e6, 3e6, num)),
        "ambient": tensor(22.0),
        "compliance": tensor(rng.uniform(1e-8, 1e-6, num)),
        "curvature": tensor(rng.uniform(50, 200, num)),
        "contact_conductance": tensor(2000.0),
    }
    constants |= {key: tensor(value) for key, value in given.items()}
    if "source" in constants:
        constants["power"] = constants["source"].sum(dim=(1, 2, 3))
    where = Topology(num, ((1, 1, 1),) * objects, (), tuple(range(objects)), (-1,) * objects, tuple(np.ndindex(num, objects)))
    of = (num_envs if case.is_per_env else 1, objects)
    volume = rng.uniform(1e-6, 1e-5, of)
    volume[:, -1] = np.inf if case.keeps else volume[:, -1]
    made_of = HeatOfObjects(
        tensor(rng.uniform(10, 60, of)), tensor(np.ones(of)), tensor(rng.uniform(0.2, 100.0, of)),
        tensor(rng.uniform(1e6, 3e6, of)), tensor(rng.uniform(0.3, 0.9, of)), tensor(rng.uniform(1e-9, 1e-7, of)),
        tensor(volume), tensor(rng.uniform(1e-4, 1e-3, of)), tensor(rng.uniform(0, 100, of)),
        *[tuple(tensor(part) for part in rng.uniform(0.01, 0.02, (3, objects))) for _ in range(2)],
    )  # fmt: skip
    shape = (num_envs, num, objects)
    touches = rng.random(shape) < 0.6
    normal = rng.normal(size=(3, *shape))
    normal /= np.linalg.norm(normal, axis=0)
    pos = [rng.uniform(-0.025, 0.035, shape) for _ in range(3)]
    patches = ContactPatch(
        tensor(rng.uniform(0.1, 10.0, shape) * touches), tensor(rng.uniform(0, 1e-4, shape) * touches * (rng.random(shape) < 0.5)),
        tuple(tensor(part * touches) for part in pos), tuple(tensor(part * touches) for part in normal), None, None,
        made_of, where, {key: torch.from_numpy(part) for key, part in where.tables().items()}, {}, tensor(boxes),
    )  # fmt: skip
    cells = tensor(rng.uniform(-20.0, 60.0, (num_envs, *there.shape)) * there)
    nodes = tensor(rng.uniform(-20.0, 60.0, (num_envs, objects)))
    return cells, nodes, rows_of(constants, patches, False), patches, constants, tensor(case.dt)
