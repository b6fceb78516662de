"""MuJoCo Warp on a GPU: many environments of the artefact's scene, stepped together by CUDA graphs.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.env_ids import EnvIds, env_indices, env_mask
from tgdsl.errors import SimulationError
from tgdsl.module import TactileModule
from tgdsl.runtime.controls import control_tensor, is_unfinite, refuse_unfinite
from tgdsl.runtime.lookup import keyframe_id
from tgdsl.runtime.objects import Values
from tgdsl.runtime.warp.lane import Lane, Replay
from tgdsl.runtime.warp.meshed import MeshedModels
from tgdsl.runtime.warp.objects import OWN_FIELDS, WorldObjects
from tgdsl.runtime.warp.reading import StateReader
from tgdsl.runtime.warp.worlds import Worlds
from tgdsl.state import SceneState


class WarpSimulation:
    """Environments in MuJoCo Warp, read by one module.

    It offers what `BatchSimulation` does, in float32, and everything `state` hands out is of one instant: after `step`, poses,
    velocities and contacts are those at the start of the last substep. After `reset` they are those of the start. Contacts of a
    pair come in any order; where there are more than slots, any of them are kept. Its solver stops at 1e-6 where MuJoCo's stops
    at 1e-8: forces of sliding contacts agree to 3e-3 of the largest one, and to 2e-4 after
    `warp_model.opt.tolerance.fill_(1e-8)`; those of contacts that stick to 1e-5 either way.

    On a GPU nothing waits for it unless the host's own numbers are handed in or asked for. What goes wrong there is therefore
    reported by a later call: `check` looks at once.

    Attributes:
        model: The compiled scene; where objects differ between environments, that of the first, and with a spare body at the
            end if some of their variants are meshes.
        substeps: Physics steps per control step.
        arrays: Live tensors (env, …) of MuJoCo's arrays, such as `arrays["qpos"]`. In `arrays["sensordata"]` the contact
            sensors that `tgdsl.instrument` adds are zero: their contacts are read elsewhere.
        parameters: Live tensors (env, …) of the model's fields that environments have of their own; what MuJoCo derives from
            them, such as `body_subtreemass`, is not derived anew.
        warp_model: MuJoCo Warp's model.
        warp_data: MuJoCo Warp's data.
    """

    def __init__(
        self,
        touch: TactileModule,
        num_envs: int,
        *,
        substeps: int = 1,
        keyframe: str | None = None,
        nconmax: int | None = None,
        njmax: int | None = None,
        model: mujoco.MjModel | None = None,
        per_env: Sequence[str] = (),
        device: str = "cuda",
        graph: bool = True,
    ):
        """Start all environments.

        Args:
            touch: The module that reads them; on the same device nothing is copied.
            num_envs: Number of environments.
            substeps: Physics steps per control step.
            keyframe: Name of the keyframe to start from; default: the model's own initial state.
            nconmax: Room for contacts per environment, in a pool that all share; default 48.
            njmax: Room for rows of constraints in each environment; default: as many as `nconmax` contacts and all limits make.
            model: A model of your own; default: the artefact's scene. Its objects are the same in all environments. Contacts
                are read without the sensors that `tgdsl.instrument` adds to it: it may lack them.
            per_env: Fields of the model that environments shall have of their own, such as "geom_friction".
            device: Where physics runs: "cuda", "cuda:1", or "cpu", which is slow and meant for tests.
            graph: Whether a GPU's work is captured as CUDA graphs; without them it is easier to debug and slower.

        Raises:
            ArtifactError: If an asset of the scene is missing or has changed.
            SimulationError: If the model lacks a body or the keyframe, holds something that MuJoCo Warp does
                not support, if there is nothing to step, or no such device or library.
        """
        if num_envs < 1 or substeps < 1:
            raise SimulationError(f"num_envs is {num_envs} and substeps {substeps}, expected at least 1 of each")
        if model is not None and touch.inputs.objects:
            what = f"object {touch.inputs.objects[0]} differs between environments, which one model cannot"
            raise SimulationError(f"{what}; leave `model` out")
        self._touch, self.substeps = touch, substeps
        self._lane = Lane(device, graph)
        self._objects: WorldObjects | None = None
        if model is None:
            scenes = MeshedModels(touch.plan.scene)
            model = scenes.model({})
            if touch.inputs.objects:
                self._objects = WorldObjects(scenes, touch.inputs, num_envs, self._lane.device)
        self.model: mujoco.MjModel = model
        self._worlds = Worlds(
            model if self._objects is None else self._objects.model,
            touch.inputs,
            num_envs,
            self._lane,
            keyframe=-1 if keyframe is None else keyframe_id(model, keyframe),
            nconmax=nconmax,
            njmax=njmax,
            per_env=list(dict.fromkeys([*per_env, *(OWN_FIELDS if self._objects else ())])),
        )
        if self._objects is not None:
            self._objects.tell(self._worlds)
        self._reader = StateReader(touch.inputs, model, self._worlds.arrays, self._worlds.contacts)
        self._step = Replay(self._lane, lambda: self._worlds.step(self.substeps))
        self._substep = Replay(self._lane, lambda: self._worlds.step(1))
        self._step_and_read = Replay(self._lane, self._physics_and_touch)
        self._held: tuple[object, ...] = ()
        self.reset()

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return int(self._worlds.data.nworld)

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        return self.substeps * float(self.model.opt.timestep)

    @property
    def arrays(self) -> Mapping[str, Tensor]:
        """Live tensors (env, …) of MuJoCo's arrays: what it integrates, and what states are read from."""
        return self._worlds.arrays

    @property
    def parameters(self) -> Mapping[str, Tensor]:
        """Live tensors (env, …) of the model's fields that environments have of their own."""
        return self._worlds.parameters

    @property
    def warp_model(self) -> Any:
        """MuJoCo Warp's model."""
        return self._worlds.model

    @property
    def warp_data(self) -> Any:
        """MuJoCo Warp's data."""
        return self._worlds.data

    def step(self, control: Tensor | np.ndarray | None = None) -> None:
        """Advance all environments by one control step.

        Args:
            control: Actuator controls, (env, actuator) or (actuator,) for all alike; default: as they were. Those on the GPU
                are checked there.

        Raises:
            SimulationError: If the controls are not finite or do not fit, an environment has diverged, or a pool was too small:
                on a GPU as soon as that is known. The other environments have then made their step.
        """
        self._set_control(control)
        self._step()
        self._finish_step()

    def substates(self, control: Tensor | np.ndarray | None = None) -> Iterator[SceneState]:
        """Advance all environments by one control step, and hand out the state after each of its physics steps.

        For sensors that are read at every physics step: `for state in sim.substates(control): readings = touch(state)`. The
        simulator is where `step` would have left it once all are taken; who stops earlier has made fewer physics steps.

        Args:
            control: Actuator controls, as for `step`; they are set when the first state is asked for.

        Yields:
            What `state` returns after each physics step; its `dt` is that of one physics step.

        Raises:
            SimulationError: As `step` does.
        """
        self._set_control(control)
        for _ in range(self.substeps):
            self._substep()
            self._finish_step()
            yield self._state(float(self.model.opt.timestep)).to(self._touch.device)

    def step_and_read(self, control: Tensor | np.ndarray | None = None) -> dict[str, Tensor]:
        """Advance by one control step and return the module's readings: on a GPU all in one CUDA graph.

        It is `step(control)` and then `touch(state())`, without gradients, and for the price of one launch. As with any CUDA
        graph, the next call overwrites the readings; `clone` what is to be kept. The first two calls run eagerly, the third
        captures; the graph is captured anew when the module holds other tensors than before: when it was moved, compiled,
        seeded or given another dt. A module that stacks or averages its last calls counts them on the host: it reads after the
        graph, not in it.

        Args:
            control: As for `step`.

        Raises:
            SimulationError: As from `step`, or if the module is on another device than physics.
        """
        if self._touch.device != self._lane.device:
            raise SimulationError(f"the module is on {self._touch.device}, physics on {self._lane.device}; expected one device")
        if len(self._touch.histories):
            self.step(control)
            with torch.no_grad():
                return self._touch(self.state())
        self._forget_other_tensors()
        self._set_control(control)
        readings = self._step_and_read()
        self._finish_step()
        return readings

    def state(self) -> SceneState:
        """Return what the module wants, of one instant, in float32 on the module's device."""
        self._worlds.refresh()
        return self._state(self.control_step).to(self._touch.device)

    def body_poses(self, env: int) -> tuple[Float[np.ndarray, "body 3"], Float[np.ndarray, "body 4"]]:
        """Return where all bodies are in one environment: origins [m], quaternions w, x, y, z. A GPU is waited for."""
        self._worlds.refresh()
        pos, quat = (self.arrays[name][env].double().cpu().numpy() for name in ("xpos", "xquat"))
        return pos, quat

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment, its objects as they are there; `parameters` are not in it."""
        return self.model if self._objects is None else self._objects.env_model(env)

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Start some environments anew (default: all), in the simulator and in the module.

        A boolean mask on the physics' device is used as it is; with indices there, the host waits to look at them.

        Raises:
            SimulationError: If there are no such environments.
        """
        mask = env_mask(env_ids, self.num_envs, self._lane.device)
        self._worlds.reset(mask)
        self._touch.reset(None if env_ids is None else mask.to(self._touch.device))

    def set_objects(
        self,
        variants: Mapping[str, Values] | None = None,
        sizes: Mapping[str, Values] | None = None,
        env_ids: EnvIds | None = None,
    ) -> None:
        """Say what objects are like in some environments (default: all), and start these anew.

        At first, environment i has variant i modulo their number. MuJoCo compiles one model per distinct choice: for a cube in
        the XHand1's palm, 10 ms; none is kept.

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
        self._objects.tell(self._worlds)
        self.reset(ids)

    def check(self) -> None:
        """Look for what has gone wrong in any environment since it was last reset. It waits for a GPU.

        Raises:
            SimulationError: If an environment has diverged or its controls were not finite, or a pool was too small.
        """
        account = self._worlds.account()
        if account:
            raise SimulationError(account)

    def recapture(self) -> None:
        """Capture the CUDA graphs anew: when an array of `warp_model` or `warp_data` was replaced."""
        for replay in (self._step, self._substep, self._step_and_read):
            replay.forget()
        self._worlds.forget_graphs()

    def _forget_other_tensors(self) -> None:
        """Forget a graph that was captured with other tensors of the module than it has now."""
        held = (self._touch._compiled, self._touch._dt, *self._touch.buffers())
        if len(held) != len(self._held) or any(now is not then for now, then in zip(held, self._held, strict=True)):
            self._step_and_read.forget()
            self._held = held

    def _physics_and_touch(self) -> dict[str, Tensor]:
        self._worlds.step(self.substeps)
        return self._touch(self._state(self.control_step))

    def _state(self, dt: float) -> SceneState:
        values: dict[str, Any] = dict(self._reader.read())
        if self._objects is not None:
            values |= {"variant": self._objects.variant.clone(), "object_size": self._objects.object_size.clone()}
        values["dt"] = dt
        return SceneState(**{name: value for name, value in values.items() if name in self._touch.inputs.fields})

    def _set_control(self, control: Tensor | np.ndarray | None) -> None:
        """Take controls over.

        Raises:
            SimulationError: If they do not fit, or are the host's and not finite.
        """
        if control is None:
            return
        values = control_tensor(control, self.num_envs, self.model.nu)
        if values.device.type == "cpu":
            refuse_unfinite(values)
        else:
            self._worlds.faults.note_control(is_unfinite(values).to(self._lane.device))
        self._worlds.arrays["ctrl"].copy_(values)

    def _finish_step(self) -> None:
        self._worlds.stepped()
        if self._worlds.faults.have_shown():
            self.check()
