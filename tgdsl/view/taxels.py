"""Taxels in the world, and which of them a camera shows.

Shapes: `taxel` taxels of one sensor or layout, `body` bodies of the model.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from tgdsl.layout.layout import Layout
from tgdsl.view.raster import Camera, Fragments

Array = np.ndarray


class Pose(NamedTuple):
    """Bodies in the world at one instant: origins [m], and orientations as quaternions w, x, y, z."""

    pos: Float[Array, "body 3"]
    quat: Float[Array, "body 4"]


@runtime_checkable
class Posed(Protocol):
    """A model whose bodies are somewhere: a simulator's, or a recorded run's."""

    model: mujoco.MjModel  # the compiled scene

    def body_poses(self, env: int) -> tuple[Float[Array, "body 3"], Float[Array, "body 4"]]:
        """Return origins [m] and quaternions w, x, y, z of all bodies in one environment, in the world."""
        ...


@dataclass(frozen=True, eq=False)
class Taxels:
    """Taxels in the world."""

    pos: Float[Array, "taxel 3"]  # position in the world [m]
    normal: Float[Array, "taxel 3"]  # outward unit normal in the world
    size: Float[Array, " taxel"]  # width of the patch that the taxel stands for [m]; 0 marks an inactive filler


def taxels_of(model: mujoco.MjModel, pose: Pose, layout: Layout) -> Taxels:
    """Return a layout's taxels in the world."""
    bodies = [layout.links[i].body for i in layout.link_id]
    pos, normal = in_world(model, pose, bodies, layout.pos, layout.normal)
    return Taxels(pos, normal, np.sqrt(layout.area) * (layout.radius > 0))


def in_world(
    model: mujoco.MjModel, pose: Pose, bodies: Iterable[str], pos: Float[Array, "taxel 3"], normal: Float[Array, "taxel 3"]
) -> tuple[Float[Array, "taxel 3"], Float[Array, "taxel 3"]]:
    """Return positions and normals in the world of taxels given in the frames of their bodies, which go by name."""
    body = np.array([model.body(name).id for name in bodies], dtype=np.int64)
    rotation = Rotation.from_quat(pose.quat[body], scalar_first=True)
    return pose.pos[body] + rotation.apply(np.array(pos)), rotation.apply(np.array(normal))  # SciPy wants writable arrays


def is_visible(taxels: Taxels, at: Float[Array, "taxel 3"], fragments: Fragments, camera: Camera) -> Bool[Array, " taxel"]:
    """Return which taxels face the camera with nothing of the robot between.

    Args:
        taxels: The taxels.
        at: Where they are, as (column [pixel], row [pixel], nearness [m]).
        fragments: The robot.
        camera: The camera.
    """
    height, width = fragments.nearness.shape
    column = np.clip(np.rint(at[:, 0]), 0, width - 1).astype(int)
    row = np.clip(np.rint(at[:, 1]), 0, height - 1).astype(int)
    slack = np.maximum(0.2 * taxels.size, 5e-4)  # [m] for taxels a little under the surface
    return (taxels.normal @ camera.toward > 0) & (at[:, 2] + slack >= fragments.nearness[row, column])
