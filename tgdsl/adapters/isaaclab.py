"""Touch as a sensor of Isaac Lab on its Newton backend, as a `TactileSensorCfg` in a scene's configuration.

It follows the contract of `SensorBase` in Isaac Lab 3: masks of environments, and data evaluated on access.
"""

# pyright: reportMissingImports=false, reportGeneralTypeIssues=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, field
from typing import Any

import warp as wp
from isaaclab.sensors import SensorBase, SensorBaseCfg
from isaaclab.utils import configclass
from isaaclab_newton.physics import NewtonManager
from torch import Tensor

from tgdsl.adapters.newton import SensorTactile


class TactileSensor(SensorBase):
    """The readings of all environments by name, `data`, at the instant of Newton's state.

    Sensors advance when they are first asked for after a step; with an `update_period`, when that has passed. An environment
    that is reset is read again, alone, and has no contacts until the next step.
    """

    tactile: SensorTactile  # the sensor of Newton's that is read; `tactile.touch` is the module

    @property
    def data(self) -> dict[str, Tensor]:
        """Readings by name, as `tactile.touch.outputs` lists them."""
        self._update_outdated_buffers()
        return self.tactile.readings

    def observation(self, group: str = "policy") -> Tensor:
        """Return an observation group of the document, (env, feature)."""
        return self.tactile.touch.observe(self.data)[group]

    def reset(self, env_ids: Sequence[int] | Tensor | None = None, env_mask: Any = None) -> None:
        """Begin a new episode in some environments (default: all)."""
        super().reset(env_ids, env_mask)
        self.tactile.reset(env_ids if env_mask is None else wp.to_torch(env_mask))

    def update(self, dt: float, force_recompute: bool = False) -> None:
        """Take note of a physics step of some duration [s]."""
        if self.is_initialized:
            self._elapsed = dt if self._is_read else self._elapsed + dt
            self._is_read, self._all_are_due = False, self._all_are_due or self.cfg.update_period == 0
            self.tactile.is_new.zero_()
        super().update(dt, force_recompute)

    def _initialize_impl(self) -> None:
        super()._initialize_impl()
        cfg, model = self.cfg, NewtonManager.get_model()
        self.tactile = SensorTactile(model, cfg.document, prefix=cfg.prefix, names=cfg.names)
        self._elapsed, self._is_read, self._all_are_due = 0.0, False, True
        if self.tactile.solver_observable_kinds:
            NewtonManager.add_contact_sensor(
                body_names_expr=cfg.prim_path
            )  # the backend then reports contacts and their forces

    def _update_buffers_impl(self, env_mask: Any) -> None:
        worlds = None if self._all_are_due else wp.to_torch(env_mask)
        dt = self._elapsed or self.tactile.touch.inputs.dt or self._sim_physics_dt
        self.tactile.update(NewtonManager.get_state_0(), NewtonManager.get_contacts(), worlds=worlds, dt=dt)
        self._is_read, self._all_are_due = True, False


@configclass
class TactileSensorCfg(SensorBaseCfg):
    """A document's sensors in a scene."""

    class_type: type = TactileSensor
    document: Any = MISSING  # the document, or an artefact (`.safetensors`)
    prefix: str = ""  # stands before all names among Newton's labels; needed only where several labels end alike
    names: dict[str, str] = field(default_factory=dict)  # labels by the names in the document, where they differ otherwise
