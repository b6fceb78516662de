"""Stored grasps: in a file, or in the user's cache under a hash of scene and settings.

Shapes: `grasp` grasps, `nq` and `nu` as in MuJoCo's model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field, StrictInt
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.fields.models import Angle, PositiveLength, Quantity, Range, RangeOf, SpecModel
from tgdsl.files.arrays import read_arrays
from tgdsl.files.cache import digest
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.rl.actuation import ZERO
from tgdsl.rl.draws import Draws
from tgdsl.rl.spec import TaskSpec, Time, Whole
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.state_values import FIELDS, StateValues

NonNegativeAngle = Annotated[float, Quantity("angle", ge=0.0)]
NonNegativeForce = Annotated[float, Quantity("force", ge=0.0)]


class GraspSpec(SpecModel):
    """Sampling and acceptance of grasps: see `tgdsl.rl.grasps.sampling`."""

    closed: str = "closed"
    """The scene's keyframe with the controls of the closed hand; the policy's joints start near the task's keyframe."""
    file: str | None = None
    """A file that `tgdsl grasps --out` wrote, relative to this document; default: the user's cache, sampled if it has none."""
    num: Whole = 512
    """Number of grasps, divided equally among the object's variants."""
    seed: Annotated[StrictInt, Field(ge=0)] = 0
    """Seed of all random numbers."""
    spread: NonNegativeAngle = 0.2
    """Largest offset of joints from the keyframe at the start, and of their targets from the closed hand's controls [rad];
    at most a quarter of a joint's range."""
    squeeze: Annotated[Range, RangeOf("angle", gt=0.0)] = (0.05, 0.2)
    """Largest lead of a joint's target over its position: the pressing torque over the servo's gain [rad]."""
    yaw: Annotated[Range, RangeOf("angle")] = ZERO
    """Rotation of the object about the vertical; it needs a free or ball joint [rad]."""
    offset: Annotated[Range, RangeOf("length")] = ZERO
    """Offset of the object along each of the world's axes; it needs a free joint [m]."""
    close: Time = 0.8
    """Time in which the hand closes while the object is fixed [s]."""
    settle: Time = 0.6
    """Time from the release of the object to the grasp [s]."""
    hold: Time = 1.2
    """Time of the pushes that test the grasp [s]."""
    push: NonNegativeForce = 1.0
    """Force of the pushes, each in a random direction and for a quarter of `hold` [N]."""
    max_tilt: Angle = 0.1
    """Largest tilt of the object from its fixed pose [rad]."""
    max_shift: PositiveLength = 0.01
    """Largest distance of the object from its fixed pose [m]."""
    min_links: Whole = 2
    """Least number of links that press with `min_force`."""
    min_force: Annotated[float, Quantity("force", gt=0.0)] = 0.1
    """Least force of a pressing link [N]."""
    opposite: Angle = 2.0
    """Least angle between two such forces, so that links press from opposite sides [rad]."""


def grasp_spec(spec: TaskSpec) -> GraspSpec | None:
    """Return the settings of a task's grasps; None if its episodes do not begin with grasps."""
    result = getattr(spec, "grasps", None)
    return result if isinstance(result, GraspSpec) else None


FORMAT = "tgdsl grasps 1"


