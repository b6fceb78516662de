"""MuJoCo Warp on a GPU: many environments of the artefact's scene, stepped together by CUDA graphs.

Shapes: `env` environments, `body` and `pair` as the module's `inputs` list them, `slot` contacts per pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.bodies import BodyFields
from tgdsl.runtime.simulators.joint_fields import JointColumns
from tgdsl.runtime.simulators.objects.choices import EnvObjects
from tgdsl.runtime.simulators.objects.properties import (
    MASS_FIELDS,
    PER_ENV,
    ObjectProperties,
    RigidObject,
    refuse_other_fields,
)
from tgdsl.runtime.simulators.simulation import Control, SimOptions, Simulation, SomeRows
from tgdsl.runtime.simulators.state_values import Rows, StateTable
from tgdsl.runtime.simulators.watch import merged_joints
from tgdsl.runtime.warp.contacts import PairContacts
from tgdsl.runtime.warp.objects import OWN_FIELDS, WorldObjects
from tgdsl.runtime.warp.stream import GraphedCall, WarpStream
from tgdsl.runtime.warp.worlds import Worlds
from tgdsl.tensors.env_ids import broadcast_over


class StateReader:
    """Gathers the fields of a state by index, on the device."""

    def __init__(
        self,
        inputs: Inputs,
        model: mujoco.MjModel,
        sources: Mapping[str, Tensor],
        kept: Mapping[str, Tensor],
        contacts: PairContacts | None = None,
    ):
        self._sources, self._contacts = sources, contacts
        device = sources["xpos"].device
        self._bodies = BodyFields(
            inputs,
            model,
            index=lambda ids: torch.from_numpy(ids).to(device),
            take=lambda array, ids: array[:, ids],
            cross=torch.linalg.cross,
        )
        indices = JointColumns.of(inputs, model)
        self._joints = {
            name: ({**sources, **kept}[array], torch.from_numpy(indices.by_array[array]).to(device))
            for name, array in indices.fields.items()
        }

    def read(self, rows: SomeRows = None) -> dict[str, Tensor]:
        """Return poses, velocities, contacts and joints by field of a state, each a tensor of its own, of all environments."""
        values = self._bodies.read(self._sources) | ({} if self._contacts is None else self._contacts.read())
        values |= {name: array[:, columns] for name, (array, columns) in self._joints.items()}
        return values


class WorldProperties(ObjectProperties):
    """Masses and frictions of objects, changed on the device without waiting."""

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        model: mujoco.MjModel,
        bodies_of: Mapping[str, str],
        num_envs: int,
        device: torch.device,
    ):
        super().__init__(model, bodies_of, num_envs, device)
        self._fields = parameters
        self._plain: dict[str, list[tuple[Tensor, Tensor, Tensor]]] = {}

    def renew(self) -> None:
        """Take what objects now are like as what masses are changed from: after others were chosen."""
        for parts in self._plain.values():
            for array, columns, value in parts:
                value.copy_(array[:, columns])

    def fields(self) -> dict[str, Tensor]:
        """Return what environments have of their own: see `ObjectProperties.fields`."""
        return dict(self._fields)

    def set_fields(self, fields: Mapping[str, Tensor]) -> None:
        """Give environments fields of their own: see `ObjectProperties.set_fields`."""
        refuse_other_fields(fields, self._fields)
        for name, value in fields.items():
            self._fields[name].copy_(value)

    def _set_mass(self, target: RigidObject, mask: Bool[Tensor, " env"], mass: Float[Tensor, " env"]) -> None:
        self._check("mass")
        if not target.is_tree:
            what = f'"{target.name}" is part of a kinematic tree, or its joints have armature'
            raise SimulationError(f"{what}: what follows of its mass is not a matter of scale; simulate on the CPU")
        own, inertia, subtree, body, dof = (self._fields[name] for name in MASS_FIELDS)
        bodies, above, dofs = (self._index(target, name) for name in ("bodies", "above", "dofs"))
        parts = [(own, bodies), (inertia, bodies), (subtree, bodies), (body, bodies), (dof, dofs)]
        if target.name not in self._plain:  # what masses are changed from each time: rounding would add up
            self._plain[target.name] = [(array, columns, array[:, columns].clone()) for array, columns in parts]
        plain = [value for _, _, value in self._plain[target.name]]
        before = own[:, bodies].sum(dim=1)
        factor = mass.to(own.dtype) / plain[0].sum(dim=1)
        scales = (factor, factor, factor, 1.0 / factor, 1.0 / factor)
        for (array, columns), value, scale in zip(parts, plain, scales, strict=True):
            new = value * scale.view(-1, *[1] * (value.ndim - 1))
            array[:, columns] = torch.where(broadcast_over(mask, new), new, array[:, columns])
        subtree[:, above] = subtree[:, above] + (own[:, bodies].sum(dim=1) - before)[:, None]

    def _set_friction(self, target: RigidObject, mask: Bool[Tensor, " env"], friction: Float[Tensor, " env"]) -> None:
        self._check("friction")
        own = self._fields["geom_friction"]
        geoms = self._index(target, "geoms")
        own[:, geoms, 0] = torch.where(mask[:, None], friction.to(own.dtype)[:, None], own[:, geoms, 0])

    def _values(self, field: str) -> Float[Tensor, "env ..."]:
        """Return what each environment has of a field of the model, also where all share it."""
        if field in self._fields:
            return self._fields[field]
        shared = torch.from_numpy(getattr(self._model, field)).to(self._device, torch.float32)
        return shared.expand(self._num_envs, *shared.shape)

    def _check(self, word: str) -> None:
        if not self._fields.keys() >= set(PER_ENV[word]):
            raise SimulationError(f'environments share each {word}; simulate(..., per_env=("{word}",)) gives them their own')


T = TypeVar("T")


class WarpSimulation(Simulation):
    """Environments in MuJoCo Warp, in float32; `qpos`, `qvel` and `ctrl` are on the physics' device.

    Contacts of a pair come in any order; where there are more than slots, any of them are kept. Its solver stops at 1e-6 where
    MuJoCo's stops at 1e-8: forces of sliding contacts agree to 3e-3 of the largest one, and to 2e-4 after
    `warp_model.opt.tolerance.fill_(1e-8)`; those of contacts that stick to 1e-5 either way.

    Devices are "cuda", "cuda:1", or "cpu", which is slow and meant for tests. On a GPU nothing waits for it unless the host's
    own numbers are handed in or asked for. What goes wrong there is therefore reported by a later call: `check` looks at once.

    Attributes:
        model: The compiled scene; where objects differ between environments, that of the first, and with a spare body at the
            end if some of their variants are meshes.
    """

    OPTIONS = ("substeps", "keyframe", "nconmax", "njmax", "model", "options", "watch", "per_env", "on_fault", "graph")
    DEVICE = "cuda"
    properties: WorldProperties
    _world_objects: WorldObjects | None = None

    @property
    def arrays(self) -> Mapping[str, Tensor]:
        """Live tensors (env, …) of MuJoCo's arrays: what it integrates, and what states are read from.

        In `arrays["sensordata"]` the contact sensors that `tgdsl.instrument` adds are zero: their contacts are read elsewhere.
        """
        return self._arrays

    @property
    def parameters(self) -> Mapping[str, Tensor]:
        """Live tensors (env, …) of the model's fields that environments have of their own.

        What MuJoCo derives from them, such as `body_subtreemass`, is not derived again.
        """
        return self._worlds.parameters

    @property
    def warp_model(self) -> Any:
        """MuJoCo Warp's model."""
        return self._worlds.model

    @property
    def warp_data(self) -> Any:
        """MuJoCo Warp's data."""
        return self._worlds.data

    def step_and_read(self, control: Control = None) -> dict[str, Tensor]:
        """Advance by one control step and return the module's readings: on a GPU all in one CUDA graph.

        It is `step(control)` and then `touch(state())`, without gradients, and for the price of one launch. As with any CUDA
        graph, the next call overwrites the readings; `clone` what is to be kept. The first two calls run eagerly, the third
        captures; the graph is captured again when the module holds other tensors than before: when it was moved, compiled,
        freed, or given another dt.

        Args:
            control: As for `step`.

        Raises:
            SimulationError: As from `step`, or if the module is on another device than physics.
        """
        if self._touch.device != self._stream.device:
            raise SimulationError(
                f"the module is on {self._touch.device}, physics on {self._stream.device}; expected one device"
            )
        self._forget_other_tensors()
        self._begin_step(control)
        readings = self._step_and_read()
        self._earlier.stepped(self._faults.restarted)
        self._touch.record_outputs(readings)
        self._finish_step(is_evaluated=True)
        return readings

    def repeated(self, body: Callable[[], T]) -> Callable[[], T]:
        """Return work that is done again and again, such as a whole step of an environment: see `Simulation.repeated`."""
        call = GraphedCall(self._stream, body)
        placed: tuple[Bool[Tensor, " env"] | None, dict[str, Tensor]] = (None, {})

        def done() -> T:
            nonlocal placed
            self._refuse_if_closed()
            was_captured = call.is_captured
            result = call()
            if call.is_captured:  # what the work notes on the host is as it was when it was captured
                start = self._start_contacts
                placed = placed if was_captured else (start.is_placed, dict(start.values))
                start.is_placed, start.values = placed[0], dict(placed[1])
                self._finish_step(is_evaluated=True)
            return result

        return done

    def body_poses(self, env: int) -> tuple[Float[np.ndarray, "body 3"], Float[np.ndarray, "body 4"]]:
        """Return where all bodies are in one environment: origins [m], quaternions w, x, y, z. A GPU is waited for."""
        self._worlds.refresh()
        pos, quat = (self.arrays[name][env].double().cpu().numpy() for name in ("xpos", "xquat"))
        return pos, quat

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment, its objects as they are there; `parameters` are not in it."""
        return self.model if self._world_objects is None else self._world_objects.env_model(env)

    def check(self) -> None:
        """Look for what has gone wrong in any environment since it was last reset. It waits for a GPU.

        Raises:
            SimulationError: If an environment has diverged or its controls were not finite, or a pool was too small.
        """
        message = self._worlds.message()
        if message:
            raise SimulationError(message)

    def recapture(self) -> None:
        """Capture the CUDA graphs again: when an array of `warp_model` or `warp_data` was replaced."""
        for call in (self._step, self._substep, self._step_and_read):
            call.forget()
        self._worlds.forget_graphs()

    def _forget_other_tensors(self) -> None:
        """Forget a graph that was captured with other tensors of the module than it has now."""
        held = (self.drive, self._touch.calls.compiled, self._touch.incoming.held_dt, *self._touch.buffers())
        if len(held) != len(self._held) or any(now is not then for now, then in zip(held, self._held, strict=True)):
            self._step_and_read.forget()
            self._held = held

    def _physics_and_touch(self) -> dict[str, Tensor]:
        if not self._earlier.are_wanted:
            self._worlds.step(self.substeps, self.drive)
        else:
            self._earlier.begin(self.substeps)
            for i in range(self.substeps):
                if i:
                    self._earlier.note(self._gathered(float(self.model.opt.timestep)))
                self._worlds.step(1, self.drive)
            self._earlier.restart(self._faults.restarted)
        if self._faults.on_fault == "reset":
            self._touch.reset(self._worlds.restarted)
            self._worlds.evaluate_stale()
        return self._touch(self._earlier.added_to(self._gathered(self.control_step)))

    def _open_device(self, device: str, options: SimOptions) -> torch.device:
        self._stream = WarpStream(device, options.get("graph", True))
        return self._stream.device

    def _start(self, num_envs: int, keyframe: int, options: SimOptions) -> None:
        inputs = self._touch.inputs
        if self._objects is not None:
            self._world_objects = WorldObjects(self._objects, inputs)
        own = list(OWN_FIELDS) if self._world_objects else []
        per_env = [field for word in options.get("per_env", ()) for field in PER_ENV.get(word, (word,))]
        self._worlds = Worlds(
            self.model if self._world_objects is None else self._world_objects.model,
            merged_joints(inputs, self._watch),
            num_envs,
            self._stream,
            keyframe=keyframe,
            nconmax=options.get("nconmax"),
            njmax=options.get("njmax"),
            per_env=list(dict.fromkeys(per_env + own)),
            on_fault=options.get("on_fault", "raise"),
        )
        self._arrays, self._faults, self._instant = self._worlds.arrays, self._worlds.faults, self._worlds.kept["time"]
        self.properties = WorldProperties(self._worlds.parameters, self.model, inputs.bodies_of, num_envs, self._device)
        with self._stream.scope():
            self._table = StateTable(self.model, self._arrays)
        if self._world_objects is not None:
            self._world_objects.write_to(self._worlds)
        self._step = GraphedCall(self._stream, lambda: self._worlds.step(self.substeps, self.drive))
        self._substep = GraphedCall(self._stream, lambda: self._worlds.step(1, self.drive))
        self._step_and_read = GraphedCall(self._stream, self._physics_and_touch)
        self._held: tuple[object, ...] = ()
        self._driven = self.drive

    def _make_reader(self, inputs: Inputs) -> StateReader:
        contacts = self._worlds.contacts if inputs is self._touch.inputs else None
        return StateReader(inputs, self.model, self._worlds.arrays, self._worlds.kept, contacts)

    def _refresh(self) -> None:
        self._worlds.refresh()

    def _use_objects(self, objects: EnvObjects) -> None:
        assert self._world_objects is not None
        self._world_objects.write_to(self._worlds)
        self.properties.renew()

    def _begin_episodes(self, mask: Bool[Tensor, " env"], rows: Rows, *, finds_contacts: bool) -> None:
        self._worlds.reset(mask, rows, finds_contacts=finds_contacts)

    def _put(self, mask: Bool[Tensor, " env"], rows: Rows) -> None:
        self._worlds.put(mask, rows)

    def _evaluate(self, mask: Bool[Tensor, " env"]) -> None:
        self._worlds.make_stale(mask)

    def _advance(self, num_steps: int) -> None:
        self._worlds.prepare()
        if self.drive is not self._driven:
            self._driven = self.drive
            self._step.forget()
            self._substep.forget()
        (self._step if num_steps == self.substeps else self._substep)()
        if self._faults.on_fault == "reset":
            self._touch.reset(self._worlds.restarted.to(self._touch.device))
        self._finish_step()

    def _finish_step(self, is_evaluated: bool = False) -> None:
        self._worlds.note_step(is_evaluated)
        if self._stream.is_capturing:
            return
        self._touch.incoming.slot_watch.warn()
        to_raise, totals = self._worlds.faults.polled()
        if to_raise:
            self.check()
        if self._faults.on_fault != "raise":
            self._faults.warn_once(totals)
