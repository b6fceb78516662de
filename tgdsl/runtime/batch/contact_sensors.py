"""MuJoCo's contact sensors, which `tgdsl.instrument` adds to a model, read as fields of a state.

Shapes: `env` environments, `pair` and `slot` as a module's `inputs` list them, `shown` contacts that one sensor shows, `number`
numbers of `sensordata`, `geom` geoms of something.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from tgdsl.errors import SimulationError, listed
from tgdsl.module.state import shape_of
from tgdsl.plan.inputs import Inputs, contact_sensor_names
from tgdsl.quantities.contacts import SLOT_FIELDS
from tgdsl.runtime.simulators.model_ids import geoms_of

CONTACT_FIELDS = ("contact_found", *SLOT_FIELDS, "contact_netforce")
"""Fields of a state that are read of contact sensors."""
_WIDTH = {"found": 1, "force": 3, "torque": 3, "dist": 1, "pos": 3, "normal": 3, "tangent": 3}
"""How many numbers each quantity has that a contact sensor may show, in MuJoCo's order."""
_OF_SLOTS = ("force", "torque", "pos", "normal", "tangent")
"""What a contact in a slot is made of, three numbers each."""
_ADVICE = "add them with tgdsl.instrument(spec, touch.inputs) before compiling"


class ContactSensors:
    """Reads the contacts that a module wants from `sensordata`.

    A pair has a sensor for each part of its object and each part of its link. Contacts that a `gap` adds beyond the margin
    carry no force, and are none.
    """

    def __init__(self, model: mujoco.MjModel, inputs: Inputs):
        """Look up where everything is.

        Args:
            model: The model.
            inputs: What the module wants.

        Raises:
            SimulationError: If the model lacks a sensor, one does not show what is wanted, or sensors are disabled.
        """
        if inputs.pairs and model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
            what = "the scene has sensors disabled, and contacts are read of sensors: they would read 0"
            raise SimulationError(f'{what}; take <flag sensor="disable"/> out of its <option>')
        self._fields = [name for name in CONTACT_FIELDS if name in inputs.fields]
        self._shapes = {name: shape_of(name, inputs) for name in self._fields}
        self._num_slots = inputs.slots
        names = [[contact_sensor_names(pair, i) for i in range(len(inputs.touching(pair)))] for pair in inputs.pairs]
        self._points = [[_PointSensor(model, point, inputs.slots) for point, _ in own] for own in names]
        self._nets: list[list[range]] = []
        if "contact_netforce" in self._fields:
            self._nets = [[_place(model, net) for _, net in own] for own in names]

    def read(self, data: Float[np.ndarray, "env number"]) -> dict[str, Float[np.ndarray, "env pair *rest"]]:
        """Return the fields that the module wants; `data` is MuJoCo's `sensordata`."""
        if not self._points:
            return {name: np.zeros((len(data), *shape)) for name, shape in self._shapes.items()}
        fields: dict[str, np.ndarray] = {}
        if self._nets:
            nets = [sum(data[:, place.start + 1 : place.start + 4] for place in own) for own in self._nets]
            fields["contact_netforce"] = np.stack(nets, axis=1)
        fields["contact_found"] = np.stack([sum(sensor.count(data) for sensor in own) for own in self._points], axis=1)
        if self._num_slots:
            shown = [[sensor.read(data) for sensor in own] for own in self._points]
            slots = np.stack([_first_contacts(own, self._num_slots) for own in shown], axis=1)
            fields |= _in_world(slots)
        return {name: fields[name] for name in self._fields}


class _Shown(NamedTuple):
    """What one sensor shows: which of those shown are contacts, and numbers of each."""

    is_contact: Bool[np.ndarray, "env shown"]
    values: Float[np.ndarray, "env shown value"]


