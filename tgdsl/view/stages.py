"""Stages that a page shows: a scene at one instant, how it goes on, and what its taxels read.

Shapes: `env` environments, `step` control steps, `actuator` actuators, `contact` contacts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.files.arrays import read_arrays
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.observations.observations import HAND_ONLY
from tgdsl.runtime.connect import simulate
from tgdsl.runtime.rollout import substeps_of
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.state_values import INTEGRATED
from tgdsl.scene.scene import scene_model
from tgdsl.view.overview import drawn_outputs

Array = np.ndarray
Poses = tuple[Float[Array, "body 3"], Float[Array, "body 4"]]


class Slider(NamedTuple):
    """A number that a user may set."""

    name: str
    low: float
    high: float


class Observed(NamedTuple):
    """Adjacent features of one kind in a group of observations."""

    name: str
    unit: str
    values: Float[Array, " feature"]


class Contacts(NamedTuple):
    """Contacts of one environment in the world."""

    pos: Float[Array, "contact 3"]  # [m]
    bodies: Int[Array, "contact 2"]  # the two bodies of each; -1 for a flex
    force: Float[Array, "contact 3"] | None  # on the second body [N]; None where it is unknown

    def forces_on(self, bodies: frozenset[int]) -> Float[Array, "contact 3"]:
        """Return the forces [N], each on that one of its two bodies that is among `bodies`, or else on the second."""
        assert self.force is not None
        is_in = np.isin(self.bodies, list(bodies))
        return np.where((is_in[:, 0] & ~is_in[:, 1])[:, None], -self.force, self.force)


class Stage(ABC):
    """A scene at one instant."""

    touch: TactileModule  # the module whose taxels are shown
    model: mujoco.MjModel  # the compiled scene
    num_envs: int
    control_step: float  # duration of one step [s]
    time: float  # the instant [s]
    readings: Mapping[str, Tensor]  # what the taxels read then
    # values that a user may set, one for each of `sliders`; None where something else acts
    control: Float[Array, " actuator"] | None = None
    by_hand: bool | None = None  # whether `control` replaces the policy; None: there is no policy
    groups: Sequence[str] = ()  # names of the groups of observations
    is_gapless = True  # whether `advance` makes each control step, so that sounds are joined
    num_steps: int | None = None  # number of instants of a recorded run; None: the scene goes on without end
    step_index: int  # which instant of a recorded run this is

    @abstractmethod
    def advance(self) -> None:
        """Go on by one control step; at the end of a recorded run, stay."""

    @abstractmethod
    def restart(self) -> None:
        """Begin again."""

    @abstractmethod
    def body_poses(self, env: int) -> Poses:
        """Return origins [m] and quaternions w, x, y, z of all bodies in one environment, in the world."""

    def seek(self, step: int) -> None:
        """Go to an instant of a recorded run, or to its first or last one."""
        raise NotImplementedError(f"{type(self).__name__} is not recorded")

    @property
    def outputs(self) -> Sequence[Output]:
        """Readings that a page can draw: of taxels, of bodies, and of boxes of links."""
        return drawn_outputs(self.touch)

    def notes(self, env: int) -> Mapping[str, float | str]:
        """Return what else there is to say of this instant in one environment, by name, such as a task's reward terms."""
        return {}

    @property
    def sliders(self) -> Sequence[Slider]:
        """What `control` sets: the actuators."""
        ranges = zip(self.model.actuator_ctrlrange.tolist(), self.model.actuator_ctrllimited, strict=True)
        names = (self.model.actuator(i).name or f"actuator {i}" for i in range(self.model.nu))
        return [
            Slider(name, *(ends if is_limited else (-1.0, 1.0))) for name, (ends, is_limited) in zip(names, ranges, strict=True)
        ]

    def acted(self, env: int) -> Float[Array, " actuator"] | None:
        """Return what a policy has set the sliders to in one environment; None: nothing has acted yet."""
        return None

    def observed(self, group: str, env: int) -> Sequence[Observed]:
        """Return what one environment observes in one of `groups`."""
        return ()

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment, its objects as they are there."""
        return self.model

    def contacts(self, env: int) -> Contacts | None:
        """Return the contacts of one environment; None where they are unknown."""
        state = self.state(env)
        return None if state is None else simulated_contacts(self.env_model(env), state)

    def state(self, env: int) -> Mapping[str, Array] | None:
        """Return the arrays that MuJoCo integrates in one environment, by their names; None if it is not simulated."""
        return None

    def close(self) -> None:  # noqa: B027
        """Release the simulator; of a recorded run, nothing."""


class RecordedStage(Stage):
    """A stage with `num_steps` instants; `seek` sets `step_index`."""

    def advance(self) -> None:
        self.seek(self.step_index + 1)

    def restart(self) -> None:
        self.seek(0)


class SimStage(Stage):
    """A simulation that its user steps and resets; `update` says what the module has read."""

    def __init__(self, touch: TactileModule, sim: Simulation):
        self.touch, self.sim, self.model = touch, sim, sim.model
        self.num_envs, self.control_step = sim.num_envs, sim.control_step
        self.time = 0.0
        self.readings: Mapping[str, Tensor] = {}

    def update(self, readings: Mapping[str, Tensor]) -> None:
        """Take the readings of the simulator's instant."""
        self.readings = readings
        self.time += self.control_step

    def advance(self) -> None:
        pass

    def restart(self) -> None:
        pass

    def body_poses(self, env: int) -> Poses:
        return self.sim.body_poses(env)

    def env_model(self, env: int) -> mujoco.MjModel:
        return self.sim.env_model(env) if self.touch.inputs.objects else self.model

    def state(self, env: int) -> Mapping[str, Array]:
        return {name: self.sim.arrays[name][env].detach().cpu().numpy().copy() for name in INTEGRATED}


