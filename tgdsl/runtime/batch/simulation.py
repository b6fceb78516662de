"""MuJoCo on CPU threads: many environments of the artefact's scene, stepped together.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int

from tgdsl.errors import SimulationError
from tgdsl.module.memory.some_rows import few_rows
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.runtime.batch import require_batch
from tgdsl.runtime.batch.own_fields import OwnFields
from tgdsl.runtime.batch.reading import BatchReader
from tgdsl.runtime.simulators.bodies import warn_of_mocap
from tgdsl.runtime.simulators.claims import claim, refuse_two_instants, refuse_unfit
from tgdsl.runtime.simulators.faults import DIVERGED, EnvFaults, OnFault
from tgdsl.runtime.simulators.joint_fields import JointColumns, KeptJoints
from tgdsl.runtime.simulators.memory import bytes_per_env, refuse_beyond_memory
from tgdsl.runtime.simulators.model_ids import keyframe_id
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
            on_fault: What becomes of environments that diverge: "raise" has `step` raise until they are reset; "reset" starts
                them anew, in the simulator and in the module, counts them in `fault_counts` and warns once; "note" leaves it to
                whoever looks at `faults` and resets them. So do environments with controls that are not finite, which "raise"
                refuses.
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
            raise SimulationError("; ".join(self._faults.messages(diverged=", and MuJoCo has started them anew")))
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