class _PointSensor:
    """A sensor of single contacts."""

    def __init__(self, model: mujoco.MjModel, name: str, num_slots: int):
        """Look up what it shows."""
        self._place = _place(model, name)
        sensor = int(model.sensor(name).id)
        bits, _, self._num = model.sensor_intprm[sensor, :3].tolist()
        columns: dict[str, list[int]] = {}
        end = itertools.count()
        for quantity, width in _WIDTH.items():
            if bits >> int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{quantity.upper()}")) & 1:
                columns[quantity] = list(itertools.islice(end, width))
        self._margin = _least_margin(model, sensor)
        wanted = [*(_OF_SLOTS if num_slots else ()), *(() if self._margin is None else ("dist", "force"))]
        if missing := [quantity for quantity in ("found", *wanted) if quantity not in columns]:
            raise SimulationError(f'the contact sensor "{name}" does not show {listed(missing)}; {_ADVICE}')
        if self._num < num_slots:
            raise SimulationError(f'the contact sensor "{name}" shows {self._num} contacts, expected {num_slots}; {_ADVICE}')
        self._columns = columns
        self._values = [column for quantity in _OF_SLOTS for column in columns[quantity]] if num_slots else []

    def count(self, data: Float[np.ndarray, "env number"]) -> Float[np.ndarray, " env"]:
        """Return how many contacts there are."""
        count = data[:, self._place.start]
        if self._margin is None:
            return count
        num = self.read(data).is_contact.sum(axis=1)
        return np.where(num < self._num, num, count)  # if all that are shown are contacts, others may be

    def read(self, data: Float[np.ndarray, "env number"]) -> _Shown:
        """Return what it shows."""
        shown = data[:, self._place.start : self._place.stop].reshape(len(data), self._num, -1)
        is_contact = shown[:, :, 0] > 0
        if self._margin is not None:
            distance, force = shown[:, :, self._columns["dist"][0]], shown[:, :, self._columns["force"]]
            is_contact = is_contact & ((distance < self._margin) | (force != 0).any(axis=-1))
        return _Shown(is_contact, shown[:, :, self._values])


def _first_contacts(parts: Sequence[_Shown], num_slots: int) -> Float[np.ndarray, "env slot value"]:
    """Return the first contacts of a pair, of all parts of its object and link; slots that are left are zero."""
    is_contact = np.concatenate([part.is_contact for part in parts], axis=1)
    values = np.concatenate([part.values for part in parts], axis=1) * is_contact[..., None]
    if values.shape[1] == num_slots:
        return values
    order = np.argsort(~is_contact, axis=1, kind="stable")[:, :num_slots]
    return np.take_along_axis(values, order[..., None], axis=1)


def _in_world(slots: Float[np.ndarray, "env pair slot 15"]) -> dict[str, Float[np.ndarray, "env pair slot 3"]]:
    """Rotate force and torque from each contact's frame (normal, tangent, their cross product) to the world."""
    force, torque, pos, normal, tangent = np.split(slots, 5, axis=-1)
    axes = np.stack([normal, tangent, np.cross(normal, tangent)], axis=-2)
    force, torque = (np.einsum("...i,...ij->...j", vector, axes) for vector in (force, torque))
    return {"contact_pos": pos, "contact_force": force, "contact_torque": torque, "contact_normal": normal}


def _place(model: mujoco.MjModel, name: str) -> range:
    try:
        sensor = model.sensor(name)
    except KeyError as error:
        raise SimulationError(f'the scene has no contact sensor "{name}", which the module wants; {_ADVICE}') from error
    return range(int(sensor.adr[0]), int(sensor.adr[0] + sensor.dim[0]))


def _least_margin(model: mujoco.MjModel, sensor: int) -> float | None:
    """Return the least margin of all pairs of geoms that a sensor is of [m]; None if none of them has a gap."""
    first = _geoms(model, int(model.sensor_objtype[sensor]), int(model.sensor_objid[sensor]))
    second = _geoms(model, int(model.sensor_reftype[sensor]), int(model.sensor_refid[sensor]))
    masks = model.geom_contype[first, None] & model.geom_conaffinity[second]
    masks |= model.geom_conaffinity[first, None] & model.geom_contype[second]
    sums = [values[first, None] + values[second] for values in (model.geom_margin, model.geom_gap)]
    of_masks = [(margin, gap) for margin, gap, mask in zip(*(part.ravel() for part in (*sums, masks)), strict=True) if mask]
    of_pairs = [
        (model.pair_margin[i], model.pair_gap[i])
        for i, (one, two) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))
        if (one in first and two in second) or (two in first and one in second)
    ]
    found = [*of_masks, *of_pairs]
    return float(min(margin for margin, _ in found)) if any(gap > 0 for _, gap in found) else None


def _geoms(model: mujoco.MjModel, kind: int, index: int) -> Int[np.ndarray, " geom"]:
    """Return the geoms of what a contact sensor names: a geom, a body, or a body and all below it."""
    is_geom = kind == mujoco.mjtObj.mjOBJ_GEOM
    return np.array([index]) if is_geom else geoms_of(model, index, kind == mujoco.mjtObj.mjOBJ_XBODY)