class SceneStage(SimStage):
    """A document's scene in MuJoCo, whose actuators follow `control`: at first the keyframe's that has the initial pose."""

    def __init__(self, touch: TactileModule, num_envs: int = 1):
        super().__init__(touch, simulate(touch, num_envs, substeps=substeps_of(touch, 5), on_fault="reset"))
        hand_only = {term.group for term in touch.plan.observations if term.type in HAND_ONLY}
        self.groups = () if hand_only else tuple(touch.observations)
        self._begin()

    def advance(self) -> None:
        self.sim.step(self.control)
        self.update(self.touch(self.sim.state()))

    def restart(self) -> None:
        self.sim.reset()
        self._begin()

    def observed(self, group: str, env: int) -> Sequence[Observed]:
        features = self.touch.observe(self.readings)[group][env].cpu().numpy()
        units = {output.name: output.units[0] for output in self.touch.outputs}
        return [Observed(term.name, units.get(term.name, ""), features[term.slice]) for term in self.touch.observations[group]]

    def close(self) -> None:
        self.sim.close()

    def _begin(self) -> None:
        keys = (i for i in range(self.model.nkey) if np.array_equal(self.model.key_qpos[i], self.model.qpos0))
        key = next(keys, None)
        self.control = np.zeros(self.model.nu) if key is None else self.model.key_ctrl[key].copy()
        self.time, self.readings = 0.0, self.touch(self.sim.state())


class RunStage(RecordedStage):
    """A run that `tgdsl run` recorded, instant by instant."""

    def __init__(self, touch: TactileModule, path: Path):
        """Read a run; raise `SimulationError` if the file holds no positions, or is of another scene or other sensors."""
        self.touch, self.model = touch, scene_model(touch.plan.scene)
        arrays = read_run(path)
        self._qpos, self._times = arrays["qpos"], arrays["time"]
        names = [output.name for output in touch.outputs]
        missing = [name for name in names if name not in arrays]
        if missing or self._qpos.shape[-1] != self.model.nq:
            has = f'has no reading "{missing[0]}"' if missing else f"has {self._qpos.shape[-1]} numbers in `qpos`"
            raise SimulationError(f"{path}: the run {has}, and the scene has {self.model.nq}: was the document changed since?")
        self._readings = {name: arrays[name] for name in names}
        self.num_steps, self.num_envs = self._qpos.shape[:2]
        self.control_step = float(self._times[0])
        self._data = mujoco.MjData(self.model)
        self.seek(0)

    def seek(self, step: int) -> None:
        self.step_index = i = int(np.clip(step, 0, len(self._times) - 1))
        self.time = float(self._times[i])
        self.readings = {name: torch.from_numpy(values[i]) for name, values in self._readings.items()}

    def body_poses(self, env: int) -> Poses:
        self._data.qpos[:] = self._qpos[self.step_index, env]
        return kinematic_poses(self.model, self._data)

    def contacts(self, env: int) -> Contacts:
        """Return where bodies are in contact; runs do not record the forces."""
        self.body_poses(env)
        mujoco.mj_collision(self.model, self._data)
        return contacts_of(self.model, self._data, with_force=False)


def simulated_contacts(model: mujoco.MjModel, state: Mapping[str, Array]) -> Contacts:
    """Return the contacts of a state, by MuJoCo's forward dynamics on the CPU."""
    data = mujoco.MjData(model)
    for name, value in state.items():
        if name == "time":
            data.time = float(value)
        else:
            getattr(data, name)[...] = value
    mujoco.mj_forward(model, data)
    return contacts_of(model, data)


def contacts_of(model: mujoco.MjModel, data: mujoco.MjData, with_force: bool = True) -> Contacts:
    """Return the contacts of a state for which MuJoCo makes constraints."""
    active = [i for i in range(data.ncon) if not data.contact[i].exclude]
    geoms = data.contact.geom[active].reshape(-1, 2)
    bodies = np.where(geoms < 0, -1, model.geom_bodyid[geoms])
    force, local = np.zeros((len(active), 3)), np.zeros(6)
    for row, i in enumerate(active if with_force else ()):
        mujoco.mj_contactForce(model, data, i, local)
        force[row] = local[:3] @ data.contact.frame[i].reshape(3, 3)
    return Contacts(data.contact.pos[active].reshape(-1, 3), bodies, force if with_force else None)


def kinematic_poses(model: mujoco.MjModel, data: mujoco.MjData) -> Poses:
    """Return origins [m] and quaternions w, x, y, z of all bodies in the world at `data.qpos`."""
    mujoco.mj_kinematics(model, data)
    return data.xpos.copy(), data.xquat.copy()


def read_run(path: Path) -> dict[str, Any]:
    """Return the arrays of a run that `tgdsl run` recorded; raise `SimulationError` if it is none."""
    arrays = read_arrays(path, "a run, as `tgdsl run` writes it", SimulationError)
    if missing := [name for name in ("time", "qpos", "document") if name not in arrays]:
        raise SimulationError(f"{path}: expected a run, as `tgdsl run` writes it; it has no `{missing[0]}`")
    return arrays
