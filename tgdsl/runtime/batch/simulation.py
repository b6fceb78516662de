"""MuJoCo on CPU threads: many environments of the artefact's scene, stepped together.

`mujoco.batch` needs MuJoCo 3.17 and is imported when a simulation starts: compiling, and reading another simulator's state,
work with an older MuJoCo.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair.
"""

from __future__ import annotations

import copy
import importlib
import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.module.state import shape_of
from tgdsl.plan.inputs import Inputs, contact_sensor_names
from tgdsl.quantities.contacts import SLOT_FIELDS
from tgdsl.runtime.simulators.faults import DIVERGED, EnvFaults
from tgdsl.runtime.simulators.fields import StateReader
from tgdsl.runtime.simulators.machine import checked_device, refuse_beyond_memory
from tgdsl.runtime.simulators.model_ids import element_id, geoms_of
from tgdsl.runtime.simulators.objects import PER_ENV, EnvObjects, ObjectProperties, RigidObject, refuse_other_fields
from tgdsl.runtime.simulators.simulation import SimOptions, Simulation, refuse_two_instants
from tgdsl.runtime.simulators.state_values import INTEGRATED, NewValues, StateTable
from tgdsl.scene.mujoco_warnings import StepWarnings, collected_messages

if TYPE_CHECKING:
    import mujoco.batch

Array = np.ndarray
_DERIVED_FROM = ("body_mass", "body_inertia", "geom_friction")
"""Fields that are changed in models of single environments; MuJoCo derives the others."""


class BatchProperties(ObjectProperties):
    """Masses and frictions of a batch: expanded fields of its model, or a model for each environment.

    Expanded fields share all else. Variants that differ in what cannot be expanded, such as trees of bounding volumes,
    take a model for each environment; changed ones are copies.
    """

    def __init__(
        self,
        batch: mujoco.batch.Batch,
        model: mujoco.MjModel,
        bodies_of: Mapping[str, str],
        variants: Sequence[mujoco.MjModel],
        is_open: bool,
    ):
        super().__init__(model, bodies_of, batch.nsim, torch.device("cpu"))
        self._batch, self._is_derived = batch, False
        self._fields: dict[str, Array] = {}
        self._chosen = [model] * batch.nsim
        differ = {name for other in variants for name in _differing(model, other)}
        is_apart = is_open or bool(differ - set(mujoco.batch.MODEL_FIELDS))  # in what cannot be expanded
        self._models = list(self._chosen) if is_apart else None

    def use_models(self, models: Sequence[mujoco.MjModel]) -> None:
        """Replace models of environments; environments with an unchanged model keep their masses and frictions."""
        changed = [env for env, model in enumerate(models) if model is not self._chosen[env]]
        self._chosen = list(models)
        if self._models is not None:
            for env in changed:
                self._models[env] = models[env]
            self._batch.set_models(self._models)
            return
        for model in {id(models[env]): models[env] for env in changed}.values():
            for name in _differing(self._model, model):
                self._field(name)
        for env in changed:
            for name, values in self._fields.items():
                value = getattr(models[env], name)
                values[env] = value[: len(values[env])] if values[env].ndim else value
        if self._is_derived and changed:
            self._batch.set_const(np.array(changed))

    def fields(self) -> dict[str, Tensor]:
        return {name: self._values(name) for name in (self._fields if self._models is None else _DERIVED_FROM)}

    def set_fields(self, fields: Mapping[str, Tensor]) -> None:
        refuse_other_fields(fields, {name: self._values(name) for name in fields if name in mujoco.batch.MODEL_FIELDS})
        changed = set()
        for name, value in fields.items():
            now = self._arrays_of(name)
            for env in np.flatnonzero((now != value.numpy()).reshape(len(now), -1).any(axis=1)).tolist():
                self._row(name, env)[...] = value[env].numpy()
                changed.add(env)
        if "body_mass" in fields:
            self._derive(np.array(sorted(changed), dtype=np.int64))
        elif self._models is not None:
            self._batch.set_models(self._models)

    def _set_mass(self, target: RigidObject, mask: Bool[Tensor, " env"], mass: Float[Tensor, " env"]) -> None:
        ids = np.flatnonzero(mask.numpy())
        for env, new_mass in zip(ids.tolist(), mass.numpy()[ids], strict=True):
            model, bodies = self._chosen[env], target.bodies  # not of what it has now: rounding would add up
            factor = new_mass / model.body_mass[bodies].sum()
            self._row("body_mass", env)[bodies] = factor * model.body_mass[bodies]
            self._row("body_inertia", env)[bodies] = factor * model.body_inertia[bodies]
        self._derive(ids)

    def _derive(self, ids: Int[Array, " n"]) -> None:
        """Have what follows from masses follow in some environments."""
        self._is_derived = True
        if self._models is None:
            if len(ids):
                self._batch.set_const(ids)
            return
        for env in ids:
            mujoco.mj_setConst(self._models[env], mujoco.MjData(self._models[env]))
        self._batch.set_models(self._models)

    def _set_friction(self, target: RigidObject, mask: Bool[Tensor, " env"], friction: Float[Tensor, " env"]) -> None:
        ids = np.flatnonzero(mask.numpy())
        for env, coefficient in zip(ids.tolist(), friction.numpy()[ids], strict=True):
            self._row("geom_friction", env)[target.geoms, 0] = coefficient
        if self._models is not None:
            self._batch.set_models(self._models)

    def _values(self, field: str) -> Float[Tensor, "env ..."]:
        return torch.from_numpy(np.array(self._arrays_of(field)))

    def _arrays_of(self, name: str) -> Array:
        """Return a field of all environments, to be read."""
        if self._models is not None:
            return np.stack([getattr(model, name) for model in self._models])
        base = getattr(self._model, name)
        return self._fields[name] if name in self._fields else np.broadcast_to(base, (self._batch.nsim, *base.shape))

    def _row(self, name: str, env: int) -> Array:
        """Return a field of one environment, to be changed."""
        if self._models is None:
            return self._field(name)[env]
        if self._models[env] is self._chosen[env]:
            self._models[env] = copy.copy(self._models[env])
        return getattr(self._models[env], name)

    def _field(self, name: str) -> Array:
        if name not in self._fields:
            self._fields[name] = self._batch.expand(name)
        return self._fields[name]


