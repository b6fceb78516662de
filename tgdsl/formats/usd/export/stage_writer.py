"""A USD stage that is being written: prim paths, transforms, and what is unsupported."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.formats.usd.attributes import set_custom
from tgdsl.formats.usd.stage import usd_modules

FREE, BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE"))
DECIMALS = 14
"""Decimals of positions and rotations: those beyond are rounding, which differs from machine to machine."""


def rounded(values: Float[np.ndarray, " number"]) -> Float[np.ndarray, " number"]:
    """Return a position [m] or rotation rounded to `DECIMALS`."""
    return np.round(values, DECIMALS) + 0.0


@dataclass(eq=False)
class StageWriter:
    """A stage that a compiled model is being written to.

    Attributes:
        file: The robot file, for messages.
        spec: MuJoCo's editable model.
        model: MuJoCo's compiled model.
        stage: The `Usd.Stage`.
        root: Path of the default prim.
        scope: Path of the scope that holds joints and what acts on them.
        materials: Path of the scope that holds physics materials.
        bodies: Path of each body's prim by MuJoCo's index; the world's is there only if it holds something.
        sites: Path of each site's prim, by MuJoCo's index.
        geoms: Path of each geom's prim, by MuJoCo's index.
        joints: Schema of each joint that can move, by MuJoCo's index.
        tendons: Path of each tendon's prim, by MuJoCo's index.
        frictions: The physics material of each sliding friction that is in use.
        unsupported: One message for each thing that USD does not hold.
    """

    file: Path
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    stage: Any
    root: str = ""
    scope: str = ""
    materials: str = ""
    bodies: dict[int, str] = field(default_factory=dict)
    sites: dict[int, str] = field(default_factory=dict)
    geoms: dict[int, str] = field(default_factory=dict)
    joints: dict[int, Any] = field(default_factory=dict)
    tendons: dict[int, str] = field(default_factory=dict)
    frictions: dict[float, Any] = field(default_factory=dict)
    unsupported: list[str] = field(default_factory=list)
    _taken: set[str] = field(default_factory=set)

    def path(self, parent: str, name: str) -> str:
        """Return a path below a prim that is valid, like the name, and not yet taken; and take it."""
        plain = f"{parent}/{usd_modules().Tf.MakeValidIdentifier(name)}"
        result, number = plain, 0
        while result in self._taken:
            number += 1
            result = f"{plain}_{number}"
        self._taken.add(result)
        return result

    def define(self, kind: str, prim_name: str, name: str) -> Any:
        """Define a prim of MuJoCo's schemas in `scope`; `name` is MuJoCo's."""
        prim = self.stage.DefinePrim(self.path(self.scope, prim_name), kind)
        set_custom(prim, "name", name)
        return prim

    def body_name(self, body: int) -> str:
        """Return a body's name, or what a message and a prim call one that has none."""
        return self.model.body(body).name or f"body_{body}"


def set_pose(
    prim: Any,
    pos: Float[np.ndarray, " 3"],
    quat: Float[np.ndarray, " 4"],
    scale: Float[np.ndarray, " 3"] | None = None,
) -> None:
    """Give a prim its pose in its parent's frame, in double precision.

    Args:
        prim: A prim that has no pose yet.
        pos: Its origin [m].
        quat: Its rotation, w x y z.
        scale: Factors along its own axes, applied first.
    """
    u = usd_modules()
    xform, double = u.UsdGeom.Xformable(prim), u.UsdGeom.XformOp.PrecisionDouble
    xform.AddTranslateOp(double).Set(u.Gf.Vec3d(*rounded(pos).tolist()))
    xform.AddOrientOp(double).Set(u.Gf.Quatd(*rounded(quat).tolist()))
    if scale is not None:
        xform.AddScaleOp(double).Set(u.Gf.Vec3d(*scale.tolist()))
