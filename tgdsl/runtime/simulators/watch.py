"""What a task reads in addition to touch: bodies, sites, joints and pairs by name, at the instant of the readings.

Shapes: `env` environments, `body`, `site`, `joint`, `actuator` and `pair` as a `Watch` lists them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.geometry.rotations import product, rotated
from tgdsl.module.state import SceneState
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.fields import StateReader
from tgdsl.runtime.simulators.model_ids import element_id

_BODY_FIELDS = ("body_pos", "body_quat", "body_linvel", "body_angvel")
_JOINT_FIELDS = ("joint_pos", "joint_vel", "joint_effort", "last_action")


@dataclass(frozen=True)
class Watch:
    """Names of elements whose motion and forces are read: see `SimOptions`."""

    bodies: tuple[str, ...] = ()  # for their poses and velocities
    sites: tuple[str, ...] = ()  # for their poses
    joints: tuple[str, ...] = ()  # hinges and slides, for positions, velocities and efforts
    actuators: tuple[str, ...] = ()  # for the controls that acted
    pairs: tuple[tuple[str, str], ...] = ()  # (link, object), for their whole force; a sensor of the module has to read it too


class BodyMotion(NamedTuple):
    """A body's frame in the world: position [m], quaternion w, x, y, z, velocity [m/s], angular velocity [rad/s]."""

    pos: Float[Tensor, "env 3"]
    quat: Float[Tensor, "env 4"]
    linvel: Float[Tensor, "env 3"]
    angvel: Float[Tensor, "env 3"]


@dataclass(frozen=True)
class Watched:
    """Values of the elements that a `Watch` names, at one instant, in world axes."""

    watch: Watch  # the names, in the order of the tensors
    body_pos: Float[Tensor, "env body 3"]  # position of each body's frame [m]
    body_quat: Float[Tensor, "env body 4"]  # orientation of each body, w, x, y, z
    body_linvel: Float[Tensor, "env body 3"]  # velocity of each body frame's origin [m/s]
    body_angvel: Float[Tensor, "env body 3"]  # angular velocity of each body [rad/s]
    site_pos: Float[Tensor, "env site 3"]  # position of each site [m]
    site_quat: Float[Tensor, "env site 4"]  # orientation of each site, w, x, y, z
    joint_pos: Float[Tensor, "env joint"]  # position of each joint [rad; slides: m]
    joint_vel: Float[Tensor, "env joint"]  # velocity of each joint [rad/s; slides: m/s]
    joint_effort: Float[Tensor, "env joint"]  # what the actuators exert on each joint [N·m; slides: N]
    last_action: Float[Tensor, "env actuator"]  # control of each actuator that acted, in its own unit
    pair_force: Float[Tensor, "env pair 3"]  # whole force of each pair's object on its link [N]

    def body(self, name: str) -> BodyMotion:
        """Return the motion of a body by name.

        Raises:
            SimulationError: If it is not watched.
        """
        bodies = self.watch.bodies
        if name not in bodies:
            raise SimulationError(f'the body "{name}" is not watched; {did_you_mean(name, bodies, "watched bodies")}')
        i = bodies.index(name)
        return BodyMotion(self.body_pos[:, i], self.body_quat[:, i], self.body_linvel[:, i], self.body_angvel[:, i])


class WatchReader:
    """Reads what a `Watch` names from a simulator's arrays."""

    def __init__(self, watch: Watch, inputs: Inputs, model: mujoco.MjModel, device: torch.device):
        sites = np.array([element_id(model, "site", name) for name in watch.sites], dtype=np.int64)
        of_sites = [_carrier(model, int(site)) for site in sites]
        bodies = tuple(dict.fromkeys((*watch.bodies, *of_sites)))
        fields = (*_BODY_FIELDS, *_JOINT_FIELDS)
        inputs_of_watch = Inputs(fields, bodies, (), {}, 0, joints=watch.joints, actuators=watch.actuators)
        self.reader, self._watch = StateReader(inputs_of_watch, model, device), watch
        self._carriers = torch.tensor([bodies.index(name) for name in of_sites], dtype=torch.int64, device=device)
        self._site_pos, self._site_quat = (torch.from_numpy(v[sites]).to(device) for v in (model.site_pos, model.site_quat))
        self._pairs = torch.tensor([_pair(inputs, pair) for pair in watch.pairs], dtype=torch.int64, device=device)

    @property
    def has_pairs(self) -> bool:
        return len(self._pairs) > 0

    def read(self, arrays: Mapping[str, Tensor]) -> SceneState:
        """Return bodies and joints, including the bodies that carry sites."""
        return SceneState(**self.reader.read(arrays))  # pyright: ignore[reportArgumentType]

    def watched(self, values: SceneState, state: SceneState | None) -> Watched:
        """Return the watched values, from the result of `read` and, for pairs, the module's state at that instant."""
        fields: dict[str, Tensor] = {name: getattr(values, name) for name in (*_BODY_FIELDS, *_JOINT_FIELDS)}
        pos, quat, num = fields["body_pos"], fields["body_quat"], len(self._watch.bodies)
        site_pos, site_quat = pos[:, :0], quat[:, :0]
        if self._watch.sites:
            carried = quat[:, self._carriers]
            site_pos, site_quat = (v.to(pos.dtype).expand(len(pos), -1, -1) for v in (self._site_pos, self._site_quat))
            site_pos = pos[:, self._carriers] + rotated(carried, site_pos)
            site_quat = product(carried, site_quat)
        force = pos.new_zeros((len(pos), 0, 3))
        if self.has_pairs:
            assert state is not None and state.contact_netforce is not None
            force = state.contact_netforce[:, self._pairs]
        fields |= {name: fields[name][:, :num] for name in _BODY_FIELDS}
        return Watched(self._watch, site_pos=site_pos, site_quat=site_quat, pair_force=force, **fields)


def _carrier(model: mujoco.MjModel, site: int) -> str:
    """Return the name of the body that a site is on."""
    name = model.body(int(model.site_bodyid[site])).name
    if not name:
        raise SimulationError(f'the site "{model.site(site).name}" is on a body without a name; name it in the scene')
    return name


def _pair(inputs: Inputs, wanted: tuple[str, str]) -> int:
    pairs = [(pair.link, pair.object) for pair in inputs.pairs]
    if "contact_netforce" not in inputs.fields or wanted not in pairs:
        problem = f"no sensor of this module reads the whole force of {wanted[1]} on {wanted[0]}"
        raise SimulationError(f"{problem}; add one of kind link_contact on {wanted[0]} that feels {wanted[1]}")
    return pairs.index(wanted)
