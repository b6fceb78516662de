"""What a module wants, read from the arrays of MuJoCo's batch.

Shapes: `env` environments.
"""

from __future__ import annotations

import mujoco
import mujoco.batch
import numpy as np

from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.batch.contact_sensors import ContactSensors
from tgdsl.runtime.simulators.bodies import STATE_ARRAYS, BodyFields


class BatchReader:
    """Gathers the fields of a state that are poses, velocities or contacts."""

    def __init__(self, inputs: Inputs, model: mujoco.MjModel, batch: mujoco.batch.Batch):
        """Look up where everything is.

        Args:
            inputs: What the module wants.
            model: The scene.
            batch: The environments.

        Raises:
            SimulationError: If the model lacks a body or a contact sensor.
        """
        self._batch = batch
        self._bodies = BodyFields(inputs, model, index=np.asarray, cross=np.cross)
        self._contacts = ContactSensors(model, inputs)
        for name in STATE_ARRAYS:
            batch.bind(name)  # an array is filled only by calls that come after its first use

    def read(self) -> dict[str, np.ndarray]:
        """Return the fields, (env, …), each an array of its own."""
        live = {name: getattr(self._batch, name) for name in STATE_ARRAYS}
        arrays = self._bodies.read(live) | self._contacts.read(live["sensordata"])
        return {name: np.ascontiguousarray(array) for name, array in arrays.items()}
