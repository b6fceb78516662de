"""Grasps as they are kept: in a file, or in the user's cache under a hash of all that they follow from.

Shapes: `grasp` grasps, `nq` and `nu` as in MuJoCo's model.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import SimulationError
from tgdsl.files.cache import digest
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.rl.grasps.spec import grasp_spec
from tgdsl.rl.spec import TaskSpec

FORMAT = "tgdsl grasps 1"


@dataclass(frozen=True, eq=False)
class Grasps:
    """Grasps of an object, at rest.

    Attributes:
        qpos: Positions of all joints.
        ctrl: Controls of all actuators, with which the hand presses.
        variant: Which of the object's variants each holds.
        scene: Digest of the scene: see `tgdsl.scene.digest`.
        object: The document's name of the object.
        settings: How they were sampled, as JSON.
    """

    qpos: Float[np.ndarray, "grasp nq"]
    ctrl: Float[np.ndarray, "grasp nu"]
    variant: Int[np.ndarray, " grasp"]
    scene: str
    object: str
    settings: str

    def __len__(self) -> int:
        return len(self.qpos)

    def packed(self) -> dict[str, np.ndarray]:
        """Return them as arrays."""
        words = {"format": FORMAT, "scene": self.scene, "object": self.object, "settings": self.settings}
        arrays = {"qpos": self.qpos, "ctrl": self.ctrl, "variant": self.variant}
        return {name: np.array(word) for name, word in words.items()} | arrays

    @classmethod
    def unpacked(cls, arrays: Mapping[str, np.ndarray]) -> Grasps:
        """Return what `packed` has made arrays of.

        Raises:
            KeyError, ValueError: If they are none.
        """
        if str(arrays["format"]) != FORMAT:
            raise ValueError(f"format {arrays['format']}")
        qpos, ctrl, variant = arrays["qpos"], arrays["ctrl"], arrays["variant"]
        is_whole = qpos.ndim == ctrl.ndim == 2 and variant.shape == (len(qpos),) == (len(ctrl),) and len(qpos)
        if not is_whole or variant.dtype.kind != "i" or not all(np.isfinite(part).all() for part in (qpos, ctrl)):
            raise ValueError("arrays that do not fit together")
        words = (str(arrays[name]) for name in ("scene", "object", "settings"))
        return cls(qpos, ctrl, variant, *words)


def settings_of(spec: TaskSpec, joints: tuple[str, ...]) -> str:
    """Return all that grasps follow from besides the scene, as JSON."""
    grasps = grasp_spec(spec)
    assert grasps is not None
    physics = {"options": spec.physics.options, "substeps": spec.physics.substeps}
    settings = {"grasps": grasps.model_dump(mode="json", exclude={"file"}), "physics": physics}
    return json.dumps(settings | {"object": spec.object, "joints": joints, "keyframe": spec.keyframe}, sort_keys=True)


def cache_key(scene: str, settings: str) -> str:
    """Return the name of the cache's file of grasps."""
    return digest(FORMAT.encode(), [np.array([scene, settings])])


def write_grasps(grasps: Grasps, file: Path) -> None:
    """Write grasps to a file; one that is there is replaced.

    Raises:
        FileError: If it cannot be written.
    """
    with atomic_open(with_folder(file)) as out:
        np.savez(out, allow_pickle=False, **grasps.packed())


def read_grasps(file: Path, scene: str, object: str) -> Grasps:
    """Read grasps of an object in a scene from a file.

    Raises:
        SimulationError: If it cannot be read, or holds something else.
    """
    try:
        with file.open("rb") as raw, np.load(raw, allow_pickle=False) as archive:
            grasps = Grasps.unpacked(archive)
    except OSError as error:
        raise SimulationError(f"{file}: cannot read this file: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise SimulationError(f"{file}: no grasps, expected a file that `tgdsl grasps --out` wrote: {error}") from error
    if grasps.object != object:
        raise SimulationError(f'{file}: grasps of the object "{grasps.object}", expected "{object}"')
    if grasps.scene != scene:
        problem = f"grasps of another scene ({grasps.scene[:12]}, expected {scene[:12]})"
        raise SimulationError(f"{file}: {problem}: robot, scene or object have changed; sample them again with `tgdsl grasps`")
    return grasps
