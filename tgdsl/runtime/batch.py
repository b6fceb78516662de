"""MuJoCo on CPU threads: many environments of the artefact's scene, stepped together.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, overload

import mujoco
import mujoco.batch
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.env_ids import EnvIds, env_indices
from tgdsl.errors import SimulationError, listed
from tgdsl.module import TactileModule
from tgdsl.runtime.controls import control_tensor, refuse_unfinite
from tgdsl.runtime.lookup import body_id, contact_sensor, keyframe_id
from tgdsl.runtime.objects import EnvObjects, Values
from tgdsl.runtime.room import bytes_per_env, refuse_beyond_memory
from tgdsl.runtime.warp import WarpSimulation
from tgdsl.scene import SceneModels
from tgdsl.state import SceneState

Array = np.ndarray
_SLOT_SIZE = 16
_DIVERGENCES = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]
_DERIVED = ("xpos", "xquat", "cvel", "subtree_com", "sensordata")


class BatchSimulation:
    """Environments in MuJoCo's `Batch`, read by one module.

    Everything `state` hands out is of one instant: after `step`, MuJoCo's poses, velocities and contacts are those at the
    start of the last substep, and so is the state. After `reset` they are those of the start.

    Attributes:
        model: The compiled scene; where objects differ between environments, that of the first.
        batch: MuJoCo's batch: `batch.qpos`, `batch.qvel` and others are live arrays (env, …).
        substeps: Physics steps per control step.
    """

    def __init__(
        self,
        touch: TactileModule,
        num_envs: int,
        *,
        substeps: int = 1,
        threads: int = 0,
        keyframe: str | None = None,
        model: mujoco.MjModel | None = None,
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

        Raises:
            ArtifactError: If an asset of the scene is missing or has changed.
            SimulationError: If the model lacks a body, a contact sensor or the keyframe, if its integrator is RK4, if its
                bodies may sleep, if there is nothing to step, or more environments than this computer has memory for.
        """
        if num_envs < 1 or substeps < 1:
            raise SimulationError(f"num_envs is {num_envs} and substeps {substeps}, expected at least 1 of each")
        if model is not None and touch.inputs.objects:
            what = f"object {touch.inputs.objects[0]} differs between environments, which one model cannot"
            raise SimulationError(f"{what}; leave `model` out")
        self._objects: EnvObjects | None = None
        if model is None:
            scenes = SceneModels(touch.plan.scene)
            model = scenes.model({})
            self._objects = EnvObjects(scenes, touch.inputs, num_envs) if touch.inputs.objects else None
        self.model: mujoco.MjModel = model
        if self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            raise SimulationError("with the integrator RK4 MuJoCo's poses and contacts are of two instants; choose another one")
        if self.model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
            what = "the scene has `sleep` enabled, and which trees sleep is not part of the state that environments share"
            raise SimulationError(f'{what}; take <flag sleep="enable"/> out of its <option>')
        refuse_beyond_memory(f"{num_envs} environments", num_envs * bytes_per_env(self.model))
        self.substeps = substeps
        self._touch = touch
        self._keyframe = -1 if keyframe is None else keyframe_id(model, keyframe)
        self._body_ids = np.array([body_id(model, name) for name in touch.inputs.bodies], dtype=np.intp)
        self._root_ids = self.model.body_rootid[self._body_ids]
        self._slots = [contact_sensor(model, pair, 0) for pair in touch.inputs.pairs]
        nets = touch.inputs.pairs if "contact_netforce" in touch.inputs.fields else ()
        self._nets = [contact_sensor(model, pair, 1) for pair in nets]
        self.batch = mujoco.batch.Batch(self.model, num_envs, threads)
        self._readers = {name: _READERS[name] for name in touch.inputs.fields if name != "dt"}
        for name in _DERIVED:
            self.batch.bind(name)  # an array is filled only by calls that come after its first use
        if self._objects is not None:
            self.batch.set_models(self._objects.models())
        self.reset()

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self.batch.nsim

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        return self.substeps * float(self.model.opt.timestep)

    def step(self, control: Tensor | Array | None = None) -> None:
        """Advance all environments by one control step.

        Args:
            control: Actuator controls, (env, actuator) or (actuator,) for all alike; default: as they were.

        Raises:
            SimulationError: If the controls are not finite or do not fit, an environment diverges, or MuJoCo reports one as
                failed. The other environments have then made their step.
        """
        self._set_control(control)
        self._advance(self.substeps)

    def substates(self, control: Tensor | Array | None = None) -> Iterator[SceneState]:
        """Advance all environments by one control step, and hand out the state after each of its physics steps.

        For sensors that are read at every physics step: `for state in sim.substates(control): readings = touch(state)`. The
        simulator is where `step` would have left it once all are taken; who stops earlier has made fewer physics steps.

        Args:
            control: Actuator controls, as for `step`; they are set when the first state is asked for.

        Yields:
            What `state` returns after each physics step; its `dt` is that of one physics step.

        Raises:
            SimulationError: As `step` does, at the physics step where it happens.
        """
        self._set_control(control)
        for _ in range(self.substeps):
            self._advance(1)
            yield self._state(float(self.model.opt.timestep))

    def state(self) -> SceneState:
        """Return what the module wants, of one instant, in float64 on the module's device; `dt` is that of a control step."""
        return self._state(self.control_step)

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Start some environments anew (default: all), in the simulator and in the module.

        Raises:
            SimulationError: If there are no such environments, or MuJoCo reports one as failed.
        """
        ids = np.unique(env_indices(env_ids, self.num_envs))  # MuJoCo takes them in ascending order, each once
        if len(ids):
            self._run(lambda: self.batch.reset(ids, keyframe=self._keyframe))
            self._touch.reset(torch.from_numpy(ids))

    def set_objects(
        self,
        variants: Mapping[str, Values] | None = None,
        sizes: Mapping[str, Values] | None = None,
        env_ids: EnvIds | None = None,
    ) -> None:
        """Say what objects are like in some environments (default: all), and start these anew.

        At first, environment i has variant i modulo their number. MuJoCo compiles one model per distinct choice: for a cube in
        the XHand1's palm, 10 ms and 3 MB.

        Args:
            variants: Which variant of an object these environments have: (env,) integers, or one for all.
            sizes: Size of an object in them as MuJoCo defines it [m]: (env, size), or one for all.
            env_ids: Indices, or a boolean mask over environments.

        Raises:
            SimulationError: If there is no such object, variant or environment, or a size does not fit; nothing has changed.
        """
        if self._objects is None:
            raise SimulationError("no object of this module differs between environments")
        ids = env_indices(env_ids, self.num_envs)
        self._objects.choose(ids, variants or {}, sizes or {})
        models = self._objects.models()
        self._run(lambda: self.batch.set_models(models))
        self.reset(ids)

    def body_poses(self, env: int) -> tuple[Float[Array, "body 3"], Float[Array, "body 4"]]:
        """Return where all bodies of the model are in one environment [m], and their quaternions w, x, y, z."""
        return self.batch.xpos[env], self.batch.xquat[env]

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment."""
        return self.batch.get_model(env)

    def _set_control(self, control: Tensor | Array | None) -> None:
        if control is None:
            return
        values = control_tensor(control, self.num_envs, self.model.nu).cpu()
        refuse_unfinite(values)
        self.batch.ctrl[...] = values.numpy()

    def _advance(self, num_steps: int) -> None:
        self.batch.warning[...] = 0
        self._run(lambda: self.batch.step(nstep=num_steps))
        diverged = np.flatnonzero(self.batch.warning[:, _DIVERGENCES, 1].any(axis=1))
        if len(diverged):
            which = listed([str(env) for env in diverged])
            raise SimulationError(f"environments {which} diverged, and MuJoCo has started them anew; reset them to go on")

    def _state(self, dt: float) -> SceneState:
        values: dict[str, Any] = {}
        for name, reader in self._readers.items():
            values[name] = torch.from_numpy(np.ascontiguousarray(reader(self))).to(self._touch.device)
        if "dt" in self._touch.inputs.fields:
            values["dt"] = dt
        return SceneState(**values)

    def _run(self, call: Callable[[], None]) -> None:
        try:
            call()
        except (mujoco.batch.SimulationError, mujoco.FatalError, ValueError) as error:
            raise SimulationError(f"MuJoCo: {error}") from error

    def _body_pos(self) -> Float[Array, "env body 3"]:
        return self.batch.xpos[:, self._body_ids]

    def _body_quat(self) -> Float[Array, "env body 4"]:
        return self.batch.xquat[:, self._body_ids]

    def _body_angvel(self) -> Float[Array, "env body 3"]:
        return self.batch.cvel[:, self._body_ids, :3]

    def _body_linvel(self) -> Float[Array, "env body 3"]:
        """Move MuJoCo's spatial velocity from the centre of mass of the kinematic tree to the body frame's origin."""
        angular, linear = self._body_angvel(), self.batch.cvel[:, self._body_ids, 3:]
        return linear + np.cross(angular, self._body_pos() - self.batch.subtree_com[:, self._root_ids])

    def _contact_found(self) -> Float[Array, "env pair"]:
        return self.batch.sensordata[:, [part.start for part in self._slots]]

    def _slot_part(self, first: int) -> Float[Array, "env pair slot 3"]:
        """Return three numbers of each slot: 1 force, 4 torque, 7 position, 10 normal, 13 tangent."""
        slots = np.stack([self.batch.sensordata[:, part.start : part.stop] for part in self._slots], axis=1)
        return slots.reshape(*slots.shape[:2], -1, _SLOT_SIZE)[..., first : first + 3]

    def _in_world(self, first: int) -> Float[Array, "env pair slot 3"]:
        """Rotate a vector from the contact's frame (normal, tangent, their cross product) to the world."""
        normal, tangent = self._slot_part(10), self._slot_part(13)
        axes = np.stack([normal, tangent, np.cross(normal, tangent)], axis=-2)
        return np.einsum("...i,...ij->...j", self._slot_part(first), axes)

    def _contact_netforce(self) -> Float[Array, "env pair 3"]:
        return np.stack([self.batch.sensordata[:, part.start + 1 : part.start + 4] for part in self._nets], axis=1)


