"""A USD stage that is being written: prim paths, transforms, attributes, and what is unsupported."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.formats.usd.stage import NAMESPACE, usd_modules

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
        bodies: Path of each body's prim by MuJoCo's index; the world's is there only if it holds something.
        sites: Path of each site's prim, by MuJoCo's index.
        geoms: Path of each geom's prim, by MuJoCo's index.
        frictions: The physics material of each sliding friction that is in use.
        unsupported: One message for each thing that USD does not hold.
    """

    file: Path
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    stage: Any
    root: str = ""
    bodies: dict[int, str] = field(default_factory=dict)
    sites: dict[int, str] = field(default_factory=dict)
    geoms: dict[int, str] = field(default_factory=dict)
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


def set_custom(prim: Any, key: str, value: str | bool | int | float | tuple[float, float] | list[float] | list[str]) -> None:
    """Set a prim's custom attribute `tgdsl:<key>`; an empty string is not written."""
    if value == "":
        return
    types = usd_modules().Sdf.ValueTypeNames
    kinds = {str: types.String, bool: types.Bool, int: types.Int, float: types.Double, tuple: types.Double2}
    kinds[list] = types.StringArray if isinstance(value, list) and isinstance(value[0], str) else types.DoubleArray
    kind = kinds[type(value)]
    prim.CreateAttribute(f"{NAMESPACE}{key}", kind, custom=True).Set(value)


def set_number(attribute: Any, value: float | Float[np.ndarray, " number"]) -> None:
    """Set an attribute to 15 digits; where it is float32, also its double-precision copy `tgdsl:<its name>`.

    Args:
        attribute: A number, a vector of three or a quaternion (w x y z).
        value: Its value.
    """
    u, digits = usd_modules(), [float(f"{number:.15g}") + 0.0 for number in np.ravel(value).tolist()]
    types, kind = u.Sdf.ValueTypeNames, attribute.GetTypeName().type.typeName
    if kind == "GfQuatf":
        exact, wide = u.Gf.Quatd(*digits), types.Quatd
        attribute.Set(u.Gf.Quatf(exact))
    elif kind == "GfVec3f":
        exact, wide = u.Gf.Vec3d(*digits), types.Double3
        attribute.Set(u.Gf.Vec3f(exact))
    else:
        exact, wide = digits[0], types.Double
        attribute.Set(exact)
    if type(exact)(attribute.Get()) != exact:
        attribute.GetPrim().CreateAttribute(f"{NAMESPACE}{attribute.GetName()}", wide, custom=True).Set(exact)
