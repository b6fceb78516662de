"""A USD stage in the making: its names, its poses, and what it was not able to hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.errors import RobotError
from tgdsl.formats.usd.stage import NAMESPACE

DECIMALS = 14
"""Decimals of positions and rotations: those beyond are rounding, which differs from machine to machine."""


def tidy(values: Float[np.ndarray, " number"]) -> Float[np.ndarray, " number"]:
    """Return a position [m] or rotation without the noise of its last digits."""
    return np.round(values, DECIMALS) + 0.0


def usd() -> Any:
    """Return USD's modules by their names; they are an extra, and only this function imports them.

    Raises:
        RobotError: If usd-core is not installed.
    """
    try:
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
    except ImportError as error:
        raise RobotError("USD files need usd-core, which is not installed: pip install usd-core") from error
    return SimpleNamespace(
        Gf=Gf, Sdf=Sdf, Tf=Tf, Usd=Usd, UsdGeom=UsdGeom, UsdPhysics=UsdPhysics, UsdShade=UsdShade, Vt=Vt
    )  # fmt: skip


@dataclass(eq=False)
class Draft:
    """A stage that a compiled model is being written to.

    Attributes:
        file: The robot file, for messages.
        spec: MuJoCo's editable model.
        model: MuJoCo's compiled model.
        stage: The `Usd.Stage`.
        root: Path of the default prim.
        bodies: Path of each body's prim by MuJoCo's index; the world's is there only if it holds something.
        frictions: The physics material of each sliding friction that is in use.
        left_out: One message for each thing that USD does not hold.
    """

    file: Path
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    stage: Any
    root: str = ""
    bodies: dict[int, str] = field(default_factory=dict)
    frictions: dict[float, Any] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    _taken: set[str] = field(default_factory=set)

    def path(self, parent: str, name: str) -> str:
        """Return a path below a prim that is valid, like the name, and not yet taken; and take it."""
        plain = f"{parent}/{usd().Tf.MakeValidIdentifier(name)}"
        found, number = plain, 0
        while found in self._taken:
            number += 1
            found = f"{plain}_{number}"
        self._taken.add(found)
        return found

    def body_name(self, body: int) -> str:
        """Return a body's name, or what a message and a prim call one that has none."""
        return self.model.body(body).name or f"body_{body}"


def place(
    prim: Any,
    pos: Float[np.ndarray, 3],
    quat: Float[np.ndarray, 4],
    scale: Float[np.ndarray, 3] | None = None,
) -> None:
    """Give a prim its pose in its parent's frame, in double precision.

    Args:
        prim: A prim that has no pose yet.
        pos: Its origin [m].
        quat: Its rotation, w x y z.
        scale: Factors along its own axes, applied first.
    """
    u = usd()
    xform, double = u.UsdGeom.Xformable(prim), u.UsdGeom.XformOp.PrecisionDouble
    xform.AddTranslateOp(double).Set(u.Gf.Vec3d(*tidy(pos).tolist()))
    xform.AddOrientOp(double).Set(u.Gf.Quatd(*tidy(quat).tolist()))
    if scale is not None:
        xform.AddScaleOp(double).Set(u.Gf.Vec3d(*scale.tolist()))


def note(prim: Any, key: str, value: str | bool | int | float | tuple[float, float] | list[float] | list[str]) -> None:
    """Keep on a prim what USD has no word for, as the attribute `tgdsl:<key>`; an empty name is not kept."""
    if value == "":
        return
    types = usd().Sdf.ValueTypeNames
    kinds = {str: types.String, bool: types.Bool, int: types.Int, float: types.Double, tuple: types.Double2}
    kinds[list] = types.StringArray if isinstance(value, list) and isinstance(value[0], str) else types.DoubleArray
    kind = kinds[type(value)]
    prim.CreateAttribute(f"{NAMESPACE}{key}", kind, custom=True).Set(value)


def put(attribute: Any, value: float | Float[np.ndarray, " number"]) -> None:
    """Set an attribute to 15 digits, and keep them in its double twin `tgdsl:<its name>` where it has float32 only.

    Args:
        attribute: A number, a vector of three or a quaternion (w x y z).
        value: Its value.
    """
    u, digits = usd(), [float(f"{number:.15g}") + 0.0 for number in np.ravel(value).tolist()]
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