@dataclass(frozen=True, eq=False)
class Grasps:
    """Grasps of an object, at rest."""

    qpos: Float[np.ndarray, "grasp nq"]  # positions of all joints
    ctrl: Float[np.ndarray, "grasp nu"]  # controls of all actuators, with which the hand presses
    variant: Int[np.ndarray, " grasp"]  # variant of each one's object
    scene: str  # digest of the scene: see `tgdsl.scene.digest`
    object: str  # the document's name of the object
    settings: str  # settings of the sampling, as JSON

    def __len__(self) -> int:
        return len(self.qpos)

    def packed(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file of grasps, by name."""
        words = {"format": FORMAT, "scene": self.scene, "object": self.object, "settings": self.settings}
        arrays = {"qpos": self.qpos, "ctrl": self.ctrl, "variant": self.variant}
        return {name: np.array(word) for name, word in words.items()} | arrays

    @classmethod
    def unpacked(cls, arrays: Mapping[str, np.ndarray]) -> Grasps:
        """Return grasps from the arrays of `packed`."""
        if str(arrays["format"]) != FORMAT:
            raise ValueError(f"format {arrays['format']}")
        return cls(
            arrays["qpos"], arrays["ctrl"], arrays["variant"], *(str(arrays[name]) for name in ("scene", "object", "settings"))
        )


def settings_of(spec: TaskSpec, joints: tuple[str, ...]) -> str:
    """Return all settings that affect grasps, without the scene, as JSON."""
    grasps = grasp_spec(spec)
    assert grasps is not None
    physics = {"options": spec.physics.options, "substeps": spec.physics.substeps}
    settings = {"grasps": grasps.model_dump(mode="json", exclude={"file"}), "physics": physics}
    return json.dumps(settings | {"object": spec.object, "joints": joints, "keyframe": spec.keyframe}, sort_keys=True)


def cache_key(scene: str, settings: str) -> str:
    """Return the name of the cache's file of grasps."""
    return digest(FORMAT.encode(), [np.array([scene, settings])])


def write_grasps(grasps: Grasps, file: Path) -> None:
    """Write grasps to a file; an existing one is replaced."""
    with atomic_open(with_folder(file)) as out:
        np.savez(out, allow_pickle=False, **grasps.packed())


def read_grasps(file: Path, scene: str, object: str) -> Grasps:
    """Read grasps of an object in a scene from a file."""
    arrays = read_arrays(file, expected := "a file that `tgdsl grasps --out` wrote", SimulationError)
    try:
        grasps = Grasps.unpacked(arrays)
    except (ValueError, KeyError) as error:
        raise SimulationError(f"{file}: expected {expected}: {error}") from error
    if grasps.object != object:
        raise SimulationError(f'{file}: grasps of the object "{grasps.object}", expected "{object}"')
    if grasps.scene != scene:
        problem = f"grasps of another scene ({grasps.scene[:12]}, expected {scene[:12]})"
        raise SimulationError(f"{file}: {problem}: robot, scene or object have changed; sample them again with `tgdsl grasps`")
    return grasps


class Drawn(NamedTuple):
    """A grasp of each environment: MuJoCo's `qpos` and `ctrl`, contact fields of a state, and the object's orientation."""

    values: StateValues
    contacts: dict[str, Tensor]
    quat: Float[Tensor, "env 4"]


class GraspTable:
    """Grasps for environments, ordered by variant: each environment draws from its variant's."""

    qpos: Float[Tensor, "grasp nq"]
    ctrl: Float[Tensor, "grasp nu"]  # controls of all actuators, with which the hand presses
    contacts: dict[str, Tensor]  # contact and force fields of a state that the module reads, by name, (grasp, …)
    quat: Float[Tensor, "grasp 4"]  # orientation of the object's body in each, in the world: w, x, y, z
    first: Int[Tensor, " env"]  # the first grasp of each environment's variant
    count: Int[Tensor, " env"]  # number of that variant's grasps

    def __init__(self, grasps: Grasps, sim: Simulation, body: str, variant: Int[Tensor, " env"], draws: Draws):
        """Evaluate the contacts of all grasps in the simulation, which the caller must reset afterwards.

        Objects must be the ones of the sampling, before masses and friction are randomised.
        """
        shape = (sim.model.nq, sim.model.nu)
        sizes = (grasps.qpos.shape[1], grasps.ctrl.shape[1])
        if sizes != shape:
            raise SimulationError(f"grasps of {sizes[0]} positions and {sizes[1]} controls, expected {shape[0]} and {shape[1]}")
        variants = variant.cpu().numpy()
        if lacking := sorted({*variants.tolist()} - {*grasps.variant.tolist()}):
            problem = f"there are no grasps of variant {listed([str(v) for v in lacking])} of {grasps.object}"
            raise SimulationError(f"{problem}; sample as many as it has variants, or more")
        order = np.argsort(grasps.variant, kind="stable")
        variants_in_order = grasps.variant[order]
        device, dtype = sim.qpos.device, sim.qpos.dtype
        self.qpos = torch.from_numpy(grasps.qpos[order]).to(device, dtype)
        self.ctrl = torch.from_numpy(grasps.ctrl[order]).to(device, dtype)
        self.first = torch.from_numpy(np.searchsorted(variants_in_order, variants)).to(device)
        self.count = torch.from_numpy(np.searchsorted(variants_in_order, variants, side="right")).to(device) - self.first
        self._draws = draws
        self.contacts = self._evaluated(sim, body, variants)
        self.quat = self.contacts.pop("quat")

    def draw(self, episode: Int[Tensor, " env"]) -> Drawn:
        """Return a grasp of each environment, drawn by its count of episodes."""
        share = self._draws.uniform("grasp", episode, 1)[:, 0]
        index = self.first + torch.minimum((share * self.count).to(torch.int64), self.count - 1)
        contacts = {name: value[index] for name, value in self.contacts.items()}
        return Drawn({"qpos": self.qpos[index], "ctrl": self.ctrl[index]}, contacts, self.quat[index])

    def _evaluated(self, sim: Simulation, body: str, variants: Int[np.ndarray, " env"]) -> dict[str, Tensor]:
        """Return the contact fields and the object's orientation in each grasp; zeros for variants without an environment."""
        rank, num = np.zeros_like(variants), np.zeros_like(variants)
        for v in np.unique(variants):
            rank[variants == v], num[variants == v] = np.arange((variants == v).sum()), (variants == v).sum()
        result: dict[str, Tensor] = {}
        device = self.qpos.device
        step, place = torch.from_numpy(num).to(device), torch.from_numpy(rank).to(device)
        for i in range(int((self.count / step).ceil().max())):
            index = self.first + torch.minimum(place + i * step, self.count - 1)
            sim.reset(contacts="evaluate", qpos=self.qpos[index], ctrl=self.ctrl[index])
            state, quat = sim.state(), sim.watched().body(body).quat
            each = {name: getattr(state, name) for name in FIELDS} | {"quat": quat}
            for name, value in each.items():
                if value is not None:
                    empty = torch.zeros((len(self.qpos), *value.shape[1:]), dtype=value.dtype, device=device)
                    result.setdefault(name, empty)[index] = value.to(device)
        return result
