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
DECIMALS = 14  # decimals of positions and rotations: those beyond are rounding, which differs from machine to machine


def rounded(values: Float[np.ndarray, " number"]) -> Float[np.ndarray, " number"]:
    """Return a position [m] or rotation rounded to `DECIMALS`."""
    return np.round(values, DECIMALS) + 0.0


@dataclass(eq=False)
class StageWriter:
    """A stage that a compiled model is being written to."""

    file: Path  # the robot file, for messages
    spec: mujoco.MjSpec  # MuJoCo's editable model
    model: mujoco.MjModel  # MuJoCo's compiled model
    stage: Any  # the `Usd.Stage`
    root: str = ""  # path of the default prim
    scope: str = ""  # path of the scope that holds joints and what acts on them
    materials: str = ""  # path of the scope that holds physics materials
    # path of each body's prim by MuJoCo's index; the world's is there only if it holds something
    bodies: dict[int, str] = field(default_factory=dict)
    sites: dict[int, str] = field(default_factory=dict)  # path of each site's prim, by MuJoCo's index
    geoms: dict[int, str] = field(default_factory=dict)  # path of each geom's prim, by MuJoCo's index
    joints: dict[int, Any] = field(default_factory=dict)  # schema of each joint that can move, by MuJoCo's index
    tendons: dict[int, str] = field(default_factory=dict)  # path of each tendon's prim, by MuJoCo's index
    frictions: dict[float, Any] = field(default_factory=dict)  # the physics material of each sliding friction that is in use
    unsupported: list[str] = field(default_factory=list)  # one message for each thing that USD does not hold
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
        prim = self.stage.DefinePrim(self.path(self.scope, prim_name), kind)
        set_custom(prim, "name", name)
        return prim

    def body_name(self, body: int) -> str:
        return self.model.body(body).name or f"body_{body}"


def set_pose(
    prim: Any,
    pos: Float[np.ndarray, " 3"],
    quat: Float[np.ndarray, " 4"],
    scale: Float[np.ndarray, " 3"] | None = None,
) -> None:
    """Give a prim its pose in its parent's frame, in double precision."""
    u = usd_modules()
    xform, double = u.UsdGeom.Xformable(prim), u.UsdGeom.XformOp.PrecisionDouble
    xform.AddTranslateOp(double).Set(u.Gf.Vec3d(*rounded(pos).tolist()))
    xform.AddOrientOp(double).Set(u.Gf.Quatd(*rounded(quat).tolist()))
    if scale is not None:
        xform.AddScaleOp(double).Set(u.Gf.Vec3d(*scale.tolist()))
