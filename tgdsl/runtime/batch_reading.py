"""What a module wants, read from the arrays of MuJoCo's batch.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Float

from tgdsl.plan import Inputs
from tgdsl.runtime.lookup import body_id, contact_sensor

Array = np.ndarray
DERIVED = ("xpos", "xquat", "cvel", "subtree_com", "sensordata")
"""Arrays of MuJoCo that a state is read from."""
_SLOT_SIZE = 16


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
        self._body_ids = np.array([body_id(model, name) for name in inputs.bodies], dtype=np.intp)
        self._root_ids = model.body_rootid[self._body_ids]
        self._slots = [contact_sensor(model, pair, 0) for pair in inputs.pairs]
        nets = inputs.pairs if "contact_netforce" in inputs.fields else ()
        self._nets = [contact_sensor(model, pair, 1) for pair in nets]
        self._readers = {name: _READERS[name] for name in inputs.fields if name in _READERS}
        for name in DERIVED:
            batch.bind(name)  # an array is filled only by calls that come after its first use

    def read(self) -> dict[str, Array]:
        """Return the fields, each an array of its own."""
        return {name: np.ascontiguousarray(reader(self)) for name, reader in self._readers.items()}

    def _body_pos(self) -> Float[Array, "env body 3"]:
        return self._batch.xpos[:, self._body_ids]

    def _body_quat(self) -> Float[Array, "env body 4"]:
        return self._batch.xquat[:, self._body_ids]

    def _body_angvel(self) -> Float[Array, "env body 3"]:
        return self._batch.cvel[:, self._body_ids, :3]

    def _body_linvel(self) -> Float[Array, "env body 3"]:
        """Move MuJoCo's spatial velocity from the centre of mass of the kinematic tree to the body frame's origin."""
        angular, linear = self._body_angvel(), self._batch.cvel[:, self._body_ids, 3:]
        return linear + np.cross(angular, self._body_pos() - self._batch.subtree_com[:, self._root_ids])

    def _contact_found(self) -> Float[Array, "env pair"]:
        return self._batch.sensordata[:, [part.start for part in self._slots]]

    def _slot_part(self, first: int) -> Float[Array, "env pair slot 3"]:
        """Return three numbers of each slot: 1 force, 4 torque, 7 position, 10 normal, 13 tangent."""
        slots = np.stack([self._batch.sensordata[:, part.start : part.stop] for part in self._slots], axis=1)
        return slots.reshape(*slots.shape[:2], -1, _SLOT_SIZE)[..., first : first + 3]

    def _in_world(self, first: int) -> Float[Array, "env pair slot 3"]:
        """Rotate a vector from the contact's frame (normal, tangent, their cross product) to the world."""
        normal, tangent = self._slot_part(10), self._slot_part(13)
        axes = np.stack([normal, tangent, np.cross(normal, tangent)], axis=-2)
        return np.einsum("...i,...ij->...j", self._slot_part(first), axes)

    def _contact_netforce(self) -> Float[Array, "env pair 3"]:
        return np.stack([self._batch.sensordata[:, part.start + 1 : part.start + 4] for part in self._nets], axis=1)


_READERS: dict[str, Callable[[BatchReader], Array]] = {
    "body_pos": BatchReader._body_pos,
    "body_quat": BatchReader._body_quat,
    "body_linvel": BatchReader._body_linvel,
    "body_angvel": BatchReader._body_angvel,
    "contact_found": BatchReader._contact_found,
    "contact_pos": lambda reader: reader._slot_part(7),
    "contact_force": lambda reader: reader._in_world(1),
    "contact_torque": lambda reader: reader._in_world(4),
    "contact_normal": lambda reader: reader._slot_part(10),
    "contact_netforce": BatchReader._contact_netforce,
}