_READERS: dict[str, Callable[[BatchSimulation], Array]] = {
    "body_pos": BatchSimulation._body_pos,
    "body_quat": BatchSimulation._body_quat,
    "body_linvel": BatchSimulation._body_linvel,
    "body_angvel": BatchSimulation._body_angvel,
    "contact_found": BatchSimulation._contact_found,
    "contact_pos": lambda sim: sim._slot_part(7),
    "contact_force": lambda sim: sim._in_world(1),
    "contact_torque": lambda sim: sim._in_world(4),
    "contact_normal": lambda sim: sim._slot_part(10),
    "contact_netforce": BatchSimulation._contact_netforce,
    "variant": lambda sim: _present(sim._objects).variant,
    "object_size": lambda sim: _present(sim._objects).object_size,
}


def _present(objects: EnvObjects | None) -> EnvObjects:
    assert objects is not None
    return objects


@overload
def simulate(
    touch: TactileModule,
    num_envs: int,
    *,
    device: Literal["cpu"] = "cpu",
    substeps: int = 1,
    threads: int = 0,
    keyframe: str | None = None,
) -> BatchSimulation: ...
@overload
def simulate(
    touch: TactileModule,
    num_envs: int,
    *,
    device: str,
    substeps: int = 1,
    threads: int = 0,
    keyframe: str | None = None,
    nconmax: int | None = None,
    njmax: int | None = None,
) -> BatchSimulation | WarpSimulation: ...
def simulate(
    touch: TactileModule,
    num_envs: int,
    *,
    device: str = "cpu",
    substeps: int = 1,
    threads: int = 0,
    keyframe: str | None = None,
    nconmax: int | None = None,
    njmax: int | None = None,
) -> BatchSimulation | WarpSimulation:
    """Simulate the scene that a module was compiled for.

    Args:
        touch: The module.
        num_envs: Number of environments.
        device: Where physics runs: "cpu" is MuJoCo's Batch, "cuda" or "cuda:1" is MuJoCo Warp. The state is handed out on the
            module's device; both on one GPU need no copies.
        substeps: Physics steps per control step.
        threads: CPU threads; 0: one per CPU.
        keyframe: Name of the keyframe to start from.
        nconmax: On a GPU, room for contacts per environment, in a pool that all share: see `WarpSimulation`.
        njmax: On a GPU, room for rows of constraints in each environment.

    Raises:
        ArtifactError: If an asset of the scene is missing or has changed.
        SimulationError: If the device is not supported, an argument is for another device, or the scene lacks what the module
            wants.
    """
    if device == "cpu":
        if nconmax is not None or njmax is not None:
            raise SimulationError('nconmax and njmax are for physics on a GPU; on "cpu" there is always room')
        return BatchSimulation(touch, num_envs, substeps=substeps, threads=threads, keyframe=keyframe)
    if threads:
        raise SimulationError(f'threads is {threads}, but only physics on "cpu" has threads, and the device is "{device}"')
    keys: dict[str, Any] = {"nconmax": nconmax, "njmax": njmax}
    return WarpSimulation(touch, num_envs, device=device, substeps=substeps, keyframe=keyframe, **keys)
