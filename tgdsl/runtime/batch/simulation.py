"""MuJoCo on CPU threads: many environments of the artefact's scene, stepped together.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from tgdsl.errors import SimulationError, listed
from tgdsl.module.memory.some_rows import few_rows
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState, shape_of
from tgdsl.plan.inputs import Inputs, contact_sensor_names
from tgdsl.quantities.contacts import SLOT_FIELDS
from tgdsl.runtime.batch import require_batch
from tgdsl.runtime.batch.own_fields import OwnFields
from tgdsl.runtime.simulators.bodies import STATE_ARRAYS, BodyFields, warn_of_mocap
from tgdsl.runtime.simulators.claims import claim, refuse_two_instants, refuse_unfit
from tgdsl.runtime.simulators.faults import DIVERGED, EnvFaults, OnFault
from tgdsl.runtime.simulators.joint_fields import JointColumns, KeptJoints
from tgdsl.runtime.simulators.memory import bytes_per_env, refuse_beyond_memory
from tgdsl.runtime.simulators.model_ids import geoms_of, keyframe_id
from tgdsl.runtime.simulators.objects.choices import EnvObjects
from tgdsl.runtime.simulators.objects.heat import EnvHeat
from tgdsl.runtime.simulators.objects.shared_meshes import SharedMeshModels
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.state_values import INTEGRATED, Rows, StateTable
from tgdsl.runtime.simulators.watch import Watch, WatchReader
from tgdsl.scene.mujoco_warnings import StepWarnings, collected_messages
from tgdsl.scene.options import Options
from tgdsl.tensors.env_ids import EnvIds, env_indices, env_mask, is_env_mask

if TYPE_CHECKING:
    import mujoco.batch


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
    results = [*of_masks, *of_pairs]
    return float(min(margin for margin, _ in results)) if any(gap > 0 for _, gap in results) else None


def _geoms(model: mujoco.MjModel, kind: int, index: int) -> Int[np.ndarray, " geom"]:
    """Return the geoms of what a contact sensor names: a geom, a body, or a body and all below it."""
    is_geom = kind == mujoco.mjtObj.mjOBJ_GEOM
    return np.array([index]) if is_geom else geoms_of(model, index, kind == mujoco.mjtObj.mjOBJ_XBODY)


def _rows(array: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Return rows of an array (env, row, …), laid out in that order, which `array[:, ids]` does not do."""
    return np.take(array, ids, axis=1)


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return `np.cross` of vectors along the last axis, in a fifth of its time for few of them."""
    (a, b, c), (x, y, z) = ([own[..., i] for i in range(3)] for own in (one, other))
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


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
        self._bodies = BodyFields(inputs, model, index=np.asarray, take=_rows, cross=_cross)
        self._contacts = ContactSensors(model, inputs)
        for name in STATE_ARRAYS:
            batch.bind(name)  # an array is filled only by calls that come after its first use

    def read(self, rows: Int[np.ndarray, " n"] | slice = slice(None)) -> dict[str, np.ndarray]:
        """Return the fields of some environments (default: all), (env, …), each an array of its own."""
        live = {name: getattr(self._batch, name)[rows] for name in STATE_ARRAYS}
        arrays = self._bodies.read(live) | self._contacts.read(live["sensordata"])
        return {name: np.ascontiguousarray(array) for name, array in arrays.items()}


Array = np.ndarray
_FORWARD, _VELOCITIES = int(mujoco.mjtStage.mjSTAGE_ACC), int(mujoco.mjtStage.mjSTAGE_VEL)
"""How far `forward` goes: all that `mj_forward` does; poses and velocities."""
_DIVERGENCES = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]


class BatchSimulation(Simulation):
    """Environments in MuJoCo's `Batch`, read by one module.

    Everything `state` hands out is of one instant: after `step`, MuJoCo's poses, velocities and contacts are those at the
    start of the last substep, and so is the state, its joints included. After `reset`, `set_state` and `forward` they are of
    where the environments are. `qpos`, `qvel` and `ctrl` are live tensors in float64 that share MuJoCo's memory, and of now.

    Attributes:
        model: The compiled scene; where objects differ between environments, that of the first.
        batch: MuJoCo's batch: `batch.qpos`, `batch.qvel` and others are live arrays (env, …).
        substeps: Physics steps per control step.
    """

    properties: OwnFields
    _objects: EnvObjects | None = None

    def __init__(
        self,
        touch: TactileModule,
        num_envs: int,
        *,
        substeps: int = 1,
        threads: int = 0,
        keyframe: str | None = None,
        model: mujoco.MjModel | None = None,
        options: Options | None = None,
        watch: Watch | None = None,
        on_fault: OnFault = "raise",
        prepare: Callable[[mujoco.MjSpec], None] | None = None,
    ):
        """Start all environments.

        Args:
            touch: The module that reads them.
            num_envs: Number of environments.
            substeps: Physics steps per control step.
            threads: CPU threads; 0: one per CPU.
            keyframe: Name of the keyframe to start from; default: the model's own initial state.
            model: A model of your own that holds the wanted contact sensors (see `tgdsl.instrument`); default: the
                artefact's scene. Its objects are the same in all environments.
            options: MuJoCo's options that are to differ from the scene's: see `tgdsl.simulate`.
            watch: What `watched` returns.
            on_fault: What becomes of environments that diverge: "raise" has `step` raise until they are reset. "reset" restarts
                them, in the simulator and in the module, counts them in `fault_counts` and warns once. "note" leaves it to
                whoever looks at `faults` and resets them. The same holds for environments with controls that are not finite,
                which "raise" refuses.
            prepare: Changes the artefact's scene before it is compiled; bodies and contact sensors must stay.

        Raises:
            ArtifactError: If an asset of the scene is missing or has changed.
            SimulationError: If the model lacks a body, a contact sensor, the keyframe or what is watched, if its integrator is
                RK4, if its bodies may sleep, if there is nothing to step, more environments than this computer has memory for,
                if the module's state is another simulation's or of other environments, or if this MuJoCo has no `mujoco.batch`.
        """
        require_batch()
        refuse_unfit(touch, num_envs, substeps, model, options)
        if model is None:
            scenes = SharedMeshModels(touch.plan.scene, options, prepare)
            model = scenes.model({})
            if touch.inputs.objects:
                self._objects = EnvObjects(scenes, touch.inputs, num_envs)
        self.model: mujoco.MjModel = model
        what = "the scene has `sleep` enabled, and which trees sleep is not part of the state that environments share"
        refuse_two_instants(model, f'{what}; take <flag sleep="enable"/> out of its <option>')
        refuse_beyond_memory(f"{num_envs} environments", num_envs * bytes_per_env(self.model))
        self.substeps = substeps
        self._touch = touch
        self._keyframe = keyframe_id(model, keyframe)
        self.batch = mujoco.batch.Batch(self.model, num_envs, threads)
        self._warnings = StepWarnings()
        warn_of_mocap(touch.inputs, self.model)
        self._reader = BatchReader(touch.inputs, self.model, self.batch)
        self._kept = KeptJoints(JointColumns.of(touch.inputs, self.model), self.batch)
        self._keepers = [self._kept]
        if watch is not None:
            self._watch = WatchReader(watch, touch.inputs, self.model, torch.device("cpu"))
            self._watch_reader = BatchReader(self._watch.inputs, self.model, self.batch)
            self._watched_joints = KeptJoints(JointColumns.of(self._watch.inputs, self.model), self.batch)
            self._keepers.append(self._watched_joints)
        with torch.inference_mode(False):
            self._arrays = {name: torch.from_numpy(self.batch.bind(name)) for name in INTEGRATED}
            self._time = torch.zeros(num_envs, dtype=torch.float64)
            self._table = StateTable(self.model, self._arrays)
            self._faults = EnvFaults(num_envs, torch.device("cpu"), on_fault)
        self.heat = EnvHeat(touch.inputs, num_envs, torch.device("cpu"), torch.float64)
        bodies_of = touch.inputs.bodies_of
        if self._objects is None:
            self.properties = OwnFields(self.batch, model, bodies_of)
        else:
            self.properties = OwnFields(self.batch, model, bodies_of, *self._objects.variants())
            self.properties.use_models(self._objects.models())
        claim(touch, self)
        self.reset()

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self.batch.nsim

    @property
    def time(self) -> Float[torch.Tensor, " env"]:
        """When the instant is that `state` is of [s]: see `Simulation.time`."""
        return self._time.clone()

    @property
    def arrays(self) -> Mapping[str, torch.Tensor]:
        """Live tensors (env, …) of the arrays that MuJoCo integrates, in float64: they share its memory."""
        return self._arrays

    def forward(self, env_ids: EnvIds | None = None) -> None:
        """Evaluate poses, velocities and contacts of some environments where they are now: see `Simulation.forward`."""
        self._refuse_if_closed()
        ids = self._ascending(env_ids)
        self._start_contacts.forget(env_mask(torch.from_numpy(ids), self.num_envs, torch.device("cpu")))
        self._evaluate(ids)

    def body_poses(self, env: int) -> tuple[Float[Array, "body 3"], Float[Array, "body 4"]]:
        """Return where all bodies of the model are in one environment [m], and their quaternions w, x, y, z."""
        return self.batch.xpos[env], self.batch.xquat[env]

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment."""
        return self.batch.get_model(env)

    def _use_objects(self) -> None:
        assert self._objects is not None
        models = self._objects.models()
        self._run(lambda: self.properties.use_models(models))

    def _begin_episodes(self, env_ids: EnvIds | None, rows: Rows, *, finds_contacts: bool = True) -> None:
        ids = self._ascending(env_ids)
        if not len(ids):
            return
        self._run(lambda: self.batch.reset(ids, keyframe=self._keyframe, stage=mujoco.mjtStage.mjSTAGE_NONE.value))
        self._write(ids, rows)
        self._evaluate(ids, _FORWARD if finds_contacts else _VELOCITIES)
        self._touch.reset(torch.from_numpy(ids))
        is_new = torch.zeros(self.num_envs, dtype=torch.bool)
        is_new[torch.from_numpy(ids)] = True
        self._faults.clear(is_new)

    def _put(self, env_ids: EnvIds | None, rows: Rows) -> None:
        ids = self._ascending(env_ids)
        self._write(ids, rows)
        self._evaluate(ids)

    def _ascending(self, env_ids: EnvIds | None) -> Int[Array, " n"]:
        """Return environments as MuJoCo takes them: in ascending order, each once."""
        ids = env_indices(env_ids, self.num_envs)
        return ids if env_ids is None or is_env_mask(env_ids, self.num_envs) else np.unique(ids)

    def _write(self, ids: Int[Array, " n"], rows: Rows) -> None:
        chosen = torch.from_numpy(ids)
        for name, values in rows.values.items():
            self._arrays[name][chosen] = values[chosen]

    def _evaluate(self, ids: Int[Array, " n"], stage: int = _FORWARD) -> None:
        if len(ids):
            self._run(lambda: self.batch.forward(ids, stage=stage))
            self._time[ids] = self._arrays["time"][ids]
            for keeper in self._keepers:
                keeper.keep(ids)

    def _advance(self, num_steps: int) -> None:
        self.batch.warning[...] = 0
        keepers = [keeper for keeper in self._keepers if keeper.is_wanted]
        self._physics_steps(num_steps - 1 if keepers else num_steps)
        if keepers:
            self._drive()
            for keeper in keepers:
                keeper.keep()
            self._run(lambda: self.batch.step(nstep=1))
        self._time.copy_(self._arrays["time"]).sub_(float(self.model.opt.timestep))
        self._faults.note(DIVERGED, torch.from_numpy(self.batch.warning[:, _DIVERGENCES, 1].any(axis=1)))
        is_faulty = self._faults.update()
        if not is_faulty.any():
            return
        if self._faults.on_fault == "raise":
            raise SimulationError("; ".join(self._faults.messages(diverged=", and MuJoCo has restarted them")))
        if self._faults.on_fault == "reset":
            self._begin_episodes(is_faulty, Rows({}))
            self._faults.note_restarted(is_faulty)
        self._faults.warn_once()

    def _physics_steps(self, num: int) -> None:
        """Make physics steps: all in one call if nothing drives them."""
        if self.drive is None and num:
            self._run(lambda: self.batch.step(nstep=num))
            return
        for _ in range(num):
            self._drive()
            self._run(lambda: self.batch.step(nstep=1))

    def _drive(self) -> None:
        if self.drive is not None:
            self.drive()

    def read(self, env_ids: EnvIds | None = None) -> dict[str, torch.Tensor]:
        """Return the module's readings: see `Simulation.read`. Of few environments only these states are gathered."""
        if env_ids is None or self._touch.inputs.substeps > 1 or self._touch.device.type != "cpu":
            return super().read(env_ids)
        mask = env_mask(env_ids, self.num_envs, torch.device("cpu"))
        rows = few_rows(mask)
        if rows is None:
            return super().read(mask)
        self._refuse_if_closed()
        state = self._start_contacts.applied_to(self._state(self.control_step, rows.numpy()), rows=rows)
        return self._touch.read_few(state, rows, self.num_envs)

    def _state(self, dt: float, rows: Int[Array, " n"] | slice = slice(None)) -> SceneState:
        values = self._reader.read(rows) | self._kept.read(rows)
        if self._objects is not None:
            values |= {"variant": self._objects.variant[rows], "object_size": self._objects.object_size[rows]}
        tensors = {name: torch.from_numpy(value) for name, value in values.items()}
        tensors |= {name: value[rows] for name, value in self.heat.read().items()} | {"time": self.time[rows]}
        return self._scene_state({name: value.to(self._touch.device) for name, value in tensors.items()}, dt)

    def _read_watch(self) -> SceneState:
        arrays = self._watch_reader.read() | self._watched_joints.read()
        values: dict[str, Any] = {name: torch.from_numpy(array) for name, array in arrays.items()}
        return SceneState(**values)

    def _run(self, call: Callable[[], None]) -> None:
        try:
            with collected_messages() as messages:
                call()
        except (mujoco.batch.SimulationError, mujoco.FatalError, ValueError) as error:
            raise SimulationError(f"MuJoCo: {error}") from error
        if messages:
            self._warnings.tell(messages)
