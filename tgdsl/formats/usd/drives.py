"""Drives of a USD stage's joints, each as one servo, in SI and radians."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tgdsl.formats.usd.custom_attributes import read_custom
from tgdsl.formats.usd.stage import Prim, Stage

INFINITE = 1e30
"""Limits of this magnitude and more are infinite: the largest float32 is often written for infinity."""
ROUNDING = 1e-6
"""A drive's damping below this share of the joint's own, which was subtracted from it, is rounding of float32."""
Range = tuple[float, float]


@dataclass(frozen=True)
class Drive:
    """A spring and damper that pulls a joint towards a target.

    Attributes:
        stiffness: [N·m/rad or N/m].
        damping: [N·m·s/rad or N·s/m].
        max_force: [N·m or N], or infinity.
        target: Target position [rad or m].
        target_velocity: [rad/s or m/s].
        actuator: Name of its actuator, or empty: the joint's.
        control: Range of the target, or None if it is free.
        gear: The actuator's control is the target times this; it enters its gains twice, its force once.
        order: Place of its actuator among those that say so; the others come after them.
    """

    stiffness: float
    damping: float
    max_force: float
    target: float
    target_velocity: float
    actuator: str = ""
    control: Range | None = None
    gear: float = 1.0
    order: float = math.inf


def read_drive(stage: Stage, prim: Prim, instance: str, kind: str, own: float) -> tuple[Drive | None, float]:
    """Return a joint's drive, if it has one that can exert a force, and the joint's own damping.

    Args:
        stage: The stage.
        prim: The joint.
        instance: Which drive is along its degree of freedom.
        kind: `hinge` or `slide`.
        own: The joint's own damping [N·m·s/rad or N·s/m], which is part of the drive's.
    """
    if not prim.HasAPI(stage.pxr.UsdPhysics.DriveAPI, instance):
        return None, own
    stiffness, damping, most, target, velocity = (
        stage.number(prim, f"drive:{instance}:physics:{name}")
        for name in ("stiffness", "damping", "maxForce", "targetPosition", "targetVelocity")
    )
    if not stiffness and not damping:
        return None, own  # it never exerts a force
    if stage.value(prim, f"drive:{instance}:physics:type") == "acceleration":
        stage.drop("drives were dropped whose gains are per mass (type acceleration), which MuJoCo does not have", prim)
        return None, own
    gain, force, unit = _si_units(stage, is_angular=kind == "hinge")
    most = math.inf if most >= INFINITE else most * force
    own = min(own, damping * gain)
    rest = damping * gain - own
    rest = 0.0 if rest < ROUNDING * own else rest
    if not stiffness and not rest:
        return None, own
    gear = float(read_custom(stage, prim, "gear") or 1.0)
    of_joint, of_actuator = (read_custom(stage, prim, key) for key in ("actuatorfrcrange", "forcerange"))
    if of_joint is not None and math.isclose(most, np.abs(of_joint).max(), rel_tol=ROUNDING):
        # The drive's limit is the smaller of the joint's, which is read with the joint, and the actuator's.
        most = math.inf if of_actuator is None else float(of_actuator[1]) * abs(gear)
    control = read_custom(stage, prim, "ctrlrange")
    order = read_custom(stage, prim, "order")
    drive = Drive(
        stiffness * gain,
        rest,
        most,
        target * unit,
        velocity * unit,
        str(read_custom(stage, prim, "actuator") or ""),
        None if control is None else (float(control[0]), float(control[1])),
        gear,
        math.inf if order is None else float(order),
    )
    return drive, own


def _si_units(stage: Stage, is_angular: bool) -> tuple[float, float, float]:
    """Return the stage's units of a drive's gains, of its force and of its target, in SI and radians."""
    if is_angular:
        torque = stage.kilograms_per_unit * stage.metres_per_unit**2
        return stage.kilograms_per_unit * (stage.metres_per_unit**2 * math.degrees(1)), torque, math.radians(1)
    return stage.kilograms_per_unit, stage.kilograms_per_unit * stage.metres_per_unit, stage.metres_per_unit