def _differing(one: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    names = [name for name in dir(one) if isinstance(getattr(one, name), Array)]
    return [name for name in names if not np.array_equal(getattr(one, name), getattr(other, name))]


_WIDTH = {"found": 1, "force": 3, "torque": 3, "dist": 1, "pos": 3, "normal": 3, "tangent": 3}
"""How many numbers each quantity has that a contact sensor may show, in MuJoCo's order."""
_OF_SLOTS = ("force", "torque", "pos", "normal", "tangent")  # the vectors of a contact in a slot, three numbers each
_ADVICE = "add them with tgdsl.instrument(spec, touch.inputs) before compiling"


class ContactSensors:
    """Reads the contacts that a module wants from `sensordata`.

    A pair has a sensor for each part of its object and each part of its link. Contacts that a `gap` adds beyond the margin
    carry no force, and are none.
    """

    def __init__(self, model: mujoco.MjModel, inputs: Inputs):
        if inputs.pairs and model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
            problem = "the scene has sensors disabled, and contacts are read of sensors: they would read 0"
            raise SimulationError(f'{problem}; take <flag sensor="disable"/> out of its <option>')
        names = [name for name in ("contact_found", *SLOT_FIELDS, "contact_netforce") if name in inputs.fields]
        self._shapes = {name: shape_of(name, inputs) for name in names}
        self._num_slots = inputs.slots
        sensors = [[contact_sensor_names(pair, i) for i in range(len(inputs.touching(pair)))] for pair in inputs.pairs]
        self._points = [[_PointSensor(model, point, inputs.slots) for point, _ in parts] for parts in sensors]
        self._nets = [[_columns(model, net)[1:4] for _, net in parts] for parts in sensors if "contact_netforce" in names]

    def read(self, sensordata: Float[Tensor, "env number"]) -> dict[str, Float[Tensor, "env pair ..."]]:
        """Return the fields that the module wants from MuJoCo's `sensordata`."""
        data, fields = sensordata.numpy(), dict[str, Array]()
        if not self._points:
            fields = {name: np.zeros((len(data), *shape)) for name, shape in self._shapes.items()}
            return {name: torch.from_numpy(values) for name, values in fields.items()}
        if self._nets:
            nets = [sum(data[:, columns.start : columns.stop] for columns in parts) for parts in self._nets]
            fields["contact_netforce"] = np.stack(nets, axis=1)
        fields["contact_found"] = np.stack([sum(sensor.count(data) for sensor in parts) for parts in self._points], axis=1)
        if self._num_slots:
            rows = [[sensor.read(data) for sensor in parts] for parts in self._points]
            fields |= _in_world(np.stack([_first_contacts(parts, self._num_slots) for parts in rows], axis=1))
        return {name: torch.from_numpy(np.ascontiguousarray(fields[name])) for name in self._shapes}


_Shown = tuple[Bool[Array, "env shown"], Float[Array, "env shown value"]]  # which rows are contacts, and numbers of each


class _PointSensor:
    """A sensor of single contacts."""

    def __init__(self, model: mujoco.MjModel, name: str, num_slots: int):
        self._place = _columns(model, name)
        sensor = element_id(model, "sensor", name)
        bits, _, self._num = model.sensor_intprm[sensor, :3].tolist()
        columns: dict[str, list[int]] = {}
        end = itertools.count()
        for quantity, width in _WIDTH.items():
            if bits >> int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{quantity.upper()}")) & 1:
                columns[quantity] = list(itertools.islice(end, width))
        self._margin = _least_margin(model, sensor)
        required = ("found", *(_OF_SLOTS if num_slots else ()), *(() if self._margin is None else ("dist", "force")))
        if missing := [quantity for quantity in required if quantity not in columns]:
            raise SimulationError(f'the contact sensor "{name}" does not show {listed(missing)}; {_ADVICE}')
        if self._num < num_slots:
            raise SimulationError(f'the contact sensor "{name}" shows {self._num} contacts, expected {num_slots}; {_ADVICE}')
        self._columns = columns
        self._values = [column for quantity in _OF_SLOTS for column in columns[quantity]] if num_slots else []

    def count(self, data: Float[Array, "env number"]) -> Float[Array, " env"]:
        """Return how many contacts there are."""
        count = data[:, self._place.start]
        if self._margin is None:
            return count
        num = self.read(data)[0].sum(axis=1)
        return np.where(num < self._num, num, count)  # if all reported rows are contacts, there may be more

    def read(self, data: Float[Array, "env number"]) -> _Shown:
        rows = data[:, self._place.start : self._place.stop].reshape(len(data), self._num, -1)
        is_contact = rows[:, :, 0] > 0
        if self._margin is not None:
            distance, force = rows[:, :, self._columns["dist"][0]], rows[:, :, self._columns["force"]]
            is_contact = is_contact & ((distance < self._margin) | (force != 0).any(axis=-1))
        return is_contact, rows[:, :, self._values]


def _first_contacts(parts: Sequence[_Shown], num_slots: int) -> Float[Array, "env slot value"]:
    """Return the first contacts of a pair, of all parts of its object and link; slots that are left are zero."""
    is_contact = np.concatenate([rows for rows, _ in parts], axis=1)
    values = np.concatenate([values for _, values in parts], axis=1) * is_contact[..., None]
    if values.shape[1] == num_slots:
        return values
    order = np.argsort(~is_contact, axis=1, kind="stable")[:, :num_slots]
    return np.take_along_axis(values, order[..., None], axis=1)


def _in_world(slots: Float[Array, "env pair slot 15"]) -> dict[str, Float[Array, "env pair slot 3"]]:
    """Rotate force and torque from each contact's frame (normal, tangent, their cross product) to the world."""
    force, torque, pos, normal, tangent = np.split(slots, 5, axis=-1)
    axes = np.stack([normal, tangent, np.cross(normal, tangent)], axis=-2)
    force, torque = (np.einsum("...i,...ij->...j", vector, axes) for vector in (force, torque))
    return {"contact_pos": pos, "contact_force": force, "contact_torque": torque, "contact_normal": normal}


def _columns(model: mujoco.MjModel, name: str) -> range:
    """Return the columns of a contact sensor in `sensordata`."""
    try:
        sensor = element_id(model, "sensor", name)
    except SimulationError as error:
        raise SimulationError(f'the scene has no contact sensor "{name}", which the module wants; {_ADVICE}') from error
    return range(int(model.sensor_adr[sensor]), int(model.sensor_adr[sensor] + model.sensor_dim[sensor]))


def _least_margin(model: mujoco.MjModel, sensor: int) -> float | None:
    """Return the least margin of all pairs of geoms that a sensor is of [m]; None if none of them has a gap."""

    def geoms(kind: int, index: int) -> Int[Array, " geom"]:
        is_geom = kind == mujoco.mjtObj.mjOBJ_GEOM
        return np.array([index]) if is_geom else geoms_of(model, index, kind == mujoco.mjtObj.mjOBJ_XBODY)

    first = geoms(int(model.sensor_objtype[sensor]), int(model.sensor_objid[sensor]))
    second = geoms(int(model.sensor_reftype[sensor]), int(model.sensor_refid[sensor]))
    masks = model.geom_contype[first, None] & model.geom_conaffinity[second]
    masks |= model.geom_conaffinity[first, None] & model.geom_contype[second]
    margin, gap = (values[first, None] + values[second] for values in (model.geom_margin, model.geom_gap))
    one, two = model.pair_geom1, model.pair_geom2
    of_pairs = (np.isin(one, first) & np.isin(two, second)) | (np.isin(two, first) & np.isin(one, second))
    margins = np.concatenate([margin[masks != 0], model.pair_margin[of_pairs]])
    gaps = np.concatenate([gap[masks != 0], model.pair_gap[of_pairs]])
    return float(margins.min()) if (gaps > 0).any() else None


_FORWARD, _VELOCITIES = int(mujoco.mjtStage.mjSTAGE_ACC), int(mujoco.mjtStage.mjSTAGE_VEL)
"""How far `forward` goes: all that `mj_forward` does; poses and velocities."""
_DIVERGENCES = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]


