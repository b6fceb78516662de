"""Heat of objects: at which temperature each begins an episode in each environment, and what it is made of there.

Shapes: `env` environments, `heated` objects of the module's `inputs.heated`, `n` chosen environments.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.fields.units import ZEROS
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.objects.choices import Values, checked_numbers

COLDEST = ZEROS["K"]
"""Absolute zero [°C]."""


class EnvHeat:
    """What the objects that hold heat are like in each environment.

    To begin with, all have the document's temperature, and environment i the material i modulo their number. Values
    written into the tensors are part of the next state: a sensor takes them when it begins an episode.

    Attributes:
        names: The objects, in the order of the tensors' columns: `inputs.heated`.
        temperature: The field `object_temperature` of a state [°C], a live tensor; 0 for objects whose temperature is not part
            of it.
        material: The field `object_material`, a live tensor; 0 for objects that have just one.
    """

    temperature: Float[Tensor, "env heated"]
    material: Int[Tensor, "env heated"]

    def __init__(self, inputs: Inputs, num_envs: int, device: torch.device, dtype: torch.dtype):
        self.names = inputs.heated
        self._starts, self._num_materials = inputs.start_temperatures, inputs.num_materials
        with torch.inference_mode(False):
            starts = [0.0 if start is None else start for start in self._starts]
            self.temperature = torch.tensor(starts, dtype=dtype, device=device).repeat(num_envs, 1)
            numbers = torch.tensor(self._num_materials, dtype=torch.int64, device=device)
            self.material = torch.arange(num_envs, device=device)[:, None] % numbers

    @property
    def saved(self) -> dict[str, Tensor]:
        """The live tensors by the names that a saved simulation has for them; none without objects that hold heat."""
        return {"heat/temperature": self.temperature, "heat/material": self.material} if self.names else {}

    def read(self) -> dict[str, Tensor]:
        """Return copies for a state, by field."""
        if not self.names:
            return {}
        return {"object_temperature": self.temperature.clone(), "object_material": self.material.clone()}

    def choose(
        self, ids: Int[np.ndarray, " n"], temperatures: Mapping[str, Values], materials: Mapping[str, Values]
    ) -> dict[tuple[str, int], np.ndarray]:
        """Return, checked, what `write` writes: see `Simulation.set_objects`."""
        result = {("temperature", self._column(name)): self._degrees(name, v, len(ids)) for name, v in temperatures.items()}
        for name, value in materials.items():
            column = self._column(name)
            numbers = checked_numbers(f"materials of object {name}", value, len(ids), self._num_materials[column])
            result["material", column] = numbers
        return result

    def write(self, ids: Int[np.ndarray, " n"], chosen: Mapping[tuple[str, int], np.ndarray]) -> None:
        """Write what was chosen for some environments, in place."""
        rows = torch.from_numpy(np.ascontiguousarray(ids)).to(self.material.device)
        with torch.inference_mode(False), torch.no_grad():
            for (name, column), values in chosen.items():
                target = getattr(self, name)
                target[rows, column] = torch.from_numpy(values).to(target.device, target.dtype)

    def _column(self, name: str) -> int:
        if name not in self.names:
            if not self.names:
                raise SimulationError("no temperature or material differs between environments for a sensor of this module")
            raise SimulationError(f'no object "{name}" holds heat; {did_you_mean(name, self.names, "objects that do")}')
        return self.names.index(name)

    def _degrees(self, name: str, value: Values, count: int) -> Float[np.ndarray, " n"]:
        if self._starts[self._column(name)] is None:
            hint = "the document frees it with `temperature: {per_env: 45 degC}`"
            raise SimulationError(f"the temperature of object {name} is fixed; {hint}")
        degrees = np.asarray(value, dtype=np.float64)
        if degrees.shape not in ((), (count,)) or not np.isfinite(degrees).all() or (degrees < COLDEST).any():
            expected = f"{count} numbers of at least {COLDEST} °C"
            raise SimulationError(f"temperatures of object {name}: expected {expected}, found {value}")
        return np.broadcast_to(degrees, count).copy()
