"""Parts of observation groups that tasks share, each with its numbers and their description.

Source: Chung et al., *Tactile Genesis*, appendix, "Observation groups".

Shapes: `env` environments, `feature` numbers of a group.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.rl.draws import Draws
from tgdsl.rl.rotations import Quat, between, inverse, product, six_numbers
from tgdsl.rl.spec import ProprioSpec
from tgdsl.rl.task import Features, HandNow, Now, Part, Setup
from tgdsl.runtime.xhand1.source import TIME_CONSTANT_S
from tgdsl.tensors.env_ids import put_rows

GoalPart = Literal["orientation", "difference", "angle"]  # parts of an observed goal, an orientation


class MeasuredVelocity:
    """Joint velocities [rad/s] as an XHand1's driver has them: `tgdsl.runtime.xhand1.source.VelocityFilter`, batched."""

    def __init__(self, joint_pos: Float[Tensor, "env joint"], control_step: float):
        self._before, self.value = joint_pos.clone(), torch.zeros_like(joint_pos)
        self._control_step = control_step
        self._share = -math.expm1(-control_step / TIME_CONSTANT_S)
        self.memory = {"before": self._before, "value": self.value}  # live tensors

    def update(self, joint_pos: Float[Tensor, "env joint"]) -> None:
        """Take the positions of the next control step [rad]."""
        self.value += self._share * ((joint_pos - self._before) / self._control_step - self.value)
        self._before.copy_(joint_pos)

    def begin(self, chosen: Bool[Tensor, " env"], joint_pos: Float[Tensor, "env joint"]) -> None:
        """Begin again at rest in some environments."""
        put_rows(self.value, chosen, 0.0)
        put_rows(self._before, chosen, joint_pos)


def proprio(now: Now | HandNow, vel_scale: float = 1.0) -> Float[Tensor, "env feature"]:
    """Return positions [rad], velocities [rad/s] times a factor, and last action of the joints that the policy moves."""
    return torch.cat([now.joint_pos, vel_scale * now.joint_vel, now.action], dim=1)


def noisy_proprio(now: Now, spec: ProprioSpec, draws: Draws, count: Int[Tensor, " env"]) -> Float[Tensor, "env feature"]:
    """Return `proprio` with noise; `count` is another number at each control step of an environment."""
    if spec.pos_noise or spec.vel_noise:
        pos, vel = draws.normal("proprio", count, 2 * now.joint_pos.shape[1]).to(now.joint_pos).chunk(2, dim=1)
        now = replace(now, joint_pos=now.joint_pos + spec.pos_noise * pos, joint_vel=now.joint_vel + spec.vel_noise * vel)
    return proprio(now, spec.vel_scale)


def priv_proprio(now: Now) -> Float[Tensor, "env feature"]:
    """Return exact `proprio` and the object's force on each link, in the link's frame [N], link by link."""
    return torch.cat([proprio(now), now.link_force.flatten(1)], dim=1)


def goal(parts: Sequence[GoalPart], body: str, wanted: Callable[[], Quat]) -> Part:
    """Return parts of a goal, the orientation `wanted` of an object: see `PlacedTaskSpec.goal`."""
    features = {
        "orientation": _orientation("goal", body),
        "difference": _orientation("goal_from_object", body),
        "angle": [Features("angle_to_goal", 1, "rad", "", body)],
    }

    def observe(now: Now) -> Float[Tensor, "env feature"]:
        goal_quat, quat = wanted(), now.object.quat
        values = {
            "orientation": lambda: six_numbers(goal_quat),
            "difference": lambda: six_numbers(product(goal_quat, inverse(quat))),
            "angle": lambda: between(goal_quat, quat)[:, None],
        }
        return torch.cat([values[part]() for part in parts], dim=1)

    return Part(observe, [each for part in parts for each in features[part]])


def object_state(setup: Setup) -> Part:
    """Return the object's position [m], six numbers of its orientation, velocity [m/s] and angular velocity [rad/s]."""
    body, vectors = setup.object, (("position", "m"), ("velocity", "m/s"), ("angular_velocity", "rad/s"))
    position, *velocities = (vector(name, unit, body) for name, unit in vectors)
    return Part(object_motion, [position, *_orientation("orientation", body), *velocities])


def object_props(setup: Setup) -> Part:
    """Return the object's friction and mass [kg]."""
    features = [Features("friction", 1, "1", "", setup.object), Features("mass", 1, "kg", "", setup.object)]
    return Part(lambda now: torch.stack([now.friction, now.mass], dim=1), features)


def distances(setup: Setup) -> Part:
    """Return the distance from each probe to the object's surface, less than 0 inside [m]."""
    sensor, table = setup.rows["surface_distance"]
    links = table["link"].tolist()
    runs = runs_of(links, range(len(links)))
    return Part(
        lambda now: now.distance, [Features("distance", len(rows), "m", "", link, 1.0, rows, sensor) for link, rows in runs]
    )


def link_forces(links: Sequence[str]) -> list[Features]:
    """Describe the object's force on each link."""
    return [vector("force", "N", link, "link") for link in links]


def vector(name: str, unit: str, link: str = "", frame: str = "world") -> Features:
    """Describe the components of a vector."""
    return Features(", ".join(f"{name}_{axis}" for axis in "xyz"), 3, unit, frame, link)


def runs_of(links: Sequence[str], rows: Sequence[int]) -> list[tuple[str, range]]:
    """Return rows that follow one another and are of one link."""
    runs: list[tuple[str, range]] = []
    for row in rows:
        if runs and runs[-1][0] == links[row] and runs[-1][1].stop == row:
            runs[-1] = (links[row], range(runs[-1][1].start, row + 1))
        else:
            runs.append((links[row], range(row, row + 1)))
    return runs


def object_motion(now: Now) -> Float[Tensor, "env feature"]:
    """Return position [m], six numbers of the orientation, velocity [m/s] and angular velocity [rad/s] of the object."""
    body = now.object
    return torch.cat([body.pos, six_numbers(body.quat), body.linvel, body.angvel], dim=1)


def _orientation(name: str, body: str) -> list[Features]:
    """Describe the first two columns of a rotation's matrix: the turned x axis, then the turned y axis."""
    parts = ", ".join(f"{name}_{part}" for part in ("xx", "xy", "xz", "yx", "yy", "yz"))
    return [Features(parts, 6, "1", "world", body)]