class BatchSimulation(Simulation):
    """Environments in MuJoCo's `Batch` on CPU threads, in float64. `qpos`, `qvel` and `ctrl` share MuJoCo's memory.

    A physics step advances joints, but leaves poses, velocities and contacts at its start. A state refers to that instant:
    its joints are the ones before the step.

    Attributes:
        batch: MuJoCo's batch: `batch.qpos`, `batch.qvel` and others are live arrays (env, …).
    """

    OPTIONS = ("substeps", "threads", "keyframe", "model", "options", "watch", "per_env", "on_fault", "prepare")
    properties: BatchProperties

    def body_poses(self, env: int) -> tuple[Float[Array, "body 3"], Float[Array, "body 4"]]:
        return self.batch.xpos[env], self.batch.xquat[env]

    def env_model(self, env: int) -> mujoco.MjModel:
        return self.batch.get_model(env)

    def _open_device(self, device: str, options: SimOptions) -> torch.device:
        if tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 17):
            problem = f"MuJoCo {mujoco.__version__} has no `mujoco.batch`, by which tgdsl simulates on a CPU"
            raise SimulationError(f'{problem}: pip install "mujoco>=3.17"')
        importlib.import_module("mujoco.batch")
        if unknown := [word for word in options.get("per_env", ()) if word not in PER_ENV]:
            hint = did_you_mean(unknown[0], PER_ENV, "words")
            raise SimulationError(f'per_env: there is no "{unknown[0]}" on "cpu"; {hint}')
        return checked_device(device, ("cpu",))

    def _start(self, num_envs: int, keyframe: int, options: SimOptions, readers: Sequence[StateReader]) -> None:
        model, inputs = self.model, self._touch.inputs
        problem = "the scene has `sleep` enabled, and which trees sleep is not part of the state that environments share"
        refuse_two_instants(model, f'{problem}; take <flag sleep="enable"/> out of its <option>')
        numbers = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION) + 16 * model.nbody + model.nsensordata
        refuse_beyond_memory(f"{num_envs} environments", 8 * numbers * num_envs)
        self.batch = mujoco.batch.Batch(model, num_envs, options.get("threads", 0) or int(num_envs == 1))
        self._keyframe, self._warnings = keyframe, StepWarnings()
        self._sensors = ContactSensors(model, inputs)
        with torch.inference_mode(False):
            # An array is filled only by calls that come after its first use.
            self._arrays = {name: torch.from_numpy(self.batch.bind(name)) for name in INTEGRATED}
            self._kept = {name: self._arrays[name].clone() for reader in readers for name in reader.moved}
            names = {"sensordata", *(name for reader in readers for name in reader.arrays)} - self._arrays.keys()
            with (
                warnings.catch_warnings()
            ):  # that torch could write into arrays that are read-only in NumPy; they are only read
                warnings.simplefilter("ignore")
                derived = {name: torch.from_numpy(self.batch.bind(name)) for name in names}
            self._sources = self._arrays | derived | self._kept
            self._instant = torch.zeros(num_envs, dtype=torch.float64)
            self._table = StateTable(model, self._arrays)
            self._faults = EnvFaults(num_envs, self._device, options.get("on_fault", "raise"))
        variants, is_open = ([], False) if self._objects is None else self._objects.variants()
        self.properties = BatchProperties(self.batch, model, inputs.bodies_of, variants, is_open)
        if self._objects is not None:
            self.properties.use_models(self._objects.models())

    def _contacts(self) -> dict[str, Tensor]:
        return self._sensors.read(self._sources["sensordata"])

    def _refresh(self) -> None: ...

    def _use_objects(self, objects: EnvObjects) -> None:
        models = objects.models()
        self._run(lambda: self.properties.use_models(models))

    def _begin_episodes(self, mask: Bool[Tensor, " env"], new: NewValues, *, finds_contacts: bool) -> None:
        ids = np.flatnonzero(mask.numpy())
        if len(ids):
            self._run(lambda: self.batch.reset(ids, keyframe=self._keyframe, stage=mujoco.mjtStage.mjSTAGE_NONE.value))
            self._put(mask, new)
            self._forward(ids, _FORWARD if finds_contacts else _VELOCITIES)
            self._faults.clear(mask)

    def _put(self, mask: Bool[Tensor, " env"], new: NewValues) -> None:
        for name, values in new.values.items():
            self._arrays[name][mask] = values[mask]

    def _evaluate(self, mask: Bool[Tensor, " env"]) -> None:
        ids = np.flatnonzero(mask.numpy())
        if len(ids):
            self._forward(ids, _FORWARD)

    def _forward(self, ids: Int[Array, " n"], stage: int) -> None:
        self._run(lambda: self.batch.forward(ids, stage=stage))
        self._instant[ids] = self._arrays["time"][ids]
        for name, saved in self._kept.items():
            saved[ids] = self._arrays[name][ids]

    def _advance(self, num_steps: int) -> None:
        self.batch.warning[...] = 0
        self._physics_steps(num_steps - 1 if self._kept else num_steps)
        if self._kept:
            if self.drive is not None:
                self.drive()
            for name, saved in self._kept.items():
                saved.copy_(self._arrays[name])
            self._run(lambda: self.batch.step(nstep=1))
        self._instant.copy_(self._arrays["time"]).sub_(float(self.model.opt.timestep))
        self._faults.note(DIVERGED, torch.from_numpy(self.batch.warning[:, _DIVERGENCES, 1].any(axis=1)))
        is_faulty = self._faults.update()
        if not is_faulty.any():
            return
        if self._faults.on_fault == "raise":
            raise SimulationError("; ".join(self._faults.messages(diverged=", and MuJoCo has restarted them")))
        if self._faults.on_fault == "reset":
            self._begin_episodes(is_faulty, NewValues({}), finds_contacts=True)
            self._touch.reset(is_faulty)
            self._faults.note_restarted(is_faulty)
        self._faults.warn_once()

    def _physics_steps(self, num: int) -> None:
        """Make physics steps: all in one call if nothing drives them."""
        if self.drive is None:
            if num:
                self._run(lambda: self.batch.step(nstep=num))
            return
        for _ in range(num):
            self.drive()
            self._run(lambda: self.batch.step(nstep=1))

    def _run(self, call: Callable[[], None]) -> None:
        try:
            with collected_messages() as messages:
                call()
        except (mujoco.batch.SimulationError, mujoco.FatalError, ValueError) as error:
            raise SimulationError(f"MuJoCo: {error}") from error
        if messages:
            self._warnings.warn(messages)
