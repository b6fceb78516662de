"""Touch as a sensor of mjlab's scenes: `SceneCfg(sensors=(TouchSensorCfg(name="touch", document="hand.yaml"),))`.

Shapes: `env` environments, `row` and `channel` as the module's `outputs` list them.
"""

# pyright: reportMissingImports=false, reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from mjlab.sensor import Sensor, SensorCfg
from torch import Tensor

from tgdsl.adapters import Document, module_of
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.module.calls import Graphed
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.runtime.read import read_warp


@dataclass
class TouchSensorCfg(SensorCfg):
    """A module's readings as a sensor of a scene, `env.scene[name]`."""

    document: Document = field(kw_only=True)  # or an artefact (`.safetensors`)
    prefix: str = ""  # before all names in mjlab's scene, such as "robot/"; needed only where several names end alike
    names: Mapping[str, str] = field(default_factory=dict)  # in mjlab's scene by those in the document, where they differ
    # returns the scene that the document is of, robot and objects under its names; default: what it names itself
    scene_fn: Callable[[], mujoco.MjSpec] | None = None
    graph: bool = True  # on a GPU: compile the module, and replay it with the reading of the scene as one CUDA graph

    def build(self) -> TouchSensor:
        """Compile the document, or load the artefact."""
        return TouchSensor(self, module_of(self.document, "mjlab", self.scene_fn and self.scene_fn()))


class TouchSensor(Sensor):
    """The readings of all environments by name, `data`, of the module `touch`.

    They advance once a control step, whatever asks first, and are of the instant that mjlab's derived arrays then have: for
    observations of now, for rewards a physics step earlier. An environment that is reset is read again. On a GPU the tensors
    are the same ones at each step.
    """

    data: Mapping[str, Float[Tensor, "env *step row channel"]]

    def __init__(self, cfg: TouchSensorCfg, touch: TactileModule):
        super().__init__()
        self.touch, self._cfg, self._elapsed = touch, cfg, 0.0
        self._due: Bool[Tensor, " env"] | None = None  # environments to read; None: all
        self._observed: dict[str, Tensor] = {}  # observation groups of the readings
        self._graphed, self._dt, self._has_run = Graphed(lambda *_: self._read()), 0.0, False

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: Mapping[str, Any]) -> None:
        """Leave the scene as it is: contacts are read without sensors."""

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Look up the document's names in the compiled scene."""
        self.touch.to(device)
        inputs = self.touch.inputs.renamed(self._cfg.names, prefix=self._cfg.prefix)
        self._scene = (mj_model, model.struct, data.struct, inputs)
        self._state()
        self._is_graphed = self._cfg.graph and self.touch.device.type == "cuda"
        if self._is_graphed:
            self.touch.compile()

    def reset(self, env_ids: Tensor | slice | None = None) -> None:
        """Begin a new episode in some environments (default: all)."""
        super().reset(env_ids)
        mask = torch.zeros(self._scene[2].nworld, dtype=torch.bool, device=self.touch.device)
        mask[slice(None) if env_ids is None else env_ids] = True
        self.touch.reset(mask)
        if self._due is not None:
            self._due |= mask

    def update(self, dt: float) -> None:
        """Take note of a physics step of some duration [s]."""
        super().update(dt)
        self._elapsed = dt if self._due is not None else self._elapsed + dt
        self._due = None

    def debug_vis(self, visualizer: Any) -> None:
        """Draw the taxels of all sensors: red where a reading is not zero, else grey."""
        state, readings, bodies, arm = self._state(), self.data, self.touch.inputs.bodies, np.zeros(3)
        pos, quat = (values.double().cpu().numpy() for values in (state.body_pos, state.body_quat))
        for env in visualizer.get_env_indices(len(pos)):
            for output in self.touch.outputs:
                if output.rows != "taxel" or len(output.shape) != 2:  # not stacked calls
                    continue
                active = (readings[output.name][env] != 0).any(dim=-1).tolist()
                for taxel, is_active in zip(self.touch.taxels[output.sensor], active, strict=True):
                    body = bodies.index(str(taxel["body"]))
                    mujoco.mju_rotVecQuat(arm, taxel["pos"].astype(float), quat[env, body])
                    color = (0.9, 0.1, 0.1, 1.0) if is_active else (0.5, 0.5, 0.5, 0.5)
                    visualizer.add_sphere(pos[env, body] + arm, float(taxel["radius"]) / 2, color)

    @property
    def observations(self) -> dict[str, Float[Tensor, "env feature"]]:
        """Observation groups of the document by name, of the readings in `data`."""
        _ = self.data
        return self._observed

    def _compute_data(self) -> dict[str, Tensor]:
        num_envs, touch = self._scene[2].nworld, self.touch
        dt = self._elapsed or touch.inputs.dt or float(self._scene[0].opt.timestep)
        if dt != self._dt:
            self._dt = dt
            self._graphed.forget()
        is_replayed = self._due is None and self._is_graphed and self._has_run
        with torch.no_grad():
            memory = touch.memory.tensors(num_envs, dt, touch.dtype, touch.device) if is_replayed else {}
            result = self._graphed({}, memory) if is_replayed else self._read(self._due)
        self._observed = {name: result.pop(f"observed/{name}") for name in touch.observations}
        if is_replayed:
            touch.record_outputs(result)
        self._has_run, self._due = True, torch.zeros(num_envs, dtype=torch.bool, device=touch.device)
        return result

    def _read(self, mask: Bool[Tensor, " env"] | None = None) -> dict[str, Tensor]:
        """Return readings by name, and observation groups below `observed/`."""
        state = self._state()
        state.dt = self._dt
        readings = self.touch(state, mask=mask)
        groups = self.touch.observe(readings) if self.touch.observations else {}
        return readings | {f"observed/{name}": value for name, value in groups.items()}

    def _state(self) -> SceneState:
        mj_model, model, data, inputs = self._scene
        return read_warp(self.touch, mj_model, model, data, inputs=inputs)


def reading(env: Any, sensor: str, name: str) -> Float[Tensor, "env feature"]:
    """Return a reading, flattened: `ObservationTermCfg(func=reading, params={"sensor": "touch", "name": "tips"})`."""
    data = env.scene[sensor].data
    if name not in data:
        raise TgdslError(f'the sensor "{sensor}" has no reading "{name}"; {did_you_mean(name, data, "readings")}')
    return data[name].flatten(1)


def observation(env: Any, sensor: str, group: str = "policy") -> Float[Tensor, "env feature"]:
    """Return an observation group of the document: `ObservationTermCfg(func=observation, params={"sensor": "touch"})`."""
    touch = env.scene[sensor].touch
    if group not in touch.observations:
        raise TgdslError(f'the sensor "{sensor}" has no group "{group}"; {did_you_mean(group, touch.observations, "groups")}')
    return env.scene[sensor].observations[group]
